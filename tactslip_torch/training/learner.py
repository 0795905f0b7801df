"""The Lightning module: two passes over training bins make a detector, a test pass evaluates it.

A test tells of decisions on labelled bins as scores and as events. Bins of a stroke in their order
are a short stream: a rule makes alarms of the decisions, and these find a slip or do not. The
detector was not made for these rules; they show what its errors would mean in use.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from tactslip_torch.data.labels import NO_POSITION
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import ROLES
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.abstention import KEY, abstention_of
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.events import (
    EventRules,
    LatencyParts,
    RecordingEvents,
    Watched,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.rules import KOfN, latch, latch_start
from tactslip_torch.report.metrics import (
    answer_counts,
    answer_metrics,
    bin_metrics,
    confusion_matrix,
    split_metrics,
)
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.abstention import Abstaining
from tactslip_torch.training.baselines import KEY as BASELINES
from tactslip_torch.training.baselines import Baselines
from tactslip_torch.training.datamodule import RecordingFeatures, SlipDataModule, Throughput
from tactslip_torch.training.fitting import (
    TrainingPass,
    from_first_process,
    of_all_processes,
    solve_metadata,
)
from tactslip_torch.training.recipe import FeatureSelection, Recipe
from tactslip_torch.training.selection import Plan, plan_detector

RULES: Mapping[str, KOfN] = MappingProxyType(
    {"first_transition": KOfN(1, 1), "two_of_three": KOfN(2, 3)}
)
"""From decisions to alarms: the paper's, every first slip bin behind a non-slip one, and two of the
last three. Either is armed again by a decision for which it does not hold."""

BINS_APART = "bins of one stroke are on both sides of this split"
"""Why a split by bin has no events."""


class EvaluatedBins(NamedTuple):
    """Decisions on bins of one recording that have one role.

    Attributes:
        bins: which they are; without features.
        says_slip: of the detector, ``[N]``, bool.
        baselines: decisions of baselines by name, ``[N]`` each.
        is_whole: whether these are all bins of the recording.
        answer: slip, non-slip or none (``model.abstention``), ``[N]``; None of a detector that
            never abstains.
    """

    bins: RecordingFeatures
    says_slip: Tensor
    baselines: Mapping[str, Tensor]
    is_whole: bool
    answer: Tensor | None = None


def evaluated_bins(
    batch: RecordingFeatures,
    says_slip: Tensor,
    baselines: Mapping[str, Tensor],
    answer: Tensor | None = None,
) -> dict[str, EvaluatedBins]:
    """Decisions ``[N]`` on the bins of a recording, for each role that some of them have."""
    light = batch._replace(features=batch.features[:, :0])
    return {
        role: EvaluatedBins(
            light.of(mask),
            says_slip[mask],
            {name: decisions[mask] for name, decisions in baselines.items()},
            bool(mask.all()),
            None if answer is None else answer[mask],
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
    """What each of ``RULES`` makes of the bins; no recordings where a split is by bin.

    A rule starts anew with every stroke and every unbroken stretch of bins of no stroke. Watched is
    from one hop before the first decision of such a stretch to the last one.
    """
    if not all(part.is_whole for part in parts):
        return {name: [] for name in RULES}
    stretches = [(part, rows) for part in parts for rows in _stretches(part.bins)]
    says_slip = pad_sequence([part.says_slip[rows] for part, rows in stretches], batch_first=True)
    llr = torch.where(says_slip, 1.0, -1.0)  # [streams, most bins]; what is padded changes nothing
    events = {}
    for name, rule in RULES.items():
        statistic, _ = rule.scan(llr, rule.start(llr[:, 0]))
        start = latch_start(llr[:, 0])
        is_alarm, is_on, _ = latch(statistic, 0.0, rearm=1, refractory=0, state=start)
        streams: dict[RecordingId, list[_Stream]] = {}
        for (part, rows), alarms, status in zip(stretches, is_alarm, is_on, strict=True):
            available_s = part.bins.ends_s[rows] + latency.look_ahead_s
            stream = _Stream(available_s, alarms[: len(rows)], status[: len(rows)])
            streams.setdefault(part.bins.recording, []).append(stream)
        events[name] = [
            recording_events(
                _watched(part, streams[part.bins.recording], latency), EventRules(), latency
            )
            for part in parts
        ]
    return events


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


class _Stream(NamedTuple):
    """Decisions in their order: when each is available, and what a rule made of them, ``[T]``."""

    available_s: Tensor
    is_alarm: Tensor
    is_on: Tensor


def _stretches(bins: RecordingFeatures) -> list[Tensor]:
    """The rows of each stroke, and of each unbroken stretch of bins of no stroke."""
    rows = torch.arange(len(bins.stroke))
    is_apart = bins.ends_s.diff() > bins.hop_s + 1e-6
    is_new = (bins.stroke.diff() != 0) | ((bins.stroke[1:] < 0) & is_apart)
    return list(rows.tensor_split(rows[1:][is_new]))


def _watched(part: EvaluatedBins, streams: Sequence[_Stream], latency: LatencyParts) -> Watched:
    """A recording as the detector saw it through a rule."""
    bins = part.bins
    alarms: list[tuple[float, float]] = []
    seen: list[tuple[float, float]] = []
    for stream in sorted(streams, key=lambda stream: float(stream.available_s[0])):
        available_s = stream.available_s.tolist()
        ended = (~stream.is_on).nonzero().flatten().tolist()
        for raised in stream.is_alarm.nonzero().flatten().tolist():
            end = next((available_s[place] for place in ended if place > raised), math.inf)
            alarms.append((available_s[raised], end))
        before = seen[-1][1] if seen else -math.inf  # a hop may be longer than a bin
        seen.append((max(available_s[0] - bins.hop_s, before), available_s[-1]))
    positive = bins.ends_s[part.says_slip] + latency.look_ahead_s
    of = bins.stroke[part.says_slip]
    first = []
    for number, stroke in enumerate(bins.strokes):
        later = positive[(of == number) & (positive >= stroke.onset_s)]
        first.append(float(later.min()) if len(later) else math.nan)
    return Watched(
        recording=str(bins.recording),
        material=bins.recording.material,
        scene=bins.recording.scene,
        duration_s=seen[-1][1],
        alarms_s=tuple(alarm for alarm, _ in alarms),
        onset_estimates_s=(),
        onsets_s=tuple(stroke.onset_s for stroke in bins.strokes),
        sliding_s=tuple((stroke.onset_s, stroke.slide_end_s) for stroke in bins.strokes),
        speeds_mm_s=tuple(stroke.speed_mm_s for stroke in bins.strokes),
        first_positive_s=tuple(first),
        watched_s=tuple(seen),
        alarm_ends_s=tuple(end for _, end in alarms),
    )


class SlipLearner(L.LightningModule):
    """Learns a ``SlipDetector`` in two epochs and evaluates it; nothing is optimised by steps.

    Args:
        pool: the features of the bins it is given.
        channel_filter: of those bins, kept with the detector.
        recipe: how the machine is made.
        detector: a finished one, to be evaluated only.
        abstaining: how thresholds for abstaining are set; by default none are.
        selection: features and ranges that were chosen elsewhere; by default the recipe finds them.
        with_baselines: fit baselines on the sample of training bins, to be evaluated beside.

    Attributes:
        detector: the result, after the second epoch.
        metadata: what the recipe found, such as the penalty.
        metrics: ``{"splits": ..., "baselines": ..., "events": ...}`` after a test; ``"answers"`` of
            a detector that may abstain.
        events: what the test found in each recording, by role and rule; to be pooled with others.
        seconds: time of each stage of the fit.
    """

    def __init__(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        recipe: Recipe | None = None,
        detector: SlipDetector | None = None,
        abstaining: Abstaining | None = None,
        selection: FeatureSelection | None = None,
        *,
        with_baselines: bool = True,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.pool = pool
        self.channel_filter = channel_filter
        self.recipe = recipe or Recipe()
        self.abstaining = abstaining or Abstaining()
        self.recipe.allowed(pool)  # refused before any work
        self._selection = selection
        self.detector = detector
        self.with_baselines = with_baselines
        self.baselines: Baselines | None = None
        if detector and BASELINES in detector.info:
            self.baselines = Baselines.from_dict(detector.pool, detector.info[BASELINES])
        self.metadata: dict[str, Any] = {}
        self.metrics: dict[str, Any] = {}
        self.events: dict[str, dict[str, list[RecordingEvents]]] = {}
        self.seconds: dict[str, float] = {}
        self._throughput = Throughput()
        self._pass_started = 0.0
        self._num_threads = torch.get_num_threads()
        self._survey = Survey(len(pool.names), self.recipe.sample_bins)
        self._plan: Plan | None = None
        self._second: TrainingPass | None = None
        self._is_resumed = False
        self._evaluated: dict[str, list[EvaluatedBins]] = {}
        # nothing is trained by it: torch's DistributedDataParallel refuses a module without one
        self._anchor = nn.Parameter(torch.zeros(()))

    def configure_optimizers(self) -> list[Any]:
        """No optimiser: the fit is a solve."""
        return []

    def on_train_epoch_start(self) -> None:
        """Start the clock of a pass; the processors belong to those who make features."""
        self._pass_started = time.perf_counter()
        if self._plan is not None:
            self._second = TrainingPass(self._plan)
        self._num_threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def training_step(self, batch: RecordingFeatures, batch_idx: int) -> None:
        """Survey in the first epoch, gather what the plan needs in the second."""
        if not batch:  # NOTHING
            return
        self._throughput.add(batch)
        mask = batch.roles["train"]
        features, is_slip = batch.features[mask], batch.is_slip[mask]
        if self._second is None or self._is_resumed:
            stratum = self.recipe.stratum(batch.recording)
            self._survey.update(str(batch.recording), stratum, features, is_slip)
        if self._second is not None:
            self._second.update(str(batch.recording), features, is_slip, batch.recording.scene)

    def on_train_epoch_end(self) -> None:
        """Plan after the first epoch, solve after the second."""
        torch.set_num_threads(self._num_threads)
        passed = time.perf_counter()
        name = "survey_pass" if self._second is None else "training_pass"
        self.seconds[name] = passed - self._pass_started
        if self._second is None or self._is_resumed:
            parts = of_all_processes(self._survey)
            self._survey = parts[0]
            for part in parts[1:]:
                self._survey.merge(part)
        if self._second is not None:
            self._second.merge_processes()
            self._solve(self._second)
            return
        self._plan = from_first_process(self._planned)
        self.seconds["validation"] = time.perf_counter() - passed
        if self._is_single_pass:
            self._second = self._sampled()
            self._solve(self._second)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep what the first pass planned, and of which bins."""
        if self._plan is None:
            return
        checkpoint["fingerprint"] = self._fingerprint()
        checkpoint["plan"] = self._plan.to_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up what ``on_save_checkpoint`` kept.

        Raises:
            ValueError: if it was gathered from other recordings than those to be trained on.
        """
        if checkpoint.get("fingerprint") != self._fingerprint():
            raise ValueError(
                "the checkpoint was gathered from other training bins; resume with the code, "
                "data, labels, split, recipe and seed it was made with"
            )
        self._plan = Plan.from_dict(checkpoint["plan"], self.recipe, self.pool)
        self._is_resumed = True  # baselines need the first pass's sample: drawn in the second

    def on_test_start(self) -> None:
        """Forget what an earlier test found.

        Raises:
            ValueError: if there is no detector yet.
        """
        if self.detector is None:
            raise ValueError("nothing to test: fit first, or give the learner a detector")
        self._evaluated = {role: [] for role in ROLES}
        self._num_threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def test_step(self, batch: RecordingFeatures, batch_idx: int) -> None:
        """Score the bins of one recording."""
        assert self.detector is not None  # on_test_start
        self._throughput.add(batch)
        chosen = batch.features[:, list(self.detector.selected)].double()
        device = next(self.detector.buffers()).device  # Lightning may have moved it
        scaled = self.detector.scaled(chosen.to(device))
        score = self.detector.head(scaled).cpu()
        says_slip = score >= 0
        baselines = self.baselines(batch.features, scaled.cpu()) if self.baselines else {}
        abstention = abstention_of(self.detector)
        answer = abstention.answer(score) if abstention else None
        for role, part in evaluated_bins(batch, says_slip, baselines, answer).items():
            self._evaluated[role].append(part)

    def on_test_epoch_end(self) -> None:
        """Turn decisions into metrics."""
        assert self.detector is not None  # on_test_start
        torch.set_num_threads(self._num_threads)
        self.metrics = {"splits": {}}
        self.events = {}
        baselines = self.baselines.metadata() if self.baselines else {}
        for about in baselines.values():
            about["splits"] = {}
        rate_hz = self.detector.pool.sample_rate_hz
        latency = LatencyParts(
            self.detector.look_ahead / rate_hz, self.detector.pool.bin_samples / rate_hz
        )
        shares = of_all_processes(self._evaluated)
        for role in ROLES:
            parts = [part for share in shares for part in share[role]]
            parts.sort(key=lambda part: part.bins.recording)
            if not parts:
                continue
            scores, of_baselines = bin_scores(parts)
            for name, found in of_baselines.items():
                baselines[name]["splits"][role] = found
            self.metrics["splits"][role] = scores
            self.events[role] = events_by_rule(parts, latency)
            if abstention := abstention_of(self.detector):
                counts = {
                    str(part.bins.recording): answer_counts(part.bins.is_slip, part.answer)
                    for part in parts
                    if part.answer is not None
                }
                answers = answer_metrics(counts, abstention.coverage)
                self.metrics.setdefault("answers", {})[role] = answers
            for name in ("accuracy", "balanced_accuracy"):
                if scores[name] is not None:
                    self.log(f"{role}/{name}", scores[name], batch_size=1)
        self.metrics["events"] = event_numbers(self.events)
        self.metrics["baselines"] = baselines

    @property
    def worker_seconds(self) -> dict[str, float]:
        """What workers spent on each stage of making features, summed over them."""
        return self._throughput.seconds

    @property
    def plan(self) -> Plan:
        """What the first pass decided."""
        assert self._plan is not None  # fitted
        return self._plan

    @property
    def gathered(self) -> tuple[TrainingPass, SampledBins]:
        """What the machine was solved from, and the first pass's sample of its bins."""
        assert self._second is not None  # fitted
        return self._second, self._survey.sample.bins()

    @property
    def _is_single_pass(self) -> bool:
        """``fast_dev_run`` ends after one epoch, so that one does the work of both passes."""
        return bool(getattr(self.trainer, "fast_dev_run", False))

    def _fingerprint(self) -> str:
        data: SlipDataModule = self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning's
        return f"{data.fingerprint()} by {self.recipe}, {self.abstaining}"

    def _planned(self) -> Plan:
        is_settled = self._selection is not None
        parts = (self.recipe, self._survey, self.pool, self._selection)
        plan = plan_detector(*parts, is_settled=is_settled, show=True)
        return self.abstaining.settle(plan, self._survey.sample.bins())

    def _sampled(self) -> TrainingPass:
        """What a second pass would gather, of the bins the first one sampled."""
        sample = self._survey.sample.bins()
        gathered = TrainingPass(replace(self.plan, fractions=(1.0, 1.0)))
        gathered.update("sample", sample.features, sample.is_slip)
        return gathered

    def _solve(self, gathered: TrainingPass) -> None:
        started = time.perf_counter()
        plan = gathered.plan
        head = from_first_process(gathered.solve)
        self.log("penalty", plan.penalty, batch_size=1)
        self.metadata = plan.metadata | {
            "validation": plan.validation,
            "nested_validation": plan.nested,
            "head": head.cost._asdict(),
            "solve": solve_metadata(head),
            "feature_filter": plan.feature_filter,
        }
        solved = time.perf_counter()
        self.seconds["solve"] = solved - started
        info = self.metadata | {"calibration": plan.calibration, KEY: plan.abstain}
        if self.with_baselines:
            sample = self._survey.sample.bins()
            self.baselines = from_first_process(
                lambda: Baselines.fit(self.pool, plan.selection(sample.features), sample)
            )
            self.seconds["baselines"] = time.perf_counter() - solved
            info[BASELINES] = self.baselines.to_dict()
        self.detector = plan.detector(self.pool, self.channel_filter, head, info)

    def rates(self) -> dict[str, str]:
        """How fast one worker goes through each stage, for the progress bar."""
        return self._throughput.rates()
