"""Recordings as ``.npz`` files that anything with NumPy can read: samples, truth and origin.

One file holds one recording. Numbers are arrays, words are text arrays, what has no fixed form is
JSON text; nothing is pickled, and nothing in a file is executed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

FORM = "tactslip_torch recording 1"
UNITS = "V"
_DTYPES = (torch.float32, torch.float64)
_Read = TypeVar("_Read")


class Archived(NamedTuple):
    """What a file holds.

    Args:
        recording: samples and truth.
        hand: its channels.
        key: what determined the samples, as plain values.
    """

    recording: Recording
    hand: HandLayout
    key: dict[str, Any]


def save_recording(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to one ``.npz`` file, whole or not at all; equal input, equal bytes.

    The file holds ``samples`` ``[C, T]`` in ``units``; ``sample_rate_hz``, ``material``,
    ``speeds_mm_s``, ``onsets_s``, ``annotated_onsets_s``, ``sliding_s`` and ``non_slip_s``
    (rows of start and end); ``channel_name``, ``channel_kind``, ``channel_finger`` and
    ``channel_segment`` (one per row of samples); ``provenance`` and ``key`` as JSON text;
    ``format``.

    Args:
        path: of the file.
        recording: samples in float32 or float64; tuples in its provenance come back as lists.
        hand: its channels, in the order of its rows.
        key: JSON-able facts that determined the samples, kept to find the file again.

    Raises:
        ValueError: if the hand has another number of channels, the samples another dtype, a word
            holds a NUL, or provenance or key is not JSON-able.
    """
    samples = recording.samples
    if samples.dtype not in _DTYPES:
        raise ValueError(f"samples must be float32 or float64 to be saved, got {samples.dtype}")
    if len(hand) != len(samples):
        raise ValueError(f"the hand has {len(hand)} channels, the recording {len(samples)}")
    content: dict[str, Any] = {
        "format": np.array(FORM),
        "samples": samples.detach().cpu().contiguous().numpy(),
        "units": np.array(UNITS),
        "sample_rate_hz": np.float64(recording.sample_rate_hz),
        "material": _words([recording.material])[0],
        "speeds_mm_s": np.array(recording.speeds_mm_s, dtype=np.float64),
        "onsets_s": np.array(recording.onsets_s, dtype=np.float64),
        "annotated_onsets_s": np.array(recording.annotated_onsets_s, dtype=np.float64),
        "sliding_s": np.array(recording.sliding_s, dtype=np.float64).reshape(-1, 2),
        "non_slip_s": np.array(recording.non_slip_s, dtype=np.float64).reshape(-1, 2),
        "provenance": np.array(_json("provenance", recording.provenance)),
        "key": np.array(_json("key", key)),
    }
    rows = hand.to_rows()
    for column in rows[0]:
        content[f"channel_{column}"] = _words([row[column] for row in rows])
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **content)


def load_recording(path: str | os.PathLike[str]) -> Archived:
    """What ``save_recording`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or no file of ours.
    """
    return _read(path, _archived)


def archived_key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save_recording`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of ours, or damaged where the key stands.
    """
    return _read(path, lambda content: _plain(content, "key"))


def _read(
    path: str | os.PathLike[str], what: Callable[[Mapping[str, NDArray[Any]]], _Read]
) -> _Read:
    name = os.fspath(path)
    try:
        file = Path(path).open("rb")  # noqa: SIM115  # closed below
    except FileNotFoundError:
        raise FileNotFoundError(f"no file at {name}") from None
    with file:
        try:
            with np.load(file, allow_pickle=False) as content:
                form = str(content["format"])
                found = what(content) if form == FORM else None
        except Exception as error:  # zip, zlib, NumPy's header and JSON raise many kinds
            raise ValueError(f"{name} is damaged or no recording of ours") from error
    if found is None:
        raise ValueError(f"{name} must be of format {FORM!r}, got {form!r}")
    return found


def _archived(content: Mapping[str, NDArray[Any]]) -> Archived:
    """Everything in a file, each part held against what it must be."""
    samples = torch.from_numpy(content["samples"])
    if samples.dtype not in _DTYPES or str(content["units"]) != UNITS:
        raise ValueError("samples must be floating volts")
    columns = ("name", "kind", "finger", "segment")
    words = [content[f"channel_{column}"].tolist() for column in columns]
    hand = HandLayout.from_rows(
        dict(zip(columns, row, strict=True)) for row in zip(*words, strict=True)
    )
    if len(hand) != len(samples):
        raise ValueError("a channel for every row of samples")
    recording = Recording(
        samples,
        float(content["sample_rate_hz"]),
        str(content["material"]),
        _numbers(content["speeds_mm_s"]),
        _numbers(content["onsets_s"]),
        _stretches(content["sliding_s"]),
        _numbers(content["annotated_onsets_s"]),
        _stretches(content["non_slip_s"]),
        _plain(content, "provenance"),
    )
    return Archived(recording, hand, _plain(content, "key"))


def _numbers(array: NDArray[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in array)


def _stretches(array: NDArray[Any]) -> tuple[tuple[float, float], ...]:
    return tuple((float(start), float(end)) for start, end in array)


def _plain(content: Mapping[str, NDArray[Any]], name: str) -> dict[str, Any]:
    """A mapping that stands as JSON text."""
    return dict(json.loads(str(content[name])))


def _json(what: str, plain: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(plain), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} must be plain JSON values to be saved: {error}") from error


def _words(words: list[str]) -> NDArray[np.str_]:
    """A text array; NumPy drops NULs at the end of words, so there may be none."""
    for word in words:
        if "\0" in word:
            raise ValueError(f"a name must not hold a NUL to be saved, got {word!r}")
    return np.array(words, dtype=np.str_)
