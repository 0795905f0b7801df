"""What turns a detector's scores into alarms, kept in the detector's file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tactslip_torch.model.calibration import Calibration, calibration_from_dict
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.rules import Rule, rule_from_dict

KEY = "alarm"
"""Under which ``SlipDetector.info`` keeps the settings."""


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
        facts: on what the threshold was set, JSON-able: recordings, hours, achieved rate.

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
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.hop_samples < 1:
            raise ValueError(f"hop_samples must be at least 1, got {self.hop_samples}")
        if not 0 < self.slip_share < 1:
            raise ValueError(f"slip_share must lie between 0 and 1, got {self.slip_share}")
        if self.target_per_hour is not None and not self.target_per_hour > 0:
            raise ValueError(f"target_per_hour must be positive, got {self.target_per_hour}")
        if math.isfinite(self.threshold) and self.threshold > self.rule.ceiling:
            raise ValueError(
                f"threshold {self.threshold:g} lies above {self.rule.ceiling:g}, the most that the "
                f"statistic of {self.rule.name} can be: no alarm would ever come; lower it"
            )
        for name in ("rearm_s", "refractory_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    def decisions(self, seconds: float, sample_rate_hz: float) -> int:
        """A length of time in decisions, rounded up."""
        return -(-round(seconds * sample_rate_hz) // self.hop_samples)

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain JSON types."""
        plain = dict(self.__dict__)
        plain["calibration"] = self.calibration.to_dict()
        plain["rule"] = self.rule.to_dict()
        plain["facts"] = dict(self.facts)
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> AlarmSettings:
        """The settings that ``to_dict`` wrote.

        Raises:
            ValueError: if one is missing, unknown or no such value.
        """
        try:
            values = dict(plain)
            values["calibration"] = calibration_from_dict(values["calibration"])
            values["rule"] = rule_from_dict(values["rule"])
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
        return cls.from_dict(detector.info[KEY])


def calibration_of(detector: SlipDetector) -> tuple[Calibration, float] | None:
    """What makes a probability of a detector's score, and the share of slip it is stated for.

    That of its alarm settings; else that of the held-out scores its training chose by, at equal
    shares; else None.
    """
    if KEY in detector.info:
        settings = AlarmSettings.of(detector)
        return settings.calibration, settings.slip_share
    if plain := detector.info.get("calibration"):
        return calibration_from_dict(plain), 0.5
    return None
