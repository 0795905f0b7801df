"""Recordings as HDF5 files, by h5py: ours, and the datasets that people have.

Ours hold ``/samples`` ``[C, T]`` in chunks of time with check sums, so that damage to them is
noticed. Only hard links are followed, each object once, so links in a circle end; links to other
files, virtual datasets and those stored in other files stay closed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._arrays import (
    LABEL_NAMES,
    Array,
    ArraySamples,
    choose,
    rate_in,
    why_not_numbers,
)
from tactslip_torch.data.formats._header import DTYPES, header_in, opened_from, text_of
from tactslip_torch.data.formats._limits import (
    FREE_BYTES,
    MOST_MEMBERS,
    Refused,
    check_plausible,
    needs,
)
from tactslip_torch.data.formats._reading import Opened, Reading

_CHUNK_BYTES = 256 * 2**10


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
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
        file.attrs["header"] = _fixed(text_of(header))[0]
        stored = file.create_dataset("samples", data=samples, **how)
        stored.attrs["sample_rate_hz"] = header["sample_rate_hz"]
        stored.attrs["units"] = _fixed(header["units"])[0]
        stored.attrs["channel_name"] = _fixed(*(row["name"] for row in header["channels"]))


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file, read by slices.

    Of others: the only dataset ``[C, T]`` or ``[T, C]``, or all of one dimension as channels by
    name, wherever they stand; times by name; the rate by an attribute or a single number, names of
    channels by words, that are called so.
    """
    file = opened_hdf5(path, stack)
    own = _header(file)
    if own is not None:
        samples = file["samples"]
        if why := why_not(samples):
            raise ValueError(f"/samples {why}")
        array = Array(path, "/samples", samples)
        return opened_from(own, ArraySamples(array, 1, dtype=DTYPES[own["dtype"]]))
    refused: dict[str, str] = {}
    numbers: dict[str, Any] = {}
    words: list[tuple[str, ...]] = []
    for name, dataset in datasets(file, refused):
        why = why_not(dataset)
        if why is None:
            numbers[name] = dataset
            continue
        refused[name] = why
        if name.rpartition("/")[2].lower() in LABEL_NAMES and why_elsewhere(dataset) is None:
            words.append(words_of(dataset))
    arrays = []
    for name, dataset in numbers.items():
        around = [dataset]
        while around[-1].name != "/":
            around.append(around[-1].parent)
        named = [
            attribute(one, at) for one in around for at in one.attrs if at.lower() in LABEL_NAMES
        ]
        rate = next(filter(None, map(_rate_of, around)), None)
        leaf = name.rpartition("/")[2]
        arrays.append(
            Array(path, name, dataset, leaf, labels=[*named, *words], sample_rate_hz=rate)
        )
    return choose(arrays, refused, how)


def header(path: Path) -> dict[str, Any] | None:
    """All of a file of ours but its samples; ``None`` if it is another's."""
    with ExitStack() as stack:
        return _header(opened_hdf5(path, stack))


def _header(file: Any) -> dict[str, Any] | None:
    words = attribute(file, "header")
    return header_in(words[0]) if len(words) == 1 else None


def opened_hdf5(path: Path, stack: ExitStack) -> Any:
    """An open HDF5 file.

    Raises:
        Refused: if h5py is absent.
    """
    return stack.enter_context(needs("h5py", f"reading {path.suffix}").File(path, "r"))


def datasets(file: Any, refused: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Every dataset that hard links lead to, by name, breadth first.

    Args:
        file: open.
        refused: gets the names of what is no such, with the reason.

    Raises:
        Refused: if there are more than ``MOST_MEMBERS`` groups and datasets.
    """
    h5py = needs("h5py", "reading HDF5")
    groups, seen = [("", file)], {h5py.h5o.get_info(file.id).addr}
    while groups:
        prefix, group = groups.pop(0)
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
                groups.append((name, found))
            elif isinstance(found, h5py.Dataset):
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
        if why is None:
            stored = min(dataset.id.get_storage_size(), dataset.file.id.get_filesize())
            claimed = max(math.prod(dataset.shape), math.prod(dataset.chunks or (0,)))
            check_plausible("", claimed * dataset.dtype.itemsize, stored)
    except TypeError:
        return "holds what NumPy does not know"
    except Refused as error:
        return str(error).strip()
    return why


def attribute(thing: Any, name: str) -> tuple[str, ...]:
    """The words of an attribute; none if it is not there, or holds others."""
    if name not in thing.attrs or not _are_words(thing.attrs.get_id(name)):
        return ()
    return _decoded(thing.attrs[name])


def words_of(dataset: Any) -> tuple[str, ...]:
    """The words of a dataset of no or one dimension; none if it holds others."""
    return _decoded(dataset[()]) if _are_words(dataset) else ()


def _are_words(kept: Any) -> bool:
    """Whether there are words of no or one dimension, and no more than may be read."""
    count = math.prod(kept.shape) if kept.shape is not None and len(kept.shape) < 2 else 0
    return kept.dtype.kind in "OS" and (
        0 < count <= MOST_MEMBERS and count * kept.dtype.itemsize <= FREE_BYTES
    )


def _decoded(values: Any) -> tuple[str, ...]:
    words = [w.decode() if isinstance(w, bytes) else w for w in np.atleast_1d(values)]
    return tuple(words) if all(isinstance(word, str) for word in words) else ()


def _rate_of(thing: Any) -> float | None:
    """The sample rate among the attributes that are one number."""
    single = [
        name
        for name in thing.attrs
        if (kept := thing.attrs.get_id(name)).shape in ((), (1,)) and kept.dtype.kind in "iuf"
    ]
    return rate_in({name: float(np.ravel(thing.attrs[name])[0]) for name in single})


def _fixed(*words: str) -> NDArray[np.bytes_]:
    """UTF-8 of one length, filled up with NULs, so that no heap is needed."""
    encoded = [word.encode() for word in words]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")
