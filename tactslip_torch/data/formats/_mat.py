"""Recordings as MAT files: ours, and the variables that people have.

Version 5 is read whole by SciPy, ours are written so; it has no check sums, so a damaged number is
not noticed there. Version 7.3 is HDF5 underneath, read by stretches by h5py, with MATLAB's order
of rows and columns.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._arrays import (
    LABEL_NAMES,
    Array,
    ArraySamples,
    choose,
    why_not_numbers,
)
from tactslip_torch.data.formats._hdf5 import (
    attribute,
    datasets,
    opened_hdf5,
    why_elsewhere,
    why_not,
)
from tactslip_torch.data.formats._header import DTYPES, header_in, opened_from, text_of
from tactslip_torch.data.formats._limits import (
    FREE_BYTES,
    MOST_MEMBERS,
    MOST_WHOLE,
    Refused,
    check_plausible,
)
from tactslip_torch.data.formats._reading import Opened, Reading

_TITLE = b"MATLAB 5.0 MAT-file, written by tactslip_torch"
_TITLE_BYTES, _HEADER_BYTES = 116, 128
_MOST_BYTES = 2**31 - 2**10  # of a variable of version 5
_MATRIX, _COMPRESSED = 14, 15
_MOST_DEPTH = 32  # of structs in structs
_NUMBERS = {"double", "single"} | {f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)}


@dataclass
class _Variables:
    """What a file holds: numbers, words by name, and what is left alone with the reason."""

    path: Path
    arrays: list[Array] = field(default_factory=list)
    words: dict[str, tuple[str, ...]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def header(self) -> dict[str, Any] | None:
        """That of ours."""
        return header_in("".join(self.words.get("header", ())))

    def add(self, name: str, values: Any, is_turned: bool) -> None:
        """Keep numbers."""
        leaf = name.rpartition(".")[2]
        self.arrays.append(Array(self.path, name, values, leaf, is_turned))

    def labels(self, array: Array) -> list[tuple[str, ...]]:
        """The words that may name the channels of an array, those of its own struct first."""
        struct_name = array.name.rpartition(".")[0]
        called = [at for at in self.words if at.rpartition(".")[2].lower() in LABEL_NAMES]
        called.sort(key=lambda at: at.rpartition(".")[0] != struct_name)
        return [self.words[at] for at in called]


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
    found = _variables(path, stack)
    own = found.header
    if own is not None:
        (samples,) = (array for array in found.arrays if array.name == "samples")
        return opened_from(own, ArraySamples(samples, 1, dtype=DTYPES[own["dtype"]]))
    arrays = [replace(array, labels=found.labels(array)) for array in found.arrays]
    return choose(arrays, found.refused, how)


def header(path: Path) -> dict[str, Any] | None:
    """All of a file of ours but its samples; ``None`` if it is another's."""
    with ExitStack() as stack:
        return _variables(path, stack, ["header"]).header


def _variables(path: Path, stack: ExitStack, names: list[str] | None = None) -> _Variables:
    """What is in a file; of version 5 only these variables, if any are named."""
    found = _Variables(path)
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if head.startswith((b"MATLAB 7.3", b"\x89HDF")):
            _look_73(opened_hdf5(path, stack), found)
            return found
        if len(head) < _HEADER_BYTES or head[124:128] not in (b"\x00\x01IM", b"\x01\x00MI"):
            raise Refused("must be a MAT file of version 5 or 7.3, and is damaged or none of them")
        _check_size(file, "<" if head[126:] == b"IM" else ">", path.stat().st_size)
    import scipy.io

    content = scipy.io.loadmat(path, mat_dtype=True, variable_names=names, spmatrix=False)
    for name, value in content.items():
        if not name.startswith("__"):
            _look(name, value, found, 0)
    return found


def _check_size(file: IO[bytes], order: str, num_bytes: int) -> None:
    """Refuse variables that are cut off or unpack to more than is plausible, before any is read."""
    unpacked, place = 0, _HEADER_BYTES
    while place < num_bytes:
        file.seek(place)
        tag = file.read(8)
        kind, size = struct.unpack(f"{order}II", tag)
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


def _look(name: str, value: Any, found: _Variables, depth: int) -> None:
    """Sort a variable of version 5, or the fields of a struct, into what is read and what not."""
    if type(value) is not np.ndarray:
        found.refused[name] = "is sparse" if hasattr(value, "tocsc") else "is an object"
    elif value.dtype.names is not None:
        if value.size != 1 or depth > _MOST_DEPTH:
            found.refused[name] = "is a struct array" if value.size != 1 else "is nested too deeply"
            return
        for inner in value.dtype.names:
            _look(f"{name}.{inner}", value.reshape(-1)[0][inner], found, depth + 1)
    elif value.dtype.kind == "U":
        found.words[name] = tuple(str(word).rstrip(" \0") for word in value.reshape(-1))
    elif value.dtype.kind == "O":
        cells = value.reshape(-1)
        if len(cells) and all(isinstance(c, np.ndarray) and c.dtype.kind == "U" for c in cells):
            found.words[name] = tuple(str(c.reshape(-1)[0]) if c.size else "" for c in cells)
        else:
            found.refused[name] = "is a cell array"
    elif (why := why_not_numbers(value.dtype, value.shape)) is not None:
        found.refused[name] = why
    else:
        found.add(name, value, is_turned=False)


# Version 7.3 -------------------------------------------------------------------------------------


def _look_73(file: Any, found: _Variables) -> None:
    """Sort what is in an HDF5 file by the classes that MATLAB wrote."""
    for path_in_file, thing in datasets(file, found.refused):
        name = path_in_file.strip("/").replace("/", ".")
        if name.startswith("#"):
            continue
        kind = "".join(attribute(thing, "MATLAB_class"))
        why = why_elsewhere(thing) or ("is empty" if "MATLAB_empty" in thing.attrs else None)
        if why is None and kind == "char":
            found.words[name] = _characters(thing)
            continue
        if why is None and kind == "cell":
            words = _cells(file, thing)
            if words:
                found.words[name] = words
                continue
            why = "is a cell array"
        if why is None and kind == "logical":
            why = "holds true or false"
        is_other = "MATLAB_object_decode" in thing.attrs or kind not in (*_NUMBERS, "")
        if why is None and is_other:
            why = f"is of class {kind[:40]}"
        if why is None and "MATLAB_sparse" in thing.parent.attrs:
            why = "is of a sparse matrix"
        why = why or why_not(thing)
        if why is None:
            found.add(name, thing, is_turned=True)
        else:
            found.refused[name] = why


def _characters(thing: Any) -> tuple[str, ...]:
    """The rows of a character array, without the blanks that fill them up."""
    is_text = thing.ndim == 2 and thing.dtype == np.uint16 and why_not(thing) is None
    if not is_text or not 0 < thing.size <= FREE_BYTES // 4:
        return ()
    rows = np.ascontiguousarray(thing[()].T).astype("<u2")
    return tuple(row.tobytes().decode("utf-16-le", "replace").rstrip(" \0") for row in rows)


def _cells(file: Any, thing: Any) -> tuple[str, ...] | None:
    """The words of cells that hold one each."""
    if thing.dtype.kind != "O" or thing.ndim != 2 or thing.size > MOST_MEMBERS:
        return None
    words: list[str] = []
    for reference in thing[()].reshape(-1):
        cell = file[reference]
        if attribute(cell, "MATLAB_class") != ("char",) or why_elsewhere(cell) is not None:
            return None
        words += ("",) if "MATLAB_empty" in cell.attrs else _characters(cell)[:1]
    return tuple(words)
