"""Loads that are not slip: a carried object's inertia, taps, changes of grip.

They come on top of what a rung says of the contact, and only where nothing slides: at rest and in
strokes that move ``"both"``, away from any stroke that slides (``events.MARGIN_S``). One thing
reaches further: a carried object's shear outlasts its stroke by ``JERK_S``, into a slide that
begins sooner, where it is heard and moves no truth. Taps and
grips press harder and never less, and carried shear stays below half of static friction, so a
contact that sticks goes on sticking: no slip begins or ends by them. Everything is a function of
absolute time.
"""

from __future__ import annotations

import numpy as np

from tactslip_torch.simulation.events import Stretch, draw_events, merged, smooth_step
from tactslip_torch.simulation.friction import relaxed
from tactslip_torch.simulation.grasp import Grasp, recording_key
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.motion import ArmStroke
from tactslip_torch.simulation.randomness import Array, generator
from tactslip_torch.simulation.scene import Scene

RINGING_S = 0.3
"""How long the arm's ringing counts as handling after a stroke (ours)."""

JERK_S = 0.03
"""How long the object takes to follow a change of the arm's acceleration: a raised cosine (ours).

The skin of all elements and 0.2 kg resonate near 40 Hz.
"""

MOST_CARRIED_SHARE = 0.5
"""Of static friction, what a carried object may take."""

KNOCK_V_PER_N = 0.05
"""First swing of each of a knock's modes at a film, per newton of the tap's peak (ours)."""

KNOCK_HZ = (60.0, 800.0)
"""Where a knock's modes lie."""

_KNOCK_MODES = 8
_KNOCK_DECAY_S = (0.002, 0.008)


class Handled:
    """What hands do to the object in one recording.

    Args:
        scene: whose handling.
        grasp: how the hand touches.
        plan: all strokes.

    Attributes:
        taps: in order of time.
        grips: the same.

    Raises:
        ValueError: if the carried object would take more than half of static friction, or more
            than a slide before has left of it, or there is no rest long enough for a tap or grip
            that is asked for.
    """

    def __init__(self, scene: Scene, grasp: Grasp, plan: tuple[ArmStroke, ...]) -> None:
        self._scene, self._plan = scene, plan
        self._share_of_load = grasp.load_n / grasp.load_n.sum()
        _require_carriable(scene, grasp, plan)
        knobs = scene.handling
        tap_s = (1e-3 * knobs.tap_ms[0], 1e-3 * knobs.tap_ms[1])
        self.taps = draw_events(scene, grasp, plan, "taps", knobs.taps_per_s, knobs.tap_n, tap_s)
        self.grips = draw_events(
            scene, grasp, plan, "grips", knobs.grips_per_s, knobs.grip_share, knobs.grip_s
        )

    @property
    def _carried(self) -> tuple[ArmStroke, ...]:
        """Strokes in which an object of some mass moves with the hand."""
        strokes = tuple(stroke for stroke in self._plan if not stroke.slides)
        return strokes if self._scene.handling.carried_kg > 0 else ()

    @property
    def is_idle(self) -> bool:
        """Whether nothing is done."""
        return not (self.taps or self.grips or self._carried)

    def stretches_s(self, duration_s: float) -> tuple[Stretch, ...]:
        """Where the hand is handled: ascending, apart, within the recording, never in a slide.

        The whole of a recording without strokes: there is nothing else to tell slip from.
        """
        if not self._plan:
            return ((0.0, duration_s),)
        stretches = [event.stretch_s for event in (*self.taps, *self.grips)]
        for number, stroke in enumerate(self._plan):
            later = [s.start_s for s in self._plan[number + 1 :] if s.slides]
            if not stroke.slides:
                stop_s = min([stroke.stop_s + RINGING_S, *later])
                stretches.append((stroke.start_s, stop_s))
        return merged([(start_s, min(end_s, duration_s)) for start_s, end_s in stretches])

    def shear_n(self, element: int, time_s: Array) -> Array:
        """Newtons of the carried object's inertia on an element; signed like a slide's friction."""
        accelerations = [_smooth_acceleration(stroke, time_s) for stroke in self._carried]
        total: Array = sum(accelerations, np.zeros(time_s.shape))
        per_element = self._scene.handling.carried_kg * float(self._share_of_load[element])
        return per_element * total

    def press_n(self, element: int, before_n: Array, grid: Grid) -> Array:
        """Newtons that taps and grips add to an element's load.

        Args:
            element: which.
            before_n: its load without them, on ``grid``.
            grid: where.

        Shape:
            - before_n, output: ``[K, B]``
        """
        extra = np.zeros(grid.time_s.shape)
        for tap in self.taps:
            rows = grid.overlapping(tap.start_s, tap.end_s)
            phase = np.clip((grid.time_s[rows] - tap.start_s) / tap.duration_s, 0.0, 1.0)
            extra[rows] += tap.size * tap.shares[element] * np.sin(np.pi * phase)
        for grip in self.grips:
            rows = grid.overlapping(grip.start_s, grip.end_s)
            phase = (grid.time_s[rows] - grip.start_s) / grip.duration_s
            rise = smooth_step(4.0 * phase) * smooth_step(4.0 * (1.0 - phase))
            extra[rows] += grip.size * grip.shares[element] * rise * before_n[rows]
        return extra

    def knock_v(self, element: int, grid: Grid) -> Array:
        """What a film of unit gain hears of the taps beyond their force: many modes, soon gone.

        Shape:
            - output: ``[K, B]``
        """
        volts = np.zeros(grid.time_s.shape)
        rng = generator(*recording_key(self._scene, "knocks"), element)
        for tap in self.taps:
            low, high = KNOCK_HZ
            hertz = low * (high / low) ** rng.random(_KNOCK_MODES)
            shortest, longest = _KNOCK_DECAY_S
            decay = 1.0 / (shortest * (longest / shortest) ** rng.random(_KNOCK_MODES))
            swing = KNOCK_V_PER_N * tap.size * tap.shares[element]
            swings = swing * rng.standard_normal(_KNOCK_MODES)
            heard = hertz < 0.4 * self._scene.sample_rate_hz
            rows = grid.overlapping(tap.start_s, tap.start_s + 12.0 * longest)
            since = np.maximum(grid.time_s[rows] - tap.start_s, 0.0)
            for f, d, s in zip(hertz[heard], decay[heard], swings[heard], strict=True):
                volts[rows] += s * np.exp(-d * since) * np.sin(2 * np.pi * f * since)
        return volts


def _smooth_acceleration(stroke: ArmStroke, time_s: Array) -> Array:
    """The arm's acceleration in m/s2 as the object follows it: the same change of speed."""
    stop_s = stroke.stop_s - stroke.start_s
    corners_s = (0.0, stroke.ramp_s, stop_s - stroke.ramp_s, stop_s)
    since = time_s - stroke.start_s
    up, even, down, rest = (smooth_step((since - corner) / JERK_S) for corner in corners_s)
    return 1e-3 * stroke.acceleration_mm_s2 * (up - even - down + rest)


def _require_carriable(scene: Scene, grasp: Grasp, plan: tuple[ArmStroke, ...]) -> None:
    """Refuse an object whose inertia comes near to making the contact slide."""
    force_n = scene.handling.carried_kg * scene.acceleration_m_s2
    if force_n == 0 or all(stroke.slides for stroke in plan):
        return
    friction_n = (1.0 - scene.contact.runout) * float(grasp.friction_n.sum())
    what = f"carrying {scene.handling.carried_kg:g} kg at {scene.acceleration_m_s2:g} m/s2 takes"
    if force_n > MOST_CARRIED_SHARE * friction_n:
        raise ValueError(
            f"{what} {force_n:.3g} N, more than half of the {friction_n:.3g} N of static friction: "
            "lower carried_kg or acceleration_m_s2, or raise load_n"
        )
    share, stopped_s = force_n / friction_n, None
    for number, stroke in enumerate(plan, 1):
        if stroke.slides:
            stopped_s = stroke.stop_s
        elif stopped_s is not None:
            rest_s = np.asarray(stroke.start_s - stopped_s)
            left = float(relaxed(grasp, rest_s)[grasp.touching].max())
            if left + share > 1.0:
                raise ValueError(
                    f"{what} {share:.3g} of static friction in stroke {number}, and up to "
                    f"{left:.3g} may be left of the slide before: pause longer or lower carried_kg"
                )
