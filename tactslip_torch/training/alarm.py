"""The alarm of a fitted detector, set on recordings that it was not trained on.

``CalibratedAlarm`` fits the classifier of slipping now and sets its threshold within a budget of
false alarms; recordings that learn, calibrate and test are apart. ``DebouncedAlarm`` is
for sets with too little recorded without slip to count false alarms: k of the last n decisions
speak for slip, and the rate of false alarms is not known.
"""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.labels import whole_samples
from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.sensing import REST_QUANTILE, Sensing
from tactslip_torch.model.calibration import (
    Platt,
    fit_platt,
    probability,
    reliability,
)
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import (
    KEY,
    AlarmSettings,
    Decider,
    Decisions,
    Scorer,
    score_stream,
)
from tactslip_torch.onset.events import (
    Bootstrap,
    EventRecord,
    EventRules,
    LatencyParts,
    first_releases,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.evidence import OnsetClassifier
from tactslip_torch.onset.rules import (
    NOTHING_YET,
    Budget,
    Cusum,
    KOfN,
    Rule,
    false_alarms,
    lowest_threshold,
    rule_from_dict,
)
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.report.metrics import weights_at_share
from tactslip_torch.runtime import bar, check_number, check_share, in_processes, one_thread
from tactslip_torch.training.onset import OnsetTraining

log = logging.getLogger(__name__)

OURS = "detector"
"""The name of the detector among those that score; the others are baselines."""

SLIPPING_NOW = "slipping now"
"""The name of the alarm of the onset classifier."""

CONFOUNDERS = "confounders"
"""In a budget: all recordings that calibrate, but for those without slip and those with slips."""

FIRST_TRANSITION = "first transition"
"""The name of the paper's rule."""

LEAST, MOST = 0.1, 1000.0
"""False alarms an hour that are of interest."""

_CEILING = 1.5  # largest sum of Cusum in thresholds: what lies above only takes time to come down
_STEP = 1.01  # by which a threshold is raised that a capped sum does not keep
_LEAST_THRESHOLD = 1e-30  # at 0 a sum would stand for ever
_NUM_POINTS = 25  # of a threshold curve, at most
_NUM_TRIED = 100
_PUSHES = 200  # timed
_FULL_S = 2.0  # of stream, until memories are full
_HELD_OF_HINTS = 0.05  # of the rate of hints, what recordings without slip may have
_SETTLE_S = 0.05  # behind what a decision rests on, as EventRules.settle_s
_LEVEL = 0.95  # of intervals
_USUAL = torch.tensor([REST_QUANTILE, 1 - REST_QUANTILE], dtype=torch.float64)  # spans
_ENOUGH = 0.99  # of the hours that are asked for
_OTHERS = "others"  # scenes without hours of their own


# Streams, and what a detector decides in them ----------------------------------------------------


class Stream(NamedTuple):
    """A recording as a detector scored it, one decision per hop.

    Attributes:
        recording: which.
        times: when things happen in it.
        score: ``[N]``, float32, NaN where not valid.
        is_valid: which decisions count, ``[N]``.
        onset_score: of every hop of the onset classifier, ``[k]``; of others than the detector [0].
        spans: smallest and largest usual span of a bin of each channel, ``[2, C]``; or ``[0, C]``.
    """

    recording: RecordingId
    times: Timeline
    score: Tensor
    is_valid: Tensor
    onset_score: Tensor
    spans: Tensor = torch.empty(0, 0)


class Timing(NamedTuple):
    """What decisions are about, and how long they wait.

    Attributes:
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
        """Time between two decisions."""
        return self.hop_samples / self.sample_rate_hz


def score_streams(
    source: RecordingSource,
    recordings: Sequence[RecordingId],
    scorers: Mapping[str, Scorer],
    hops: Mapping[str, int],
    onset: OnsetClassifier | Mapping[str, OnsetClassifier] | None = None,
    num_workers: int | None = None,
) -> dict[str, list[Stream]]:
    """The recordings, in order, as each detector scores them; made by workers.

    Args:
        source: of the recordings.
        recordings: which of them.
        scorers: detectors by name.
        hops: distance of two decisions of each, in samples.
        onset: scores hops beside the detector ``OURS``; one, or one for each material.
        num_workers: processes; ``None`` for as many as there are processors, at most 8.

    Raises:
        ValueError: if a recording has other channels than a detector.
    """
    scored = partial(_scored, source, scorers, hops, onset)
    rows = list(in_processes(scored, recordings, "watch streams", "recording", num_workers))
    streams = dict[str, list[Stream]]()
    for name in scorers:
        arrays = [[torch.from_numpy(x) for x in row[name]] for row in rows]
        named = zip(recordings, arrays, strict=True)
        streams[name] = [Stream(one, source.timeline(one), *own) for one, own in named]
    return streams


def _scored(
    source: RecordingSource,
    scorers: Mapping[str, Scorer],
    hops: Mapping[str, int],
    onset: OnsetClassifier | Mapping[str, OnsetClassifier] | None,
    recording: RecordingId,
) -> dict[str, list[NDArray[Any]]]:
    samples = source.load(recording).samples
    if isinstance(onset, Mapping):
        onset = onset[recording.material]
    streams = dict[str, list[NDArray[Any]]]()
    for name, scorer in scorers.items():
        found = score_stream(scorer, samples, hops[name])
        is_ours = onset is not None and name == OURS
        hopwise = onset.score_recording(samples) if is_ours and onset else torch.empty(0).double()
        spans = found.span.nanquantile(_USUAL, 0) if len(found.span) else found.span
        entries = (found.score.float(), found.is_valid, hopwise, spans)
        streams[name] = [x.numpy() for x in entries]
    return streams


def _labelled(streams: Sequence[Stream], timing: Timing) -> tuple[Tensor, Tensor]:
    """Scores of valid bins that are wholly slip or non-slip, ``[N]``, and which they are.

    A bin is slip if it lies in a slide, and non-slip if it meets none.
    """
    scores, labels = [torch.zeros(0)], [torch.zeros(0, dtype=torch.bool)]
    for stream in streams:
        number = torch.arange(len(stream.score), dtype=torch.float64)
        start = number * timing.hop_samples / timing.sample_rate_hz
        end = start + timing.bin_samples / timing.sample_rate_hz
        slides = torch.tensor(stream.times.sliding_s, dtype=torch.float64).reshape(-1, 2, 1)
        is_slip = ((start >= slides[:, 0]) & (end <= slides[:, 1])).any(0)
        meets = ((end > slides[:, 0]) & (start < slides[:, 1])).any(0)
        kept = (is_slip | ~meets) & stream.is_valid
        scores.append(stream.score[kept])
        labels.append(is_slip[kept])
    return torch.cat(scores), torch.cat(labels)


def decide(
    streams: Sequence[Stream], settings: AlarmSettings, timing: Timing
) -> Iterator[tuple[Stream, Decisions]]:
    """What a detector decides in each stream; the shortest streams first.

    ``settings.hop_samples`` may be a multiple of the timing's: so many decisions are left out.
    """
    step = settings.hop_samples // timing.hop_samples
    for stream in sorted(streams, key=lambda own: (len(own.score), len(own.onset_score))):
        decider = Decider(settings, timing.sample_rate_hz, timing.bin_samples, timing.look_ahead)
        made = decider.decide(stream.score[::step], stream.is_valid[::step])
        if settings.onset is not None:
            made = decider.join(made, stream.onset_score)
        yield stream, made


def event_record(stream: Stream, decisions: Decisions) -> EventRecord:
    """The alarms of a stream beside what is true of it."""
    times, available_s = stream.times, decisions.available_s.numpy()
    raised = np.flatnonzero(decisions.is_alarm.numpy())
    off = np.append(np.flatnonzero(~decisions.is_on.numpy()), len(available_s))
    ends = off[np.searchsorted(off, raised)]
    says_slip = available_s[np.flatnonzero(decisions.llr.numpy() > 0)]
    releases_s = first_releases(times.onsets_s, times.released_s)
    first = np.append(says_slip, math.nan)[np.searchsorted(says_slip, releases_s)]
    return EventRecord.of(
        times,
        recording=str(stream.recording),
        material=stream.recording.material,
        scene=stream.recording.scene,
        duration_s=times.duration_s,
        alarms_s=tuple(available_s[raised].tolist()),
        onset_estimates_s=tuple(decisions.onset_s.numpy()[raised].tolist()),
        first_positive_s=tuple(first.tolist()),
        alarm_ends_s=tuple(np.append(available_s, math.inf)[ends].tolist()),
    )


# What is reported of an alarm ------------------------------------------------------------------


def threshold_curve(
    quiet: BudgetScores, settings: AlarmSettings, timing: Timing
) -> list[list[float]]:
    """Thresholds and the false alarms of the detector an hour at each, by the rule in the settings.

    With an onset classifier they are its thresholds, and that of bins stays.

    Rates fall as thresholds rise; from ``LEAST`` to ``MOST`` an hour, at most 25 points that are
    about equally far apart by the rate's logarithm. Fewer where the recordings show no more: none
    is below one alarm in all of them.

    Args:
        quiet: decisions where nothing slips.
        settings: that made them; their threshold does not count.
        timing: of the scores.
    """
    onset = settings.onset
    scores = quiet.statistic if onset is None else quiet.onset_score
    falling = np.concatenate([own[of] for own, of in zip(scores, quiet.is_quiet, strict=True)])
    falling = np.sort(falling[falling > NOTHING_YET])[::-1]
    ranks = np.unique(np.geomspace(1, len(falling), _NUM_TRIED).astype(int)) - 1
    points = list[list[float]]()
    for value in dict.fromkeys(falling[ranks].tolist()):
        alarms = sum(map(len, quiet.alarms(settings.at_threshold(value), timing.sample_rate_hz)))
        rate = alarms / quiet.amount
        if rate > MOST:
            break
        if rate >= LEAST and (not points or rate > points[-1][1]):
            points.append([value, rate])
    if len(points) > _NUM_POINTS:
        rates = np.log([rate for _, rate in points])
        wanted = np.linspace(rates[0], rates[-1], _NUM_POINTS)
        nearest = np.abs(rates - wanted[:, None]).argmin(axis=1)
        points = [points[place] for place in np.unique(nearest)]
    return points[::-1]


def _events(
    streams: Sequence[Stream], settings: AlarmSettings, timing: Timing, compute_s: float | None
) -> dict[str, Any]:
    rate = timing.sample_rate_hz
    latency = LatencyParts(timing.look_ahead / rate, timing.bin_samples / rate, compute_s)
    seen = [
        recording_events(event_record(*made), EventRules(), latency)
        for made in decide(streams, settings, timing)
    ]
    return pooled_metrics(seen)


def _reliability(
    streams: Sequence[Stream], settings: AlarmSettings, timing: Timing
) -> dict[str, Any]:
    """Stated probabilities beside what happened, of bins weighted to the settings' slip fraction.

    Of all streams and, under ``"per_material"``, of those of each material; nothing of streams
    without bins of both classes.
    """
    by_material: dict[str, Any] = {}
    for name in (None, *dict.fromkeys(stream.recording.material for stream in streams)):
        own = [stream for stream in streams if name in (None, stream.recording.material)]
        scores, is_slip = _labelled(own, timing)
        if bool(is_slip.any()) and not bool(is_slip.all()):
            stated = probability(settings.calibration.llr(scores), settings.slip_share)
            weights = weights_at_share(is_slip, settings.slip_share)
            by_material[name or ""] = reliability(stated, is_slip, weights=weights)
    everything = by_material.pop("", None)
    return {} if everything is None else everything | {"per_material": by_material}


def _push_seconds(detector: SlipDetector, settings: AlarmSettings) -> float:
    """Median time of a push of one hop: what a decision costs a stream here, on one thread."""
    live = StreamingDetector(detector, settings)
    generator = torch.Generator().manual_seed(0)
    hop_samples = settings.decision_samples
    hop = torch.randn(hop_samples, len(detector.pool.hand), generator=generator)
    seconds = []
    with one_thread():
        live.push(hop.repeat(round(_FULL_S * detector.pool.sample_rate_hz) // hop_samples, 1))
        for _ in range(_PUSHES):
            started = time.perf_counter()
            live.push(hop)
            seconds.append(time.perf_counter() - started)
    return statistics.median(seconds[_PUSHES // 10 :])


def _lead_s(
    streams: Sequence[Stream], settings: AlarmSettings, timing: Timing, by_onset: bool
) -> float:
    """From an onset to what alarms of one of the classifiers estimate it to be: the median."""
    errors = []
    for stream, made in decide(streams, settings, timing):
        own, times = made.is_alarm & (made.by_onset == by_onset), stream.times
        alarms = list(zip(made.available_s[own].tolist(), made.onset_s[own].tolist(), strict=True))
        firsts = first_releases(times.onsets_s, times.released_s)
        for first_s, onset_s in zip(firsts, times.onsets_s, strict=True):
            until_s = onset_s + EventRules().found_within_s
            errors += [at - onset_s for alarm_s, at in alarms if first_s <= alarm_s <= until_s][:1]
    return statistics.median(errors) if errors else 0.0


# Thresholds within budgets -----------------------------------------------------------------------


def within_budgets(
    settings: AlarmSettings,
    streams: Sequence[Stream],
    timing: Timing,
    budgets: Sequence[Budget],
    allowed: int | None = None,
    scored: Sequence[BudgetScores] | None = None,
    slip_scene: str = "",
) -> AlarmSettings:
    """Settings with the lowest threshold that keeps every budget, and what it gave as metadata.

    It is that of the onset classifier, if there is one. A threshold that a rule cannot reach is
    infinite. A ``Cusum`` without ceiling gets one above its threshold. A sum that is capped is
    sooner low again, so what was one alarm can be two; the threshold is raised until budgets are
    kept.

    Args:
        settings: calibration, rule and onset classifier; their thresholds do not count.
        streams: of each budget those of its scene, scored.
        timing: of the scores.
        budgets: the first is of recordings without slip, whose rate is stated.
        allowed: alarms, in place of those that each budget allows.
        scored: ``budget_scores`` of all this, where they are known.
        slip_scene: of recordings with slips, which are no confounders.

    Raises:
        ValueError: if streams are too few to show a budget.
    """
    rule, onset = settings.rule, settings.onset
    settings = replace(settings, threshold=math.inf)
    scored = scored or budget_scores(streams, settings, timing, budgets, slip_scene)
    most = [of.budget.allowed(of.amount) if allowed is None else allowed for of in scored]
    if onset is not None:
        threshold = _lowest(scored, most, settings, timing, "onset_score")
        return _with_counts(settings.at_threshold(threshold), scored, most, timing)
    value = max(_lowest(scored, most, settings, timing, "statistic"), _LEAST_THRESHOLD)
    while True:
        value, made = value if value <= rule.ceiling else math.inf, rule
        if isinstance(rule, Cusum) and rule.ceiling == math.inf:
            made = replace(rule, ceiling=_CEILING * value)
        settings = replace(settings, rule=made, threshold=value)
        if made != rule:
            scored = budget_scores(streams, settings, timing, budgets, slip_scene)
        settings = _with_counts(settings, scored, most, timing)
        if all(row["alarms"] <= row["allowed"] for row in settings.metadata["budget"]):
            return settings
        value *= _STEP


@dataclass
class BudgetScores:
    """Decisions on recordings of a budget's scene, by which thresholds are set.

    Attributes:
        budget: of them.
        statistic: of the rule, ``[N]`` of each recording.
        onset_score: of the onset classifier, likewise.
        is_quiet: where an alarm is false; a decision that is not valid raises none.
        amount: hours.
    """

    budget: Budget
    statistic: list[NDArray[Any]] = field(default_factory=list)
    onset_score: list[NDArray[Any]] = field(default_factory=list)
    is_quiet: list[NDArray[np.bool_]] = field(default_factory=list)
    amount: float = 0

    def alarms(self, settings: AlarmSettings, sample_rate_hz: float) -> list[NDArray[np.int64]]:
        """Places of the false alarms of each recording."""
        scores = self.statistic if settings.onset is None else self.onset_score
        times = settings.latch_times(sample_rate_hz)
        return [
            false_alarms(own >= settings.alarm_threshold, is_quiet, **times)
            for own, is_quiet in zip(scores, self.is_quiet, strict=True)
        ]


def _decisions_h(settings: AlarmSettings, timing: Timing) -> float:
    """Decisions of an hour."""
    return 3600 * timing.sample_rate_hz / settings.decision_samples


def budget_scores(
    streams: Sequence[Stream],
    settings: AlarmSettings,
    timing: Timing,
    budgets: Sequence[Budget],
    slip_scene: str = "",
) -> list[BudgetScores]:
    """What thresholds are set on, of each budget; the shortest streams first.

    Alarms are false where nothing slips, outside slides and what is left of them in bins and rules.
    """
    without = {slip_scene, *(budget.scene for budget in budgets)}
    settle_s = (timing.bin_samples + timing.look_ahead) / timing.sample_rate_hz + _SETTLE_S
    found = []
    for budget in budgets:
        scores = BudgetScores(budget)
        own = [
            stream
            for stream in streams
            if stream.recording.scene == budget.scene
            or (budget.scene == CONFOUNDERS and stream.recording.scene not in without)
        ]
        for stream, made in decide(own, settings, timing):
            time_s, times = made.available_s.numpy(), stream.times
            quiet = made.is_valid.numpy().copy()
            if settings.onset is not None:
                quiet &= made.onset_score.numpy() > NOTHING_YET
            firsts = first_releases(times.onsets_s, times.released_s)
            for first_s, (_, end_s) in zip(firsts, times.sliding_s, strict=True):
                before_s = first_s - EventRules().early_s
                quiet &= (time_s < before_s) | (time_s > end_s + settle_s)
            scores.statistic.append(made.statistic.numpy())
            scores.onset_score.append(made.onset_score.numpy())
            scores.is_quiet.append(quiet)
            scores.amount += int(quiet.sum()) / _decisions_h(settings, timing)
        found.append(scores)
    return found


def _lowest(
    scored: Sequence[BudgetScores],
    allowed: Sequence[int],
    settings: AlarmSettings,
    timing: Timing,
    name: str,
) -> float:
    """The lowest threshold of a score at which each budget has at most so many alarms."""
    times = settings.latch_times(timing.sample_rate_hz)
    return max(
        lowest_threshold(
            getattr(scores, name),
            scores.is_quiet,
            most,
            **times,
        )
        for scores, most in zip(scored, allowed, strict=True)
    )


def _with_counts(
    settings: AlarmSettings,
    scored: Sequence[BudgetScores],
    allowed: Sequence[int],
    timing: Timing,
) -> AlarmSettings:
    """The settings, with what their thresholds gave on the recordings that they were set on."""
    rows = list[dict[str, Any]]()
    rate_hz, onset = timing.sample_rate_hz, settings.onset
    for scores, most in zip(scored, allowed, strict=True):
        budget, num = scores.budget, sum(map(len, scores.alarms(settings, rate_hz)))
        rows.append(
            {
                "scene": budget.scene,
                "limit": budget.limit,
                "amount": scores.amount,
                "allowed": most,
                "alarms": num,
                "bound": budget.bound(num, scores.amount),
            }
        )
    usual = scored[0]
    alarms = list(map(len, usual.alarms(settings, rate_hz)))
    hours = [len(own) / _decisions_h(settings, timing) for own in usual.is_quiet]
    rate = Bootstrap(len(hours), _LEVEL).rate(alarms, hours)
    calibrated = {
        "value": settings.threshold if onset is None else onset.threshold,
        "target_per_hour": usual.budget.limit,
        "rate": {"alarms": sum(alarms), "hours": sum(hours), **(rate or {})},
    }
    metadata = {"slip_free": usual.budget.scene, "budget": rows, "calibrated": calibrated}
    return replace(settings, metadata=metadata | {"confidence": usual.budget.confidence})


# The stages behind a fit -------------------------------------------------------------------------


@dataclass(frozen=True)
class CalibratedAlarm:
    """Sets the alarm of a fitted detector, of a classifier of slipping now, within a budget.

    The classifier learns from recordings of its own. Of ``streams``, those of the materials that it
    learned from set thresholds and test; those of other materials test alone. What sets thresholds
    is scored by a classifier that was fitted without its material, so that budgets hold for new
    materials. Beside it the detector of bins and baselines are thresholds on their scores, under
    the same budgets.

    Args:
        worlds: recordings to learn from.
        streams: recordings with slips, without, and of confounders.
        classifier: how the onset classifier is fitted.
        budget: false alarms an hour of each scene; ``"confounders"``: of all scenes that are not
            named, together.
        confidence: with which budgets are to hold.
        hint_per_hour: false hints an hour of confounders.
        hours: to calibrate on, by scene, ``"others"`` for those that are not named.
        check_hours: to check on, at most, likewise; for seen and for held-out materials.
        hop_ms: distance of two bins.
        slip_free: the scene without slip.
        with_slips: the scene with slips.
        rule: what gathers evidence of bins; ``evidence: null`` is hop / bin.
        slip_share: how much of a stream is slip, for probabilities.
        rearm_s: how long the score must stay low before the next alarm.
        refractory_s: shortest time between two alarms.

    Raises:
        ValueError: for a rule or scene that is not there, a hop that is no whole
            number of samples, or a number out of range.
    """

    worlds: RecordingSource
    streams: RecordingSource
    classifier: OnsetTraining
    budget: Mapping[str, float]
    hours: Mapping[str, float]
    check_hours: Mapping[str, float]
    hop_ms: float
    slip_free: str
    with_slips: str
    rule: Mapping[str, Any]
    confidence: float = 0.95
    hint_per_hour: float = 60.0
    slip_share: float = 0.5
    rearm_s: float = 0.2
    refractory_s: float = 0.2

    def __post_init__(self) -> None:
        scenes = sorted({recording.scene for recording in self.streams.ids})
        named = [*self.budget, *self.hours, *self.check_hours]
        for name in (self.slip_free, self.with_slips, *named):
            if name not in (*scenes, _OTHERS, CONFOUNDERS):
                raise ValueError(
                    f"onset.streams has no scene {name!r}, it has {', '.join(scenes)}; take it out "
                    "of onset.budget and onset.hours"
                )
        if self.slip_free not in self.budget:
            raise ValueError(f"onset.budget must say what {self.slip_free} may have, an hour")
        for name in ("hop_ms", "hint_per_hour"):
            check_number(f"onset.{name}", getattr(self, name))
        for name, limit in self.budget.items():
            check_number(f"onset.budget.{name}", limit)
        self._settings(self.made_rule(1), Platt(1.0, 0.0), self.hop_samples)  # refuses bad numbers

    @property
    def hop_samples(self) -> int:
        """Distance of two bins."""
        return whole_samples(self.hop_ms, self.streams.sample_rate_hz, "onset.hop_ms")

    @property
    def budgets(self) -> list[Budget]:
        """What recordings may have, those without slip first."""
        names = sorted(self.budget, key=lambda name: name != self.slip_free)
        return [Budget(n, self.budget[n], confidence=self.confidence) for n in names]

    def made_rule(self, bin_samples: int) -> Rule:
        """The rule; where it leaves it open, evidence is hop / bin."""
        evidence = min(1.0, self.hop_samples / bin_samples)
        is_open = self.rule.get("evidence", 1) is None
        return rule_from_dict({**self.rule, "evidence": evidence} if is_open else self.rule)

    def roles(self, detector: SlipDetector) -> dict[str, list[RecordingId]]:
        """Which recordings calibrate and test, of seen and of held-out materials.

        Raises:
            ValueError: if there is no recording to calibrate on, or too few to show a budget.
        """
        trained = set(detector.info.get("train_recordings", {}).values())
        seen = {recording.material for recording in self.worlds.ids}
        roles: dict[str, list[RecordingId]] = {"calibrate": [], "test": [], "unseen": []}
        hours: defaultdict[tuple[str, str], float] = defaultdict(float)
        fresh = [r for r in self.streams.ids if cache_key(self.streams.key(r)) not in trained]
        for recording in sorted(fresh, key=lambda r: (r.scene, r.cycle, r.material)):
            scene, role = recording.scene, "unseen"
            if recording.material in seen:
                most = self.hours.get(scene, self.hours.get(_OTHERS, 0.0))
                role = "calibrate" if hours["calibrate", scene] < most else "test"
            most = self.check_hours.get(scene, self.check_hours.get(_OTHERS, 0.0))
            if role != "calibrate" and hours[role, scene] >= most:
                continue
            hours[role, scene] += self.streams.timeline(recording).duration_s / 3600
            roles[role].append(recording)
        given: defaultdict[str, float] = defaultdict(float)
        for recording in roles["calibrate"]:
            scene, h = recording.scene, hours["calibrate", recording.scene]
            given[scene] = h
        for scene, wanted in self.hours.items():
            if scene != _OTHERS and given[scene] < _ENOUGH * wanted:
                log.warning(
                    "%.2f h of %s are left to calibrate on, onset.hours asks for %g: give "
                    "onset.streams more",
                    given[scene],
                    scene,
                    wanted,
                )
        named = {self.with_slips, *self.budget}
        given[CONFOUNDERS] = sum(h for scene, h in given.items() if scene not in named)
        for budget in self.budgets:  # refused before hours are spent
            budget.allowed(given[budget.scene])
        for scene in (self.with_slips, self.slip_free):
            if not given[scene]:
                raise ValueError(
                    f"no recording of scene {scene} that was not trained on is left to calibrate "
                    "on; give onset.streams more of them"
                )
        return roles

    def __call__(
        self,
        detector: SlipDetector,
        baselines: Mapping[str, Scorer] | None = None,
        num_workers: int | None = None,
    ) -> dict[str, Any]:
        """Set the alarm of a detector, in its ``info``, and evaluate it.

        Args:
            detector: fitted.
            baselines: by name; each is a threshold on its score.
            num_workers: processes that score streams.

        Returns:
            JSON-able: ``"rule"``, the method that the detector's file has, ``"settings"`` of it,
            ``"sample_rate_hz"``; ``"classifier"``, how the onset classifier was chosen;
            ``"held_out"``, materials that it did not learn from;
            ``"streams"``, recordings, hours and slips of each role and scene; ``"methods"``;
            ``"budget"``, a row for each budget, method and role; ``"reliability"`` of each role;
            ``"events"`` of the scenes with and without slips, by role and method; ``"scenes"``,
            the same of every other scene by role, and whether it was ``"trained"`` on.

        Raises:
            ValueError: if there is nothing to calibrate on, or too little to show a budget.
        """
        roles = self.roles(detector)
        onset, left_out, chosen = self.classifier(self.worlds, self.worlds.ids, num_workers)
        scorers: dict[str, Scorer] = {OURS: detector, **(baselines or {})}
        hops, rate = dict.fromkeys(scorers, self.hop_samples), self.streams.sample_rate_hz
        others = {one.material: left_out.get(one.material, onset) for one in roles["calibrate"]}
        score = partial(score_streams, self.streams, scorers=scorers, hops=hops)
        scored = {
            role: score(
                own, onset=others if role == "calibrate" else onset, num_workers=num_workers
            )
            for role, own in roles.items()
        }
        timings = {
            name: Timing(rate, hops[name], scorer.pool.bin_samples, scorer.look_ahead)
            for name, scorer in scorers.items()
        }
        methods = self.methods(scored["calibrate"], timings, onset)
        amounts = self._amounts(roles)
        _, settings = methods[SLIPPING_NOW]
        (quiet,) = budget_scores(
            scored["calibrate"][OURS], settings, timings[OURS], self.budgets[:1]
        )
        curve = threshold_curve(quiet, settings, timings[OURS])
        metadata = {
            **settings.metadata,
            "simulated": self.streams.is_simulated,
            "streams": amounts["calibrate"],
            "threshold_curve": curve,
        }
        spans = torch.cat([stream.spans for stream in scored["calibrate"][OURS]])
        known = detector.sensing
        levels = Sensing.fit(spans, known.min_alive, known.stuck_samples)
        settings = replace(settings, metadata=metadata, levels=levels)
        detector.info[KEY] = settings.to_dict()
        del scored["calibrate"]
        return {
            "rule": SLIPPING_NOW,
            "sample_rate_hz": rate,
            "settings": settings.to_dict(),
            "classifier": chosen,
            "held_out": list(dict.fromkeys(recording.material for recording in roles["unseen"])),
            "streams": amounts,
            "methods": {
                name: {
                    "scorer": scorer,
                    "calibrated": made.metadata.get("calibrated"),
                    **made.to_dict(),
                    "onset": made.onset is not None,
                }
                for name, (scorer, made) in methods.items()
            },
            **self._evaluated(scored, methods, timings, _push_seconds(detector, settings)),
        }

    def _evaluated(
        self,
        scored: Mapping[str, Mapping[str, Sequence[Stream]]],
        methods: Mapping[str, tuple[str, AlarmSettings]],
        timings: Mapping[str, Timing],
        compute_s: float,
    ) -> dict[str, Any]:
        """What came of each method on recordings of each role that set nothing."""
        events = defaultdict[str, dict[str, dict[str, Any]]](lambda: defaultdict(dict))
        calibrations = {}
        for role, name in bar(list(product(scored, methods)), "events", "table row"):
            scorer, made = methods[name]
            by_scene = defaultdict[str, list[Stream]](list)  # "" the usual ones
            for stream in scored[role][scorer]:
                scene = stream.recording.scene
                by_scene["" if scene in (self.with_slips, self.slip_free) else scene].append(stream)
            for scene, own in by_scene.items():
                measured_s = compute_s if scorer == OURS else None
                events[scene][role][name] = _events(own, made, timings[scorer], measured_s)
            if name == SLIPPING_NOW and (found := _reliability(by_scene[""], made, timings[OURS])):
                calibrations[f"{role} stream"] = found
        budget_rows = self._budget_rows(methods, scored, timings)
        usual = events.pop("", {})
        return {
            "budget": budget_rows,
            "reliability": calibrations,
            "events": {f"{role} stream": found for role, found in usual.items()},
            "scenes": {
                scene: {"trained": scene in {r.scene for r in self.worlds.ids}} | by_role
                for scene, by_role in events.items()
            },
        }

    def methods(
        self,
        streams: Mapping[str, Sequence[Stream]],
        timings: Mapping[str, Timing],
        onset: OnsetClassifier,
    ) -> dict[str, tuple[str, AlarmSettings]]:
        """By name whose scores, and what makes alarms of them.

        ``SLIPPING_NOW``; the rule on bins, under the same budgets; the paper's own rule,
        ``FIRST_TRANSITION``; and a threshold on the score of each baseline.

        The paper's rule makes every change of the score to slip an alarm, one decision a bin: there
        is no threshold but the score's own, and no memory beyond the bin before. It is left out
        where the hop does not divide the bin.

        Args:
            streams: that calibrate, by scorer, ``OURS`` included.
            timings: of every scorer.
            onset: classifier, without threshold.

        Raises:
            ValueError: if our scores cannot be calibrated, or a budget not be shown.
        """
        ours, timing = streams[OURS], timings[OURS]
        calibration = fit_platt(*_labelled(ours, timing))
        rule = self.made_rule(timing.bin_samples)
        methods = {SLIPPING_NOW: (OURS, self.calibrated(rule, calibration, ours, timing, onset))}
        alone = self.calibrated(rule, calibration, ours, timing)
        methods[rule.name] = OURS, alone
        if timing.bin_samples % timing.hop_samples == 0:
            settings = self._settings(KOfN(1, 1), Platt(1.0, 0.0), timing.bin_samples)
            settings = replace(settings, threshold=_LEAST_THRESHOLD, rearm_s=0, refractory_s=0)
            methods[FIRST_TRANSITION] = OURS, settings
        for name in streams:
            if name != OURS:
                settings = self._settings(KOfN(1, 1), Platt(1.0, 0.0), timings[name].hop_samples)
                of = timings[name]
                scored = budget_scores(streams[name], settings, of, self.budgets, self.with_slips)
                most = [each.budget.allowed(each.amount) for each in scored]
                threshold = _lowest(scored, most, settings, of, "statistic")
                settings = replace(settings, threshold=threshold)
                methods[name] = name, _with_counts(settings, scored, most, of)
        return methods

    def calibrated(
        self,
        rule: Rule,
        calibration: Platt,
        streams: Sequence[Stream],
        timing: Timing,
        onset: OnsetClassifier | None = None,
    ) -> AlarmSettings:
        """Settings with the threshold that keeps every budget, and that of hints."""
        settings = replace(self._settings(rule, calibration, timing.hop_samples), onset=onset)
        made = within_budgets(settings, streams, timing, self.budgets, slip_scene=self.with_slips)
        lead_s = _lead_s(streams, made, timing, by_onset=onset is not None)
        if made.onset is None:
            return replace(made, lead_s=lead_s)
        rates = {CONFOUNDERS: 1.0, self.slip_free: _HELD_OF_HINTS}
        hints = [
            Budget(scene, share * self.hint_per_hour)
            for scene, share in rates.items()
            if scene in self.budget
        ]
        scored = budget_scores(streams, settings, timing, hints, self.with_slips)
        most = [int(of.budget.limit * of.amount) for of in scored]
        hint = _lowest(scored, most, settings, timing, "onset_score")
        hint = min(hint, made.onset.threshold)
        return replace(made, onset=replace(made.onset, lead_s=lead_s, hint=hint))

    def _settings(self, rule: Rule, calibration: Platt, hop_samples: int) -> AlarmSettings:
        """Without a threshold yet."""
        return AlarmSettings(
            hop_samples,
            calibration,
            rule,
            math.inf,
            self.budget[self.slip_free],
            self.slip_share,
            self.rearm_s,
            self.refractory_s,
        )

    def _budget_rows(
        self,
        methods: Mapping[str, tuple[str, AlarmSettings]],
        scored: Mapping[str, Mapping[str, Sequence[Stream]]],
        timings: Mapping[str, Timing],
    ) -> list[dict[str, Any]]:
        """What each method had of each budget, and of each scene, on recordings of each role."""
        rows = []
        scenes = {stream.recording.scene for own in scored.values() for stream in own[OURS]}
        limits = {budget.scene: budget.limit for budget in self.budgets}
        others = sorted(scenes - {self.with_slips, *limits})
        for role, (name, (scorer, made)) in product(scored, methods.items()):
            wanted = [*self.budgets, *(Budget(s, limits.get(CONFOUNDERS, 1.0)) for s in others)]
            for budget in wanted:
                kinds = self.budgets if budget.scene == CONFOUNDERS else [budget]
                (of,) = (
                    one
                    for one in budget_scores(
                        scored[role][scorer], made, timings[scorer], kinds, self.with_slips
                    )
                    if one.budget.scene == budget.scene
                )
                if not of.amount:
                    continue
                num = sum(map(len, of.alarms(made, timings[scorer].sample_rate_hz)))
                low, high = budget.interval(num, of.amount, _LEVEL)
                rows.append(
                    {
                        "role": role,
                        "scene": budget.scene,
                        "limit": budget.limit if budget in self.budgets else None,
                        "method": name,
                        "alarms": num,
                        "amount": of.amount,
                        "rate": num / of.amount,
                        "low": low,
                        "high": high,
                    }
                )
        return rows

    def _amounts(
        self, roles: Mapping[str, Sequence[RecordingId]]
    ) -> dict[str, dict[str, dict[str, float]]]:
        """Recordings, hours and slips of each role and scene."""
        amounts: dict[str, dict[str, dict[str, float]]] = {}
        for role, recordings in roles.items():
            for recording in recordings:
                none = {"recordings": 0, "hours": 0.0, "slips": 0}
                row = amounts.setdefault(role, {}).setdefault(recording.scene, none)
                times = self.streams.timeline(recording)
                row["recordings"] += 1
                row["hours"] += times.duration_s / 3600
                row["slips"] += len(times.onsets_s)
        return amounts


@dataclass(frozen=True)
class DebouncedAlarm:
    """Sets the alarm of a fitted detector at no given rate: k of the last n decisions say slip.

    With a classifier of slipping now, fitted on the detector's own training recordings, alarms come
    from that, at a threshold of about ten false alarms an hour of those that were left out.

    Args:
        hop_ms: distance of two decisions; ``None`` for half a bin.
        k: so many decisions must say slip,
        n: of so many.
        probability: from which a decision speaks for slip.
        slip_share: how much of a stream is slip, for probabilities.
        rearm_s: how long the statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.
        classifier: how a classifier of slipping now is fitted; ``None``: there is none.
        fewest_slips: labelled slips that it is fitted on, at least; with fewer the rule stays.

    Raises:
        ValueError: for a number that cannot be.
    """

    hop_ms: float | None = None
    k: int = 2
    n: int = 3
    probability: float = 0.5
    slip_share: float = 0.5
    rearm_s: float = 0.1
    refractory_s: float = 0.2
    classifier: OnsetTraining | None = None
    fewest_slips: int = 30

    def __post_init__(self) -> None:
        if self.hop_ms is not None:
            check_number("onset.hop_ms", self.hop_ms)
        for name in ("k", "n", "fewest_slips"):
            check_number(f"onset.{name}", getattr(self, name), whole=True)
        check_share("onset.probability", self.probability)
        self._settings(Platt(1.0, 0.0), 1)  # refuses bad numbers

    def hop_samples(self, sample_rate_hz: float, bin_samples: int) -> int:
        """The distance of two decisions in samples.

        Raises:
            ValueError: if it is no whole number of them.
        """
        if self.hop_ms is None:
            return max(bin_samples // 2, 1)
        return whole_samples(self.hop_ms, sample_rate_hz, "onset.hop_ms")

    def __call__(self, detector: SlipDetector) -> None:
        """Set the alarm of a detector, in its ``info``.

        Raises:
            ValueError: if training had nothing to choose, so that scores have no calibration.
        """
        known = detector.calibration
        if known is None:
            raise ValueError(
                "onset=debounced needs scores of recordings left out, and there are none; train on "
                "recordings of two objects or more, with several recipe.penalties"
            )
        hop = self.hop_samples(detector.pool.sample_rate_hz, detector.pool.bin_samples)
        detector.info[KEY] = self._settings(known[0], hop).to_dict()

    def fit(
        self, detector: SlipDetector, source: RecordingSource, num_workers: int | None = None
    ) -> dict[str, Any]:
        """Give a detector that has its alarm a classifier of slipping now.

        Args:
            detector: fitted on recordings of the source.
            source: whose labelled slips begin at known times.
            num_workers: processes.

        Returns:
            JSON-able: what the classifier was fitted on; empty where there are too few slips.
        """
        assert self.classifier is not None
        trained = set(detector.info.get("train_recordings", {}))
        own = [recording for recording in source.ids if str(recording) in trained]
        num_slips = sum(len(source.timeline(recording).onsets_s) for recording in own)
        if num_slips < self.fewest_slips:
            log.warning(
                "%d labelled slips are too few for a classifier of slipping now, which needs %d; "
                "the alarm stays at %d of %d decisions on bins",
                *(num_slips, self.fewest_slips, self.k, self.n),
            )
            return {}
        onset, _, report = self.classifier(source, own, num_workers)
        chosen = report["heads"].get(report["head"], {})
        onset = replace(onset, threshold=chosen.get("threshold", 0.0))
        settings = replace(AlarmSettings.of(detector), onset=onset)
        detector.info[KEY] = settings.to_dict()
        return report

    def _settings(self, calibration: Platt, hop_samples: int) -> AlarmSettings:
        settings = AlarmSettings(
            hop_samples,
            calibration,
            KOfN(self.k, self.n),
            threshold=0.0,
            target_per_hour=None,
            slip_share=self.slip_share,
            rearm_s=self.rearm_s,
            refractory_s=self.refractory_s,
        )
        odds, share_odds = (p / (1 - p) for p in (self.probability, self.slip_share))
        return replace(settings, threshold=math.log(odds) - math.log(share_odds))
