"""All of a recording but its samples, as plain values that a file of any format can hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.data.formats._faults import MOST_CHANNELS, Refused
from tactslip_torch.data.formats._reading import Archived, Opened, Samples
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout

FORM = "tactslip_torch recording 1"
MOST_HEADER = 16 * 2**20
"""Bytes of header text; a longer one is no header of ours."""
DTYPES = {"float32": torch.float32, "float64": torch.float64}
_STRETCHES = ("sliding_s", "non_slip_s", "slip_s")
_MOMENTS = ("speeds_mm_s", "onsets_s", "annotated_onsets_s")


def facts_of(recording: Recording, hand: HandLayout, key: Mapping[str, Any]) -> dict[str, Any]:
    """What ``archived_from`` gives back, numbers to the bit, as JSON has it.

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
    return {
        "format": FORM,
        "dtype": str(samples.dtype).removeprefix("torch."),
        "shape": list(samples.shape),
        "units": recording.units,
        "sample_rate_hz": float(recording.sample_rate_hz),
        "material": recording.material,
        **{name: list(getattr(recording, name)) for name in (*_MOMENTS, *_STRETCHES)},
        "channels": hand.to_rows(),
        "provenance": _plain("provenance", recording.provenance),
        "key": _plain("key", key),
    }


def text_of(facts: Mapping[str, Any]) -> str:
    """One line of JSON, ASCII; equal facts give equal text."""
    return json.dumps(facts, sort_keys=True, allow_nan=False)


def facts_in(text: str | bytes | None) -> dict[str, Any] | None:
    """What ``text_of`` wrote; ``None`` if a text is not ours.

    Raises:
        Refused: if it is of another version, or too long.
        ValueError: if it is damaged.
    """
    if isinstance(text, bytes):
        text = text.decode()
    if text is None or FORM.rpartition(" ")[0] not in text:
        return None
    if len(text) > MOST_HEADER:
        raise Refused(f"has a header of {len(text)} characters, at most {MOST_HEADER} are read")
    facts = json.loads(text)
    form = facts.get("format") if isinstance(facts, dict) else None
    if form != FORM:
        raise Refused(f"must be of format {FORM!r}, got {str(form)[:80]!r}")
    return dict(facts)


def shape_of(facts: Mapping[str, Any]) -> tuple[int, int]:
    """Channels and samples that a header states.

    Raises:
        ValueError: if these are no numbers that can be.
    """
    num_channels, num_samples = facts["shape"]
    is_count = all(type(n) is int and 0 <= n < 2**62 for n in (num_channels, num_samples))
    if not is_count or not 0 < num_channels <= MOST_CHANNELS:
        raise ValueError(f"a header of {str(facts['shape'])[:40]} samples")
    return num_channels, num_samples


def archived_from(facts: Mapping[str, Any], samples: Tensor) -> Archived:
    """What ``facts_of`` was given, around these samples ``[C, T]``, or none of them ``[C, 0]``.

    Raises:
        ValueError: if a part is missing or wrong, or belongs to other samples.
    """
    try:
        num_channels, num_samples = shape_of(facts)
        shapes = ((num_channels, num_samples), (num_channels, 0))
        if samples.dtype != DTYPES[facts["dtype"]] or samples.shape not in shapes:
            raise ValueError(
                f"{list(samples.shape)} samples in {samples.dtype}, where its header says "
                f"{facts['shape']} in {facts['dtype']}"
            )
        hand = HandLayout.from_rows(facts["channels"])
        if len(hand) != num_channels:
            raise ValueError(f"{len(hand)} rows of channels for {num_channels} channels")
        truth: dict[str, Any] = {
            name: tuple(float(value) for value in facts[name]) for name in _MOMENTS
        }
        for name in _STRETCHES:
            truth[name] = tuple((float(start), float(end)) for start, end in facts[name])
        recording = Recording(
            samples,
            float(facts["sample_rate_hz"]),
            str(facts["material"]),
            provenance=dict(facts["provenance"]),
            units=str(facts["units"]),
            **truth,
        )
        return Archived(recording, hand, dict(facts["key"]))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"a header that lacks a part: {error}") from error


def ours(facts: Mapping[str, Any], samples: Samples) -> Opened:
    """An open file of ours: its samples, and all else around none of them.

    Raises:
        ValueError: as ``archived_from``, or if there are more or fewer samples than it states.
    """
    archived = archived_from(facts, samples.read(0, 0))
    if samples.num_samples != facts["shape"][1]:
        raise ValueError(f"{samples.num_samples} samples, where its header says {facts['shape']}")
    rate = archived.recording.sample_rate_hz
    return Opened(samples, archived, archived.hand.names, None, rate)


def _plain(what: str, values: Mapping[str, Any]) -> Any:
    """Values as JSON gives them back.

    Raises:
        ValueError: naming ``what``, if they are not plain.
    """
    try:
        return json.loads(text_of(dict(values)))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} must be plain JSON values to be saved: {error}") from error
