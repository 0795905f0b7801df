"""Recordings as Parquet tables, by pyarrow: a column a channel, read by groups of rows.

Ours have check sums, so that damage to them is noticed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np

from tactslip_torch.data.formats.arrays import ColumnSamples, Contents
from tactslip_torch.data.formats.choosing import choose
from tactslip_torch.data.formats.header import Archived, archived_from, facts_of, header_of
from tactslip_torch.data.formats.parquet_table import EXTRA, Column, Table, columns_of
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading, needs
from tactslip_torch.data.formats.refusing import Refused, is_ours, refusing
from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

TIME = "time_s"
_GROUP_BYTES = 4 * 2**20


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording to one Parquet file, whole or not at all; equal input, equal bytes.

    The table has the column ``time_s`` and a column a channel; its metadata has ``header``, which
    is everything else as JSON, and ``sample_rate_hz`` and ``units``.

    Args:
        path: of the file.
        recording: samples in float32 or float64; tuples in its provenance come back as lists.
        hand: its channels, in the order of its rows.
        key: JSON-able facts that determined the samples, kept to find the file again.

    Raises:
        ValueError: if pyarrow is absent, a channel is called ``time_s``, the hand has another
            number of channels, the samples another dtype, or provenance or key is not JSON-able.
    """
    pa, pq = (needs(name, "writing .parquet", EXTRA) for name in ("pyarrow", "pyarrow.parquet"))
    header = header_of(recording, hand, key)
    if TIME in hand.names:
        raise ValueError(f"{os.fspath(path)}: a channel must not be called {TIME!r} in a table")
    samples = recording.samples.detach().cpu().contiguous().numpy()
    times = np.arange(samples.shape[1]) / recording.sample_rate_hz
    metadata = {
        "header": header,
        "sample_rate_hz": repr(float(recording.sample_rate_hz)),
        "units": recording.units,
    }
    columns = [pa.array(values) for values in (times, *samples)]
    table = pa.table(columns, names=[TIME, *hand.names]).replace_schema_metadata(metadata)
    rows = max(_GROUP_BYTES // (len(hand) * samples.itemsize), 1)
    with whole_file(path) as temporary:
        pq.write_table(
            table,
            temporary,
            row_group_size=rows,
            use_dictionary=False,
            compression="none",
            write_statistics=False,
            write_page_checksum=True,
        )


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if pyarrow is absent, or the file damaged or none of ours.
    """
    with ExitStack() as stack, refusing(path):
        table = Table(path, stack)
        samples = _our_samples(table)
        return archived_from(_our_header(table), samples.read(0, samples.num_samples))


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save`` wrote; its samples are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if pyarrow is absent, or the file none of ours.
    """
    with ExitStack() as stack, refusing(path):
        return dict(facts_of(_our_header(Table(path, stack)))["key"])


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """A file of ours or of others, its samples to be read by groups of rows.

    Of others: every column of numbers is a channel but the times, which are found by name or by
    being time stamps; nulls are NaN. The rate is what the metadata calls ``sample_rate_hz``,
    ``sample_rate``, ``sampling_rate``, ``fs`` or ``rate``. A group of rows is held at a time.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if pyarrow is absent, the file is damaged, or it has no such columns.
    """
    with ExitStack() as stack:
        with refusing(path):
            opened = _opened(Table(path, stack), how)
        yield opened


def _opened(table: Table, how: Reading) -> Opened:
    if is_ours(table.metadata.get("header")):
        samples = _our_samples(table)
        archived = archived_from(_our_header(table), samples.read(0, 0))
        rate = archived.recording.sample_rate_hz
        return Opened(samples, archived, archived.hand.names, None, rate)
    columns, refused = columns_of(table)
    said = {}
    for name, text in table.metadata.items():
        with suppress(ValueError):
            said[name] = float(text)
    contents = Contents(columns, refused, facts=lambda name: (said,), columns=table.names)
    return choose(table.path, contents, how)


def _our_header(table: Table) -> str:
    header = table.metadata.get("header")
    if header is None:
        raise Refused(f"{table.path} is no recording of ours: it has no header")
    return header


def _our_samples(table: Table) -> ColumnSamples:
    columns: list[Column] = columns_of(table)[0]
    if [column.name for column in columns[:1]] != [TIME] or len(columns) < 2:
        raise ValueError("times must stand first, then channels")
    return ColumnSamples(columns[1:])
