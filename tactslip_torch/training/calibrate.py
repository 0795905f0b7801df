"""Decision threshold and alarm of a fitted detector, set on recordings of its use.

Labelled recordings with slip set the threshold of bins; what is known to be without slip sets the
alarm for a rate of false alarms. False alarms come in bunches, so that the bound of a rate takes
their dispersion into account: the variance of counts in equal stretches of time by their mean. The
threshold is the lowest at which so many false alarms occur as the bound allows. Alarms only become
more as it falls, so the bound holds although it is chosen on the same recordings.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.data.labels import LabelRule, bins_of
from tactslip_torch.data.recording import Stretch, Timeline
from tactslip_torch.model.calibration import Platt, fit_platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.events import EventRules, LatencyParts, OnsetEvent, recording_events
from tactslip_torch.onset.rules import Budget, Cusum, KOfN, lowest_threshold
from tactslip_torch.training.alarm import (
    BudgetScores,
    Stream,
    Timing,
    budget_scores,
    decide,
    event_record,
    threshold_curve,
    within_budgets,
)

SLIP_FREE = "without slip"
"""The scene of what is known to be without slip, whatever was done with the hand."""

_FEWEST_ALARMS = 20  # by which bunches are seen
_LEVELS = (1, 2, 4, 8)  # times as many: lower thresholds
_BLOCKS = (12, 24, 48)  # of equal time
_MARGIN = 1.25  # by which stated rates hold in 95 % of the sets of benchmarks.stated_rates
_NUM_FOLDS = 10
_FEWEST_GROUPS = 3


class ScoredRecording(NamedTuple):
    """A recording, or a stretch of one, as the detector scored it.

    Attributes:
        stream: with what is known of its time.
        quiet: the same; what is not known to be without slip is a slide there.
        alarms: decisions of the alarm where nothing slips.
        bins: scores of labelled bins, ``[N]``.
        is_slip: of these, ``[N]``.
    """

    stream: Stream
    quiet: Stream
    alarms: BudgetScores
    bins: Tensor
    is_slip: Tensor

    @property
    def hours(self) -> float:
        """Valid decisions without slip, in hours."""
        return self.alarms.amount


class Change(NamedTuple):
    """What calibration changes of a detector.

    Attributes:
        shift: score that is the decision threshold now.
        calibration: of scores above the new threshold; ``None``: as it was.
        alarm: settings by the scores as they were.
    """

    shift: float
    calibration: Platt | None
    alarm: AlarmSettings


@dataclass(frozen=True)
class Calibrator:
    """Sets the decision threshold and the alarm of a detector, and evaluates both.

    Args:
        settings: of the alarm, as they are.
        timing: of the scores.
        rule: how bins are labelled.
        per_hour: false alarms an hour, at most; ``None``: the alarm's rate is not set.
        confidence: with which the rate is to hold.

    Raises:
        ValueError: if the rate or the confidence is out of range.
    """

    settings: AlarmSettings
    timing: Timing
    rule: LabelRule
    per_hour: float | None
    confidence: float = 0.95

    def budget(self, dispersion: float = 1.0) -> Budget:
        """The rate as a budget of false alarms."""
        limit = 1.0 if self.per_hour is None else self.per_hour
        return Budget(SLIP_FREE, limit, confidence=self.confidence, dispersion=dispersion)

    def scored(self, stream: Stream) -> ScoredRecording:
        """A stream with its decisions, and with the scores of its labelled bins."""
        times, rate_hz = stream.times, self.timing.sample_rate_hz
        gaps = _complement(times.non_slip_s, times.duration_s)
        starts = tuple(start for start, _ in gaps)
        others = Timeline(starts, starts, (0.0,) * len(gaps), gaps, duration_s=times.duration_s)
        recording = replace(stream.recording, scene=SLIP_FREE)
        quiet = stream._replace(recording=recording, times=others)
        (alarms,) = budget_scores([quiet], self.settings, self.timing, [self.budget()])
        per_sample_ms = 1000 / rate_hz
        rule = replace(
            self.rule,
            bin_ms=self.timing.bin_samples * per_sample_ms,
            hop_ms=self.timing.hop_samples * per_sample_ms,
            assign="majority" if self.rule.assign == "whole" else self.rule.assign,
            shuffle_seed=None,
        )
        laid = bins_of(rule, times, rate_hz)
        place = laid.starts // self.timing.hop_samples
        is_there = place < len(stream.score)
        place, is_slip = place[is_there], laid.is_slip[is_there]
        valid = stream.is_valid[place]
        return ScoredRecording(stream, quiet, alarms, stream.score[place][valid], is_slip[valid])

    def dispersion(self, recordings: Sequence[ScoredRecording]) -> float:
        """Variance of the counts of false alarms in equal stretches by their mean, at least 1.

        The largest over several lengths, and over thresholds at which false alarms are many enough
        to be counted, with a margin on what exceeds 1, as it is an estimate. 1 where none are.
        """
        scores, budget, found = _joined(recordings, self.budget()), self.budget(), [1.0]
        fewest = max(_FEWEST_ALARMS, int(budget.limit * scores.amount))
        for level in _LEVELS:
            alarms = scores.alarms(self._at(scores, level * fewest), self.timing.sample_rate_hz)
            ends = np.cumsum([quiet.sum() for quiet in scores.is_quiet])
            places = [
                end - quiet.sum() + np.cumsum(quiet)[own]
                for end, quiet, own in zip(ends, scores.is_quiet, alarms, strict=True)
            ]
            every = np.concatenate(places)
            if len(every) < _FEWEST_ALARMS / 2:
                continue
            for num in _BLOCKS:
                counts, _ = np.histogram(every, num, (0, ends[-1] + 1))
                found.append(float(counts.var(ddof=1) / counts.mean()))
        return 1 + _MARGIN * (max(found) - 1)

    def fit(
        self,
        recordings: Sequence[ScoredRecording],
        budget: Budget | None = None,
        allowed: int | None = None,
        *,
        moves_bins: bool = False,
    ) -> Change:
        """What recordings say the detector should be.

        Args:
            recordings: to set thresholds on.
            budget: of false alarms; ``None``: no rate is set.
            allowed: false alarms, in place of what the budget allows.
            moves_bins: whether the decision threshold is set.

        Raises:
            ValueError: if a rate cannot be shown, or slip has the lower scores.
        """
        shift, platt, alarm = 0.0, None, self.settings
        if moves_bins:
            bins = torch.cat([one.bins for one in recordings])
            is_slip = torch.cat([one.is_slip for one in recordings])
            shift = decision_threshold(bins, is_slip)
            platt = fit_platt(bins.double() - shift, is_slip)
        if budget is not None:
            rule = alarm.rule
            if isinstance(rule, Cusum):  # its ceiling follows from the threshold
                alarm = replace(alarm, rule=replace(rule, ceiling=math.inf))
            quiet = [one for one in recordings if one.hours]
            own = [one.quiet for one in quiet]
            same = alarm.rule == rule
            scored = [_joined(quiet, budget)] if same else None
            alarm = within_budgets(alarm, own, self.timing, [budget], allowed, scored)
            alarm = replace(alarm, target_per_hour=budget.limit)
        elif platt is not None and self._moves_alarm:
            score = (alarm.threshold - platt.offset) / platt.slope + shift
            old = alarm.calibration
            alarm = replace(alarm, threshold=old.slope * score + old.offset)
        return Change(shift, platt, alarm)

    def apply(self, change: Change, detector: SlipDetector, metadata: Mapping[str, Any]) -> None:
        """Change a detector and its ``info``; metadata is added to that of its alarm."""
        alarm = self.restated(change)
        if change.calibration is not None:
            detector.head = _shifted(detector.head, change.shift)
            detector.info["calibration"] = change.calibration.to_dict()
        more = {**alarm.metadata, **metadata}
        detector.info[KEY] = replace(alarm, metadata=more).to_dict()

    def restated(self, change: Change, threshold: float | None = None) -> AlarmSettings:
        """Settings by the scores as they become, of the changed alarm or at another threshold.

        Alarms of k of n decisions are stated by the new calibration. Others keep what they make of
        samples.
        """
        alarm, platt, old = change.alarm, change.calibration, change.alarm.calibration
        alarm = alarm if threshold is None else alarm.at_threshold(threshold)
        if platt is None:
            return alarm
        if not (isinstance(alarm.rule, KOfN) and platt.slope > 0 and old.slope > 0):
            kept = Platt(old.slope, old.offset + old.slope * change.shift)
            return replace(alarm, calibration=kept)
        score = (alarm.threshold - old.offset) / old.slope - change.shift
        value = platt.slope * score + platt.offset
        if self.per_hour is None and alarm is change.alarm and alarm != self.settings:
            value = self.settings.threshold  # moved with the calibration
        return replace(alarm, calibration=platt, threshold=value)

    def left_out(
        self, recordings: Sequence[ScoredRecording], change: Change, budget: Budget | None
    ) -> tuple[list[Change], str]:
        """For each recording what the others say, and in words what was left out together.

        Groups are left out where there are three or more, else recordings, up to ten at once. As
        many false alarms an hour are allowed as in the change that all recordings make.
        """
        moves_bins = change.calibration is not None
        rows = change.alarm.metadata.get("budget", ())
        rate = rows[0]["allowed"] / rows[0]["amount"] if budget is not None else 0.0
        masks, words = left_out_folds([one.stream.recording.material for one in recordings])
        found = [change] * len(recordings)
        for out in masks:
            rest = [one for one, is_out in zip(recordings, out, strict=True) if not is_out]
            hours = sum(one.hours for one in rest)
            is_slip = torch.cat([one.is_slip for one in rest] or [torch.zeros(0).bool()])
            told = bool(is_slip.any()) and not bool(is_slip.all())
            own = self.fit(
                rest,
                budget if hours else None,
                int(rate * hours),
                moves_bins=moves_bins and told,
            )
            for place, is_out in enumerate(out):
                if is_out:
                    found[place] = own
        return found, words

    def outcome(self, one: ScoredRecording, change: Change) -> dict[str, Any]:
        """What a detector with this change makes of a recording, as counts."""
        says_slip = one.bins >= change.shift
        rate_hz, timing = self.timing.sample_rate_hz, self.timing
        alarms = one.alarms.alarms(change.alarm, rate_hz)
        onsets = list[OnsetEvent]()
        if one.stream.times.onsets_s:
            latency = LatencyParts(timing.look_ahead / rate_hz, timing.bin_samples / rate_hz)
            for made in decide([one.stream], change.alarm, timing):
                record = event_record(*made)
                onsets += recording_events(record, EventRules(), latency).onsets
        return {
            "slip_bins": int(one.is_slip.sum()),
            "slip_right": int((says_slip & one.is_slip).sum()),
            "other_bins": int((~one.is_slip).sum()),
            "other_right": int((~says_slip & ~one.is_slip).sum()),
            "hours": one.hours,
            "false_alarms": sum(map(len, alarms)),
            "slips": len(onsets),
            "found": sum(onset.outcome == "found" for onset in onsets),
            "early": sum(onset.outcome == "early" for onset in onsets),
            "delays_s": [onset.delay_s for onset in onsets if onset.outcome == "found"],
        }

    def curve(self, recordings: Sequence[ScoredRecording], change: Change) -> list[list[float]]:
        """Thresholds of the alarm, by the scores as they were, and false alarms an hour at each."""
        quiet = [one for one in recordings if one.hours]
        return threshold_curve(_joined(quiet, self.budget()), change.alarm, self.timing)

    @property
    def _moves_alarm(self) -> bool:
        """Whether the alarm follows the calibration of bins: one that no rate was set for."""
        settings = self.settings
        is_debounced = isinstance(settings.rule, KOfN) and settings.onset is None
        return is_debounced and settings.target_per_hour is None and settings.calibration.slope > 0

    def _at(self, scores: BudgetScores, num: int) -> AlarmSettings:
        """Settings with about so many false alarms, for counting alone."""
        settings, onset = self.settings, self.settings.onset
        times = settings.latch_times(self.timing.sample_rate_hz)
        rearm, refractory = times["rearm"], times["refractory"]
        statistic = scores.statistic if onset is None else scores.onset_score
        threshold = lowest_threshold(
            statistic, scores.is_quiet, num, rearm=rearm, refractory=refractory
        )
        if onset is not None:
            return settings.at_threshold(threshold)
        rule = settings.rule
        if isinstance(rule, Cusum):
            settings = replace(settings, rule=replace(rule, ceiling=math.inf))
        return replace(settings, threshold=threshold)


def left_out_folds(groups: Sequence[str]) -> tuple[list[list[bool]], str]:
    """What is left out together, and in words.

    Groups are where there are three or more, else recordings; in up to ten folds.

    Args:
        groups: of each recording.

    Returns:
        For each fold which recordings are left out, and what all of them are.
    """
    names = list(dict.fromkeys(groups))
    places = [names.index(group) for group in groups]
    words = f"{len(names)} groups ({', '.join(names[:4])}{', ..' * (len(names) > 4)})"
    if len(names) < _FEWEST_GROUPS:
        places, words = list(range(len(groups))), f"{len(groups)} recordings"
    folds = range(min(_NUM_FOLDS, max(places) + 1))
    return [[place % _NUM_FOLDS == fold for place in places] for fold in folds], words


def held_out_accuracy(recordings: Sequence[ScoredRecording]) -> float:
    """Balanced accuracy of bins at a threshold of 0 or, if that is better, as the others set it.

    0 where there are no valid bins of both classes.
    """
    masks, _ = left_out_folds([one.stream.recording.material for one in recordings])
    bins, is_slip = (torch.cat([getattr(r, n) for r in recordings]) for n in ("bins", "is_slip"))
    if not bool(is_slip.any()) or bool(is_slip.all()):
        return 0.0
    moved = bins.clone()
    for mask in masks:
        is_out = torch.cat(
            [torch.full((len(r.bins),), out) for r, out in zip(recordings, mask, strict=True)]
        )
        rest = is_slip[~is_out]
        if bool(rest.any()) and not bool(rest.all()):
            moved[is_out] -= decision_threshold(bins[~is_out], rest)
    recalls = [
        ((scores[is_slip] >= 0).double().mean(), (scores[~is_slip] < 0).double().mean())
        for scores in (bins, moved)
    ]
    return max(float(slip + other) / 2 for slip, other in recalls)


def decision_threshold(scores: Tensor, is_slip: Tensor) -> float:
    """The score from which bins should be called slip: that of the least balanced error.

    Between two scores; of equally good places the middle one.

    Shape:
        - scores, is_slip (bool): ``[N]``

    Raises:
        ValueError: unless there is slip and non-slip.

    Example:
        >>> scores = torch.tensor([-1.0, 0.0, 2.0, 3.0])
        >>> decision_threshold(scores, torch.tensor([False, False, True, True]))
        1.0
    """
    values, order = scores.double().sort()
    slip = is_slip[order]
    if not bool(slip.any()) or bool(slip.all()):
        raise ValueError("expected bins of slip and of non-slip, got one of them")
    missed = slip.double().cumsum(0) / slip.sum()  # of a threshold just above each score
    false = 1 - (~slip).double().cumsum(0) / (~slip).sum()
    error = (missed + false)[:-1]
    error[values[1:] == values[:-1]] = math.inf
    best = (error <= error.min() + 1e-12).nonzero().flatten()
    place = int(best[len(best) // 2])
    return float(values[place] + values[place + 1]) / 2


def in_stretches(stream: Stream, timing: Timing, number: int) -> list[Stream]:
    """A stream without slip cut into so many of equal length, in each of which rules begin anew."""
    num = len(stream.score)
    edges = [round(part * num / number) for part in range(number + 1)]
    per_bin = len(stream.onset_score) / max(num, 1)
    found = []
    for first, stop in pairwise(edges):
        start_s, end_s = first * timing.hop_s, stop * timing.hop_s
        inside = ((max(a, start_s), min(b, end_s)) for a, b in stream.times.non_slip_s)
        quiet = tuple((a - start_s, b - start_s) for a, b in inside if a < b)
        hops = slice(round(first * per_bin), round(stop * per_bin))
        found.append(
            Stream(
                stream.recording,
                Timeline(non_slip_s=quiet, duration_s=end_s - start_s),
                stream.score[first:stop],
                stream.is_valid[first:stop],
                stream.onset_score[hops],
            )
        )
    return found


def _complement(stretches: Sequence[Stretch], duration_s: float) -> tuple[Stretch, ...]:
    """What lies between stretches, from 0 to the end of the recording."""
    edge, gaps = 0.0, []
    for start, end in sorted(stretches):
        if start > edge + 1e-9:
            gaps.append((edge, start))
        edge = max(edge, end)
    if edge < duration_s - 1e-9:
        gaps.append((edge, duration_s))
    return tuple(gaps)


def _joined(recordings: Sequence[ScoredRecording], budget: Budget) -> BudgetScores:
    """Decisions of all recordings."""
    parts = [one.alarms for one in recordings]
    return BudgetScores(
        budget,
        [x for part in parts for x in part.statistic],
        [x for part in parts for x in part.onset_score],
        [x for part in parts for x in part.is_quiet],
        sum(part.amount for part in parts),
    )


def _shifted(head: QuadraticForm, by: float) -> QuadraticForm:
    """The machine whose score is lower by so much."""
    made = copy.deepcopy(head)
    made.constant -= by
    return made
