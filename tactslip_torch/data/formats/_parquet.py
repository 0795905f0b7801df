"""Recordings as Parquet tables, by pyarrow: a column a channel, read whole.

Ours have check sums, so that damage to them is noticed.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._arrays import Array, ArraySamples, choose, rate_in
from tactslip_torch.data.formats._header import (
    DTYPES,
    MOST_HEADER,
    header_in,
    opened_from,
    text_of,
)
from tactslip_torch.data.formats._limits import (
    MOST_CHANNELS,
    MOST_WHOLE,
    Refused,
    check_plausible,
    needs,
)
from tactslip_torch.data.formats._reading import Opened, Reading

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
    units, refused = {}, {}
    for name, kind in zip(names, schema.types, strict=True):
        if types.is_timestamp(kind):
            units[name] = kind.unit
        elif types.is_floating(kind) or types.is_integer(kind):
            units[name] = None
        else:
            refused[name] = f"holds {str(kind)[:40]!r}"
    said: dict[str, float] = {}
    for name, text in metadata.items():
        with suppress(ValueError):
            said[name] = float(text)
    rate = rate_in(said)
    table = file.read(columns=list(units), use_threads=False)
    arrays = []
    for name, unit in units.items():
        column = table.column(table.schema.names.index(name))  # nulls are NaN, stamps whole numbers
        values = (column if unit is None else column.cast("int64")).to_numpy()
        arrays.append(Array(path, name, values, time_unit=unit, sample_rate_hz=rate))
    own = header_in(metadata.get("header"))
    if own is not None:
        if names[:1] != [_TIME] or len(arrays) < 2 or refused:
            raise ValueError("times must stand first, then channels")
        return opened_from(own, ArraySamples(arrays[1:], dtype=DTYPES[own["dtype"]]))
    return choose(arrays, refused, how, columns=names)


def header(path: Path) -> dict[str, Any] | None:
    """All of a file of ours but its samples; ``None`` if it is another's."""
    with ExitStack() as stack:
        return header_in(_opened(path, stack)[1].get("header"))


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
