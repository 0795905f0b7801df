"""The dynamic rung where a scheme breaks: stiff, light, fast, unloaded, shaken, in float32."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from dynamics_oracle import SMOOTH, TACKY, driven, ramped

from tactslip_torch.simulation.dynamics import (
    Drive,
    Lanes,
    LaneState,
    hertz_pressure,
    integrate,
    stage,
)
from tactslip_torch.simulation.dynamics.stepper import EngineName

ENGINES: tuple[EngineName, ...] = ("eager", "compiled")

SPEEDS_M_S = (1e-6, 1e-3, 0.04, 2.0)
STIFFNESSES_N_M = (1.0, 1e3, 1e6)
BRISTLES_N_M = (1e2, 1e5, 1e8)
MASSES_KG = (0.0, 1e-12, 5e-3, 1.0)
LOADS_N = (0.0, 1e-9, 1.0, 1e6)


def extreme(n: int, dtype: torch.dtype) -> tuple[Lanes, torch.Tensor, torch.Tensor]:
    """A lane for each choice of the above, half of them tacky; its arm's speed and its load."""
    grid = np.array(list(product(SPEEDS_M_S, STIFFNESSES_N_M, BRISTLES_N_M, MASSES_KG, LOADS_N)))
    speed, k, sigma, m, load = torch.tensor(grid).T
    tacky = torch.arange(len(grid)) % 2 == 0
    lanes = SMOOTH.lanes(
        dtype,
        k=k,
        k1=0.2 * k,
        m=m,
        sigma=sigma,
        d0=(1e-3 * sigma).sqrt(),
        mu_s=torch.where(tacky, 1.1, 0.8),
        mu_k=torch.where(tacky, 0.85, 0.7),
        vs=torch.where(tacky, 0.05, 0.01),
        pressure=hertz_pressure(n),
    )
    return lanes, speed, load


def turning(speed: torch.Tensor, load: torch.Tensor, until_s: float) -> Drive:
    """The load goes at a third and is back at half, the arm turns round near the end."""

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        phase = (times / until_s)[:, None]
        lifted = (phase > 1 / 3) & (phase < 1 / 2)
        arm = speed * torch.where(phase < 0.8, 1.0, -1.0)
        return arm, torch.where(lifted, 0.0, load * (1.0 + 0.5 * torch.sin(40.0 * phase)))

    return drive


def needing(engine: EngineName) -> EngineName:
    if engine == "compiled":
        pytest.importorskip("numba")
    return engine


@pytest.mark.parametrize("step_s", [1e-6, 250e-6, 5e-3])
@pytest.mark.parametrize(
    ("n", "dtype", "engine", "num"),
    [
        (1, torch.float64, "compiled", 120),
        (4, torch.float64, "compiled", 120),
        (2, torch.float64, "eager", 24),
        (2, torch.float32, "eager", 24),
    ],
)
def test_bounded_and_within_the_cone(
    step_s: float, n: int, dtype: torch.dtype, engine: EngineName, num: int
) -> None:
    engine = needing(engine)
    lanes, speed, load = extreme(n, dtype)
    drive = turning(speed, load, num * step_s)
    load_n, moving = load.to(dtype), speed.to(dtype)
    state = LaneState.sticking(lanes, 0.5 * lanes.mu_k * load_n, 0.2)
    each, slack = lanes.bristle_stiffness_n_m[:, None] / n, 64 * torch.finfo(dtype).eps
    springs = lanes.stiffness_n_m + lanes.relaxing_n_m
    drag = lanes.damping_n_s_m + (springs * lanes.mass_kg).sqrt()
    most = 1.5 * (1.5 * lanes.mu_s * load_n + 2.0 * drag * moving)  # 1.5 N, and turning round
    for number in range(num):
        trace, state = integrate(
            lanes, state, drive, 1, step_s, start_s=number * step_s, engine=engine
        )
        for name, values in (vars(trace) | vars(state)).items():
            assert values.isfinite().all(), (number, name)
        now = drive(torch.tensor([(number + 1) * step_s], dtype=torch.float64))[1][0].to(dtype)
        cone = lanes.pressure * (lanes.mu_s * now)[:, None]
        assert ((each * state.bristle_m).abs() <= cone * (1.0 + slack)).all(), number
        assert (trace.friction_n[0].abs() <= most).all(), number
        assert (trace.inertia_n[0].abs() <= most).all(), number
        free = (now == 0.0) & (moving > 0)
        torch.testing.assert_close(trace.slip_m_s[0][free], trace.speed_m_s[0][free])


@pytest.mark.parametrize("step_s", [1e-6, 250e-6, 5e-3])
def test_no_stage_is_left_unsolved(step_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every lane's equation holds to rounding, or turns its sign within 3e-8 of the speed."""
    root, eps, num, judged = stage._root, torch.finfo(torch.float64).eps, 24, 0

    def watched(skin, load, base, offset, guess, high):  # type: ignore[no-untyped-def]
        nonlocal judged
        speed = root(skin, load, base, offset, guess, high)
        left, _, at = stage._left(skin, load, base, offset, speed)
        below, _, _ = stage._left(skin, load, base, offset, speed * (1.0 - 2.0 * eps**0.5))
        above, _, _ = stage._left(skin, load, base, offset, speed * (1.0 + 2.0 * eps**0.5))
        scale = skin.inertia * speed + offset.abs() + skin.stage_s * at.force.abs()
        solved = (left.abs() <= 16.0 * eps * scale) | (below <= 0) & (above >= 0)
        assert solved.all(), f"{int((~solved).sum())} lanes unsolved"
        judged += solved.numel()
        return speed

    monkeypatch.setattr(stage, "_root", watched)
    lanes, speed, load = extreme(4, torch.float64)
    state = LaneState.sticking(lanes, 0.5 * lanes.mu_k * load, 0.2)
    integrate(lanes, state, turning(speed, load, num * step_s), num, step_s, engine="eager")
    assert judged == 2 * num * len(speed)


@pytest.mark.parametrize("step_s", [1e-6, 250e-6, 5e-3])
def test_engines_agree_where_it_is_extreme(step_s: float) -> None:
    pytest.importorskip("numba")
    lanes, speed, load = extreme(2, torch.float64)
    start = LaneState.sticking(lanes, 0.5 * lanes.mu_k * load, 0.2)
    drive = turning(speed, load, 4 * step_s)
    (one, _), (other, _) = (
        integrate(lanes, start, drive, 4, step_s, engine=engine) for engine in ENGINES
    )
    springs = lanes.stiffness_n_m + lanes.relaxing_n_m
    drag = lanes.damping_n_s_m + (springs * lanes.mass_kg).sqrt()
    scale = lanes.mu_s * load + drag * speed
    for name in ("friction_n", "inertia_n"):
        assert ((vars(one)[name] - vars(other)[name]).abs() <= 1e-6 * scale).all(), name


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_search_ends_though_nothing_can_be_found(engine: EngineName, wrong: float) -> None:
    lanes = SMOOTH.lanes(m=[0.0, 5e-3], pressure=hertz_pressure(2))
    start = LaneState.sticking(lanes, 0.3)
    drive = driven(lambda t: wrong, lambda t: 1.0)
    trace, _ = integrate(lanes, start, drive, 3, 250e-6, engine=needing(engine))
    assert not trace.friction_n.isfinite().any()


def test_without_mass_is_the_limit_of_little() -> None:
    lanes = TACKY.lanes(m=[0.0, 1e-12, 1e-9])
    drive = driven(ramped(0.02), lambda t: 1.0)
    trace, _ = integrate(lanes, LaneState.sticking(lanes), drive, 180, 250e-6)
    assert (trace.inertia_n[:, 0] == 0).all()
    friction = trace.friction_n
    torch.testing.assert_close(friction[:, 1], friction[:, 0], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(friction[:, 2], friction[:, 0], rtol=1e-3, atol=1e-6)
    assert 0.5 < friction[-1, 0] < 1.1


def test_stiff_skin_is_coulombs_slider() -> None:
    """Skin and bristles far stiffer than any: steady friction is ``mu(v) N`` at once."""
    lanes = SMOOTH.lanes(k=[1e6, 1e7], sigma=[1e8, 1e9], k1=0.0, pressure=hertz_pressure(8))
    drive = driven(lambda t: 0.04, lambda t: 2.0 + math.sin(20.0 * t))
    trace, _ = integrate(lanes, LaneState.sticking(lanes), drive, 800, 250e-6)
    times = np.arange(101, 801) * 250e-6
    wanted = torch.tensor(0.7 * (2.0 + np.sin(20.0 * times)))[:, None].expand(-1, 2)
    carried = trace.friction_n[100:] - trace.inertia_n[100:]
    torch.testing.assert_close(carried, wanted, rtol=1e-3, atol=0)


# Energy --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "step_s", "engine"),
    [
        *product((1, 8), (1.0 / 32000, 1.0 / 4000, 1.0 / 400), ("compiled",)),
        (2, 1.0 / 4000, "eager"),
        (2, 1.0 / 400, "eager"),
    ],
)
def test_friction_gives_nothing_over_a_cycle(n: int, step_s: float, engine: EngineName) -> None:
    """Work of friction less what bristles store, by the right ends of the steps, over a cycle.

    Sticking bristles are springs: their gross work is large and comes back. What is left is not
    negative to 2e-5 of the gross work, and to 2e-3 at steps of a 40th of a cycle. The first cycle
    begins without a force and does not end so, which right ends do not count: half a step's power.
    """
    period, engine = 0.1, needing(engine)
    num_cycles = 4 if engine == "compiled" else 2
    speeds = (1e-6, 1e-4, 3e-3, 0.05, 0.5)
    grid = np.array(list(product(speeds, (0.0, 5e-3), (3e3, 1e5), (0.0, 0.9), (0.0, 1.0))))
    speed, m, sigma, tremor, damped = torch.tensor(grid).T
    d0 = damped * (5e-3 * sigma).sqrt()
    lanes = TACKY.lanes(m=m, sigma=sigma, d0=d0, pressure=hertz_pressure(n))

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        phase = (2.0 * math.pi / period * times)[:, None]
        return speed * torch.cos(phase), 1.0 + tremor * torch.sin(3.0 * phase)

    num, state = round(period / step_s), LaneState.sticking(lanes)
    each = lanes.bristle_stiffness_n_m / n
    for cycle in range(num_cycles):
        before = 0.5 * each * state.bristle_m.square().sum(-1)
        trace, state = integrate(
            lanes, state, drive, num, step_s, start_s=cycle * period, engine=engine
        )
        ends = cycle * period + step_s * torch.arange(1, num + 1, dtype=torch.float64)
        stretching = drive(ends)[0] - trace.speed_m_s
        pull = trace.friction_n + lanes.damping_n_s_m * stretching - trace.inertia_n
        power = step_s * pull * trace.speed_m_s
        after = 0.5 * each * state.bristle_m.square().sum(-1)
        gross = power.abs().sum(0) + before + after
        lost = power.sum(0) - (after - before)
        tolerance = 2e-5 if step_s < 1e-3 else 2e-3
        if cycle:
            assert (lost >= -tolerance * gross).all()
    slides = speed == 0.5
    assert (lost[slides] > 0.5 * gross[slides]).all()


def test_a_sticking_element_stops() -> None:
    """Thrown at 5 mm/s while pulled with less than ``mu_s N``, it comes to rest and holds."""
    share = torch.tensor([0.0, 0.5, 0.9, 0.98], dtype=torch.float64)
    lanes = SMOOTH.lanes(m=[[1e-4], [5e-3]], sigma=[1e5] * 4, k1=0.0, pressure=hertz_pressure(3))
    start = LaneState.sticking(lanes, share * 0.8)
    start = replace(start, speed_m_s=torch.full_like(start.speed_m_s, 5e-3))
    still = driven(lambda t: 0.0, lambda t: 1.0)

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return tuple(values[:, None] for values in still(times))

    trace, state = integrate(lanes, start, drive, 8000, 250e-6)
    assert (trace.speed_m_s[-400:].abs() < 1e-9).all()
    assert (state.stretch_m - start.stretch_m).abs().max() < 2e-4
    held = (lanes.bristle_stiffness_n_m[..., None] / 3 * state.bristle_m).sum(-1)
    torch.testing.assert_close(held, trace.friction_n[-1], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("trembling", ["pull", "pull and load"])
def test_drift_under_vibration_is_radaus(trembling: str) -> None:
    """Pulled with half of what holds at rest, trembling: the model creeps, and we as it does."""
    force, until_s, turn = 0.4, 0.12, 2.0 * math.pi * 50.0

    def arm(t: float) -> float:
        return 4e-3 * turn * math.cos(turn * t)

    def load(t: float) -> float:
        return 1.0 + (0.2 * math.sin(turn * t + 1.0) if trembling != "pull" else 0.0)

    element = replace(SMOOTH, k1=0.0, k=50.0, c=0.1)  # soft: pulls on as the patch creeps
    lanes = element.lanes(m=[5e-3])
    start = LaneState.sticking(lanes, force)
    begun = np.array([force / element.k, 0.0, 0.0, force / element.sigma])
    found = element.radau(arm, load, np.array([until_s]), begun)
    drift = force / element.k - found["u"][0]  # the arm is back where it was
    assert drift > 1e-5
    for step_s, most in ((125e-6, 1e-3), (250e-6, 4e-3)):
        _, state = integrate(lanes, start, driven(arm, load), round(until_s / step_s), step_s)
        ours = float(start.stretch_m - state.stretch_m)
        assert abs(ours - drift) <= most * drift


def test_float32_is_enough() -> None:
    """In the relative coordinate, through many slips of a tacky surface."""
    traces = []
    for dtype in (torch.float32, torch.float64):
        lanes = SMOOTH.lanes(
            dtype,
            c=2.0,
            m=[2e-3, 5e-3, 1e-2, 5e-3],
            mu_s=[1.1, 1.1, 1.1, 0.8],
            mu_k=[0.85, 0.85, 0.85, 0.7],
            vs=[0.05, 0.05, 0.05, 0.01],
            pressure=hertz_pressure(4),
        )
        drive = driven(ramped(0.04), lambda t: 1.0)
        traces.append(integrate(lanes, LaneState.sticking(lanes), drive, 800, 250e-6)[0])
    single, double = (trace.friction_n.double() for trace in traces)
    off = (single - double).abs().amax(0) / double.amax(0)
    sticks = (traces[1].slip_m_s[400:] < 4e-3).any(0)
    assert sticks.tolist() == [True, True, True, False]
    assert (off <= 2e-4).all()
    assert off[3] <= 1e-5


def test_a_load_that_goes_and_comes() -> None:
    """Without load the patch runs free and stores nothing; with it again, it sticks and slides."""
    lanes = TACKY.lanes(m=[5e-3], k1=0.0, c=2.0, pressure=hertz_pressure(4))

    def load(t: float) -> float:
        return 0.0 if 0.1 <= t < 0.2 else 1.0

    drive = driven(ramped(0.04), load)
    trace, state = integrate(lanes, LaneState.sticking(lanes), drive, 790, 250e-6)
    assert (state.bristle_m == 0).all()
    free = slice(410, 790)
    torch.testing.assert_close(trace.slip_m_s[free], trace.speed_m_s[free])
    assert trace.friction_n[760:790].abs().max() < 0.02
    again, _ = integrate(lanes, state, drive, 800, 250e-6, start_s=790 * 250e-6)
    assert again.friction_n[400:].min() > 0.5
    assert again.friction_n.max() < 1.6
    assert all(v.isfinite().all() for t in (trace, again) for v in vars(t).values())
