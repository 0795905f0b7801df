"""Skin and bristles against Radau and in themselves, up to where a scheme breaks."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tactslip_torch import native
from tactslip_torch.simulation import _bristles
from tactslip_torch.simulation._bristles import (
    Lanes,
    LaneState,
    Trace,
    hertz_pressure,
    integrate,
    stage_times_s,
)

NO_ENGINE = native.reason_unavailable()
needs_engine = pytest.mark.skipif(bool(NO_ENGINE), reason=NO_ENGINE)
BACKENDS = ("torch", "native")
NATIVE = pytest.param("native", marks=needs_engine)
each_backend = pytest.mark.parametrize("backend", ["torch", NATIVE])
Course = Callable[[float], float]


@dataclass(frozen=True)
class Element:
    """Skin on a smooth surface, and its equations in plain NumPy; SI units."""

    m: float = 5e-3
    k: float = 1e3
    k1: float = 200.0
    tau: float = 0.5
    c: float = 1.0
    mu_s: float = 0.8
    mu_k: float = 0.7
    vs: float = 0.01
    sigma: float = 1e5
    d0: float = (1e5 * 5e-3) ** 0.5
    sigma2: float = 0.0
    pressure: tuple[float, ...] = (1.0,)

    def lanes(self, dtype: torch.dtype = torch.float64, **other: object) -> Lanes:
        """As one lane ``[1]``, or as many as the values in ``other`` have."""
        values = vars(self) | {"m": [self.m]} | other  # in the order of Lanes
        return Lanes(*(torch.as_tensor(value, dtype=dtype) for value in values.values()))

    def rates(self, v: float, z: np.ndarray, load: float) -> tuple[np.ndarray, float]:
        """How fast bristles bend, and with what force they pull."""
        w = np.array(self.pressure)
        s, d0 = self.sigma / len(w), self.d0 / len(w)
        mu = self.mu_k + (self.mu_s - self.mu_k) * np.exp(-((v / self.vs) ** 2))
        z_rate = v - s * abs(v) * z / (w * load * mu)
        d = d0 / (1.0 + d0 * abs(v) / (w * self.mu_k * load))
        return z_rate, float((s * z + d * z_rate).sum() + self.sigma2 * v)

    def radau(self, arm: Course, load: Course, times_s: np.ndarray) -> dict[str, np.ndarray]:
        """SciPy's solution at some times, from rest."""

        def right(t: float, y: np.ndarray) -> np.ndarray:
            (u, v, q), w = y[:3], arm(t)
            z_rate, pull = self.rates(v, y[3:], load(t))
            v_rate = (self.k * u + q + self.c * (w - v) - pull) / self.m
            return np.r_[w - v, v_rate, self.k1 * (w - v) - q / self.tau, z_rate]

        start = np.zeros(3 + len(self.pressure))
        options = {"method": "Radau", "rtol": 1e-8, "atol": 1e-12, "max_step": 1e-3}
        found = solve_ivp(right, (0.0, times_s[-1]), start, t_eval=times_s, **options)
        assert found.success
        u, v, q = found.y[:3]
        z, loads = found.y[3:], map(load, times_s)
        z_rates = [self.rates(a, b, c)[0] for a, b, c in zip(v, z.T, loads, strict=True)]
        slip = v - np.array(z_rates) @ np.array(self.pressure)
        return {"u": u, "v": v, "q": q, "z": z, "friction": self.k * u + q, "slip": slip}


SMOOTH = Element()
TACKY = replace(SMOOTH, mu_s=1.1, mu_k=0.85, vs=0.05)
PATCH = replace(TACKY, pressure=tuple(hertz_pressure(6).tolist()))


def ramped(arm_m_s: float) -> Course:
    """An arm that starts at 2 ms and is at speed at 22 ms."""
    return lambda t: arm_m_s * min(max((t - 0.002) / 0.02, 0.0), 1.0)


def one(time_s: float) -> float:
    return 1.0


def driven(arm: Course, load: Course = one) -> Callable[[torch.Tensor], tuple[torch.Tensor, ...]]:
    """The same drive for lanes ``[L]``, all alike: arm and load from times."""

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, ...]:
        values = torch.tensor([[arm(t), load(t)] for t in times.tolist()], dtype=torch.float64)
        return values[:, :1], values[:, 1:]

    return drive


def at_rest(lanes: Lanes, force: torch.Tensor | float = 0.0) -> LaneState:
    shape = torch.broadcast_shapes(*(values.shape for values in lanes[:-1]))
    return LaneState.sticking(lanes, torch.as_tensor(force).to(lanes.pressure).expand(shape))


def carry(lanes, state, drive, num_steps, step_s, every=1, first_step=0, backend="auto"):
    """``integrate`` under a drive that is a function of time."""
    arm, load = drive(stage_times_s(num_steps, step_s, first_step))
    arm, load = arm.to(lanes.pressure), load.to(lanes.pressure)
    return integrate(lanes, state, arm, load, step_s, every, backend)


def assert_close(one: tuple, other: tuple, tolerance: float = 0.0) -> None:
    for mine, its in zip(one, other, strict=True):
        assert mine.shape == its.shape
        scale = float(mine.abs().max())
        assert (mine.double() - its.double()).abs().max() <= tolerance * scale


# --- against Radau ------------------------------------------------------------------------------

CASES = {
    "smooth 20 mm/s": (SMOOTH, 0.02),
    "tacky 40 mm/s": (TACKY, 0.04),
    "patch 20 mm/s": (PATCH, 0.02),
}
TIMES = np.arange(1, 1601) * 50e-6


@cache
def solution(case: str) -> dict[str, np.ndarray]:
    element, arm_m_s = CASES[case]
    return element.radau(ramped(arm_m_s), one, TIMES)


def crossing_s(times: np.ndarray, speed: np.ndarray, level: float) -> float:
    after = int(np.argmax(speed > level))
    return np.interp(level, speed[after - 1 : after + 1], times[after - 1 : after + 1])


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("step_us", "most", "late_s"), [(125, 0.004, 10e-6), (250, 0.03, 40e-6)])
def test_friction_and_breakaway_are_radaus(case, step_us, most, late_s):
    (element, arm_m_s), found = CASES[case], solution(case)
    lanes, num = element.lanes(), 80_000 // step_us
    trace, _ = carry(lanes, at_rest(lanes), driven(ramped(arm_m_s)), num, step_us * 1e-6)
    times = np.arange(1, num + 1) * step_us * 1e-6
    error = trace.friction_n[:, 0].numpy() - np.interp(times, TIMES, found["friction"])
    assert np.abs(error).max() <= most * found["friction"].max()
    let_go_s = crossing_s(times, trace.slip_m_s[:, 0].numpy(), arm_m_s / 2)
    assert abs(let_go_s - crossing_s(TIMES, found["slip"], arm_m_s / 2)) <= late_s


# --- engines ------------------------------------------------------------------------------------


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


def shaken(times: torch.Tensor, least: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Back and forth under a load that goes away and comes back, other ones for each lane."""
    t = times[:, None, None]
    arm = torch.tensor([[0.05, 0.06, 0.04], [0.02, 0.05, 0.07]]) * torch.sin(70.0 * t)
    load = torch.tensor([[1.0, 0.5, 2.0], [1.5, 1.0, 0.1]]) * (0.7 + torch.sin(90.0 * t))
    return arm, load.clamp(least)


@needs_engine
@pytest.mark.parametrize("n", [1, 16])
def test_backends_agree(n):
    lanes = varied(n)
    results = [carry(lanes, at_rest(lanes, 0.2), shaken, 120, 250e-6, backend=e) for e in BACKENDS]
    for one, other in zip(*results, strict=True):
        assert_close(one, other, 1e-8)


@each_backend
def test_pieces_make_the_whole(backend):
    lanes, step_s = varied(4), 2.0**-12
    whole, end = carry(lanes, at_rest(lanes), shaken, 60, step_s, backend=backend)
    third, same = carry(lanes, at_rest(lanes), shaken, 60, step_s, every=3, backend=backend)
    assert_close(tuple(values[2::3] for values in whole), third)
    state, pieces = at_rest(lanes), []
    for first, num in ((0, 24), (24, 6), (30, 30)):
        piece, state = carry(lanes, state, shaken, num, step_s, first_step=first, backend=backend)
        pieces.append(piece)
    assert_close(whole, Trace(*map(torch.cat, zip(*pieces, strict=True))))
    assert_close(end, same)
    assert_close(end, state)


def test_float32_and_any_device_do(device):
    """In the relative coordinate float32 is enough, through many slips of a tacky surface."""
    traces = []
    for dtype in (torch.float32, torch.float64):
        lanes = TACKY.lanes(dtype, c=2.0, m=[2e-3, 5e-3, 1e-2], pressure=hertz_pressure(4))
        there = Lanes(*(values.to(device) for values in lanes))
        trace, _ = carry(there, at_rest(there), driven(ramped(0.04)), 280, 250e-6, backend="torch")
        assert trace.slip_m_s.device == there.mu_s.device
        assert trace.slip_m_s.dtype == dtype
        traces.append(Trace(*(values.cpu().double() for values in trace)))
    single, double = traces
    assert (double.slip_m_s[140:] < 4e-3).any(0).all()
    error = (single.friction_n - double.friction_n).abs().amax(0) / double.friction_n.amax(0)
    assert (error <= 2e-4).all()


@needs_engine
def test_auto_takes_what_it_can(monkeypatch):
    taken, compiled = [], _bristles._carry_native
    monkeypatch.setattr(_bristles, "_carry_native", lambda *a: taken.append(1) or compiled(*a))
    lanes, single = varied(), varied(dtype=torch.float32)
    wanting = lanes._replace(mu_s=lanes.mu_s.clone().requires_grad_())

    def go(own, backend="auto"):
        taken.clear()
        return carry(own, at_rest(own), shaken, 2, 250e-6, backend=backend)[0], bool(taken)

    assert go(lanes)[1]
    assert not go(single)[1]
    trace, is_native = go(wanting)
    assert trace.friction_n.requires_grad
    assert not is_native
    with pytest.raises(ValueError, match=r'"native" needs float64 on the CPU, got torch.float32'):
        go(single, "native")
    with pytest.raises(ValueError, match="backend must be one of auto, native, torch, got 'fast'"):
        go(lanes, "fast")
    monkeypatch.setattr(native, "_loaded", lambda: "no compiler")
    assert not go(lanes)[1]
    with pytest.raises(ValueError, match='"native" cannot be used: no compiler'):
        go(lanes, "native")


def test_gradients_are_those_of_the_scheme():
    def last(mu_s, stiffness, load):
        lanes = Element(vs=0.05).lanes()._replace(mu_s=mu_s, stiffness_n_m=stiffness)
        drive = (torch.full((24, 1), 0.04, dtype=torch.float64), load.expand(24, 1))
        trace, state = integrate(lanes, at_rest(lanes, 0.6), *drive, 1e-3)
        return torch.cat([trace.friction_n[-1], trace.slip_m_s[-1] * 10, state.speed_m_s * 10])

    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.8, 1e3, 1.0)]
    assert torch.autograd.gradcheck(last, values, eps=1e-6, rtol=1e-4, atol=1e-7)


# --- extremes -----------------------------------------------------------------------------------


def extreme(n: int, dtype: torch.dtype) -> tuple[Lanes, torch.Tensor, torch.Tensor]:
    """Lanes of all speeds, stiffnesses, masses and loads, half of them tacky; speeds and loads."""
    speeds, stiffnesses, bristles = (1e-6, 1e-3, 0.04, 2.0), (1.0, 1e3, 1e6), (1e2, 1e5, 1e8)
    masses, loads = (0.0, 1e-12, 5e-3, 1.0), (0.0, 1e-9, 1.0, 1e6)
    grid = np.array(list(product(speeds, stiffnesses, bristles, masses, loads)))
    speed, k, sigma, m, load = torch.tensor(grid).T
    is_tacky = torch.arange(len(grid)) % 2 == 0
    surface = {
        name: torch.where(is_tacky, getattr(TACKY, name), getattr(SMOOTH, name))
        for name in ("mu_s", "mu_k", "vs")
    }
    skin = {"k": k, "k1": 0.2 * k, "m": m, "sigma": sigma, "d0": (1e-3 * sigma).sqrt()}
    lanes = SMOOTH.lanes(dtype=dtype, **skin, **surface, pressure=hertz_pressure(n))
    return lanes, speed, load


def turning(speed: torch.Tensor, load: torch.Tensor, until_s: float):
    """The load goes at a third and is back at half, the arm turns round near the end."""

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        phase = (times / until_s)[:, None]
        lifted = (phase > 1 / 3) & (phase < 1 / 2)
        arm = speed * torch.where(phase < 0.8, 1.0, -1.0)
        return arm, torch.where(lifted, 0.0, load * (1.0 + 0.5 * torch.sin(40.0 * phase)))

    return drive


def largest_force(lanes: Lanes, speed: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
    springs = lanes.stiffness_n_m + lanes.relaxing_n_m
    drag = lanes.damping_n_s_m + (springs * lanes.mass_kg).sqrt()
    return 1.5 * (1.5 * lanes.mu_s * load + 2.0 * drag * speed)  # 1.5 N, and turning round


@pytest.mark.parametrize("step_s", [1e-6, 5e-3])
@pytest.mark.parametrize(
    ("n", "dtype", "backend", "num"),
    [
        pytest.param(4, torch.float64, "native", 60, marks=needs_engine),
        (2, torch.float32, "torch", 15),
    ],
)
def test_bounded_and_within_the_cone(step_s, n, dtype, backend, num):
    lanes, speed, load = extreme(n, dtype)
    drive, slack = turning(speed, load, num * step_s), 1.0 + 64 * torch.finfo(dtype).eps
    load_n, moving = load.to(dtype), speed.to(dtype)
    state = at_rest(lanes, 0.5 * lanes.mu_k * load_n)
    each, most = lanes.bristle_stiffness_n_m[:, None] / n, largest_force(lanes, moving, load_n)
    for number in range(num):
        trace, state = carry(lanes, state, drive, 1, step_s, first_step=number, backend=backend)
        assert all(values.isfinite().all() for values in (*trace, *state)), number
        now = drive(torch.tensor([(number + 1) * step_s], dtype=torch.float64))[1][0].to(dtype)
        cone = lanes.pressure * (lanes.mu_s * now)[:, None]
        assert ((each * state.bristle_m).abs() <= cone * slack).all(), number
        assert (trace.friction_n[0].abs() <= most).all(), number
        assert (trace.inertia_n[0].abs() <= most).all(), number
        free = (now == 0.0) & (moving > 0)
        torch.testing.assert_close(trace.slip_m_s[0][free], state.speed_m_s[free])
