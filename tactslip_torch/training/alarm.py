"""The alarm of a fitted detector, set on recordings that it was not trained on.

``CalibratedAlarm`` sets it for a false-alarm rate. Half of the seen materials' cycles *calibrate*:
score to log likelihood ratio, the threshold of every rule, how far an onset lies back. The other
half and the unseen materials say what became of it, and set nothing.

``DebouncedAlarm`` is for sets with too little recorded without slip to count false alarms on: k of
the last n decisions say slip, by the calibration of the held-out scores that training chose by.
How often it is false is not known.
"""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.data.labels import whole_samples
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.calibration import (
    Calibration,
    Isotonic,
    Platt,
    fit_isotonic,
    fit_platt,
    probability,
    reliability,
)
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.onset.events import EventRules, LatencyParts, event_metrics
from tactslip_torch.onset.rules import Cusum, KOfN, Rule, rule_from_dict
from tactslip_torch.onset.settings import KEY, AlarmSettings, calibration_of
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.onset.thresholds import Threshold, alarm_counts, alarm_rate, choose_threshold
from tactslip_torch.report.metrics import weights_at_share
from tactslip_torch.runtime import bar
from tactslip_torch.training.stream_evaluation import (
    Clock,
    Stream,
    decide,
    slip_bins,
    watch,
    watched,
)

log = logging.getLogger(__name__)

OURS = "detector"
"""The name of the detector among those that watch."""

FIRST_TRANSITION = "first transition"
"""The name of the paper's rule."""

CEILING = 1.5
"""Largest sum of ``Cusum`` in thresholds: what lies above only takes time to come down."""

_STEP = 1.01  # by which a threshold is raised that a capped sum does not keep
_ABOVE_NEUTRAL = 1e-30  # a score of slip, and no decision that tells nothing

FITS: Mapping[str, Callable[[Tensor, Tensor], Calibration]] = {
    "platt": fit_platt,
    "isotonic": fit_isotonic,
}
"""From scores to log likelihood ratios."""


class Method(NamedTuple):
    """A way to alarm: whose scores, by which settings, and how its threshold was found.

    Attributes:
        scorer: the name of the detector that scores.
        settings: what makes alarms of scores.
        threshold: None if nothing was set.
    """

    scorer: str
    settings: AlarmSettings
    threshold: Threshold | None

    def to_dict(self) -> dict[str, Any]:
        """The method as plain JSON types."""
        calibrated = None if self.threshold is None else asdict(self.threshold)
        return {"scorer": self.scorer, "calibrated": calibrated, **self.settings.to_dict()}


def labelled(streams: Sequence[Stream], scorer: str, clock: Clock) -> tuple[Tensor, Tensor]:
    """Scores of valid bins that are wholly slip or non-slip, ``[N]``, and which they are."""
    scores, labels = [np.zeros(0, np.float32)], [np.zeros(0, bool)]
    for stream in streams:
        score = stream.score[scorer]
        is_clear, is_slip = slip_bins(stream, clock, len(score))
        kept = is_clear & stream.is_valid[scorer]
        scores.append(score[kept])
        labels.append(is_slip[kept])
    return torch.from_numpy(np.concatenate(scores)), torch.from_numpy(np.concatenate(labels))


def _lead_s(streams: Sequence[Stream], scorer: str, settings: AlarmSettings, clock: Clock) -> float:
    """From an onset to where the run of ratios that found it began: the median."""
    errors = []
    for stream, decisions in decide(streams, scorer, settings, clock):
        seen = watched(stream, decisions)
        for onset_s in seen.onsets_s:
            later = [
                estimate - onset_s
                for alarm, estimate in zip(seen.alarms_s, seen.onset_estimates_s, strict=True)
                if onset_s <= alarm <= onset_s + EventRules().found_within_s
            ]
            errors += later[:1]
    return statistics.median(errors) if errors else 0.0


LEAST, MOST = 0.1, 1000.0
"""False alarms an hour that are of interest."""

_NUM_POINTS = 25
_NUM_TRIED = 100


def threshold_curve(
    quiet: Sequence[Stream], settings: AlarmSettings, clock: Clock
) -> list[list[float]]:
    """Thresholds and the false alarms of the detector an hour at each, by the rule in the settings.

    Rates fall as thresholds rise; from ``LEAST`` to ``MOST`` an hour, at most 25 points that are
    about equally far apart by the rate's logarithm. Fewer where the recordings show no more: none
    is below one alarm in all of them.

    Args:
        quiet: recordings in which nothing slips.
        settings: calibration, rule, re-arming; their threshold does not count.
        clock: of the scores.
    """
    statistics = [made.statistic for _, made in decide(quiet, OURS, settings, clock)]
    hours = sum(len(statistic) for statistic in statistics) * clock.hop_s / 3600
    falling = torch.cat(statistics).sort(descending=True).values
    ranks = np.unique(np.geomspace(1, len(falling), _NUM_TRIED).astype(int)) - 1
    found = list[list[float]]()
    for value in dict.fromkeys(falling[ranks].tolist()):
        alarms = alarm_counts(
            statistics,
            [value],
            rearm=settings.decisions(settings.rearm_s, clock.sample_rate_hz),
            refractory=settings.decisions(settings.refractory_s, clock.sample_rate_hz),
        )
        rate = int(alarms.sum()) / hours
        if rate > MOST:
            break
        if rate >= LEAST and (not found or rate > found[-1][1]):
            found.append([value, rate])
    return _thinned(found)[::-1]


def _thinned(points: list[list[float]]) -> list[list[float]]:
    """Those next to evenly spaced logarithms of the rate."""
    if len(points) <= _NUM_POINTS:
        return points
    rates = np.log([rate for _, rate in points])
    wanted = np.linspace(rates[0], rates[-1], _NUM_POINTS)
    nearest = np.abs(rates - wanted[:, None]).argmin(axis=1)
    return [points[place] for place in np.unique(nearest)]


def reliability_of(
    parts: Mapping[str, Sequence[Stream]], settings: AlarmSettings, clock: Clock
) -> dict[str, Any]:
    """Stated probabilities beside what happened: of each part, and of each of its materials.

    Bins are weighted to the share of slip that probabilities are stated for.
    """
    found: dict[str, Any] = {}
    for part, streams in parts.items():
        groups: dict[str, list[Stream]] = {"": list(streams)}
        for stream in streams:
            groups.setdefault(stream.recording.material, []).append(stream)
        rows = {}
        for material, own in groups.items():
            scores, is_slip = labelled(own, OURS, clock)
            if bool(is_slip.any()) and not bool(is_slip.all()):
                stated = probability(settings.calibration.llr(scores), settings.slip_share)
                weights = weights_at_share(is_slip, settings.slip_share)
                rows[material] = reliability(stated, is_slip, weights=weights).to_dict()
        if "" in rows:
            found[part] = rows.pop("") | {"per_material": rows}
    return found


def push_seconds(detector: SlipDetector, settings: AlarmSettings, pushes: int = 200) -> float:
    """Median time of a push of one hop: what a decision costs a stream here, on one thread."""
    live = StreamingDetector(detector, settings)
    generator = torch.Generator().manual_seed(0)
    hop = torch.randn(settings.hop_samples, len(detector.pool.hand), generator=generator)
    taken = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        live.push(hop.repeat(-(-2 * detector.pool.bin_samples // settings.hop_samples), 1))  # full
        for _ in range(pushes):
            started = time.perf_counter()
            live.push(hop)
            taken.append(time.perf_counter() - started)
    finally:
        torch.set_num_threads(threads)
    return statistics.median(taken[pushes // 10 :])


def amounts_of(streams: Mapping[str, Sequence[Stream]]) -> dict[str, dict[str, dict[str, float]]]:
    """Recordings, hours and slips of each role and scene."""
    amounts: dict[str, dict[str, dict[str, float]]] = {}
    for role, own in streams.items():
        for stream in own:
            none = {"recordings": 0, "hours": 0.0, "slips": 0}
            row = amounts.setdefault(role, {}).setdefault(stream.recording.scene, none)
            row["recordings"] += 1
            row["hours"] += stream.duration_s / 3600
            row["slips"] += len(stream.onsets_s)
    return amounts


@dataclass(frozen=True)
class CalibratedAlarm:
    """Sets the alarm of a fitted detector for a false-alarm rate.

    Args:
        streams: recordings, those trained on included or not; of the paper's scene, without
            slip, and of confounding scenes.
        hop_ms: distance of two decisions.
        false_alarms_per_hour: at most.
        hours: of recordings without slip, at most, to set thresholds on, and as many to check
            them on, for seen and for unseen materials.
        slip_free: the scene without slip, on which false alarms are counted.
        rules: of ``onset.rules``, by name.
        rule: the one that the detector's file gets; those of baselines are like it.
        calibration: ``"platt"`` or ``"isotonic"``.
        slip_share: how much of a stream is slip, for probabilities.
        rearm_s: how long the statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.
        level: of intervals.

    Raises:
        ValueError: for a rule, calibration or scene that is not there, a hop that is no whole
            number of samples, or a number out of range.
    """

    streams: RecordingSource
    hop_ms: float
    false_alarms_per_hour: float
    hours: float
    slip_free: str
    rules: Mapping[str, Mapping[str, Any]]
    rule: str
    calibration: str = "platt"
    slip_share: float = 0.5
    rearm_s: float = 0.1
    refractory_s: float = 0.2
    level: float = 0.95

    def __post_init__(self) -> None:
        scenes = sorted({recording.scene for recording in self.streams.ids})
        for name, known in (("rule", list(self.rules)), ("calibration", list(FITS))):
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"onset.{name} must be one of {', '.join(known)}, got {value!r}")
        if self.slip_free not in scenes:
            raise ValueError(
                f"onset.slip_free must be a scene of onset.streams, {', '.join(scenes)}, "
                f"got {self.slip_free!r}"
            )
        for name in ("hop_ms", "false_alarms_per_hour", "hours"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"onset.{name} must be positive, got {getattr(self, name)}")
        if not 0 < self.level < 1:
            raise ValueError(f"onset.level must lie between 0 and 1, got {self.level}")
        for rule in self.made_rules(self.hop_samples).values():  # bad numbers are refused now
            self._settings(rule, Platt(1.0, 0.0), self.hop_samples)

    @property
    def hop_samples(self) -> int:
        """Distance of two decisions."""
        return whole_samples(self.hop_ms, self.streams.sample_rate_hz, "onset.hop_ms")

    def made_rules(self, bin_samples: int) -> dict[str, Rule]:
        """The rules; where they leave it open, evidence is hop / bin."""
        made = {}
        for name, given in self.rules.items():
            numbers = dict(given)
            if numbers.get("evidence", 1) is None:
                numbers["evidence"] = min(1.0, self.hop_samples / bin_samples)
            made[name] = rule_from_dict(numbers)
        return made

    def roles(self, detector: SlipDetector) -> dict[str, list[RecordingId]]:
        """Which recordings calibrate, and which evaluate, of seen and of unseen materials.

        Every second cycle of a seen material calibrates, of the paper's scene and the one without
        slip; nothing that was trained on has a role.

        Raises:
            ValueError: if there is no recording to calibrate on.
        """
        trained = set(detector.info.get("train_recordings", {}).values())
        seen = set(detector.info.get("train_materials", ()))
        needed = (PAPER_SCENE, self.slip_free)
        roles: dict[str, list[RecordingId]] = {"calibrate": [], "test": [], "unseen": []}
        hours = dict.fromkeys(roles, 0.0)
        places: Counter[tuple[str, str]] = Counter()
        fresh = [r for r in self.streams.ids if cache_key(self.streams.key(r)) not in trained]
        for recording in sorted(fresh, key=lambda r: (r.scene, r.cycle, r.material)):
            of = (recording.material, recording.scene)
            role = "test" if recording.material in seen else "unseen"
            if role == "test" and recording.scene in needed and places[of] % 2 == 0:
                role = "calibrate"
            places[of] += 1
            if recording.scene == self.slip_free:
                if hours[role] >= self.hours:
                    continue
                hours[role] += self.streams.timeline(recording).duration_s / 3600
            roles[role].append(recording)
        for role, found in hours.items():
            if 0 < found < self.hours:
                log.warning(
                    "%s has %.2f h of %s, onset.hours=%g were asked for: give onset.streams more",
                    role,
                    found,
                    self.slip_free,
                    self.hours,
                )
        for scene in needed:
            if not any(recording.scene == scene for recording in roles["calibrate"]):
                raise ValueError(
                    f"no recording of scene {scene} that was not trained on is left to calibrate "
                    "on; give onset.streams more cycles of it"
                )
        return roles

    def __call__(
        self,
        detector: SlipDetector,
        others: Mapping[str, Scorer] | None = None,
        num_workers: int | None = None,
    ) -> dict[str, Any]:
        """Set the alarm of a detector, in its ``info``, and evaluate it.

        Args:
            detector: fitted.
            others: baselines by name, which are calibrated and evaluated alike.
            num_workers: processes that score streams.

        Returns:
            JSON-able: ``"rule"``, ``"settings"`` of it, ``"sample_rate_hz"``; ``"streams"``,
            recordings, hours and slips of each role and scene; ``"methods"``; ``"reliability"`` of
            each role; ``"events"`` of the protocol and of the scene without slip, by role and
            method; ``"scenes"``, the same of every other scene by role, and whether it was
            ``"trained"`` on.

        Raises:
            ValueError: if there is nothing to calibrate on.
        """
        roles = self.roles(detector)
        role_of = {recording: role for role, own in roles.items() for recording in own}
        scorers: dict[str, Scorer] = {OURS: detector, **(others or {})}
        streams: dict[str, list[Stream]] = {role: [] for role in roles}
        for stream in watch(self.streams, list(role_of), scorers, self.hop_samples, num_workers):
            streams[role_of[stream.recording]].append(stream)
        rate = self.streams.sample_rate_hz
        clocks = {
            name: Clock(rate, self.hop_samples, scorer.pool.bin_samples, scorer.look_ahead)
            for name, scorer in scorers.items()
        }
        amounts = amounts_of(streams)
        calibrating = streams.pop("calibrate")
        methods = self.methods(calibrating, clocks)
        settings = methods[self.rule].settings
        metadata = {
            "simulated": self.streams.is_simulated,
            "streams": amounts["calibrate"],
            "threshold_curve": threshold_curve(self._quiet(calibrating), settings, clocks[OURS]),
        }
        settings = replace(settings, facts={**settings.facts, **metadata})
        detector.info[KEY] = settings.to_dict()
        usual: dict[str, list[Stream]] = {}
        scenes: dict[str, dict[str, list[Stream]]] = {}
        for role, own in streams.items():
            for stream in own:
                scene = stream.recording.scene
                if scene in (PAPER_SCENE, self.slip_free):
                    usual.setdefault(f"{role} stream", []).append(stream)
                else:
                    scenes.setdefault(scene, {}).setdefault(role, []).append(stream)
        compute_s = {OURS: push_seconds(detector, settings)}
        rows = [
            (part, name)
            for part in [*usual.values(), *(own for of in scenes.values() for own in of.values())]
            for name in methods
        ]
        events: dict[int, dict[str, Any]] = {}
        for part, name in bar(rows, "events", "table row"):
            method = methods[name]
            clock = clocks[method.scorer]
            latency = LatencyParts(clock.look_ahead_s, clock.bin_s, compute_s.get(method.scorer))
            made = decide(part, method.scorer, method.settings, clock)
            seen = [watched(stream, decisions) for stream, decisions in made]
            found = event_metrics(seen, EventRules(), latency, level=self.level)
            events.setdefault(id(part), {})[name] = found
        trained = {
            name.split("/")[2]
            for name in detector.info.get("train_recordings", {})
            if name.count("/") > 1
        }
        return {
            "rule": self.rule,
            "sample_rate_hz": rate,
            "settings": settings.to_dict(),
            "streams": amounts,
            "methods": {name: method.to_dict() for name, method in methods.items()},
            "reliability": reliability_of(usual, settings, clocks[OURS]),
            "events": {name: events[id(part)] for name, part in usual.items()},
            "scenes": {
                scene: {"trained": scene in trained}
                | {role: events[id(part)] for role, part in by_role.items()}
                for scene, by_role in scenes.items()
            },
        }

    def methods(self, streams: Sequence[Stream], clocks: Mapping[str, Clock]) -> dict[str, Method]:
        """Every rule on our scores, the main one on those of the others, and the paper's own.

        The paper's rule, ``FIRST_TRANSITION``, makes every change of the score to slip an alarm,
        one decision a bin: there is no threshold but the score's own, and no memory beyond the bin
        before. It is left out where the hop does not divide the bin.

        Args:
            streams: that calibrate.
            clocks: of every scorer, ``OURS`` included.

        Raises:
            ValueError: if our scores cannot be calibrated; others whose cannot are left out.
        """
        rules, methods = self.made_rules(clocks[OURS].bin_samples), {}
        for scorer, clock in clocks.items():
            try:
                calibration = FITS[self.calibration](*labelled(streams, scorer, clock))
            except ValueError as error:
                if scorer == OURS:
                    raise
                log.warning("%s is left out: %s", scorer, error)
                continue
            for name, rule in rules.items() if scorer == OURS else [(scorer, rules[self.rule])]:
                methods[name] = self.calibrated(scorer, rule, calibration, streams, clock)
            if scorer == OURS and clock.bin_samples % clock.hop_samples == 0:
                settings = self._settings(KOfN(1, 1), Platt(1.0, 0.0), clock.bin_samples)
                settings = replace(settings, threshold=_ABOVE_NEUTRAL, rearm_s=0, refractory_s=0)
                methods[FIRST_TRANSITION] = Method(scorer, settings, None)
        return methods

    def calibrated(
        self,
        scorer: str,
        rule: Rule,
        calibration: Calibration,
        streams: Sequence[Stream],
        clock: Clock,
    ) -> Method:
        """A rule with the threshold for the rate, and the lead of its onset estimates.

        A ``Cusum`` without ceiling gets one above its threshold. A sum that is capped is sooner low
        again, so what was one alarm can be two: it is counted anew, by the rule that goes into the
        file, and the threshold is raised until the rate is kept.

        Args:
            scorer: whose scores.
            rule: what makes statistics of them.
            calibration: what makes ratios of them.
            streams: that calibrate, those of the scene without slip included.
            clock: of the scores.
        """
        settings = self._settings(rule, calibration, clock.hop_samples)
        quiet = self._quiet(streams)
        highest = math.inf  # of a statistic that is itself a ratio, what the calibration gives
        if isinstance(rule, KOfN) and isinstance(calibration, Isotonic):
            highest = max(calibration.llrs)
        threshold = choose_threshold(
            [made.statistic for _, made in decide(quiet, scorer, settings, clock)],
            rule,
            clock.hop_s,
            self.false_alarms_per_hour,
            rearm=settings.decisions(self.rearm_s, clock.sample_rate_hz),
            refractory=settings.decisions(self.refractory_s, clock.sample_rate_hz),
            ceiling=highest,
            level=self.level,
        )
        settings = replace(settings, threshold=threshold.value)
        if isinstance(rule, Cusum) and rule.ceiling == math.inf and threshold.value > 0:
            allowed = math.floor(self.false_alarms_per_hour * threshold.rate.hours)
            value = threshold.value
            while True:
                capped = replace(rule, ceiling=CEILING * value)
                settings = replace(settings, rule=capped, threshold=value)
                made = [decisions for _, decisions in decide(quiet, scorer, settings, clock)]
                counts = [int(decisions.is_alarm.sum()) for decisions in made]
                if sum(counts) <= allowed:
                    break
                value *= _STEP
            hours = [len(decisions.number) * clock.hop_s / 3600 for decisions in made]
            rate = alarm_rate(counts, hours, self.level)
            threshold = replace(threshold, value=value, rate=rate)
        facts = {"slip_free": self.slip_free, "calibrated": asdict(threshold)}
        lead_s = _lead_s(streams, scorer, settings, clock)
        return Method(scorer, replace(settings, lead_s=lead_s, facts=facts), threshold)

    def _settings(self, rule: Rule, calibration: Calibration, hop_samples: int) -> AlarmSettings:
        """Without a threshold yet."""
        return AlarmSettings(
            hop_samples,
            calibration,
            rule,
            math.inf,
            self.false_alarms_per_hour,
            self.slip_share,
            self.rearm_s,
            self.refractory_s,
        )

    def _quiet(self, streams: Sequence[Stream]) -> list[Stream]:
        return [stream for stream in streams if stream.recording.scene == self.slip_free]


@dataclass(frozen=True)
class DebouncedAlarm:
    """The stage behind the fit.

    Args:
        hop_ms: distance of two decisions; ``None`` for half a bin.
        k: so many decisions must say slip,
        n: of so many.
        probability: at which a decision says slip.
        slip_share: how much of a stream is slip, for probabilities.
        rearm_s: how long the statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.

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

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            is_number = type(value) in (int, float)
            if name in ("k", "n"):
                is_fine, wanted = type(value) is int, "be a whole number"
            elif name in ("probability", "slip_share"):
                is_fine, wanted = is_number and 0 < value < 1, "lie between 0 and 1"
            elif name == "hop_ms":
                is_fine = value is None or (is_number and 0 < value < math.inf)
                wanted = "be positive, or null"
            else:
                is_fine, wanted = is_number and 0 <= value < math.inf, "be seconds from 0"
            if not is_fine:
                raise ValueError(f"onset.{name} must {wanted}, got {value!r}")
        _ = KOfN(self.k, self.n)

    def hop_samples(self, sample_rate_hz: float, bin_samples: int) -> int:
        """The distance of two decisions in samples.

        Raises:
            ValueError: if it is no whole number of them.
        """
        if self.hop_ms is None:
            return max(bin_samples // 2, 1)
        return whole_samples(self.hop_ms, sample_rate_hz, "onset.hop_ms")

    def __call__(
        self,
        detector: SlipDetector,
        others: Mapping[str, Scorer] | None = None,
        num_workers: int | None = None,
    ) -> dict[str, Any]:
        """Set the alarm of a detector, in its ``info``; there is nothing to report of it.

        Raises:
            ValueError: if training had nothing to choose, so that scores have no calibration.
        """
        known = calibration_of(detector)
        if known is None:
            raise ValueError(
                "onset=debounced needs the calibration of held-out scores, and training chose "
                "nothing; give several recipe.penalties"
            )
        pool = detector.pool
        settings = AlarmSettings(
            hop_samples=self.hop_samples(pool.sample_rate_hz, pool.bin_samples),
            calibration=known[0],
            rule=KOfN(self.k, self.n),
            threshold=_log_odds(self.probability) - _log_odds(self.slip_share),
            target_per_hour=None,
            slip_share=self.slip_share,
            rearm_s=self.rearm_s,
            refractory_s=self.refractory_s,
        )
        detector.info[KEY] = settings.to_dict()
        return {}


def _log_odds(probability: float) -> float:
    return math.log(probability / (1 - probability))
