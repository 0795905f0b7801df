"""How elements stick, let go and slide, by closed forms or by integrated bristles.

Truth, vibration and sensors are made from what a contact says, whichever it is.

*Kinematic*: every sample is a formula; bursts are drawn where skin lets go.

*Bristles*: each stroke that slides is integrated alone (``bristles.py``), element by element: from
the shear that the quasi-static contact has at its start, spring and bristles at rest and in
balance, the Maxwell arm relaxed, through the stroke and a quarter second of settling. In the pause
the shear relaxes in closed form; the two are blended over the settling by a raised cosine. So a
stroke does not need the strokes before it. What that approximates: the shear with which a stroke
ends is replaced by the quasi-static one, and creep of bristles over a pause is left out. An
element slides grossly from the first to the last time at which its slip speed exceeds half of the
speed of an arm that moves. It takes every stroke of every touching element, whatever windows and
channels are asked for.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib.util import find_spec

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.simulation.blocks import Array, Grid, generator, lognormal
from tactslip_torch.simulation.bristles import (
    GROSS_SHARE,
    EngineName,
    Lanes,
    LaneState,
    hertz_pressure,
    integrate,
    integrator,
    stage_times_s,
)
from tactslip_torch.simulation.grasp import Grasp, Surface, draw_grasp, quasi_static_slips
from tactslip_torch.simulation.scene import ArmStroke, Motion, Scene, next_starts_s

SLIDE_RISE_S = 0.004
"""Time constant with which an element that let go reaches the arm's speed (ours)."""

BURST_SHARES = (1.0, -0.2)
"""Bursts of letting go and of sticking again, over that of letting go (ours)."""

SETTLING_S = 0.25
"""How long a stroke is integrated on behind its end, or as long as its pause (ours)."""

MOVING_SHARE = 0.02
"""Of its highest speed, below which the arm counts as at rest (ours)."""

LEAST_STIFFNESS_SHARE = 0.01
"""Of the skin's stiffness, what stays however much relaxes (ours)."""

_KEPT = 4  # recordings whose traces are kept, about 4 MB each
_DRIVEN_AT_ONCE = 1 << 16  # numbers that drive lanes in one call; they fit a cache


@dataclass(frozen=True, eq=False)
class ElementContact:
    """One touching element's contact on a grid of blocks and on its history.

    Args:
        normal_n: newtons, on ``grid.history``.
        friction_n: newtons, on ``grid.history``; never above static friction.
        slide: slip speed over the speed between hand and object, on the grid: 0 sticking, or
            where nothing drives it; 1 sliding steadily; above 1 where the skin springs back, by
            much where the arm is slow.
        release_v: what a film of unit gain hears of letting go and sticking again, on the grid.
    """

    normal_n: Array
    friction_n: Array
    slide: Array
    release_v: Array


class KinematicContact:
    """Contact by closed forms.

    Args:
        scene: whose contact.
        grasp: how the hand touches.

    Attributes:
        slips: when each element slides, over all strokes that do.
        integrator: nothing.
    """

    def __init__(self, scene: Scene, grasp: Grasp) -> None:
        self.slips = quasi_static_slips(grasp, scene.slides)
        self.integrator: Mapping[str, str] = {}
        self._scene, self._grasp = scene, grasp

    def element(self, element: int, grid: Grid, motion: Motion) -> ElementContact:
        """A touching element's contact.

        Args:
            element: which.
            grid: where.
            motion: of the strokes that slide, on the grid's history.
        """
        normal_n = self._grasp.normal_n(element, motion.position_mm, motion.grid.time_s)
        slide = grid.zeros()
        for start_s, end_s in self.slips_of(element):
            rows = grid.overlapping(start_s, end_s)
            time_s = grid.time_s[rows]
            since = np.where((time_s >= start_s) & (time_s < end_s), time_s - start_s, 0.0)
            slide[rows] += -np.expm1(-since / SLIDE_RISE_S)
        friction_n = self._grasp.surface.mu_s * normal_n * self.shear_share(element, motion)
        return ElementContact(normal_n, friction_n, slide, self._release_v(element, grid))

    def slips_of(self, element: int) -> list[tuple[float, float]]:
        """Start and end in seconds of every slip of an element."""
        starts_s, ends_s = self.slips.start_s[:, element], self.slips.end_s[:, element]
        return list(zip(starts_s.tolist(), ends_s.tolist(), strict=True))

    def shear_share(self, element: int, motion: Motion) -> Array:
        """Friction over ``mu_s N``, in ``[0, 1]``; zero before the first stroke.

        Shape:
            - output: ``[K, B]`` on the motion's grid
        """
        grasp, recoil_s = self._grasp, self._scene.contact.recoil_s
        share, after = motion.grid.zeros(), self._grasp.shear_after
        presliding_mm, ratio = grasp.presliding_mm[element], grasp.surface.mu_ratio
        nexts_s = next_starts_s(motion.plan)
        for number, (stroke, next_s) in enumerate(zip(motion.plan, nexts_s, strict=True)):
            rows = motion.grid.overlapping(stroke.start_s, next_s)
            if rows.start == rows.stop:
                continue
            t, travel_mm = motion.grid.time_s[rows], motion.travel_mm[number][rows]
            let_go_s, stick_s = (
                self.slips.start_s[number, element],
                self.slips.end_s[number, element],
            )
            stretching = self.slips.shear_before[number, element] + travel_mm / presliding_mm
            sliding = ratio + (1.0 - ratio) * np.exp(-np.maximum(t - let_go_s, 0.0) / recoil_s)
            sticking = after - (stroke.distance_mm - travel_mm) / presliding_mm
            rest = after * grasp.relaxed(np.maximum(t - stroke.stop_s, 0.0), element)
            value = np.where(t > let_go_s, sliding, np.minimum(stretching, 1.0))
            value = np.where(t >= stick_s, sticking, value)
            value = np.where(t >= stroke.stop_s, rest, value)
            np.copyto(share[rows], value, where=(t >= stroke.start_s) & (t <= next_s))
        return share

    def _release_v(self, element: int, grid: Grid) -> Array:
        """The ringing of the skin at each letting go and, weaker, at each sticking again."""
        scene, grasp, volts = self._scene, self._grasp, grid.zeros()
        omega = 2 * np.pi * grasp.resonance_hz[element]
        decay = grasp.damping[element] * omega
        times_s = [time_s for slip in self.slips_of(element) for time_s in slip]
        strengths = lognormal(
            generator(*scene.key("onset pulse"), element), 0.3, (len(self.slips.start_s), 2)
        )
        full_v = scene.contact.onset_pulse_v * grasp.friction_n[element]
        sizes = (np.array(BURST_SHARES) * full_v * strengths).ravel()
        for start_s, size in zip(times_s, sizes, strict=True):
            rows, wave = grid.ringing(start_s, 12.0 / decay, omega, decay)
            volts[rows] += size * wave
        return volts


@dataclass(frozen=True, eq=False)
class StrokeTrace:
    """One stroke of the touching elements of a recording, at its samples.

    Args:
        first: the sample at which or before which the stroke starts; row 0.
        settling_s: how long it is integrated on behind its end.
        friction_n: what the skin transmits, ``[num + 1, E]`` float32.
        inertia_n: of the skin, ``[num + 1, E]`` float32.
        slide: slip speed over the arm's, 0 where it slips back or the arm rests,
            ``[num + 1, E]`` float32.
        start_s: when gross sliding begins, NaN where it never does, ``[E]``.
        end_s: when it ends for good, ``[E]``.
        integrator: what integrated it: see ``bristles.integrator``.
    """

    first: int
    settling_s: float
    friction_n: NDArray[np.float32]
    inertia_n: NDArray[np.float32]
    slide: NDArray[np.float32]
    start_s: Array
    end_s: Array
    integrator: Mapping[str, str]


class BristleContact:
    """Contact read from integrated skin and bristles.

    Args:
        scene: whose contact; its fidelity is ``"bristles"``.
        grasp: how the hand touches.
        traces: of its strokes; ``None`` to integrate them now, or take those of the last few
            scenes again.

    Attributes:
        slips: when each element slides grossly, over all strokes that do.
        integrator: what integrated it; empty if there is no stroke.

    Raises:
        ValueError: if no whole number of steps makes a sample, or the hand never slides.
    """

    def __init__(
        self, scene: Scene, grasp: Grasp, traces: tuple[StrokeTrace, ...] | None = None
    ) -> None:
        self._scene, self._grasp = scene, grasp
        self._traces = scene_traces(scene) if traces is None else traces
        self.integrator = self._traces[0].integrator if self._traces else {}
        rest = quasi_static_slips(grasp, scene.slides)
        start_s, end_s = np.full_like(rest.start_s, np.nan), np.full_like(rest.end_s, np.nan)
        load = grasp.load_n[grasp.touching]
        for number, trace in enumerate(self._traces):
            start_s[number, grasp.touching] = trace.start_s
            end_s[number, grasp.touching] = trace.end_s
            sliding = load[np.isfinite(trace.start_s)].sum() / load.sum()
            if sliding < 0.5:  # its onset would not exist
                raise ValueError(
                    f"stroke {number + 1} never slides: elements that carry {100 * sliding:.0f} % "
                    "of the load let go, 50 % must; give it more travel or less friction"
                )
        self.slips = replace(rest, start_s=start_s, end_s=end_s)

    def element(self, element: int, grid: Grid, motion: Motion) -> ElementContact:
        """A touching element's contact.

        Args:
            element: which.
            grid: where.
            motion: of the strokes that slide, on the grid's history.
        """
        scene, grasp, plan = self._scene, self._grasp, motion.plan
        lane = int(np.searchsorted(grasp.touching, element))
        normal_n = grasp.normal_n(element, motion.position_mm, motion.grid.time_s)
        static_n = grasp.surface.mu_s * normal_n
        friction_n, slide, inertia_n = motion.grid.zeros(), grid.zeros(), grid.zeros()
        for trace, stroke, next_s in zip(self._traces, plan, next_starts_s(plan), strict=True):
            stop_s = stroke.stop_s
            rows = motion.grid.overlapping(stop_s, next_s)
            t = motion.grid.time_s[rows]
            share = grasp.shear_after * grasp.relaxed(np.maximum(t - stop_s, 0.0), element)
            paused = (t >= stop_s) & (t <= next_s)
            np.copyto(friction_n[rows], static_n[rows] * share, where=paused)
            _blend(friction_n, motion.grid, trace, trace.friction_n[:, lane], stop_s)
            _blend(slide, grid, trace, trace.slide[:, lane], stop_s)
            _blend(inertia_n, grid, trace, trace.inertia_n[:, lane], stop_s)
        release_v = scene.dynamics.release_v_per_n * inertia_n
        return ElementContact(normal_n, friction_n, slide, release_v)


Contacts = KinematicContact | BristleContact
"""Either model of a recording's contact."""


def scene_contact(
    scene: Scene, grasp: Grasp, traces: tuple[StrokeTrace, ...] | None = None
) -> Contacts:
    """The contact of a scene by its fidelity; where nothing slides both are one.

    Args:
        scene: says which.
        grasp: how the hand touches.
        traces: of its strokes, where they are integrated already.
    """
    if scene.fidelity == "kinematic":
        return KinematicContact(scene, grasp)
    return BristleContact(scene, grasp, traces)


def _blend(
    out: Array, grid: Grid, trace: StrokeTrace, values: NDArray[np.float32], stop_s: float
) -> None:
    """Put a stroke's samples in their places, fading into what is there over the settling."""
    num, rate_hz = len(values) - 1, grid.sample_rate_hz
    rows = grid.overlapping(trace.first / rate_hz, (trace.first + num) / rate_hz)
    sample = grid.blocks[rows, None] * grid.block_samples + np.arange(grid.block_samples)
    place = sample - trace.first
    since_s = np.clip(grid.time_s[rows] - stop_s, 0.0, trace.settling_s)
    settled = since_s / trace.settling_s if trace.settling_s > 0 else np.zeros(since_s.shape)
    weight = np.where((place >= 0) & (place <= num), 0.5 + 0.5 * np.cos(np.pi * settled), 0.0)
    there = out[rows]
    there += weight * (values[np.clip(place, 0, num)] - there)


# --- strokes, integrated ------------------------------------------------------------------------


def lanes_of(scene: Scene, grasp: Grasp) -> Lanes:
    """Skin and bristles of every touching element, ``[E]``.

    ``mu_s N0`` over the presliding travel is the stiffness of skin and bristles in series; the
    bristles take ``bristle_share`` of the travel, a single one what its stiffness leaves it.
    Resonance and damping ratio say how heavy and how damped the skin is, its relaxation which part
    of it is a Maxwell arm. Part of the damping goes with friction, as what feeds stick-slip does:
    a damping ratio alone is too little for some skins or too much for others. PHYSICS.md, *Chain
    per sensing element*.
    """
    dynamics, down, surface = scene.dynamics, grasp.touching, grasp.surface
    static_n, presliding_m = grasp.friction_n[down], 1e-3 * grasp.presliding_mm[down]
    series_n_m = static_n / presliding_m
    share = np.full(len(down), dynamics.bristle_share)
    if dynamics.num_bristles == 1:
        share = np.minimum(series_n_m / dynamics.bristle_stiffness_n_m, share)
    bristles, skin = series_n_m / share, series_n_m / (1.0 - share)
    omega = 2 * np.pi * grasp.resonance_hz[down]
    mass = skin / omega**2
    relaxing = np.minimum(grasp.relaxation[down], 1.0 - LEAST_STIFFNESS_SHARE)
    damping = 2.0 * (dynamics.sliding_damping + grasp.damping[down]) * mass * omega
    same = np.ones(len(down))
    columns = {
        "mass_kg": mass,
        "stiffness_n_m": (1.0 - relaxing) * skin,
        "relaxing_n_m": relaxing * skin,
        "relaxation_time_s": grasp.relaxation_time_s[down],
        "damping_n_s_m": damping + dynamics.sliding_damping_s_m * static_n,
        "mu_s": surface.mu_s * same,
        "mu_k": _fast_ratio(scene, surface) * surface.mu_s * same,
        "stribeck_m_s": 1e-3 * surface.material.stribeck_mm_s * same,
        "bristle_stiffness_n_m": bristles,
        "bristle_damping_n_s_m": 2.0 * dynamics.bristle_damping * np.sqrt(bristles * mass),
        "viscous_n_s_m": dynamics.viscous_n_s_m * same,
    }
    tensors = {name: torch.from_numpy(column) for name, column in columns.items()}
    return Lanes(**tensors, pressure=hertz_pressure(int(dynamics.num_bristles)))


def _fast_ratio(scene: Scene, surface: Surface) -> float:
    """Kinetic over static friction far above the Stribeck speed."""
    fast, (low, high) = surface.material.fast_ratio, surface.material.mu_ratio
    if fast is None or scene.contact.mu_k is not None:
        return surface.mu_ratio
    return float(np.interp(surface.mu_ratio, (low, high), fast))


@dataclass(frozen=True, eq=False)
class Slide:
    """One stroke of one recording, to be integrated.

    Args:
        scene: of the recording.
        stroke: as the arm runs it.
        first: the sample at which or before which it starts.
        settling_s: how long it is integrated on behind its end.
        lanes: skin and bristles of the touching elements.
        load_n: of these elements at the samples, ``[num + 1, E]``.
        shear_n: of these elements as the stroke starts, ``[E]``.
    """

    scene: Scene
    stroke: ArmStroke
    first: int
    settling_s: float
    lanes: Lanes
    load_n: Array
    shear_n: Array

    @property
    def num(self) -> int:
        """Samples behind the first."""
        return len(self.load_n) - 1

    def drive(self, since_s: Array) -> tuple[Array, Array]:
        """The arm's speed in m/s and the loads in N at times from the first sample.

        Speeds are exact; loads are joined by straight lines between samples.

        Shape:
            - since_s: ``[n]``
            - output: ``[n, 1]`` and ``[n, E]``
        """
        rate_hz = self.scene.sample_rate_hz
        speed = 1e-3 * self.stroke.speed_mm_s(self.first / rate_hz + since_s)
        place = np.minimum(since_s * rate_hz, self.num)
        row = np.minimum(place.astype(np.int64), self.num - 1)
        part, before = (place - row)[:, None], self.load_n[row]
        return speed[:, None], before + part * (self.load_n[row + 1] - before)


def slides_of(scene: Scene, grasp: Grasp) -> list[Slide]:
    """The strokes of a scene that slide, ready to be integrated."""
    plan, rate_hz, down = scene.slides, scene.sample_rate_hz, grasp.touching
    lanes, rest = lanes_of(scene, grasp), quasi_static_slips(grasp, plan)
    slides = []
    for number, (stroke, next_s) in enumerate(zip(plan, next_starts_s(plan), strict=True)):
        settling_s = min(SETTLING_S, next_s - stroke.stop_s)
        first = int(np.floor(stroke.start_s * rate_hz))
        last = int(np.ceil((stroke.stop_s + settling_s) * rate_hz))
        time_s = np.arange(first, last + 1)[:, None] / rate_hz
        load_n = grasp.normal_n(down, stroke.origin_mm + stroke.travel_mm(time_s), time_s)
        shear_n = grasp.surface.mu_s * load_n[0] * rest.shear_before[number][down]
        slides.append(Slide(scene, stroke, first, settling_s, lanes, load_n, shear_n))
    return slides


def steps_per_sample(scene: Scene) -> int:
    """How many steps of the integration make a sample.

    Raises:
        ValueError: if that is not a whole number.
    """
    sample_us = 1e6 / scene.sample_rate_hz
    steps = round(sample_us / scene.dynamics.step_us)
    if steps < 1 or abs(steps * scene.dynamics.step_us - sample_us) > 1e-6 * sample_us:
        raise ValueError(
            f"a whole number of steps must make a sample, got dynamics.step_us="
            f"{scene.dynamics.step_us:g} at sample_rate_hz={scene.sample_rate_hz:g} "
            f"({sample_us:g} us); take {sample_us / max(steps, 1):g}"
        )
    return steps


@lru_cache(maxsize=_KEPT)
def scene_traces(scene: Scene) -> tuple[StrokeTrace, ...]:
    """The traces of a scene; of the last few they are kept, as a timeline and samples need them."""
    return traces_of([scene])[0]


def traces_of(
    scenes: Sequence[Scene],
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
    engine: EngineName = "auto",
) -> list[tuple[StrokeTrace, ...]]:
    """Every stroke that slides of every recording; those that last equally long run side by side.

    Each has the same bits however many run beside it (by the compiled engine; by the eager one,
    to rounding).

    Args:
        scenes: of fidelity ``"bristles"``.
        device: where lanes are integrated.
        dtype: in which they are.
        engine: see ``integrate``.

    Raises:
        ValueError: if no whole number of steps makes a sample.
    """
    if find_spec("numba") is None and engine == "auto":
        _say_slow()
    slides = [slides_of(scene, draw_grasp(scene)) for scene in scenes]
    alike: dict[tuple[int, int, float, int], list[Slide]] = {}
    for slide in (slide for own in slides for slide in own):
        every, rate_hz = steps_per_sample(slide.scene), slide.scene.sample_rate_hz
        kind = (slide.num, every, rate_hz, slide.lanes.num_bristles)
        alike.setdefault(kind, []).append(slide)
    traces: dict[Slide, StrokeTrace] = {}
    for together in alike.values():
        found = _integrated(together, torch.device(device), dtype, engine)
        traces.update(zip(together, found, strict=True))
    return [tuple(traces[slide] for slide in own) for own in slides]


@cache
def _say_slow() -> None:
    logging.getLogger(__name__).warning(
        "numba is not installed: bristles are integrated by engine eager, which is slow; "
        'pip install "tactslip_torch[fast]"'
    )


def _integrated(
    slides: list[Slide], device: torch.device, dtype: torch.dtype, engine: EngineName
) -> list[StrokeTrace]:
    """Strokes of one length, side by side."""
    scene, num = slides[0].scene, slides[0].num
    every, rate_hz = steps_per_sample(scene), scene.sample_rate_hz
    lanes = Lanes.together([slide.lanes for slide in slides], device, dtype)
    shear = torch.from_numpy(np.concatenate([slide.shear_n for slide in slides]))
    state = LaneState.sticking(lanes, shear.to(device, dtype))
    ends = np.cumsum([len(slide.shear_n) for slide in slides])
    friction, inertia, slip = (np.empty((num, ends[-1])) for _ in range(3))
    at_once = max(1, _DRIVEN_AT_ONCE // (2 * every * int(ends[-1])))
    step_s = 1.0 / (rate_hz * every)
    for first in range(0, num, at_once):
        rows = slice(first, min(first + at_once, num))
        num_steps = (rows.stop - first) * every
        since_s = stage_times_s(num_steps, step_s, first * every).numpy()
        arms, loads = zip(*(slide.drive(since_s) for slide in slides), strict=True)
        if len(slides) > 1:
            arms = tuple(
                arm.repeat(load.shape[1], 1) for arm, load in zip(arms, loads, strict=True)
            )
        arm, load = (
            torch.from_numpy(np.concatenate(columns, axis=1)).to(device, dtype)
            for columns in (arms, loads)
        )
        with torch.no_grad():
            trace, state = integrate(lanes, state, arm, load, step_s, every, engine)
        friction[rows] = trace.friction_n.double().cpu().numpy()
        inertia[rows] = trace.inertia_n.double().cpu().numpy()
        slip[rows] = trace.slip_m_s.double().cpu().numpy()
    by = integrator(engine, dtype, device)
    traces = []
    for slide, end in zip(slides, ends.tolist(), strict=True):
        own = slice(end - len(slide.shear_n), end)
        traces.append(_trace(slide, by, friction[:, own], inertia[:, own], slip[:, own]))
    return traces


def _trace(
    slide: Slide, by: Mapping[str, str], friction: Array, inertia: Array, slip: Array
) -> StrokeTrace:
    """What is kept of a stroke; all ``[num, E]``."""
    rate_hz, peak_m_s = slide.scene.sample_rate_hz, 1e-3 * slide.stroke.peak_mm_s
    arm, _ = slide.drive(np.arange(1, slide.num + 1) / rate_hz)
    arm = np.where(arm > MOVING_SHARE * peak_m_s, arm, 0.0)
    excess = np.where(arm > 0, slip - GROSS_SHARE * arm, -np.abs(slip))
    start_s, end_s = _gross(excess, slide.first, rate_hz)
    over = np.maximum(slip / np.maximum(arm, MOVING_SHARE * peak_m_s), 0.0)
    still = np.zeros_like(slide.shear_n)
    friction_n, inertia_n, slide_share = (
        np.concatenate([before[None], rows]).astype(np.float32)
        for before, rows in (
            (slide.shear_n, friction),
            (still, inertia),
            (still, np.where(arm > 0, over, 0.0)),
        )
    )
    return StrokeTrace(
        slide.first, slide.settling_s, friction_n, inertia_n, slide_share, start_s, end_s, by
    )


def _gross(excess: Array, first: int, rate_hz: float) -> tuple[Array, Array]:
    """First and last time at which elements slide grossly, between samples by straight lines.

    Args:
        excess: of the slip speed over the threshold, ``[num, E]``.
        first: the sample before row 0.
        rate_hz: of the samples.
    """
    num, lanes = excess.shape[0], np.arange(excess.shape[1])
    gross = excess > 0
    begins, ends = gross.argmax(0), num - 1 - gross[::-1].argmax(0)
    padded = np.concatenate([np.zeros((1, len(lanes))), excess, np.zeros((1, len(lanes)))])

    def crossing(inside: NDArray[np.int64], outside: NDArray[np.int64]) -> Array:
        """From the sample inside towards that outside, in samples of the padded rows."""
        high, low = padded[inside, lanes], padded[outside, lanes]
        with np.errstate(invalid="ignore"):
            part = np.where(high > 0, high / (high - low), 0.0)
        return np.asarray(inside + (outside - inside) * part, dtype=np.float64)

    start, end = crossing(begins + 1, begins), crossing(ends + 1, ends + 2)
    slides = gross.any(0)
    return (
        np.where(slides, (first + start) / rate_hz, np.nan),
        np.where(slides, (first + end) / rate_hz, np.nan),
    )
