"""Error of friction force and of onset on single elements, against Radau."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.clocks import say
from benchmarks.simulation.radau import radau
from benchmarks.simulation.sizes import Sizes, scene_on
from tactslip_torch.simulation import Scene, Stroke
from tactslip_torch.simulation.blocks import Grid, block_samples_for
from tactslip_torch.simulation.bristles import Lanes, LaneState, integrate, stage_times_s
from tactslip_torch.simulation.contact import KinematicContact, Slide, slides_of
from tactslip_torch.simulation.grasp import Grasp, draw_grasp
from tactslip_torch.simulation.scene import Motion

Array = NDArray[np.float64]

CASES = (("M5", 20.0), ("M2", 60.0), ("M6", 40.0))
"""Material and mm/s; the first element in contact of a fresh grasp."""

NEAR_S = 50e-6
"""Distance of the times at which Radau's onset is looked for."""


class Element(NamedTuple):
    """One element that starts to slide, and the truth about it.

    Attributes:
        scene: with one stroke.
        grasp: its.
        slide: its stroke.
        lanes: skin and bristles of the element alone.
        until_s: end of what is compared, from the first sample.
        truth: spring force and slip speed at some times, by Radau.
        onset_s: from the first sample, by Radau.
        static_n: friction at which it lets go, nominally.
    """

    scene: Scene
    grasp: Grasp
    slide: Slide
    lanes: Lanes
    until_s: float
    truth: Any
    onset_s: float
    static_n: float


def elements(rung: str, sizes: Sizes) -> list[Element]:
    """The cases of a rung, solved by Radau."""
    return [_element(rung, *case, sizes) for case in CASES[: sizes.elements]]


def _element(rung: str, material: str, speed_mm_s: float, sizes: Sizes) -> Element:
    say(f"Radau: {rung}, {material} at {speed_mm_s:g} mm/s")
    scene = scene_on(rung, material, sizes.seed, strokes=(Stroke(speed_mm_s),))
    grasp = draw_grasp(scene)
    (slide,) = slides_of(scene, grasp)
    columns = {name: values[:1] for name, values in vars(slide.lanes).items()}
    lanes = Lanes(**columns | {"pressure": slide.lanes.pressure})
    travel = np.asarray(grasp.presliding_mm[grasp.touching[0]])
    free_s = float(slide.stroke.time_of_travel_s(travel)) - slide.stroke.start_s
    until_s = 1e-3 * round(1e3 * (1.2 * free_s + sizes.behind_s))
    constants = {name: float(column[0]) for name, column in columns.items() if name != "pressure"}
    pressure = lanes.pressure.numpy()
    first_s = slide.first / scene.sample_rate_hz
    rate_hz, loads = scene.sample_rate_hz, slide.load_n[:, 0]

    def arm(time_s: float) -> float:
        return 1e-3 * float(slide.stroke.speed_mm_s(np.asarray(first_s + time_s)))

    def held(time_s: float) -> float:
        return float(np.interp(time_s * rate_hz, np.arange(len(loads)), loads))

    truth = radau(constants, pressure, arm, held, until_s)
    near = NEAR_S * np.arange(1, round(until_s / NEAR_S) + 1, dtype=np.float64)
    slip = truth(near)[1]
    onset_s = onset(near, slip, np.array([arm(t) for t in near]))
    static_n = float(grasp.friction_n[grasp.touching[0]])
    return Element(scene, grasp, slide, lanes, until_s, truth, onset_s, static_n)


def onset(time_s: Array, slip: Array, arm: Array) -> float:
    """When slip first exceeds half of the arm's speed, between times by a straight line.

    Example:
        >>> float(onset(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0]), np.ones(3)))
        2.5
    """
    excess = np.where(arm > 0, slip - 0.5 * arm, -1e-9)
    after = int(np.argmax(excess > 0))
    if not excess[after] > 0:
        raise ValueError("the element does not slide before the comparison ends")
    low, high = excess[after - 1], excess[after]
    part = high / (high - low) if after else 0.0
    return float(time_s[after] - part * (time_s[after] - time_s[after - 1]))


def step_errors(rung: str, found: list[Element], step_us: float) -> dict[str, Any]:
    """Worst error over elements: friction over static friction, and onset in seconds."""
    friction, onsets = [], []
    for element in found:
        lanes, num = element.lanes, int(element.until_s / (1e-6 * step_us) + 1e-9)
        stages_s = stage_times_s(num, 1e-6 * step_us).numpy()
        arms, loads = (torch.from_numpy(part[:, :1]) for part in element.slide.drive(stages_s))
        trace, _ = integrate(lanes, LaneState.sticking(lanes), arms, loads, 1e-6 * step_us)
        time_s = 1e-6 * step_us * np.arange(1, num + 1, dtype=np.float64)
        force = trace.friction_n[:, 0].numpy()
        friction.append(np.abs(force - element.truth(time_s)[0]).max() / element.static_n)
        arm = element.slide.drive(time_s)[0][:, 0]
        onsets.append(abs(onset(time_s, trace.slip_m_s[:, 0].numpy(), arm) - element.onset_s))
    return {
        "rung": rung,
        "step_us": step_us,
        "friction_error": float(max(friction)),
        "onset_error_s": float(max(onsets)),
    }


def kinematic_errors(found: list[Element]) -> dict[str, Any]:
    """The same of the closed form, against Radau's LuGre."""
    friction, onsets = [], []
    for element in found:
        scene = replace(element.scene, fidelity="kinematic")
        rate_hz, first = scene.sample_rate_hz, element.slide.first
        contact = KinematicContact(scene, element.grasp)
        lane = int(element.grasp.touching[0])
        size, num = block_samples_for(rate_hz), int(element.until_s * rate_hz)
        grid = Grid(np.arange(first // size, (first + num) // size + 1), size, rate_hz)
        time_s = grid.time_s.ravel() - first / rate_hz
        inside = (time_s > 0) & (time_s <= element.until_s)
        share = contact.shear_share(lane, Motion(scene.slides, grid))
        load = element.slide.drive(time_s[inside])[1][:, 0]
        force = element.grasp.surface.mu_s * load * share.ravel()[inside]
        friction.append(np.abs(force - element.truth(time_s[inside])[0]).max() / element.static_n)
        onset_s = contact.slips.start_s[0, lane] - first / rate_hz
        onsets.append(abs(onset_s - element.onset_s))
    return {
        "rung": "kinematic",
        "step_us": None,
        "friction_error": float(max(friction)),
        "onset_error_s": float(max(onsets)),
    }
