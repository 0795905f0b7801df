"""The alarm of a fitted detector, set on recordings that it was not trained on.

``CalibratedAlarm`` sets it for a false-alarm rate. Half of the cycles of the materials seen in
training *calibrate*: score to log likelihood ratio, the threshold of every rule, how far an onset
lies back. The other half and the held-out materials evaluate the result and set nothing.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.data.labels import whole_samples
from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
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
from tactslip_torch.onset.decisions import (
    KEY,
    AlarmSettings,
    Decider,
    Decisions,
    Scorer,
    calibration_of,
    is_usable,
    score_stream,
)
from tactslip_torch.onset.events import (
    EventRules,
    LatencyParts,
    Watched,
    first_releases,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.rules import Cusum, KOfN, Rule, rule_from_dict
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.onset.thresholds import alarm_counts, alarm_rate, choose_threshold
from tactslip_torch.report.metrics import weights_at_share
from tactslip_torch.runtime import bar, check_number, in_processes, one_thread

log = logging.getLogger(__name__)

OURS = "detector"
"""The name of the detector among those that score; the others are baselines."""

FIRST_TRANSITION = "first transition"
"""The name of the paper's rule."""

FITS: Mapping[str, Callable[[Tensor, Tensor], Calibration]] = {
    "platt": fit_platt,
    "isotonic": fit_isotonic,
}
"""From scores to log likelihood ratios."""

LEAST, MOST = 0.1, 1000.0
"""False alarms an hour that are of interest."""

_CEILING = 1.5  # largest sum of Cusum in thresholds: what lies above only takes time to come down
_STEP = 1.01  # by which a threshold is raised that a capped sum does not keep
_ABOVE_NEUTRAL = 1e-30  # a score of slip, and no decision that tells nothing
_NUM_POINTS = 25  # of a threshold curve, at most
_NUM_TRIED = 100
_TOGETHER = 256  # streams decided at once
_PUSHES = 200  # timed


# Streams, and what a detector decides in them ----------------------------------------------------


class Stream(NamedTuple):
    """A recording as a detector scored it, one decision per hop.

    Attributes:
        recording: which.
        times: when things happen in it.
        score: ``[N]``, float32.
        is_valid: whether every channel in use could be trusted, ``[N]``.
        is_usable: whether the score tells anything: some channel in use was there, ``[N]``.
    """

    recording: RecordingId
    times: Timeline
    score: Tensor
    is_valid: Tensor
    is_usable: Tensor


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
    hop_samples: int,
    num_workers: int | None = None,
) -> dict[str, list[Stream]]:
    """The recordings, in order, as each detector scores them; made by workers.

    Args:
        source: of the recordings.
        recordings: which of them.
        scorers: detectors by name.
        hop_samples: distance of two decisions.
        num_workers: processes; ``None`` for as many as there are processors, at most 8.

    Raises:
        ValueError: if a recording has other channels than a detector.
    """
    scored = partial(_scored, source, scorers, hop_samples)
    rows = list(in_processes(scored, recordings, "watch streams", "recording", num_workers))
    return {name: [row[place] for row in rows] for place, name in enumerate(scorers)}


def _scored(
    source: RecordingSource,
    scorers: Mapping[str, Scorer],
    hop_samples: int,
    recording: RecordingId,
) -> list[Stream]:
    samples, times = source.load(recording).samples, source.timeline(recording)
    streams = []
    for scorer in scorers.values():
        found = score_stream(scorer, samples, hop_samples)
        usable = is_usable(found.score, found.is_missing, scorer.needed_index)
        streams.append(Stream(recording, times, found.score.float(), found.is_valid, usable))
    return streams


def labelled(streams: Sequence[Stream], timing: Timing) -> tuple[Tensor, Tensor]:
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
    """What a detector decides in each stream; those of one length are decided together.

    ``settings.hop_samples`` may be a multiple of the timing's: so many decisions are left out.

    Yields:
        Every stream with its decisions, in order of length.
    """
    step = settings.hop_samples // timing.hop_samples
    for _, group in groupby(sorted(streams, key=_length), key=_length):
        alike = list(group)
        for first in range(0, len(alike), _TOGETHER):
            part = alike[first : first + _TOGETHER]
            decider = Decider(
                settings, timing.sample_rate_hz, timing.bin_samples, timing.look_ahead
            )
            made = decider.decide(
                torch.stack([stream.score[::step] for stream in part]),
                torch.stack([stream.is_valid[::step] for stream in part]),
                torch.stack([stream.is_usable[::step] for stream in part]),
            )
            for row, stream in enumerate(part):
                yield stream, Decisions(*(x[row] if x.ndim > 1 else x for x in made))


def _length(stream: Stream) -> int:
    return len(stream.score)


def watched(stream: Stream, decisions: Decisions) -> Watched:
    """The alarms of a stream beside what is true of it."""
    times, available_s = stream.times, decisions.available_s.numpy()
    raised = np.flatnonzero(decisions.is_alarm.numpy())
    off = np.append(np.flatnonzero(~decisions.is_on.numpy()), len(available_s))
    ends = off[np.searchsorted(off, raised)]
    says_slip = available_s[np.flatnonzero(decisions.llr.numpy() > 0)]
    releases_s = first_releases(times.onsets_s, times.released_s)
    first = np.append(says_slip, math.nan)[np.searchsorted(says_slip, releases_s)]
    return Watched(
        recording=str(stream.recording),
        material=stream.recording.material,
        scene=stream.recording.scene,
        duration_s=times.duration_s,
        alarms_s=tuple(available_s[raised].tolist()),
        onset_estimates_s=tuple(decisions.onset_s.numpy()[raised].tolist()),
        onsets_s=times.onsets_s,
        sliding_s=times.sliding_s,
        speeds_mm_s=times.speeds_mm_s,
        first_positive_s=tuple(first.tolist()),
        alarm_ends_s=tuple(np.append(available_s, math.inf)[ends].tolist()),
        released_s=times.released_s,
    )


# What is told of an alarm ------------------------------------------------------------------------


def threshold_curve(
    quiet: Sequence[Stream], settings: AlarmSettings, timing: Timing
) -> list[list[float]]:
    """Thresholds and the false alarms of the detector an hour at each, by the rule in the settings.

    Rates fall as thresholds rise; from ``LEAST`` to ``MOST`` an hour, at most 25 points that are
    about equally far apart by the rate's logarithm. Fewer where the recordings show no more: none
    is below one alarm in all of them.

    Args:
        quiet: recordings in which nothing slips.
        settings: calibration, rule, re-arming; their threshold does not count.
        timing: of the scores.
    """
    statistics = [made.statistic for _, made in decide(quiet, settings, timing)]
    hours = sum(map(len, statistics)) * timing.hop_s / 3600
    falling = torch.cat(statistics).sort(descending=True).values
    ranks = np.unique(np.geomspace(1, len(falling), _NUM_TRIED).astype(int)) - 1
    points = list[list[float]]()
    for value in dict.fromkeys(falling[ranks].tolist()):
        alarms = alarm_counts(
            statistics,
            value,
            rearm=settings.decisions(settings.rearm_s, timing.sample_rate_hz),
            refractory=settings.decisions(settings.refractory_s, timing.sample_rate_hz),
        )
        rate = int(alarms.sum()) / hours
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
        scores, is_slip = labelled(own, timing)
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
    hop = torch.randn(settings.hop_samples, len(detector.pool.hand), generator=generator)
    seconds = []
    with one_thread():
        live.push(hop.repeat(-(-2 * detector.pool.bin_samples // settings.hop_samples), 1))  # full
        for _ in range(_PUSHES):
            started = time.perf_counter()
            live.push(hop)
            seconds.append(time.perf_counter() - started)
    return statistics.median(seconds[_PUSHES // 10 :])


def _lead_s(streams: Sequence[Stream], settings: AlarmSettings, timing: Timing) -> float:
    """From an onset to where the run of ratios that found it began: the median."""
    errors = []
    for stream, decisions in decide(streams, settings, timing):
        seen = watched(stream, decisions)
        for onset_s in seen.onsets_s:
            later = [
                estimate - onset_s
                for alarm, estimate in zip(seen.alarms_s, seen.onset_estimates_s, strict=True)
                if onset_s <= alarm <= onset_s + EventRules().found_within_s
            ]
            errors += later[:1]
    return statistics.median(errors) if errors else 0.0


# The stages behind a fit -------------------------------------------------------------------------


@dataclass(frozen=True)
class CalibratedAlarm:
    """Sets the alarm of a fitted detector for a false-alarm rate.

    Args:
        streams: recordings, those trained on included or not; of the paper's scene, without
            slip, and of confounding scenes.
        hop_ms: distance of two decisions.
        false_alarms_per_hour: at most.
        hours: of recordings without slip, at most, to set thresholds on, and as many to check
            them on, for seen and for held-out materials.
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
        _check_numbers(self, positive=("hop_ms", "false_alarms_per_hour", "hours"))
        if not 0 < self.level < 1:
            raise ValueError(f"onset.level must lie between 0 and 1, got {self.level}")
        self.made_rules(self.hop_samples)  # bad numbers are refused now

    @property
    def hop_samples(self) -> int:
        """Distance of two decisions."""
        return whole_samples(self.hop_ms, self.streams.sample_rate_hz, "onset.hop_ms")

    def made_rules(self, bin_samples: int) -> dict[str, Rule]:
        """The rules; where they leave it open, evidence is hop / bin."""
        evidence = min(1.0, self.hop_samples / bin_samples)
        return {
            name: rule_from_dict(
                {**given, "evidence": evidence} if given.get("evidence", 1) is None else given
            )
            for name, given in self.rules.items()
        }

    def roles(self, detector: SlipDetector) -> dict[str, list[RecordingId]]:
        """Which recordings calibrate, and which evaluate, of seen and of held-out materials.

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
        baselines: Mapping[str, Scorer] | None = None,
        num_workers: int | None = None,
    ) -> dict[str, Any]:
        """Set the alarm of a detector, in its ``info``, and evaluate it.

        Args:
            detector: fitted.
            baselines: by name; they are calibrated and evaluated alike.
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
        recordings = [recording for own in roles.values() for recording in own]
        scorers: dict[str, Scorer] = {OURS: detector, **(baselines or {})}
        scored = score_streams(self.streams, recordings, scorers, self.hop_samples, num_workers)
        rate, num_calibrate = self.streams.sample_rate_hz, len(roles["calibrate"])
        timings = {
            name: Timing(rate, self.hop_samples, scorer.pool.bin_samples, scorer.look_ahead)
            for name, scorer in scorers.items()
        }
        calibrating = {name: own[:num_calibrate] for name, own in scored.items()}
        methods = self.methods(calibrating, timings)
        amounts = self._amounts(roles)
        _, settings = methods[self.rule]
        curve = threshold_curve(self._quiet(calibrating[OURS]), settings, timings[OURS])
        metadata = {
            **settings.metadata,
            "simulated": self.streams.is_simulated,
            "streams": amounts["calibrate"],
            "threshold_curve": curve,
        }
        settings = replace(settings, metadata=metadata)
        detector.info[KEY] = settings.to_dict()
        places = [role for role, own in roles.items() for _ in own]
        groups: dict[tuple[str, str], list[int]] = {}  # by scene, "" for the usual ones, and role
        for index, (role, recording) in enumerate(zip(places, recordings, strict=True)):
            scene = "" if recording.scene in (PAPER_SCENE, self.slip_free) else recording.scene
            if role != "calibrate":
                groups.setdefault((scene, role), []).append(index)
        compute_s = {OURS: _push_seconds(detector, settings)}
        events: dict[str, dict[str, dict[str, Any]]] = {"": {}}
        rows = [(group, name) for group in groups for name in methods]
        for (scene, role), name in bar(rows, "events", "table row"):
            scorer, made = methods[name]
            own = [scored[scorer][index] for index in groups[scene, role]]
            found = self._events(own, made, timings[scorer], compute_s.get(scorer))
            events.setdefault(scene, {}).setdefault(role, {})[name] = found
        told = {
            f"{role} stream": _reliability(
                [scored[OURS][index] for index in groups["", role]], settings, timings[OURS]
            )
            for role in events[""]
        }
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
            "methods": {
                name: {
                    "scorer": scorer,
                    "calibrated": made.metadata.get("calibrated"),
                    **made.to_dict(),
                }
                for name, (scorer, made) in methods.items()
            },
            "reliability": {name: found for name, found in told.items() if found},
            "events": {f"{role} stream": found for role, found in events.pop("").items()},
            "scenes": {
                scene: {"trained": scene in trained} | by_role for scene, by_role in events.items()
            },
        }

    def methods(
        self, streams: Mapping[str, Sequence[Stream]], timings: Mapping[str, Timing]
    ) -> dict[str, tuple[str, AlarmSettings]]:
        """By name whose scores, and what makes alarms of them.

        Every rule on our scores, the main one on those of baselines, and the paper's own.

        The paper's rule, ``FIRST_TRANSITION``, makes every change of the score to slip an alarm,
        one decision a bin: there is no threshold but the score's own, and no memory beyond the bin
        before. It is left out where the hop does not divide the bin.

        Args:
            streams: that calibrate, by scorer, ``OURS`` included.
            timings: of every scorer.

        Raises:
            ValueError: if our scores cannot be calibrated; baselines whose cannot are left out.
        """
        rules, methods = self.made_rules(timings[OURS].bin_samples), {}
        for scorer, timing in timings.items():
            try:
                calibration = FITS[self.calibration](*labelled(streams[scorer], timing))
            except ValueError as error:
                if scorer == OURS:
                    raise
                log.warning("%s is left out: %s", scorer, error)
                continue
            for name, rule in rules.items() if scorer == OURS else [(scorer, rules[self.rule])]:
                settings = self.calibrated(rule, calibration, streams[scorer], timing)
                methods[name] = scorer, settings
            if scorer == OURS and timing.bin_samples % timing.hop_samples == 0:
                settings = self._settings(KOfN(1, 1), Platt(1.0, 0.0), timing.bin_samples)
                settings = replace(settings, threshold=_ABOVE_NEUTRAL, rearm_s=0, refractory_s=0)
                methods[FIRST_TRANSITION] = scorer, settings
        return methods

    def calibrated(
        self, rule: Rule, calibration: Calibration, streams: Sequence[Stream], timing: Timing
    ) -> AlarmSettings:
        """A rule with the threshold for the rate, and the lead of its onset estimates.

        The ``Threshold`` is told in the settings' metadata, as ``"calibrated"``.

        A ``Cusum`` without ceiling gets one above its threshold. A sum that is capped is sooner low
        again, so what was one alarm can be two: they are counted again by the rule that goes into
        the file, and the threshold is raised until the rate is kept.

        Args:
            rule: what makes statistics of ratios.
            calibration: what makes ratios of scores.
            streams: that calibrate, those of the scene without slip included.
            timing: of the scores.
        """
        settings = self._settings(rule, calibration, timing.hop_samples)
        quiet = self._quiet(streams)
        highest = math.inf  # of a statistic that is itself a ratio, what the calibration gives
        if isinstance(rule, KOfN) and isinstance(calibration, Isotonic):
            highest = max(calibration.llrs)
        threshold = choose_threshold(
            [made.statistic for _, made in decide(quiet, settings, timing)],
            rule,
            timing.hop_s,
            self.false_alarms_per_hour,
            rearm=settings.decisions(self.rearm_s, timing.sample_rate_hz),
            refractory=settings.decisions(self.refractory_s, timing.sample_rate_hz),
            ceiling=highest,
            level=self.level,
        )
        settings = replace(settings, threshold=threshold.value)
        if isinstance(rule, Cusum) and rule.ceiling == math.inf and threshold.value > 0:
            allowed = math.floor(self.false_alarms_per_hour * threshold.rate.hours)
            counts, value = [allowed + 1], threshold.value / _STEP
            while sum(counts) > allowed:
                value *= _STEP
                capped = replace(rule, ceiling=_CEILING * value)
                settings = replace(settings, rule=capped, threshold=value)
                made = [decisions for _, decisions in decide(quiet, settings, timing)]
                counts = [int(decisions.is_alarm.sum()) for decisions in made]
            hours = [len(decisions.number) * timing.hop_s / 3600 for decisions in made]
            rate = alarm_rate(counts, hours, self.level)
            threshold = replace(threshold, value=value, rate=rate)
        metadata = {"slip_free": self.slip_free, "calibrated": asdict(threshold)}
        lead_s = _lead_s(streams, settings, timing)
        return replace(settings, lead_s=lead_s, metadata=metadata)

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

    def _events(
        self,
        streams: Sequence[Stream],
        settings: AlarmSettings,
        timing: Timing,
        compute_s: float | None,
    ) -> dict[str, Any]:
        rate = timing.sample_rate_hz
        latency = LatencyParts(timing.look_ahead / rate, timing.bin_samples / rate, compute_s)
        seen = [
            recording_events(watched(*made), EventRules(), latency)
            for made in decide(streams, settings, timing)
        ]
        return pooled_metrics(seen, level=self.level)

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

    def _quiet(self, streams: Sequence[Stream]) -> list[Stream]:
        return [stream for stream in streams if stream.recording.scene == self.slip_free]


@dataclass(frozen=True)
class DebouncedAlarm:
    """Sets the alarm of a fitted detector at no given rate: k of the last n decisions say slip.

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
        _check_numbers(self, positive=() if self.hop_ms is None else ("hop_ms",))
        for name in ("k", "n"):
            check_number(f"onset.{name}", getattr(self, name), whole=True)
        KOfN(self.k, self.n)

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
        known = calibration_of(detector)
        if known is None:
            raise ValueError(
                "onset=debounced needs the calibration of held-out scores, and training chose "
                "nothing; give several recipe.penalties"
            )
        pool = detector.pool
        odds, share_odds = (p / (1 - p) for p in (self.probability, self.slip_share))
        settings = AlarmSettings(
            hop_samples=self.hop_samples(pool.sample_rate_hz, pool.bin_samples),
            calibration=known[0],
            rule=KOfN(self.k, self.n),
            threshold=math.log(odds) - math.log(share_odds),
            target_per_hour=None,
            slip_share=self.slip_share,
            rearm_s=self.rearm_s,
            refractory_s=self.refractory_s,
        )
        detector.info[KEY] = settings.to_dict()


def _check_numbers(stage: CalibratedAlarm | DebouncedAlarm, positive: Sequence[str]) -> None:
    """Refuse numbers that cannot be, of both stages."""
    for name in positive:
        check_number(f"onset.{name}", getattr(stage, name))
    for name in ("rearm_s", "refractory_s"):
        check_number(f"onset.{name}", getattr(stage, name), least=0)
    for name in ("slip_share", "probability"):
        value = getattr(stage, name, 0.5)
        if type(value) not in (int, float) or not 0 < value < 1:
            raise ValueError(f"onset.{name} must lie between 0 and 1, got {value!r}")
