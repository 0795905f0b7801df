"""Recordings as HDF5 files, by h5py: ours, and the datasets that people have.

Ours hold ``/samples`` ``[C, T]`` in chunks of time with check sums, so that damage to them is
noticed. Nothing is read but numbers and words that stand in the file itself (``hdf5_tree``).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.arrays import Contents, MatrixSamples
from tactslip_torch.data.formats.choosing import LABEL_NAMES, choose
from tactslip_torch.data.formats.hdf5_tree import (
    DatasetArray,
    around,
    numbers_said,
    objects,
    why_elsewhere,
    why_not,
    words_in,
    words_said,
)
from tactslip_torch.data.formats.header import Archived, archived_from, facts_of, header_of
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading, needs
from tactslip_torch.data.formats.refusing import Refused, is_ours, refusing
from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

_CHUNK_BYTES = 256 * 2**10


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to one HDF5 file, whole or not at all; equal input, equal bytes.

    The file holds the dataset ``/samples`` ``[C, T]`` with the attributes ``sample_rate_hz``,
    ``units`` and ``channel_name``, and everything else as JSON in the file's attribute ``header``.

    Args:
        path: of the file.
        recording: samples in float32 or float64; tuples in its provenance come back as lists.
        hand: its channels, in the order of its rows.
        key: JSON-able facts that determined the samples, kept to find the file again.

    Raises:
        ValueError: if h5py is absent, the hand has another number of channels, the samples
            another dtype, a word holds a NUL, or provenance or key is not JSON-able.
    """
    h5py = needs("h5py", f"writing {Path(path).suffix or 'HDF5'}")
    header = header_of(recording, hand, key)
    for word in (recording.units, *hand.names):
        if "\0" in word:
            raise ValueError(f"a name must not hold a NUL to be saved, got {word!r}")
    samples = recording.samples.detach().cpu().contiguous().numpy()
    num_channels, num_samples = samples.shape
    instants = _CHUNK_BYTES // (num_channels * samples.itemsize)
    how = {}
    if num_samples:
        how = {"chunks": (num_channels, min(max(instants, 1), num_samples)), "fletcher32": True}
    # HDF5 of 2008 and later: before, more than some 4000 names would not fit
    with whole_file(path) as temporary, h5py.File(temporary, "w", libver="v108") as file:
        file.attrs["header"] = _fixed(header)[0]
        stored = file.create_dataset("samples", data=samples, **how)
        stored.attrs["sample_rate_hz"] = float(recording.sample_rate_hz)
        stored.attrs["units"] = _fixed(recording.units)[0]
        stored.attrs["channel_name"] = _fixed(*hand.names)


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if h5py is absent, or the file damaged or none of ours.
    """
    h5py = _library(path)
    with refusing(path), h5py.File(path, "r") as file:
        samples = _our_samples(file, h5py)
        return archived_from(_our_header(file, path), samples.read(0, samples.num_samples))


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if h5py is absent, or the file none of ours.
    """
    h5py = _library(path)
    with refusing(path), h5py.File(path, "r") as file:
        return dict(facts_of(_our_header(file, path))["key"])


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """A file of ours or of others, its samples to be read by slices.

    Of others: the only dataset ``[C, T]`` or ``[T, C]``, or all of one dimension as channels by
    name, wherever they stand; times by name; the rate by an attribute or a single number called
    ``sample_rate_hz``, ``sample_rate``, ``sampling_rate``, ``fs`` or ``rate``; names of channels
    by words called ``channel_name``, ``channels`` or ``labels``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if h5py is absent, the file is damaged, or does not show which samples are
            meant; the line names those that could be.
    """
    h5py = _library(path)
    with ExitStack() as stack:
        with refusing(path):
            file = stack.enter_context(h5py.File(path, "r"))
            opened = _opened(path, file, h5py, how)
        yield opened


def _opened(path: str | os.PathLike[str], file: Any, h5py: Any, how: Reading) -> Opened:
    if not is_ours(_header(file)):
        return choose(path, _contents(file, h5py), how)
    samples = _our_samples(file, h5py)
    archived = archived_from(_our_header(file, path), samples.read(0, 0))
    rate = archived.recording.sample_rate_hz
    return Opened(samples, archived, archived.hand.names, None, rate)


def _fixed(*words: str) -> NDArray[np.bytes_]:
    """UTF-8 of one length, filled up with NULs: no heap is needed (``hdf5_heap``)."""
    encoded = [word.encode() for word in words]
    return np.array(encoded, dtype=f"S{max(1, *map(len, encoded))}")


def _library(path: str | os.PathLike[str]) -> Any:
    return needs("h5py", f"reading {Path(path).suffix or 'HDF5'}")


def _header(file: Any) -> str | None:
    """The attribute of that name, if it is one text."""
    words = words_said(file, "header") if "header" in file.attrs else ()
    return words[0] if len(words) == 1 else None


def _our_header(file: Any, path: str | os.PathLike[str]) -> str:
    header = _header(file)
    if header is None:
        raise Refused(f"{os.fspath(path)} is no recording of ours: it has no header")
    return header


def _our_samples(file: Any, h5py: Any) -> MatrixSamples:
    if not isinstance(file.get("samples", getlink=True), h5py.HardLink):
        raise ValueError("samples must stand in the file")
    why = why_not(file["samples"], h5py)
    if why is not None or file["samples"].ndim != 2:
        raise ValueError(f"/samples {why or 'must have two dimensions'}")
    return MatrixSamples(DatasetArray("/samples", "samples", file["samples"]), time_axis=1)


def _contents(file: Any, h5py: Any) -> Contents:
    """Every dataset that may be read, and what is said beside them."""
    arrays: list[DatasetArray] = []
    refused: dict[str, str] = {}
    called: list[Any] = []  # as if they held names of channels
    for name, thing in objects(file, h5py, refused):
        if not isinstance(thing, h5py.Dataset):
            continue
        leaf = name.rpartition("/")[2]
        why = why_not(thing, h5py)
        if why is None:
            arrays.append(DatasetArray(name, leaf, thing))
            continue
        refused[name] = why
        if leaf.lower() in LABEL_NAMES and why_elsewhere(thing, h5py) is None:
            called.append(thing)

    def labels(name: str) -> Iterator[tuple[str, ...]]:
        for thing in around(file, name):
            yield from (words_said(thing, at) for at in thing.attrs if at.lower() in LABEL_NAMES)
        yield from map(words_in, called)

    def facts(name: str) -> Iterator[dict[str, float]]:
        yield from map(numbers_said, around(file, name))

    return Contents(arrays, refused, labels, facts)
