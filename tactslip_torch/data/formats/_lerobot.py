"""Episodes of LeRobot datasets as recordings, by pyarrow, without LeRobot.

A dataset is a folder with ``meta/info.json``: ``fps``, ``data_path`` and ``features``, each with
dtype, shape and names. Up to version 2.1 an episode is a table of its own; from 3.0 on a table
holds several, and ``meta/episodes`` tells which. A row is a frame, a feature a column of numbers or
lists. Nothing in it tells of slip. An episode is called ``DATASET/episode_000003.lerobot``; there
is no file of that name.

Reference:
    github.com/huggingface/lerobot, ``datasets/utils.py`` and ``dataset_metadata.py``; 2.1 and 3.0.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import opened_columns
from tactslip_torch.data.formats._reading import (
    MOST_CHANNELS,
    MOST_HEADER,
    MOST_WHOLE,
    Opened,
    Reading,
    Refused,
    Samples,
    check_plausible,
    needs,
)

ENDING = ".lerobot"
_INFO = Path("meta", "info.json")
_TIME, _EPISODE = "timestamp", "episode_index"
_OWN = (_TIME, "frame_index", _EPISODE, "index", "task_index")
_NUMBERS = re.compile(r"float(16|32|64)|u?int(8|16|32|64)|bool")
_FIELD = re.compile(r"\{(?:episode_chunk|episode_index|chunk_index|file_index)(?::0\d)?d?\}")
_MOST_EPISODES = 10**6


def is_dataset(folder: Path) -> bool:
    """Whether a folder is such a dataset."""
    return (folder / _INFO).is_file()


def episodes_of(folder: Path) -> list[Path]:
    """The names of all episodes of a dataset.

    Raises:
        Refused: if its ``meta/info.json`` cannot be read.
    """
    num = _whole(_info_of(folder), "total_episodes", _MOST_EPISODES)
    return [folder / f"episode_{number:06d}{ENDING}" for number in range(num)]


def table_of(path: Path) -> Path:
    """The file in which an episode is.

    Raises:
        Refused: if the dataset has no such episode.
    """
    folder, number, info = path.parent, _number_of(path), _info_of(path.parent)
    if number >= (num := _whole(info, "total_episodes", _MOST_EPISODES)):
        raise Refused(f"is none of the {num} episodes of its dataset, 0 to {num - 1}")
    places = {_EPISODE: number, "episode_chunk": number // _whole(info, "chunks_size", 10**6, 1)}
    template = str(info.get("data_path"))
    if "file_index" in template:
        places |= _listed_place(folder, number)
    plain = _FIELD.sub("", template)
    if "{" in plain or ".." in PurePosixPath(plain).parts or plain.startswith("/"):
        raise Refused(f"is of a dataset whose data_path is {template[:80]!r}, which is not read")
    table = folder / template.format(**places)
    if not table.is_file():
        raise Refused(f"lies in {table.relative_to(folder)}, which is not there; download it whole")
    return table


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The tactile columns of an episode, by ``timestamp`` and at the rate ``fps``.

    The features are those that ``reading.samples`` names, with ``*`` for any text, by default the
    one called tactile. Channels have the names that the feature gives its numbers, else its own
    name and their place. A feature that holds several samples of each channel is read with
    ``reading.samples_per_row``.

    Raises:
        Refused: if pyarrow is absent, the dataset is damaged, or it does not show which features
            are meant.
    """
    table, info = table_of(path), _info_of(path.parent)
    chosen = _features_in(info, how)
    counts = {name: math.prod(feature["shape"]) for name, feature in chosen.items()}
    found = _rows_of(table, _number_of(path), [_TIME, *chosen], 1 + sum(counts.values()))
    lists = [_flat(found, name, count) for name, count in ((_TIME, 1), *counts.items())]
    columns = [row for rows in lists for row in rows]
    names = _names_of(chosen)
    fps = info.get("fps")
    if not isinstance(fps, int | float) or not 0 < fps < math.inf:
        raise Refused(f"is of a dataset of {str(fps)[:40]} frames a second")

    def samples(places: list[int]) -> Samples:
        return Samples(path, [columns[place] for place in places])

    how = replace(how, hand=names)  # whatever they are called, they are those of the feature
    opened = opened_columns([_TIME, *names], len(names) + 1, how, samples, [0])
    return opened._replace(sample_rate_hz=float(fps) * how.samples_per_row)


def _number_of(path: Path) -> int:
    found = re.fullmatch(r"episode_(\d{1,9})\.lerobot", path.name)
    if found is None:
        raise Refused("must be called as episode_000003.lerobot to be read from its dataset")
    return int(found[1])


def _info_of(folder: Path) -> dict[str, Any]:
    path = folder / _INFO
    try:
        size = path.stat().st_size
        info = json.loads(path.read_bytes()) if size <= MOST_HEADER else None
    except (OSError, ValueError, RecursionError) as error:
        raise Refused(f"{path} is damaged or no JSON ({str(error)[:80]})") from None
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise Refused(f"{path} must be that of a LeRobot dataset, with features and fps")
    return info


def _whole(info: Mapping[str, Any], name: str, most: int, least: int = 0) -> int:
    value = info.get(name)
    if type(value) is not int or not least <= value <= most:
        raise Refused(f"is of a dataset whose {name} is {str(value)[:40]}, not {least} to {most}")
    return value


def _listed_place(folder: Path, number: int) -> dict[str, int]:
    """The chunk and file that ``meta/episodes`` gives for an episode."""
    wanted = ["data/chunk_index", "data/file_index"]
    for path in sorted((folder / "meta" / "episodes").glob("*/*.parquet")):
        if found := _rows_of(path, number, wanted, len(wanted)).to_pylist():
            return {name.partition("/")[2]: int(found[0][name]) for name in wanted}
    raise Refused("is listed in no file of meta/episodes; download the dataset whole")


def _features_in(info: Mapping[str, Any], how: Reading) -> dict[str, dict[str, Any]]:
    """The features that are meant, of which each is numbers of one shape."""
    numbers = {
        name: feature
        for name, feature in info["features"].items()
        if isinstance(feature, dict)
        and name not in _OWN
        and _NUMBERS.fullmatch(str(feature.get("dtype")))
        and isinstance(feature.get("shape"), list)
        and all(type(length) is int and 0 < length <= MOST_CHANNELS for length in feature["shape"])
    }
    wanted = "*tactile*" if how.samples is None else how.samples
    chosen = {n: f for n, f in numbers.items() if fnmatchcase(n, wanted) or n == wanted}
    if not chosen or (len(chosen) > 1 and how.samples is None):
        said = f"no feature {wanted!r}" if not chosen else f"several, {', '.join(chosen)}"
        listed = ", ".join(numbers) or "none"
        raise Refused(
            f"has {said[:200]}; say reading.samples=NAME, with * for any text; its features of "
            f"numbers are {listed[:400]}"
        )
    if (total := sum(math.prod(f["shape"]) for f in chosen.values())) > MOST_CHANNELS:
        raise Refused(f"has {total} numbers a frame, at most {MOST_CHANNELS} are read")
    return chosen


def _names_of(chosen: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Of all numbers of the features."""
    names: list[str] = []
    for feature, said in chosen.items():
        count, own = math.prod(said["shape"]), said.get("names")
        if isinstance(own, dict):  # {"motors": [names]}, or {name: place}
            first = next(iter(own.values()), None)
            own = first if isinstance(first, list) else list(own)
        if not (isinstance(own, list) and len(own) == len(set(map(str, own))) == count):
            last = feature.rpartition(".")[2]
            own = [last] if count == 1 else [f"{last}_{place}" for place in range(count)]
        names += map(str, own)
    if len(set(names)) < len(names) or _TIME in names:
        counts = {feature: range(math.prod(said["shape"])) for feature, said in chosen.items()}
        names = [f"{feature}_{place}" for feature, places in counts.items() for place in places]
    return names


def _rows_of(table: Path, number: int, columns: Sequence[str], num_numbers: int) -> Any:
    """The rows of an episode, so many numbers each, in some columns of a file."""
    library = needs("pyarrow.parquet", "reading LeRobot datasets")
    with library.ParquetFile(table) as file:
        names, num_rows = file.schema_arrow.names, file.metadata.num_rows
    if missing := [name for name in (_EPISODE, *columns) if name not in names]:
        raise Refused(f"lies in {table.name}, which has no column {missing[0]!r}")
    check_plausible(table.name, num_rows * num_numbers * 4, table.stat().st_size, MOST_WHOLE)
    return library.read_table(
        table,
        columns=columns,
        filters=[(_EPISODE, "==", number)],
        use_threads=False,
        partitioning=None,  # names of folders are no columns
    ).combine_chunks()


def _flat(table: Any, name: str, count: int) -> NDArray[Any]:
    """The numbers of a column, ``[count, T]``; lists may be nested."""
    values = table.column(name).combine_chunks()
    while hasattr(values, "values"):  # a list, of any kind
        values = values.flatten()
    numbers = np.asarray(values.to_numpy(zero_copy_only=False))
    if numbers.size != len(table) * count or numbers.dtype.kind not in "iufb":
        raise Refused(f"has {numbers.size} numbers in {name!r} of {len(table)} frames of {count}")
    numbers = numbers.astype(np.uint8) if numbers.dtype.kind == "b" else numbers
    return numbers.reshape(len(table), count).T
