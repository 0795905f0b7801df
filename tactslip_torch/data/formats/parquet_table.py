"""Columns of numbers in a Parquet file, read by groups of rows of which one is held at a time."""

from __future__ import annotations

import os
from bisect import bisect_right
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.arrays import why_not_plausible
from tactslip_torch.data.formats.header import MOST_HEADER
from tactslip_torch.data.formats.reading import TimeUnit
from tactslip_torch.data.formats.refusing import Refused, library

EXTRA = "parquet"
MOST_GROUP_BYTES = 2**30
_MOST_PARTS = 10**6


class Table:
    """An open file.

    Args:
        path: of the file.
        stack: closes it.

    Raises:
        Refused: if pyarrow is absent, the table claims more than is plausible, or two columns have
            one name.
        Exception: whatever pyarrow raises of a damaged file.
    """

    def __init__(self, path: str | os.PathLike[str], stack: ExitStack) -> None:
        self.pa = library("pyarrow", "reading .parquet", EXTRA)
        parquet = library("pyarrow.parquet", "reading .parquet", EXTRA)
        self.path = os.fspath(path)
        self.file = stack.enter_context(
            parquet.ParquetFile(
                self.path,
                thrift_string_size_limit=4 * MOST_HEADER,
                thrift_container_size_limit=_MOST_PARTS,
                page_checksum_verification=True,
            )
        )
        facts, self.schema = self.file.metadata, self.file.schema_arrow
        self.names: list[str] = self.schema.names
        self.metadata: dict[str, str] = {
            name.decode("utf-8", "replace"): value.decode("utf-8", "replace")
            for name, value in (facts.metadata or {}).items()
        }
        rows = [facts.row_group(group).num_rows for group in range(facts.num_row_groups)]
        self.ends = list(accumulate(rows))
        self.num_rows = self.ends[-1] if rows else 0
        claimed = self.num_rows * len(self.names) * 8
        why = why_not_plausible(claimed, Path(path).stat().st_size)
        if why is None and max(rows, default=0) * len(self.names) * 8 > MOST_GROUP_BYTES:
            why = f"has groups of {max(rows)} rows, more than {MOST_GROUP_BYTES} bytes"
        if why is None and len(set(self.names)) < len(self.names):
            why = "has several columns of one name"
        if why is not None:
            raise Refused(f"{self.path} {why}; write it again, in smaller groups of rows")

    def values(self, group: int, name: str) -> NDArray[Any]:
        """A column of a group of rows; nulls are NaN, time stamps whole numbers."""
        table = self.file.read_row_group(group, columns=[name], use_threads=False)
        values = table.column(table.schema.names.index(name))  # "a" brings "a.b" as well
        if self.pa.types.is_timestamp(values.type):
            values = values.cast(self.pa.int64())
        found: NDArray[Any] = values.to_numpy()
        return found


@dataclass
class Column:
    """A column of numbers; the group of rows that was read last is kept."""

    table: Table
    name: str
    dtype: np.dtype[Any]
    time_unit: TimeUnit | None = None
    _group: int = field(default=-1, init=False)
    _kept: NDArray[Any] = field(default_factory=lambda: np.empty(0), init=False)

    @property
    def leaf(self) -> str:
        """The whole name: a table has no groups."""
        return self.name

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of rows."""
        return (self.table.num_rows,)

    def read(self, axis: int, first: int, stop: int) -> NDArray[Any]:
        """Rows from ``first`` to before ``stop``.

        Raises:
            ValueError: if the file is damaged there.
        """
        if stop <= first:
            return np.empty(0, self.dtype)
        ends, parts = self.table.ends, []
        for group in range(bisect_right(ends, first), bisect_right(ends, stop - 1) + 1):
            start = ends[group - 1] if group else 0
            parts.append(self._values(group)[max(first - start, 0) : stop - start])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _values(self, group: int) -> NDArray[Any]:
        if group != self._group:
            try:
                self._kept = self.table.values(group, self.name)
            except Exception as error:
                raise ValueError(f"{self.table.path} is damaged at {self.name!r}") from error
            self._group = group
        return self._kept


def columns_of(table: Table) -> tuple[list[Column], dict[str, str]]:
    """The columns of numbers, and names of the others with the reason."""
    columns, refused = [], {}
    for name, kind in zip(table.names, table.schema.types, strict=True):
        types = table.pa.types
        if types.is_timestamp(kind):
            columns.append(Column(table, name, np.dtype(np.int64), kind.unit))
        elif types.is_floating(kind) or types.is_integer(kind):
            columns.append(Column(table, name, np.dtype(kind.to_pandas_dtype())))
        else:
            refused[name] = f"holds {str(kind)[:40]!r}"
    return columns, refused
