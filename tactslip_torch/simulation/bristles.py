"""Skin and bristles: friction integrated in time, one lane for one element in one stroke.

PHYSICS.md, skin and friction: a mass behind a spring, a damper and a Maxwell arm (standard linear
solid), carried over the surface by bristles under a Hertz pressure (Canudas de Wit, Olsson, Astrom
and Lischinsky 1995, IEEE TAC 40(3), 419-425). One bristle is LuGre's model, 16 to 64 are a patch
whose edge lets go first. SI units throughout.

The scheme is SDIRK2 (PHYSICS.md, stiffness): two implicit stages a step, order 2, L-stable, and the
second stage ends at the step's end, so that what a trace holds obeys the balance of forces to
rounding (Alexander 1977, SIAM J. Numer. Anal. 14(6), 1006-1021). A stage of length ``a`` from base
values in small letters, the arm's speed ``w``::

    U = u + a (w - V)        Q = (q + a k1 (w - V)) / (1 + a / tau)
    m V = m v + a (k U + Q + c (w - V) - sigma2 V - F(V))

Skin and bristles are eliminated; the last is one scalar equation ``A V + B + a F(V) = 0`` a lane,
with ``A > 0`` and ``F`` bounded, so there is always a root and a bracket.

This module is the definition: torch on any device, differentiable. ``compiled.py`` carries it out
for float64 on the CPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from importlib.metadata import version
from itertools import count
from typing import Literal, NamedTuple, Self, cast, get_args

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.runtime import usable_engine

EngineName = Literal["auto", "compiled", "eager"]

GROSS_SHARE = 0.5
"""Of the arm's speed, above which an element slides grossly, and a bristle at all."""

GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Length of a stage in steps."""

PATIENCE = 10
"""Evaluations after which every other step halves the bracket, whatever Newton says.

So the search ends: by then or, at the latest, when no number lies within the bracket, which in
float64 takes 1074 + 1024 + 53 halvings of the widest there is.
"""

_FADED = 6.5  # Stribeck speeds, beyond which exp(-(v/vs)^2) is no part of 1 in float64
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
            Stribeck speed, relaxation time or friction that is not positive, ``mu_k > mu_s``, or a
            pressure that does not sum to 1.
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
        dampers = ("damping_n_s_m", "bristle_damping_n_s_m", "viscous_n_s_m")
        may_be_zero = ("mass_kg", "relaxing_n_m", *dampers)
        for field in fields(self):
            name, values = field.name, getattr(self, field.name)
            fine = values >= 0 if name in may_be_zero else values > 0
            if name != "relaxation_time_s":
                fine = fine & values.isfinite()
            if not fine.all():
                sign = "not negative" if name in may_be_zero else "positive"
                raise ValueError(
                    f"expected {name} finite and {sign}, got {float(values[~fine][0]):g}"
                )
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

    @classmethod
    def together(cls, each: list[Lanes], device: torch.device, dtype: torch.dtype) -> Lanes:
        """Lanes ``[L]`` of several, one after the other; they share one pressure."""
        names = [field.name for field in fields(cls) if field.name != "pressure"]
        tensors = {name: torch.cat([getattr(own, name) for own in each]) for name in names}
        tensors["pressure"] = each[0].pressure
        return cls(**{name: values.to(device, dtype) for name, values in tensors.items()})

    @property
    def shape(self) -> torch.Size:
        """The lanes' shape."""
        tensors: list[Tensor] = [getattr(self, field.name) for field in fields(self)]
        return torch.Size(torch.broadcast_shapes(*(values.shape for values in tensors[:-1])))

    @property
    def num_bristles(self) -> int:
        """How many bristles share the load."""
        return len(self.pressure)


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


@dataclass(frozen=True, eq=False)
class Trace:
    """Lanes at every so many steps; all ``[T, *]``.

    Args:
        friction_n: what the skin's springs transmit, ``k u + q``.
        inertia_n: mass times acceleration of the patch.
        speed_m_s: of the patch over the surface.
        slip_m_s: that speed less the bristles' rates, each by its share of the load. More than
            half of the arm's speed is gross sliding.
        incipient: whether a bristle slips at more than half of the speed of an arm that moves; so
            does any without load, which the patch drags along.
    """

    friction_n: Tensor
    inertia_n: Tensor
    speed_m_s: Tensor
    slip_m_s: Tensor
    incipient: Tensor


def stage_times_s(num_steps: int, step_s: float, first_step: int = 0) -> Tensor:
    """The times at which ``integrate`` wants to be driven, from that of step 0.

    Shape:
        - output: ``[2 num_steps]`` float64, two stages a step
    """
    steps = torch.arange(first_step, first_step + num_steps, dtype=torch.float64)
    return torch.stack((steps + GAMMA, steps + 1.0), -1).flatten() * step_s


def integrate(
    lanes: Lanes,
    state: LaneState,
    arm_m_s: Tensor,
    load_n: Tensor,
    step_s: float,
    every: int = 1,
    engine: EngineName = "auto",
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
        every: of how many steps the last is kept.
        engine: ``"compiled"`` is for float64 on the CPU and has no gradient; ``"auto"`` takes it
            where it can, else ``"eager"``. They agree to rounding.

    Returns:
        The trace, its entry ``i`` after ``(i + 1) every`` steps, and the last state.

    Shape:
        - arm_m_s, load_n: ``[2 num_steps, *]``, or what expands to the lanes' shape ``*``
        - output: ``[num_steps / every, *]``, in the lanes' kind of number and on their device

    Raises:
        ValueError: for a number of steps that is not a multiple of ``every``, a step that is not
            positive, shapes that do not fit the lanes, an unknown engine, or one that cannot do
            this.
    """
    num_steps, shape = len(arm_m_s) // 2, lanes.shape
    if every < 1 or len(arm_m_s) != 2 * num_steps or num_steps % every:
        raise ValueError(
            f"expected two stages a step and num_steps as a multiple of every, got {len(arm_m_s)} "
            f"stages and {every}"
        )
    if not 0 < step_s < math.inf:
        raise ValueError(f"expected step_s positive and finite, got {step_s:g}")
    wanted = (shape, shape, shape, (*shape, lanes.num_bristles))
    came = [tuple(values.shape) for values in vars(state).values()]
    if came != [tuple(each) for each in wanted]:
        raise ValueError(
            f"expected a state of lanes {tuple(shape)} with {lanes.num_bristles} bristles, got "
            f"{', '.join(map(str, came))}"
        )
    try:
        arm, load = (
            values.to(lanes.pressure).expand(2 * num_steps, *shape) for values in (arm_m_s, load_n)
        )
    except RuntimeError:
        raise ValueError(
            f"expected arm_m_s and load_n that expand to {(2 * num_steps, *shape)}, got "
            f"{tuple(arm_m_s.shape)} and {tuple(load_n.shape)}"
        ) from None
    chosen = _usable(engine)
    if chosen == "compiled" and (lack := _compiled_lacks(lanes, state, arm, load)):
        if engine == "compiled":
            raise ValueError(f'engine "compiled" {lack}; use engine "eager"')
        chosen = "eager"
    carry = _carry_compiled if chosen == "compiled" else _carry_eager
    return carry(lanes, state, arm, load, step_s, every)


def integrator(
    engine: EngineName = "auto",
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> dict[str, str]:
    """What carries lanes of a kind here without gradient: engines and their releases round apart.

    Raises:
        ValueError: for an unknown engine, or one that cannot be used here.

    Example:
        >>> integrator("eager")["engine"]
        'eager'
    """
    kind = torch.device(device).type
    chosen = _usable(engine)
    if (dtype, kind) != (torch.float64, "cpu"):
        chosen = "eager"
    runs_on = "numba" if chosen == "compiled" else "torch"
    return {
        "engine": chosen,
        f"{runs_on}_version": version(runs_on),
        "dtype": str(dtype).removeprefix("torch."),
        "device": kind,
    }


# --- the definition -----------------------------------------------------------------------------


def _carry_eager(
    lanes: Lanes, state: LaneState, arm: Tensor, load: Tensor, step_s: float, every: int
) -> tuple[Trace, LaneState]:
    """All lanes at once, step by step, in torch."""
    stage, rows = _Stage(lanes, GAMMA * step_s), []
    rest_s = (1.0 - 2.0 * GAMMA) * step_s
    for number in range(len(arm) // 2):
        start_m_s, (first, second) = state.speed_m_s, (2 * number, 2 * number + 1)
        middle = stage.end(state, arm[first], load[first], start_m_s)
        # The second stage starts 1 - gamma of the first's rates ahead, gamma of them behind its end
        ahead = LaneState(
            *(
                value + rest_s * rate
                for value, rate in zip(
                    vars(middle.state).values(), vars(middle.rates).values(), strict=True
                )
            )
        )
        guess = start_m_s + (middle.state.speed_m_s - start_m_s) / GAMMA
        last = stage.end(ahead, arm[second], load[second], guess)
        state = last.state
        if (number + 1) % every == 0:
            moves = arm[second] != 0
            slipping = last.slip_m_s.abs() > GROSS_SHARE * arm[second].abs()[..., None]
            rows.append(
                (
                    lanes.stiffness_n_m * state.stretch_m + state.relaxing_n,
                    last.inertia_n,
                    state.speed_m_s,
                    (last.slip_m_s * lanes.pressure).sum(-1),
                    slipping.any(-1) & moves,
                )
            )
    if not rows:
        nothing = lanes.pressure.new_empty((0, *lanes.shape))
        return Trace(nothing, nothing, nothing, nothing, nothing.bool()), state
    return Trace(*(torch.stack(column) for column in zip(*rows, strict=True))), state


class _StageEnd(NamedTuple):
    """A lane at the end of a stage and how fast it changes there."""

    state: LaneState
    rates: LaneState
    inertia_n: Tensor  # m v'
    slip_m_s: Tensor  # of each bristle, [*, n]


class _Pull(NamedTuple):
    """Bristles at one speed."""

    bristle: Tensor  # deflections, [*, n]
    rate: Tensor  # theirs, [*, n]
    force: Tensor  # of all bristles, [*]
    slope: Tensor  # its derivative by the speed, [*]


class _Stage:
    """Implicit stages of one length ``a``: what they share, and how one ends."""

    def __init__(self, lanes: Lanes, stage_s: float) -> None:
        self.lanes, self.stage_s = lanes, stage_s
        self.relaxed = 1.0 / (1.0 + stage_s / lanes.relaxation_time_s)
        springs = lanes.stiffness_n_m + lanes.relaxing_n_m * self.relaxed
        dampers = lanes.damping_n_s_m + lanes.viscous_n_s_m
        self.inertia = lanes.mass_kg + stage_s * (stage_s * springs + dampers)  # A, kg
        n = lanes.num_bristles
        self.stiffness = (lanes.bristle_stiffness_n_m / n)[..., None]  # of one bristle
        self.damping = (lanes.bristle_damping_n_s_m / n)[..., None]  # of one bristle at rest
        self.mu_s, self.mu_k = lanes.mu_s[..., None], lanes.mu_k[..., None]
        self.stribeck = lanes.stribeck_m_s[..., None]

    def end(self, base: LaneState, arm: Tensor, normal_n: Tensor, guess: Tensor) -> _StageEnd:
        """The end of a stage from ``base``; differentiable.

        Args:
            base: values that the stage starts from.
            arm: speed at the stage's time, ``[*]``.
            normal_n: load at that time, ``[*]``.
            guess: speed to start the search from.
        """
        lanes, a = self.lanes, self.stage_s
        load = self.carried(normal_n)
        most = load * (self.mu_s / self.stiffness)  # deflection that the load holds
        bristle = torch.minimum(torch.maximum(base.bristle_m, -most), most)
        ahead = base.relaxing_n + a * lanes.relaxing_n_m * arm
        drive = (
            lanes.stiffness_n_m * (base.stretch_m + a * arm)
            + self.relaxed * ahead
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
        v = side * speed
        stretching = arm - v
        relaxing = self.relaxed * (base.relaxing_n + a * lanes.relaxing_n_m * stretching)
        accelerating = (v - base.speed_m_s) / a
        back = side[..., None]
        return _StageEnd(
            LaneState(base.stretch_m + a * stretching, v, relaxing, back * at.bristle),
            LaneState(
                stretching,
                accelerating,
                lanes.relaxing_n_m * stretching - relaxing / lanes.relaxation_time_s,
                back * at.rate,
            ),
            lanes.mass_kg * accelerating,
            back * (speed[..., None] - at.rate),
        )

    def carried(self, normal_n: Tensor) -> Tensor:
        """Load of each bristle ``[*, n]``; one that is no more than rounding, or below, is none."""
        floor = torch.finfo(normal_n.dtype).tiny ** 0.25
        return torch.where(normal_n > floor, normal_n, 0.0)[..., None] * self.lanes.pressure

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
            load: of each bristle, from ``carried``.
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
            if number >= PATIENCE and number % 2:
                outside = torch.ones_like(outside)
            half = low + 0.5 * (high - low)
            empty = ~((half > low) & (half < high))  # also where it is NaN
            to_low = outside & ~was_low & (number < PATIENCE)
            wanted = torch.where(outside, torch.where(to_low, low, half), wanted)
            was_low = was_low | to_low
            close = (wanted - speed).abs() <= eps**0.5 * speed
            exact = left.abs() <= 4.0 * eps * scale
            speed = torch.where(done | exact & outside, speed, wanted)
            done = done | exact | close & ~outside | empty
            if bool(done.all()):
                break
        return speed


# --- the compiled engine ------------------------------------------------------------------------


def _usable(engine: EngineName) -> EngineName:
    """The engine that a name means on this machine, or one line why it cannot be."""
    known = get_args(EngineName)
    return cast(EngineName, usable_engine(engine, known, _load_kernels, "bristles are integrated"))


def _load_kernels() -> None:
    from tactslip_torch.simulation import compiled  # noqa: F401  (numba takes a second)


def _compiled_lacks(lanes: Lanes, state: LaneState, arm: Tensor, load: Tensor) -> str:
    """Why kernels cannot do this; empty if they can."""
    if lanes.pressure.dtype != torch.float64 or lanes.pressure.device.type != "cpu":
        return f"needs float64 on the CPU, got {lanes.pressure.dtype} on {lanes.pressure.device}"
    tensors = (*vars(lanes).values(), *vars(state).values(), arm, load)
    if torch.is_grad_enabled() and any(values.requires_grad for values in tensors):
        return "has no gradient, which is asked for"
    return ""


def _carry_compiled(
    lanes: Lanes, state: LaneState, arm: Tensor, load: Tensor, step_s: float, every: int
) -> tuple[Trace, LaneState]:
    """``_carry_eager`` of float64 on the CPU, without gradient."""
    from tactslip_torch.simulation.compiled import carry_blocks

    n, shape, stage = lanes.num_bristles, lanes.shape, _Stage(lanes, GAMMA * step_s)
    rows = (
        lanes.mass_kg,
        lanes.stiffness_n_m,
        lanes.relaxing_n_m,
        lanes.relaxation_time_s,
        lanes.damping_n_s_m,
        lanes.mu_s,
        lanes.mu_k,
        lanes.stribeck_m_s,
        stage.stiffness[..., 0],
        stage.damping[..., 0],
        stage.relaxed,
        stage.inertia,
    )
    table = torch.stack([row.detach().expand(shape).reshape(-1) for row in rows]).numpy()
    *flat, bristle = (values.detach() for values in vars(state).values())
    states = torch.stack([values.reshape(-1) for values in flat]).numpy()
    bristles = bristle.reshape(-1, n).numpy().copy()
    num_rows = len(arm) // (2 * every)
    out = np.empty((4, num_rows, shape.numel()))
    incipient = np.empty((num_rows, shape.numel()), dtype=np.bool_)
    carry_blocks(
        table,
        states,
        bristles,
        np.ascontiguousarray(lanes.pressure.detach().numpy()),
        arm.detach().reshape(len(arm), shape.numel()).contiguous().numpy(),
        load.detach().reshape(len(load), shape.numel()).contiguous().numpy(),
        step_s,
        GAMMA,
        PATIENCE,
        GROSS_SHARE,
        every,
        out,
        incipient,
    )
    kept = [torch.from_numpy(values).reshape(num_rows, *shape) for values in (*out, incipient)]
    u, v, q = torch.from_numpy(states).reshape(3, *shape)
    return Trace(*kept), LaneState(u, v, q, torch.from_numpy(bristles).reshape(*shape, n))
