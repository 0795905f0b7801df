"""Detectors on whole recordings: workers make a score per decision, and hand on nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.onset.decisions import Decider, Decisions, Scorer, is_usable, score_stream
from tactslip_torch.onset.events import Watched
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.runtime import in_processes

Array = NDArray[Any]

_AT_ONCE = 256
"""Streams decided together."""


@dataclass(frozen=True, eq=False)
class Stream:
    """A recording as detectors scored it, one decision per hop.

    Args:
        recording: which.
        duration_s: of it.
        onsets_s: exact, one per stroke.
        sliding_s: start and end of each slide.
        speeds_mm_s: of each stroke.
        score: of every detector by name, ``[N]``, float32.
        is_valid: whether that is to be relied on, ``[N]``.
        is_usable: whether it tells anything: some channel in use was there, ``[N]``.
    """

    recording: RecordingId
    duration_s: float
    onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]
    speeds_mm_s: tuple[float, ...]
    score: Mapping[str, Array]
    is_valid: Mapping[str, Array]
    is_usable: Mapping[str, Array]


@dataclass(frozen=True)
class Clock:
    """When decisions are about what, and when they are there.

    Args:
        sample_rate_hz: of the stream.
        hop_samples: distance of two decisions.
        bin_samples: what each is about.
        look_ahead: samples behind its bin that a decision waits for.
    """

    sample_rate_hz: float
    hop_samples: int
    bin_samples: int
    look_ahead: int

    @property
    def hop_s(self) -> float:
        """Between two decisions."""
        return self.hop_samples / self.sample_rate_hz

    @property
    def bin_s(self) -> float:
        """Length of a bin."""
        return self.bin_samples / self.sample_rate_hz

    @property
    def look_ahead_s(self) -> float:
        """From the end of a bin until its decision can be made."""
        return self.look_ahead / self.sample_rate_hz

    def starts_s(self, num: int) -> Array:
        """Where the bins of the first decisions begin, ``[num]``."""
        return np.asarray(np.arange(num) * self.hop_samples / self.sample_rate_hz)

    def available_s(self, num: int) -> Array:
        """When the first decisions can be made, ``[num]``."""
        last = np.arange(num) * self.hop_samples + self.bin_samples + self.look_ahead
        return np.asarray(last / self.sample_rate_hz)


def watch(
    source: RecordingSource,
    recordings: Sequence[RecordingId],
    scorers: Mapping[str, Scorer],
    hop_samples: int,
    num_workers: int | None = None,
) -> Iterator[Stream]:
    """The recordings as the detectors score them, in order, with a progress bar.

    Args:
        source: of the recordings.
        recordings: which of them.
        scorers: detectors by name.
        hop_samples: distance of two decisions.
        num_workers: processes; ``None`` for as many as there are processors, at most 8.

    Raises:
        ValueError: if a recording has other channels than a detector.
    """
    watched = partial(_watched, source, scorers, hop_samples)
    return in_processes(watched, recordings, "watch streams", "recording", num_workers)


def _watched(
    source: RecordingSource,
    scorers: Mapping[str, Scorer],
    hop_samples: int,
    recording: RecordingId,
) -> Stream:
    loaded = source.load(recording)
    found = {
        name: score_stream(scorer, loaded.samples, hop_samples) for name, scorer in scorers.items()
    }
    return Stream(
        recording,
        loaded.duration_s,
        loaded.onsets_s,
        loaded.sliding_s,
        loaded.speeds_mm_s,
        {name: scores.score.float().numpy() for name, scores in found.items()},
        {name: scores.is_valid.numpy() for name, scores in found.items()},
        {
            name: is_usable(scores.score, scores.is_missing, scorers[name].needed_index).numpy()
            for name, scores in found.items()
        },
    )


def slip_bins(stream: Stream, clock: Clock, num: int) -> tuple[Array, Array]:
    """Which of the first decisions are wholly of one kind, and whether that is slip, ``[num]``.

    A bin is slip if it lies in a slide, and non-slip if it meets none; what straddles is neither.
    """
    start = clock.starts_s(num)
    end = start + clock.bin_s
    slides = np.asarray(stream.sliding_s, dtype=np.float64).reshape(-1, 2)
    is_slip = ((start[:, None] >= slides[:, 0]) & (end[:, None] <= slides[:, 1])).any(-1)
    meets = ((end[:, None] > slides[:, 0]) & (start[:, None] < slides[:, 1])).any(-1)
    return np.asarray(is_slip | ~meets), np.asarray(is_slip)


def decide(
    streams: Sequence[Stream], scorer: str, settings: AlarmSettings, clock: Clock
) -> Iterator[tuple[Stream, Decisions]]:
    """What a detector decides in each stream; those of one length are decided together.

    ``settings.hop_samples`` may be a multiple of the clock's hop: so many decisions are left out.

    Yields:
        Every stream with its decisions, in order of length.
    """
    step = settings.hop_samples // clock.hop_samples
    groups: dict[int, list[Stream]] = {}
    for stream in streams:
        groups.setdefault(len(stream.score[scorer][::step]), []).append(stream)
    for _, group in sorted(groups.items()):
        for start in range(0, len(group), _AT_ONCE):
            part = group[start : start + _AT_ONCE]
            rows = np.stack([stream.score[scorer][::step] for stream in part])
            valid = np.stack([stream.is_valid[scorer][::step] for stream in part])
            usable = np.stack([stream.is_usable[scorer][::step] for stream in part])
            decider = Decider(settings, clock.sample_rate_hz, clock.bin_samples, clock.look_ahead)
            made = decider.decide(*map(torch.from_numpy, (rows, valid, usable)))
            for place, stream in enumerate(part):
                own = (part[place] if part.ndim > 1 else part for part in made)
                yield stream, Decisions(*own)


def watched(stream: Stream, decisions: Decisions) -> Watched:
    """The alarms of a stream beside what is true of it."""
    available_s = decisions.available_s.numpy()
    raised = np.flatnonzero(decisions.is_alarm.numpy())
    off = np.append(np.flatnonzero(~decisions.is_on.numpy()), len(available_s))
    ends = off[np.searchsorted(off, raised)]
    speaks = available_s[np.flatnonzero(decisions.llr.numpy() > 0)]
    following = np.append(speaks, math.nan)[np.searchsorted(speaks, stream.onsets_s)]
    return Watched(
        recording=str(stream.recording),
        material=stream.recording.material,
        scene=stream.recording.scene,
        duration_s=stream.duration_s,
        alarms_s=tuple(available_s[raised].tolist()),
        onset_estimates_s=tuple(decisions.onset_s.numpy()[raised].tolist()),
        onsets_s=stream.onsets_s,
        sliding_s=stream.sliding_s,
        speeds_mm_s=stream.speeds_mm_s,
        first_positive_s=tuple(following.tolist()),
        alarm_ends_s=tuple(np.append(available_s, math.inf)[ends].tolist()),
    )
