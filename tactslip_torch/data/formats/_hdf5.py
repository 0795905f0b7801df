"""Recordings as HDF5 files, by h5py: ours, and the datasets that people have.

Ours hold ``/samples`` ``[C, T]`` in chunks of time with check sums, so that damage to them is
noticed. Only hard links are followed, each object once, so links in a circle end; links to other
files, virtual datasets and those stored in other files stay closed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._arrays import (
    LABEL_NAMES,
    Array,
    ArraySamples,
    Contents,
    choose,
    why_not_numbers,
)
from tactslip_torch.data.formats._faults import (
    FREE_BYTES,
    MOST_MEMBERS,
    Refused,
    check_plausible,
    needs,
)
from tactslip_torch.data.formats._header import DTYPES, facts_in, ours, text_of
from tactslip_torch.data.formats._reading import Opened, Reading

_CHUNK_BYTES = 256 * 2**10


def write(path: Path, samples: NDArray[Any], facts: Mapping[str, Any]) -> None:
    """Write ``/samples`` with ``sample_rate_hz``, ``units`` and ``channel_name`` as attributes.

    Everything else is JSON in the file's attribute ``header``.
    """
    h5py = needs("h5py", f"writing {path.suffix}")
    num_channels, num_samples = samples.shape
    instants = max(_CHUNK_BYTES // (num_channels * samples.itemsize), 1)
    how: dict[str, Any] = {}
    if num_samples:
        how = {"chunks": (num_channels, min(instants, num_samples)), "fletcher32": True}
    # HDF5 of 2008 and later: before, more than some 4000 names would not fit
    with h5py.File(path, "w", libver="v108") as file:
        file.attrs["header"] = _fixed(text_of(facts))[0]
        stored = file.create_dataset("samples", data=samples, **how)
        stored.attrs["sample_rate_hz"] = facts["sample_rate_hz"]
        stored.attrs["units"] = _fixed(facts["units"])[0]
        stored.attrs["channel_name"] = _fixed(*(row["name"] for row in facts["channels"]))


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file, read by slices.

    Of others: the only dataset ``[C, T]`` or ``[T, C]``, or all of one dimension as channels by
    name, wherever they stand; times by name; the rate by an attribute or a single number, names of
    channels by words, that are called so.
    """
    file = opened(path, stack)
    facts = _facts(file)
    arrays: list[Array] = []
    refused: dict[str, str] = {}
    words: list[Any] = []
    for name, thing in objects(file, refused):
        if not hasattr(thing, "shape"):
            continue
        leaf = name.rpartition("/")[2]
        why = why_not(thing)
        if why is None:
            arrays.append(Array(path, name, thing, leaf=leaf))
        else:
            refused[name] = why
            if leaf.lower() in LABEL_NAMES and why_elsewhere(thing) is None:
                words.append(thing)
    if facts is not None:
        (samples,) = (array for array in arrays if array.name == "/samples")
        return ours(facts, ArraySamples(samples, 1, dtype=DTYPES[facts["dtype"]]))

    def around(name: str) -> Iterator[Any]:
        parts = name.strip("/").split("/")
        return (file["/" + "/".join(parts[:depth])] for depth in range(len(parts), -1, -1))

    def labels(name: str) -> Iterator[tuple[str, ...]]:
        for thing in around(name):
            yield from (attribute(thing, at) for at in thing.attrs if at.lower() in LABEL_NAMES)
        yield from (words_in(thing) for thing in words)

    def numbers(name: str) -> Iterator[dict[str, float]]:
        yield from map(_numbers, around(name))

    return choose(Contents(arrays, refused, labels, numbers), how)


def facts(path: Path) -> dict[str, Any] | None:
    """All of a file of ours but its samples; ``None`` if it is another's."""
    with ExitStack() as stack:
        return _facts(opened(path, stack))


def opened(path: Path, stack: ExitStack) -> Any:
    """An open HDF5 file.

    Raises:
        Refused: if h5py is absent.
    """
    return stack.enter_context(needs("h5py", f"reading {path.suffix}").File(path, "r"))


def objects(file: Any, refused: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Every group and dataset that hard links lead to, by name, breadth first.

    Args:
        file: open.
        refused: gets the names of what is no such, with the reason.

    Raises:
        Refused: if there are more than ``MOST_MEMBERS``.
    """
    h5py = needs("h5py", "reading HDF5")
    todo, seen = [("", file)], {h5py.h5o.get_info(file.id).addr}
    while todo:
        prefix, group = todo.pop(0)
        for leaf in group:
            name = f"{prefix}/{leaf}"
            if not isinstance(group.get(leaf, getlink=True), h5py.HardLink):
                refused[name] = "is a link, perhaps to another file, and not followed"
                continue
            try:
                found = group[leaf]
                address = h5py.h5o.get_info(found.id).addr
            except (KeyError, OSError, RuntimeError, TypeError, ValueError):
                refused[name] = "is damaged"
                continue
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > MOST_MEMBERS:
                raise Refused(f"holds more than {MOST_MEMBERS} objects")
            if isinstance(found, h5py.Group):
                todo.append((name, found))
            yield name, found


def why_elsewhere(dataset: Any) -> str | None:
    """The reason why reading a dataset would open other files, if there is one."""
    if dataset.is_virtual:
        return "is virtual: its numbers are in other files"
    return "is stored in other files" if dataset.external else None


def why_not(dataset: Any) -> str | None:
    """The reason why a dataset is not read as numbers of up to two dimensions, if there is one."""
    try:
        why = why_elsewhere(dataset) or why_not_numbers(dataset.dtype, dataset.shape)
    except TypeError:
        return "holds what NumPy does not know"
    if why is not None:
        return why
    stored = min(dataset.id.get_storage_size(), dataset.file.id.get_filesize())
    claimed = max(math.prod(dataset.shape), math.prod(dataset.chunks or (0,)))
    try:
        check_plausible("", claimed * dataset.dtype.itemsize, stored)
    except Refused as error:
        return str(error).strip()
    return None


def words_in(dataset: Any) -> tuple[str, ...]:
    """The words of a dataset of no or one dimension; none if it holds others."""
    return _words(dataset, lambda: dataset[()])


def attribute(thing: Any, name: str) -> tuple[str, ...]:
    """The words of an attribute; none if it is not there, or holds others."""
    if name not in thing.attrs:
        return ()
    return _words(thing.attrs.get_id(name), lambda: thing.attrs[name])


def _words(kept: Any, read: Callable[[], Any]) -> tuple[str, ...]:
    count = math.prod(kept.shape) if kept.shape is not None and len(kept.shape) < 2 else 0
    is_large = count * kept.dtype.itemsize > FREE_BYTES or count > MOST_MEMBERS
    if kept.dtype.kind not in "OS" or is_large or not count:
        return ()
    words = [w.decode() if isinstance(w, bytes) else w for w in np.atleast_1d(read())]
    return tuple(words) if all(isinstance(word, str) for word in words) else ()


def _numbers(thing: Any) -> dict[str, float]:
    """Attributes that are one number."""
    ids = {name: thing.attrs.get_id(name) for name in thing.attrs}
    return {
        name: float(np.asarray(thing.attrs[name]).reshape(-1)[0])
        for name, kept in ids.items()
        if kept.shape in ((), (1,)) and kept.dtype.kind in "iuf"
    }


def _facts(file: Any) -> dict[str, Any] | None:
    words = attribute(file, "header")
    return facts_in(words[0]) if len(words) == 1 else None


def _fixed(*words: str) -> NDArray[np.bytes_]:
    """UTF-8 of one length, filled up with NULs, so that no heap is needed."""
    encoded = [word.encode() for word in words]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")
