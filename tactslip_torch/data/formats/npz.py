"""Recordings as ``.npz`` files that anything with NumPy can read: samples, truth and origin.

One file holds one recording. Numbers are arrays, words are text arrays, what has no fixed form is
JSON text; nothing is pickled, and nothing in a file is executed. ``open`` leaves the samples where
they are and reads them by stretches, so a recording may be longer than the memory. Samples alone
are read as well: a ``.npy`` array ``[T, C]``, or an archive with ``samples`` ``[C, T]``.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats.header import (
    DTYPES,
    FORM,
    Archived,
    check_savable,
    damaged,
    plain_json,
)
from tactslip_torch.data.formats.npz_members import MOST_CHANNELS, check_members
from tactslip_torch.data.formats.reading import (
    AS_IT_SAYS,
    RATE_NAMES,
    SECONDS,
    KeptTimes,
    Opened,
    Reading,
    is_time_first,
    time_name,
)
from tactslip_torch.data.formats.refusing import Refused, refusing
from tactslip_torch.data.formats.stored_array import StoredSamples, array_head, stored_samples
from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

_LOCAL_HEADER = struct.Struct("<26xHH")  # of a ZIP member: lengths of its name and extra field
_ZIP = b"PK\3\4"
_MOST_NAMED = 8
_COLUMNS = ("name", "kind", "finger", "segment", "adapting")
_Read = TypeVar("_Read")


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to one ``.npz`` file, whole or not at all; equal input, equal bytes.

    The file holds ``samples`` ``[C, T]`` in ``units``; ``sample_rate_hz``, ``material``,
    ``speeds_mm_s``, ``onsets_s``, ``annotated_onsets_s``, ``sliding_s``, ``non_slip_s`` and, if
    there is any, ``slip_s`` (rows of start and end); ``channel_name``, ``channel_kind``,
    ``channel_finger``, ``channel_segment`` and, if a kind does not say it, ``channel_adapting``
    (one per row of samples); ``provenance`` and ``key`` as JSON text; ``format``.

    Args:
        path: of the file.
        recording: samples in float32 or float64; tuples in its provenance come back as lists.
        hand: its channels, in the order of its rows.
        key: JSON-able facts that determined the samples, kept to find the file again.

    Raises:
        ValueError: if the hand has another number of channels, the samples another dtype, a word
            holds a NUL, or provenance or key is not JSON-able.
    """
    check_savable(recording, hand)
    content: dict[str, Any] = {
        "format": np.array(FORM),
        "samples": recording.samples.detach().cpu().contiguous().numpy(),
        "units": _words([recording.units])[0],
        "sample_rate_hz": np.float64(recording.sample_rate_hz),
        "material": _words([recording.material])[0],
        "speeds_mm_s": np.array(recording.speeds_mm_s, dtype=np.float64),
        "onsets_s": np.array(recording.onsets_s, dtype=np.float64),
        "annotated_onsets_s": np.array(recording.annotated_onsets_s, dtype=np.float64),
        "sliding_s": np.array(recording.sliding_s, dtype=np.float64).reshape(-1, 2),
        "non_slip_s": np.array(recording.non_slip_s, dtype=np.float64).reshape(-1, 2),
        "provenance": np.array(plain_json("provenance", recording.provenance)),
        "key": np.array(plain_json("key", key)),
    }
    if recording.slip_s:
        content["slip_s"] = np.array(recording.slip_s, dtype=np.float64)
    rows = hand.to_rows()
    for column in _COLUMNS:
        if any(column in row for row in rows):
            content[f"channel_{column}"] = _words([row.get(column, "") for row in rows])
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **content)


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or no file of ours.
    """
    return _read(path, lambda content: _archived(content, torch.from_numpy(content["samples"])))


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of ours, or damaged where the key stands.
    """
    return _read(path, lambda content: _plain(content, "key"))


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """What ``save`` wrote, its samples, once checked for damage, to be read by stretches.

    Compressed ones are unpacked to a temporary file (``TMPDIR``). Arrays of others: of an archive
    ``reading.samples``, or the one called so.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or holds no such samples.
    """
    with ExitStack() as stack:
        with refusing(path):
            file = stack.enter_context(Path(path).open("rb"))
            samples, is_ours = _stored(file, stack, how, path)
            times, rate = (None, None) if is_ours else _beside(file, samples, how, path)
            none = samples.read(0, 0)
        rest = _read(path, lambda content: _archived(content, none)) if is_ours else None
        rate = rest.recording.sample_rate_hz if rest else rate
        yield Opened(samples, rest, rest.hand.names if rest else None, times, rate)


def _stored(
    file: IO[bytes], stack: ExitStack, how: Reading, path: str | os.PathLike[str]
) -> tuple[StoredSamples, bool]:
    """The samples of a file, and whether it is one of ours; an archive's are read for its sum."""
    is_array = file.read(len(npy.MAGIC_PREFIX)) == npy.MAGIC_PREFIX
    file.seek(0)
    if is_array:
        head = array_head(file)
        is_first = how.time_first is not False
        return stored_samples(file, head, is_time_first=is_first), False
    wanted = how.samples or "samples"
    with zipfile.ZipFile(file) as archive:
        there = archive.namelist()
        is_ours = "format.npy" in there and wanted == "samples"
        if f"{wanted}.npy" not in there and all(name.endswith(".npy") for name in there):
            arrays = ", ".join(name.removesuffix(".npy") for name in there[:_MOST_NAMED])
            raise Refused(
                f"{os.fspath(path)} has no array {wanted!r}, it has {arrays}; say reading.samples"
            )
        check_members(archive, path)
        member = archive.getinfo(f"{wanted}.npy")
        is_packed = member.compress_type != zipfile.ZIP_STORED
        copied = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115  # by the stack
        with archive.open(member) as content, Path(os.devnull).open("wb") as nowhere:
            shutil.copyfileobj(content, copied if is_packed else nowhere)
    if is_packed:
        copied.seek(0)
        file = copied
    else:
        file.seek(member.header_offset)
        name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        file.seek(name + extra, os.SEEK_CUR)
    end = file.tell() + member.file_size
    head = array_head(file)
    if head.end > end:
        raise ValueError("samples must be all there")
    is_first = how.time_first is True
    if how.samples is not None and how.time_first is None:
        try:
            is_first = is_time_first((head.shape[0], head.shape[1]), how, path, wanted)
        except ValueError as error:
            raise Refused(str(error)) from None
    return stored_samples(file, head, is_time_first=is_first and not is_ours), is_ours


def _beside(
    file: IO[bytes], samples: StoredSamples, how: Reading, path: str | os.PathLike[str]
) -> tuple[KeptTimes | None, float | None]:
    """Times and rate that stand beside the samples of an archive of others."""
    file.seek(0)
    if not zipfile.is_zipfile(file):
        return None, None
    file.seek(0)
    with np.load(file, allow_pickle=False) as content:
        try:
            name = time_name(content.files, how)
        except ValueError as error:
            raise Refused(f"{os.fspath(path)}: {error}") from None
        rates = [content[n] for n in content.files if n.lower() in RATE_NAMES]
        rate = float(rates[0]) if len(rates) == 1 and rates[0].size == 1 else None
        if name is None:
            return None, rate
        times = np.asarray(content[name]).reshape(-1)
    if times.dtype.kind not in "iuf" or len(times) != samples.num_samples:
        raise Refused(
            f"{os.fspath(path)} has {samples.num_samples} samples and {len(times)} times in "
            f"{name!r}; give reading.time=null to go without"
        )
    seconds = (times - times[:1]).astype(np.float64) * SECONDS[how.time_unit]
    return KeptTimes(torch.from_numpy(seconds)), rate


def _read(
    path: str | os.PathLike[str], what: Callable[[Mapping[str, NDArray[Any]]], _Read]
) -> _Read:
    """What can be made of an archive's arrays, each read when it is asked for."""
    with refusing(path), Path(path).open("rb") as file:
        if file.read(len(_ZIP)) != _ZIP:  # NumPy would read an array whole
            raise damaged(path)
        with zipfile.ZipFile(file) as archive:
            check_members(archive, path)
        file.seek(0)
        with np.load(file, allow_pickle=False) as content:
            if (form := str(content["format"])) != FORM:
                raise Refused(f"{os.fspath(path)} must be of format {FORM!r}, got {form[:80]!r}")
            return what(content)


def _archived(content: Mapping[str, NDArray[Any]], samples: Tensor) -> Archived:
    """Everything in a file around its samples, each part held against what it must be."""
    if samples.dtype not in DTYPES.values():
        raise ValueError("samples must be floating")
    columns = [column for column in _COLUMNS if f"channel_{column}" in content]
    if len(samples) > MOST_CHANNELS:
        raise ValueError(f"{len(samples)} channels, at most {MOST_CHANNELS} are read")
    words = [content[f"channel_{column}"].tolist() for column in columns]
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*words, strict=True))
    hand = HandLayout.from_rows(
        {column: word for column, word in row.items() if word or column != "adapting"}
        for row in rows
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
        slip_s=_stretches(content["slip_s"]) if "slip_s" in content else (),
        units=str(content["units"]),
    )
    return Archived(recording, hand, _plain(content, "key"))


def _numbers(array: NDArray[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in array)


def _stretches(array: NDArray[Any]) -> tuple[tuple[float, float], ...]:
    return tuple((float(start), float(end)) for start, end in array)


def _plain(content: Mapping[str, NDArray[Any]], name: str) -> dict[str, Any]:
    """A mapping that stands as JSON text."""
    return dict(json.loads(str(content[name])))


def _words(words: list[str]) -> NDArray[np.str_]:
    """A text array; NumPy drops NULs at the end of words, so there may be none."""
    for word in words:
        if "\0" in word:
            raise ValueError(f"a name must not hold a NUL to be saved, got {word!r}")
    return np.array(words, dtype=np.str_)
