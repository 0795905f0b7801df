"""Recordings as Parquet tables, by pyarrow: a column a channel, read whole.

Ours have check sums, so that damage to them is noticed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import opened_columns, rate_in
from tactslip_torch.data.formats._reading import (
    MOST_CHANNELS,
    MOST_HEADER,
    MOST_WHOLE,
    Opened,
    Reading,
    Refused,
    Samples,
    check_plausible,
    header_in,
    needs,
    opened_from,
    text_of,
)

_TIME = "time_s"
_GROUP_BYTES = 4 * 2**20


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write the column ``time_s`` and a column a channel.

    Metadata: ``header``, which is everything else as JSON, ``sample_rate_hz`` and ``units``.
    """
    pa, pq = needs("pyarrow", "writing .parquet"), needs("pyarrow.parquet", "writing .parquet")
    names = [row["name"] for row in header["channels"]]
    if _TIME in names:
        raise Refused(f"cannot hold a channel called {_TIME!r}; rename it")
    times = np.arange(samples.shape[1]) / header["sample_rate_hz"]
    metadata = {
        "header": text_of(header),
        "sample_rate_hz": repr(header["sample_rate_hz"]),
        "units": header["units"],
    }
    columns = [pa.array(values) for values in (times, *samples)]
    pq.write_table(
        pa.table(columns, names=[_TIME, *names]).replace_schema_metadata(metadata),
        path,
        row_group_size=max(_GROUP_BYTES // (len(names) * samples.itemsize), 1),
        use_dictionary=False,
        compression="none",
        write_statistics=False,
        write_page_checksum=True,
    )


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """The columns of a table.

    Of others: every column of numbers is a channel but the times, which are found by name or by
    being time stamps; nulls are NaN. The rate is what the metadata call so.

    Raises:
        Refused: if pyarrow is absent, or the table claims more than is plausible or read whole.
    """
    file, metadata = _opened(path, stack)
    rows, schema = file.metadata.num_rows, file.schema_arrow
    names: list[str] = schema.names
    if len(set(names)) < len(names) or len(names) > MOST_CHANNELS:
        raise Refused(f"has several columns of one name, or more than {MOST_CHANNELS}; rename them")
    check_plausible("its table", rows * len(names) * 8, path.stat().st_size, MOST_WHOLE)
    types = needs("pyarrow", "reading .parquet").types
    stamps = {n: kind.unit for n, kind in enumerate(schema.types) if types.is_timestamp(kind)}
    is_number = [types.is_floating(kind) or types.is_integer(kind) for kind in schema.types]
    refused = [n for n, good in enumerate(is_number) if not good and n not in stamps]
    own = header_in(metadata.get("header"))
    if own is not None:
        if names[:1] != [_TIME] or len(names) < 2 or refused:
            raise ValueError("times must stand first, then channels")
        return opened_from(own, path, _columns(file, names[1:]))
    lists = [n for n, kind in enumerate(schema.types) if types.is_nested(kind)]
    wrong = lists if how.channels is None else []  # channels may be in them
    if wrong or len(refused) == len(names):
        place = (wrong or refused)[0]
        raise Refused(
            f"holds no samples that are a column each: {names[place]!r} holds "
            f"{str(schema.types[place])[:40]!r}; list columns of numbers as reading.channels, or "
            "give the folder if it is a LeRobot dataset"
        )

    def samples(places: list[int]) -> Samples:
        if wrong := [place for place in places if place in refused]:
            kind = str(schema.types[wrong[0]])[:40]
            raise Refused(f"holds {kind!r} in column {names[wrong[0]]!r}")
        return Samples(path, _columns(file, [names[place] for place in places]))

    said: dict[str, float] = {}
    for name, text in metadata.items():
        with suppress(ValueError):
            said[name] = float(text)
    opened = opened_columns(names, len(names), how, samples, refused, stamps)
    return opened._replace(sample_rate_hz=rate_in(said))


def _columns(file: Any, names: Sequence[str]) -> list[NDArray[Any]]:
    """The numbers of columns; nulls are NaN, time stamps whole numbers."""
    table = file.read(columns=list(names), use_threads=False)
    columns = [table.column(name) for name in names]
    is_stamp = [str(column.type).startswith("timestamp") for column in columns]
    return [
        (column.cast("int64") if of_time else column).to_numpy()
        for column, of_time in zip(columns, is_stamp, strict=True)
    ]


def _opened(path: Path, stack: ExitStack) -> tuple[Any, dict[str, str]]:
    """An open file and its metadata."""
    file = stack.enter_context(
        needs("pyarrow.parquet", "reading .parquet").ParquetFile(
            path,
            thrift_string_size_limit=4 * MOST_HEADER,
            thrift_container_size_limit=10**6,
            page_checksum_verification=True,
        )
    )
    said = file.metadata.metadata or {}
    metadata = {
        name.decode("utf-8", "replace"): value.decode("utf-8", "replace")
        for name, value in said.items()
    }
    return file, metadata
