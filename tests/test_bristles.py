"""Skin and bristles against Radau and in themselves, up to where a scheme breaks."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np
import pytest
import torch
from dynamics_oracle import SMOOTH, TACKY, Drive, Element, carry, driven, ramped

from tactslip_torch import runtime as engines
from tactslip_torch.simulation import bristles
from tactslip_torch.simulation._bristles import (
    EngineName,
    Lanes,
    LaneState,
    Trace,
    hertz_pressure,
    integrate,
)

FINE_S = 50e-6

UNTIL_S = 0.08

CASES = {
    "smooth 20 mm/s": (SMOOTH, 0.02),
    "smooth 60 mm/s": (SMOOTH, 0.06),
    "tacky 40 mm/s": (TACKY, 0.04),
    "patch 20 mm/s": (replace(TACKY, pressure=tuple(hertz_pressure(6).tolist())), 0.02),
}

ENGINES = ("eager", "compiled")


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    if request.param == "compiled":
        pytest.importorskip("numba")
    return request.param


def one(time_s: float) -> float:
    return 1.0


@lru_cache
def solution(case: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    element, arm_m_s = CASES[case]
    times = np.arange(1, round(UNTIL_S / FINE_S) + 1) * FINE_S
    return times, element.radau(ramped(arm_m_s), one, times)


def crossing_s(times: np.ndarray, speed: np.ndarray, level: float) -> float:
    after = int(np.argmax(speed > level))
    part = (level - speed[after - 1]) / (speed[after] - speed[after - 1])
    return times[after - 1] + part * (times[after] - times[after - 1])


def assert_same(one: Trace, other: Trace, tolerance: float = 0.0) -> None:
    for name, values in vars(one).items():
        scale = 1.0 if name == "incipient" else float(values.abs().max())
        difference = (values.double() - vars(other)[name].double()).abs()
        assert values.shape == vars(other)[name].shape, name
        assert difference.max() <= tolerance * scale, name


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("step_us", "most", "late_s"), [(125, 0.004, 10e-6), (250, 0.03, 40e-6)])
def test_friction_and_breakaway_are_radaus(case: str, step_us: int, most: float, late_s: float):
    element, arm_m_s = CASES[case]
    times, found = solution(case)
    lanes, num = element.lanes(m=[element.m]), round(UNTIL_S * 1e6) // step_us
    trace, _ = carry(
        lanes, LaneState.sticking(lanes), driven(ramped(arm_m_s), one), num, step_us * 1e-6
    )
    ours = np.arange(1, num + 1) * step_us * 1e-6
    friction = trace.friction_n[:, 0].numpy()
    peak = found["friction"].max()
    assert np.abs(friction - np.interp(ours, times, found["friction"])).max() <= most * peak
    let_go = crossing_s(ours, trace.speed_m_s[:, 0].numpy(), arm_m_s / 2)
    assert abs(let_go - crossing_s(times, found["v"], arm_m_s / 2)) <= late_s


def test_state_and_slip_are_radaus() -> None:
    element, arm_m_s = CASES["patch 20 mm/s"]
    _, found = solution("patch 20 mm/s")
    lanes, step_s = element.lanes(m=[element.m]), 62.5e-6
    drive = driven(ramped(arm_m_s), one)
    for until_s in (0.03, 0.06):  # sticking, and in the first slip
        trace, state = carry(
            lanes, LaneState.sticking(lanes), drive, round(until_s / step_s), step_s
        )
        at = round(until_s / FINE_S) - 1
        u, v, q, z = (found[name][..., at] for name in "uvqz")
        z_rate, _ = element.rates(v, z, 1.0)
        torch.testing.assert_close(
            torch.cat([state.stretch_m, state.relaxing_n, state.bristle_m[0]]).numpy(),
            np.r_[u, q, z],
            rtol=3e-3,
            atol=1e-9,
        )
        slip = v - np.dot(element.pressure, z_rate)
        np.testing.assert_allclose(trace.slip_m_s[-1, 0], slip, rtol=0.02, atol=1e-6)
        v_rate = (element.k * u + q + element.c * (arm_m_s - v) - element.rates(v, z, 1.0)[1]) / (
            element.m
        )
        np.testing.assert_allclose(trace.inertia_n[-1, 0], element.m * v_rate, atol=5e-3)


def test_order_is_two_where_nothing_lets_go() -> None:
    def arm(t: float) -> float:
        return 0.06 + 0.01 * math.sin(60.0 * t)

    def load(t: float) -> float:
        return 1.0 + 0.3 * math.sin(90.0 * t)

    element = replace(SMOOTH, sigma2=0.5)
    times = np.arange(1, 11) * 0.02
    found = element.radau(arm, load, times)
    lanes, errors = element.lanes(m=[element.m]), []
    for step_s in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        every = round(0.02 / step_s)
        trace, _ = carry(
            lanes, LaneState.sticking(lanes), driven(arm, load), 10 * every, step_s, every
        )
        errors.append(np.abs(trace.friction_n[:, 0].numpy() - found["friction"])[5:].max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 1.8) & (orders < 2.3)).all(), orders


def test_balance_of_forces_holds_in_the_trace() -> None:
    element = replace(TACKY, sigma2=0.7, pressure=tuple(hertz_pressure(3).tolist()))
    lanes, step_s = element.lanes(m=[element.m]), 250e-6
    state, drive = LaneState.sticking(lanes), driven(ramped(0.04), one)
    for number in range(400):
        trace, state = carry(lanes, state, drive, 1, step_s, first_step=number)
        arm = ramped(0.04)((number + 1) * step_s)
        v = float(state.speed_m_s)
        _, friction = element.rates(v, state.bristle_m[0].numpy(), 1.0)
        pulled = float(trace.friction_n) + element.c * (arm - v) - friction
        assert abs(float(trace.inertia_n) - pulled) < 1e-8


def drawn_patches(rng: np.random.Generator, num: int) -> tuple[Lanes, torch.Tensor, torch.Tensor]:
    def spread(low: float, high: float) -> torch.Tensor:
        return torch.tensor(10 ** rng.uniform(low, high, num))

    mu_s = spread(-1, 1)
    lanes = SMOOTH.lanes(
        mu_s=mu_s,
        mu_k=mu_s * torch.tensor(rng.uniform(0.05, 1.0, num)),
        vs=spread(-3, 0),
        sigma=spread(2, 8),
        d0=spread(-2, 6),
        pressure=hertz_pressure(5),
    )
    stage = bristles._Stage(lanes, 1e-4)
    load = stage.carried(spread(-3, 3))
    bent = load * stage.mu_s / stage.stiffness * torch.tensor(rng.uniform(-1, 1, (num, 5)))
    return lanes, load, bent


def test_no_bristle_gives_back_more_than_it_holds(rng: np.random.Generator) -> None:
    lanes, load, bent = drawn_patches(rng, 500)
    speed = torch.tensor(10 ** rng.uniform(-7, 1, 500))
    for stage_s in (1e-7, 1e-4, 1e-2):
        patch = bristles._Stage(lanes, stage_s)
        at = patch.pull(load, bent, speed)
        stored = (patch.stiffness * at.bristle * at.rate).sum(-1)
        work = at.force * speed
        scale = (patch.stiffness * at.bristle * at.rate).abs().sum(-1) + work.abs()
        assert (work - stored >= -1e-12 * scale).all()
        most = load * patch.mu_s
        assert ((patch.stiffness * at.bristle).abs() <= most * (1 + 1e-12)).all()
        torch.testing.assert_close(at.bristle, bent + stage_s * at.rate, rtol=1e-9, atol=1e-20)


def test_slope_of_the_force_is_its_derivative(rng: np.random.Generator) -> None:
    lanes, load, bent = drawn_patches(rng, 200)
    speed = torch.tensor(10 ** rng.uniform(-5, 0, 200), requires_grad=True)
    at = bristles._Stage(lanes, 1e-4).pull(load, bent, speed)
    (slope,) = torch.autograd.grad(at.force.sum(), speed)
    scale = at.slope.abs() + (at.force / speed).abs()
    assert ((slope - at.slope).abs() <= 1e-9 * scale.detach()).all()


@pytest.mark.parametrize("arm_m_s", [0.02, 0.06])
def test_the_edge_lets_go_before_the_whole(arm_m_s: float) -> None:
    lanes = replace(SMOOTH, sigma=3e3, d0=1.0).lanes(m=[5e-3], pressure=hertz_pressure(32))
    trace, _ = carry(lanes, LaneState.sticking(lanes), driven(ramped(arm_m_s), one), 800, 250e-6)
    sliding = trace.slip_m_s[:, 0] > arm_m_s / 2
    incipient, gross = (int(flags.int().argmax()) for flags in (trace.incipient[:, 0], sliding))
    assert 0 < incipient * 1.1 < gross
    assert trace.incipient[:, 0][sliding].all()
    held = trace.friction_n[incipient, 0], trace.friction_n[:gross, 0].max()
    assert held[0] < 0.9 * held[1]


@pytest.mark.parametrize("n", [1, 2, 5, 64])
def test_hertz_pressure(n: int) -> None:
    place = np.linspace(-1 + 1 / n, 1 - 1 / n, n)
    wanted = np.sqrt(1 - place**2) / np.sqrt(1 - place**2).sum()
    np.testing.assert_allclose(hertz_pressure(n), wanted, rtol=1e-12)
    assert hertz_pressure(n, dtype=torch.float32).dtype == torch.float32


@pytest.mark.parametrize("arm_m_s", [0.02, 0.04, 0.06])
def test_stick_slip_is_the_tacky_materials(arm_m_s: float) -> None:
    masses = [2e-3, 5e-3, 1e-2]
    swing = []
    for element in (SMOOTH, TACKY):
        lanes = replace(element, c=2.0).lanes(m=masses)
        start = LaneState.sticking(lanes)
        trace, _ = carry(lanes, start, driven(ramped(arm_m_s), one), 4000, 250e-6)
        late = trace.friction_n[2000:]
        swing.append((late.amax(0) - late.amin(0)) / late.mean(0))
        sticks = (trace.slip_m_s[2000:] < 0.1 * arm_m_s).any(0)
        assert (sticks == (element is TACKY)).all()
    smooth, tacky = swing
    assert (smooth < 1e-3).all()
    assert ((tacky > 0.1) & (tacky < 0.7)).all()


def varied(n: int = 1, dtype: torch.dtype = torch.float64) -> Lanes:
    """Lanes of two sides, among them one without mass."""
    return TACKY.lanes(
        dtype=dtype,
        m=[[5e-3, 0.0, 1e-2], [2e-3, 1e-4, 5e-3]],
        mu_s=[[1.1], [0.9]],
        vs=[0.05, 0.01, 0.02],
        sigma=[[1e5, 1e4, 1e6]],
        sigma2=0.2,
        pressure=hertz_pressure(n),
    )


def shaken(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Back and forth under a load that goes away and comes back, other ones for each lane."""
    t = times[:, None, None]
    arm = torch.tensor([[0.05, 0.06, 0.04], [0.02, 0.05, 0.07]]) * torch.sin(70.0 * t)
    load = torch.tensor([[1.0, 0.5, 2.0], [1.5, 1.0, 0.1]]) * (0.7 + torch.sin(90.0 * t)).clamp(0)
    return arm, load


@pytest.mark.parametrize("n", [1, 16])
def test_engines_agree(n: int) -> None:
    pytest.importorskip("numba")
    lanes = varied(n)
    start = LaneState.sticking(lanes, 0.2, 0.3)
    eager, end = carry(lanes, start, shaken, 600, 250e-6, engine="eager")
    compiled, last = carry(lanes, start, shaken, 600, 250e-6, engine="compiled")
    assert_same(eager, compiled, 1e-9)
    assert eager.incipient.any()
    assert not eager.incipient.all()
    for mine, other in zip(vars(end).values(), vars(last).values(), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-15)


def test_a_load_below_nothing_is_none(engine: str) -> None:
    lanes = varied(2)
    start = LaneState.sticking(lanes)

    def pulled(times: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
        arm, _ = shaken(times)
        return arm, torch.sin(90.0 * times)[:, None, None].clamp(least)

    below, _ = carry(lanes, start, lambda t: pulled(t, -1.0), 300, 250e-6, engine=engine)
    none, _ = carry(lanes, start, lambda t: pulled(t, 0.0), 300, 250e-6, engine=engine)
    assert_same(none, below)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_manners(dtype: torch.dtype, engine: str) -> None:
    if (dtype, engine) == (torch.float32, "compiled"):
        pytest.skip("for float64 alone")
    lanes = varied(3, dtype)
    start = LaneState.sticking(lanes)
    strided = LaneState(*(torch.stack([v, v], -1)[..., 0] for v in vars(start).values()))
    kept = [values.clone() for values in (*vars(lanes).values(), *vars(start).values())]
    first, state = carry(lanes, start, shaken, 20, 250e-6, engine=engine)
    second, _ = carry(lanes, strided, shaken, 20, 250e-6, engine=engine)
    assert_same(first, second)
    tensors = (*vars(lanes).values(), *vars(start).values())
    assert all(torch.equal(values, old) for values, old in zip(tensors, kept, strict=True))
    assert first.friction_n.dtype == state.bristle_m.dtype == dtype
    assert first.friction_n.shape == (20, 2, 3)
    assert state.bristle_m.shape == (2, 3, 3)
    nothing, same = carry(lanes, start, shaken, 0, 250e-6, engine=engine)
    assert nothing.slip_m_s.shape == (0, 2, 3)
    assert torch.equal(same.bristle_m, start.bristle_m)


def test_on_any_device(device: torch.device) -> None:
    lanes = varied(3)
    there = Lanes(*(values.to(device) for values in vars(lanes).values()))
    start = LaneState.sticking(there, 0.1, 0.5)

    trace, state = carry(there, start, shaken, 60, 250e-6, engine="eager")
    here = LaneState.sticking(lanes, 0.1, 0.5)
    same, _ = carry(lanes, here, shaken, 60, 250e-6, engine="eager")
    assert state.bristle_m.device == start.stretch_m.device
    assert_same(same, Trace(*(values.cpu() for values in vars(trace).values())), 1e-9)


def test_auto_takes_what_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    taken, compiled = [], bristles._carry_compiled
    monkeypatch.setattr(bristles, "_carry_compiled", lambda *a: taken.append(1) or compiled(*a))
    lanes = varied()
    carry(lanes, LaneState.sticking(lanes), shaken, 2, 250e-6)
    assert taken
    taken.clear()
    single = varied(dtype=torch.float32)
    carry(single, LaneState.sticking(single), shaken, 2, 250e-6)
    load = torch.ones((), dtype=torch.float64, requires_grad=True)
    lane = TACKY.lanes()
    trace, _ = carry(
        lane,
        LaneState.sticking(lane, 0.5),
        lambda t: (0.02 + 0.0 * t, load.expand(len(t))),
        9,
        1e-3,
    )
    assert not taken
    assert trace.friction_n.requires_grad
    with pytest.raises(ValueError, match=r'"compiled" needs float64 on the CPU, got torch.float32'):
        carry(single, LaneState.sticking(single), shaken, 2, 250e-6, engine="compiled")
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    carry(lanes, LaneState.sticking(lanes), shaken, 2, 250e-6)
    assert not taken
    with pytest.raises(ValueError, match='"compiled" needs numba, which is not installed'):
        carry(lanes, LaneState.sticking(lanes), shaken, 2, 250e-6, engine="compiled")


def test_gradients_are_those_of_the_scheme() -> None:
    def last(mu_s: torch.Tensor, k: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
        element = Element(vs=0.05)
        tensors = vars(element.lanes()) | {"mu_s": mu_s, "stiffness_n_m": k}
        lanes = Lanes(**tensors)
        trace, state = carry(
            lanes,
            LaneState.sticking(lanes, 0.6),
            lambda t: (0.04 + 0.0 * t, load.expand(len(t))),
            12,
            1e-3,
        )
        return torch.stack([trace.friction_n[-1], trace.slip_m_s[-1] * 10, state.speed_m_s * 10])

    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.8, 1e3, 1.0)]
    assert torch.autograd.gradcheck(last, values, eps=1e-6, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mu_k": 0.9}, "expected mu_k <= mu_s, got mu_k up to 0.9 over mu_s down to 0.8"),
        ({"mu_s": -0.5}, "expected mu_s finite and positive, got -0.5"),
        ({"m": [1e-3, -1e-3]}, "expected mass_kg finite and not negative, got -0.001"),
        ({"tau": 0.0}, "expected relaxation_time_s finite and positive, got 0"),
        ({"k": math.nan}, "expected stiffness_n_m finite and positive, got nan"),
        ({"sigma": math.inf}, "expected bristle_stiffness_n_m finite and positive, got inf"),
        ({"pressure": [0.5, 0.4]}, r"expected pressure \[n\] that sums to 1, got \(2,\) with sum"),
        ({"pressure": [[1.0]]}, r"expected pressure \[n\] that sums to 1"),
    ],
)
def test_lanes_that_cannot_be(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        SMOOTH.lanes(**values)
    assert "\n" not in str(caught.value)


def test_sticking_is_where_nothing_moves(engine: str) -> None:
    lanes = varied(5)
    force = torch.tensor([[0.3, 0.0, -0.3], [0.1, 0.2, -0.05]], dtype=torch.float64)
    start = LaneState.sticking(lanes, force, 0.25)
    torch.testing.assert_close(lanes.stiffness_n_m * start.stretch_m + start.relaxing_n, force)
    still = torch.zeros(1, 1, 1, dtype=torch.float64)
    trace, _ = carry(
        replace(lanes, relaxing_n_m=torch.zeros_like(lanes.relaxing_n_m)),
        LaneState.sticking(lanes, force),
        lambda t: (still.expand(len(t), 1, 1), (still + 1.0).expand(len(t), 1, 1)),
        40,
        250e-6,
        engine=engine,
    )
    torch.testing.assert_close(trace.friction_n, force.expand(40, 2, 3), rtol=1e-12, atol=1e-15)
    assert not trace.incipient.any()


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
        trace, state = carry(lanes, state, drive, 1, step_s, first_step=number, engine=engine)
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
    root, eps, num, solved = bristles._Stage.root, torch.finfo(torch.float64).eps, 24, []

    def watched(stage, load, base, offset, guess, high):  # type: ignore[no-untyped-def]
        speed = root(stage, load, base, offset, guess, high)
        left, _, at = stage.left(load, base, offset, speed)
        below, above = (
            stage.left(load, base, offset, speed * (1.0 + side * eps**0.5))[0] for side in (-2, 2)
        )
        scale = stage.inertia * speed + offset.abs() + stage.stage_s * at.force.abs()
        solved.append((left.abs() <= 16.0 * eps * scale) | (below <= 0) & (above >= 0))
        return speed

    monkeypatch.setattr(bristles._Stage, "root", watched)
    lanes, speed, load = extreme(4, torch.float64)
    state = LaneState.sticking(lanes, 0.5 * lanes.mu_k * load, 0.2)
    carry(lanes, state, turning(speed, load, num * step_s), num, step_s, engine="eager")
    assert len(solved) == 2 * num
    assert torch.stack(solved).all()


@pytest.mark.parametrize("step_s", [1e-6, 250e-6, 5e-3])
def test_engines_agree_where_it_is_extreme(step_s: float) -> None:
    pytest.importorskip("numba")
    lanes, speed, load = extreme(2, torch.float64)
    start = LaneState.sticking(lanes, 0.5 * lanes.mu_k * load, 0.2)
    drive = turning(speed, load, 4 * step_s)
    (one, _), (other, _) = (
        carry(lanes, start, drive, 4, step_s, engine=engine) for engine in ENGINES
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
    trace, _ = carry(lanes, start, drive, 3, 250e-6, engine=needing(engine))
    assert not trace.friction_n.isfinite().any()


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
        _, state = carry(lanes, start, driven(arm, load), round(until_s / step_s), step_s)
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
        traces.append(carry(lanes, LaneState.sticking(lanes), drive, 800, 250e-6)[0])
    single, double = (trace.friction_n.double() for trace in traces)
    off = (single - double).abs().amax(0) / double.amax(0)
    sticks = (traces[1].slip_m_s[400:] < 4e-3).any(0)
    assert sticks.tolist() == [True, True, True, False]
    assert (off <= 2e-4).all()
    assert off[3] <= 1e-5


def test_pieces_make_the_whole(engine: str) -> None:
    lanes, step_s = varied(4), 2.0**-12
    start = LaneState.sticking(lanes)
    whole, end = carry(lanes, start, shaken, 120, step_s, engine=engine)
    third, same = carry(lanes, start, shaken, 120, step_s, every=3, engine=engine)
    assert_same(Trace(*(values[2::3] for values in vars(whole).values())), third)
    state, pieces = start, []
    for first, num in ((0, 48), (48, 12), (60, 60)):
        piece, state = carry(lanes, state, shaken, num, step_s, first_step=first, engine=engine)
        pieces.append(vars(piece).values())
    assert_same(whole, Trace(*map(torch.cat, zip(*pieces, strict=True))))
    for other in (same, state):
        for mine, its in zip(vars(end).values(), vars(other).values(), strict=True):
            assert torch.equal(mine, its)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"every": 3}, "num_steps as a multiple of every, got 8 stages and 3"),
        ({"every": 0}, "num_steps as a multiple of every, got 8 stages and 0"),
        ({"step_s": 0.0}, "expected step_s positive and finite, got 0"),
        ({"engine": "fast"}, "engine must be one of auto, compiled, eager, got 'fast'"),
        ({"state": LaneState(*[torch.zeros(2)] * 4)}, r"a state of lanes \(3,\) with 1 bristles"),
        ({"load_n": torch.ones(8, 2)}, r"that expand to \(8, 3\), got \(8, 1\) and \(8, 2\)"),
    ],
)
def test_requests_that_cannot_be(values: dict[str, object], message: str) -> None:
    lanes = SMOOTH.lanes(m=[1e-3] * 3)
    whole = {
        "state": LaneState.sticking(lanes),
        "arm_m_s": torch.full((8, 1), 0.02),
        "load_n": torch.ones(8, 1),
        "step_s": 1e-4,
    }
    with pytest.raises(ValueError, match=message):
        integrate(lanes, **whole | values)
