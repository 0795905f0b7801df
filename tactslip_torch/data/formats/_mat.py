"""Recordings as MAT files: ours, and the variables that people have.

Version 5 is read whole by SciPy, ours are written so; it has no check sums, so a damaged number is
not noticed there. Version 7.3 is HDF5 underneath (``_hdf5``), read by stretches.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Container, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import choose, why_not_numbers
from tactslip_torch.data.formats._hdf5 import read_mat
from tactslip_torch.data.formats._reading import (
    MOST_MEMBERS,
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
_CELL, _STRUCT, _OBJECT, _CHARACTERS, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_OF_NUMBERS = range(6, 16)
_TEXT = (1, 16)
_MOST_NAME = 2**12
_ITEM_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
"""Bytes of a number, by the kind of an element."""
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
        _check_variables(file, "<" if head[126:] == b"IM" else ">", path.stat().st_size)
    import scipy.io

    found: dict[str, Any] = scipy.io.loadmat(path, mat_dtype=True, spmatrix=False)
    return found


class _Content:
    """The bytes of a variable in order, of a packed one as they unpack.

    Args:
        pieces: of them.
        order: of the bytes of a number, ``<`` or ``>``.
    """

    def __init__(self, pieces: Iterator[bytes], order: str) -> None:
        self._pieces, self._order, self._held = pieces, order, b""

    def take(self, num: int) -> bytes:
        """The next bytes, of which as many must be there."""
        while len(self._held) < num:
            self._held += self._next()
        taken, self._held = self._held[:num], self._held[num:]
        return taken

    def skip(self, num: int) -> None:
        """Go on behind so many bytes."""
        while num > len(self._held):
            num -= len(self._held)
            self._held = self._next()
        self._held = self._held[num:]

    def rest(self) -> None:
        """Go to the end, where a packed variable has its check sum."""
        for _ in self._pieces:
            pass

    def _next(self) -> bytes:
        if (piece := next(self._pieces, None)) is None:
            raise ValueError("a variable ends before what it states")
        return piece

    def parse(self, content: bytes, kind: str) -> tuple[int, ...]:
        """Whole numbers of 4 bytes, of a kind as ``struct`` calls it."""
        return struct.unpack(f"{self._order}{len(content) // 4}{kind}", content)

    def tag(self) -> tuple[int, int, int]:
        """Kind and size of the element that begins here, and how far its end is, tag included."""
        (first,) = self.parse(self.take(4), "I")
        if first >> 16:  # a small one, all of it in 8 bytes
            return first & 0xFFFF, first >> 16, 8
        (size,) = self.parse(self.take(4), "I")
        return first, size, 8 + size + -size % 8

    def element(self, kinds: Container[int], sizes: Container[int]) -> tuple[bytes, int]:
        """The bytes of an element of one of these kinds and sizes, and how many bytes it takes."""
        kind, size, length = self.tag()
        is_small = length == 8 and size
        if kind not in kinds or size not in sizes or (is_small and size > 4):
            raise ValueError(f"an element of kind {kind} and {size} bytes where there can be none")
        value = self.take(size)
        self.skip(4 - size if is_small else length - 8 - size)
        return value, length

    def numbers(self, count: int | None) -> int:
        """Go behind an element of so many numbers, if it is said; how many bytes it takes."""
        kind, size, length = self.tag()
        is_small = length == 8 and size
        item = _ITEM_BYTES.get(kind)
        if item is None or (is_small and size > 4):
            raise ValueError(f"numbers of kind {kind} in {size} bytes")
        if count is not None and size != count * item:
            raise ValueError(f"{size // item} numbers in a matrix of {count}")
        self.skip(4 if is_small else length - 8)
        return length


def _check_variables(file: IO[bytes], order: str, num_bytes: int) -> None:
    """Refuse what SciPy would trust: variables that are cut off, or state sizes that cannot be.

    So are those that unpack to more than is plausible.
    """
    unpacked, place = 0, _HEADER_BYTES

    def pieces(size: int, is_packed: bool) -> Iterator[bytes]:
        nonlocal unpacked
        unpacking = zlib.decompressobj()
        while size and not unpacking.eof:
            packed = file.read(min(size, 2**16))
            size -= len(packed)
            while packed:
                piece = unpacking.decompress(packed, 2**22) if is_packed else packed
                packed = unpacking.unconsumed_tail if is_packed else b""
                unpacked += len(piece)
                check_plausible("its variables", unpacked, num_bytes, MOST_WHOLE)
                yield piece
        if is_packed and not unpacking.eof:
            raise ValueError("a packed variable is cut off")

    while place < num_bytes:
        file.seek(place)
        kind, size = struct.unpack(f"{order}II", file.read(8))
        place += 8 + size
        if kind not in (_MATRIX, _COMPRESSED) or place > num_bytes:
            raise ValueError("a variable is cut off, or is none")
        content = _Content(pieces(size, kind == _COMPRESSED), order)
        if kind == _COMPRESSED:
            kind, size, _ = content.tag()
        if kind != _MATRIX:
            raise ValueError("a packed variable that is none")
        _check_matrix(content, size, 0)
        content.rest()


def _check_matrix(content: _Content, size: int, depth: int) -> int:
    """Walk over the elements of a matrix, all of which must fit; how many bytes were left.

    Reference:
        MAT-File Format, The MathWorks, chapter 1, "Level 5 MAT-file format".
    """
    if not size:
        return 0  # as cells hold what is empty
    if depth > _MOST_DEPTH:
        raise ValueError("variables nested too deeply")
    left = size

    def element(kinds: Container[int], sizes: Container[int]) -> bytes:
        nonlocal left
        value, length = content.element(kinds, sizes)
        left -= length
        return value

    def numbers(count: int | None) -> None:
        nonlocal left
        left -= content.numbers(count)

    def matrices(count: int) -> None:
        nonlocal left
        if count * 8 > left:
            raise ValueError(f"{count} cells or fields in {left} bytes")
        for _ in range(count):
            kind, inner, length = content.tag()
            if kind != _MATRIX or length > left:
                raise ValueError("a cell or field that is none")
            if _check_matrix(content, inner, depth + 1):
                raise ValueError("a cell or field that is shorter than it states")
            left -= length

    flags, _ = content.parse(element({6}, {8}), "I")
    kind, is_complex = flags & 0xFF, bool(flags & 0x800)
    count = 1
    if kind != _OPAQUE:
        sizes = content.parse(element({5, 6}, range(8, 129, 4)), "i")
        if min(sizes) < 0:
            raise ValueError(f"a matrix of {sizes}")
        count = math.prod(sizes)
    element(_TEXT, range(_MOST_NAME))
    if kind == _OPAQUE:
        element(_TEXT, range(_MOST_NAME))
        element(_TEXT, range(_MOST_NAME))
        matrices(1)
    elif kind == _FUNCTION:
        matrices(1)
    elif kind == _CELL:
        matrices(count)
    elif kind in (_STRUCT, _OBJECT):
        if kind == _OBJECT:
            element(_TEXT, range(_MOST_NAME))
        (length,) = content.parse(element({5}, {4}), "i")
        if not 0 < length < _MOST_NAME:
            raise ValueError(f"names of {length} characters")
        num_names = len(element(_TEXT, range(0, MOST_MEMBERS * length, length))) // length
        if not num_names and count > MOST_MEMBERS:
            raise ValueError(f"{count} structs of no field")
        matrices(count * num_names)
    elif kind == _CHARACTERS:
        if count > max(left, _MOST_NAME):
            raise ValueError(f"{count} characters in {left} bytes")
        numbers(None)
    elif kind in _OF_NUMBERS:
        for _ in range(1 + is_complex):
            numbers(count)
    elif kind == _SPARSE:
        for _ in range(3 + is_complex):
            numbers(None)
    else:
        raise ValueError(f"a variable of class {kind}")
    if left < 0:
        raise ValueError("elements longer than their variable")
    return left


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
