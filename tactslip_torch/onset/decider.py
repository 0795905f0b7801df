"""From scores to decisions and alarms, piece by piece: what streams and whole recordings share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.calibration import probability
from tactslip_torch.onset.latch import latch, latch_start
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
    """One entry per decision, in order.

    Attributes:
        number: of the decision in its stream, from 0, ``[m]``, int64.
        available_s: when it can be made, ``[m]``, float64.
        score: at least 0 is slip, ``[m]``.
        llr: log likelihood ratio; ``NEUTRAL`` where the decision is not valid, ``[m]``.
        probability: of slip, by the bin alone, ``[m]``.
        statistic: of the rule, ``[m]``.
        is_valid: whether every channel in use could be trusted, ``[m]``.
        is_alarm: whether it raises an alarm, ``[m]``.
        is_on: whether an alarm stands after it: the contact's status, ``[m]``.
        alarms: those raised, in order.
    """

    number: Tensor
    available_s: Tensor
    score: Tensor
    llr: Tensor
    probability: Tensor
    statistic: Tensor
    is_valid: Tensor
    is_alarm: Tensor
    is_on: Tensor
    alarms: tuple[Alarm, ...]


class Decider:
    """Scores of one stream in, decisions out; its memory has a fixed size.

    Args:
        settings: calibration, rule, threshold.
        sample_rate_hz: of the stream.
        bin_samples: length of a bin.
        look_ahead: samples behind its bin that a decision waits for.
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

    def reset(self, origin_s: float = 0.0) -> None:
        """Forget everything; the next decision is number 0 of a stream that begins at a time."""
        self._origin_s = origin_s
        self._number = 0  # Python's integers do not end
        self._run = 0  # where the unbroken run of positive ratios up to now began
        self._rule_state: Tensor | None = None
        self._latch = latch_start(torch.zeros(()))

    def decide(self, score: Tensor, is_valid: Tensor) -> Decisions:
        """The next decisions.

        Shape:
            - score, is_valid: ``[m]``; m may be 0
        """
        settings = self.settings
        if self._rule_state is None or self._rule_state.dtype != score.dtype:
            self._rule_state = settings.rule.start(score.new_zeros(()))
        llr = settings.calibration.llr(score)
        llr = torch.where(is_valid & llr.isfinite(), llr, NEUTRAL)
        statistic, self._rule_state = settings.rule.scan(llr, self._rule_state)
        is_alarm, is_on, self._latch = latch(
            statistic,
            settings.threshold,
            margin=settings.rule.margin,
            rearm=self._rearm,
            refractory=self._refractory,
            state=self._latch,
        )
        chance = probability(llr, settings.slip_share)
        number = torch.arange(self._number, self._number + len(score))
        available_s = self._available_s(number)
        runs = self._run_starts(llr)
        alarms = tuple(
            Alarm(
                alarm_s=float(available_s[i]),
                onset_s=self._onset_s(runs[i], float(available_s[i])),
                score=float(score[i]),
                probability=float(chance[i]),
                statistic=float(statistic[i]),
                is_valid=bool(is_valid[i]),
            )
            for i in is_alarm.nonzero().flatten().tolist()
        )
        self._number += len(score)
        return Decisions(
            number, available_s, score, llr, chance, statistic, is_valid, is_alarm, is_on, alarms
        )

    def _available_s(self, number: Tensor) -> Tensor:
        samples = number * self.settings.hop_samples + self._first
        return self._origin_s + samples.double() / self._rate

    def _onset_s(self, run: int, alarm_s: float) -> float:
        began_s = float(self._available_s(torch.tensor(run)))
        return min(alarm_s, began_s - self.settings.lead_s)

    def _run_starts(self, llr: Tensor) -> list[int]:
        """Of each decision, the first of the run of positive ratios that ends in it; or itself."""
        here = torch.arange(self._number, self._number + len(llr))
        behind = torch.where(llr > 0, self._run, here + 1)  # a run begins behind the last other
        starts = behind.cummax(0).values if len(llr) else behind
        if len(llr):
            self._run = int(starts[-1])
        return torch.minimum(starts, here).tolist()  # type: ignore[no-any-return]  # of integers
