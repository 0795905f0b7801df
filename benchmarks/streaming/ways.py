"""Ways to watch a stream: ``StreamingDetector``, and a bin with its context for every decision."""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import Decider, Decisions
from tactslip_torch.onset.rules import Cusum
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.simulation.source import SimulatedRecordings

RATE_HZ = 2000.0
Array = NDArray[Any]


class Watcher(Protocol):
    """What takes the next samples ``[n, C]`` of a stream."""

    def push(self, samples: Array, /) -> Decisions:
        """The decisions they make possible."""


class Naive:
    """Every bin judged as it completes, from the raw samples around it, by ``judge_raw``.

    At a hop of a fifth of a bin every sample is filtered five times and more. Bins are those of a
    ``StreamingDetector``; they wait for all of their context, and the first have zeros before them.

    Args:
        detector: fitted.
        settings: hop, calibration, rule and threshold; every push brings one hop.
    """

    def __init__(self, detector: SlipDetector, settings: AlarmSettings) -> None:
        pool = detector.pool
        self._detector = detector
        self._decider = Decider(
            settings, pool.sample_rate_hz, pool.bin_samples, detector.look_ahead
        )
        behind = pool.bin_samples + detector.context_after  # a bin's start, and what must be there
        held = -(-behind // settings.hop_samples) * settings.hop_samples
        self._needed = detector.context_before + behind
        self._held = torch.zeros(len(pool.hand), detector.context_before + held)

    @torch.no_grad()
    def push(self, samples: Array, /) -> Decisions:
        """The decision on the bin that these samples complete."""
        new = torch.from_numpy(np.ascontiguousarray(samples.T))
        self._held = torch.cat([self._held[:, new.shape[-1] :], new], dim=-1)
        score, is_valid, *_ = self._detector.judge_raw(self._held[None, :, : self._needed])
        return self._decider.decide(score, is_valid)


def settings_of(hop: int) -> AlarmSettings:
    """Settings of the usual kind; what they say of a bin does not matter here."""
    rule = Cusum(drift=0.1, evidence=min(1.0, hop / 100), ceiling=10.0)
    return AlarmSettings(hop, Platt(1.0, 0.0), rule, 8.0, target_per_hour=1.0)


def ours(detector: SlipDetector, hop: int) -> StreamingDetector:
    """A stream of float32 samples."""
    return StreamingDetector(detector, settings_of(hop), dtype=torch.float32)


@cache
def stream_samples(num_recordings: int) -> Array:
    """Simulated recordings, one behind the other, ``[T, 24]`` float32. Do not write into it."""
    materials = ("M1", "M2", "M3", "M4", "M5", "M6")
    source = SimulatedRecordings(cycles=-(-num_recordings // 6), materials=materials)
    ids = sorted(source.ids, key=lambda each: (each.cycle, each.material))[:num_recordings]
    parts = [source.load(recording).samples.float().numpy().T for recording in ids]
    return np.ascontiguousarray(np.concatenate(parts))


class Endless:
    """Pieces of samples ``[T, C]``, over and over."""

    def __init__(self, samples: Array) -> None:
        self._samples = samples
        self._place = 0

    def next(self, num: int) -> Array:
        """The next samples; the end of the recording is passed over if they would not fit."""
        if self._place + num > len(self._samples):
            self._place = 0
        self._place += num
        return self._samples[self._place - num : self._place]
