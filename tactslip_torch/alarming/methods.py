"""Ways to alarm, set on recordings that calibrate: calibration, threshold, lead."""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.alarming.watching import Clock, Stream, decide, slip_bins, watched
from tactslip_torch.model.calibration import (
    Calibration,
    Isotonic,
    Platt,
    fit_isotonic,
    fit_platt,
)
from tactslip_torch.onset.events import EventRules
from tactslip_torch.onset.rate import Threshold, alarm_rate, choose_threshold
from tactslip_torch.onset.sequential import Cusum, Hysteresis, KOfN, Rule
from tactslip_torch.onset.settings import AlarmSettings

log = logging.getLogger(__name__)

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
        calibrated = None if self.threshold is None else threshold_facts(self.threshold)
        return {"scorer": self.scorer, "calibrated": calibrated, **self.settings.to_dict()}


@dataclass(frozen=True)
class Promise:
    """What thresholds are set for.

    Args:
        false_alarms_per_hour: at most.
        slip_free: the scene to count them on.
        slip_share: how much of a stream is slip, for probabilities.
        rearm_s: how long a statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.
        level: of intervals.
    """

    false_alarms_per_hour: float
    slip_free: str
    slip_share: float
    rearm_s: float
    refractory_s: float
    level: float

    def calibrated(
        self,
        scorer: str,
        rule: Rule,
        calibration: Calibration,
        streams: Sequence[Stream],
        clock: Clock,
    ) -> Method:
        """A rule with the threshold for the promise, and the lead of its onset estimates.

        Args:
            scorer: whose scores.
            rule: what makes statistics of them; a ``Cusum`` without ceiling gets one.
            calibration: what makes ratios of them.
            streams: that calibrate, those of the scene without slip among them.
            clock: of the scores.
        """
        settings = AlarmSettings(
            clock.hop_samples,
            calibration,
            rule,
            math.inf,
            self.false_alarms_per_hour,
            self.slip_share,
            self.rearm_s,
            self.refractory_s,
        )
        quiet = [stream for stream in streams if stream.recording.scene == self.slip_free]
        threshold = choose_threshold(
            [made.statistic for _, made in decide(quiet, scorer, settings, clock)],
            rule,
            clock.hop_s,
            self.false_alarms_per_hour,
            rearm=settings.decisions(self.rearm_s, clock.sample_rate_hz),
            refractory=settings.decisions(self.refractory_s, clock.sample_rate_hz),
            ceiling=_largest(rule, calibration),
            level=self.level,
        )
        if isinstance(rule, Cusum) and rule.ceiling == math.inf and threshold.value > 0:
            settings, threshold = self._capped(rule, settings, threshold, quiet, scorer, clock)
        else:
            settings = replace(settings, threshold=threshold.value)
        facts = {"slip_free": self.slip_free, "calibrated": threshold_facts(threshold)}
        lead_s = _lead_s(streams, scorer, settings, clock)
        return Method(scorer, replace(settings, lead_s=lead_s, facts=facts), threshold)

    def _capped(
        self,
        rule: Cusum,
        settings: AlarmSettings,
        threshold: Threshold,
        quiet: Sequence[Stream],
        scorer: str,
        clock: Clock,
    ) -> tuple[AlarmSettings, Threshold]:
        """The same sum with a ceiling above its threshold, which is raised until it keeps the rate.

        A sum that is capped is sooner low again, so what was one alarm can be two: it is counted
        anew, by the rule that goes into the file.
        """
        value, allowed = (
            threshold.value,
            math.floor(self.false_alarms_per_hour * threshold.rate.hours),
        )
        while True:
            capped = replace(rule, ceiling=CEILING * value)
            settings = replace(settings, rule=capped, threshold=value)
            made = [decisions for _, decisions in decide(quiet, scorer, settings, clock)]
            counts = [int(decisions.is_alarm.sum()) for decisions in made]
            if sum(counts) <= allowed:
                hours = [len(decisions.number) * clock.hop_s / 3600 for decisions in made]
                rate = alarm_rate(counts, hours, self.level)
                return settings, replace(threshold, value=value, rate=rate)
            value *= _STEP

    def first_transition(self, scorer: str, clock: Clock) -> Method:
        """The paper's rule: every change of the score to slip is an alarm, one decision a bin.

        There is no threshold but the score's own, and no memory beyond the bin before. The clock's
        hop must divide the bin.
        """
        settings = AlarmSettings(
            clock.bin_samples,
            Platt(1.0, 0.0),
            KOfN(1, 1),
            _ABOVE_NEUTRAL,
            self.false_alarms_per_hour,
            self.slip_share,
            rearm_s=0,
            refractory_s=0,
        )
        return Method(scorer, settings, None)


def methods_of(
    promise: Promise,
    rules: Mapping[str, Rule],
    main: str,
    fit: str,
    streams: Sequence[Stream],
    clocks: Mapping[str, Clock],
    ours: str,
    transition: str,
) -> dict[str, Method]:
    """Every rule on our scores, the main one on those of the others, and the paper's own.

    Args:
        promise: what thresholds are set for.
        rules: by name.
        main: the rule that the others get too; their methods have their own names.
        fit: one of ``FITS``.
        streams: that calibrate.
        clocks: of every scorer, ours among them.
        ours: its name.
        transition: the name of the paper's rule, which is left out where the hop does not divide
            the bin.

    Raises:
        ValueError: if our scores cannot be calibrated; others whose cannot are left out.
    """
    methods = {}
    for scorer, clock in clocks.items():
        try:
            calibration = FITS[fit](*labelled(streams, scorer, clock))
        except ValueError as error:
            if scorer == ours:
                raise
            log.warning("%s is left out: %s", scorer, error)
            continue
        for name, rule in rules.items() if scorer == ours else [(scorer, rules[main])]:
            methods[name] = promise.calibrated(scorer, rule, calibration, streams, clock)
        if scorer == ours and clock.bin_samples % clock.hop_samples == 0:
            methods[transition] = promise.first_transition(scorer, clock)
    return methods


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


def threshold_facts(threshold: Threshold) -> dict[str, Any]:
    """A threshold as JSON types."""
    return {
        "value": threshold.value,
        "target_per_hour": threshold.target_per_hour,
        "reached": threshold.reached,
        "rate": dict(vars(threshold.rate)),
    }


def _largest(rule: Rule, calibration: Calibration) -> float:
    """What the statistic of a rule that hands ratios on cannot exceed, by their calibration."""
    if isinstance(rule, KOfN | Hysteresis) and isinstance(calibration, Isotonic):
        return max(calibration.llrs)
    return math.inf
