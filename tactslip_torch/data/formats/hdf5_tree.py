"""What stands in an HDF5 file and may be read: nothing outside it, nothing larger than plausible.

Only hard links are followed, each object once, so links in a circle end; links to other files,
virtual datasets and those stored in other files stay closed.
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.arrays import FREE_BYTES, why_not_numbers, why_not_plausible
from tactslip_torch.data.formats.hdf5_heap import has_sound_heaps
from tactslip_torch.data.formats.header import damaged
from tactslip_torch.data.formats.reading import TimeUnit
from tactslip_torch.data.formats.refusing import Refused

MOST_OBJECTS = 10_000
MOST_WORDS = 10_000
_DEFLATE, _SHUFFLE, _FLETCHER = 1, 2, 3  # filters of HDF5
_SUM_BYTES = 4
_MOST_INFLATION = 1032  # of zlib, in bytes per byte
_SUSPECT_BYTES = 64 * 2**20 // _MOST_INFLATION


def objects(file: Any, h5py: Any, refused: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Every group and dataset that hard links lead to, by name, breadth first.

    Args:
        file: open, ``h5py.File``.
        h5py: the library.
        refused: gets the names of what is no such, with the reason.

    Raises:
        Refused: if there are more than ``MOST_OBJECTS``.
    """
    todo, seen = [("", file)], {_address(file, h5py)}
    while todo:
        prefix, group = todo.pop(0)
        for leaf in group:
            name = f"{prefix}/{leaf}"
            link = group.get(leaf, getlink=True)
            if not isinstance(link, h5py.HardLink):
                refused[name] = "is a link, which is not followed"
                continue
            try:
                found = group[leaf]
                address = _address(found, h5py)
            except (KeyError, OSError, RuntimeError, TypeError, ValueError):
                refused[name] = "is damaged"
                continue
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > MOST_OBJECTS:
                raise Refused(f"{file.filename} holds more than {MOST_OBJECTS} objects")
            if isinstance(found, h5py.Group):
                todo.append((name, found))
            yield name, found


def why_elsewhere(dataset: Any, h5py: Any) -> str | None:
    """The reason why reading a dataset would open other files, if there is one."""
    plan = dataset.id.get_create_plist()
    if plan.get_layout() == h5py.h5d.VIRTUAL:
        return "is virtual: its numbers are in other files"
    return "is stored in other files" if plan.get_external_count() else None


def why_not(dataset: Any, h5py: Any) -> str | None:
    """The reason why a dataset is not read as numbers of up to two dimensions, if there is one."""
    elsewhere = why_elsewhere(dataset, h5py)
    if elsewhere is not None:
        return elsewhere
    try:
        dtype, shape = dataset.dtype, dataset.shape
    except TypeError:
        return "holds what NumPy does not know"
    if shape is None or len(shape) > 2:
        return "is empty" if shape is None else f"has {len(shape)} dimensions"
    plan = dataset.id.get_create_plist()
    filters = [plan.get_filter(number)[0] for number in range(plan.get_nfilters())]
    if filters.count(_DEFLATE) > 1:
        return "is compressed twice"
    stored = min(dataset.id.get_storage_size(), dataset.file.id.get_filesize())
    claimed = math.prod(shape) * dtype.itemsize
    chunk = math.prod(dataset.chunks or (0,)) * dtype.itemsize
    return why_not_numbers(dtype) or why_not_plausible(max(claimed, chunk), stored)


@dataclass(frozen=True)
class DatasetArray:
    """A dataset of numbers that ``why_not`` has nothing against.

    MATLAB's columns stand together, and its files show them as rows: ``is_turned`` puts that right.
    """

    name: str
    leaf: str
    dataset: Any
    is_turned: bool = False
    time_unit: TimeUnit | None = None
    _sound: set[tuple[int, ...]] = field(default_factory=set, compare=False)

    @property
    def shape(self) -> tuple[int, ...]:
        """As its writer sees it."""
        shape: tuple[int, ...] = self.dataset.shape
        return shape[::-1] if self.is_turned else shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """In the file."""
        found: np.dtype[Any] = self.dataset.dtype
        return found

    def read(self, axis: int, first: int, stop: int) -> NDArray[Any]:
        """What stands from ``first`` to before ``stop`` along that axis.

        Raises:
            ValueError: if it cannot be read.
        """
        stored_axis = len(self.shape) - 1 - axis if self.is_turned else axis
        where = (slice(None),) * stored_axis + (slice(first, stop),) if self.shape else ()
        try:
            self._check_chunks(stored_axis, first, stop)
            values: NDArray[Any] = np.asarray(self.dataset[where])
        except Exception as error:  # a filter that is absent, a sum that is wrong, a cut file
            raise damaged(self.dataset.file.filename) from error
        return values.T if self.is_turned else values

    def _check_chunks(self, axis: int, first: int, stop: int) -> None:
        """Refuse chunks that are not what they should be: HDF5 reads beyond, or unpacks it all."""
        chunks, shape = self.dataset.chunks, self.dataset.shape
        if chunks is None or not self.dataset.size or first >= stop:
            return
        ranges = [range(0, length, step) for length, step in zip(shape, chunks, strict=True)]
        step = chunks[axis]
        ranges[axis] = range(first // step * step, stop, step)
        for corner in itertools.product(*ranges):
            if corner not in self._sound:
                check_chunk(self.dataset.id, corner, math.prod(chunks) * self.dtype.itemsize)
                self._sound.add(corner)


def check_chunk(dataset: Any, corner: tuple[int, ...], num_bytes: int) -> None:
    """Hold what is stored of a chunk against the bytes that it must unpack to.

    Raises:
        ValueError: if it is too short or unpacks to more.
    """
    plan, stored = dataset.get_create_plist(), dataset.get_chunk_info_by_coord(corner)
    if stored.byte_offset is None:  # never written
        return
    filters = [plan.get_filter(number)[0] for number in range(plan.get_nfilters())]
    sums = _SUM_BYTES * filters.count(_FLETCHER)
    is_packed = not set(filters) <= {_SHUFFLE, _FLETCHER}
    if stored.size <= sums or not (is_packed or num_bytes <= stored.size <= num_bytes + sums):
        raise ValueError(f"the chunk at {corner} is stored in {stored.size} bytes")
    if _DEFLATE in filters and stored.size > _SUSPECT_BYTES:
        packed = dataset.read_direct_chunk(corner)[1]
        if len(zlib.decompressobj().decompress(packed, num_bytes + 1)) > num_bytes:
            raise ValueError(f"the chunk at {corner} holds more than {num_bytes} bytes")


def around(file: Any, name: str) -> list[Any]:
    """A dataset, the groups that it stands in, and the file: what may say something about it."""
    parts = name.strip("/").split("/")
    return [file["/" + "/".join(parts[:depth])] for depth in range(len(parts), -1, -1)]


def numbers_said(thing: Any) -> dict[str, float]:
    """Attributes that are one number."""
    found = {}
    for name in thing.attrs:
        kind = thing.attrs.get_id(name)
        if kind.shape in ((), (1,)) and kind.dtype.kind in "iuf":
            found[name] = float(np.asarray(thing.attrs[name]).reshape(-1)[0])
    return found


def words_said(thing: Any, name: str) -> tuple[str, ...]:
    """The words of an attribute, none if it holds none."""
    return _words(thing.attrs.get_id(name), thing.file.filename, lambda: thing.attrs[name])


def words_in(dataset: Any) -> tuple[str, ...]:
    """The words of a dataset, none if it holds none or holds them in chunks."""
    if dataset.chunks is not None:  # nobody's few words are, and nothing looks through them
        return ()
    return _words(dataset, dataset.file.filename, lambda: dataset[()])


def _words(kept: Any, path: str, read: Callable[[], Any]) -> tuple[str, ...]:
    count = math.prod(kept.shape) if kept.shape is not None and len(kept.shape) < 2 else 0
    dtype = kept.dtype
    if dtype.kind not in "OS" or not count or count > MOST_WORDS:
        return ()
    if count * dtype.itemsize > FREE_BYTES or (dtype.kind == "O" and not has_sound_heaps(path)):
        return ()
    values = np.atleast_1d(read())
    words = [word.decode("utf-8") if isinstance(word, bytes) else word for word in values]
    return tuple(words) if all(isinstance(word, str) for word in words) else ()


def _address(thing: Any, h5py: Any) -> int:
    address: int = h5py.h5o.get_info(thing.id).addr
    return address
