"""What the dynamic rungs integrate: one lane is one element in one stroke, along the surface.

PHYSICS.md, skin and friction: a mass behind a spring, a damper and a Maxwell arm (standard linear
solid), carried over the surface by bristles (Canudas de Wit et al. 1995) under a Hertz pressure.
One bristle is LuGre's model, 16 to 64 are a patch whose edge lets go first. SI units throughout.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

GROSS_SHARE = 0.5
"""Of the arm's speed, above which an element slides grossly, and a bristle at all."""

_ROUNDINGS = 64.0  # how many roundings the sum of the pressure may be off


@dataclass(frozen=True, eq=False)
class Lanes:
    """Skin and friction of every lane; tensors that broadcast to the lanes' shape.

    Args:
        mass_kg: of the skin that moves with the contact; 0 is a pure balance of forces.
        stiffness_n_m: the spring that stays.
        relaxing_n_m: the spring of the Maxwell arm, whose force dies away.
        relaxation_time_s: with which it does; may be infinite.
        damping_n_s_m: the damper beside both springs.
        mu_s: friction coefficient at rest.
        mu_k: friction coefficient in sliding.
        stribeck_m_s: speed over which the one becomes the other.
        bristle_stiffness_n_m: of all bristles together.
        bristle_damping_n_s_m: of all bristles together, at rest.
        viscous_n_s_m: friction in proportion to speed.
        pressure: share of the load that each bristle carries; its length is their number.

    Shape:
        - pressure: ``[n]``; all others broadcast to ``shape``, ``[*]``

    Raises:
        ValueError: for a value that is negative, not finite or not a number, a stiffness,
            Stribeck speed, relaxation time or friction that is not positive, ``mu_k > mu_s``, a
            pressure that does not sum to 1, or tensors of several kinds or devices.
    """

    mass_kg: Tensor
    stiffness_n_m: Tensor
    relaxing_n_m: Tensor
    relaxation_time_s: Tensor
    damping_n_s_m: Tensor
    mu_s: Tensor
    mu_k: Tensor
    stribeck_m_s: Tensor
    bristle_stiffness_n_m: Tensor
    bristle_damping_n_s_m: Tensor
    viscous_n_s_m: Tensor
    pressure: Tensor

    def __post_init__(self) -> None:
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, values in tensors.items():
            if not isinstance(values, Tensor) or not values.is_floating_point():
                came = values.dtype if isinstance(values, Tensor) else type(values).__name__
                raise ValueError(f"expected {name} as a tensor of floats, got {came}")
            if (values.dtype, values.device) != (self.pressure.dtype, self.pressure.device):
                raise ValueError(
                    f"expected all of one kind on one device, got {name} as {values.dtype} on "
                    f"{values.device} and pressure as {self.pressure.dtype} on "
                    f"{self.pressure.device}"
                )
            _check(name, values)
        weights = self.pressure
        slack = _ROUNDINGS * torch.finfo(weights.dtype).eps
        if weights.dim() != 1 or not abs(float(weights.sum()) - 1.0) <= slack:
            raise ValueError(
                f"expected pressure [n] that sums to 1, got {tuple(weights.shape)} with sum "
                f"{float(weights.sum()):g}; hertz_pressure(n) gives one"
            )
        if (self.mu_k > self.mu_s).any():
            raise ValueError(
                f"expected mu_k <= mu_s, got mu_k up to {float(self.mu_k.max()):g} over mu_s down "
                f"to {float(self.mu_s.min()):g}; friction in sliding is not above that at rest"
            )
        _ = self.shape  # raises where shapes do not broadcast

    @property
    def shape(self) -> torch.Size:
        """The lanes' shape."""
        tensors: dict[str, Tensor] = {f.name: getattr(self, f.name) for f in fields(self)}
        shapes = {name: t.shape for name, t in tensors.items() if name != "pressure"}
        try:
            return torch.Size(torch.broadcast_shapes(*shapes.values()))
        except RuntimeError:
            listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
            raise ValueError(f"expected shapes that broadcast, got {listed}") from None

    @property
    def num_bristles(self) -> int:
        """How many bristles share the load."""
        return len(self.pressure)


def _check(name: str, values: Tensor) -> None:
    """One line if a value of ``Lanes`` cannot be."""
    positive = name not in (
        "mass_kg",
        "relaxing_n_m",
        "damping_n_s_m",
        "bristle_damping_n_s_m",
        "viscous_n_s_m",
    )
    fine = values > 0 if positive else values >= 0
    if name != "relaxation_time_s":
        fine = fine & values.isfinite()
    if not fine.all():
        sign = "positive" if positive else "not negative"
        raise ValueError(f"expected {name} finite and {sign}, got {float(values[~fine][0]):g}")


def hertz_pressure(
    num_bristles: int, *, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Tensor:
    """Shares of the load under a Hertz pressure, in proportion to ``sqrt(1 - r^2)``.

    Bristle ``i`` stands at ``r = (2 i + 1) / n - 1`` across the contact.

    Shape:
        - output: ``[n]``, positive, sums to 1

    Raises:
        ValueError: for no bristle.
    """
    if num_bristles < 1:
        raise ValueError(f"expected one bristle or more, got {num_bristles}")
    steps = torch.arange(num_bristles, dtype=torch.float64, device=device)
    place = (2.0 * steps + 1.0) / num_bristles - 1.0
    weights = (1.0 - place * place).sqrt()
    return (weights / weights.sum()).to(dtype)


@dataclass(frozen=True, eq=False)
class LaneState:
    """Where every lane is between two steps.

    Args:
        stretch_m: of the skin, arm less patch.
        speed_m_s: of the patch over the surface.
        relaxing_n: force of the Maxwell arm.
        bristle_m: deflection of each bristle.

    Shape:
        - bristle_m: ``[*, n]``; all others ``[*]``
    """

    stretch_m: Tensor
    speed_m_s: Tensor
    relaxing_n: Tensor
    bristle_m: Tensor

    @classmethod
    def sticking(
        cls, lanes: Lanes, force_n: Tensor | float = 0.0, relaxing_share: Tensor | float = 0.0
    ) -> Self:
        """At rest, with a shear force that spring and bristles agree on.

        Each bristle carries the share of the force that it carries of the load, as after sliding.
        What goes beyond ``mu_s N`` is lost in the first step.

        Args:
            lanes: whose state it is.
            force_n: with which the skin pulls the patch.
            relaxing_share: part of it that the Maxwell arm holds, from 0 (long at rest) to 1.

        Shape:
            - force_n, relaxing_share: broadcast to the lanes' shape

        Raises:
            ValueError: if ``relaxing_share`` is outside 0 to 1.
        """
        like = lanes.pressure
        force = torch.as_tensor(force_n, dtype=like.dtype, device=like.device)
        share = torch.as_tensor(relaxing_share, dtype=like.dtype, device=like.device)
        if not ((share >= 0) & (share <= 1)).all():
            raise ValueError(
                f"expected relaxing_share within 0 to 1, got {float(share.min()):g} to "
                f"{float(share.max()):g}"
            )
        force, share = force.expand(lanes.shape), share.expand(lanes.shape)
        each = lanes.bristle_stiffness_n_m / lanes.num_bristles
        return cls(
            stretch_m=(1.0 - share) * force / lanes.stiffness_n_m,
            speed_m_s=torch.zeros_like(force),
            relaxing_n=share * force,
            bristle_m=(force / each)[..., None] * like,
        )
