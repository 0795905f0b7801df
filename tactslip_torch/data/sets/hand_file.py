"""A file as a detector needs it: the channels of its hand, in order, on an even clock, tared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.clock import EvenSamples
from tactslip_torch.data.folder import refuse_other_channels
from tactslip_torch.data.formats.header import Archived
from tactslip_torch.data.formats.reading import Reading, Samples
from tactslip_torch.data.formats.registry import open_file
from tactslip_torch.data.sets.stream import Stream, hand_of, look
from tactslip_torch.hand import HandLayout

_RATE_ERR = 0.01  # of a rate that timestamps tell; a stated one must be the hand's own


class HandFile(NamedTuple):
    """A file that is open.

    Args:
        samples: of the hand's channels; NaN where timestamps show a gap.
        archived: all else, if the file is one of ours.
    """

    samples: Samples
    archived: Archived | None


@contextmanager
def hand_file(
    path: Path,
    hand: HandLayout,
    sample_rate_hz: float,
    reading: Reading,
    tare_s: Sequence[float] | None = None,
) -> Iterator[HandFile]:
    """Open a recording of a hand, ours or another's, to watch it by stretches.

    Args:
        path: of the file.
        hand: its channels; a file that names them all may have them in another order, and more.
        sample_rate_hz: that is wanted.
        reading: what the file does not say.
        tare_s: start and end of the stretch whose mean is taken off each channel, as it was for
            training.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, of another hand or rate, or nobody says its rate.
    """
    with open_file(path, reading) as opened:
        if opened.archived is not None or (opened.names is None and reading.channels is None):
            refuse_other_channels(path, opened, hand.to_rows())
    stream = Stream(reading=reading, channels=hand)
    found = look(path, stream)
    rate = found.clock.sample_rate_hz
    if rate != sample_rate_hz and not (
        found.is_measured and abs(rate / sample_rate_hz - 1) <= _RATE_ERR
    ):
        raise ValueError(
            f"{path} is of {rate} Hz, the detector of {sample_rate_hz:g} Hz; resample it"
        )
    try:
        _, rows = hand_of(found, stream)
    except ValueError as error:
        raise ValueError(f"{path} {error}") from None
    with open_file(path, reading) as opened:
        samples: Samples = opened.samples
        if found.clock.gaps:
            samples = EvenSamples(samples, found.clock)
        if rows != list(range(samples.num_channels)) or tare_s is not None:
            samples = _Chosen(samples, rows, _level(samples, rows, sample_rate_hz, tare_s, path))
        yield HandFile(samples, opened.archived)


def _level(
    samples: Samples,
    rows: list[int],
    rate_hz: float,
    tare_s: Sequence[float] | None,
    path: Path,
) -> Tensor:
    """What is taken off each channel, ``[C, 1]``, float64."""
    if tare_s is None:
        return torch.zeros(len(rows), 1, dtype=torch.float64)
    if len(tare_s) != 2 or not 0 <= tare_s[0] < tare_s[1]:
        raise ValueError(f"tare_s must be [start, end] in seconds, got {list(tare_s)}")
    first, stop = (round(moment * rate_hz) for moment in tare_s)
    if not first < stop <= samples.num_samples:
        raise ValueError(
            f"{path} has {samples.num_samples} samples, too few for tare_s={list(tare_s)}"
        )
    return samples.read(first, stop)[rows].double().nanmean(-1, keepdim=True)


class _Chosen:
    """Some rows of samples, a level taken off each."""

    def __init__(self, samples: Samples, rows: list[int], level: Tensor) -> None:
        self.num_channels, self.num_samples = len(rows), samples.num_samples
        self.dtype = samples.dtype
        self._samples, self._rows, self._level = samples, rows, level

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``."""
        return (self._samples.read(first, stop)[self._rows] - self._level).to(self.dtype)
