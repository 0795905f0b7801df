"""What hands do to an object without sliding on it: carry it, tap it, grip it harder."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.simulation.knobs.checks import require_finite


@dataclass(frozen=True)
class Handling:
    """Loads on the contact that are not slip. All priors are ours.

    Args:
        carried_kg: mass of the object that moves with the hand (strokes that move ``"both"``);
            its inertia loads the contact with shear, shared among elements by normal load.
        taps_per_s: knocks of the object on the hand a second, at rest and in strokes that move
            ``"both"``, never while the contact slides.
        tap_n: range of a tap's peak force on an element of relative load 1; log-uniform.
        tap_ms: range of a tap's duration, a half sine; log-uniform.
        grips_per_s: changes of grip a second, where taps may be: the normal load rises, stays
            and falls back, never below what it was, so that a contact that sticks sticks on.
        grip_share: range of the rise over the load; log-uniform.
        grip_s: range of its duration with both ramps, which take a quarter each; log-uniform.

    Raises:
        ValueError: if a knob is negative or not finite.
    """

    carried_kg: float = 0.2
    taps_per_s: float = 0.0
    tap_n: tuple[float, float] = (0.2, 2.0)
    tap_ms: tuple[float, float] = (5.0, 40.0)
    grips_per_s: float = 0.0
    grip_share: tuple[float, float] = (0.1, 1.0)
    grip_s: tuple[float, float] = (0.2, 1.0)

    def __post_init__(self) -> None:
        require_finite(self)
