"""Friction of a patch of bristles at the end of an implicit stage, as a function of its speed.

The deflections are eliminated: a stage ``Z = z + a Z'(V, Z)`` of length ``a`` from the base ``z``
has the solution below in closed form, so that only the speed ``V`` is left to be solved for.
Canudas de Wit, Olsson, Astrom and Lischinsky (1995), IEEE TAC 40(3), 419-425.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.simulation.dynamics.lanes import Lanes

_FADED = 6.5  # Stribeck speeds, beyond which exp(-(v/vs)^2) is no part of 1 in float64


class Patch(NamedTuple):
    """What stays the same for all stages; ``[*, 1]`` unless said otherwise."""

    stiffness: Tensor  # of one bristle
    damping: Tensor  # of one bristle at rest
    mu_s: Tensor
    mu_k: Tensor
    stribeck: Tensor
    pressure: Tensor  # [n]


class Pull(NamedTuple):
    """A patch at one speed."""

    bristle: Tensor  # deflections, [*, n]
    rate: Tensor  # theirs, [*, n]
    force: Tensor  # of all bristles, [*]
    slope: Tensor  # its derivative by the speed, [*]


def patch_of(lanes: Lanes) -> Patch:
    """The bristles of some lanes."""
    n = lanes.num_bristles
    return Patch(
        stiffness=(lanes.bristle_stiffness_n_m / n)[..., None],
        damping=(lanes.bristle_damping_n_s_m / n)[..., None],
        mu_s=lanes.mu_s[..., None],
        mu_k=lanes.mu_k[..., None],
        stribeck=lanes.stribeck_m_s[..., None],
        pressure=lanes.pressure,
    )


def carried(patch: Patch, normal_n: Tensor) -> Tensor:
    """Load of each bristle; a load that is no more than rounding, or negative, is none.

    Shape:
        - normal_n: ``[*]``
        - output: ``[*, n]``
    """
    floor = torch.finfo(normal_n.dtype).tiny ** 0.25
    return torch.where(normal_n > floor, normal_n, 0.0)[..., None] * patch.pressure


def clamped(patch: Patch, load: Tensor, bristle: Tensor) -> Tensor:
    """Deflections cut to what the load holds, ``mu_s`` times it; ``[*, n]``."""
    most = load * (patch.mu_s / patch.stiffness)
    return torch.minimum(torch.maximum(bristle, -most), most)


def pull(patch: Patch, load: Tensor, base: Tensor, speed: Tensor, stage_s: float) -> Pull:
    r"""Friction of the bristles, less the viscous part, at the end of a stage.

    With :math:`\mu(V) = \mu_k + (\mu_s - \mu_k) e^{-(V/v_s)^2}` and :math:`g_i = w_i N \mu(V)`,

    .. math::
        z_i' = V - s |V| z_i / g_i, \qquad
        F = \sum_i s z_i + d_i z_i', \qquad
        d_i = \frac{d_0}{1 + d_0 |V| / (w_i \mu_k N)}

    and the stage has :math:`Z_i = g_i (z_i + a V) / (g_i + a s |V|)`: a mean of :math:`z_i` and
    :math:`\pm g_i / s`, so that from a base cut to :math:`w_i \mu_s N / s` it never leaves it.

    The damping is ours, and makes friction passive. With :math:`x = s z_i / g_i`, the work per
    time less what the bristle stores is

    .. math::
        F_i V - s z_i z_i' = |V| \, (g_i x^2 - d_i V x + d_i |V|)

    whose discriminant :math:`d_i |V| (d_i |V| - 4 g_i)` is negative, as
    :math:`d_i |V| < w_i \mu_k N \le g_i`. With a constant :math:`d_i` it is not.

    A bristle without load has no friction, ``Z = Z' = 0``, and all of ``V`` is its slip.

    Args:
        patch: the bristles.
        load: of each bristle, from ``carried``.
        base: deflections that the stage starts from, from ``clamped``.
        speed: not negative; for a patch that moves back turn the signs of ``base`` and the result.
        stage_s: the length ``a``.

    Shape:
        - load, base: ``[*, n]``
        - speed: ``[*]``
    """
    v = speed[..., None]
    held = load > 0
    ratio = (v / patch.stribeck).clamp(max=_FADED)
    fading = (patch.mu_s - patch.mu_k) * torch.where(ratio < _FADED, (-ratio * ratio).exp(), 0.0)
    g = load * (patch.mu_k + fading)
    g_slope = load * (fading * (-2.0 * ratio / patch.stribeck))
    s, lag = patch.stiffness, stage_s * patch.stiffness
    share = torch.where(held, g + lag * v, 1.0).reciprocal()
    reached = base + stage_s * v
    bristle = g * reached * share
    bristle_slope = (g_slope * reached + g * stage_s - bristle * (g_slope + lag)) * share
    free = g - s * base
    rate = v * free * share
    rate_slope = (free + v * g_slope - rate * (g_slope + lag)) * share
    most = load * patch.mu_k  # what the damping cannot pass
    damped = torch.where(held, most + patch.damping * v, 1.0).reciprocal()
    damping = patch.damping * most * damped
    damping_slope = -damping * patch.damping * damped
    force = s * bristle + damping * rate
    slope = s * bristle_slope + damping_slope * rate + damping * rate_slope
    return Pull(bristle, rate, force.sum(-1), slope.sum(-1))
