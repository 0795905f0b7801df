"""Recordings as ``.npz`` files that anything with NumPy can read: samples, truth and origin.

One file holds one recording. Numbers are arrays, words are text arrays, what has no fixed form is
JSON text; nothing is pickled, and nothing in a file is executed. ``open_recording`` leaves the
samples where they are and reads them by stretches, so a recording may be longer than the memory.
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
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

FORM = "tactslip_torch recording 1"
UNITS = "V"
_DTYPES = (torch.float32, torch.float64)
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_LOCAL_HEADER = struct.Struct("<26xHH")  # of a ZIP member: lengths of its name and extra field
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


class StoredSamples(NamedTuple):
    """Samples ``[C, T]`` that stay in an open file from byte ``start`` on until asked for.

    The samples of a channel stand together there or, if not ``is_by_channel``, those of an instant.
    """

    file: IO[bytes]
    start: int
    dtype: np.dtype[Any]
    num_channels: int
    num_samples: int
    is_by_channel: bool

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, as far as there are any, ``[C, n]``.

        Raises:
            ValueError: if the file has been cut since it was opened.
        """
        count = max(min(stop, self.num_samples) - first, 0)
        step, width = 1 if self.is_by_channel else self.num_channels, self.dtype.itemsize
        rows = self.num_channels // step
        content = bytearray()
        for row in range(rows):
            self.file.seek(self.start + (row * self.num_samples + first * step) * width)
            content += self.file.read(count * step * width)
        if len(content) < self.num_channels * count * width:
            raise ValueError(f"{self.file.name} was cut while it was read; make it again")
        values = np.frombuffer(content, self.dtype).astype(self.dtype.newbyteorder("="), copy=False)
        by_channel = values.reshape(rows, count, step).swapaxes(1, 2)
        return torch.from_numpy(by_channel.reshape(self.num_channels, count))

    def pieces(self, num_samples: int) -> Iterator[Tensor]:
        """All samples in order, ``num_samples`` at a time and the rest at the end."""
        for first in range(0, self.num_samples, num_samples):
            yield self.read(first, first + num_samples)


class OpenRecording(NamedTuple):
    """Samples in a file that is open, and the rest, around a recording of no samples.

    The rest is ``None`` if the file holds samples alone.
    """

    samples: StoredSamples
    archived: Archived | None


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
    return _read(path, lambda content: _archived(content, torch.from_numpy(content["samples"])))


@contextmanager
def open_recording(path: str | os.PathLike[str]) -> Iterator[OpenRecording]:
    """What ``save_recording`` wrote, its samples, once checked for damage, to be read by stretches.

    Compressed ones are unpacked to a temporary file (``TMPDIR``). Volts alone are read as well:
    a ``.npy`` array ``[T, C]``, or an archive of ``samples`` ``[C, T]``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or holds no such samples.
    """
    with ExitStack() as stack:
        file = stack.enter_context(_opened(path))
        try:
            stored, is_ours = _stored(file, stack)
        except Exception as error:
            raise _damaged(path) from error
        none = stored.read(0, 0)
        rest = _read(path, lambda content: _archived(content, none)) if is_ours else None
        yield OpenRecording(stored, rest)


def archived_key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save_recording`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of ours, or damaged where the key stands.
    """
    return _read(path, lambda content: _plain(content, "key"))


def _opened(path: str | os.PathLike[str]) -> IO[bytes]:
    try:
        return Path(path).open("rb")
    except FileNotFoundError:
        raise FileNotFoundError(f"no file at {os.fspath(path)}") from None


def _damaged(path: str | os.PathLike[str]) -> ValueError:
    return ValueError(f"{os.fspath(path)} is damaged or no recording of ours")


def _stored(file: IO[bytes], stack: ExitStack) -> tuple[StoredSamples, bool]:
    """The samples of a file, and whether it is one of ours; an archive's are read for its sum."""
    is_array = file.read(len(npy.MAGIC_PREFIX)) == npy.MAGIC_PREFIX
    file.seek(0)
    if is_array:
        return _stored_array(file, is_time_first=True), False
    with zipfile.ZipFile(file) as archive:
        member = archive.getinfo("samples.npy")
        is_packed = member.compress_type != zipfile.ZIP_STORED
        copied = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115  # by the stack
        with archive.open(member) as content, Path(os.devnull).open("wb") as nowhere:
            shutil.copyfileobj(content, copied if is_packed else nowhere)
        is_ours = archive.namelist() != ["samples.npy"]
    if is_packed:
        copied.seek(0)
        return _stored_array(copied, is_time_first=False), is_ours
    file.seek(member.header_offset)
    name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
    file.seek(name + extra, os.SEEK_CUR)
    return _stored_array(file, is_time_first=False), is_ours


def _stored_array(file: IO[bytes], *, is_time_first: bool) -> StoredSamples:
    """The array that begins where the file is, ``[T, C]`` or ``[C, T]``."""
    version = npy.read_magic(file)  # type: ignore[no-untyped-call]
    shape, is_fortran, dtype = _HEADERS[version](file)  # type: ignore[no-untyped-call]
    num_channels, num_samples = reversed(shape) if is_time_first else shape
    start, needed = file.tell(), num_channels * num_samples * dtype.itemsize
    is_volts = num_channels and dtype.kind == "f" and dtype.itemsize in (4, 8)
    if not is_volts or needed > file.seek(0, os.SEEK_END) - start:
        raise ValueError("samples must be floating volts, and all there")
    return StoredSamples(file, start, dtype, num_channels, num_samples, is_fortran == is_time_first)


def _read(
    path: str | os.PathLike[str], what: Callable[[Mapping[str, NDArray[Any]]], _Read]
) -> _Read:
    with _opened(path) as file:
        try:
            with np.load(file, allow_pickle=False) as content:
                form = str(content["format"])
                found = what(content) if form == FORM else None
        except Exception as error:  # zip, zlib, NumPy's header and JSON raise many kinds
            raise _damaged(path) from error
    if found is None:
        raise ValueError(f"{os.fspath(path)} must be of format {FORM!r}, got {form!r}")
    return found


def _archived(content: Mapping[str, NDArray[Any]], samples: Tensor) -> Archived:
    """Everything in a file around its samples, each part held against what it must be."""
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
