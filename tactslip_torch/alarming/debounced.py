"""An alarm without a promise: k of the last n decisions say slip.

For sets that hold too little without slip to count false alarms on. The calibration is that of the
held-out scores by which training chose; how often it cries wolf, nobody knows yet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tactslip_torch.data.labels import whole_samples
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.scoring import Scorer
from tactslip_torch.onset.sequential import KOfN
from tactslip_torch.onset.settings import KEY, AlarmSettings, calibration_of


@dataclass(frozen=True)
class Debounced:
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
        for name in ("k", "n"):
            if type(getattr(self, name)) is not int:
                raise ValueError(
                    f"onset.{name} must be a whole number, got {getattr(self, name)!r}"
                )
        for name in ("probability", "slip_share"):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value < 1:
                raise ValueError(f"onset.{name} must lie between 0 and 1, got {value!r}")
        for name in ("rearm_s", "refractory_s"):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 <= value < math.inf:
                raise ValueError(f"onset.{name} must be seconds from 0, got {value!r}")
        hop_ms = self.hop_ms
        if hop_ms is not None and (type(hop_ms) not in (int, float) or not 0 < hop_ms < math.inf):
            raise ValueError(f"onset.hop_ms must be positive, or null, got {hop_ms!r}")
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
