"""From scores to decisions and alarms, piece by piece: what streams and whole recordings share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.calibration import probability
from tactslip_torch.model.widening import widened_llr
from tactslip_torch.onset.latch import Latch, latch, latch_start
from tactslip_torch.onset.sequential import NEUTRAL
from tactslip_torch.onset.settings import AlarmSettings


@dataclass(frozen=True)
class Alarm:
    """An alarm, as it was raised.

    Args:
        alarm_s: when it could be raised: the end of the deciding bin and the look-ahead.
        onset_s: when the slip is thought to have begun, no later than that.
        score: of the deciding bin.
        probability: that the deciding bin is slip.
        statistic: of the rule.
        is_valid: whether every channel in use could be trusted.
    """

    alarm_s: float
    onset_s: float
    score: float
    probability: float
    statistic: float
    is_valid: bool


class Decisions(NamedTuple):
    """One entry per decision, in order; of several streams at once, one row each.

    Attributes:
        number: of the decision in its stream, from 0, ``[m]``, int64.
        available_s: when it can be made, ``[m]``, float64.
        onset_s: when the slip began that it speaks of, as far as it can tell, ``[*, m]``, float64.
        score: at least 0 is slip, ``[*, m]``.
        llr: log likelihood ratio; ``NEUTRAL`` where the score tells nothing, ``[*, m]``.
        probability: of slip, by the bin alone, ``[*, m]``.
        statistic: of the rule, ``[*, m]``.
        is_valid: whether every channel in use could be trusted, ``[*, m]``.
        is_alarm: whether it raises an alarm, ``[*, m]``.
        is_on: whether an alarm stands after it: the contact's status, ``[*, m]``.
    """

    number: Tensor
    available_s: Tensor
    onset_s: Tensor
    score: Tensor
    llr: Tensor
    probability: Tensor
    statistic: Tensor
    is_valid: Tensor
    is_alarm: Tensor
    is_on: Tensor

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """The alarms that were raised, in order; of one stream."""
        return tuple(
            Alarm(
                alarm_s=float(self.available_s[i]),
                onset_s=float(self.onset_s[i]),
                score=float(self.score[i]),
                probability=float(self.probability[i]),
                statistic=float(self.statistic[i]),
                is_valid=bool(self.is_valid[i]),
            )
            for i in self.is_alarm.nonzero().flatten().tolist()
        )


class Decider:
    """Scores in, decisions out; its memory has a fixed size.

    Args:
        settings: calibration, rule, threshold.
        sample_rate_hz: of the stream.
        bin_samples: length of a bin.
        look_ahead: samples behind its bin that a decision waits for.

    Example:
        >>> from tactslip_torch.model.calibration import Platt
        >>> from tactslip_torch.onset.sequential import KOfN
        >>> settings = AlarmSettings(20, Platt(4.0, 0.0), KOfN(2, 3), 1.0, target_per_hour=1.0)
        >>> decider = Decider(settings, 2000.0, bin_samples=100, look_ahead=25)
        >>> score = torch.tensor([-1.0, -1.0, 0.5, -1.0, 0.6, 0.7])
        >>> [round(alarm.alarm_s, 4) for alarm in decider.decide(score, score.isfinite()).alarms]
        [0.1025]
    """

    def __init__(
        self, settings: AlarmSettings, sample_rate_hz: float, bin_samples: int, look_ahead: int
    ) -> None:
        self.settings = settings
        self._rate = sample_rate_hz
        self._first = bin_samples + look_ahead
        self._rearm = settings.decisions(settings.rearm_s, sample_rate_hz)
        self._refractory = settings.decisions(settings.refractory_s, sample_rate_hz)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next decision is number 0 of a stream that begins at 0."""
        self._number = 0  # Python's integers do not end
        self._state: tuple[Tensor, Latch, Tensor] | None = None

    def decide(
        self,
        score: Tensor,
        is_valid: Tensor,
        is_usable: Tensor | None = None,
        variance: Tensor | None = None,
    ) -> Decisions:
        """The next decisions.

        Args:
            score: of bins, in order.
            is_valid: whether every channel in use could be trusted; handed on.
            is_usable: whether the score tells anything (``is_usable``); where not, the evidence is
                ``NEUTRAL``. By default ``is_valid``.
            variance: of scores that are expected ones; evidence is the weaker for it. Default: 0.

        Shape:
            - all: ``[*, m]``; m may be 0, the streams ``*`` are always the same
        """
        settings = self.settings
        if self._state is None:
            like = score.new_zeros(score.shape[:-1])
            none = torch.zeros(like.shape, dtype=torch.int64)
            self._state = settings.rule.start(like), latch_start(like), none
        of_rule, of_latch, run = self._state
        if variance is None:
            llr = settings.calibration.llr(score)
        else:
            llr = widened_llr(settings.calibration, score, variance)
        tells = is_valid if is_usable is None else is_usable
        llr = torch.where(tells & llr.isfinite(), llr, NEUTRAL)
        statistic, of_rule = settings.rule.scan(llr, of_rule)
        is_alarm, is_on, of_latch = latch(
            statistic,
            settings.threshold,
            margin=settings.rule.margin,
            rearm=self._rearm,
            refractory=self._refractory,
            state=of_latch,
        )
        number = torch.arange(self._number, self._number + score.shape[-1])
        runs = _run_starts(llr, number, run)
        self._state = of_rule, of_latch, runs[..., -1] if len(number) else run
        self._number += len(number)
        available_s = self._available_s(number)
        began_s = self._available_s(torch.minimum(runs, number)) - settings.lead_s
        return Decisions(
            number,
            available_s,
            torch.minimum(began_s, available_s),
            score,
            llr,
            probability(llr, settings.slip_share),
            statistic,
            is_valid,
            is_alarm,
            is_on,
        )

    def _available_s(self, number: Tensor) -> Tensor:
        samples = number * self.settings.hop_samples + self._first
        return samples.double() / self._rate


def _run_starts(llr: Tensor, number: Tensor, before: Tensor) -> Tensor:
    """Where the unbroken run of positive ratios up to each decision began, ``[*, m]``.

    Behind a decision that is not positive the next one would begin it: its own number and 1.
    """
    starts = torch.where(llr > 0, before[..., None], number + 1)
    return starts.cummax(-1).values if len(number) else starts


def is_usable(score: Tensor, is_missing: Tensor, needed_index: Tensor) -> Tensor:
    """Whether a score tells anything: it is finite, and some channel in use was there.

    A hand that lost a sensor goes on feeling with the others: the score is the one expected without
    it, the decision is flagged as not valid and still counts, the less the less certain the score
    is. One that lost them all feels nothing.

    Shape:
        - score, output: ``[*]``
        - is_missing: ``[*, C]``
        - needed_index: ``[channels in use]``
    """
    return score.isfinite() & ~is_missing.index_select(-1, needed_index).all(-1)
