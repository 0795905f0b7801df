"""Recordings as text tables: ``.csv``, ``.tsv``, ``.txt``, ``.dat`` and LabVIEW's ``.lvm``.

A file of ours is a comment with the header, a line of column names, and a row an instant: its time
and a column a channel, separated by commas in ``.csv`` and by tabs elsewhere. Of others most is
found out: see ``text_layout``. UTF-8, Latin-1 and, where its mark is there, UTF-16 are read.
"""

from __future__ import annotations

import codecs
import csv
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats.columns import chosen_columns
from tactslip_torch.data.formats.header import (
    DTYPES,
    FORM,
    MOST_HEADER,
    Archived,
    archived_from,
    damaged,
    facts_of,
    header_of,
)
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Opened, Reading
from tactslip_torch.data.formats.text_layout import Layout, layout_of
from tactslip_torch.data.formats.text_table import TextTable, all_rows
from tactslip_torch.data.recording import Recording
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

_OURS = f"# {FORM[:-1]}".encode()  # without its version
_TO_WRITE = 4096  # rows at a time
_TO_COUNT = 1024  # rows that show whether a column is their number
_CHUNK = 2**20
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


class TextSamples(NamedTuple):
    """Samples ``[C, T]`` that stay in a text table: some of its columns."""

    table: TextTable
    columns: tuple[int, ...]
    dtype: torch.dtype

    @property
    def num_channels(self) -> int:
        """Columns of samples."""
        return len(self.columns)

    @property
    def num_samples(self) -> int:
        """Rows."""
        return self.table.num_rows

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, as far as there are any, ``[C, n]``.

        Raises:
            ValueError: if the file has changed since it was opened.
        """
        return _channels(self.table.read(first, stop), self.columns, self.dtype)


class TextTimes(NamedTuple):
    """Seconds since the first row, from a column whose unit is ``seconds`` long."""

    table: TextTable
    column: int
    seconds: float

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds of the rows in that range, ``[n]``, float64; errors as of ``TextSamples``."""
        origin = self.table.read(0, 1)[:, self.column]
        times = self.table.read(first, stop)[:, self.column]
        return torch.from_numpy((times - origin) * self.seconds if len(times) else times.copy())


def save(
    path: str | os.PathLike[str], recording: Recording, hand: HandLayout, key: Mapping[str, Any]
) -> None:
    """Write a recording as text, whole or not at all; equal input, equal bytes.

    Numbers have as few digits as give the same bits back; of a NaN only that it is one is kept.

    Raises:
        ValueError: if the hand has another number of channels, the samples another dtype, or
            provenance or key is not JSON-able.
    """
    header = header_of(recording, hand, key)
    samples = recording.samples.detach().cpu().numpy()
    mark = "," if Path(path).suffix.lower() == ".csv" else "\t"
    with (
        whole_file(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="replace", newline="\n") as file,
    ):
        file.write(f"# {FORM} {header}\n")
        names = [" ".join(name.split()) for name in hand.names]  # in the header as they are
        csv.writer(file, delimiter=mark, lineterminator="\n").writerow(["time_s", *names])
        for first in range(0, samples.shape[1], _TO_WRITE):
            rows = samples[:, first : first + _TO_WRITE].T
            times = (np.arange(first, first + len(rows)) / recording.sample_rate_hz).tolist()
            texts = [map(repr, times), *(_texts(column) for column in rows.T)]
            file.writelines(mark.join(row) + "\n" for row in zip(*texts, strict=True))


def load(path: str | os.PathLike[str]) -> Archived:
    """What ``save`` wrote, bit for bit but for what sort of NaN is where.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or no file of ours; a wrong row is named with its line.
    """
    with _opened(path) as file:
        header, layout, shape, dtype = _ours(path, file)
        if 2 * shape[0] * shape[1] > os.fstat(file.fileno()).st_size:  # a digit and what follows it
            raise damaged(path)
        samples, done = torch.empty(shape, dtype=dtype), 0
        for rows in all_rows(path, file, layout):
            if done + len(rows) > shape[1]:
                raise damaged(path)
            channels = _channels(rows, tuple(range(1, shape[0] + 1)), dtype)
            samples[:, done : done + len(rows)] = channels
            done += len(rows)
        if done < shape[1]:
            raise damaged(path)
        return _archived(path, header, samples)


def key(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The key of a file that ``save`` wrote; its rows are not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no file of ours, or damaged where the key stands.
    """
    with _opened(path) as file:
        header, _, shape, dtype = _ours(path, file)
        return _archived(path, header, torch.empty((shape[0], 0), dtype=dtype)).key


@contextmanager
def open(path: str | os.PathLike[str], how: Reading = AS_IT_SAYS) -> Iterator[Opened]:
    """A text table, its rows once looked at, to be read by stretches.

    UTF-16 is written as UTF-8 to a temporary file (``TMPDIR``) first.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no table of numbers, naming the line; or lacks a column of ``how``.
    """
    with _opened(path) as file, ExitStack() as stack:
        if _is_ours(file):
            header, layout, shape, dtype = _ours(path, file)
            table = TextTable(path, file, layout)
            if table.num_rows != shape[1]:
                raise damaged(path)
            rest = _archived(path, header, torch.empty((shape[0], 0), dtype=dtype))
            samples = TextSamples(table, tuple(range(1, shape[0] + 1)), dtype)
            rate = rest.recording.sample_rate_hz
            yield Opened(samples, rest, rest.hand.names, None, rate)
        else:
            table = _foreign(path, file, how, stack)
            yield _opened_table(path, table, how)


def _opened_table(path: str | os.PathLike[str], table: TextTable, how: Reading) -> Opened:
    layout = table.layout

    def is_count(column: int) -> bool:
        values = table.read(0, _TO_COUNT)[:, column]
        return len(values) > 2 and bool((np.diff(values) == 1).all())

    time, seconds, columns = chosen_columns(path, layout.names, layout.num_columns, how, is_count)
    names = layout.names and tuple(layout.names[column] for column in columns)
    has_times = time is not None and not (layout.is_time_empty and time == 0)
    times = TextTimes(table, time, seconds) if has_times and time is not None else None
    samples = TextSamples(table, columns, torch.float64)
    return Opened(samples, None, names or None, times, layout.sample_rate_hz)


def _foreign(
    path: str | os.PathLike[str], file: IO[bytes], how: Reading, stack: ExitStack
) -> TextTable:
    mark = file.read(3)
    if mark[:2] in _UTF16:
        copied = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115  # by the stack
        file.seek(0)
        _copy_as_utf8(path, file, copied)
        copied.seek(0)
        file = copied
    elif mark != codecs.BOM_UTF8:
        file.seek(0)
    return TextTable(path, file, layout_of(path, file, how))


def _copy_as_utf8(path: str | os.PathLike[str], file: IO[bytes], copied: IO[bytes]) -> None:
    decoder = codecs.getincrementaldecoder("utf-16")()
    try:
        while chunk := file.read(_CHUNK):
            text = decoder.decode(chunk)
            if "\0" in text:  # nor let a sparse file fill the disk
                raise damaged(path)
            copied.write(text.encode())
        decoder.decode(b"", final=True)
    except UnicodeError as error:
        raise ValueError(f"{os.fspath(path)} is no whole UTF-16 text; save it as UTF-8") from error


def _opened(path: str | os.PathLike[str]) -> IO[bytes]:
    if not Path(path).exists():
        raise FileNotFoundError(f"no file at {os.fspath(path)}")
    if not Path(path).is_file():  # reading a pipe would wait for ever
        raise ValueError(f"{os.fspath(path)} must be a file")
    return Path(path).open("rb")


def _is_ours(file: IO[bytes]) -> bool:
    is_ours = file.read(len(_OURS)) == _OURS
    file.seek(0)
    return is_ours


def _ours(
    path: str | os.PathLike[str], file: IO[bytes]
) -> tuple[str, Layout, tuple[int, int], torch.dtype]:
    """Header, layout, shape ``[C, T]`` and dtype of a file of ours."""
    if not _is_ours(file):
        raise damaged(path)
    try:
        form, _, header = file.readline(MOST_HEADER).decode().removeprefix("# ").partition(" {")
        if form != FORM:
            raise ValueError(f"{os.fspath(path)} must be of format {FORM!r}, got {form!r}")
    except UnicodeDecodeError as error:
        raise damaged(path) from error
    try:
        facts = facts_of(header := "{" + header)
        num_channels, num_samples = (int(size) for size in facts["shape"])
        dtype = DTYPES[facts["dtype"]]
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path) from error
    names = file.readline(MOST_HEADER)
    mark = "\t" if names.startswith(b"time_s\t") else ","
    if num_channels < 1 or num_samples < 0 or not names.startswith(f"time_s{mark}".encode()):
        raise damaged(path)
    layout = Layout(file.tell(), 3, mark, num_channels + 1)
    return header, layout, (num_channels, num_samples), dtype


def _archived(path: str | os.PathLike[str], header: str, samples: Tensor) -> Archived:
    try:
        return archived_from(header, samples)
    except ValueError as error:
        raise damaged(path) from error


def _channels(rows: NDArray[np.float64], columns: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    with np.errstate(over="ignore"):  # a number beyond float32 is infinite in it
        wanted = np.float32 if dtype == torch.float32 else np.float64
        chosen = rows[:, columns].T.astype(wanted, order="C")
    return torch.from_numpy(chosen)


def _texts(column: NDArray[Any]) -> list[str]:
    """Numbers with as few digits as give the same bits, read as float64 and cast."""
    if column.dtype == np.float64:
        return list(map(repr, column.tolist()))
    texts = list(map(str, column))
    read = np.array(list(map(float, texts))).astype(column.dtype)
    for place in np.flatnonzero((read != column) & ~np.isnan(column)):
        texts[place] = f"{column[place]:.9g}"  # the shortest rounds twice, to a neighbour
    return texts
