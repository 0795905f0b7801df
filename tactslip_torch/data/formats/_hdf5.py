"""Recordings as HDF5 files, by h5py: ours, and the datasets that people have.

Ours hold ``/samples`` ``[C, T]`` in chunks of time with check sums, so that damage to them is
noticed. Only hard links are followed, each object once, so links in a circle end; links to other
files, virtual datasets and those stored in other files stay closed. MAT files of version 7.3 are
HDF5 underneath, with rows and columns exchanged and the class of each variable as an attribute.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import choose, rate_in, why_not_numbers
from tactslip_torch.data.formats._names import CHANNEL_LISTS
from tactslip_torch.data.formats._reading import (
    FREE_BYTES,
    MOST_MEMBERS,
    Opened,
    Reading,
    Refused,
    check_plausible,
    header_in,
    needs,
    opened_from,
    text_of,
)

_CHUNK_BYTES = 256 * 2**10
_CLASSES = {"", "double", "single"} | {f"{u}int{b}" for u in ("", "u") for b in (8, 16, 32, 64)}
"""Of MATLAB, that are numbers."""


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


def _fixed(*words: str) -> NDArray[np.bytes_]:
    """UTF-8 of one length, filled up with NULs, so that no heap is needed."""
    encoded = [word.encode() for word in words]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file, read by slices.

    Of others: the only dataset ``[C, T]`` or ``[T, C]``, or all of one dimension as channels by
    name, wherever they stand; times by name; the rate by an attribute or a single number, names of
    channels by words, that are called so.
    """
    file = stack.enter_context(needs("h5py", f"reading {path.suffix}").File(path, "r"))
    own = header_in(_attribute(file, "header"))
    if own is not None:
        if why := _why_not(file["samples"]):
            raise ValueError(f"/samples {why}")
        _check_chunks(file["samples"])
        return opened_from(own, path, file["samples"], 1)
    found: dict[str, Any] = {}
    for name, dataset in _datasets(file, found):
        is_label = name.rpartition("/")[2].lower() in CHANNEL_LISTS
        found[name] = _why_not(dataset) or dataset
        if is_label and _why_elsewhere(dataset) is None and _are_words(dataset):
            found[name] = _decoded(dataset[()])
    return choose(path, found, how, said=_said)


def _said(dataset: Any) -> tuple[list[tuple[str, ...]], float | None]:
    """Words that may name the channels of a dataset and its rate, the nearest attributes first."""
    around = [dataset]
    while around[-1].name != "/":
        around.append(around[-1].parent)
    named = [(one, at) for one in around for at in one.attrs if at.lower() in CHANNEL_LISTS]
    rate = next(filter(None, map(_rate_of, around)), None)
    return [_attribute(one, at) for one, at in named], rate


def _datasets(file: Any, found: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Every dataset that hard links lead to, by name, breadth first.

    Args:
        file: open.
        found: gets the names of what is no such, with the reason.

    Raises:
        Refused: if there are more than ``MOST_MEMBERS`` groups and datasets.
    """
    h5py = needs("h5py", "reading HDF5")
    groups, seen = [("", file)], {file["/"]}
    while groups:
        prefix, group = groups.pop(0)
        for leaf in group:
            name = f"{prefix}/{leaf}"
            if not isinstance(group.get(leaf, getlink=True), h5py.HardLink):
                found[name] = "is a link, perhaps to another file, and not followed"
                continue
            try:
                thing = group[leaf]
                is_known = thing in seen
            except (KeyError, OSError, RuntimeError, TypeError, ValueError):
                found[name] = "is damaged"
                continue
            seen.add(thing)
            if len(seen) > MOST_MEMBERS:
                raise Refused(f"holds more than {MOST_MEMBERS} objects")
            if isinstance(thing, h5py.Group) and not is_known:
                groups.append((name, thing))
            elif isinstance(thing, h5py.Dataset) and not is_known:
                yield name, thing


def _why_elsewhere(dataset: Any) -> str | None:
    """The reason why reading a dataset would open other files, if there is one."""
    if dataset.is_virtual:
        return "is virtual: its numbers are in other files"
    return "is stored in other files" if dataset.external else None


def _why_not(dataset: Any) -> str | None:
    """The reason why a dataset is not read as numbers of up to two dimensions, if there is one."""
    try:
        why = _why_elsewhere(dataset) or why_not_numbers(dataset.dtype, dataset.shape)
        if why is None:
            stored = min(dataset.id.get_storage_size(), dataset.file.id.get_filesize())
            claimed = max(math.prod(dataset.shape), math.prod(dataset.chunks or (0,)))
            check_plausible("", claimed * dataset.dtype.itemsize, stored)
    except TypeError:
        return "holds what NumPy does not know"
    except Refused as error:
        return str(error).strip()
    return why


def _check_chunks(dataset: Any) -> None:
    """Look at all samples of ours once, packed: for a chunk that HDF5 does not find it gives zeros.

    Raises:
        ValueError: if one is not in the file, or is read without its check sum.
    """
    size = dataset.file.id.get_filesize()
    for first in range(0, dataset.shape[1], dataset.chunks[1]) if dataset.chunks else ():
        chunk = dataset.id.get_chunk_info_by_coord((0, first))
        is_there = chunk.byte_offset is not None and chunk.byte_offset + chunk.size <= size
        if not is_there or dataset.id.read_direct_chunk((0, first))[0]:
            raise ValueError(f"no samples from number {first} on")


def _attribute(thing: Any, name: str) -> tuple[str, ...]:
    """The words of an attribute; none if it is not there, or holds others."""
    if name not in thing.attrs or not _are_words(thing.attrs.get_id(name)):
        return ()
    return _decoded(thing.attrs[name])


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


# MAT files of version 7.3 -----------------------------------------------------------------------


def read_mat(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a MAT file of version 7.3, variables of structs as ``trial.volts``."""
    file = stack.enter_context(needs("h5py", "reading .mat of version 7.3").File(path, "r"))
    found = _variables(file)
    own = header_in(found.get("header"))
    if own is not None:
        return opened_from(own, path, found["samples"])
    if how.time_first is not None:
        how = replace(how, time_first=not how.time_first)  # as MATLAB shows it
    return choose(path, found, how, ".", _said)


def _variables(file: Any) -> dict[str, Any]:
    """Numbers, words, or why they are neither, by name and by the classes MATLAB wrote."""
    linked: dict[str, Any] = {}
    found: dict[str, Any] = {}
    for path_in_file, thing in _datasets(file, linked):
        name = path_in_file.strip("/").replace("/", ".")
        if name.startswith("#"):
            continue
        kind = "".join(_attribute(thing, "MATLAB_class"))
        why = _why_elsewhere(thing) or ("is empty" if "MATLAB_empty" in thing.attrs else None)
        if why is None and kind in ("char", "cell"):
            words = _characters(thing) if kind == "char" else _cells(file, thing)
            found[name] = f"is a {kind} array" if words is None else words
        elif why is None and kind == "logical":
            found[name] = "holds true or false"
        elif why is None and ("MATLAB_object_decode" in thing.attrs or kind not in _CLASSES):
            found[name] = f"is of class {kind[:40]}"
        elif why is None and "MATLAB_sparse" in thing.parent.attrs:
            found[name] = "is of a sparse matrix"
        else:
            found[name] = why or _why_not(thing) or thing
    return linked | found


def _characters(thing: Any) -> tuple[str, ...] | None:
    """The rows of a character array, without the blanks that fill them up."""
    is_text = thing.ndim == 2 and thing.dtype == np.uint16 and _why_not(thing) is None
    if not is_text or not 0 < thing.size <= FREE_BYTES // 4:
        return None
    rows = np.ascontiguousarray(thing[()].T).astype("<u2")
    return tuple(row.tobytes().decode("utf-16-le", "replace").rstrip(" \0") for row in rows)


def _cells(file: Any, thing: Any) -> tuple[str, ...] | None:
    """The words of cells that hold one each."""
    if thing.dtype.kind != "O" or thing.ndim != 2 or not 0 < thing.size <= MOST_MEMBERS:
        return None
    words: list[str] = []
    for reference in thing[()].reshape(-1):
        cell = file[reference]
        if _attribute(cell, "MATLAB_class") != ("char",) or _why_elsewhere(cell) is not None:
            return None
        is_empty = "MATLAB_empty" in cell.attrs
        words += ("",) if is_empty else (_characters(cell) or ())[:1]
    return tuple(words)
