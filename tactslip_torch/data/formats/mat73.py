"""Variables of MAT files of version 7.3, which are HDF5 files with MATLAB's marks."""

from __future__ import annotations

import os
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.hdf5_tree import (
    DatasetArray,
    objects,
    why_elsewhere,
    why_not,
    words_said,
)
from tactslip_torch.data.formats.refusing import library

_NUMBERS = {"double", "single"} | {f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)}
_MOST_WORDS = 10_000
_MOST_CHARACTERS = 2**24


def look_through_73(
    path: str | os.PathLike[str], stack: ExitStack
) -> tuple[list[DatasetArray], dict[str, tuple[str, ...]], dict[str, str]]:
    """Numbers, words by name, and what is left alone with the reason.

    Rows and columns are MATLAB's: HDF5 shows its matrices turned.

    Args:
        path: of the file.
        stack: closes it.

    Raises:
        Refused: if h5py is absent.
        Exception: whatever h5py raises of a damaged file.
    """
    h5py = library("h5py", "reading .mat of version 7.3")
    file = stack.enter_context(h5py.File(path, "r"))
    arrays: list[DatasetArray] = []
    words: dict[str, tuple[str, ...]] = {}
    refused: dict[str, str] = {}
    for path_in_file, thing in objects(file, h5py, refused):
        name = path_in_file.strip("/").replace("/", ".")
        if name.startswith("#") or not isinstance(thing, h5py.Dataset):
            continue
        why = why_elsewhere(thing, h5py)
        kind = _class(thing)
        if why is not None or "MATLAB_empty" in thing.attrs:
            refused[name] = why or "is empty"
        elif kind == "char":
            words[name] = _rows(thing)
        elif kind == "cell":
            found = _cell_words(file, thing, h5py)
            words |= {name: found} if found else {}
            refused |= {} if found else {name: "is a cell array"}
        elif kind is not None and kind not in _NUMBERS:
            refused[name] = "holds true or false" if kind == "logical" else f"is of class {kind}"
        elif (why := why_not(thing, h5py) or _why_not_matrix(thing)) is not None:
            refused[name] = why
        else:
            arrays.append(DatasetArray(name, name.rpartition(".")[2], thing, is_turned=True))
    return arrays, words, refused


def _class(thing: Any) -> str | None:
    """MATLAB's name for what a dataset holds; None if something else wrote it."""
    if "MATLAB_object_decode" in thing.attrs:
        return "object"
    if "MATLAB_class" not in thing.attrs:
        return None
    return "".join(words_said(thing, "MATLAB_class")) or "unknown"


def _why_not_matrix(thing: Any) -> str | None:
    return "is of a sparse matrix" if "MATLAB_sparse" in thing.parent.attrs else None


def _rows(thing: Any) -> tuple[str, ...]:
    """The rows of a character array, without the blanks that fill them up."""
    if thing.ndim != 2 or thing.dtype != np.uint16 or not 0 < thing.size <= _MOST_CHARACTERS:
        return ()
    rows = np.ascontiguousarray(_all_of(thing).T).astype("<u2")
    return tuple(row.tobytes().decode("utf-16-le", "replace").rstrip(" \0") for row in rows)


def _cell_words(file: Any, thing: Any, h5py: Any) -> tuple[str, ...] | None:
    """The words of cells that hold one each."""
    is_short = thing.ndim == 2 and min(thing.shape) == 1 and thing.size <= _MOST_WORDS
    if h5py.check_ref_dtype(thing.dtype) is not h5py.Reference or not is_short:
        return None
    words: list[str] = []
    for reference in _all_of(thing).reshape(-1):
        cell = file[reference]
        if not isinstance(cell, h5py.Dataset) or why_elsewhere(cell, h5py) is not None:
            return None
        if _class(cell) != "char":
            return None
        words += ("",) if "MATLAB_empty" in cell.attrs else _rows(cell)[:1]
    return tuple(words)


def _all_of(thing: Any) -> NDArray[Any]:
    """Everything in a dataset of two dimensions, looked at before HDF5 reads it."""
    return DatasetArray(thing.name, "", thing).read(0, 0, len(thing))
