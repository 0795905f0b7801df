"""Detectors watch whole recordings: workers make a score per decision, and hand on nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.onset.scoring import Scorer, score_stream
from tactslip_torch.workers import in_processes

Array = NDArray[Any]


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
    """

    recording: RecordingId
    duration_s: float
    onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]
    speeds_mm_s: tuple[float, ...]
    score: Mapping[str, Array]
    is_valid: Mapping[str, Array]


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
        ValueError: if a recording is shorter than a bin or has other channels than a detector.
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
    )
