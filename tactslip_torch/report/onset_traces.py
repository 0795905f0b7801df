"""A stream as the few points that a page can show of it, gathered while it passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.report.envelope import Array, RunningEnvelope

Points = tuple[Array, Array]
"""Times in seconds and values there."""
Stretches = Sequence[tuple[float, float]]

_STRETCHES = 1500  # of each line, of which the least and the greatest value are kept


@dataclass(frozen=True, eq=False)
class Heard:
    """One recording and what was decided of it.

    Args:
        view: start and end of what is drawn, in seconds.
        films: volts of each film by its name; NaN is a gap.
        probability: of slip.
        is_slip: contact status after each decision, 0 or 1.
        is_valid: whether the decision can be relied on, 0 or 1.
        is_unsure: whether its score is too near the boundary to answer, or not valid, 0 or 1.
        alarms: of each alarm, when it was raised and when its slip is thought to have begun.
        onsets_s: exact onsets, where they are known.
        sliding_s: start and end of each slide.
        is_known: whether the truth is.
        units: of the samples.
    """

    view: tuple[float, float]
    films: Mapping[str, Points]
    probability: Points
    is_slip: Points
    is_valid: Points
    is_unsure: Points
    alarms: Stretches = ()
    onsets_s: Sequence[float] = ()
    sliding_s: Stretches = ()
    is_known: bool = False
    units: str = "V"


@dataclass(eq=False)
class Traces:
    """Gathers samples and decisions of a recording; its memory does not grow with the length.

    Args:
        films: what is drawn: row in the samples, by name.
        sample_rate_hz: of the samples.
        hop_s: distance of two decisions.
        view: start and end of what is drawn, in seconds.
        units: of the samples.
    """

    films: Mapping[str, int]
    sample_rate_hz: float
    hop_s: float
    view: tuple[float, float]
    units: str = "V"
    _num_samples: int = field(default=0, init=False)
    _first_s: float | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._span = tuple(round(edge * self.sample_rate_hz) for edge in self.view)
        length = self._span[1] - self._span[0]
        num_decisions = round((self.view[1] - self.view[0]) / self.hop_s)
        self._volts = RunningEnvelope(len(self.films), length, _STRETCHES)
        self._decided = RunningEnvelope(4, num_decisions, _STRETCHES)

    def add_samples(self, samples: NDArray[np.floating]) -> None:
        """Take the next samples, ``[C, n]``."""
        first, stop = (max(edge - self._num_samples, 0) for edge in self._span)
        self._num_samples += samples.shape[1]
        self._volts.add(samples[list(self.films.values()), first:stop])

    def add_decisions(
        self,
        available_s: Array,
        probability: Array,
        is_slip: Array,
        is_valid: Array,
        is_unsure: Array,
    ) -> None:
        """Take the next decisions, each ``[m]``."""
        since_s = self.view[0] - self.hop_s  # the one before the view tells the status there
        is_seen = (available_s > since_s) & (available_s <= self.view[1])
        if self._first_s is None and is_seen.any():
            self._first_s = float(available_s[is_seen][0])
        self._decided.add(np.stack([probability, is_slip, is_valid, is_unsure])[:, is_seen])

    def heard(
        self, alarms: Stretches, onsets_s: Sequence[float], sliding_s: Stretches, *, is_known: bool
    ) -> Heard:
        """What was gathered, with alarms and truth."""
        places, volts = self._volts.points()
        times = (self._span[0] + places) / self.sample_rate_hz
        films = {name: (times[row], volts[row]) for row, name in enumerate(self.films)}
        number, values = self._decided.points()
        decided_s = (self._first_s or 0.0) + number * self.hop_s
        lines = [(decided_s[row], values[row]) for row in range(4)]
        truth = (alarms, onsets_s, sliding_s, is_known)
        return Heard(self.view, films, lines[0], lines[1], lines[2], lines[3], *truth, self.units)


def view_of(given: Any, duration_s: float) -> tuple[float, float]:
    """What is drawn of a recording: all of it, or ``[start, end]`` as far as it goes.

    Raises:
        ValueError: if that is no stretch, or begins behind the recording.
    """
    if given is None:
        return 0.0, duration_s
    edges = list(given) if isinstance(given, Sequence) and not isinstance(given, str) else []
    if len(edges) != 2 or not all(type(edge) in (int, float) for edge in edges):
        raise ValueError(f"view must be [start, end] in seconds, got {given!r}")
    start, end = max(float(edges[0]), 0.0), min(float(edges[1]), duration_s)
    if not start < end:
        raise ValueError(f"view={given!r} shows nothing of {duration_s:g} s")
    return start, end


def spans(status: Points, end_s: float) -> list[tuple[float, float]]:
    """Stretches in which a status is on; it holds from its time to the next, at last to the end."""
    times, values = status
    is_on = np.concatenate([[False], np.asarray(values) >= 0.5, [False]])
    edges = np.flatnonzero(is_on[1:] != is_on[:-1])
    bounds = np.append(times, end_s)[edges].reshape(-1, 2)
    return [(float(start), float(end)) for start, end in bounds if end > start]


def status_at(status: Points, times: Array) -> NDArray[np.bool_]:
    """Whether a status is on at other times: off before its first."""
    known, values = status
    place = np.searchsorted(known, times, side="right")
    return np.concatenate([[False], np.asarray(values) >= 0.5])[place]
