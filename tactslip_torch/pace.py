"""How fast workers make features, stage by stage."""

from __future__ import annotations

from collections import Counter

from tactslip_torch.feature_maker import RecordingFeatures

_UNITS = {
    "simulate": "recordings",
    "read": "recordings",
    "features": "bins",
    "read_cache": "recordings",
}


class Pace:
    """What recordings took, added up.

    Attributes:
        seconds: that workers spent on each stage, summed over them.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._done: dict[str, Counter[str]] = {}

    def add(self, made: RecordingFeatures) -> None:
        """Count a recording."""
        for stage, seconds in made.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
            done = self._done.setdefault(stage, Counter())
            done.update(recordings=1, bins=len(made.is_slip))

    def rates(self) -> dict[str, str]:
        """Of one worker, for people."""
        return {
            stage: f"{self._done[stage][unit] / max(self.seconds[stage], 1e-9):.0f} {unit}/s"
            for stage, unit in _UNITS.items()
            if stage in self._done
        }
