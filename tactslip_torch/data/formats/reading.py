"""What every format gives of an open file, and what a person says that the file does not."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from types import ModuleType
from typing import Literal, NamedTuple, Protocol, get_args

import torch
from torch import Tensor

from tactslip_torch.data.formats.header import Archived

TimeUnit = Literal["s", "ms", "us", "ns"]
SECONDS: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIME_NAMES = ("time", "time_s", "t", "timestamp", "timestamps", "stamp", "time_stamp", "seconds")
"""Names that ``time="auto"`` takes for times, in small letters."""


class Samples(Protocol):
    """Samples ``[C, T]`` that stay in their file until they are asked for."""

    @property
    def num_channels(self) -> int:
        """Rows."""

    @property
    def num_samples(self) -> int:
        """Columns."""

    @property
    def dtype(self) -> torch.dtype:
        """``float32`` or ``float64``; of whole numbers the smaller that holds them all."""

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, as far as there are any, ``[C, n]``.

        Raises:
            ValueError: if the file was damaged or cut since it was opened.
        """


class Times(Protocol):
    """When samples were taken."""

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds since the first sample, ``[n]``, float64, of the samples in that range."""


class KeptTimes(NamedTuple):
    """Times in memory, seconds since the first sample."""

    seconds: Tensor

    def read(self, first: int, stop: int) -> Tensor:
        """Those of the samples in that range, ``[n]``."""
        return self.seconds[first:stop]


class Opened(NamedTuple):
    """A file that is open.

    Args:
        samples: in the file's order of channels.
        archived: all else around a recording of no samples, if the file is one of ours.
        names: of the channels, if the file says.
        times: if the file has any.
        sample_rate_hz: if the file states it; what times say is not here.
    """

    samples: Samples
    archived: Archived | None = None
    names: tuple[str, ...] | None = None
    times: Times | None = None
    sample_rate_hz: float | None = None


def is_number(value: object) -> bool:
    """Whether a setting is a number; ``True`` is none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_column(value: object) -> bool:
    """Whether a setting says a column, by name or number."""
    return isinstance(value, (str, int)) and not isinstance(value, bool)


@dataclass(frozen=True)
class Reading:
    """How to read files that do not say it themselves; files of ours need none of it.

    Args:
        sample_rate_hz: of files without times.
        time: the column, dataset, variable or field of times, by name or by number from 0.
            ``"auto"``: what is called ``time``, ``t``, ``timestamp`` or the like; of a table
            without names the first column, unless the rate is given. ``None``: there is none.
        time_unit: of those times.
        channels: columns by name or number, in the order of the hand; ``None``: all but the times.
        samples: the dataset, variable or topic that holds samples; ``None``: the only one that can.
        time_first: whether arrays are ``[T, C]``; ``None``: the longer axis is time.
        delimiter: between columns of text; ``None``: found from the first lines.

    Raises:
        ValueError: for a value that cannot be.
    """

    sample_rate_hz: float | None = None
    time: str | int | None = "auto"
    time_unit: TimeUnit = "s"
    channels: Sequence[str | int] | None = None
    samples: str | None = None
    time_first: bool | None = None
    delimiter: str | None = None

    def __post_init__(self) -> None:
        rate = self.sample_rate_hz
        if rate is not None and not (is_number(rate) and 0 < rate < math.inf):
            raise ValueError(f"reading.sample_rate_hz must be positive, got {rate!r}")
        if self.time_unit not in get_args(TimeUnit):
            known = ", ".join(get_args(TimeUnit))
            raise ValueError(f"reading.time_unit must be one of {known}, got {self.time_unit!r}")
        if self.channels is not None:
            is_list = isinstance(self.channels, Sequence) and not isinstance(self.channels, str)
            if not (is_list and self.channels and all(map(_is_column, self.channels))):
                raise ValueError(
                    "reading.channels must be a list of columns, by name or number, got "
                    f"{self.channels!r}"
                )
            object.__setattr__(self, "channels", tuple(self.channels))
            if len(set(self.channels)) < len(self.channels):
                raise ValueError(f"reading.channels names a column twice: {list(self.channels)}")
        for name, kind, wanted in (
            ("samples", str, "the name of a dataset, variable or topic"),
            ("time_first", bool, "true, false"),
        ):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise ValueError(f"reading.{name} must be {wanted} or null, got {value!r}")
        if self.time is not None and not _is_column(self.time):
            raise ValueError(f"reading.time must be a name, a number or null, got {self.time!r}")
        if self.delimiter is not None and not (
            isinstance(self.delimiter, str) and len(self.delimiter) == 1
        ):
            raise ValueError(f"reading.delimiter must be one character, got {self.delimiter!r}")


RATE_NAMES = ("sample_rate_hz", "sampling_rate", "sample_rate", "samplingrate", "rate", "fs")
"""Names of a rate in files of others, in small letters."""
AS_IT_SAYS = Reading()
"""What is asked of a file that says all itself."""


def pieces(samples: Samples, num_samples: int) -> Iterator[Tensor]:
    """All samples in order, ``num_samples`` at a time and the rest at the end; ``[C, n]`` each."""
    for first in range(0, samples.num_samples, num_samples):
        yield samples.read(first, first + num_samples)


def time_name(names: Sequence[str], how: Reading) -> str | None:
    """Which of the names is that of the times; ``None`` if there is none.

    Raises:
        ValueError: if one is asked for that is not there.
    """
    if how.time == "auto":
        return next((name for name in names if name.strip().lower() in TIME_NAMES), None)
    if how.time is None or how.time in names:
        return how.time  # type: ignore[return-value]  # one of the names
    if isinstance(how.time, int) and 0 <= how.time < len(names):
        return names[how.time]
    raise ValueError(f"reading.time={how.time!r} is none of {', '.join(names)}")


def is_time_first(
    shape: tuple[int, int], how: Reading, path: str | os.PathLike[str], what: str
) -> bool:
    """Whether an array of that shape is ``[T, C]``.

    Raises:
        ValueError: if nobody says and the shape does not tell.
    """
    if how.time_first is not None:
        return how.time_first
    if shape[0] == shape[1]:
        raise ValueError(
            f"{os.fspath(path)}: {what} is {shape[0]} by {shape[1]}, so it does not show which "
            "axis is time; say reading.time_first=true or false"
        )
    return shape[0] > shape[1]


def needs(module: str, what: str, extra: str = "formats") -> ModuleType:
    """A library that is there only if its extra was installed.

    Args:
        module: to import.
        what: it is for, such as ``"reading .h5"``.
        extra: of this package that brings it.

    Raises:
        ValueError: in one line, if it is absent.
    """
    name = module.partition(".")[0]
    if find_spec(name) is None:
        raise ValueError(
            f'{what} needs {name}, which is not installed; pip install "tactslip_torch[{extra}]"'
        )
    return importlib.import_module(module)
