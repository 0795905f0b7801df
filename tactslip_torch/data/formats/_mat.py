"""Recordings as MAT files: ours, and the variables that people have.

Version 5 is read whole by SciPy, ours are written so; it has no check sums, so a damaged number is
not noticed there. Version 7.3 is HDF5 underneath (``_hdf5``), read by stretches.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import choose, why_not_numbers
from tactslip_torch.data.formats._hdf5 import read_mat
from tactslip_torch.data.formats._reading import (
    FREE_BYTES,
    MOST_WHOLE,
    Opened,
    Reading,
    Refused,
    check_plausible,
    header_in,
    opened_from,
    text_of,
)

_TITLE = b"MATLAB 5.0 MAT-file, written by tactslip_torch"
_TITLE_BYTES, _HEADER_BYTES = 116, 128
_MOST_BYTES = 2**31 - 2**10  # of a variable of version 5
_MATRIX, _COMPRESSED = 14, 15
_MOST_DEPTH = 32  # of structs in structs


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write ``samples`` ``[C, T]``, ``sample_rate_hz``, ``units`` and the cells ``channel_name``.

    Everything else is JSON text in ``header``.
    """
    import scipy.io

    if samples.nbytes > _MOST_BYTES:
        raise Refused(
            f"cannot hold {samples.nbytes} bytes of samples, a MAT file of version 5 has at most "
            f"{_MOST_BYTES}; save as .h5"
        )
    names = np.empty((len(samples), 1), dtype=object)
    names[:, 0] = [row["name"] for row in header["channels"]]
    content = {
        "header": text_of(header),
        "samples": samples,
        "sample_rate_hz": header["sample_rate_hz"],
        "units": header["units"],
        "channel_name": names,
    }
    with path.open("w+b") as file:
        scipy.io.savemat(file, content, format="5", do_compression=False)
        file.seek(0)
        file.write(_TITLE.ljust(_TITLE_BYTES))  # instead of the time of day


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file.

    Of others: the only matrix, or all vectors of one length as channels by name, also in structs
    (``trial.volts``); times by name; the rate by a number, names of channels by characters or
    cells, that are called so.

    Raises:
        Refused: if h5py is absent where it is needed, or a file of version 5 holds more than is
            read whole or unpacks to more than is plausible.
    """
    with path.open("rb") as file:
        if file.read(_HEADER_BYTES).startswith((b"MATLAB 7.3", b"\x89HDF")):
            return read_mat(path, how, stack)
    found: dict[str, Any] = {}
    for name, value in _loaded(path).items():
        if not name.startswith("__"):
            _look(name, value, found, 0)
    own = header_in(found.get("header"))
    if own is not None:
        return opened_from(own, path, found["samples"], 1)
    return choose(path, found, how, ".")


def _loaded(path: Path) -> dict[str, Any]:
    """The variables of a file of version 5."""
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or head[124:128] not in (b"\x00\x01IM", b"\x01\x00MI"):
            raise Refused("must be a MAT file of version 5 or 7.3, and is damaged or none of them")
        _check_size(file, "<" if head[126:] == b"IM" else ">", path.stat().st_size)
    import scipy.io

    found: dict[str, Any] = scipy.io.loadmat(path, mat_dtype=True, spmatrix=False)
    return found


def _check_size(file: IO[bytes], order: str, num_bytes: int) -> None:
    """Refuse variables that are cut off or unpack to more than is plausible, before any is read."""
    unpacked, place = 0, _HEADER_BYTES
    while place < num_bytes:
        file.seek(place)
        kind, size = struct.unpack(f"{order}II", file.read(8))
        place += 8 + size
        if kind not in (_MATRIX, _COMPRESSED) or place > num_bytes:
            raise ValueError("a variable is cut off, or is none")
        if kind == _MATRIX:
            unpacked += size
            continue
        unpacking = zlib.decompressobj()
        while size and not unpacking.eof:
            packed = file.read(min(size, 2**16))
            size -= len(packed)
            while packed and unpacked <= MOST_WHOLE:
                unpacked += len(unpacking.decompress(packed, 2**22))
                packed = unpacking.unconsumed_tail
                if unpacked > FREE_BYTES:
                    check_plausible("its variables", unpacked, num_bytes, MOST_WHOLE)
    check_plausible("its variables", unpacked, num_bytes, MOST_WHOLE)


def _look(name: str, value: Any, found: dict[str, Any], depth: int) -> None:
    """Sort a variable, or the fields of a struct, into ``found``.

    An array is numbers, a tuple words, and a text the reason why it is neither.
    """
    if type(value) is not np.ndarray:
        found[name] = "is sparse" if hasattr(value, "tocsc") else "is an object"
    elif value.dtype.names is not None:
        if value.size != 1 or depth > _MOST_DEPTH:
            found[name] = "is a struct array" if value.size != 1 else "is nested too deeply"
            return
        for inner in value.dtype.names:
            _look(f"{name}.{inner}", value.reshape(-1)[0][inner], found, depth + 1)
    elif value.dtype.kind == "U":
        found[name] = tuple(str(word).rstrip(" \0") for word in value.reshape(-1))
    elif value.dtype.kind == "O":
        cells = value.reshape(-1)
        are_words = all(isinstance(c, np.ndarray) and c.dtype.kind == "U" for c in cells)
        found[name] = "is a cell array"
        if len(cells) and are_words:
            found[name] = tuple(str(c.reshape(-1)[0]) if c.size else "" for c in cells)
    else:
        found[name] = why_not_numbers(value.dtype, value.shape) or value
