"""A tiny set of recordings on a two-channel hand: fast, separable but not trivially, no simulator.

Non-slip is noise; slip is a louder noise of a material's own colour. The level of every recording
varies enough that some bins are on the wrong side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import Recording, RecordingId, Timeline
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.recipe import Paper

SMALL_HAND = HandLayout(
    (Channel("SG1", "SG", "index", "distal"), Channel("PVDF1", "PVDF", "index", "distal"))
)
RATE_HZ = 2000.0


@dataclass(frozen=True)
class SmallTimeline(Timeline):
    duration_s: float = 2.0
    onsets_s: tuple[float, ...] = (1.1,)
    annotated_onsets_s: tuple[float, ...] = (1.1,)
    sliding_s: tuple[tuple[float, float], ...] = ((1.1, 1.95),)
    speeds_mm_s: tuple[float, ...] = (20.0,)


class NoiseRecordings:
    """A ``RecordingSource`` of two channels of noise; a subclass says which, and shapes it."""

    is_simulated = False
    hand = SMALL_HAND
    sample_rate_hz = RATE_HZ
    ids: tuple[RecordingId, ...] = ()

    def timeline(self, recording: RecordingId) -> Timeline:
        return SmallTimeline()

    def key(self, recording: RecordingId) -> dict[str, Any]:
        return {"id": str(recording)}

    def seed(self, recording: RecordingId) -> int:
        return sum(str(recording).encode()) * 7919

    def shape(
        self, noise: Tensor, time_s: Tensor, recording: RecordingId, generator: torch.Generator
    ) -> None:
        """Change white noise of size 1 ``[C, T]`` in place."""

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        times, rate_hz = self.timeline(recording), self.sample_rate_hz
        generator = torch.Generator().manual_seed(self.seed(recording))
        num_samples = round(times.duration_s * rate_hz)
        noise = torch.randn(len(self.hand), num_samples, generator=generator)
        self.shape(noise, torch.arange(num_samples) / rate_hz, recording, generator)
        truth = times.speeds_mm_s, times.onsets_s, times.sliding_s
        released_s = times.released_s
        return Recording(noise, rate_hz, recording.material, *truth, released_s=released_s)


class SmallSet(NoiseRecordings):
    """Its ``gains`` scale recordings, ``broken`` names one that holds a NaN."""

    is_simulated = True

    def __init__(
        self,
        materials: Sequence[str] = ("a", "b", "c"),
        cycles: int = 5,
        gains: Mapping[RecordingId, float] | None = None,
        broken: RecordingId | None = None,
    ) -> None:
        self.ids = tuple(RecordingId(m, c) for m in materials for c in range(cycles))
        self.gains = dict(gains or {})
        self.broken = broken
        self.loads = 0

    def key(self, recording: RecordingId) -> dict[str, Any]:
        gain = self.gains.get(recording, 1.0)
        return {"id": str(recording), "gain": gain, "broken": recording == self.broken}

    def shape(
        self, noise: Tensor, time_s: Tensor, recording: RecordingId, generator: torch.Generator
    ) -> None:
        self.loads += 1
        onset = round(self.timeline(recording).onsets_s[0] * RATE_HZ)
        noise[:, onset:] *= 1.25 + 0.25 * torch.rand(1, generator=generator)
        noise[0] += 1.0
        noise *= self.gains.get(recording, 1.0)
        if recording == self.broken:
            noise[1, onset + 300] = torch.nan


def small_maker(source: SmallSet, cache: FeatureCache | None = None, **rule: Any) -> FeatureMaker:
    return FeatureMaker(
        source, FeaturePool(SMALL_HAND), ChannelFilter([51, 11]), LabelRule(**rule), cache
    )


def small_recipe(**changes: Any) -> Paper:
    return Paper(**({"num_features": 10, "penalties": (0.1, 1.0), "sample_bins": 50} | changes))


def refitted_scores(bins: TrainingBins, groups: torch.Tensor, penalty: float) -> torch.Tensor:
    """Of each bin, by the machine that is fitted without its group."""
    scores = torch.full((len(groups),), torch.nan, dtype=torch.float64)
    for group in groups.unique():
        own = groups == group
        others = (x[~own] for x in (bins.features, bins.is_slip, bins.weights) if x is not None)
        scores[own] = fit_machine(TrainingBins(*others), penalty)(bins.features[own])
    return scores
