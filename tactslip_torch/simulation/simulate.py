"""A scene in, a recording out.

Arm motion, contact on the scene's rung, handling, vibration, imperfections, sensors, faults. Only
the channels and the stretches of time that are asked for are computed; elements out of contact cost
no friction.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.data.recording import Recording
from tactslip_torch.simulation.contact import ContactModel
from tactslip_torch.simulation.disturbances import Common
from tactslip_torch.simulation.faults import held_samples, recorded_channels, stuck_volts
from tactslip_torch.simulation.grasp import Grasp, draw_grasp
from tactslip_torch.simulation.grid import Grid, block_samples_for
from tactslip_torch.simulation.handling import Handled
from tactslip_torch.simulation.imperfections import disturb, gain_factor, load_factor, pickup
from tactslip_torch.simulation.ladder import scene_contact
from tactslip_torch.simulation.motion import ArmStroke, Motion, arm_strokes, last_stop_s
from tactslip_torch.simulation.randomness import Array
from tactslip_torch.simulation.scene import SIMULATION_VERSION, Scene
from tactslip_torch.simulation.sensors import (
    draw_front,
    film_volts,
    front_end,
    gauge_volts,
)
from tactslip_torch.simulation.timeline import Timeline, timeline_of
from tactslip_torch.simulation.vibration import element_vibration, shared_field


def simulate(
    scene: Scene,
    *,
    windows: Sequence[tuple[float, float]] | None = None,
    channels: Iterable[str] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Recording:
    """The scene's recording, with exact onsets.

    Args:
        scene: what to simulate.
        windows: ``(start_s, end_s)`` stretches to compute, ``None`` for all. Samples from
            ``round(start_s * rate)`` up to ``round(end_s * rate)``; they equal those of the whole
            recording. The cost is that of the blocks of a quarter second that they touch.
        channels: names of the channels to compute, ``None`` for all.
        dtype: of the samples, floating.

    Shape:
        - samples: ``[C, T]`` for the whole hand and duration, volts; NaN where not asked for

    Raises:
        ValueError: if a window lies outside the recording or is empty, a channel is unknown,
            ``dtype`` is not floating, or the contact cannot take the handling that is asked for.

    Example:
        >>> recording = simulate(Scene("M1"), windows=[(2.0, 2.1)], channels=["PVDF7"])
        >>> int(recording.samples.isfinite().sum())
        200
    """
    if not dtype.is_floating_point:
        raise ValueError(f"dtype must be floating, got {dtype}")
    plan = arm_strokes(scene.strokes, scene.acceleration_m_s2)
    grasp = draw_grasp(scene)
    model = scene_contact(scene, grasp, plan)
    truth = timeline_of(scene, plan, grasp, model.slips)
    wanted = _wanted_samples(scene, truth, windows)
    indices = _channel_indices(scene, channels)
    volts = np.full((len(scene.hand), truth.num_samples), np.nan)
    recorded, stuck = recorded_channels(scene), stuck_volts(scene)
    felt = sorted({recorded[index] for index in indices if index not in stuck})
    if wanted and indices:
        held = held_samples(scene, truth.num_samples)
        grid = _covering_grid(scene, held, wanted)
        rows = _volts(scene, plan, grasp, model, grid, felt)
        runs = _runs(held, grid, wanted)
        for index in indices:
            for run, source in runs:
                if index in stuck:
                    volts[index, run] = stuck[index]
                else:
                    volts[index, run] = rows[recorded[index]].reshape(-1)[source]
    return Recording(
        samples=torch.from_numpy(volts).to(dtype),
        sample_rate_hz=scene.sample_rate_hz,
        material=scene.material,
        speeds_mm_s=truth.speeds_mm_s,
        onsets_s=truth.onsets_s,
        sliding_s=truth.sliding_s,
        annotated_onsets_s=truth.annotated_onsets_s,
        non_slip_s=truth.non_slip_s,
        provenance=_provenance(scene, model),
    )


def _volts(
    scene: Scene,
    plan: tuple[ArmStroke, ...],
    grasp: Grasp,
    model: ContactModel,
    grid: Grid,
    indices: list[int],
) -> dict[int, Array]:
    """Volts of the channels asked for on the grid, ``[K, B]`` each."""
    _, _, now = grid.history
    driven = Motion(tuple(stroke for stroke in plan if stroke.drives), grid)
    sliding = Motion(tuple(stroke for stroke in plan if stroke.slides), grid)
    duration_s = last_stop_s(plan) + scene.tail_s
    front, common = draw_front(scene), Common(scene, driven, duration_s)
    field = shared_field(scene, grasp, sliding)
    volts = {index: common.channel(index) for index in indices}
    elements = {int(grasp.element_of_channel[index]) for index in indices}
    contact_of, handled = model.on(grid), Handled(scene, grasp, plan)
    for element in sorted(elements & set(grasp.touching.tolist())):
        contact = contact_of(element)
        vibration = element_vibration(scene, grasp, contact, field, element)
        disturb(scene, grasp, contact, element, grid, vibration, duration_s)
        normal_n, shear_n, press_n = contact.normal_n, contact.friction_n, None
        if (factor := load_factor(scene, element, grid.history[0])) is not None:
            normal_n, shear_n = normal_n * factor, shear_n * factor
            for band in (vibration.high, vibration.low):
                band *= np.sqrt(factor[now])
        if not handled.is_idle:
            press_n = handled.press_n(element, normal_n, grid.history[0])
            normal_n = normal_n + press_n
            shear_n = shear_n + handled.shear_n(element, grid.history[0].time_s)
            vibration.high[:] += handled.knock_v(element, grid)
        for index in indices:
            if grasp.element_of_channel[index] != element:
                continue
            if scene.hand.channels[index].adapting == "slow":
                felt = gauge_volts(scene, normal_n[now], shear_n[now], vibration)
            else:
                felt = film_volts(scene, grid, shear_n, vibration, press_n)
            volts[index] += front.gain[index] * gain_factor(scene, index, grid) * felt
    if (common_mode := pickup(scene, grid)) is not None:
        wave, couplings = common_mode
        for index in indices:
            volts[index] += couplings[index] * wave
    return {
        index: front_end(scene, front, index, grid, volts[index], duration_s) for index in indices
    }


def _wanted_samples(
    scene: Scene, truth: Timeline, windows: Sequence[tuple[float, float]] | None
) -> list[tuple[int, int]]:
    """The windows in samples."""
    if windows is None:
        return [(0, truth.num_samples)]
    wanted = []
    for start_s, end_s in windows:
        if not (math.isfinite(start_s) and math.isfinite(end_s)):
            raise ValueError(f"a window must be finite, got ({start_s}, {end_s})")
        first, last = (round(t * scene.sample_rate_hz) for t in (start_s, end_s))
        if not 0 <= first < last <= truth.num_samples:
            raise ValueError(
                f"a window must lie within the recording, 0 <= start < end <= "
                f"{truth.duration_s:g} s, got ({start_s:g}, {end_s:g})"
            )
        wanted.append((first, last))
    return wanted


def _channel_indices(scene: Scene, channels: Iterable[str] | None) -> list[int]:
    """Positions of the channels asked for, in file order."""
    names = scene.hand.names
    if channels is None:
        return list(range(len(names)))
    asked = {channels} if isinstance(channels, str) else set(channels)
    unknown = sorted(asked - set(names))
    if unknown:
        raise ValueError(f"unknown channels {', '.join(unknown)}; this hand has {', '.join(names)}")
    return [index for index, name in enumerate(names) if name in asked]


def _covering_grid(scene: Scene, held: NDArray[np.int64], wanted: list[tuple[int, int]]) -> Grid:
    """The blocks of the samples that stand in the wanted ones."""
    size = block_samples_for(scene.sample_rate_hz)
    blocks = [np.unique(held[first:last] // size) for first, last in wanted]
    return Grid(np.unique(np.concatenate(blocks)), size, scene.sample_rate_hz)


def _runs(
    held: NDArray[np.int64], grid: Grid, wanted: list[tuple[int, int]]
) -> list[tuple[slice, NDArray[np.int64]]]:
    """Every window, and where on the grid, its blocks in a row, its samples come from."""
    size = grid.block_samples
    runs = []
    for first, last in wanted:
        block, offset = np.divmod(held[first:last], size)
        runs.append((slice(first, last), np.searchsorted(grid.blocks, block) * size + offset))
    return runs


def _provenance(scene: Scene, model: ContactModel) -> dict[str, object]:
    """Where the recording comes from."""
    facts = {
        "simulated": True,
        "fidelity": scene.fidelity,
        "seed": scene.seed,
        "scene": scene.name,
        "material": scene.material,
        "session": scene.session,
        "cycle": scene.cycle,
        "simulation_version": SIMULATION_VERSION,
        "numpy_version": np.__version__,
    }
    return facts | ({"integrator": dict(model.integrator)} if model.integrator else {})
