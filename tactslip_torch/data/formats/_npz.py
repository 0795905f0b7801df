"""Recordings as ``.npz`` files that anything with NumPy can read, and ``.npy`` arrays.

Of ours numbers are arrays, words are text arrays, what has no fixed form is JSON text. Nothing is
pickled, and nothing in a file is executed. Arrays are mapped into memory, so no more is read than
is asked for; compressed ones are unpacked to a temporary file (``TMPDIR``) first.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Literal, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import choose, why_not_numbers
from tactslip_torch.data.formats._reading import (
    FORM,
    Opened,
    Reading,
    Refused,
    check_plausible,
    opened_from,
)
from tactslip_torch.data.recording import MOMENTS, STRETCHES

_LOCAL_HEADER = struct.Struct("<26xHH")  # of a ZIP member: lengths of its name and extra field
_MOST_BESIDE = 16 * 2**20  # bytes of a member of ours that is read whole: names, numbers, JSON
_COLUMNS = ("name", "kind", "finger", "segment", "adapting")
_WORDS = ("units", "material")


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write ``samples`` ``[C, T]`` and everything else as arrays of their own.

    Beside them: ``sample_rate_hz``, ``units``, ``material``, ``speeds_mm_s``, ``onsets_s``,
    ``annotated_onsets_s``; ``sliding_s``, ``non_slip_s`` and, if there are any, ``slip_s`` (rows of
    start and end) and ``released_s`` (rows of first and last); ``channel_name``, ``_kind``,
    ``_finger``, ``_segment`` and, if a kind does not say it, ``_adapting`` (one per row of
    samples); ``provenance`` and ``key`` as JSON text.
    """
    content: dict[str, Any] = {"format": np.array(FORM), "samples": samples}
    content |= {name: np.array([header[name]], np.str_)[0] for name in _WORDS}
    content["sample_rate_hz"] = np.float64(header["sample_rate_hz"])
    content |= {name: np.array(header[name], np.float64) for name in MOMENTS}
    for name in STRETCHES:
        if header[name] or name not in ("slip_s", "released_s"):
            content[name] = np.array(header[name], np.float64).reshape(-1, 2)
    for name in ("provenance", "key"):
        content[name] = np.array(json.dumps(header[name], sort_keys=True))
    rows = header["channels"]
    for column in _COLUMNS:
        if any(column in row for row in rows):
            words = [row.get(column, "") for row in rows]
            content[f"channel_{column}"] = np.array(words, np.str_)
    with path.open("wb") as file:
        np.savez(file, **content)


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file of ours, of an array, or of an archive of arrays.

    Of an archive of others ``samples``, if there is one; else what ``choose`` finds.
    """
    file = stack.enter_context(path.open("rb"))
    if file.read(len(npy.MAGIC_PREFIX)) == npy.MAGIC_PREFIX:
        stored = {"samples": _mapped(file, 0, path.stat().st_size)}
        how = replace(how, samples=None)
    else:
        with zipfile.ZipFile(file) as archive:
            stored = {
                member.filename.removesuffix(".npy"): _member(file, archive, member, stack)
                for member in _checked(archive)
                if member.filename.endswith(".npy")
            }
        if "format" in stored and how.samples in (None, "samples"):
            return opened_from(_header(stored), path, stored["samples"], 1)
        if how.samples is None and "samples" in stored:
            how = replace(how, samples="samples")
    found = {n: why_not_numbers(kept.dtype, kept.shape) or kept for n, kept in stored.items()}
    return choose(path, found, how)


def _header(content: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """The header of a file of ours, from its arrays."""
    if (form := str(content["format"])) != FORM:
        raise Refused(f"must be of format {FORM!r}, got {form[:80]!r}")
    needed = ("samples", "sample_rate_hz", *_WORDS, *MOMENTS, "provenance", "key")
    if missing := [name for name in needed if name not in content]:
        raise ValueError(f"no array {', '.join(missing)} in the archive")
    samples = content["samples"]
    beside = {name: kept.tolist() for name, kept in content.items() if name != "samples"}
    words = {c: beside[f"channel_{c}"] for c in _COLUMNS if f"channel_{c}" in beside}
    if any(len(column) != len(samples) for column in words.values()):
        raise ValueError("a name for every row of samples")
    rows = [dict(zip(words, row, strict=True)) for row in zip(*words.values(), strict=True)]
    return beside | {
        "dtype": str(samples.dtype),
        "shape": list(samples.shape),
        **{name: json.loads(beside[name]) for name in ("provenance", "key")},
        "channels": [
            {name: word for name, word in row.items() if word or name != "adapting"} for row in rows
        ],
    }


def _checked(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """The members, none of which claims more than can be meant."""
    members = archive.infolist()
    is_ours = any(member.filename == "format.npy" for member in members)
    for member in members:
        name, size = member.filename[:40], member.file_size
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Refused(f"holds {name!r}, which is not packed as NumPy packs arrays")
        if member.flag_bits & 1:
            raise Refused(f"holds {name!r}, which is encrypted; write it in the clear")
        check_plausible(repr(name), size, member.compress_size)
        if is_ours and name != "samples.npy" and size > _MOST_BESIDE:
            raise Refused(f"holds {name!r} of {size} bytes, at most {_MOST_BESIDE} are read")
    return members


def _member(
    file: IO[bytes], archive: zipfile.ZipFile, member: zipfile.ZipInfo, stack: ExitStack
) -> NDArray[Any]:
    """An array of an archive; all of it is read once, for its check sum."""
    is_packed = member.compress_type != zipfile.ZIP_STORED
    copied = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115  # by the stack
    with archive.open(member) as content, Path(os.devnull).open("wb") as nowhere:
        shutil.copyfileobj(content, copied if is_packed else nowhere)
    if is_packed:
        return _mapped(copied, 0, member.file_size)
    file.seek(member.header_offset)
    name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
    return _mapped(file, file.tell() + name + extra, member.file_size)


def _head(content: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether columns stand together, and dtype, as the head of an array states them."""
    version = npy.read_magic(content)  # type: ignore[no-untyped-call]
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
    head: tuple[tuple[int, ...], bool, np.dtype[Any]] = read(content)  # type: ignore[no-untyped-call]
    return head


def _mapped(file: IO[bytes], start: int, num_bytes: int) -> NDArray[Any]:
    """The array that begins there and must end within so many bytes."""
    file.seek(start)
    shape, is_fortran, dtype = _head(file)
    end = file.tell() + math.prod(shape) * dtype.itemsize
    is_whole = end <= start + num_bytes and min(shape, default=0) >= 0
    if not is_whole or max(shape, default=0) > 2**40:  # an array without channels claims anything
        raise ValueError("samples must be all there")
    if dtype.hasobject or not math.prod(shape) * dtype.itemsize:
        return np.empty(shape if not dtype.hasobject else (), dtype)
    order: Literal["F", "C"] = "F" if is_fortran else "C"
    return np.memmap(cast("Any", file), dtype, "r", file.tell(), shape, order)
