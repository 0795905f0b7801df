"""From recordings to scores, and from scores to decisions and alarms.

``AlarmSettings`` are what makes alarms of scores, kept in the detector's file. ``score_stream``
scores a whole recording, one bin every hop; ``Decider`` makes decisions and alarms of scores, piece
by piece, for streams and whole recordings alike; ``stream_statistic`` is all of it with gradients,
from raw volts to the statistic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import (
    Calibration,
    calibration_from_dict,
    probability,
)
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import Prediction
from tactslip_torch.onset.evidence import OnsetClassifier
from tactslip_torch.onset.rules import NEUTRAL, NOTHING_YET, Latch, Rule, latch, rule_from_dict
from tactslip_torch.runtime import check_number
from tactslip_torch.signals.filtering import ChannelFilter, extended

KEY = "alarm"
"""Under which ``SlipDetector.info`` keeps the settings."""


Array = NDArray[Any]


@dataclass(frozen=True)
class AlarmSettings:
    """How a stream of scores becomes alarms, and the rate it was set for.

    Args:
        hop_samples: distance of two decisions.
        calibration: from a score to a log likelihood ratio.
        rule: from these to a statistic.
        threshold: at which the statistic raises an alarm.
        target_per_hour: false alarms an hour that the threshold was set for; ``None``: for no rate,
            of false alarms.
        slip_share: how much of a stream is slip; the balance that probabilities are stated for.
        rearm_s: how long the statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.
        lead_s: from an onset to the first decision that speaks for slip, in the middle; the
            estimate of an onset goes back by it.
        metadata: on what the threshold was set, JSON-able: recordings, hours, achieved rate.
        onset: classifier of fast evidence; with it an alarm comes from either, and decisions are
            its hop apart.

    Raises:
        ValueError: if a time or the hop is negative, the share lies outside 0 to 1, or the
            statistic cannot reach the threshold.
    """

    hop_samples: int
    calibration: Calibration
    rule: Rule
    threshold: float
    target_per_hour: float | None
    slip_share: float = 0.5
    rearm_s: float = 0.1
    refractory_s: float = 0.2
    lead_s: float = 0.0
    metadata: Mapping[str, Any] = field(default_factory=dict)
    onset: OnsetClassifier | None = None

    def __post_init__(self) -> None:
        check_number("hop_samples", self.hop_samples, whole=True)
        if not 0 < self.slip_share < 1:
            raise ValueError(f"slip_share must lie between 0 and 1, got {self.slip_share}")
        if self.target_per_hour is not None:
            check_number("target_per_hour", self.target_per_hour)
        if math.isfinite(self.threshold) and self.threshold > self.rule.ceiling:
            raise ValueError(
                f"threshold {self.threshold:g} lies above {self.rule.ceiling:g}, the most that the "
                f"statistic of {self.rule.name} can be: no alarm would ever come; lower it"
            )
        for name in ("rearm_s", "refractory_s"):
            check_number(name, getattr(self, name), least=0)

    def __repr__(self) -> str:
        rate = self.target_per_hour
        aim = "" if rate is None else f" for {rate:g} false alarms an hour"
        onset = "" if self.onset is None else f", onset classifier at {self.onset.threshold:.4g}"
        return (
            f"AlarmSettings({self.rule} at {self.threshold:.4g}{aim}{onset}, a decision every "
            f"{self.decision_samples} samples)"
        )

    @property
    def decision_samples(self) -> int:
        """Distance of two decisions: that of the onset classifier, if there is one."""
        return self.hop_samples if self.onset is None else self.onset.evidence.hop_samples

    @property
    def thresholds(self) -> dict[str, float]:
        """That of the statistic and, with an onset classifier, of its score."""
        of_onset = {} if self.onset is None else {"onset_score": self.onset.threshold}
        return {"statistic": self.threshold} | of_onset

    def decisions(self, seconds: float, sample_rate_hz: float) -> int:
        """A length of time in decisions, rounded up."""
        return -(-round(seconds * sample_rate_hz) // self.decision_samples)

    def latch_times(self, sample_rate_hz: float) -> dict[str, int]:
        """What a latch is told, in decisions."""
        return {
            "rearm": self.decisions(self.rearm_s, sample_rate_hz),
            "refractory": self.decisions(self.refractory_s, sample_rate_hz),
        }

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain JSON types."""
        plain = dict(self.__dict__)
        plain["calibration"] = self.calibration.to_dict()
        plain["rule"] = self.rule.to_dict()
        plain["metadata"] = dict(self.metadata)
        plain["onset"] = self.onset and self.onset.to_dict()
        return plain

    @classmethod
    def from_dict(
        cls, plain: Mapping[str, Any], hand: HandLayout, sample_rate_hz: float
    ) -> AlarmSettings:
        """The settings that ``to_dict`` wrote, of a detector of this hand.

        Raises:
            ValueError: if one is missing, unknown or no such value.
        """
        try:
            values = dict(plain)
            values["calibration"] = calibration_from_dict(values["calibration"])
            values["rule"] = rule_from_dict(values["rule"])
            if (onset := values.get("onset")) is not None:
                values["onset"] = OnsetClassifier.from_dict(onset, hand, sample_rate_hz)
            return cls(**values)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no alarm settings of this version: {error}") from error

    @classmethod
    def of(cls, detector: SlipDetector) -> AlarmSettings:
        """The settings in a detector's file.

        Raises:
            ValueError: if there are none.
        """
        if KEY not in detector.info:
            raise ValueError(
                "this detector has no alarm threshold; train with +exp=onset, which sets one, or "
                "with onset=debounced, which is set for no rate"
            )
        return cls.from_dict(detector.info[KEY], detector.pool.hand, detector.pool.sample_rate_hz)


def calibration_of(detector: SlipDetector) -> tuple[Calibration, float] | None:
    """What makes a probability of a detector's score, and the share of slip it is stated for.

    As ``SlipDetector.calibration``, whose alarm settings are checked.
    """
    if KEY in detector.info:
        AlarmSettings.of(detector)
    return detector.calibration


class Scorer(Protocol):
    """What is asked of a detector: ``SlipDetector``, or a baseline that scores filtered bins."""

    @property
    def pool(self) -> FeaturePool:
        """How long bins are, and in what they are computed."""

    @property
    def channel_filter(self) -> ChannelFilter:
        """The frames of all channels."""

    @property
    def needed_index(self) -> Tensor:
        """Channels in use, ascending; the others are not filtered."""

    @property
    def look_ahead(self) -> int:
        """Samples behind a bin that its score waits for."""

    def predict_raw(self, samples: Tensor, *, given: torch.dtype) -> Prediction:
        """Score raw bins with their context, ``[N, C, W]``, as they were ``given`` in a dtype."""


def score_stream(
    detector: Scorer, samples: Tensor, hop_samples: int, chunk: int = 1024
) -> Prediction:
    """Predict every bin of a recording that begins a whole number of hops from its start.

    Before and behind it lies what its filter takes to lie there (``extended``). A NaN makes the
    bins within its frame's reach not valid. A recording shorter than a bin or a frame has no bins.

    Args:
        detector: that predicts.
        samples: the recording, volts; may hold NaN.
        hop_samples: distance of the bins' starts.
        chunk: bins at once, for memory.

    Shape:
        - samples: ``[C, T]``, float32 or float64
        - output: of N bins, in order

    Raises:
        ValueError: if hop or chunk is no positive number, or samples are not of this hand.
    """
    lengths = detector.channel_filter.window_lengths
    if samples.ndim != 2 or len(samples) != len(lengths):
        raise ValueError(
            f"expected a recording [{len(lengths)}, T] (channels, time), got {tuple(samples.shape)}"
        )
    if hop_samples < 1 or chunk < 1:
        raise ValueError(f"hop_samples and chunk must be positive, got {hop_samples} and {chunk}")
    used, length = detector.needed_index.tolist(), detector.pool.bin_samples
    with torch.no_grad():
        samples = samples.detach()
        if samples.shape[-1] < max(length, *(lengths[channel] for channel in used)):
            empty, none = samples.new_empty(0), samples.new_empty(0, len(samples)).bool()
            return Prediction(empty, none[:, 0], none)
        whole = extended(detector.pool.widen(samples), detector.channel_filter, used)
        bins = whole.unfold(-1, length + 2 * detector.channel_filter.context, hop_samples)
        parts = [
            detector.predict_raw(x, given=samples.dtype) for x in bins.transpose(0, 1).split(chunk)
        ]
        return Prediction(*map(torch.cat, zip(*parts, strict=True)))


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
        raised_by: ``"onset"``, the classifier of fast evidence, or ``"status"``, that of bins.
    """

    alarm_s: float
    onset_s: float
    score: float
    probability: float
    statistic: float
    is_valid: bool
    raised_by: str = "status"


class Decisions(NamedTuple):
    """One entry per decision, in order; of several streams at once, one row each.

    With an onset classifier there is one every hop of its own, and what is said of bins is that of
    the last bin known by then: score 0 and no probability of its own before the first, not valid.

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
        onset_score: of fast evidence, ``NOTHING_YET`` where there is none, ``[*, m]``, float64.
        by_onset: whether fast evidence reaches its threshold, ``[*, m]``.
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
    onset_score: Tensor
    by_onset: Tensor

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
                raised_by="onset" if self.by_onset[i] else "status",
            )
            for i in self.is_alarm.nonzero().flatten().tolist()
        )


_OF_BINS = ("onset_s", "score", "llr", "probability", "statistic", "is_valid")
"""What decisions with an onset classifier say of the last bin; float64 holds all of it exactly."""


class Decider:
    """Scores in, decisions out; its memory has a fixed size.

    ``decide`` is told of bins alone. With an onset classifier ``join`` makes of these decisions and
    of onset scores those of the alarm: it is raised by whichever reaches its threshold first, and
    stands until both have been low for ``rearm_s``. So bins confirm what fast evidence raised, or
    clear it.

    Args:
        settings: calibration, rule, threshold.
        sample_rate_hz: of the stream.
        bin_samples: length of a bin.
        look_ahead: samples behind its bin that a decision waits for.
        frame_samples: that must have come before any decision on a bin.
        end_s: when so many samples had come, ``[m]``; by default by the sample rate.

    Example:
        >>> from tactslip_torch.model.calibration import Platt
        >>> from tactslip_torch.onset.rules import KOfN
        >>> settings = AlarmSettings(20, Platt(4.0, 0.0), KOfN(2, 3), 1.0, target_per_hour=1.0)
        >>> decider = Decider(settings, 2000.0, bin_samples=100, look_ahead=25)
        >>> score = torch.tensor([-1.0, -1.0, 0.5, -1.0, 0.6, 0.7])
        >>> [round(alarm.alarm_s, 4) for alarm in decider.decide(score, score.isfinite()).alarms]
        [0.1025]
    """

    def __init__(
        self,
        settings: AlarmSettings,
        sample_rate_hz: float,
        bin_samples: int,
        look_ahead: int,
        frame_samples: int = 0,
        *,
        end_s: Callable[[Array], Array] | None = None,
    ) -> None:
        self.settings = settings
        self._rate = sample_rate_hz
        self._end_s = end_s or (lambda samples: samples / sample_rate_hz)
        self._first, self._frame = bin_samples + look_ahead, frame_samples
        self._latch_times = settings.latch_times(sample_rate_hz)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next decision is number 0 of a stream that begins at 0."""
        self._number = 0  # Python's integers do not end
        # of the rule (of one stream plain numbers); of the latch, one a stream; where the run began
        self._state: tuple[Any, list[Latch], Array] | None = None
        self._hop = 0  # of the next onset score
        self._known: Array | None = None  # of bins, those that count from the next hop on
        self._first_known = -1  # number of the first of them
        self._latches: list[Latch] = []

    def decide(
        self,
        score: Tensor,
        is_valid: Tensor,
        is_usable: Tensor | None = None,
    ) -> Decisions:
        """The next decisions.

        Args:
            score: of bins, in order.
            is_valid: whether every channel in use could be trusted; handed on.
            is_usable: whether the score tells anything (``is_usable``); where not, the evidence is
                ``NEUTRAL``. By default ``is_valid``.

        Shape:
            - all: ``[*, m]``; m may be 0, the streams ``*`` are always the same
        """
        settings = self.settings
        if self._state is None:
            like = score.new_zeros(score.shape[:-1])
            start: Any = settings.rule.start(like)
            of_rule, none = start if like.ndim else start.tolist(), np.zeros(like.shape, np.int64)
            self._state = of_rule, [Latch()] * like.numel(), none
        of_rule, latches, run = self._state
        llr = settings.calibration.llr(score)
        tells = is_valid if is_usable is None else is_usable
        ratios = llr.detach().numpy()
        ratios = np.where(tells.numpy() & np.isfinite(ratios), ratios, ratios.dtype.type(NEUTRAL))
        one = ratios.dtype.type
        llr = torch.from_numpy(ratios)
        if score.ndim == 1:
            row, of_rule = settings.rule.scan_row(ratios.tolist(), of_rule, one)
            statistic, rows = torch.from_numpy(np.array(row, one)), [row]
        else:
            statistic, of_rule = settings.rule.scan(llr, of_rule)
            rows = statistic.flatten(0, -2).tolist()
        is_alarm, is_on, latches = self._latched(rows, float(one(settings.threshold)), latches)
        number = np.arange(self._number, self._number + score.shape[-1])
        # where the unbroken run of positive ratios up to each decision began: behind one that is
        # not positive the next one would begin it
        runs = np.where(ratios > 0, run[..., None], number + 1)
        runs = np.maximum.accumulate(runs, -1)
        self._state = of_rule, latches, runs[..., -1] if len(number) else run
        self._number += len(number)
        samples = number * settings.hop_samples + self._first
        if settings.onset is None:  # else ``join`` says when
            samples = samples.clip(min=self._frame)
        available_s = self._end_s(samples)
        lasted_s = (number - np.minimum(runs, number)) * settings.hop_samples / self._rate
        return Decisions(
            torch.from_numpy(number),
            torch.from_numpy(available_s),
            torch.from_numpy(available_s - np.maximum(lasted_s + settings.lead_s, 0.0)),
            score,
            llr,
            probability(llr, settings.slip_share),
            statistic,
            is_valid,
            is_alarm.reshape(score.shape),
            is_on.reshape(score.shape),
            torch.full(score.shape, NOTHING_YET, dtype=torch.float64),
            torch.zeros(score.shape, dtype=torch.bool),
        )

    def join(self, bins: Decisions, onset_score: Tensor) -> Decisions:
        """The decisions of the alarm.

        Args:
            bins: what ``decide`` made next; those of one push may wait for later hops.
            onset_score: of the hops that came next.

        Shape:
            - onset_score, output: ``[*, k]``; the streams ``*`` are always the same
        """
        onset, settings = self.settings.onset, self.settings
        assert onset is not None
        scores, known = onset_score.numpy(), self._known
        if known is None:  # before all bins, number -1
            says_nothing = (math.inf, 0.0, 0.0, settings.slip_share, NOTHING_YET, 0.0)
            known = np.multiply.outer(says_nothing, np.ones((*scores.shape[:-1], 1)))
            self._first_known, self._latches = -1, [Latch()] * int(np.prod(scores.shape[:-1]))
        if bins.score.shape[-1]:
            made = np.stack([getattr(bins, name).numpy() for name in _OF_BINS])
            known = np.concatenate([known, made], -1)
        number = np.arange(self._hop, self._hop + scores.shape[-1])
        samples = (number + 1) * onset.evidence.hop_samples
        last = (samples - self._first) // settings.hop_samples
        last[samples < max(self._frame, self._first)] = -1
        at = last - self._first_known
        said = known.take(at, -1)
        if len(at) and at[-1]:
            known, self._first_known = known[..., at[-1] :].copy(), int(last[-1])
        self._known, self._hop = known, self._hop + len(number)
        began_s, of_bin = said[0], said[1:5].astype(bins.score.numpy().dtype)
        score, llr, stated, statistic = torch.from_numpy(of_bin).unbind()
        by_onset = scores >= onset.threshold
        is_high = by_onset | (of_bin[3] >= of_bin.dtype.type(settings.threshold))
        rows = is_high.reshape(len(self._latches), len(number)).tolist()
        is_alarm, is_on, self._latches = self._latched(rows, 1.0, self._latches)
        available_s = self._end_s(samples)
        onset_s = np.where(by_onset, available_s - onset.lead_s, began_s)
        return Decisions(
            torch.from_numpy(number),
            torch.from_numpy(available_s),
            torch.from_numpy(np.minimum(onset_s, available_s)),
            score,
            llr,
            stated,
            statistic,
            torch.from_numpy(said[5] > 0),
            is_alarm.reshape(scores.shape),
            is_on.reshape(scores.shape),
            onset_score,
            torch.from_numpy(by_onset),
        )

    def _latched(
        self, rows: list[list[float]], threshold: float, latches: list[Latch]
    ) -> tuple[Tensor, Tensor, list[Latch]]:
        """Alarms of every stream, whether one stands, and the latches after them."""
        made = [
            latch(row, threshold, **self._latch_times, state=state)
            for row, state in zip(rows, latches, strict=True)
        ]
        alarms, standing = (
            torch.from_numpy(np.array([of_row[part] for of_row in made], bool)) for part in (0, 1)
        )
        return alarms, standing, [state for _, _, state in made]


def is_usable(score: Tensor, is_missing: Tensor, needed_index: Tensor) -> Tensor:
    """Whether a score tells anything: it is finite, and some channel in use was there.

    A hand that lost a sensor goes on feeling with the others: the decision is flagged as not valid
    and still counts. One that lost them all feels nothing.

    Shape:
        - score, output: ``[*]``
        - is_missing: ``[*, C]``
        - needed_index: ``[channels in use]``
    """
    return score.isfinite() & ~is_missing.index_select(-1, needed_index).all(-1)


class StreamStatistic(NamedTuple):
    """One entry per decision, in order, ``[*, m]`` each, dtype of the samples.

    Attributes:
        score: at least 0 is slip.
        llr: log likelihood ratio; ``NEUTRAL``, without gradient, where the score tells nothing.
        probability: of slip, by the bin alone.
        statistic: of the rule; an alarm is raised where it reaches ``settings.threshold``.
    """

    score: Tensor
    llr: Tensor
    probability: Tensor
    statistic: Tensor


def stream_statistic(
    detector: SlipDetector, settings: AlarmSettings, samples: Tensor
) -> StreamStatistic:
    """Every decision on whole recordings, differentiable in the raw samples.

    Gradients are those of the values: 0 through a feature that is clipped, through a channel that
    counts as missing and through entropy; one-sided at ties. All
    features of the pool are made on the way: a few seconds of stream at once, not hours.

    Args:
        detector: fitted on this hand.
        settings: hop, calibration and rule; ``AlarmSettings.of(detector)`` are those in its file.
        samples: recordings in volts; a channel with a NaN or Inf in a bin's reach is left out
            of that bin.

    Shape:
        - samples: ``[*, C, T]``, float32 or float64, ``T`` at least a bin and the longest frame
        - output: ``[*, m]`` each, ``m = (T - n) // hop + 1``

    Raises:
        ValueError: if samples are not of this hand or too short for a decision.

    Example:
        The gradient of the highest statistic, volt by volt, summed up for each channel:

        >>> detector = SlipDetector.load("onset.pt")  # doctest: +SKIP
        >>> samples = recording.samples.clone().requires_grad_()  # doctest: +SKIP
        >>> found = stream_statistic(detector, AlarmSettings.of(detector), samples)
        ... # doctest: +SKIP
        >>> (pull,) = torch.autograd.grad(found.statistic.max(), samples)  # doctest: +SKIP
        >>> pull.abs().sum(-1)  # doctest: +SKIP
    """
    detector.channel_filter.check(samples)
    used = detector.needed_index.tolist()
    length = detector.pool.bin_samples
    shortest = max(length, *(detector.channel_filter.window_lengths[i] for i in used))
    if samples.shape[-1] < shortest:
        raise ValueError(
            f"expected at least {shortest} samples, a bin and the longest frame in use, "
            f"got {samples.shape[-1]}; give a longer recording"
        )
    whole = extended(detector.pool.widen(samples), detector.channel_filter, used)
    bins = whole.unfold(-1, length + 2 * detector.channel_filter.context, settings.hop_samples)
    is_used = torch.zeros(len(detector.pool.hand), 1, dtype=torch.bool, device=bins.device)
    is_used[used] = True
    bins = bins.movedim(-3, -2)  # [*, m, C, n + context]
    bins = torch.where(is_used | bins.isfinite(), bins, 0.0)  # or 0 times NaN comes back
    score, _, is_missing = detector.predict_raw(bins, given=samples.dtype)
    llr = settings.calibration.llr(score)
    tells = is_usable(score, is_missing, detector.needed_index) & llr.isfinite()
    llr = torch.where(tells, llr, NEUTRAL)
    statistic, _ = settings.rule.scan(llr, settings.rule.start(llr[..., 0]))
    return StreamStatistic(score, llr, probability(llr, settings.slip_share), statistic)
