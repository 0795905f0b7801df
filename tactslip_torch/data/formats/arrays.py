"""Arrays that stay in an open file, whichever library reads them: as samples, as times."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats.reading import SECONDS, TimeUnit

MOST_RATIO = 100
FREE_BYTES = 64 * 2**20


class Array(Protocol):
    """Numbers of no more than two dimensions in an open file."""

    @property
    def name(self) -> str:
        """In full, as people of the format write it: ``/group/volts``, ``trial.volts``."""

    @property
    def leaf(self) -> str:
        """The last part of the name."""

    @property
    def shape(self) -> tuple[int, ...]:
        """As people of the format see it."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """In the file."""

    @property
    def time_unit(self) -> TimeUnit | None:
        """Of a column that says it holds times."""

    def read(self, axis: int, first: int, stop: int) -> NDArray[Any]:
        """What stands from ``first`` to before ``stop`` along that axis, all of the other.

        Raises:
            ValueError: if the file was damaged or cut since it was opened.
        """


class Contents(NamedTuple):
    """What was found in a file of arrays.

    Args:
        arrays: that can be read.
        refused: names of what cannot, each with the reason.
        labels: words that may name channels of the array of that name, nearest first.
        facts: numbers said about the array of that name, nearest first.
        columns: names by which columns are counted, where the file is one table.
    """

    arrays: Sequence[Array]
    refused: Mapping[str, str] = {}
    labels: Callable[[str], Iterable[tuple[str, ...]]] = lambda name: ()
    facts: Callable[[str], Iterable[Mapping[str, float]]] = lambda name: ()
    columns: Sequence[str] | None = None


def float_for(*stored: np.dtype[Any]) -> torch.dtype:
    """``float32`` if it holds every number of these dtypes exactly, else ``float64``.

    Whole numbers beyond 2**53 are rounded.
    """
    small = all(dtype.itemsize <= (4 if dtype.kind == "f" else 2) for dtype in stored)
    return torch.float32 if small else torch.float64


def why_not_numbers(dtype: np.dtype[Any]) -> str | None:
    """The reason why values of this dtype are no samples, if there is one."""
    if dtype.kind in "iu" or (dtype.kind == "f" and dtype.itemsize <= 8):
        return None
    kinds = {"b": "true or false", "c": "complex numbers", "V": "compound", "O": "objects or text"}
    return f"holds {kinds.get(dtype.kind, 'text' if dtype.kind in 'SU' else str(dtype))}"


def why_not_plausible(claimed: int, stored: int) -> str | None:
    """The reason why a file that stores so few bytes cannot claim so many, if there is one."""
    if claimed <= max(FREE_BYTES, MOST_RATIO * stored):
        return None
    return f"claims {claimed} bytes and stores {stored}, of which {MOST_RATIO} times are believed"


def vector(array: Array, first: int, stop: int) -> NDArray[Any]:
    """A stretch of an array of which no more than one axis is longer than 1."""
    return array.read(int(np.argmax(array.shape)), first, stop).reshape(-1)


@dataclass(frozen=True)
class MatrixSamples:
    """Samples in one array, ``[T, C]`` if ``time_axis`` is 0; ``rows`` are its channels used."""

    array: Array
    time_axis: int
    rows: Sequence[int] | None = None

    @property
    def num_channels(self) -> int:
        """Of those used."""
        return self.array.shape[1 - self.time_axis] if self.rows is None else len(self.rows)

    @property
    def num_samples(self) -> int:
        """Along the axis of time."""
        return self.array.shape[self.time_axis]

    @property
    def dtype(self) -> torch.dtype:
        """See ``float_for``."""
        return float_for(self.array.dtype)

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``."""
        first, stop = _within(first, stop, self.num_samples)
        values = self.array.read(self.time_axis, first, stop)
        by_channel = values if self.time_axis else values.T
        return _tensor(by_channel if self.rows is None else by_channel[list(self.rows)], self.dtype)


@dataclass(frozen=True)
class ColumnSamples:
    """Samples in an array per channel, all of one length."""

    arrays: Sequence[Array]

    @property
    def num_channels(self) -> int:
        """As many as arrays."""
        return len(self.arrays)

    @property
    def num_samples(self) -> int:
        """The length of each."""
        return max(self.arrays[0].shape)

    @property
    def dtype(self) -> torch.dtype:
        """See ``float_for``."""
        return float_for(*(array.dtype for array in self.arrays))

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``."""
        first, stop = _within(first, stop, self.num_samples)
        wanted = np.float32 if self.dtype == torch.float32 else np.float64
        values = np.empty((self.num_channels, stop - first), wanted)
        for row, array in zip(values, self.arrays, strict=True):
            row[:] = vector(array, first, stop)
        return torch.from_numpy(values)


@dataclass(frozen=True)
class MatrixColumn:
    """One channel of an array, read as if it stood alone: the times in a column of theirs."""

    array: Array
    time_axis: int
    number: int
    time_unit: TimeUnit | None = None

    @property
    def name(self) -> str:
        """Of the array, with the number."""
        return f"{self.array.name}[{self.number}]"

    leaf = name

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of samples."""
        return (self.array.shape[self.time_axis],)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the array."""
        return self.array.dtype

    def read(self, axis: int, first: int, stop: int) -> NDArray[Any]:
        """A stretch of it."""
        part = self.array.read(self.time_axis, first, stop)
        column: NDArray[Any] = np.take(part, self.number, axis=1 - self.time_axis)
        return column


@dataclass(frozen=True)
class ArrayTimes:
    """Times in an array, in seconds since its first."""

    array: Array
    unit: TimeUnit
    start: Any = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", vector(self.array, 0, 1)[0])

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds since the first sample, ``[n]``.

        Whole numbers are subtracted as such: nanoseconds since 1970 are more than a float holds.
        """
        values = vector(self.array, *_within(first, stop, max(self.array.shape)))
        kind = np.int64 if self.array.dtype.kind in "iu" else np.float64
        since = values.astype(kind) - self.start.astype(kind)
        return torch.from_numpy(since.astype(np.float64) * SECONDS[self.unit])


def _within(first: int, stop: int, num_samples: int) -> tuple[int, int]:
    return min(first, num_samples), max(min(stop, num_samples), min(first, num_samples))


def _tensor(values: NDArray[Any], dtype: torch.dtype) -> Tensor:
    wanted = np.float32 if dtype == torch.float32 else np.float64
    return torch.from_numpy(np.ascontiguousarray(values, wanted))
