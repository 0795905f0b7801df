"""A scene in, its truth and its recording out.

Arm motion, contact, handling, vibration, imperfections, sensors, faults. Only the channels and the
intervals of time that are asked for are computed; elements out of contact cost no friction.

The hand's elements do not let go together. Its *onset* is when elements that carry half of the
normal load have let go (the load-weighted median of their breakaways); its sliding ends when
elements that carry half of it stick again. Both are read from the contact, not from the arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from tactslip_torch.data.recording import Recording
from tactslip_torch.simulation.blocks import Array, Grid, block_samples_for, generator
from tactslip_torch.simulation.bristles import EngineName
from tactslip_torch.simulation.contact import Contacts, StrokeTrace, scene_contact, traces_of
from tactslip_torch.simulation.disturbances import (
    Handled,
    common_waves,
    disturb,
    gain_factor,
    held_samples,
    load_factor,
    pickup,
    recorded_channels,
    stuck_volts,
)
from tactslip_torch.simulation.grasp import Grasp, Slips, draw_grasp
from tactslip_torch.simulation.scene import SIMULATION_VERSION, Motion, Scene
from tactslip_torch.simulation.sensors import (
    draw_front,
    element_vibration,
    film_volts,
    front_end,
    gauge_volts,
    shared_field,
)


@dataclass(frozen=True)
class Timeline:
    """When what happens, one entry per stroke that slides unless said otherwise.

    Args:
        duration_s: of the recording, a whole number of samples.
        num_samples: the same in samples.
        speeds_mm_s: steady speeds.
        onsets_s: when the contact begins to slide, exact.
        annotated_onsets_s: the same as a person would mark it, with jitter.
        sliding_s: ``(onset, end)`` of each slide. With bristles a slide of a tacky material
            includes its stick phases.
        arm_s: ``(start, stop)`` of every stroke that the arm drives, sliding or not.
        non_slip_s: intervals without slip in which the hand is handled, ascending and apart: what
            a detector of motors or knocks would call slip.
        slip_s: none: every onset is known.
        missing_s: none: dropped samples repeat the last, as loggers do.
    """

    duration_s: float
    num_samples: int
    speeds_mm_s: tuple[float, ...]
    onsets_s: tuple[float, ...]
    annotated_onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]
    arm_s: tuple[tuple[float, float], ...]
    non_slip_s: tuple[tuple[float, float], ...] = ()
    slip_s: tuple[tuple[float, float], ...] = ()
    missing_s: tuple[tuple[float, float], ...] = ()


def timeline(scene: Scene) -> Timeline:
    """What is true of the scene's recording, without simulating its samples.

    Raises:
        ValueError: if the contact cannot take the handling that is asked for: see ``Handled``.

    Example:
        >>> truth = timeline(Scene("M5"))
        >>> [round(onset) for onset in truth.onsets_s]
        [2, 9, 14]
        >>> truth.arm_s[0][0] < truth.onsets_s[0]
        True
    """
    grasp = draw_grasp(scene)
    return _timeline(scene, grasp, scene_contact(scene, grasp).slips)


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
        windows: ``(start_s, end_s)`` intervals to compute, ``None`` for all. Samples from
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
    return recording_of(scene, None, windows, channels, dtype)


def simulate_many(
    scenes: Iterable[Scene],
    *,
    windows: Sequence[Sequence[tuple[float, float]] | None] | None = None,
    channels: Iterable[str] | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
    engine: EngineName = "auto",
    at_once: int = 32,
) -> Iterator[Recording]:
    """The recordings of several scenes, in their order, each when it is asked for.

    Bristles of many recordings are integrated side by side, on any device. The compiled engine
    carries lanes by 16, which the elements of one recording nearly fill, so there this saves
    little; the eager engine makes few large calls of what would be many small ones.

    On the CPU in float64, engine ``"auto"``, each has the bytes that ``simulate`` gives it; by the
    eager engine, in float32 or on a GPU what it differs by is the integration's rounding.

    Args:
        scenes: of any fidelity; kinematic ones are simulated one by one.
        windows: of every scene, as ``simulate`` takes them; ``None`` for all of all.
        channels: names of the channels to compute, ``None`` for all.
        device: where bristles are integrated; sensors are simulated on the CPU.
        dtype: in which bristles are integrated, float32 or float64; samples are float32.
        engine: ``"compiled"`` or ``"eager"``, ``"auto"`` for what there is.
        at_once: how many recordings are integrated together.

    Raises:
        ValueError: as ``simulate``; or if there are not as many windows as scenes, or ``at_once``
            is not positive.

    Example:
        >>> scenes = [Scene("M2", fidelity="bristles", cycle=cycle) for cycle in range(2)]
        >>> [len(recording.onsets_s) for recording in simulate_many(scenes, channels=["SG1"])]
        [3, 3]
    """
    scenes = list(scenes)
    if at_once < 1:
        raise ValueError(f"at_once must be at least 1, got {at_once}")
    if windows is not None and len(windows) != len(scenes):
        raise ValueError(f"expected windows of each of {len(scenes)} scenes, got {len(windows)}")
    wanted = [None] * len(scenes) if windows is None else list(windows)
    if channels is not None and not isinstance(channels, str):
        channels = list(channels)

    def made() -> Iterator[Recording]:
        for start in range(0, len(scenes), at_once):
            some = scenes[start : start + at_once]
            distinct = list(dict.fromkeys(one for one in some if one.fidelity == "bristles"))
            found = traces_of(distinct, device=device, dtype=dtype, engine=engine)
            traces = dict(zip(distinct, found, strict=True))
            for scene, own in zip(some, wanted[start : start + at_once], strict=True):
                yield recording_of(scene, traces.get(scene), own, channels)

    return made()


def recording_of(
    scene: Scene,
    traces: tuple[StrokeTrace, ...] | None,
    windows: Sequence[tuple[float, float]] | None = None,
    channels: Iterable[str] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Recording:
    """``simulate`` with the traces of bristles that are integrated already, or ``None``."""
    grasp = draw_grasp(scene)
    contact = scene_contact(scene, grasp, traces)
    truth = _timeline(scene, grasp, contact.slips)
    wanted = _wanted_samples(scene, truth, windows)
    indices = _channel_indices(scene, channels)
    volts = np.full((len(scene.hand), truth.num_samples), np.nan)
    recorded, stuck = recorded_channels(scene), stuck_volts(scene)
    if wanted and indices:
        held = held_samples(scene, truth.num_samples)  # by every sample, the one that stands there
        size = block_samples_for(scene.sample_rate_hz)
        blocks = np.unique(np.concatenate([held[first:last] // size for first, last in wanted]))
        grid = Grid(blocks, size, scene.sample_rate_hz)
        sensed = sorted({recorded[index] for index in indices if index not in stuck})
        rows = _volts(scene, grasp, contact, grid, sensed)
        for first, last in wanted:
            block, offset = np.divmod(held[first:last], size)
            source = np.searchsorted(blocks, block) * size + offset
            for index in indices:
                if index in stuck:
                    volts[index, first:last] = stuck[index]
                else:
                    volts[index, first:last] = rows[recorded[index]].reshape(-1)[source]
    return Recording(
        samples=torch.from_numpy(volts).to(dtype),
        sample_rate_hz=scene.sample_rate_hz,
        material=scene.material,
        speeds_mm_s=truth.speeds_mm_s,
        onsets_s=truth.onsets_s,
        sliding_s=truth.sliding_s,
        annotated_onsets_s=truth.annotated_onsets_s,
        non_slip_s=truth.non_slip_s,
        provenance=_provenance(scene, contact),
    )


def _timeline(scene: Scene, grasp: Grasp, slips: Slips) -> Timeline:
    """The timeline of a scene whose contact is known."""
    down = grasp.touching
    onsets = [_weighted_median(row[down], grasp.load_n[down]) for row in slips.start_s]
    sticking = [np.nan_to_num(row[down], nan=-np.inf) for row in slips.end_s]  # never slid
    ends = [_weighted_median(row, grasp.load_n[down]) for row in sticking]
    num_samples = math.ceil(scene.end_s * scene.sample_rate_hz - 1e-6)
    duration_s = num_samples / scene.sample_rate_hz
    return Timeline(
        duration_s=duration_s,
        num_samples=num_samples,
        speeds_mm_s=tuple(stroke.speed_mm_s for stroke in scene.strokes if stroke.slides),
        onsets_s=tuple(onsets),
        annotated_onsets_s=tuple(_annotated(scene, onsets, ends)),
        sliding_s=tuple(zip(onsets, ends, strict=True)),
        arm_s=tuple((stroke.start_s, stroke.stop_s) for stroke in scene.arm if stroke.drives),
        non_slip_s=Handled(scene, grasp).intervals_s(duration_s),
    )


def _annotated(scene: Scene, onsets: list[float], ends: list[float]) -> list[float]:
    """Onsets with a person's jitter, kept inside the recording and before the slide's end."""
    jitter_s = 1e-3 * scene.disturbances.label_jitter_ms
    draws = generator(*scene.key("annotation")).standard_normal(len(onsets))
    marks = np.asarray(onsets) + jitter_s * np.clip(draws, -3.0, 3.0)
    return [max(0.0, min(m, e)) for m, e in zip(marks.tolist(), ends, strict=True)]


def _weighted_median(values: Array, weights: Array) -> float:
    """The value at which half of the weight is reached."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])])


def _volts(
    scene: Scene, grasp: Grasp, contact: Contacts, grid: Grid, indices: list[int]
) -> dict[int, Array]:
    """Volts of the channels asked for on the grid, ``[K, B]`` each."""
    history, _, now = grid.history
    driven = Motion(tuple(stroke for stroke in scene.arm if stroke.drives), grid)
    front, common = draw_front(scene), common_waves(scene, driven) + pickup(scene, grid)
    field = shared_field(scene, grasp, Motion(scene.slides, grid))
    motion, handled = Motion(scene.slides, history), Handled(scene, grasp)
    volts = {index: grid.zeros() for index in indices}
    for wave in common:
        for index in indices:
            volts[index][wave.rows] += wave.volts[index] * wave.wave
    elements = {int(grasp.element_of_channel[index]) for index in indices}
    for element in sorted(elements & set(grasp.touching.tolist())):
        state = contact.element(element, grid, motion)
        vibration = element_vibration(scene, grasp, state, field, element)
        disturb(scene, grasp, state, element, grid, vibration)
        normal_n, shear_n, press_n = state.normal_n, state.friction_n, None
        if (factor := load_factor(scene, element, history)) is not None:
            normal_n, shear_n = normal_n * factor, shear_n * factor
            for band in (vibration.high, vibration.low):
                band *= np.sqrt(factor[now])
        if not handled.is_idle:
            press_n = handled.press_n(element, normal_n, history)
            normal_n = normal_n + press_n
            shear_n = shear_n + handled.shear_n(element, history.time_s)
            vibration.high[:] += handled.knock_v(element, grid)
        for index in indices:
            if grasp.element_of_channel[index] != element:
                continue
            if scene.hand.channels[index].adapting == "slow":
                sensed = gauge_volts(scene, normal_n[now], shear_n[now], vibration)
            else:
                sensed = film_volts(scene, grid, shear_n, vibration, press_n)
            volts[index] += front.gain[index] * gain_factor(scene, index, grid) * sensed
    return {index: front_end(scene, front, index, grid, volts[index]) for index in indices}


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


def _provenance(scene: Scene, contact: Contacts) -> dict[str, object]:
    """Where the recording comes from."""
    provenance: dict[str, object] = {
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
    if contact.integrator:
        provenance["integrator"] = dict(contact.integrator)
    return provenance
