"""What a file gives when it is open, and what a person says that the file does not."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, Protocol, get_args

import torch
from torch import Tensor

from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout

TimeUnit = Literal["s", "ms", "us", "ns"]
SECONDS: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


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


class Archived(NamedTuple):
    """What a file of ours holds.

    Args:
        recording: samples and truth.
        hand: its channels.
        key: what determined the samples, as plain values.
    """

    recording: Recording
    hand: HandLayout
    key: dict[str, Any]


class Opened(NamedTuple):
    """A recording in a file that is open.

    Args:
        samples: all of them.
        archived: all else of a file of ours, around no samples; ``None`` for other files.
        names: of the channels, if the file says.
        times: of the samples, if the file has any.
        sample_rate_hz: if the file says; what a person says is not here.
    """

    samples: Samples
    archived: Archived | None = None
    names: tuple[str, ...] | None = None
    times: Times | None = None
    sample_rate_hz: float | None = None


def pieces(samples: Samples, num_samples: int) -> Iterator[Tensor]:
    """All samples in order, ``num_samples`` at a time and the rest at the end; ``[C, n]`` each."""
    for first in range(0, samples.num_samples, num_samples):
        yield samples.read(first, first + num_samples)


def is_number(value: object) -> bool:
    """Whether a setting is a finite number; ``True`` is none."""
    is_real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_real and math.isfinite(value)  # type: ignore[arg-type]


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
        isolate: whether to read in a process of its own, for files from strangers: a file that
            takes too much memory or time, or ends the process, is then refused in one line.
        isolate_gib: of memory that process may take beyond its libraries.
        isolate_s: it may take.

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
    isolate: bool = False
    isolate_gib: float = 2.0
    isolate_s: float = 120.0

    def __post_init__(self) -> None:
        units, columns = get_args(TimeUnit), self.channels
        is_list = isinstance(columns, Sequence) and not isinstance(columns, str) and bool(columns)
        mark = self.delimiter
        rate = self.sample_rate_hz
        for name, is_right, wanted in (
            ("sample_rate_hz", rate is None or _is_positive(rate), "positive"),
            ("isolate_gib", _is_positive(self.isolate_gib), "positive"),
            ("isolate_s", _is_positive(self.isolate_s), "positive"),
            ("time_unit", self.time_unit in units, f"one of {', '.join(units)}"),
            (
                "channels",
                columns is None or (is_list and all(map(_is_column, columns))),
                "a list of columns, by name or number",
            ),
            (
                "samples",
                isinstance(self.samples, str | None),
                "the name of a dataset, variable or topic, or null",
            ),
            ("time_first", self.time_first in (True, False, None), "true, false or null"),
            ("isolate", isinstance(self.isolate, bool), "true or false"),
            ("time", self.time is None or _is_column(self.time), "a name, a number or null"),
            (
                "delimiter",
                mark is None or (isinstance(mark, str) and len(mark) == 1),
                "one character",
            ),
        ):
            if not is_right:
                raise ValueError(f"reading.{name} must be {wanted}, got {getattr(self, name)!r}")
        if columns is not None:
            object.__setattr__(self, "channels", tuple(columns))
            if len(set(columns)) < len(columns):
                raise ValueError(f"reading.channels names a column twice: {list(columns)}")

    def key(self) -> dict[str, Any]:
        """What decides the samples that are read, as plain values; ``isolate`` does not."""
        return {n: value for n, value in asdict(self).items() if not n.startswith("isolate")}


def _is_positive(value: object) -> bool:
    return is_number(value) and value > 0  # type: ignore[operator]


def _is_column(value: object) -> bool:
    """Whether a setting says a column, by name or number."""
    return isinstance(value, (str, int)) and not isinstance(value, bool)
