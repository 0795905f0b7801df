"""All of a recording but its samples, as plain values that a file of any format can hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import torch

from tactslip_torch.data.formats._limits import MOST_CHANNELS, Refused
from tactslip_torch.data.formats._reading import Archived, Opened, Samples
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout

FORM = "tactslip_torch recording 1"
MOST_HEADER = 16 * 2**20
"""Bytes of header text; a longer one is no header of ours."""
DTYPES = {"float32": torch.float32, "float64": torch.float64}
MOMENTS = ("speeds_mm_s", "onsets_s", "annotated_onsets_s")
STRETCHES = ("sliding_s", "non_slip_s", "slip_s")


def header_of(recording: Recording, hand: HandLayout, key: Mapping[str, Any]) -> dict[str, Any]:
    """What ``opened_from`` reads, numbers to the bit, as JSON has it.

    Raises:
        ValueError: if samples are neither float32 nor float64, the hand has another number of
            channels, a word holds a NUL, or provenance or key is not JSON-able.
    """
    samples = recording.samples
    if samples.dtype not in DTYPES.values():
        raise ValueError(f"samples must be float32 or float64 to be saved, got {samples.dtype}")
    if len(hand) != len(samples):
        raise ValueError(f"the hand has {len(hand)} channels, the recording {len(samples)}")
    for word in (recording.units, recording.material, *hand.names):
        if "\0" in word:
            raise ValueError(f"a name must not hold a NUL to be saved, got {word!r}")
    header = {
        "format": FORM,
        "dtype": str(samples.dtype).removeprefix("torch."),
        "shape": list(samples.shape),
        "units": recording.units,
        "sample_rate_hz": float(recording.sample_rate_hz),
        "material": recording.material,
        **{name: list(getattr(recording, name)) for name in (*MOMENTS, *STRETCHES)},
        "channels": hand.to_rows(),
    }
    for name, values in (("provenance", recording.provenance), ("key", key)):
        try:
            header[name] = json.loads(text_of(dict(values)))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be plain JSON values to be saved: {error}") from error
    return header


def text_of(header: Mapping[str, Any]) -> str:
    """One line of JSON, ASCII; equal headers give equal text."""
    return json.dumps(header, sort_keys=True, allow_nan=False)


def header_in(text: str | None) -> dict[str, Any] | None:
    """What ``text_of`` wrote; ``None`` if a text is not ours.

    Raises:
        Refused: if it is of another version, or too long.
        ValueError: if it is damaged.
    """
    if text is None or FORM.rpartition(" ")[0] not in text:
        return None
    if len(text) > MOST_HEADER:
        raise Refused(f"has a header of {len(text)} characters, at most {MOST_HEADER} are read")
    header = json.loads(text)
    form = header.get("format") if isinstance(header, dict) else None
    if form != FORM:
        raise Refused(f"must be of format {FORM!r}, got {str(form)[:80]!r}")
    return dict(header)


def shape_of(header: Mapping[str, Any]) -> tuple[int, int]:
    """Channels and samples that a header states.

    Raises:
        ValueError: if these are no numbers that can be.
    """
    num_channels, num_samples = header["shape"]
    is_count = all(type(n) is int and 0 <= n < 2**62 for n in (num_channels, num_samples))
    if not is_count or not 0 < num_channels <= MOST_CHANNELS:
        raise ValueError(f"a header of {str(header['shape'])[:40]} samples")
    return num_channels, num_samples


def opened_from(header: Mapping[str, Any], samples: Samples) -> Opened:
    """An open file of ours: its samples, and all else around none of them.

    Raises:
        ValueError: if a part of the header is missing or wrong, or belongs to other samples.
    """
    try:
        if samples.dtype != DTYPES[header["dtype"]] or shape_of(header) != (
            samples.num_channels,
            samples.num_samples,
        ):
            raise ValueError(
                f"{samples.num_channels} by {samples.num_samples} samples in {samples.dtype}, "
                f"where its header says {header['shape']} in {header['dtype']}"
            )
        hand = HandLayout.from_rows(header["channels"])
        if len(hand) != samples.num_channels:
            raise ValueError(f"{len(hand)} rows of channels for {samples.num_channels} channels")
        truth: dict[str, Any] = {name: tuple(map(float, header[name])) for name in MOMENTS}
        for name in STRETCHES:
            truth[name] = tuple((float(start), float(end)) for start, end in header[name])
        recording = Recording(
            samples.read(0, 0),
            float(header["sample_rate_hz"]),
            str(header["material"]),
            **truth,
            provenance=dict(header["provenance"]),
            units=str(header["units"]),
        )
        archived = Archived(recording, hand, dict(header["key"]))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"a header that lacks a part: {error}") from error
    return Opened(samples, archived, hand.names, None, recording.sample_rate_hz)
