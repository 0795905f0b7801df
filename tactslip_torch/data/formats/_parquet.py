"""Recordings as Parquet tables, by pyarrow: a column a channel, read whole; LeRobot's episodes.

A LeRobot dataset is a folder with ``meta/info.json``: ``fps``, ``data_path`` and ``features``, each
with dtype, shape and names. Up to version 2.1 an episode is a table of its own; from 3.0 on a table
holds several, and ``meta/episodes`` tells which. A row is a frame, a feature a column of numbers or
lists. An episode is called ``DATASET/episode_000003.lerobot``; there is no file of that name.

Reference:
    github.com/huggingface/lerobot, ``datasets/utils.py`` and ``dataset_metadata.py``; 2.1 and 3.0.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._inference import Refused, rate_in
from tactslip_torch.data.formats._reading import (
    MOST_CHANNELS,
    MOST_WHOLE,
    Opened,
    Reading,
    Samples,
    _label_numbers,
    check_plausible,
    header_in,
    needs,
    opened_columns,
    opened_from,
    text_of,
)
from tactslip_torch.runtime import setting

_GROUP_BYTES = 4 * 2**20


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write the column ``time_s`` and a column a channel, with check sums.

    Metadata: ``header``, which is everything else as JSON, ``sample_rate_hz`` and ``units``.
    """
    pa, pq = needs("pyarrow", "writing .parquet"), needs("pyarrow.parquet", "writing .parquet")
    names = [row["name"] for row in header["channels"]]
    if "time_s" in names:
        raise Refused("cannot hold a channel called 'time_s'; rename it")
    times = np.arange(samples.shape[1]) / header["sample_rate_hz"]
    metadata = {
        "header": text_of(header),
        "sample_rate_hz": repr(header["sample_rate_hz"]),
        "units": header["units"],
    }
    columns = [pa.array(values) for values in (times, *samples)]
    pq.write_table(
        pa.table(columns, names=["time_s", *names]).replace_schema_metadata(metadata),
        path,
        row_group_size=max(_GROUP_BYTES // (len(names) * samples.itemsize), 1),
        use_dictionary=False,
        compression="none",
        write_statistics=False,
        write_page_checksum=True,
    )


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The columns of a table.

    Of foreign ones: every column of numbers is a channel but the times, which are found by name or
    by being time stamps; nulls are NaN. The rate is what the metadata call so.

    Raises:
        Refused: if pyarrow is absent, or the table claims more than is plausible or read whole.
    """
    library = needs("pyarrow.parquet", "reading .parquet")
    file = stack.enter_context(library.ParquetFile(path, page_checksum_verification=True))
    schema, num_rows = file.schema_arrow, file.metadata.num_rows
    names, kinds = schema.names, schema.types
    metadata = {k.decode(): v.decode() for k, v in (file.metadata.metadata or {}).items()}
    if len(set(names)) < len(names) or len(names) > MOST_CHANNELS:
        raise Refused(f"has several columns of one name, or more than {MOST_CHANNELS}; rename them")
    check_plausible("its table", num_rows * len(names) * 8, path.stat().st_size, MOST_WHOLE)
    types = needs("pyarrow", "reading .parquet").types
    stamps = {n: kind.unit for n, kind in enumerate(kinds) if types.is_timestamp(kind)}
    is_number = [types.is_floating(kind) or types.is_integer(kind) for kind in kinds]
    refused = [n for n, good in enumerate(is_number) if not good and n not in stamps]

    def samples(places: Sequence[int]) -> Samples:
        if how.label is not None and len(places) == 1 and places[0] in refused:
            values = file.read(columns=[names[places[0]]], use_threads=False).column(0).to_pylist()
            words = [None if value is None else str(value) for value in values]
            return Samples(path, [_label_numbers(how.label, words)])
        if wrong := [place for place in places if place in refused]:
            kind = str(kinds[wrong[0]])[:40]
            raise Refused(f"holds {kind!r} in column {names[wrong[0]]!r}")
        table = file.read(columns=[names[place] for place in places], use_threads=False)
        columns = [table.column(names[place]) for place in places]
        of_time = [place in stamps for place in places]
        whole = [
            c.cast("int64") if is_time else c for c, is_time in zip(columns, of_time, strict=True)
        ]
        return Samples(path, [column.to_numpy() for column in whole])

    own = header_in(metadata.get("header"))
    if own is not None:
        return opened_from(own, path, samples(range(1, len(names))))
    lists = [n for n, kind in enumerate(kinds) if types.is_nested(kind)]
    wrong = lists if how.channels is None else []  # channels may be in them
    if wrong or len(refused) == len(names):
        place = (wrong or refused)[0]
        raise Refused(
            f"holds no samples that are a column each: {names[place]!r} holds "
            f"{str(kinds[place])[:40]!r}; list columns of numbers as "
            f"{setting('reading.channels')}, or give the folder if it is a LeRobot dataset"
        )
    opened = opened_columns(names, len(names), how, samples, refused, stamps)
    numbers: dict[str, float] = {}
    for name, text in metadata.items():
        with suppress(ValueError):
            numbers[name] = float(text)
    return opened._replace(sample_rate_hz=rate_in(numbers))


# Episodes of LeRobot ----------------------------------------------------------------------------

EPISODE_ENDING = ".lerobot"
_INFO = Path("meta", "info.json")
_TIME, _EPISODE = "timestamp", "episode_index"
_OWN = (_TIME, "frame_index", _EPISODE, "index", "task_index")
_NUMBERS = re.compile(r"float(16|32|64)|u?int(8|16|32|64)|bool")
_FIELD = re.compile(r"\{(?:episode_chunk|episode_index|chunk_index|file_index)(?::0\d)?d?\}")
_MOST_EPISODES = 10**6


def is_dataset(folder: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (folder / _INFO).is_file()


def episodes_of(folder: Path) -> list[Path]:
    """The names of all episodes of a dataset.

    Raises:
        Refused: if its ``meta/info.json`` cannot be read.
    """
    num = _whole(_info_of(folder), "total_episodes", _MOST_EPISODES)
    return [folder / f"episode_{number:06d}{EPISODE_ENDING}" for number in range(num)]


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
        wanted = ["data/chunk_index", "data/file_index"]
        listed = sorted((folder / "meta" / "episodes").glob("*/*.parquet"))
        rows = next(filter(len, (_rows_of(file, number, wanted, 2) for file in listed)), None)
        if rows is None:
            raise Refused("is listed in no file of meta/episodes; download the dataset whole")
        places |= {n.partition("/")[2]: int(value) for n, value in rows.to_pylist()[0].items()}
    plain = _FIELD.sub("", template)
    if "{" in plain or ".." in PurePosixPath(plain).parts or plain.startswith("/"):
        raise Refused(f"is of a dataset whose data_path is {template[:80]!r}, which is not read")
    table = folder / template.format(**places)
    if not table.is_file():
        raise Refused(f"lies in {table.relative_to(folder)}, which is not there; download it whole")
    return table


def read_episode(path: Path, how: Reading, stack: ExitStack) -> Opened:
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
    counts = _features_in(info, how)
    found = _rows_of(table, _number_of(path), [_TIME, *counts], 1 + sum(counts.values()))
    columns = [row for name, n in ((_TIME, 1), *counts.items()) for row in _flat(found, name, n)]
    names = _names_of(counts, info["features"])
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
        info = json.loads(path.read_bytes())
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


def _features_in(info: Mapping[str, Any], how: Reading) -> dict[str, int]:
    """The features that are meant, and how many numbers each has."""
    numbers = {
        name: math.prod(feature["shape"])
        for name, feature in info["features"].items()
        if name not in _OWN and _NUMBERS.fullmatch(str(feature.get("dtype")))
    }
    wanted = "*tactile*" if how.samples is None else how.samples
    chosen = {n: c for n, c in numbers.items() if fnmatchcase(n, wanted) or n == wanted}
    if not chosen or (len(chosen) > 1 and how.samples is None):
        what = f"no feature {wanted!r}" if not chosen else f"several, {', '.join(chosen)}"
        listed = ", ".join(numbers) or "none"
        raise Refused(
            f"has {what[:200]}; say {setting('reading.samples')}=NAME, with * for any text; its "
            f"features of numbers are {listed[:400]}"
        )
    if not 0 < (total := sum(chosen.values())) <= MOST_CHANNELS:
        raise Refused(f"has {total} numbers a frame, 1 to {MOST_CHANNELS} are read")
    return chosen


def _names_of(counts: Mapping[str, int], features: Mapping[str, Any]) -> list[str]:
    """Of all numbers of the features."""
    names: list[str] = []
    for feature, count in counts.items():
        own = features[feature].get("names")
        if isinstance(own, dict):  # {"motors": [names]}, or {name: place}
            first = next(iter(own.values()), None)
            own = first if isinstance(first, list) else list(own)
        if not isinstance(own, list) or len(own) != count:
            last = feature.rpartition(".")[2]
            own = [last] if count == 1 else [f"{last}_{place}" for place in range(count)]
        names += map(str, own)
    if len(set(names)) < len(names) or _TIME in names:
        return [f"{feature}_{place}" for feature, n in counts.items() for place in range(n)]
    return names


def _rows_of(table: Path, number: int, columns: Sequence[str], num_numbers: int) -> Any:
    """The rows of an episode, so many numbers each, in some columns of a file."""
    library = needs("pyarrow.parquet", "reading LeRobot datasets")
    with library.ParquetFile(table) as file:
        names, num_rows = file.schema_arrow.names, file.metadata.num_rows
    if missing := [name for name in (_EPISODE, *columns) if name not in names]:
        raise Refused(f"lies in {table.name}, which has no column {missing[0]!r}")
    check_plausible(table.name, num_rows * num_numbers * 4, table.stat().st_size, MOST_WHOLE)
    # names of folders are no columns
    only = [(_EPISODE, "==", number)]
    return library.read_table(
        table, columns=columns, filters=only, use_threads=False, partitioning=None
    )


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
