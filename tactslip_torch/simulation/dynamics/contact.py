r"""The dynamic rungs ``"lugre"`` and ``"patch"``: contact read from integrated skin and bristles.

Each stroke that slides is integrated alone, element by element: from the shear that the
quasi-static contact (``friction.slips``) has at its start, spring and bristles at rest and in
balance, the Maxwell arm relaxed, through the stroke and a quarter second of settling. In the pause
the shear relaxes in closed form, as on the kinematic rung; the two are blended over the settling by
a raised cosine. So a stroke does not need the strokes before it. What that approximates: the shear
with which a stroke ends is replaced by the quasi-static one, and creep of bristles over a pause is
left out.

Truth is what the integrated contact did: an element slides grossly from the first to the last time
at which its slip speed exceeds half of the speed of an arm that moves. It takes every stroke of
every touching element, whatever windows and channels are asked for. The last few recordings are
kept, so that a timeline and the samples integrate once.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.contact import ElementContact, Slips
from tactslip_torch.simulation.dynamics.traces import StrokeTrace, require_sliding, traces_of
from tactslip_torch.simulation.friction import relaxed, slips
from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.load import normal_force
from tactslip_torch.simulation.motion import ArmStroke, Motion
from tactslip_torch.simulation.randomness import Array
from tactslip_torch.simulation.scene import Scene

KEPT = 4
"""How many recordings' traces are kept, about 4 MB each."""

Traces = tuple[StrokeTrace, ...]

_kept: OrderedDict[Scene, Traces] = OrderedDict()
_lock = Lock()
_given: ContextVar[Mapping[Scene, Traces]] = ContextVar("_given", default=MappingProxyType({}))


@contextmanager
def given(traces: Mapping[Scene, Traces]) -> Iterator[None]:
    """Within it, contacts of these scenes are read from these traces."""
    token = _given.set(traces)
    try:
        yield
    finally:
        _given.reset(token)


def scene_traces(scene: Scene) -> Traces:
    """The scene's traces: given, kept, or integrated now."""
    if scene in _given.get():
        return _given.get()[scene]
    with _lock:
        if scene in _kept:
            _kept.move_to_end(scene)
            return _kept[scene]
    found = traces_of([scene])[0]
    with _lock:
        _kept[scene] = found
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
    return found


class DynamicContact:
    """A ``ContactModel`` that is integrated.

    Args:
        scene: whose contact; its rung is ``"lugre"`` or ``"patch"``.
        grasp: how the hand touches.
        plan: the strokes that slide.

    Attributes:
        slips: truth.
        integrator: what integrated it, ``stepper.integrator``; empty if there is no stroke.
        incipient_s: when the first bristle of each element slides, ``[S, E]``.

    Raises:
        ValueError: if no whole number of steps makes a sample, or the hand never slides.
    """

    def __init__(self, scene: Scene, grasp: Grasp, plan: tuple[ArmStroke, ...]) -> None:
        self._scene, self._grasp, self._plan = scene, grasp, plan
        self._traces = scene_traces(scene) if plan else ()
        require_sliding(grasp, dict(enumerate(self._traces)))
        self._rest = slips(grasp, plan)
        self.integrator = self._traces[0].integrator if plan else {}
        self.slips = Slips(
            self._spread([trace.start_s for trace in self._traces]),
            self._spread([trace.end_s for trace in self._traces]),
        )
        self.incipient_s = self._spread([trace.incipient_s for trace in self._traces])

    def _spread(self, rows: list[Array]) -> Array:
        """Times of the touching elements among those of all, ``[S, E]``."""
        out = np.full((len(rows), len(self._grasp.load_n)), np.nan)
        for number, row in enumerate(rows):
            out[number, self._grasp.touching] = row
        return out

    def on(self, grid: Grid) -> Callable[[int], ElementContact]:
        """What computes a touching element's contact on a grid."""
        motion = Motion(self._plan, grid.history[0])
        return lambda element: self._element(grid, motion, element)

    def _element(self, grid: Grid, motion: Motion, element: int) -> ElementContact:
        """One element's contact; ``motion`` is on the grid's history."""
        scene, grasp = self._scene, self._grasp
        lane = int(np.searchsorted(grasp.touching, element))
        normal_n = normal_force(scene, grasp, element, motion.position_mm, motion.grid.time_s)
        static_n = grasp.surface.mu_s * normal_n
        friction_n = np.zeros(motion.grid.time_s.shape)
        slide, inertia_n = np.zeros(grid.time_s.shape), np.zeros(grid.time_s.shape)
        next_starts_s = [stroke.start_s for stroke in self._plan[1:]] + [np.inf]
        for number, trace in enumerate(self._traces):
            stop_s = self._plan[number].stop_s
            rest = self._rest.shear_after[number, element]
            rows = motion.grid.overlapping(stop_s, next_starts_s[number])
            t = motion.grid.time_s[rows]
            share = rest * relaxed(grasp, np.maximum(t - stop_s, 0.0), element)
            paused = (t >= stop_s) & (t <= next_starts_s[number])
            np.copyto(friction_n[rows], static_n[rows] * share, where=paused)
            _blend(friction_n, motion.grid, trace, trace.friction_n[:, lane], stop_s)
            _blend(slide, grid, trace, trace.slide[:, lane], stop_s)
            _blend(inertia_n, grid, trace, trace.inertia_n[:, lane], stop_s)
        release_v = scene.dynamics.release_v_per_n * inertia_n
        return ElementContact(normal_n, friction_n, slide, release_v)


def _blend(
    out: Array, grid: Grid, trace: StrokeTrace, values: NDArray[np.float32], stop_s: float
) -> None:
    """Put a stroke's samples in their places, fading into what is there over the settling."""
    span, rate_hz = trace.span, grid.sample_rate_hz
    rows = grid.overlapping(span.first / rate_hz, (span.first + span.num) / rate_hz)
    sample = grid.blocks[rows, None] * grid.block_samples + np.arange(grid.block_samples)
    place = sample - span.first
    since_s = np.clip(grid.time_s[rows] - stop_s, 0.0, span.settling_s)
    settled = since_s / span.settling_s if span.settling_s > 0 else np.zeros(since_s.shape)
    weight = np.where((place >= 0) & (place <= span.num), 0.5 + 0.5 * np.cos(np.pi * settled), 0.0)
    there = out[rows]
    there += weight * (values[np.clip(place, 0, span.num)] - there)
