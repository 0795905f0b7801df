"""The Lightning module: two passes over training bins make a detector, a test pass evaluates it.

A test tells of decisions on labelled bins as scores and as events. Bins of a stroke in their order
are a short stream: a rule makes alarms of the decisions, and these find a slip or do not. The
detector was not made for these rules; they show what its errors would mean in use.

A result means little without what a simpler method reaches on the same bins. So four ``Baselines``
are fitted on training bins and evaluated beside the detector, with both classes balanced and each
sampled bin weighted by the number of bins it stands for:

- ``best_pooled_number``: the statistic over channels of one descriptor that separates the classes
  best, and its threshold;
- ``logistic_regression``: on the scaled columns of the detector;
- ``logistic_regression_simple``: on mean, standard deviation and rms of each channel, and their
  logarithms;
- ``random_forest_simple``: on mean, standard deviation and rms of each channel.

``logistic_regression`` has the features that the recipe lets the detector have, the others those
of the whole pool.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import lightning as L
import numpy as np
import torch
import torch.distributed
from numpy.typing import NDArray
from torch import Tensor, nn

from tactslip_torch.data.labels import NO_POSITION
from tactslip_torch.data.splits import ROLES
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool, is_rounding
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.model.detector import SlipDetector
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
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import RecordingFeatures, SlipDataModule
from tactslip_torch.training.plan import (
    Plan,
    TrainingPass,
    plan_detector,
    solve_metadata,
)
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


class SlipLearner(L.LightningModule):
    """Learns a ``SlipDetector`` in two epochs and evaluates it; nothing is optimised by steps.

    Args:
        pool: the features of the bins it is given.
        channel_filter: of those bins, kept with the detector.
        recipe: how the machine is made.
        detector: a finished one, to be evaluated only.
        with_baselines: fit baselines on the sample of training bins, to be evaluated beside.

    Attributes:
        detector: the result, after the second epoch.
        metadata: what the recipe found, such as the penalty.
        metrics: ``{"splits": ..., "baselines": ..., "events": ...}`` after a test.
        events: what the test found in each recording, by role and rule; to be pooled with others.
        seconds: time of each stage of the fit.
        worker_seconds: what workers spent on each stage of making features, summed over them.
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
        self.recipe = recipe or Recipe()
        self.recipe.allowed(pool)  # refused before any work
        self.detector = detector
        self.with_baselines = with_baselines
        self.baselines: Baselines | None = None
        if detector and BASELINES in detector.info:
            self.baselines = Baselines.from_dict(detector.pool, detector.info[BASELINES])
        self.metadata: dict[str, Any] = {}
        self.metrics: dict[str, Any] = {}
        self.events: dict[str, dict[str, list[RecordingEvents]]] = {}
        self.seconds: dict[str, float] = {}
        self.worker_seconds = Counter[str]()
        self._pass_started = 0.0
        self._num_threads = torch.get_num_threads()
        self._statistics = TrainingStatistics(len(pool.names), self.recipe.sample_bins)
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
        """Gather statistics in the first epoch, what the plan needs in the second."""
        if not batch:  # NOTHING
            return
        self.worker_seconds.update(batch.seconds)
        mask = batch.roles["train"]
        features, is_slip = batch.features[mask], batch.is_slip[mask]
        if self._second is None or self._is_resumed:
            stratum = self.recipe.stratum(batch.recording)
            self._statistics.update(
                str(batch.recording), stratum, features, is_slip, batch.longest_run
            )
        if self._second is not None:
            self._second.update(str(batch.recording), features, is_slip, batch.recording.scene)

    def on_train_epoch_end(self) -> None:
        """Plan after the first epoch, solve after the second."""
        torch.set_num_threads(self._num_threads)
        passed = time.perf_counter()
        name = "statistics_pass" if self._second is None else "training_pass"
        self.seconds[name] = passed - self._pass_started
        if self._second is None or self._is_resumed:
            self._statistics = _merged(self._statistics)
        if self._second is not None:
            _merge_processes(self._second)
            self._solve(self._second)
            return
        self._plan = _from_first_process(self._planned)
        self.seconds["validation"] = time.perf_counter() - passed
        if getattr(self.trainer, "fast_dev_run", False):  # ends after one epoch
            sample = self._statistics.sample.bins()
            self._second = TrainingPass(replace(self._plan, fractions=(1.0, 1.0)))
            self._second.update("sample", sample.features, sample.is_slip)
            self._solve(self._second)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep what the first pass planned, and of which bins."""
        if self._plan is None:
            return
        checkpoint["format"] = CHECKPOINT
        checkpoint["fingerprint"] = self._fingerprint()
        checkpoint["plan"] = self._plan.to_dict()
        checkpoint["state_dict"] = {}  # Lightning's own adds nothing

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up what ``on_save_checkpoint`` kept.

        Raises:
            ValueError: if it was gathered from other recordings than those to be trained on, or
                its plan is none.
        """
        checkpoint["state_dict"] = self.state_dict()
        if checkpoint.get("fingerprint") != self._fingerprint():
            raise ValueError(
                "the checkpoint was gathered from other training bins; resume with the code, "
                "data, labels, split, recipe and seed it was made with"
            )
        try:
            self._plan = Plan.from_dict(checkpoint["plan"], self.recipe, self.pool)
        except DAMAGE_ERRORS as error:
            said = str(error).splitlines()[0]
            raise ValueError(f"the checkpoint is damaged: {said}; train again") from error
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
        self.worker_seconds.update(batch.seconds)
        chosen = batch.features[:, list(self.detector.selected)].double()
        device = next(self.detector.buffers()).device  # Lightning may have moved it
        scaled = self.detector.scaled(chosen.to(device))
        score = self.detector.head(scaled).cpu()
        baselines = self.baselines(batch.features, scaled.cpu()) if self.baselines else {}
        for role, part in evaluated_bins(batch, score >= 0, baselines).items():
            self._evaluated[role].append(part)

    def on_test_epoch_end(self) -> None:
        """Turn decisions into metrics."""
        assert self.detector is not None  # on_test_start
        torch.set_num_threads(self._num_threads)
        self.metrics, self.events = {"splits": {}}, {}
        baselines = self.baselines.metadata() if self.baselines else {}
        for about in baselines.values():
            about["splits"] = {}
        pool = self.detector.pool
        latency = LatencyParts(
            self.detector.look_ahead / pool.sample_rate_hz, pool.bin_samples / pool.sample_rate_hz
        )
        of_processes = _of_all_processes(self._evaluated)
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

    @property
    def plan(self) -> Plan:
        """What the first pass decided."""
        assert self._plan is not None  # fitted
        return self._plan

    def _fingerprint(self) -> str:
        data: SlipDataModule = self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning's
        return f"{data.fingerprint()} by {self.recipe}"

    def _planned(self) -> Plan:
        return plan_detector(self.recipe, self._statistics, self.pool, show=True)

    def _solve(self, gathered: TrainingPass) -> None:
        started = time.perf_counter()
        plan = gathered.plan
        head = _from_first_process(gathered.solve)
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
        info = self.metadata | {"calibration": plan.calibration}
        if self.with_baselines:
            sample = self._statistics.sample.bins()
            self.baselines = _from_first_process(
                lambda: Baselines.fit(self.pool, plan.selection(sample.features), sample)
            )
            self.seconds["baselines"] = time.perf_counter() - solved
            info[BASELINES] = self.baselines.to_dict()
        self.detector = plan.detector(self.pool, self.channel_filter, head, info)


# Processes of a distributed fit ------------------------------------------------------------------


def _num_processes() -> int:
    ready = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if ready else 1


def _of_all_processes(own: Value) -> list[Value]:
    """What every process holds, in the order of their ranks."""
    values: list[Any] = [own] * _num_processes()
    if len(values) > 1:
        torch.distributed.all_gather_object(values, own)
    return values


def _from_first_process(make: Callable[[], Value]) -> Value:
    """What the first process makes, in every process; its error as well, so that none waits."""
    if _num_processes() == 1:
        return make()
    box: list[Any] = [None, None]
    if torch.distributed.get_rank() == 0:
        try:
            box[0] = make()
        except Exception as error:
            box[1] = error
    torch.distributed.broadcast_object_list(box)
    if box[1] is not None:
        raise box[1]
    made: Value = box[0]
    return made


def _merged(own: Value) -> Value:
    """What every process holds, put together in the order of their ranks."""
    values: list[Any] = _of_all_processes(own)
    for other in values[1:]:
        values[0].merge(other)
    whole: Value = values[0]
    return whole


def _merge_processes(gathered: TrainingPass) -> None:
    """Put together what every process gathered; refuses a recording that two of them saw."""
    stats = gathered.stats
    holder = gathered if stats is None else stats
    holder.seen_batches = _merged(holder.seen_batches)
    for bins in _of_all_processes(gathered.bins):
        gathered.bins |= bins
    if stats is not None and _num_processes() > 1:
        for total in (stats.sums, stats.count):
            torch.distributed.all_reduce(total)


POOLED_NUMBER = "best_pooled_number"
BASELINES = "baselines"
"""Where a detector's ``info`` has the best pooled number."""
CONSTANT_BINS = 1200  # at most, of which compression learns its medians
NUM_TREES = 100  # as scikit-learn has it
MOST_FOLDS = 6  # with 3, C of simple statistics costs two points on held-out materials
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
"""scikit-learn's ``C`` of logistic regression, chosen by leaving groups out, strongest first."""
WIDE, WIDE_PENALTY = 256, 1e-2
"""With more columns than this, choosing would take longer than the detector's own validation: ``C``
is fixed. On 672 pooled columns of the simulated hand 1e-3 to 1 differ by .3 points."""
LOG_FLOOR = 1e-2  # of the training median of a magnitude, below which its logarithm levels out


class SimpleStatistics:
    """Mean, standard deviation and rms of each channel's filtered bin, out of pool features.

    Of a fast channel the pool has wavelet branches alone. The first approximation and detail add up
    to the bin, ``x = A1 + D1``, so ``mean(x) = mean(A1) + mean(D1)``, and with the correlation
    ``r`` of each with ``x``, ``std(x) = r(A1) std(A1) + r(D1) std(D1)``.

    Args:
        pool: of the features.
    """

    def __init__(self, pool: FeaturePool) -> None:
        def of(channels: tuple[int, ...], component: str, descriptor: str) -> list[int]:
            hand = pool.hand.names
            return pool.places(
                FeatureName(hand[c], component, "time", descriptor) for c in channels
            )

        self.num_samples = pool.bin_samples
        slow, fast = pool.hand.slow, pool.hand.fast
        self._slow = [of(slow, "raw", d) for d in ("mean", "std", "energy")]
        self._fast = {
            d: [of(fast, branch, d) for branch in ("A1", "D1")]
            for d in ("mean", "std", "correlation")
        }

    def __call__(self, features: Tensor) -> Tensor:
        """All means, then standard deviations, then rms, of slow channels and then of fast ones.

        Standard deviations have ``n - 1`` in the denominator, rms ``n``.

        Shape:
            - features: ``[N, F]``, of the whole pool; output: ``[N, 3 C]``, float64, in the unit of
              the samples
        """
        x, num = features.double(), self.num_samples
        mean, std, energy = (x[:, places] for places in self._slow)
        parts = {
            d: torch.stack([x[:, places] for places in of]) for d, of in self._fast.items()
        }  # [2, N, fast channels]
        fast_mean = parts["mean"].sum(0)
        fast_std = (parts["correlation"] * parts["std"]).sum(0).clamp(min=0.0)
        fast_rms = (fast_mean.square() + fast_std.square() * ((num - 1) / num)).sqrt()
        rms = (energy / num).sqrt()
        return torch.cat([mean, fast_mean, std, fast_std, rms, fast_rms], 1)


def _fit_regression(columns: Tensor, sample: SampledBins, *, with_logs: bool = False) -> Any:
    """scikit-learn's logistic regression of standardised columns ``[n, K]`` of sampled bins.

    Its ``C`` is chosen by leaving groups out unless columns are many: the best mean balanced
    accuracy, the strongest penalty of equals. ``with_logs`` adds the logarithm of each column's
    magnitude: amplitudes range over decades, so logarithms are worth seven points on the simulated
    hand.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import GridSearchCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer, StandardScaler

    before = make_pipeline(StandardScaler())
    if with_logs:
        floor = LOG_FLOOR * columns.abs().median(0).values
        floor = torch.where(floor > 0, floor, 1.0)
        logs = FunctionTransformer(_with_logs, kw_args={"floor": floor.numpy()})
        before = make_pipeline(logs, StandardScaler())
    z = before.fit_transform(columns.double().numpy())
    groups, names = sample_groups(sample)
    num_folds = min(len(names), MOST_FOLDS)
    splits = [(groups % num_folds != fold, groups % num_folds == fold) for fold in range(num_folds)]
    folds = [
        [part.nonzero()[:, 0].numpy() for part in split]
        for split in splits
        if all(has_both_classes(sample.is_slip[part]) for part in split)
    ]
    is_wide = z.shape[1] > WIDE
    solver = "lbfgs" if is_wide else "newton-cholesky"
    made = LogisticRegression(C=WIDE_PENALTY, class_weight="balanced", max_iter=2000, solver=solver)
    if folds and not is_wide:
        made = GridSearchCV(made, {"C": PENALTIES}, scoring="balanced_accuracy", cv=folds)
    made.fit(z, sample.is_slip.numpy(), sample_weight=sample.sample_weight.numpy())
    return make_pipeline(before, getattr(made, "best_estimator_", made))


def _with_logs(columns: NDArray[np.float64], floor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns, and the logarithms of their magnitudes, which level out at the floor."""
    return np.concatenate([columns, np.log(np.abs(columns) + floor)], 1)


def _fit_forest(columns: Tensor, sample: SampledBins) -> Any:
    """scikit-learn's random forest of columns ``[n, K]`` of sampled bins."""
    from sklearn.ensemble import RandomForestClassifier

    made = RandomForestClassifier(NUM_TREES, class_weight="balanced", random_state=0, n_jobs=2)
    truth, weights = sample.is_slip.numpy(), sample.sample_weight.numpy()
    return made.fit(columns.numpy(), truth, sample_weight=weights).set_params(n_jobs=None)


@dataclass(frozen=True)
class PooledNumber:
    """One statistic over channels of one descriptor, and a threshold.

    Args:
        pooling: with one column.
        inputs: pool indices of the features that it takes.
        rule: of that column, which is compressed (``features.pooling``).
    """

    pooling: ChannelPooling
    inputs: tuple[int, ...]
    rule: FeatureThreshold

    @classmethod
    def fit(cls, pool: FeaturePool, sample: SampledBins) -> PooledNumber:
        """The mean or standard deviation over channels with the best balanced accuracy.

        Raises:
            ValueError: if a class is absent.
        """
        places = (~is_rounding(pool)).nonzero().flatten()
        names = [pool.names[place] for place in places.tolist()]
        features = sample.features[:: -(-len(sample.features) // CONSTANT_BINS)][:, places]
        layer = ChannelPooling.fit(pool.hand, names, features, ["mean", "std"])
        columns = layer(sample.features[:, pool.places(layer.inputs)].double())
        rule = best_threshold(columns, sample.is_slip, sample.sample_weight)
        layer = layer.select([rule.index])
        return cls(layer, tuple(pool.places(layer.inputs)), replace(rule, index=0))

    @property
    def name(self) -> FeatureName:
        """What the number is."""
        return self.pooling.names[0]

    def metadata(self) -> dict[str, Any]:
        """What it is, and its threshold, JSON-able."""
        rule = self.rule
        return {"feature": str(self.name), "threshold": rule.threshold, "sign": rule.sign}

    def __call__(self, features: Tensor) -> Tensor:
        """Decisions from features of the whole pool, ``[N, F] -> [N]``, bool."""
        return self.rule(self.pooling(features[:, list(self.inputs)].double()))

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values; ``from_dict`` takes them."""
        constants = {name: x.tolist() for name, x in self.pooling.state_dict().items()}
        rule = {"threshold": self.rule.threshold, "sign": self.rule.sign}
        return self.pooling.to_dict() | {"constants": constants} | rule

    @classmethod
    def from_dict(cls, pool: FeaturePool, plain: Mapping[str, Any]) -> PooledNumber:
        """The number that ``to_dict`` described."""
        constants = {
            name: torch.tensor(x, dtype=torch.float64) for name, x in plain["constants"].items()
        }
        layer = ChannelPooling.from_dict(pool.hand, plain, constants)
        rule = FeatureThreshold(0, plain["threshold"], plain["sign"])
        return cls(layer, tuple(pool.places(layer.inputs)), rule)


class Baselines:
    """Fitted baselines.

    Args:
        pool: of the features.
        pooled: the best pooled number.
        others: estimators of scikit-learn by name.
        about: what is told of each, by name, JSON-able.
    """

    def __init__(
        self,
        pool: FeaturePool,
        pooled: PooledNumber,
        others: Mapping[str, Any] | None = None,
        about: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.pooled, self._others = pooled, dict(others or {})
        self._about = {POOLED_NUMBER: pooled.metadata()} | dict(about or {})
        self._statistics = SimpleStatistics(pool) if self._others else None

    @classmethod
    def fit(cls, pool: FeaturePool, scaled: Tensor, sample: SampledBins) -> Baselines:
        """Fit all of them to sampled training bins.

        Args:
            pool: of the features.
            scaled: columns of the detector of the sampled bins, ``[n, K]``.
            sample: as the first pass keeps it.

        Raises:
            ValueError: if a class is absent.
        """
        from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # sklearn's own

        pooled = PooledNumber.fit(pool, sample)  # refuses one class
        x = SimpleStatistics(pool)(sample.features)
        with warnings.catch_warnings(), threadpool_limits(1):  # small: threads would wait
            warnings.simplefilter("ignore")  # newton-cholesky falls back to lbfgs by itself
            on_scaled = _fit_regression(scaled, sample)
            on_simple = _fit_regression(x, sample, with_logs=True)
            others = {
                "logistic_regression": on_scaled,
                "logistic_regression_simple": on_simple,
                "random_forest_simple": _fit_forest(x, sample),
            }
        about = {
            POOLED_NUMBER: pooled.metadata(),
            "logistic_regression": {"C": on_scaled[-1].C},
            "logistic_regression_simple": {"C": on_simple[-1].C},
            "random_forest_simple": {"trees": NUM_TREES},
        }
        num_bins = len(sample.is_slip)
        about = {name: own | {"num_bins": num_bins} for name, own in about.items()}
        return cls(pool, pooled, others, about)

    def __call__(self, features: Tensor, scaled: Tensor) -> dict[str, Tensor]:
        """Decisions by name.

        Shape:
            - features: ``[N, F]``, of the whole pool
            - scaled: ``[N, K]``, columns of the detector
            - output: each ``[N]``, bool
        """
        found = {POOLED_NUMBER: self.pooled(features)}
        if self._statistics is not None:
            simple = self._statistics(features)
            for name, made in self._others.items():
                x = (simple if name.endswith("_simple") else scaled.double()).numpy()
                found[name] = torch.from_numpy(made.predict(x) if len(x) else np.zeros(0, bool))
        return found

    def metadata(self) -> dict[str, dict[str, Any]]:
        """What each is, by name, JSON-able."""
        return {name: dict(own) for name, own in self._about.items()}

    def to_dict(self) -> dict[str, Any]:
        """What a detector keeps: the best pooled number, JSON-able; the others are too large."""
        return {POOLED_NUMBER: self.pooled.to_dict()}

    @classmethod
    def from_dict(cls, pool: FeaturePool, plain: Mapping[str, Any]) -> Baselines:
        """The baselines that ``to_dict`` kept."""
        return cls(pool, PooledNumber.from_dict(pool, plain[POOLED_NUMBER]))
