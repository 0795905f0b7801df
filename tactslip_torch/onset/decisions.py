"""From recordings to scores, and from scores to decisions and alarms.

``AlarmSettings`` are what makes alarms of scores, kept in the detector's file. ``score_stream``
scores a whole recording, one bin every hop; ``Decider`` makes decisions and alarms of scores, piece
by piece, for streams and whole recordings alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.sensing import Sensing, without_stuck
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import Platt, calibration_from_dict, probability
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.onset.evidence import OnsetClassifier
from tactslip_torch.onset.rules import (
    HOLD_S,
    NOTHING_YET,
    Latch,
    Rule,
    latch,
    most_lost,
    rule_from_dict,
)
from tactslip_torch.runtime import check_number, check_share
from tactslip_torch.signals.filtering import ChannelFilter, extended

LARGEST = 1e30
"""Size of a log likelihood ratio, at most."""
_CHUNK_BINS = 1024  # at once, for memory
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
        threshold: at which the statistic raises an alarm; of no use with an onset classifier.
        target_per_hour: false alarms an hour that the threshold was set for; ``None``: no
            rate was set.
        slip_share: how much of a stream is slip; the balance that probabilities are stated for.
        rearm_s: how long the statistic must stay low before the next alarm.
        refractory_s: shortest time between two alarms.
        hold_s: lost samples in a row, in seconds, up to which rules keep their state.
        lead_s: from an onset to the first decision that speaks for slip, in the middle; the
            estimate of an onset goes back by it.
        metadata: on what the threshold was set, JSON-able: recordings, hours, achieved rate.
        onset: classifier of slipping now; with it alarms come from it alone, and decisions are
            its hop apart.
        levels: spans of bins in the recordings that the threshold was set on, by which decisions
            are in range or not; ``None``: by those of the detector's training.

    Raises:
        ValueError: if a time or the hop is negative, the share lies outside 0 to 1, or the
            statistic cannot reach the threshold.
    """

    hop_samples: int
    calibration: Platt
    rule: Rule
    threshold: float
    target_per_hour: float | None
    slip_share: float = 0.5
    rearm_s: float = 0.1
    refractory_s: float = 0.2
    lead_s: float = 0.0
    hold_s: float = HOLD_S
    metadata: Mapping[str, Any] = field(default_factory=dict)
    onset: OnsetClassifier | None = None
    levels: Sensing | None = None

    def __post_init__(self) -> None:
        check_number("hop_samples", self.hop_samples, whole=True)
        check_share("slip_share", self.slip_share)
        if self.target_per_hour is not None:
            check_number("target_per_hour", self.target_per_hour)
        if math.isfinite(self.threshold) and self.threshold > self.rule.ceiling:
            raise ValueError(
                f"threshold {self.threshold:g} lies above {self.rule.ceiling:g}, the most that the "
                f"statistic of {self.rule.name} can be: no alarm would ever come; lower it"
            )
        for name in ("rearm_s", "refractory_s", "hold_s"):
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
    def alarm_threshold(self) -> float:
        """The one that a user sets: of the onset classifier, if there is one; bins keep theirs."""
        return (self.onset or self).threshold

    def sensing(self, of_training: Sensing) -> Sensing:
        """With the spans by which decisions are in range or not."""
        if (levels := self.levels) is None:
            return of_training
        return replace(of_training, rest_span=levels.rest_span, most_span=levels.most_span)

    def at_threshold(self, value: float) -> AlarmSettings:
        """The same with another ``alarm_threshold``."""
        if self.onset is None:
            return replace(self, threshold=value)
        hint = self.onset.hint  # infinite for none; otherwise never above the threshold
        hint = min(hint, value) if math.isfinite(hint) else hint
        return replace(self, onset=replace(self.onset, threshold=value, hint=hint))

    def latch_times(self, sample_rate_hz: float) -> dict[str, int]:
        """Times of a latch, in decisions, rounded up."""
        seconds = {"rearm": self.rearm_s, "refractory": self.refractory_s}
        return {
            name: -(-round(time_s * sample_rate_hz) // self.decision_samples)
            for name, time_s in seconds.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain JSON types."""
        plain = dict(self.__dict__)
        plain["calibration"] = self.calibration.to_dict()
        plain["rule"] = self.rule.to_dict()
        plain["metadata"] = dict(self.metadata)
        plain["threshold"] = self.threshold if self.threshold < math.inf else None
        plain["onset"] = self.onset and self.onset.to_dict()
        plain["levels"] = self.levels and self.levels.to_dict()
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
            if values["threshold"] is None:
                values["threshold"] = math.inf
            if (onset := values.get("onset")) is not None:
                values["onset"] = OnsetClassifier.from_dict(onset, hand, sample_rate_hz)
            if (levels := values.get("levels")) is not None:
                values["levels"] = Sensing.from_dict(levels)
            return cls(**values)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no alarm settings of this version: {error}") from error

    @classmethod
    def of(cls, detector: _HasInfo) -> AlarmSettings:
        """The settings in a detector's file.

        Raises:
            ValueError: if there are none.
        """
        if KEY not in detector.info:
            raise ValueError(
                "this detector has no alarm threshold; train it with onset=debounced, the default, "
                "on recordings of two objects or more; tactslip calibrate then sets it for a rate"
            )
        return cls.from_dict(detector.info[KEY], detector.pool.hand, detector.pool.sample_rate_hz)


class _HasInfo(Protocol):
    """What alarm settings are read from: ``SlipDetector``, with the content of its file."""

    @property
    def pool(self) -> FeaturePool:
        """Of which hand, at which rate."""

    @property
    def info(self) -> dict[str, Any]:
        """JSON-able values by name."""


class Scorer(Protocol):
    """What is asked of a detector: ``SlipDetector``, or a baseline that scores filtered bins."""

    @property
    def pool(self) -> FeaturePool:
        """How long bins are, and in what they are computed."""

    @property
    def channel_filter(self) -> ChannelFilter:
        """The frames of all channels."""

    @property
    def sensing(self) -> Sensing:
        """When a channel counts as stuck."""

    @property
    def needed_index(self) -> Tensor:
        """Channels in use, ascending; the others are not filtered."""

    @property
    def look_ahead(self) -> int:
        """Samples behind a bin that its score waits for."""

    def predict_raw(self, samples: Tensor, *, given: torch.dtype) -> Prediction:
        """Score raw bins with their context, ``[N, C, W]``, as they were ``given`` in a dtype."""


def score_stream(detector: Scorer, samples: Tensor, hop_samples: int) -> Prediction:
    """Predict every bin of a recording that begins a whole number of hops from its start.

    Before and behind it lies what its filter takes to lie there (``extended``). A channel is lost
    in the bins whose frames reach a NaN of it, or that it is stuck in. A recording shorter than a
    bin or a frame has no bins.

    Args:
        detector: that predicts.
        samples: the recording, volts; may hold NaN.
        hop_samples: distance of the bins' starts.

    Shape:
        - samples: ``[C, T]``, float32 or float64
        - output: of N bins, in order

    Raises:
        ValueError: if the hop is no positive number, or samples are not of this hand.
    """
    lengths = detector.channel_filter.window_lengths
    if samples.ndim != 2 or len(samples) != len(lengths):
        raise ValueError(
            f"expected a recording [{len(lengths)}, T] (channels, time), got {tuple(samples.shape)}"
        )
    if hop_samples < 1:
        raise ValueError(f"hop_samples must be positive, got {hop_samples}")
    used, length = detector.needed_index.tolist(), detector.pool.bin_samples
    with torch.no_grad():
        samples = samples.detach()
        if samples.shape[-1] < max(length, *(lengths[channel] for channel in used)):
            empty, none = samples.new_empty(0), samples.new_empty(0, len(samples))
            return Prediction(empty, empty.bool(), empty.bool(), none.bool(), none.double())
        bins = _raw_bins(detector, samples, hop_samples)
        parts = [
            detector.predict_raw(x, given=samples.dtype)
            for x in bins.transpose(0, 1).split(_CHUNK_BINS)
        ]
        return Prediction(*map(torch.cat, zip(*parts, strict=True)))


def _raw_bins(detector: Scorer, samples: Tensor, hop_samples: int) -> Tensor:
    """Bins with their context: ``[*, C, T] -> [*, C, m, W]``."""
    layer, length = detector.channel_filter, detector.pool.bin_samples
    samples = without_stuck(samples, detector.sensing.stuck_samples)
    whole = extended(detector.pool.widen(samples), layer, detector.needed_index.tolist())
    return whole.unfold(-1, length + 2 * layer.context, hop_samples)


@dataclass(frozen=True)
class Alarm:
    """An alarm, as it was raised.

    Args:
        alarm_s: when it could be raised: the end of the deciding bin and the look-ahead.
        onset_s: when the slip is thought to have begun, no later than that.
        score: of the deciding bin.
        probability: that the last bin is slip; NaN, as score and statistic, where there is none.
        statistic: of the rule.
        in_range: whether the channels moved about as much as in training.
        channels_lost: names of the channels that were left out.
        raised_by: ``"onset"``, the classifier of slipping now, or ``"status"``, that of bins.
    """

    alarm_s: float
    onset_s: float
    score: float
    probability: float
    statistic: float
    in_range: bool
    channels_lost: tuple[str, ...] = ()
    raised_by: str = "status"


class Decisions(NamedTuple):
    """One entry per decision of a stream, in order.

    With an onset classifier there is one every hop of its own, and the columns of bins are those of
    the last bin known by then. Such a decision is valid where the bin is, or where the classifier
    has a score; only the score raises alarms.

    Attributes:
        number: of the decision in its stream, from 0, ``[m]``, int64.
        available_s: when it could be made: the end of its bin and the look-ahead, ``[m]``, float64.
        onset_s: when the slip is thought to have begun, if this is one, ``[m]``, float64.
        score: at least 0 is slip, NaN where the bin is not valid, ``[m]``.
        llr: log likelihood ratio, NaN likewise, ``[m]``.
        probability: of slip, by the bin alone, NaN likewise, ``[m]``.
        statistic: of the rule, NaN likewise, ``[m]``.
        is_valid: whether the decision counts, ``[m]``; one that does not raises no alarm.
        in_range: whether the channels move about as much as in training, or as in the recordings
            that the threshold was set on (``AlarmSettings.levels``), ``[m]``.
        channels_lost: channels in use that were left out, ``[m, C]``.
        is_alarm: whether it raises an alarm, ``[m]``.
        is_on: whether an alarm stands after it: the contact's status, ``[m]``.
        onset_score: of the onset classifier, ``NOTHING_YET`` where there is none, ``[m]``, float64.
        by_onset: whether that reaches its threshold, ``[m]``.
        is_hint: whether it reaches the lower one, ``[m]``; never without an onset classifier.
        channels: names of ``C`` channels, empty where they are not known.
    """

    number: Tensor
    available_s: Tensor
    onset_s: Tensor
    score: Tensor
    llr: Tensor
    probability: Tensor
    statistic: Tensor
    is_valid: Tensor
    in_range: Tensor
    channels_lost: Tensor
    is_alarm: Tensor
    is_on: Tensor
    onset_score: Tensor
    by_onset: Tensor
    is_hint: Tensor
    channels: tuple[str, ...] = ()

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """The alarms that were raised, in order."""
        return tuple(
            Alarm(
                alarm_s=float(self.available_s[i]),
                onset_s=float(self.onset_s[i]),
                score=float(self.score[i]),
                probability=float(self.probability[i]),
                statistic=float(self.statistic[i]),
                in_range=bool(self.in_range[i]),
                channels_lost=self.names_lost(i),
                raised_by="onset" if self.by_onset[i] else "status",
            )
            for i in self.is_alarm.nonzero().flatten().tolist()
        )

    def names_lost(self, index: int) -> tuple[str, ...]:
        """Names of the channels that a decision was made without."""
        flags = self.channels_lost[index].tolist()
        return tuple(name for name, lost in zip(self.channels, flags, strict=True) if lost)


HOST_COLUMNS = {
    "time_s": "available_s",
    "onset_s": "onset_s",
    "score": "score",
    "probability": "probability",
    "valid": "is_valid",
    "in_range": "in_range",
    "channels_lost": "channels_lost",
    "statistic": "statistic",
    "alarm": "is_alarm",
    "on": "is_on",
}
"""Names that all hosts give the columns of ``Decisions`` (``export/README.md``), in their order."""


def joined_decisions(parts: Sequence[Decisions]) -> Decisions:
    """Decisions of one stream, one behind the other."""
    if len(parts) == 1:
        return parts[0]
    columns: list[Any] = list(zip(*(part[:-1] for part in parts), strict=True))
    return Decisions._make([*map(torch.cat, columns), parts[0].channels])


_OF_BINS = ("onset_s", "score", "llr", "probability", "statistic", "is_valid", "in_range")
"""What decisions with an onset classifier say of the last bin; float64 holds all of it exactly.
Channels that are lost come behind."""


class _StreamRule:
    """The rule and the latch of one stream, and what they remember.

    Args:
        rule: from ratios to statistics; ``None``: they are statistics.
        threshold: of the statistic.
        latch_times: of the latch.
        most: decisions in a row that may be lost until all begins anew.
    """

    def __init__(
        self, rule: Rule | None, threshold: float, latch_times: Mapping[str, int], most: int
    ) -> None:
        self._rule, self._threshold, self._most = rule, threshold, most
        self._latch_times, self._latch = latch_times, Latch()
        self._run, self._lost, self._memory = 0, 0, list[float]()
        self._begin()

    def walk(self, ratios: Array, number: int) -> tuple[Array, Array, Array, Array]:
        """The next decisions ``[m]``, NaN where not valid; the first of them has this number.

        Returns:
            The statistic, which decisions raise an alarm, whether one stands after each, and the
            number of the decision with which its unbroken run of positive ratios began.
        """
        statistics, alarms, standing = list[float](), list[bool](), list[bool]()
        runs = np.empty(len(ratios), np.int64)
        threshold = float(ratios.dtype.type(self._threshold))

        def latched(statistic: list[float]) -> None:
            raised, stands, self._latch = latch(
                statistic, threshold, **self._latch_times, state=self._latch
            )
            alarms.extend(raised)
            standing.extend(stands)

        lost, places = np.isnan(ratios), np.arange(len(ratios))
        edges = np.flatnonzero(lost[1:] != lost[:-1]) + 1
        for part in np.split(places, edges) if len(edges) else [places][: len(ratios)]:
            statistic = ratios[part].tolist()
            if lost[part[0]]:
                kept = max(self._most - self._lost, 0)  # decisions that change nothing
                self._lost += len(part)
                runs[part] = self._run
                latched(statistic[:kept])
                if len(part) > kept:
                    self._latch = self._latch._replace(is_on=False, below=0)
                    latched(statistic[kept:])
                    runs[part[kept:]] = number + part[kept:] + 1
            else:
                if self._lost > self._most:
                    self._begin()
                self._lost = 0
                if self._rule is not None:
                    statistic, self._memory = self._rule.scan_row(
                        statistic, self._memory, ratios.dtype.type
                    )
                latched(statistic)
                began = np.where(ratios[part] > 0, self._run, number + part + 1)
                runs[part] = np.maximum.accumulate(began)
            self._run = int(runs[part[-1]])
            statistics.extend(statistic)
        flags = np.array(alarms, bool), np.array(standing, bool)
        return np.array(statistics, ratios.dtype), *flags, runs

    def _begin(self) -> None:
        """Forget all that the rule gathered."""
        if self._rule is not None:
            self._memory = self._rule.start()


class Decider:
    """Scores in, decisions out; its memory has a fixed size.

    ``decide`` takes bins alone. With an onset classifier ``join`` makes of these decisions and
    of onset scores those of the alarm: it is raised where the score reaches its threshold, and
    stands until the score has been low for ``rearm_s``. Bins raise none then.

    Decisions that are not valid move nothing. After ``settings.hold_s`` of lost samples an alarm
    that stands ends, and the rule begins anew.

    Args:
        settings: calibration, rule, threshold.
        sample_rate_hz: of the stream.
        bin_samples: length of a bin.
        look_ahead: samples behind its bin that a decision waits for.
        frame_samples: that must have come before any decision on a bin.
        context_before: samples before its bin that a decision rests on; default: ``look_ahead``.
        channels: names of the channels, if ``decide`` gets which are lost.
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
        context_before: int | None = None,
        channels: Sequence[str] = (),
        end_s: Callable[[Array], Array] | None = None,
    ) -> None:
        self.settings = settings
        self._rate, self._channels = sample_rate_hz, tuple(channels)
        self._end_s = end_s or (lambda samples: samples / sample_rate_hz)
        self._first, self._frame = bin_samples + look_ahead, frame_samples
        self._latch_times = settings.latch_times(sample_rate_hz)
        window = self._first + (look_ahead if context_before is None else context_before)
        self._window = window
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next decision is number 0 of a stream that begins at 0."""
        settings, onset = self.settings, self.settings.onset
        self._number = 0  # Python's integers do not end
        self._rule = self._rule_of(settings.rule, settings.threshold, settings.hop_samples)
        self._hop = 0  # of the next onset score
        if onset is not None:
            self._alarm_rule = self._rule_of(None, 1.0, onset.evidence.hop_samples)
        no_bin = [math.inf, *[math.nan] * 4, 0.0, 0.0, *[0.0] * len(self._channels)]
        self._known = np.array(no_bin)[:, None]  # of bins that count from the next hop on
        self._first_known = -1  # number of the first of them: before all bins

    def decide(
        self,
        score: Tensor,
        is_valid: Tensor,
        in_range: Tensor | None = None,
        channels_lost: Tensor | None = None,
    ) -> Decisions:
        """The next decisions.

        Args:
            score: of bins, in order.
            is_valid: whether they count.
            in_range: handed on; default: as ``is_valid``.
            channels_lost: handed on; default: of no channel.

        Shape:
            - score, is_valid, in_range: ``[m]``, m from 0; channels_lost: ``[m, C]``
        """
        settings = self.settings
        valid = is_valid & score.isfinite()
        llr = settings.calibration.llr(torch.where(valid, score, 0.0)).clamp(-LARGEST, LARGEST)
        score, llr = (x.masked_fill(~valid, torch.nan) for x in (score.detach(), llr.detach()))
        statistic, alarms, standing, runs = self._rule.walk(llr.numpy(), self._number)
        number = np.arange(self._number, self._number + len(score))
        self._number += len(score)
        samples = number * settings.hop_samples + self._first
        if settings.onset is None:  # else ``join`` says when
            samples = samples.clip(min=self._frame)
        available_s = self._end_s(samples)
        lasted_s = (number - np.minimum(runs, number)) * settings.hop_samples / self._rate
        if channels_lost is None:
            channels_lost = valid.new_zeros(len(valid), len(self._channels))
        return Decisions(
            torch.from_numpy(number),
            torch.from_numpy(available_s),
            torch.from_numpy(available_s - np.maximum(lasted_s + settings.lead_s, 0.0)),
            score,
            llr,
            probability(llr, settings.slip_share),
            torch.from_numpy(statistic),
            valid,
            valid if in_range is None else in_range & valid,
            channels_lost,
            torch.from_numpy(alarms),
            torch.from_numpy(standing),
            torch.full(score.shape, NOTHING_YET, dtype=torch.float64),
            torch.zeros(score.shape, dtype=torch.bool),
            torch.zeros(score.shape, dtype=torch.bool),
            self._channels,
        )

    def join(self, bins: Decisions, onset_score: Tensor) -> Decisions:
        """The decisions of the alarm.

        Args:
            bins: what ``decide`` made next; those of one push may wait for later hops.
            onset_score: of the hops that came next.

        Shape:
            - onset_score, output: ``[k]``
        """
        onset, settings = self.settings.onset, self.settings
        assert onset is not None
        scores, known = onset_score.numpy(), self._known
        if len(bins.score):
            made = [getattr(bins, name).numpy() for name in _OF_BINS]
            known = np.concatenate([known, np.stack([*made, *bins.channels_lost.T.numpy()])], -1)
        number = np.arange(self._hop, self._hop + len(scores))
        samples = (number + 1) * onset.evidence.hop_samples
        last = (samples - self._first) // settings.hop_samples
        last[samples < max(self._frame, self._first)] = -1
        at = last - self._first_known
        latest = known.take(at, -1)
        if len(at) and at[-1]:
            known, self._first_known = known[:, at[-1] :].copy(), int(last[-1])
        self._known, self._hop = known, self._hop + len(number)
        began_s, of_bin = latest[0], latest[1:5].astype(bins.score.numpy().dtype)
        score, llr, stated, statistic = torch.from_numpy(of_bin).unbind()
        by_onset = scores >= onset.threshold
        is_known = scores > NOTHING_YET
        ratios = np.where(is_known, by_onset * 1.0, np.nan)
        _, alarms, standing, _ = self._alarm_rule.walk(ratios, 0)
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
            torch.from_numpy((latest[5] > 0) | is_known),
            torch.from_numpy(latest[6] > 0),
            torch.from_numpy(latest[7:].T > 0),
            torch.from_numpy(alarms),
            torch.from_numpy(standing),
            onset_score,
            torch.from_numpy(by_onset),
            torch.from_numpy(scores >= onset.hint),
            self._channels,
        )

    def _rule_of(self, rule: Rule | None, threshold: float, hop_samples: int) -> _StreamRule:
        """Of decisions a hop apart."""
        most = most_lost(self._window, round(self.settings.hold_s * self._rate), hop_samples)
        return _StreamRule(rule, threshold, self._latch_times, most)
