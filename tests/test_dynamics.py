"""The dynamic rung's integrator against Radau, itself in pieces, and what friction should do."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from dynamics_oracle import SMOOTH, TACKY, Element, driven, ramped

from tactslip_torch import engines
from tactslip_torch.simulation.dynamics import (
    Lanes,
    LaneState,
    Trace,
    bristles,
    hertz_pressure,
    integrate,
    stepper,
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


# Against Radau -------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("step_us", "most", "late_s"), [(125, 0.004, 10e-6), (250, 0.03, 40e-6)])
def test_friction_and_breakaway_are_radaus(case: str, step_us: int, most: float, late_s: float):
    element, arm_m_s = CASES[case]
    times, found = solution(case)
    lanes, num = element.lanes(m=[element.m]), round(UNTIL_S * 1e6) // step_us
    trace, _ = integrate(
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
        trace, state = integrate(
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
        trace, _ = integrate(
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
        trace, state = integrate(lanes, state, drive, 1, step_s, start_s=number * step_s)
        arm = ramped(0.04)((number + 1) * step_s)
        v = float(state.speed_m_s)
        _, friction = element.rates(v, state.bristle_m[0].numpy(), 1.0)
        pulled = float(trace.friction_n) + element.c * (arm - v) - friction
        assert abs(float(trace.inertia_n) - pulled) < 1e-8


# Bristles ------------------------------------------------------------------------------------


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
    patch = bristles.patch_of(lanes)
    load = bristles.carried(patch, spread(-3, 3))
    bent = load * patch.mu_s / patch.stiffness * torch.tensor(rng.uniform(-1, 1, (num, 5)))
    return lanes, load, bent


def test_no_bristle_gives_back_more_than_it_holds(rng: np.random.Generator) -> None:
    lanes, load, bent = drawn_patches(rng, 500)
    patch = bristles.patch_of(lanes)
    speed = torch.tensor(10 ** rng.uniform(-7, 1, 500))
    for stage_s in (1e-7, 1e-4, 1e-2):
        at = bristles.pull(patch, load, bent, speed, stage_s)
        stored = (patch.stiffness * at.bristle * at.rate).sum(-1)
        work = at.force * speed
        scale = (patch.stiffness * at.bristle * at.rate).abs().sum(-1) + work.abs()
        assert (work - stored >= -1e-12 * scale).all()
        most = load * patch.mu_s
        assert ((patch.stiffness * at.bristle).abs() <= most * (1 + 1e-12)).all()
        torch.testing.assert_close(at.bristle, bent + stage_s * at.rate, rtol=1e-9, atol=1e-20)


def test_slope_of_the_force_is_its_derivative(rng: np.random.Generator) -> None:
    lanes, load, bent = drawn_patches(rng, 200)
    patch = bristles.patch_of(lanes)
    speed = torch.tensor(10 ** rng.uniform(-5, 0, 200), requires_grad=True)
    at = bristles.pull(patch, load, bent, speed, 1e-4)
    (slope,) = torch.autograd.grad(at.force.sum(), speed)
    scale = at.slope.abs() + (at.force / speed).abs()
    assert ((slope - at.slope).abs() <= 1e-9 * scale.detach()).all()


def test_bristles_alike_are_one() -> None:
    alone, n = TACKY.lanes(m=[5e-3]), 7
    many = TACKY.lanes(m=[5e-3], pressure=[1 / n] * n)
    drive = driven(ramped(0.04), one)
    first, end = integrate(alone, LaneState.sticking(alone), drive, 600, 250e-6)
    second, last = integrate(many, LaneState.sticking(many), drive, 600, 250e-6)
    assert_same(first, second, 1e-9)
    torch.testing.assert_close(last.bristle_m, end.bristle_m.expand(1, n))
    assert torch.equal(hertz_pressure(1), torch.ones(1, dtype=torch.float64))


@pytest.mark.parametrize("arm_m_s", [0.02, 0.06])
def test_the_edge_lets_go_before_the_whole(arm_m_s: float) -> None:
    lanes = replace(SMOOTH, sigma=3e3, d0=1.0).lanes(m=[5e-3], pressure=hertz_pressure(32))
    trace, _ = integrate(
        lanes, LaneState.sticking(lanes), driven(ramped(arm_m_s), one), 800, 250e-6
    )
    sliding = trace.slip_m_s[:, 0] > arm_m_s / 2
    incipient, gross = (int(flags.int().argmax()) for flags in (trace.incipient[:, 0], sliding))
    assert 0 < incipient * 1.1 < gross
    assert trace.incipient[:, 0][sliding].all()
    held = trace.friction_n[incipient, 0], trace.friction_n[:gross, 0].max()
    assert held[0] < 0.9 * held[1]


def hertz_by_hand(n: int) -> np.ndarray:
    place = np.linspace(-1 + 1 / n, 1 - 1 / n, n)
    return np.sqrt(1 - place**2) / np.sqrt(1 - place**2).sum()


@pytest.mark.parametrize("n", [1, 2, 5, 64])
def test_hertz_pressure(n: int) -> None:
    np.testing.assert_allclose(hertz_pressure(n), hertz_by_hand(n), rtol=1e-12)
    assert hertz_pressure(n, dtype=torch.float32).dtype == torch.float32


# Stick-slip ----------------------------------------------------------------------------------


@pytest.mark.parametrize("arm_m_s", [0.02, 0.04, 0.06])
def test_stick_slip_is_the_tacky_materials(arm_m_s: float) -> None:
    masses = [2e-3, 5e-3, 1e-2]
    swing = []
    for element in (SMOOTH, TACKY):
        lanes = replace(element, c=2.0).lanes(m=masses)
        start = LaneState.sticking(lanes)
        trace, _ = integrate(lanes, start, driven(ramped(arm_m_s), one), 4000, 250e-6)
        late = trace.friction_n[2000:]
        swing.append((late.amax(0) - late.amin(0)) / late.mean(0))
        sticks = (trace.slip_m_s[2000:] < 0.1 * arm_m_s).any(0)
        assert (sticks == (element is TACKY)).all()
    smooth, tacky = swing
    assert (smooth < 1e-3).all()
    assert ((tacky > 0.1) & (tacky < 0.7)).all()


# Engines, pieces, shapes ---------------------------------------------------------------------


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
    eager, end = integrate(lanes, start, shaken, 600, 250e-6, engine="eager")
    compiled, last = integrate(lanes, start, shaken, 600, 250e-6, engine="compiled")
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

    below, _ = integrate(lanes, start, lambda t: pulled(t, -1.0), 300, 250e-6, engine=engine)
    none, _ = integrate(lanes, start, lambda t: pulled(t, 0.0), 300, 250e-6, engine=engine)
    assert_same(none, below)


def test_pieces_make_the_whole(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lanes = varied(4)
    start = LaneState.sticking(lanes)
    whole, end = integrate(lanes, start, shaken, 120, 2.0**-12, engine=engine)
    third, same = integrate(lanes, start, shaken, 120, 2.0**-12, every=3, engine=engine)
    assert_same(Trace(*(values[2::3] for values in vars(whole).values())), third)
    state, parts = start, []
    for number in (0, 48, 60):
        num = 48 if number == 0 else 12 if number == 48 else 60
        part, state = integrate(
            lanes, state, shaken, num, 2.0**-12, start_s=number * 2.0**-12, engine=engine
        )
        parts.append(vars(part).values())
    assert_same(whole, Trace(*map(torch.cat, zip(*parts, strict=True))))
    monkeypatch.setattr(stepper, "_DRIVEN_AT_ONCE", 12 * 7)  # 7 steps at a time
    asked, _ = integrate(lanes, start, shaken, 120, 2.0**-12, every=3, engine=engine)
    assert_same(third, asked)
    for other in (same, state):
        for mine, its in zip(vars(end).values(), vars(other).values(), strict=True):
            assert torch.equal(mine, its)


def test_no_bit_depends_on_a_neighbour() -> None:
    """Compiled, a lane's bytes are the same in any order, company and block."""
    pytest.importorskip("numba")
    masses, loads = torch.linspace(0.0, 1e-2, 37), torch.linspace(0.0, 2.0, 37)

    def friction(order: torch.Tensor) -> torch.Tensor:
        lanes = TACKY.lanes(m=masses[order], pressure=hertz_pressure(3))
        load = loads[order].double()
        trace, _ = integrate(
            lanes,
            LaneState.sticking(lanes),
            lambda t: (0.05 * torch.sin(70.0 * t)[:, None], load.expand(len(t), -1)),
            400,
            250e-6,
            engine="compiled",
        )
        return trace.friction_n

    together, order = friction(torch.arange(37)), torch.arange(36, -1, -1)
    assert torch.equal(friction(order), together[:, order])
    assert torch.equal(friction(order[:5]), together[:, order[:5]])


def test_each_lane_is_alone(engine: str) -> None:
    lanes = varied(4)
    trace, _ = integrate(lanes, LaneState.sticking(lanes), shaken, 60, 250e-6, engine=engine)
    tensors = {name: values for name, values in vars(lanes).items() if name != "pressure"}
    for row in range(2):
        for column in range(3):
            single = {
                name: values.expand(2, 3)[row, column] if values.dim() else values
                for name, values in tensors.items()
            }
            lane = Lanes(**single, pressure=lanes.pressure)

            def drive(times: torch.Tensor, at: tuple[int, int] = (row, column)):
                return tuple(values.expand(-1, 2, 3)[:, *at] for values in shaken(times))

            alone, _ = integrate(lane, LaneState.sticking(lane), drive, 60, 250e-6, engine=engine)
            picked = Trace(*(values[:, row, column] for values in vars(trace).values()))
            assert_same(picked, alone, 1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_manners(dtype: torch.dtype, engine: str) -> None:
    if (dtype, engine) == (torch.float32, "compiled"):
        pytest.skip("for float64 alone")
    lanes = varied(3, dtype)
    start = LaneState.sticking(lanes)
    strided = LaneState(*(torch.stack([v, v], -1)[..., 0] for v in vars(start).values()))
    kept = [values.clone() for values in (*vars(lanes).values(), *vars(start).values())]
    first, state = integrate(lanes, start, shaken, 20, 250e-6, engine=engine)
    second, _ = integrate(lanes, strided, shaken, 20, 250e-6, engine=engine)
    assert_same(first, second)
    tensors = (*vars(lanes).values(), *vars(start).values())
    assert all(torch.equal(values, old) for values, old in zip(tensors, kept, strict=True))
    assert first.friction_n.dtype == state.bristle_m.dtype == dtype
    assert first.friction_n.shape == (20, 2, 3)
    assert state.bristle_m.shape == (2, 3, 3)
    nothing, same = integrate(lanes, start, shaken, 0, 250e-6, engine=engine)
    assert nothing.slip_m_s.shape == (0, 2, 3)
    assert same is start


def test_on_any_device(device: torch.device) -> None:
    lanes = varied(3)
    there = Lanes(*(values.to(device) for values in vars(lanes).values()))
    start = LaneState.sticking(there, 0.1, 0.5)

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        assert times.device == start.stretch_m.device
        arm, load = shaken(times.cpu())
        return arm.to(device), load.to(device)

    trace, state = integrate(there, start, drive, 60, 250e-6, engine="eager")
    here = LaneState.sticking(lanes, 0.1, 0.5)
    same, _ = integrate(lanes, here, shaken, 60, 250e-6, engine="eager")
    assert state.bristle_m.device == start.stretch_m.device
    assert_same(same, Trace(*(values.cpu() for values in vars(trace).values())), 1e-9)


def test_auto_takes_what_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    from tactslip_torch.simulation.dynamics import packing

    taken = []
    carry = packing.carry
    monkeypatch.setattr(packing, "carry", lambda *a: taken.append(1) or carry(*a))
    lanes = varied()
    integrate(lanes, LaneState.sticking(lanes), shaken, 2, 250e-6)
    assert taken
    taken.clear()
    single = varied(dtype=torch.float32)
    integrate(single, LaneState.sticking(single), shaken, 2, 250e-6)
    load = torch.ones((), dtype=torch.float64, requires_grad=True)
    lane = TACKY.lanes()
    trace, _ = integrate(
        lane,
        LaneState.sticking(lane, 0.5),
        lambda t: (0.02 + 0.0 * t, load.expand(len(t))),
        9,
        1e-3,
    )
    assert not taken
    assert trace.friction_n.requires_grad
    with pytest.raises(ValueError, match=r'"compiled" needs float64 on the CPU, got torch.float32'):
        integrate(single, LaneState.sticking(single), shaken, 2, 250e-6, engine="compiled")
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    integrate(lanes, LaneState.sticking(lanes), shaken, 2, 250e-6)
    assert not taken
    with pytest.raises(ValueError, match='"compiled" needs numba, which is not installed'):
        integrate(lanes, LaneState.sticking(lanes), shaken, 2, 250e-6, engine="compiled")


def test_gradients_are_those_of_the_scheme() -> None:
    def last(mu_s: torch.Tensor, k: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
        element = Element(vs=0.05)
        tensors = vars(element.lanes()) | {"mu_s": mu_s, "stiffness_n_m": k}
        lanes = Lanes(**tensors)
        trace, state = integrate(
            lanes,
            LaneState.sticking(lanes, 0.6),
            lambda t: (0.04 + 0.0 * t, load.expand(len(t))),
            12,
            1e-3,
        )
        return torch.stack([trace.friction_n[-1], trace.slip_m_s[-1] * 10, state.speed_m_s * 10])

    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.8, 1e3, 1.0)]
    assert torch.autograd.gradcheck(last, values, eps=1e-6, rtol=1e-4, atol=1e-7)


# What is refused -----------------------------------------------------------------------------


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
        ({"m": [1.0] * 2, "k": [1.0] * 3}, r"expected shapes that broadcast, got mass_kg \(2,\)"),
    ],
)
def test_lanes_that_cannot_be(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        SMOOTH.lanes(**values)
    assert "\n" not in str(caught.value)


def test_lanes_of_other_kinds_are_refused() -> None:
    tensors = vars(SMOOTH.lanes())
    with pytest.raises(ValueError, match=r"expected mass_kg as a tensor of floats, got float"):
        Lanes(**tensors | {"mass_kg": 1e-3})
    with pytest.raises(ValueError, match=r"expected mu_k as a tensor of floats, got torch.int64"):
        Lanes(**tensors | {"mu_k": torch.tensor(1)})
    with pytest.raises(ValueError, match=r"of one kind on one device, got mu_s as torch.float3"):
        Lanes(**tensors | {"mu_s": tensors["mu_s"].float()})
    assert torch.isinf(SMOOTH.lanes(tau=math.inf).relaxation_time_s)
    with pytest.raises(ValueError, match="expected one bristle or more, got 0"):
        hertz_pressure(0)
    with pytest.raises(ValueError, match=r"relaxing_share within 0 to 1, got 1.5 to 1.5"):
        LaneState.sticking(SMOOTH.lanes(), 0.1, 1.5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"num_steps": 7, "every": 2}, "num_steps as a multiple of every, got 7 and 2"),
        ({"every": 0}, "num_steps as a multiple of every, got 4 and 0"),
        ({"step_s": 0.0}, "expected step_s positive and finite, got 0"),
        ({"engine": "fast"}, "engine must be one of auto, compiled, eager, got 'fast'"),
        ({"state": LaneState(*[torch.zeros(2)] * 4)}, r"a state of lanes \(3,\) with 1 bristles"),
        (
            {"drive": lambda t: (torch.ones(2), torch.ones(2))},
            r"drive to return tensors that expand to \(8, 3\) for 8 times, got \(2,\)",
        ),
    ],
)
def test_requests_that_cannot_be(values: dict[str, object], message: str) -> None:
    lanes = SMOOTH.lanes(m=[1e-3] * 3)
    whole = {
        "state": LaneState.sticking(lanes),
        "drive": driven(ramped(0.02), one),
        "num_steps": 4,
        "step_s": 1e-4,
    }
    with pytest.raises(ValueError, match=message):
        integrate(lanes, **whole | values)


def test_sticking_is_where_nothing_moves(engine: str) -> None:
    lanes = varied(5)
    force = torch.tensor([[0.3, 0.0, -0.3], [0.1, 0.2, -0.05]], dtype=torch.float64)
    start = LaneState.sticking(lanes, force, 0.25)
    torch.testing.assert_close(lanes.stiffness_n_m * start.stretch_m + start.relaxing_n, force)
    still = torch.zeros(1, 1, 1, dtype=torch.float64)
    trace, _ = integrate(
        replace(lanes, relaxing_n_m=torch.zeros_like(lanes.relaxing_n_m)),
        LaneState.sticking(lanes, force),
        lambda t: (still, still + 1.0),
        40,
        250e-6,
        engine=engine,
    )
    torch.testing.assert_close(trace.friction_n, force.expand(40, 2, 3), rtol=1e-12, atol=1e-15)
    assert not trace.incipient.any()
