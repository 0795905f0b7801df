"""All of a recording but its samples, as one JSON text that a file of any format can hold."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout

FORM = "tactslip_torch recording 1"
DTYPES = {"float32": torch.float32, "float64": torch.float64}
MOST_HEADER = 16 * 2**20
"""Bytes of header text; a longer one is no header of ours."""


class Archived(NamedTuple):
    """What a file of ours holds.

    Args:
        recording: samples and truth.
        hand: its channels.
        key: what determined the samples, as plain values.
    """

    recording: Recording
    hand: HandLayout
    key: dict[str, Any]


def header_of(recording: Recording, hand: HandLayout, key: Mapping[str, Any]) -> str:
    """One line of JSON, ASCII; ``archived_from`` gives all of it back, numbers to the bit.

    Raises:
        ValueError: if samples are neither float32 nor float64, the hand has another number of
            channels, or provenance or key is not JSON-able.
    """
    check_savable(recording, hand)
    facts = {
        "format": FORM,
        "dtype": str(recording.samples.dtype).removeprefix("torch."),
        "shape": list(recording.samples.shape),
        "units": recording.units,
        "sample_rate_hz": float(recording.sample_rate_hz),
        "material": recording.material,
        "speeds_mm_s": list(recording.speeds_mm_s),
        "onsets_s": list(recording.onsets_s),
        "annotated_onsets_s": list(recording.annotated_onsets_s),
        "sliding_s": list(recording.sliding_s),
        "non_slip_s": list(recording.non_slip_s),
        "slip_s": list(recording.slip_s),
        "channels": hand.to_rows(),
        "provenance": json.loads(plain_json("provenance", recording.provenance)),
        "key": json.loads(plain_json("key", key)),
    }
    return json.dumps(facts, sort_keys=True, allow_nan=False)


def archived_from(header: str, samples: Tensor) -> Archived:
    """What ``header_of`` wrote, around these samples ``[C, T]``, or none of them ``[C, 0]``.

    Raises:
        ValueError: if the text is no header of ours, or belongs to other samples.
    """
    facts = facts_of(header)
    try:
        dtype, shape = DTYPES[facts["dtype"]], tuple(facts["shape"])
        if samples.dtype != dtype or samples.shape not in (shape, (shape[0], 0)):
            raise ValueError("the header is of other samples")
        hand = HandLayout.from_rows(facts["channels"])
        if len(hand) != shape[0]:
            raise ValueError("a channel for every row of samples")
        recording = Recording(
            samples,
            float(facts["sample_rate_hz"]),
            str(facts["material"]),
            _numbers(facts["speeds_mm_s"]),
            _numbers(facts["onsets_s"]),
            _stretches(facts["sliding_s"]),
            _numbers(facts["annotated_onsets_s"]),
            _stretches(facts["non_slip_s"]),
            dict(facts["provenance"]),
            slip_s=_stretches(facts["slip_s"]),
            units=str(facts["units"]),
        )
        return Archived(recording, hand, dict(facts["key"]))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"a header that lacks a part: {error}") from error


def facts_of(header: str) -> dict[str, Any]:
    """The header as plain values: ``shape``, ``dtype``, ``key`` and the rest.

    Raises:
        ValueError: if the text is no header of ours.
    """
    if len(header) > MOST_HEADER:
        raise ValueError(f"a header of {len(header)} characters, at most {MOST_HEADER} are read")
    try:
        facts = json.loads(header)
    except RecursionError:
        raise ValueError("a header nested too deeply") from None
    form = facts.get("format") if isinstance(facts, dict) else None
    if form != FORM:
        raise ValueError(f"the header must be of format {FORM!r}, got {form!r}")
    return dict(facts)


def check_savable(recording: Recording, hand: HandLayout) -> None:
    """Refuse samples that no file of ours can hold.

    Raises:
        ValueError: if they are neither float32 nor float64, or the hand has other channels.
    """
    samples = recording.samples
    if samples.dtype not in DTYPES.values():
        raise ValueError(f"samples must be float32 or float64 to be saved, got {samples.dtype}")
    if len(hand) != len(samples):
        raise ValueError(f"the hand has {len(hand)} channels, the recording {len(samples)}")


def plain_json(what: str, plain: Mapping[str, Any]) -> str:
    """JSON text of plain values.

    Raises:
        ValueError: naming ``what``, if they are not.
    """
    try:
        return json.dumps(dict(plain), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} must be plain JSON values to be saved: {error}") from error


def damaged(path: str | os.PathLike[str]) -> ValueError:
    """What to raise of a file that cannot be read."""
    return ValueError(f"{os.fspath(path)} is damaged or no recording of ours")


def _numbers(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _stretches(values: Sequence[Sequence[float]]) -> tuple[tuple[float, float], ...]:
    return tuple((float(start), float(end)) for start, end in values)
