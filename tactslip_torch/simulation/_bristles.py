"""Skin and bristles: friction integrated in time, one lane for one element in one stroke.

A mass behind a spring, a damper and a Maxwell arm (standard linear solid) is carried over the
surface by bristles under a Hertz pressure (Canudas de Wit, Olsson, Astrom and Lischinsky 1995, IEEE
TAC 40(3), 419-425). One bristle is LuGre's model, 16 to 64 are a patch. SI units.

The scheme is SDIRK2: two implicit stages a step, order 2, L-stable, and the
second stage ends at the step's end, so that what a trace holds obeys the balance of forces to
rounding (Alexander 1977, SIAM J. Numer. Anal. 14(6), 1006-1021). A stage of length ``a`` from base
values in small letters, the arm's speed ``w``::

    U = u + a (w - V)        Q = (q + a k1 (w - V)) / (1 + a / tau)
    m V = m v + a (k U + Q + c (w - V) - sigma2 V - F(V))

Skin and bristles are eliminated; the last is one scalar equation ``A V + B + a F(V) = 0`` a lane,
with ``A > 0`` and ``F`` bounded, so there is always a root and a bracket. Torch defines it, on any
device and differentiable; ``native/bristles.cpp`` computes it for float64 on the CPU.
"""

from __future__ import annotations

import math
from importlib.metadata import version
from itertools import count
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch import native
from tactslip_torch.native import BackendName

_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)  # length of a stage in steps

# Evaluations after which every other step halves the bracket, whatever Newton says. So the search
# ends: by then or, at the latest, when no number lies within the bracket, which in float64 takes
# 1074 + 1024 + 53 halvings of the widest there is.
_PATIENCE = 10

_FADED = 6.5  # Stribeck speeds, beyond which exp(-(v/vs)^2) is no part of 1 in float64


class Lanes(NamedTuple):
    """Skin and friction of every lane, ``[*]`` each, all positive or zero.

    Args:
        mass_kg: of the skin that moves with the contact; 0 is a pure balance of forces.
        stiffness_n_m: the spring that stays.
        relaxing_n_m: the spring of the Maxwell arm, whose force dies away.
        relaxation_time_s: with which it does; may be infinite.
        damping_n_s_m: the damper beside both springs.
        mu_s: friction coefficient at rest.
        mu_k: friction coefficient in sliding, at most ``mu_s``.
        stribeck_m_s: speed over which the one becomes the other.
        bristle_stiffness_n_m: of all bristles together.
        bristle_damping_n_s_m: of all bristles together, at rest.
        viscous_n_s_m: friction in proportion to speed.
        pressure: fraction of the load that each bristle carries, ``[n]``; sums to 1.
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


class LaneState(NamedTuple):
    """Where every lane is between two steps, or how fast it changes.

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
    def sticking(cls, lanes: Lanes, force_n: Tensor) -> LaneState:
        """At rest, the Maxwell arm relaxed, with a shear force that spring and bristles agree on.

        Each bristle carries the fraction of the force that it carries of the load, as after
        sliding. What goes beyond ``mu_s N`` is lost in the first step.
        """
        still = torch.zeros_like(force_n)
        each = lanes.bristle_stiffness_n_m / len(lanes.pressure)
        bristle = (force_n / each)[..., None] * lanes.pressure
        return cls(force_n / lanes.stiffness_n_m, still, still, bristle)


class Trace(NamedTuple):
    """Lanes at every so many steps; all ``[T, *]``.

    Args:
        friction_n: what the skin's springs transmit, ``k u + q``.
        inertia_n: mass times acceleration of the patch.
        slip_m_s: speed of the patch over the surface less the bristles' rates, each by its
            fraction of the load. More than half of the arm's speed is gross sliding.
    """

    friction_n: Tensor
    inertia_n: Tensor
    slip_m_s: Tensor


def hertz_pressure(num_bristles: int) -> Tensor:
    """Fractions of the load under a Hertz pressure, in proportion to ``sqrt(1 - r^2)``.

    Bristle ``i`` stands at ``r = (2 i + 1) / n - 1`` across the contact.

    Shape:
        - output: ``[n]`` float64, positive, sums to 1
    """
    place = (2.0 * torch.arange(num_bristles, dtype=torch.float64) + 1.0) / num_bristles - 1.0
    weights = (1.0 - place * place).sqrt()
    return weights / weights.sum()


def stage_times_s(num_steps: int, step_s: float, first_step: int = 0) -> Tensor:
    """The times at which ``integrate`` wants to be driven, from that of step 0.

    Shape:
        - output: ``[2 num_steps]`` float64, two stages a step
    """
    steps = torch.arange(first_step, first_step + num_steps, dtype=torch.float64)
    return torch.stack((steps + _GAMMA, steps + 1.0), -1).flatten() * step_s


def integrate(
    lanes: Lanes,
    state: LaneState,
    arm_m_s: Tensor,
    load_n: Tensor,
    step_s: float,
    every: int = 1,
    backend: BackendName = "auto",
) -> tuple[Trace, LaneState]:
    """Carry lanes through time under a drive.

    To do with less memory, integrate piece by piece, each from the state that the one before it
    gave back: the result is the same.

    Args:
        lanes: skin and friction.
        state: where the lanes are.
        arm_m_s: the arm's speed over the surface at the stages, ``stage_times_s``.
        load_n: newtons at the same times.
        step_s: length of a step; 125 to 250 us are accurate, any is stable.
        every: of how many steps the last is kept; it divides their number.
        backend: ``"native"`` is for float64 on the CPU and has no gradient; ``"auto"`` takes it
            where it can, else ``"torch"``. They agree to rounding.

    Returns:
        The trace, its entry ``i`` after ``(i + 1) every`` steps, and the last state.

    Shape:
        - arm_m_s, load_n: ``[2 num_steps, *]``
        - output: ``[num_steps / every, *]``, in the lanes' kind of number and on their device

    Raises:
        ValueError: for an unknown backend, or one that cannot do this.
    """
    chosen = native.backend_of(backend)
    if chosen == "native" and (lack := _native_lacks(lanes, state, arm_m_s, load_n)):
        if backend == "native":
            raise ValueError(f'backend "native" {lack}; use backend "torch"')
        chosen = "torch"
    carry = _carry_native if chosen == "native" else _carry_torch
    return carry(lanes, state, arm_m_s, load_n, step_s, every)


def integrator() -> dict[str, str]:
    """What integrates recordings here: backends and their releases round apart."""
    chosen = native.backend_of("auto")
    runs_on = "tactslip_torch" if chosen == "native" else "torch"
    return {
        "backend": chosen,
        f"{runs_on}_version": version(runs_on),
        "dtype": "float64",
        "device": "cpu",
    }


# --- the definition -----------------------------------------------------------------------------


def _carry_torch(
    lanes: Lanes, state: LaneState, arm: Tensor, load: Tensor, step_s: float, every: int
) -> tuple[Trace, LaneState]:
    """All lanes at once, step by step, in torch."""
    stage, rows = _Stage(lanes, _GAMMA * step_s), []
    rest_s = (1.0 - 2.0 * _GAMMA) * step_s
    for number in range(len(arm) // 2):
        start_m_s, (first, second) = state.speed_m_s, (2 * number, 2 * number + 1)
        middle, rates = stage.end(state, arm[first], load[first], start_m_s)
        # The second stage starts 1 - gamma of the first's rates ahead, gamma of them behind its end
        ahead = LaneState(*(x + rest_s * rate for x, rate in zip(middle, rates, strict=True)))
        guess = start_m_s + (middle.speed_m_s - start_m_s) / _GAMMA
        state, rates = stage.end(ahead, arm[second], load[second], guess)
        if (number + 1) % every == 0:
            friction = lanes.stiffness_n_m * state.stretch_m + state.relaxing_n
            slip = state.speed_m_s - (rates.bristle_m * lanes.pressure).sum(-1)
            rows.append(Trace(friction, lanes.mass_kg * rates.speed_m_s, slip))
    return Trace(*(torch.stack(column) for column in zip(*rows, strict=True))), state


class _Pull(NamedTuple):
    """Bristles at one speed."""

    bristle: Tensor  # deflections, [*, n]
    rate: Tensor  # theirs, [*, n]
    force: Tensor  # of all bristles, [*]
    slope: Tensor  # its derivative by the speed, [*]


class _Stage:
    """Implicit stages of one length ``a``: what they have in common, and how one ends."""

    def __init__(self, lanes: Lanes, stage_s: float) -> None:
        self.lanes, self.stage_s = lanes, stage_s
        self.relaxed = 1.0 / (1.0 + stage_s / lanes.relaxation_time_s)
        springs = lanes.stiffness_n_m + lanes.relaxing_n_m * self.relaxed
        dampers = lanes.damping_n_s_m + lanes.viscous_n_s_m
        self.inertia = lanes.mass_kg + stage_s * (stage_s * springs + dampers)  # A, kg
        n = len(lanes.pressure)
        self.stiffness = (lanes.bristle_stiffness_n_m / n)[..., None]  # of one bristle
        self.damping = (lanes.bristle_damping_n_s_m / n)[..., None]  # of one bristle at rest
        self.mu_s, self.mu_k = lanes.mu_s[..., None], lanes.mu_k[..., None]
        self.stribeck = lanes.stribeck_m_s[..., None]

    def end(
        self, base: LaneState, arm: Tensor, normal_n: Tensor, guess: Tensor
    ) -> tuple[LaneState, LaneState]:
        """The end of a stage from ``base`` and the rates there; differentiable.

        Args:
            base: values that the stage starts from.
            arm: speed at the stage's time, ``[*]``.
            normal_n: load at that time, ``[*]``; below 0, or no more than rounding, it is none.
            guess: speed to start the search from.
        """
        lanes, a = self.lanes, self.stage_s
        floor = torch.finfo(normal_n.dtype).tiny ** 0.25
        load = torch.where(normal_n > floor, normal_n, 0.0)[..., None] * lanes.pressure
        most = load * (self.mu_s / self.stiffness)  # deflection that the load holds
        bristle = torch.minimum(torch.maximum(base.bristle_m, -most), most)
        drive = (
            lanes.stiffness_n_m * (base.stretch_m + a * arm)
            + self.relaxed * (base.relaxing_n + a * lanes.relaxing_n_m * arm)
            + lanes.damping_n_s_m * arm
        )
        offset = -lanes.mass_kg * base.speed_m_s - a * drive
        at_rest = offset + a * (self.stiffness * bristle).sum(-1)
        side = torch.where(at_rest > 0, -1.0, 1.0).to(offset.dtype)  # of 0, where the root is
        turned, offset = side[..., None] * bristle, side * offset
        with torch.no_grad():
            strongest = 3.0 * a * lanes.mu_s * load.sum(-1)  # more than bristles can pull
            high = ((strongest - offset) / self.inertia).clamp(min=0.0)
            speed = self.root(load, turned, offset, side * guess, high)
        if torch.is_grad_enabled():  # one more step of Newton has the derivative of the root
            left, slope, _ = self.left(load, turned, offset, speed)
            speed = speed - (left - left.detach()) / slope.detach()
        at = self.pull(load, turned, speed)
        v, back = side * speed, side[..., None]
        stretching = arm - v
        relaxing = self.relaxed * (base.relaxing_n + a * lanes.relaxing_n_m * stretching)
        state = LaneState(base.stretch_m + a * stretching, v, relaxing, back * at.bristle)
        relaxing_rate = lanes.relaxing_n_m * stretching - relaxing / lanes.relaxation_time_s
        accelerating = (v - base.speed_m_s) / a
        return state, LaneState(stretching, accelerating, relaxing_rate, back * at.rate)

    def pull(self, load: Tensor, base: Tensor, speed: Tensor) -> _Pull:
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
            load: of each bristle.
            base: deflections that the stage starts from, cut to what the load holds.
            speed: not negative; for a patch that moves back turn the signs of ``base`` and of the
                result.

        Shape:
            - load, base: ``[*, n]``
            - speed: ``[*]``
        """
        v = speed[..., None]
        held = load > 0
        ratio = (v / self.stribeck).clamp(max=_FADED)
        fading = (self.mu_s - self.mu_k) * torch.where(ratio < _FADED, (-ratio * ratio).exp(), 0.0)
        g = load * (self.mu_k + fading)
        g_slope = load * (fading * (-2.0 * ratio / self.stribeck))
        s, lag = self.stiffness, self.stage_s * self.stiffness
        share = torch.where(held, g + lag * v, 1.0).reciprocal()
        reached = base + self.stage_s * v
        bristle = g * reached * share
        bristle_slope = (g_slope * reached + g * self.stage_s - bristle * (g_slope + lag)) * share
        free = g - s * base
        rate = v * free * share
        rate_slope = (free + v * g_slope - rate * (g_slope + lag)) * share
        most = load * self.mu_k  # what the damping cannot pass
        damped = torch.where(held, most + self.damping * v, 1.0).reciprocal()
        damping = self.damping * most * damped
        damping_slope = -damping * self.damping * damped
        force = s * bristle + damping * rate
        slope = s * bristle_slope + damping_slope * rate + damping * rate_slope
        return _Pull(bristle, rate, force.sum(-1), slope.sum(-1))

    def left(
        self, load: Tensor, base: Tensor, offset: Tensor, speed: Tensor
    ) -> tuple[Tensor, Tensor, _Pull]:
        """What is left of the stage's equation at a speed, and its slope."""
        at = self.pull(load, base, speed)
        left = self.inertia * speed + offset + self.stage_s * at.force
        return left, self.inertia + self.stage_s * at.slope, at

    def root(
        self, load: Tensor, base: Tensor, offset: Tensor, guess: Tensor, high: Tensor
    ) -> Tensor:
        """A root between 0, where the equation is not positive, and ``high``, where not negative.

        Newton's steps; one that would leave the bracket goes to its lower end the first time (the
        force bends down with the speed, so that Newton climbs from there) and halves it later. A
        lane is done where the equation holds to rounding, a step of Newton within the bracket is
        so small that the next would be rounding, or no number is left within the bracket. It then
        no longer moves, so that its result does not depend on its neighbours.
        """
        eps = torch.finfo(offset.dtype).eps
        low = torch.zeros_like(high)
        speed = torch.minimum(guess.clamp(min=0.0), high)
        done = torch.zeros_like(high, dtype=torch.bool)
        was_low = done
        for number in count():
            left, slope, at = self.left(load, base, offset, speed)
            scale = self.inertia * speed + offset.abs() + self.stage_s * at.force.abs()
            below = left < 0
            low = torch.where(below, speed, low)
            high = torch.where(below, high, speed)
            wanted = speed - left / slope
            outside = ~((wanted >= low) & (wanted <= high))  # so is NaN
            if number >= _PATIENCE and number % 2:
                outside = torch.ones_like(outside)
            half = low + 0.5 * (high - low)
            empty = ~((half > low) & (half < high))  # also where it is NaN
            to_low = outside & ~was_low & (number < _PATIENCE)
            wanted = torch.where(outside, torch.where(to_low, low, half), wanted)
            was_low = was_low | to_low
            close = (wanted - speed).abs() <= eps**0.5 * speed
            exact = left.abs() <= 4.0 * eps * scale
            speed = torch.where(done | exact & outside, speed, wanted)
            done = done | exact | close & ~outside | empty
            if bool(done.all()):
                break
        return speed


# --- the native engine --------------------------------------------------------------------------


def _native_lacks(lanes: Lanes, state: LaneState, arm: Tensor, load: Tensor) -> str:
    """Why kernels cannot do this; empty if they can."""
    if lanes.pressure.dtype != torch.float64 or lanes.pressure.device.type != "cpu":
        return f"needs float64 on the CPU, got {lanes.pressure.dtype} on {lanes.pressure.device}"
    if torch.is_grad_enabled() and any(x.requires_grad for x in (*lanes, *state, arm, load)):
        return "has no gradient, which is asked for"
    return ""


def _carry_native(
    lanes: Lanes, state: LaneState, arm: Tensor, load: Tensor, step_s: float, every: int
) -> tuple[Trace, LaneState]:
    """``_carry_torch`` of float64 on the CPU, without gradient."""
    *flat, bristle = (values.detach() for values in state)
    shape, n, stage = flat[0].shape, len(lanes.pressure), _Stage(lanes, _GAMMA * step_s)
    of_bristle = (stage.stiffness[..., 0], stage.damping[..., 0])
    rows = (*lanes[:8], *of_bristle, stage.relaxed, stage.inertia)
    table = torch.stack([row.detach().expand(shape).reshape(-1) for row in rows]).numpy()
    states = torch.stack([values.reshape(-1) for values in flat]).numpy()
    bristles = bristle.reshape(-1, n).numpy().copy()
    arm, load = (
        values.detach().expand(len(arm), *shape).reshape(len(arm), -1).contiguous()
        for values in (arm, load)
    )
    out = native.carry_bristles(
        table,
        lanes.pressure.detach().contiguous().numpy(),
        states,
        bristles,
        arm.numpy(),
        load.numpy(),
        step_s=step_s,
        gamma=_GAMMA,
        every=every,
        patience=_PATIENCE,
    )
    trace = Trace(*(torch.from_numpy(values).reshape(-1, *shape) for values in out))
    u, v, q = torch.from_numpy(states).reshape(3, *shape)
    return trace, LaneState(u, v, q, torch.from_numpy(bristles).reshape(*shape, n))
