"""Error of friction force and of onset on single elements, against Radau."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.clocks import say
from benchmarks.simulation.radau import radau
from benchmarks.simulation.sizes import Sizes
from tactslip_torch.simulation.dynamics import LaneState, integrate
from tactslip_torch.simulation.dynamics.drive import StrokeDrive, loads_n, span_of, stroke_drive
from tactslip_torch.simulation.dynamics.physics import Skins, lanes_of, skins
from tactslip_torch.simulation.friction import shear_share
from tactslip_torch.simulation.grasp import Grasp, draw_grasp
from tactslip_torch.simulation.grid import Grid, block_samples_for
from tactslip_torch.simulation.knobs import Stroke
from tactslip_torch.simulation.ladder import scene_contact
from tactslip_torch.simulation.motion import ArmStroke, Motion, arm_strokes
from tactslip_torch.simulation.scene import Scene

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
        stroke: as the arm runs it.
        skin: of the element alone.
        drive: of its lane.
        until_s: end of what is compared, from the first sample.
        truth: spring force and slip speed at some times, by Radau.
        onset_s: from the first sample, by Radau.
        static_n: friction at which it lets go, nominally.
    """

    scene: Scene
    grasp: Grasp
    stroke: ArmStroke
    skin: Skins
    drive: StrokeDrive
    until_s: float
    truth: Any
    onset_s: float
    static_n: float


def elements(rung: str, sizes: Sizes) -> list[Element]:
    """The cases of a rung, solved by Radau."""
    return [_element(rung, *case, sizes) for case in CASES[: sizes.elements]]


def _element(rung: str, material: str, speed_mm_s: float, sizes: Sizes) -> Element:
    say(f"Radau: {rung}, {material} at {speed_mm_s:g} mm/s")
    scene = Scene(material, fidelity=rung, seed=sizes.seed, strokes=(Stroke(speed_mm_s),))
    grasp = draw_grasp(scene)
    plan = arm_strokes(scene.strokes, scene.acceleration_m_s2)
    span = span_of(plan, 0, scene.sample_rate_hz)
    load = loads_n(scene, grasp, plan[0], span)[:, :1]
    skin = skins(scene, grasp).only(slice(1))
    drive = stroke_drive([(plan[0], span, load)], scene.sample_rate_hz, torch.device("cpu"))
    travel = np.asarray(grasp.presliding_mm[grasp.touching[0]])
    free_s = float(plan[0].time_of_travel_s(travel)) - plan[0].start_s
    until_s = 1e-3 * round(1e3 * (1.2 * free_s + sizes.behind_s))
    constants = {name: float(column[0]) for name, column in skin.columns().items()}
    pressure = lanes_of([skin], torch.float64, torch.device("cpu")).pressure.numpy()
    first_s = span.first / scene.sample_rate_hz
    rate_hz, loads = scene.sample_rate_hz, load[:, 0]

    def arm(time_s: float) -> float:
        return 1e-3 * float(plan[0].speed_mm_s(np.asarray(first_s + time_s)))

    def held(time_s: float) -> float:
        return float(np.interp(time_s * rate_hz, np.arange(len(loads)), loads))

    truth = radau(constants, pressure, arm, held, until_s)
    near = NEAR_S * np.arange(1, round(until_s / NEAR_S) + 1, dtype=np.float64)
    slip = truth(near)[1]
    onset_s = onset(near, slip, np.array([arm(t) for t in near]))
    static_n = float(grasp.friction_n[grasp.touching[0]])
    return Element(scene, grasp, plan[0], skin, drive, until_s, truth, onset_s, static_n)


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
        lanes = lanes_of([element.skin], torch.float64, torch.device("cpu"))
        num = int(element.until_s / (1e-6 * step_us) + 1e-9)
        trace, _ = integrate(lanes, LaneState.sticking(lanes), element.drive, num, 1e-6 * step_us)
        time_s = 1e-6 * step_us * np.arange(1, num + 1, dtype=np.float64)
        force = trace.friction_n[:, 0].numpy()
        friction.append(np.abs(force - element.truth(time_s)[0]).max() / element.static_n)
        arm = element.drive.speed_m_s(torch.from_numpy(time_s))[:, 0].numpy()
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
        rate_hz, plan = scene.sample_rate_hz, (element.stroke,)
        model: Any = scene_contact(scene, element.grasp, plan)
        lane = int(element.grasp.touching[0])
        size, first = block_samples_for(rate_hz), int(np.floor(element.stroke.start_s * rate_hz))
        num = int(element.until_s * rate_hz)
        grid = Grid(np.arange(first // size, (first + num) // size + 1), size, rate_hz)
        time_s = grid.time_s.ravel() - first / rate_hz
        inside = (time_s > 0) & (time_s <= element.until_s)
        share = shear_share(
            element.grasp, model.slips, Motion(plan, grid), lane, scene.contact.recoil_s
        )
        load = element.drive(torch.from_numpy(time_s[inside]))[1][:, 0].numpy()
        force = element.grasp.surface.mu_s * load * share.ravel()[inside]
        friction.append(np.abs(force - element.truth(time_s[inside])[0]).max() / element.static_n)
        onset_s = model.slips.start_s[0, lane] - first / rate_hz
        onsets.append(abs(onset_s - element.onset_s))
    return {
        "rung": "kinematic",
        "step_us": None,
        "friction_error": float(max(friction)),
        "onset_error_s": float(max(onsets)),
    }
