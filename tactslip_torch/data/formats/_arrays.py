"""Recordings in files of arrays: NumPy's, HDF5, and MAT of versions 5 and 7.3.

``.mat`` of version 5 and the words of all are read whole; ``.npy``, HDF5 and MAT of version 7.3,
which is HDF5 underneath with rows and columns exchanged, by stretches. So are large arrays of
``.npz``, by way of a temporary file (``TMPDIR``). Of foreign
files the only matrix is the samples, or all vectors of one length are channels by name. Nothing is
unpickled, and no other file is opened.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._inference import (
    CHANNEL_LISTS,
    RATES,
    Refused,
    is_time,
    no_channels,
    rate_in,
    seconds_and_nanoseconds,
    time_unit_in,
)
from tactslip_torch.data.formats._reading import (
    FORM,
    FREE_BYTES,
    MOST_MEMBERS,
    MOST_WHOLE,
    Opened,
    Reading,
    Samples,
    StoredArray,
    _label_numbers,
    _nanoseconds,
    check_plausible,
    header_in,
    needs,
    opened_columns,
    opened_from,
    position_of,
    some,
    text_of,
)
from tactslip_torch.data.recording import MOMENTS, STRETCHES
from tactslip_torch.runtime import setting

_LARGE = 16 * 2**20  # bytes of an array that is not kept in memory
_NOT_NUMBERS = {"b": "true or false", "c": "complex numbers", "V": "compound values"}
_NOT_NUMBERS |= {"O": "objects or text", "S": "text", "U": "text"}
_Labels = list[tuple[str, ...]]


# Which arrays are samples -----------------------------------------------------------------------


@dataclass(frozen=True)
class _Array:
    """Numbers of no more than two dimensions in an open file.

    Args:
        name: in full, as people of the format write it: ``/group/volts``, ``trial.volts``.
        values: have ``shape`` and ``dtype`` and are sliced as NumPy's are.
        leaf: the last part of the name.
        labels: words that may name its channels, the likeliest first.
        sample_rate_hz: if the file says it of this array.
    """

    name: str
    values: Any
    leaf: str
    labels: _Labels
    sample_rate_hz: float | None = None

    @property
    def length(self) -> int:
        """Of the longest axis."""
        return int(max(self.values.shape))

    @property
    def is_column(self) -> bool:
        """Whether no more than one axis is longer than 1."""
        return len([length for length in self.values.shape if length > 1]) < 2


def _why_not_numbers(values: Any) -> str | None:
    """The reason why values are no samples, if there is one."""
    if values.dtype.kind not in "iuf" or values.dtype.itemsize > 8:
        return f"holds {_NOT_NUMBERS.get(values.dtype.kind, str(values.dtype))}"
    if values.shape is None or len(values.shape) > 2:
        return "is empty" if values.shape is None else f"has {len(values.shape)} dimensions"
    return None


def _choose(
    path: Path,
    found: Mapping[str, Any],
    how: Reading,
    separator: str = "/",
    attributes: Callable[[Any], tuple[_Labels, float | None]] = lambda _: ([], None),
) -> Opened:
    """The samples of a file: its only array of two dimensions, or all columns of one length.

    What ``how`` names goes first: ``samples`` an array or a group, ``channels`` columns, ``time``
    an array or a column. Single numbers are no samples.

    Args:
        path: of the file.
        found: everything in it by name: an array of numbers, a tuple of words, or the text why it
            is neither.
        how: what a person says of the file.
        separator: between the parts of a name.
        attributes: what they say of an array: words that may name its channels, and its rate.

    Raises:
        Refused: in one line that names what could be meant, if that is none or several.
    """
    refused = {name: kept for name, kept in found.items() if isinstance(kept, str)}
    arrays = _arrays_of(found, separator, attributes)
    several = [array for array in arrays if math.prod(array.values.shape) > 1]
    within = several if how.samples is None else _named(how.samples, several, refused)
    columns = [array for array in several if array.is_column]  # which numbers count
    matrices = [array for array in within if not array.is_column]
    called = {word for array in columns if array in within for word in (array.name, array.leaf)}
    is_matrix = bool(matrices) and (how.channels is None or not called.issuperset(how.channels))

    def apart(wanted: str | int | None, key: str) -> Sequence[_Array]:
        """Arrays that are not the samples; none of what is a column of a matrix."""
        if wanted is None:
            return []
        if isinstance(wanted, int):
            is_there = columns and not is_matrix
            return [columns[position_of(None, len(columns), wanted, key)]] if is_there else []
        if is_matrix and any(wanted in labels for array in several for labels in array.labels):
            return []
        return _named(wanted, several, refused)

    pair = [columns[n] for n in seconds_and_nanoseconds([array.leaf for array in columns])]
    if how.time == "auto" and pair and pair[0].length == pair[1].length:
        both = _nanoseconds(*(np.ravel(array.values[()]) for array in pair))
        times: Sequence[_Array] = [_Array(pair[0].name, both, "time_ns", [])]
        columns = [array for array in columns if array not in pair]
    elif how.time == "auto":
        times = [array for array in columns if is_time(array.leaf)]
    else:
        times = apart(how.time, setting("reading.time"))
    label = how.label
    words = _label_words(found, how, separator)
    labels = [] if words else apart(None if label is None else label.name, "labels.column")
    how = replace(how, label=None) if words or labels else how  # of the columns
    singles = [array for array in columns if array in within]
    passed: list[_Array] = []
    if how.channels is None:
        singles = [array for array in singles if array not in (*times, *labels)]
        if len(within) > 1 or how.samples is None:
            places = no_channels([array.leaf for array in singles], how.hand)
            passed = [singles[place] for place in places]
            singles = [array for array in singles if array not in passed]
    cubes = [name for name, why in refused.items() if why.endswith(" dimensions")]
    if cubes and how.samples is None and how.channels is None:
        raise Refused(
            f"holds {cubes[0]!r}, which {refused[cubes[0]]}; a recording has 2, channels and time: "
            f"cut windows are no recording (SlipClassifier takes them), else say "
            f"{setting('reading.samples')}"
        )
    if is_matrix:
        if len(matrices) > 1:
            raise Refused(
                f"holds several arrays, {_listed(matrices)}; say {setting('reading.samples')}"
            )
        opened, near = _of_matrix(path, matrices[0], times, how), matrices[0]
    elif singles:
        opened, near = _of_columns(path, singles, columns, how)
    else:
        named = {array.name: "is a label or book-keeping by its name" for array in passed}
        whys = "; ".join([f"{name!r} {why}" for name, why in (refused | named).items()][:3])
        reasons = f" ({whys})" if whys else " but times" if times else ""
        raise Refused(f"holds no samples{reasons}; say {setting('reading.samples')} if it does")
    length = opened.samples.num_samples
    fitting = [a for a in times if a.is_column and a.length == length]
    if opened.stamps is None and fitting:
        unit = how.time_unit or time_unit_in(fitting[0].leaf)
        opened = opened._replace(stamps=Samples(path, [fitting[0].values]), time_unit=unit)
    elif opened.stamps is None and times and how.time != "auto":
        raise Refused(
            f"has times {_listed(times)} for {length} samples; say {setting('reading.time')}"
        )
    if labels:
        if not labels[0].is_column or labels[0].length != length:
            raise Refused(f"has labels {_listed(labels)} for {length} samples; say labels.column")
        opened = opened._replace(labels=Samples(path, [labels[0].values]))
    if words:
        if len(words) != length:
            raise Refused(f"has {len(words)} labels for {length} samples; say labels.column")
        assert label is not None  # there are words of it
        opened = opened._replace(labels=Samples(path, [_label_numbers(label, words)]))
    rate = near.sample_rate_hz or _single_rate(arrays, near.name)
    beside = tuple(array.name for array in passed if array.length == length)
    return opened._replace(sample_rate_hz=rate, left_out=(*opened.left_out, *beside))


def _as_labels(name: str, values: Any, how: Reading) -> Any:
    """The column of labels as numbers or a tuple of words, if it is asked for and holds none.

    ``None`` of all else; true and false are 1 and 0.
    """
    if how.label is None or how.label.name not in (
        name,
        name.strip("/"),
        re.split("[/.]", name)[-1],
    ):
        return None
    if values.dtype.kind not in "bUSO" or sum(length > 1 for length in values.shape) > 1:
        return None
    whole = np.ravel(values[()])
    return whole.astype(np.int8) if whole.dtype.kind == "b" else _decoded(whole)


def _label_words(found: Mapping[str, Any], how: Reading, separator: str) -> Sequence[str]:
    """The words of the column of labels, if it holds words and not numbers."""
    wanted = "" if how.label is None else str(how.label.name).strip("/")
    for name, kept in found.items():
        if isinstance(kept, tuple) and wanted in (
            name.strip("/"),
            name.rpartition(separator)[2],
        ):
            return kept
    return ()


def _arrays_of(
    found: Mapping[str, Any],
    separator: str,
    attributes: Callable[[Any], tuple[_Labels, float | None]],
) -> list[_Array]:
    """The arrays of a file, with the words that may name their channels, the nearest first."""
    lists = {
        name: kept
        for name, kept in found.items()
        if isinstance(kept, tuple) and name.rpartition(separator)[2].lower() in CHANNEL_LISTS
    }
    arrays = []
    for name, kept in found.items():
        if not isinstance(kept, tuple | str):
            group, _, leaf = name.rpartition(separator)
            labels, rate = attributes(kept)
            near = sorted(lists, key=lambda at: at.rpartition(separator)[0] != group)
            arrays.append(_Array(name, kept, leaf, [*labels, *(lists[at] for at in near)], rate))
    return arrays


def _of_matrix(path: Path, matrix: _Array, times: Sequence[_Array], how: Reading) -> Opened:
    axis = _time_axis(matrix, {array.length for array in times}, how)
    count = matrix.values.shape[1 - axis]
    fitting = (labels for labels in matrix.labels if len(labels) == len(set(labels)) == count)
    labels = next(fitting, None)
    is_elsewhere = bool(times) and how.time != "auto"
    how = replace(how, time=None) if is_elsewhere else how

    def samples(rows: list[int]) -> Samples:
        return Samples(path, matrix.values, axis, None if rows == list(range(count)) else rows)

    return opened_columns(labels, count, how, samples)


def _time_axis(matrix: _Array, lengths: set[int], how: Reading) -> int:
    """The axis that is said, or as long as the times, or the longer one."""
    if how.time_first is not None:
        return 0 if how.time_first else 1
    rows, columns = matrix.values.shape
    if (rows in lengths) != (columns in lengths):
        return 0 if rows in lengths else 1
    if rows == columns:
        raise Refused(
            f"holds {matrix.name!r} of {rows} by {columns}, so it does not show which axis is "
            f"time; say {setting('reading.time_first')}=true or false"
        )
    return 0 if rows > columns else 1


def _of_columns(
    path: Path, singles: Sequence[_Array], columns: Sequence[_Array], how: Reading
) -> tuple[Opened, _Array]:
    """Arrays of one column each, and the first of them; numbers count all such of the file."""
    chosen = list(singles)
    if how.channels is not None:
        chosen = [
            columns[position_of(None, len(columns), wanted, setting("reading.channels"))]
            if isinstance(wanted, int)
            else _named(wanted, singles, {})[0]
            for wanted in how.channels
        ]
    if len({column.length for column in chosen}) > 1:
        raise Refused(
            f"holds columns of several lengths, {_listed(chosen)}; say "
            f"{setting('reading.channels')}"
        )
    names = tuple(column.leaf for column in chosen)
    if len(set(names)) < len(names):
        names = tuple(column.name for column in chosen)
    return Opened(Samples(path, [column.values for column in chosen]), names=names), chosen[0]


def _named(wanted: str, arrays: Sequence[_Array], refused: Mapping[str, str]) -> list[_Array]:
    """The array of that name, or those of that group; else what is only called so at its end."""
    plain = wanted.strip("/")
    for exact in (True, False):
        found = [a for a in arrays if plain == (a.name.strip("/") if exact else a.leaf)]
        if len(found) == 1:
            return found
    groups = (f"{plain}/", f"{plain}.")
    if inside := [array for array in arrays if array.name.strip("/").startswith(groups)]:
        return inside
    for name, why in refused.items():
        if name.strip("/") == plain:
            raise Refused(f"cannot be read at {name!r}: it {why}")
    raise Refused(f"has no {wanted!r} of numbers; it has {_listed(arrays) or 'none'}")


def _listed(arrays: Sequence[_Array]) -> str:
    return some([f"{a.name!r} {' by '.join(map(str, a.values.shape))}" for a in arrays])


def _single_rate(arrays: Sequence[_Array], name: str) -> float | None:
    """A rate that is an array of one number, the nearest to the samples by its name."""
    single = [a for a in arrays if math.prod(a.values.shape) == 1]
    single = [a for a in single if a.leaf.lower() in RATES]
    single.sort(key=lambda one: len(os.path.commonprefix([one.name, name])))
    return rate_in({one.leaf: float(np.ravel(one.values[()])[0]) for one in single})


# NumPy -------------------------------------------------------------------------------------------

_CHANNEL_COLUMNS = ("name", "kind", "finger", "segment", "adapting")
_WORDS = ("units", "material")


def write_npz(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
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
    for column in _CHANNEL_COLUMNS:
        if any(column in row for row in rows):
            words = [row.get(column, "") for row in rows]
            content[f"channel_{column}"] = np.array(words, np.str_)
    with path.open("wb") as file:
        np.savez(file, **content)


def read_npz(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A package file, an array, or an archive of arrays: ``samples``, if there is one."""
    if not zipfile.is_zipfile(path):
        array = _stored_array(stack.enter_context(path.open("rb")))
        stored = {"samples": _why_not_numbers(array) or array}
        return _choose(path, stored, replace(how, samples=None))
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        claimed = sum(member.file_size for member in members)
        check_plausible("its arrays", claimed, path.stat().st_size, MOST_WHOLE)
        large = [one.filename for one in members if one.file_size > _LARGE]
        found: dict[str, Any] = {
            name.removesuffix(".npy"): _unpacked(archive, name, stack)
            for name in large
            if name.endswith(".npy")
        }
    with np.load(path, allow_pickle=False) as content:
        for name in content.files:
            if name in found:
                continue
            try:
                found[name] = content[name]
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                found[name] = "holds objects"
    if "format" in found and how.samples in (None, "samples"):
        return opened_from(_npz_header(found), path, Samples(path, found["samples"], 1))
    if how.samples is None and "samples" in found:
        how = replace(how, samples="samples")
    for name, kept in found.items():
        if isinstance(kept, np.ndarray | StoredArray):
            labels = _as_labels(name, kept, how)
            found[name] = (_why_not_numbers(kept) or kept) if labels is None else labels
    return _choose(path, found, how)


def _unpacked(archive: zipfile.ZipFile, name: str, stack: ExitStack) -> StoredArray | str:
    """An array of an archive, in a temporary file; why it is none of numbers otherwise."""
    file = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
    with archive.open(name) as member:
        shutil.copyfileobj(member, file, FREE_BYTES // 64)
    file.seek(0)
    try:
        return _stored_array(file)
    except Refused as error:
        return str(error)


def _stored_array(file: IO[bytes]) -> StoredArray:
    """The array of an open ``.npy`` file.

    Raises:
        ValueError: if it is none, or cut.
    """
    version: tuple[int, int] = np.lib.format.read_magic(file)  # type: ignore[no-untyped-call]
    form = np.lib.format
    read_header = form.read_array_header_1_0 if version == (1, 0) else form.read_array_header_2_0
    shape, is_fortran, dtype = read_header(file)  # type: ignore[no-untyped-call]
    if dtype.hasobject:
        raise Refused("holds objects or text")
    return StoredArray(file, dtype, shape, file.tell(), "F" if is_fortran else "C")


def _npz_header(content: Mapping[str, Any]) -> dict[str, Any]:
    """The header of a package file, from its arrays."""
    if (form := str(content["format"])) != FORM:
        raise Refused(f"must be of format {FORM!r}, got {form[:80]!r}")
    needed = ("samples", "sample_rate_hz", *_WORDS, *MOMENTS, "provenance", "key")
    if missing := [name for name in needed if name not in content]:
        raise ValueError(f"no array {', '.join(missing)} in the archive")
    samples = content["samples"]
    beside = {name: kept.tolist() for name, kept in content.items() if name != "samples"}
    columns = [c for c in _CHANNEL_COLUMNS if f"channel_{c}" in beside]
    rows = zip(*(beside[f"channel_{column}"] for column in columns), strict=True)
    named = [dict(zip(columns, row, strict=True)) for row in rows]
    return beside | {
        "dtype": str(samples.dtype),
        "shape": list(samples.shape),
        **{name: json.loads(beside[name]) for name in ("provenance", "key")},
        "channels": [{n: w for n, w in row.items() if w or n != "adapting"} for row in named],
    }


# HDF5 --------------------------------------------------------------------------------------------

_CHUNK_BYTES = 256 * 2**10


def write_hdf5(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write ``/samples`` with ``sample_rate_hz``, ``units`` and ``channel_name`` as attributes.

    Everything else is JSON in the file's attribute ``header``. Chunks of time have check sums.
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


def read_hdf5(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file, read by slices.

    Of foreign ones: the only dataset ``[C, T]`` or ``[T, C]``, or all of one dimension as channels
    by name, wherever they stand; times by name; the rate by an attribute or a single number, names
    of channels by words, that are called so.
    """
    file = stack.enter_context(needs("h5py", f"reading {path.suffix}").File(path, "r"))
    own = header_in(_attribute(file, "header"))
    if own is not None:
        if why := _why_no_dataset(file["samples"]):
            raise ValueError(f"/samples {why}")
        return opened_from(own, path, Samples(path, file["samples"], 1))
    found: dict[str, Any] = {}
    for name, dataset in _datasets(file):
        is_list = name.rpartition("/")[2].lower() in CHANNEL_LISTS and _are_words(dataset)
        found[name] = _decoded(dataset[()]) if is_list else _why_no_dataset(dataset) or dataset
        if isinstance(found[name], str) and (labels := _as_labels(name, dataset, how)) is not None:
            found[name] = labels
    return _choose(path, found, how, attributes=_attributes)


def _datasets(file: Any) -> list[tuple[str, Any]]:
    """Every dataset that hard links lead to, by name, once; those of upper groups first.

    Raises:
        Refused: if there are more than ``MOST_MEMBERS`` groups and datasets.
    """
    h5py = needs("h5py", "reading HDF5")
    found: list[tuple[str, Any]] = []

    def visit(name: str, thing: Any) -> None:
        found.append((f"/{name}", thing))
        if len(found) > MOST_MEMBERS:
            raise Refused(f"holds more than {MOST_MEMBERS} objects")

    file.visititems(visit)
    found.sort(key=lambda one: one[0].count("/"))
    return [(name, thing) for name, thing in found if isinstance(thing, h5py.Dataset)]


def _why_no_dataset(dataset: Any) -> str | None:
    """The reason why a dataset is not read as numbers of up to two dimensions, if there is one."""
    if dataset.is_virtual or dataset.external:
        return "is stored in other files"
    try:
        why = _why_not_numbers(dataset)
        if why is None:
            stored = min(dataset.id.get_storage_size(), dataset.file.id.get_filesize())
            claimed = max(math.prod(dataset.shape), math.prod(dataset.chunks or (0,)))
            check_plausible("", claimed * dataset.dtype.itemsize, stored)
    except TypeError:
        return "holds what NumPy does not know"
    except Refused as error:
        return str(error).strip()
    return why


def _attributes(dataset: Any) -> tuple[_Labels, float | None]:
    """Words that may name the channels of a dataset and its rate, the nearest attributes first."""
    if isinstance(dataset, np.ndarray):  # labels that were true and false
        return [], None
    around = [dataset]
    while around[-1].name != "/":
        around.append(around[-1].parent)
    named = [(one, at) for one in around for at in one.attrs if at.lower() in CHANNEL_LISTS]
    rates = ({n: _number(one.attrs[n]) for n in one.attrs if n.lower() in RATES} for one in around)
    return [_attribute(one, at) for one, at in named], next(filter(None, map(rate_in, rates)), None)


def _number(value: Any) -> float:
    """An attribute that is one number; NaN of all else."""
    values = np.ravel(value)
    return float(values[0]) if values.size == 1 and values.dtype.kind in "iuf" else math.nan


def _attribute(thing: Any, name: str) -> tuple[str, ...]:
    """The words of an attribute; none if it is not there, or holds others."""
    if name not in thing.attrs or not _are_words(thing.attrs.get_id(name)):
        return ()
    return _decoded(thing.attrs[name])


def _are_words(kept: Any) -> bool:
    """Whether there are words of no or one dimension, and no more than may be read."""
    count = math.prod(kept.shape) if kept.shape is not None and len(kept.shape) < 2 else 0
    num_bytes = count * kept.dtype.itemsize
    return kept.dtype.kind in "OS" and 0 < count <= MOST_MEMBERS and num_bytes <= FREE_BYTES


def _decoded(values: Any) -> tuple[str, ...]:
    words = [w.decode() if isinstance(w, bytes) else w for w in np.atleast_1d(values)]
    return tuple(words) if all(isinstance(word, str) for word in words) else ()


# MAT ---------------------------------------------------------------------------------------------

_TITLE = b"MATLAB 5.0 MAT-file, written by tactslip_torch"
_MOST_BYTES = 2**31 - 2**10  # of a variable of version 5
_CLASSES = {"", "double", "single"} | {f"{u}int{b}" for u in ("", "u") for b in (8, 16, 32, 64)}
"""Of MATLAB, that are numbers."""


def write_mat(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write ``samples`` ``[C, T]``, ``sample_rate_hz``, ``units`` and the cells ``channel_name``.

    Everything else is JSON text in ``header``. Version 5 has no check sums.
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
        file.write(_TITLE.ljust(116))  # instead of the time of day


def read_mat(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The samples of a file.

    Of foreign ones: the only matrix, or all vectors of one length as channels by name, also in
    structs (``trial.volts``); times by name; the rate by a number, names of channels by characters
    or, up to version 7, cells, that are called so.

    Raises:
        Refused: if h5py is absent where it is needed, or a file of version 5 claims more than is
            read whole.
    """
    with path.open("rb") as file:
        head = file.read(128)
    is_hdf5 = head.startswith((b"MATLAB 7.3", b"\x89HDF"))
    if not is_hdf5 and head[124:] not in (b"\x00\x01IM", b"\x01\x00MI"):
        raise Refused("must be a MAT file of version 5 or 7.3, and is damaged or none of them")
    if is_hdf5:
        handle = stack.enter_context(needs("h5py", "reading .mat of version 7.3").File(path, "r"))
        found = _hdf5_variables(handle, how)
        if how.time_first is not None:
            how = replace(how, time_first=not how.time_first)  # as MATLAB shows it
    else:
        import scipy.io

        shapes = [shape for _, shape, _ in scipy.io.whosmat(path)]
        claimed = 8 * sum(map(math.prod, shapes))
        check_plausible("its variables", claimed, path.stat().st_size, MOST_WHOLE)
        found = {}
        for name, value in scipy.io.loadmat(path, mat_dtype=True, spmatrix=False).items():
            if not name.startswith("__"):
                _look(name, value, found, how)
    own = header_in(found.get("header"))
    if own is not None:
        return opened_from(own, path, Samples(path, found["samples"], 0 if is_hdf5 else 1))
    return _choose(path, found, how, ".", _attributes if is_hdf5 else lambda _: ([], None))


def _look(name: str, value: Any, found: dict[str, Any], how: Reading) -> None:
    """Sort a variable of version 5, or the fields of a struct, into ``found``.

    An array is numbers, a tuple words, and a text the reason why it is neither.
    """
    if type(value) is not np.ndarray:
        found[name] = "is sparse" if hasattr(value, "tocsc") else "is an object"
    elif value.dtype.names is not None:
        found |= {name: "is a struct array"} if value.size != 1 else {}
        for inner in value.dtype.names if value.size == 1 else ():
            _look(f"{name}.{inner}", value.reshape(-1)[0][inner], found, how)
    elif value.dtype.kind == "U":
        found[name] = tuple(str(word).rstrip(" \0") for word in value.reshape(-1))
    elif value.dtype.kind == "O":
        cells = value.reshape(-1)
        are_words = all(isinstance(c, np.ndarray) and c.dtype.kind == "U" for c in cells)
        found[name] = "is a cell array"
        if len(cells) and are_words:
            found[name] = tuple(str(c.reshape(-1)[0]) if c.size else "" for c in cells)
    elif (labels := _as_labels(name, value, how)) is not None:
        found[name] = labels
    else:
        found[name] = _why_not_numbers(value) or value


def _hdf5_variables(file: Any, how: Reading) -> dict[str, Any]:
    """Numbers, words, or why they are neither, by name and by the classes MATLAB wrote."""
    found: dict[str, Any] = {}
    for place, thing in _datasets(file):
        name = place.strip("/").replace("/", ".")
        kind = "".join(_attribute(thing, "MATLAB_class"))
        if name.startswith("#"):
            continue
        if "MATLAB_empty" in thing.attrs:
            found[name] = "is empty"
        elif kind == "char":
            found[name] = _characters(thing) or "is a char array"
        elif kind == "logical":
            is_label = how.label is not None and how.label.name in (name, name.split(".")[-1])
            found[name] = thing if is_label else "holds true or false"
        elif "MATLAB_object_decode" in thing.attrs or kind not in _CLASSES:
            found[name] = f"is of class {kind[:40]}"
        elif "MATLAB_sparse" in thing.parent.attrs:
            found[name] = "is of a sparse matrix"
        else:
            found[name] = _why_no_dataset(thing) or thing
    return found


def _characters(thing: Any) -> tuple[str, ...] | None:
    """The rows of a character array, without the blanks that fill them up."""
    is_text = thing.ndim == 2 and thing.dtype == np.uint16 and _why_no_dataset(thing) is None
    if not is_text or not 0 < thing.size <= FREE_BYTES // 4:
        return None
    rows = np.ascontiguousarray(thing[()].T).astype("<u2")
    return tuple(row.tobytes().decode("utf-16-le", "replace").rstrip(" \0") for row in rows)
