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
        for name in ("probability", "slip_share"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(
                    f"onset.{name} must lie between 0 and 1, got {getattr(self, name)}"
                )
        if self.hop_ms is not None and not 0 < self.hop_ms < math.inf:
            raise ValueError(f"onset.hop_ms must be positive, got {self.hop_ms}")
        _ = KOfN(self.k, self.n)

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
        hop = max(pool.bin_samples // 2, 1)
        if self.hop_ms is not None:
            hop = whole_samples(self.hop_ms, pool.sample_rate_hz, "onset.hop_ms")
        settings = AlarmSettings(
            hop_samples=hop,
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
