"""Simulated recordings with their truth, one at a time and as a set.

Elements do not let go together. The *onset* is when elements that carry half of the normal load
have let go; sliding ends when elements that carry half of it stick again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.data.recording import MOMENTS, STRETCHES, Recording, RecordingId, Stretch
from tactslip_torch.data.recording import Timeline as _Timeline
from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import check_number
from tactslip_torch.simulation._blocks import Array, Grid, generator
from tactslip_torch.simulation._bristles import integrator
from tactslip_torch.simulation._contact import Grasp, Slips, draw_grasp, scene_contact
from tactslip_torch.simulation._sensors import Handled, held_samples, recorded_channels, volts_of
from tactslip_torch.simulation.scene import (
    PAPER,
    SEEN_MATERIALS,
    SIMULATION_VERSION,
    UNSEEN_MATERIALS,
    Scene,
    paper_scenes,
)


@dataclass(frozen=True, kw_only=True)
class Timeline(_Timeline):
    """When what happens, one entry per stroke that slides unless said otherwise.

    Onsets are exact, annotated ones have the jitter of a person. With bristles a slide of a tacky
    material includes its stick phases; of ``released_s``, bristles may hold an element that carries
    little load: it never lets go and does not count. ``non_slip_s`` are intervals, ascending and
    apart, that a detector of motors or knocks would call slip. ``slip_s`` is empty since every
    onset is known, ``missing_s`` since dropped samples repeat the last, as loggers do.

    Args:
        num_samples: of the recording, whose duration is a whole number of samples.
        arm_s: ``(start, stop)`` of every stroke that the arm drives, sliding or not.
    """

    num_samples: int
    arm_s: tuple[Stretch, ...]


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
    grasp = draw_grasp(scene)
    contact = scene_contact(scene, grasp)
    truth = _timeline(scene, grasp, contact.slips)
    volts = np.full((len(scene.hand), truth.num_samples), np.nan)
    wanted, indices = _wanted_samples(scene, truth, windows), _channel_indices(scene, channels)
    recorded, stuck = recorded_channels(scene)
    if len(wanted) and indices:
        held = held_samples(scene, truth.num_samples)[wanted]  # the sample that stands there
        size = Grid(held, scene.sample_rate_hz).block_samples
        blocks = np.unique(held // size)
        places = np.searchsorted(blocks, held // size) * size + held % size
        sensed = sorted({recorded[index] for index in indices if index not in stuck})
        grid = Grid(blocks, scene.sample_rate_hz)
        rows = dict(zip(sensed, volts_of(scene, grasp, contact, grid, sensed), strict=True))
        for index in indices:
            if index in stuck:
                volts[index, wanted] = stuck[index]
            else:
                volts[index, wanted] = rows[recorded[index]].reshape(-1)[places]
    return Recording(
        samples=torch.from_numpy(volts).to(dtype),
        sample_rate_hz=scene.sample_rate_hz,
        material=scene.material,
        provenance=_provenance(scene),
        **{name: getattr(truth, name) for name in (*MOMENTS, *STRETCHES)},
    )


def _timeline(scene: Scene, grasp: Grasp, slips: Slips) -> Timeline:
    """The timeline of a scene whose contact is known."""
    touching = grasp.touching
    load_n = grasp.load_n[touching]
    starts_s = slips.start_s[:, touching]
    onsets_s = [_weighted_median(row, load_n) for row in starts_s]
    never = -np.inf  # for elements that did not slide
    ends_s = [_weighted_median(np.nan_to_num(r[touching], nan=never), load_n) for r in slips.end_s]
    jitter_s = 1e-3 * scene.disturbances.label_jitter_ms
    draws = generator(*scene.key("annotation")).standard_normal(len(onsets_s))
    marks_s = np.asarray(onsets_s) + jitter_s * np.clip(draws, -3.0, 3.0)
    num_samples = math.ceil(scene.end_s * scene.sample_rate_hz - 1e-6)
    duration_s = num_samples / scene.sample_rate_hz
    return Timeline(
        duration_s=duration_s,
        num_samples=num_samples,
        speeds_mm_s=tuple(stroke.speed_mm_s for stroke in scene.strokes if stroke.slides),
        onsets_s=tuple(onsets_s),
        annotated_onsets_s=tuple(np.maximum(np.minimum(marks_s, ends_s), 0.0).tolist()),
        sliding_s=tuple(zip(onsets_s, ends_s, strict=True)),
        released_s=tuple((float(np.nanmin(row)), float(np.nanmax(row))) for row in starts_s),
        arm_s=tuple((stroke.start_s, stroke.stop_s) for stroke in scene.arm if stroke.drives),
        non_slip_s=Handled(scene, grasp).intervals_s(duration_s),
    )


def _weighted_median(values: Array, weights: Array) -> float:
    """The value at which half of the weight is reached."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])])


def _wanted_samples(
    scene: Scene, truth: Timeline, windows: Sequence[tuple[float, float]] | None
) -> NDArray[np.int64]:
    """The samples in any of the windows, ascending."""
    is_wanted = np.full(truth.num_samples, windows is None)
    for start_s, end_s in windows or ():
        if not (math.isfinite(start_s) and math.isfinite(end_s)):
            raise ValueError(f"a window must be finite, got ({start_s}, {end_s})")
        first, last = (round(t * scene.sample_rate_hz) for t in (start_s, end_s))
        if not 0 <= first < last <= truth.num_samples:
            raise ValueError(
                f"a window must lie within the recording, 0 <= start < end <= "
                f"{truth.duration_s:g} s, got ({start_s:g}, {end_s:g})"
            )
        is_wanted[first:last] = True
    return np.flatnonzero(is_wanted)


def _channel_indices(scene: Scene, channels: Iterable[str] | None) -> list[int]:
    """Positions of the channels asked for, in file order."""
    names = scene.hand.names
    if channels is None:
        return list(range(len(names)))
    asked = {channels} if isinstance(channels, str) else set(channels)
    if unknown := sorted(asked - set(names)):
        raise ValueError(f"unknown channels {', '.join(unknown)}; this hand has {', '.join(names)}")
    return [index for index, name in enumerate(names) if name in asked]


def _provenance(scene: Scene) -> dict[str, object]:
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
    if scene.fidelity == "bristles" and scene.slides:
        provenance["integrator"] = integrator()
    return provenance


class SimulatedRecordings:
    """A ``RecordingSource`` of simulated scenes: the paper's, another, or several kinds.

    Args:
        seed: of the whole set.
        cycles: recordings per material, session and kind of scene.
        materials: ids in ``MATERIALS``.
        channels: rows for ``HandLayout.from_rows``; ``None`` for the paper's hand.
        fidelity: of the contact, one of ``FIDELITIES``.
        scene: overrides of any parameter of the scenes; ``name`` is the kind they are.
        extra_scenes: further kinds of scenes by name, with their overrides; ``cycles`` among them
            is the kind's own number. They start from the same parameters as ``scene``.
        sessions: mountings of every material, each with all its cycles and kinds of scenes. The
            first one's recordings are those of a set with one session; further ones are named
            "2", "3" and so on, and draw everything that belongs to a mounting again: noise floor,
            mains, gains, offsets, load shares, couplings, skin, and the surface's own sample.

    Raises:
        ValueError: as ``paper_scenes``; or if there is no session.

    Example:
        >>> noisy = {"machine_mv": 20.0, "cycles": 1}
        >>> source = SimulatedRecordings(
        ...     cycles=2, materials=["M1"], extra_scenes={"noisy": noisy}
        ... )
        >>> [str(recording) for recording in source.ids]
        ['M1/0', 'M1/1', 'M1/0/noisy']
    """

    is_simulated = True

    def __init__(
        self,
        *,
        seed: int = 0,
        cycles: int = 28,
        materials: Iterable[str] = SEEN_MATERIALS + UNSEEN_MATERIALS,
        channels: Iterable[Mapping[str, str]] | None = None,
        fidelity: str = "kinematic",
        scene: Mapping[str, Any] | None = None,
        extra_scenes: Mapping[str, Mapping[str, Any]] | None = None,
        sessions: int = 1,
    ) -> None:
        check_number("data.sessions", sessions, whole=True)
        self.hand = HandLayout.paper24() if channels is None else HandLayout.from_rows(channels)
        base = {"fidelity": fidelity, "name": PAPER, **(scene or {})}
        kinds = [{**base, "cycles": cycles}]
        kinds += [
            {**kinds[0], **changes, "name": name} for name, changes in (extra_scenes or {}).items()
        ]
        materials = tuple(materials)
        self._scenes: dict[RecordingId, Scene] = {}
        for session, kind in product(["", *map(str, range(2, sessions + 1))], kinds):
            for one in paper_scenes(seed=seed, materials=materials, hand=self.hand, **kind):
                mounting = f"{one.session}/{session}" if session else one.session
                name = RecordingId(one.material, one.cycle, one.name, session)
                self._scenes[name] = replace(one, session=mounting)
        self.ids = tuple(self._scenes)
        first = next(iter(self._scenes.values()), None)
        self.sample_rate_hz = 2000.0 if first is None else first.sample_rate_hz

    def timeline(self, recording: RecordingId) -> Timeline:
        """When things happen, without a sample being simulated."""
        return timeline(self._scenes[recording])

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """The scene as plain values and, with bristles, what integrates it here."""
        scene = self._scenes[recording]
        if scene.fidelity == "kinematic":
            return scene.to_dict()
        return {**scene.to_dict(), "integrator": integrator()}

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Simulate the recording, or the intervals of it that are asked for."""
        return simulate(self._scenes[recording], windows=windows)
