"""A file as a detector needs it: the channels of its hand, in order, on an even clock, tared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from tactslip_torch.data.clock import EvenSamples
from tactslip_torch.data.folder import refuse_other_channels
from tactslip_torch.data.formats import Archived, Reading, Samples, open_file
from tactslip_torch.data.sets.sampling import tare_level, tare_of
from tactslip_torch.data.sets.stream import Found, Stream, hand_of, look_at
from tactslip_torch.hand import HandLayout

_RATE_ERR = 0.001  # of a measured rate, as what is told in seconds errs; a stated one has none


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
    units: str,
    tare_s: Sequence[float] | None = None,
) -> Iterator[HandFile]:
    """Open a recording of a hand, ours or another's, to watch it by stretches.

    Args:
        path: of the file.
        hand: its channels; a file that names them all may have them in another order, and more.
        sample_rate_hz: that is wanted.
        reading: what the file does not say.
        units: that are wanted; of a file that does not say its own, they are taken for granted.
        tare_s: start and end of the stretch whose mean is taken off each channel, as it was for
            training.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, of another hand, rate or unit, or nobody says its rate.
    """
    tare = tare_of(tare_s, "tare_s")
    stream = Stream(reading=reading, channels=hand)
    with open_file(path, reading) as opened:
        if opened.archived is not None or (opened.names is None and reading.channels is None):
            refuse_other_channels(path, opened, hand.to_rows())
        found = look_at(opened, path, stream)
        _refuse_others(path, found, sample_rate_hz, units)
        try:
            _, rows = hand_of(found, stream)
        except ValueError as error:
            raise ValueError(f"{path} {error}") from None
        samples: Samples = opened.samples
        if found.clock.gaps:
            samples = EvenSamples(samples, found.clock)
        if rows != list(range(samples.num_channels)) or tare is not None:
            level = tare_level(samples, rows, sample_rate_hz, tare, path)
            samples = _Chosen(samples, rows, level)
        yield HandFile(samples, opened.archived)


def _refuse_others(path: Path, found: Found, sample_rate_hz: float, units: str) -> None:
    """Raise for another rate or unit than is wanted."""
    rate = found.clock.sample_rate_hz
    if rate != sample_rate_hz and not (
        found.is_measured and abs(rate / sample_rate_hz - 1) <= _RATE_ERR
    ):
        raise ValueError(
            f"{path} is of {rate} Hz, the detector of {sample_rate_hz:g} Hz; resample it"
        )
    if found.units not in (None, units):
        raise ValueError(
            f"{path} is in {found.units}, the detector was trained on {units}; give it recordings "
            f"in {units}, or train one on {found.units}"
        )


class _Chosen:
    """Some rows of samples, a level taken off each."""

    def __init__(self, samples: Samples, rows: list[int], level: Tensor) -> None:
        self.num_channels, self.num_samples = len(rows), samples.num_samples
        self.dtype = samples.dtype
        self._samples, self._rows, self._level = samples, rows, level

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``."""
        return (self._samples.read(first, stop)[self._rows] - self._level).to(self.dtype)
