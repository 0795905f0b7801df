"""The Lightning module: one step fits a detector to all training bins, a test evaluates it."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from tactslip_torch.data.splits import ROLES
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector
<<<<<<< HEAD
from tactslip_torch.onset.events import LatencyParts, RecordingEvents
=======
from tactslip_torch.onset.events import (
    EventRecord,
    EventRules,
    LatencyParts,
    RecordingEvents,
    first_releases,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.package_files import CHECKPOINT, DAMAGE_ERRORS
from tactslip_torch.report.metrics import (
    bin_metrics,
    confusion_matrix,
    split_metrics,
)
>>>>>>> main
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.baselines import Baselines
from tactslip_torch.training.datamodule import RecordingFeatures, TrainingBins
from tactslip_torch.training.evaluation import (
    EvaluatedBins,
    bin_scores,
    evaluated_bins,
    event_numbers,
    events_by_rule,
)
<<<<<<< HEAD
from tactslip_torch.training.recipe import General, Recipe, from_first_process, gathered
=======
from tactslip_torch.training.recipe import (
    FeatureThreshold,
    Recipe,
    best_threshold,
    has_both_classes,
    sample_groups,
)

Value = TypeVar("Value")

RULES: Mapping[str, tuple[int, int]] = MappingProxyType(
    {"first_transition": (1, 1), "two_of_three": (2, 3)}
)
"""From decisions to alarms, each k of the last n: the paper's, every first slip bin after a
non-slip one, and two of three. Either is armed again by a decision for which it does not hold."""

BINS_APART = "bins of one stroke are on both sides of this split"
"""Why a split by bin has no events."""


class EvaluatedBins(NamedTuple):
    """Decisions on bins of one recording that have one role.

    Attributes:
        bins: which they are; without features.
        says_slip: of the detector, ``[N]``, bool.
        baselines: decisions of baselines by name, ``[N]`` each.
        is_whole: whether these are all bins of the recording.
    """

    bins: RecordingFeatures
    says_slip: Tensor
    baselines: Mapping[str, Tensor]
    is_whole: bool


def evaluated_bins(
    batch: RecordingFeatures,
    says_slip: Tensor,
    baselines: Mapping[str, Tensor],
) -> dict[str, EvaluatedBins]:
    """Decisions ``[N]`` on the bins of a recording, for each role that some of them have."""
    light = batch._replace(features=batch.features[:, :0])
    return {
        role: EvaluatedBins(
            light.of(mask),
            says_slip[mask],
            {name: decisions[mask] for name, decisions in baselines.items()},
            bool(mask.all()),
        )
        for role, mask in batch.roles.items()
        if bool(mask.any())
    }


def bin_scores(parts: Sequence[EvaluatedBins]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """``bin_metrics`` of the detector, and ``split_metrics`` of each baseline, on all bins."""
    truth = torch.cat([part.bins.is_slip for part in parts])
    places = torch.cat([part.bins.position for part in parts]).tolist()
    scores = bin_metrics(
        truth,
        torch.cat([part.says_slip for part in parts]),
        [part.bins.recording.material for part in parts for _ in part.says_slip],
        torch.cat([part.bins.speed_mm_s for part in parts]).tolist(),
        [part.bins.recording.scene for part in parts for _ in part.says_slip],
        [None if place == NO_POSITION else place for place in places],
    )
    return scores, {
        name: split_metrics(
            confusion_matrix(truth, torch.cat([part.baselines[name] for part in parts]))
        )
        for name in parts[0].baselines
    }


def events_by_rule(
    parts: Sequence[EvaluatedBins], latency: LatencyParts
) -> dict[str, list[RecordingEvents]]:
    """What each of ``RULES`` makes of the bins; no recordings where a split is by bin."""
    if not all(part.is_whole for part in parts):
        return {name: [] for name in RULES}
    return {
        name: [
            recording_events(_watched(part, k, n, latency), EventRules(), latency) for part in parts
        ]
        for name, (k, n) in RULES.items()
    }


def event_numbers(
    events: Mapping[str, Mapping[str, Sequence[RecordingEvents]]],
) -> dict[str, dict[str, Any]]:
    """``pooled_metrics`` by role and rule; of no recordings with the ``reason``, all None."""
    return {
        role: {
            name: pooled_metrics(own) | ({} if own else {"reason": BINS_APART})
            for name, own in by_rule.items()
        }
        for role, by_rule in events.items()
    }


def _watched(part: EvaluatedBins, k: int, n: int, latency: LatencyParts) -> EventRecord:
    """A recording as the detector saw it through an alarm of k of the last n decisions.

    It starts anew with every stroke and every unbroken stretch of bins of no stroke, whatever order
    their labels put them in. Watched is from one hop before the first decision of such a stretch to
    the last one.
    """
    bins, times = part.bins, part.bins.times
    order = np.lexsort((bins.ends_s.numpy(), bins.stroke.numpy() < 0))
    available_s = (bins.ends_s + latency.look_ahead_s).numpy()[order]
    says_slip, stroke = part.says_slip.numpy()[order], bins.stroke.numpy()[order]
    is_apart = np.diff(available_s) > bins.hop_s + 1e-6
    is_new = (np.diff(stroke) != 0) | ((stroke[1:] < 0) & is_apart)
    stretches = np.split(np.arange(len(stroke)), np.flatnonzero(is_new) + 1)
    alarms: list[tuple[float, float]] = []
    seen: list[tuple[float, float]] = []
    for rows in sorted(stretches, key=lambda rows: float(available_s[rows[0]])):
        hops_s = available_s[rows]
        is_on = np.convolve(says_slip[rows], np.ones(n))[: len(rows)] > k - 0.5
        raised = np.flatnonzero(is_on & ~np.append(False, is_on[:-1]))
        off = np.append(np.flatnonzero(~is_on), len(rows))
        ends = np.append(hops_s, math.inf)[off[np.searchsorted(off, raised)]]
        alarms += zip(hops_s[raised].tolist(), ends.tolist(), strict=True)
        before = seen[-1][1] if seen else -math.inf  # a hop may be longer than a bin
        seen.append((max(float(hops_s[0]) - bins.hop_s, before), float(hops_s[-1])))
    first = []
    for number, release_s in enumerate(first_releases(times.onsets_s, times.released_s)):
        is_later = says_slip & (stroke == number) & (available_s >= release_s)
        first.append(next(iter(available_s[is_later].tolist()), math.nan))
    return EventRecord(
        recording=str(bins.recording),
        material=bins.recording.material,
        scene=bins.recording.scene,
        duration_s=seen[-1][1],
        alarms_s=tuple(alarm for alarm, _ in alarms),
        onset_estimates_s=(),
        onsets_s=times.onsets_s,
        sliding_s=tuple(
            (o, end) for o, (_, end) in zip(times.onsets_s, times.sliding_s, strict=True)
        ),
        speeds_mm_s=times.speeds_mm_s,
        first_positive_s=tuple(first),
        watched_s=tuple(seen),
        alarm_ends_s=tuple(end for _, end in alarms),
        released_s=times.released_s,
    )
>>>>>>> main


class SlipLearner(L.LightningModule):
    """Fits a ``SlipDetector`` in one step and evaluates it; nothing is optimised by gradients.

    Args:
        pool: the features of the bins it is given, whole or a selection.
        channel_filter: of those bins, kept with the detector.
        recipe: how the machine is made.
        detector: a finished one, to be evaluated only.
        with_baselines: fit baselines on the sample of training bins, to be evaluated beside.

    Attributes:
        detector: the result, after the training step.
        metadata: how it was made, such as the penalty.
        metrics: ``{"splits": ..., "baselines": ..., "events": ...}`` after a test.
        events: of each recording, by role and rule, after a test; to be pooled with others.
        seconds: time of each stage of the fit.

    Raises:
        ValueError: if the recipe allows no feature of the pool.
    """

    def __init__(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        recipe: Recipe | None = None,
        detector: SlipDetector | None = None,
        *,
        with_baselines: bool = True,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.pool = pool
        self.channel_filter = channel_filter
        self.recipe = recipe or General()
        if detector is None:
            self.recipe.allowed(pool)  # refused before any work
        self.detector = detector
        self.with_baselines = with_baselines
        self.baselines: Baselines | None = None
        self.metadata: dict[str, Any] = {}
        self.metrics: dict[str, Any] = {}
        self.events: dict[str, dict[str, list[RecordingEvents]]] = {}
        self.seconds: dict[str, float] = {}
        self._evaluated: dict[str, list[EvaluatedBins]] = {}
        # nothing is trained by it: torch's DistributedDataParallel refuses a module without one
        self._anchor = nn.Parameter(torch.zeros(()))

    def configure_optimizers(self) -> list[Any]:
        """No optimiser: the fit is a solve."""
        return []

    @torch.no_grad()
    def training_step(self, batch: TrainingBins, batch_idx: int) -> None:
        """Fit to the training bins of this process and of those beside it."""
        started = time.perf_counter()
        fit = self.recipe.fit(batch, self.pool, show=True)
        fitted = time.perf_counter()
        self.seconds["fit"] = fitted - started
        self.log("penalty", fit.penalty, batch_size=1)
        self.metadata = {"recipe": self.recipe.name} | fit.metadata
        info = self.metadata | {"calibration": fit.calibration}
        if self.with_baselines:
            sample = fit.sample
            self.baselines = from_first_process(
                lambda: Baselines(self.pool, fit.selection(sample.features), sample)
            )
            self.seconds["baselines"] = time.perf_counter() - fitted
        self.detector = fit.detector(self.pool, self.channel_filter, info)

    def on_test_start(self) -> None:
        """Forget an earlier test.

        Raises:
            ValueError: if there is no detector yet.
        """
        if self.detector is None:
            raise ValueError("nothing to test: fit first, or give the learner a detector")
        self._evaluated = {role: [] for role in ROLES}

    def test_step(self, batch: RecordingFeatures, batch_idx: int) -> None:
        """Score the bins of one recording."""
        detector = self.detector
        assert detector is not None  # on_test_start
        place = {feature: index for index, feature in enumerate(self.pool.selected)}
        chosen = batch.features[:, [place[feature] for feature in detector.selected]].double()
        device = next(detector.buffers()).device  # Lightning may have moved it
        scaled = detector.scaled(chosen.to(device))
        score: Tensor = detector.head(scaled).cpu()
        baselines = self.baselines(batch.features, scaled.cpu()) if self.baselines else {}
        for role, part in evaluated_bins(batch, score >= 0, baselines).items():
            self._evaluated[role].append(part)

    def on_test_epoch_end(self) -> None:
        """Turn decisions into metrics."""
        assert self.detector is not None  # on_test_start
        self.metrics, self.events = {"splits": {}}, {}
        known = self.baselines.metadata if self.baselines else {}
        baselines = {name: metadata | {"splits": {}} for name, metadata in known.items()}
        pool = self.detector.pool
        latency = LatencyParts(
            self.detector.look_ahead / pool.sample_rate_hz, pool.bin_samples / pool.sample_rate_hz
        )
        of_processes = gathered(self._evaluated)
        for role in ROLES:
            parts = [part for own in of_processes for part in own[role]]
            parts.sort(key=lambda part: part.bins.recording)
            if not parts:
                continue
            scores, of_baselines = bin_scores(parts)
            for name, found in of_baselines.items():
                baselines[name]["splits"][role] = found
            self.metrics["splits"][role] = scores
            self.events[role] = events_by_rule(parts, latency)
            for name in ("accuracy", "balanced_accuracy"):
                if scores[name] is not None:
                    self.log(f"{role}/{name}", scores[name], batch_size=1)
        self.metrics["events"] = event_numbers(self.events)
        self.metrics["baselines"] = baselines
