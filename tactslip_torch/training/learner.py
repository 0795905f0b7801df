"""The Lightning module: one step fits a detector to all training bins, a test evaluates it."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
import torch
from torch import nn

from tactslip_torch.data.splits import ROLES
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.events import LatencyParts, RecordingEvents
from tactslip_torch.runtime import from_first_process, gathered, one_thread
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.baselines import Baselines
from tactslip_torch.training.bins import SampledBins
from tactslip_torch.training.datamodule import RecordingFeatures, TrainingBins
from tactslip_torch.training.evaluation import (
    EvaluatedBins,
    Outcomes,
    bin_scores,
    compared,
    evaluated_bins,
    event_numbers,
    events_by_rule,
)
from tactslip_torch.training.recipe import General, Recipe


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
        sample: of the training bins, after the training step.
        metadata: how it was made, such as the penalty.
        metrics: ``{"splits": ..., "baselines": ..., "comparison": ..., "events": ...}`` after a
            test.
        events: of each recording, by role and rule, after a test; to be pooled with others.
        outcomes: of the recordings that are held out, by role, after a test; to be compared with
            others.
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
        self.sample: SampledBins | None = None
        self.baselines: Baselines | None = None
        self.metadata: dict[str, Any] = {}
        self.metrics: dict[str, Any] = {}
        self.events: dict[str, dict[str, list[RecordingEvents]]] = {}
        self.outcomes: dict[str, Outcomes] = {}
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
        self.sample = fit.sample
        self.metadata = {"recipe": self.recipe.name} | fit.metadata
        info = self.metadata | {"calibration": fit.calibration}
        if self.with_baselines:
            sample = fit.sample
            with one_thread():
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

    @one_thread()  # a recording is small: threads would mostly wait
    def test_step(self, batch: RecordingFeatures, batch_idx: int) -> None:
        """Score the bins of one recording."""
        detector = self.detector
        assert detector is not None  # on_test_start
        place = {feature: index for index, feature in enumerate(self.pool.selected)}
        chosen = batch.features[:, [place[feature] for feature in detector.selected]].double()
        device = next(detector.buffers()).device  # Lightning may have moved it
        is_lost, is_valid = detector.sensed(batch.span.to(device), batch.run.to(device))
        scaled = detector.scaled(chosen.to(device), is_lost if is_lost.any() else None)
        says_slip = (detector.head(scaled) >= 0) & is_valid
        baselines = self.baselines(batch.features, scaled.cpu()) if self.baselines else {}
        parts = evaluated_bins(batch, says_slip.cpu(), is_valid.cpu(), baselines)
        for role, part in parts.items():
            self._evaluated[role].append(part)

    @one_thread()
    def on_test_epoch_end(self) -> None:
        """Turn decisions into metrics."""
        assert self.detector is not None  # on_test_start
        self.metrics, self.events, self.outcomes = {"splits": {}, "comparison": {}}, {}, {}
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
            if self.baselines and role != "train":
                self.outcomes[role] = Outcomes.of(parts)
                if found := compared([self.outcomes[role]], role):
                    self.metrics["comparison"][role] = found
            for name in ("accuracy", "balanced_accuracy"):
                if scores[name] is not None:
                    self.log(f"{role}/{name}", scores[name], batch_size=1)
        self.metrics["events"] = event_numbers(self.events)
        self.metrics["baselines"] = baselines
