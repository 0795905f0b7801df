"""The three calibrated knobs: where they start, how far they may move, and what was frozen.

They move together along one line of difficulty. ``d`` prior standard deviations harder means
less friction noise, longer presliding and more bursts, each by its own spread to the power ``d``;
so calibration has one unknown. ``simulation/calibrated.json`` holds what
``python -m tactslip_torch.calibrate write=true`` froze, with where it comes from.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Knob = float | tuple[float, float]


@dataclass(frozen=True)
class Prior:
    """A free knob before calibration.

    Args:
        start: PHYSICS.md's starting value, or both ends of a range.
        spread: prior standard deviation, as a factor. It moves both ends of a range.
        harder: the sign of the knob's change where slip gets harder to tell.
        source: of the spread.
    """

    start: Knob
    spread: float
    harder: int
    source: str

    def at(self, difficulty: float) -> Knob:
        """The knob ``difficulty`` prior standard deviations harder, to four digits."""
        factor = self.spread ** (self.harder * difficulty)
        if isinstance(self.start, tuple):
            low, high = self.start
            return _four_digits(low * factor), _four_digits(high * factor)
        return _four_digits(self.start * factor)


PRIORS: Mapping[str, Prior] = {
    "friction_noise_mv": Prior(
        8.0, 1.5, -1, "PHYSICS.md: 2 to 12 mV, about two standard deviations on either side"
    ),
    "presliding_mm": Prior(
        (0.3, 3.0), 1.5, 1, "PHYSICS.md: .2 to 2 mm beside a starting range of .3 to 3 mm"
    ),
    "burst_rate_hz": Prior(0.3, 2.0, 1, "ours; PHYSICS.md gives no range"),
}
"""The free knobs by name. Nothing else is calibrated."""


def knobs_at(difficulty: float) -> dict[str, Knob]:
    """All three knobs at a place on the line of difficulty.

    Example:
        >>> knobs_at(0.0)
        {'friction_noise_mv': 8.0, 'presliding_mm': (0.3, 3.0), 'burst_rate_hz': 0.3}
        >>> knobs_at(1.0)["friction_noise_mv"]
        5.333
    """
    return {name: prior.at(difficulty) for name, prior in PRIORS.items()}


def read_calibrated(path: Path) -> dict[str, Any]:
    """The knobs that a calibration froze: numbers, and ``(low, high)`` for a range.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is no JSON, lacks a knob or holds no positive numbers. Nothing can start
            without it, ``calibrate`` included, so each error says to restore it.
    """
    restore = "restore it from the release (reinstall tactslip_torch)"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileNotFoundError(f"no calibrated knobs at {path}; {restore}") from None
    except ValueError as error:
        raise ValueError(f"{path} must hold JSON, but: {error}; {restore}") from None
    values = content.get("values") if isinstance(content, dict) else None
    if not isinstance(values, dict):
        raise ValueError(f"{path} must hold an object with an object 'values'; {restore}")
    knobs: dict[str, Any] = {}
    for name, prior in PRIORS.items():
        value: Any = values.get(name)
        is_range = isinstance(prior.start, tuple)
        numbers = value if is_range and isinstance(value, list) else [value]
        if len(numbers) != 1 + is_range or not all(
            isinstance(number, int | float) and 0 < number < math.inf for number in numbers
        ):
            raise ValueError(
                f"{path} must hold {name} as {'[low, high]' if is_range else 'a number'}, "
                f"positive, got {value!r}; {restore}"
            )
        knobs[name] = tuple(map(float, numbers)) if is_range else float(value)
    return knobs


def _four_digits(value: float) -> float:
    """So that what is printed is what is simulated."""
    return float(f"{value:.4g}")


CALIBRATED_PATH = Path(__file__).parents[1] / "calibrated.json"
"""The frozen values, part of the package."""

CALIBRATED = read_calibrated(CALIBRATED_PATH)
"""What scenes take by default, by the name of the knob."""
