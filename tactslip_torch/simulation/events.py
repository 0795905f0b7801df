"""When things happen that are not slip: stretches of time, and taps and grips drawn into the quiet.

A recording is *quiet* where nothing slides or is about to: at rest and in strokes that move
``"both"``, ``MARGIN_S`` away from every stroke that slides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactslip_torch.simulation.grasp import Grasp, recording_key
from tactslip_torch.simulation.motion import ArmStroke, last_stop_s
from tactslip_torch.simulation.randomness import Array, generator, log_uniform, lognormal
from tactslip_torch.simulation.scene import Scene

MARGIN_S = 0.1
"""Between a tap or grip, with its settling, and a stroke that slides (ours)."""

SETTLE_S = 0.1
"""How long a film still tells of a tap or grip that is over (ours)."""

SHARE_SPREAD = 0.3
"""How unevenly elements share a tap or grip: spread of a factor on their load (ours)."""

Stretch = tuple[float, float]
"""Start and end in seconds."""


@dataclass(frozen=True, eq=False)
class Event:
    """A tap or a change of grip.

    Args:
        start_s: when it begins.
        duration_s: until the load is what it was before.
        size: newtons of a tap on an element of relative load 1, or a grip's rise over the load.
        shares: factor on it for every element, ``[E]``.
    """

    start_s: float
    duration_s: float
    size: float
    shares: Array

    @property
    def end_s(self) -> float:
        """When the load is what it was before."""
        return self.start_s + self.duration_s

    @property
    def stretch_s(self) -> Stretch:
        """What of the recording tells of it."""
        return self.start_s, self.end_s + SETTLE_S


def smooth_step(phase: Array) -> Array:
    """Half a raised cosine: 0 up to phase 0, 1 from phase 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(phase, 0.0, 1.0)))


def merged(stretches: list[Stretch]) -> tuple[Stretch, ...]:
    """The union of stretches, ascending and apart; empty ones are left out."""
    union: list[list[float]] = []
    for start_s, end_s in sorted(stretches):
        if end_s <= start_s:
            continue
        if union and start_s <= union[-1][1]:
            union[-1][1] = max(union[-1][1], end_s)
        else:
            union.append([start_s, end_s])
    return tuple((start_s, end_s) for start_s, end_s in union)


def quiet_stretches(plan: tuple[ArmStroke, ...], duration_s: float) -> tuple[Stretch, ...]:
    """Where nothing slides or is about to: all but the strokes that slide, and ``MARGIN_S``."""
    quiet, now_s = [], 0.0
    for stroke in plan:
        if stroke.slides:
            quiet.append((now_s, stroke.start_s - MARGIN_S))
            now_s = stroke.stop_s + MARGIN_S
    return merged([*quiet, (now_s, duration_s)])


def draw_events(
    scene: Scene,
    grasp: Grasp,
    plan: tuple[ArmStroke, ...],
    purpose: str,
    rate_hz: float,
    sizes: tuple[float, float],
    lengths_s: tuple[float, float],
) -> tuple[Event, ...]:
    """Events at random times where nothing slides, in order of time."""
    if rate_hz == 0:
        return ()
    quiet = quiet_stretches(plan, last_stop_s(plan) + scene.tail_s)
    if not any(end_s - start_s > lengths_s[1] + SETTLE_S for start_s, end_s in quiet):
        raise ValueError(
            f"no rest long enough for {purpose} of up to {lengths_s[1]:g} s, {SETTLE_S:g} s to "
            f"settle and {MARGIN_S:g} s before and after each slide: pause longer or add a tail_s"
        )
    rng = generator(*recording_key(scene, purpose))
    load = grasp.load_n / scene.contact.load_n
    events = []
    for _ in range(rng.poisson(rate_hz * sum(end_s - start_s for start_s, end_s in quiet))):
        length_s, size = log_uniform(rng, lengths_s), log_uniform(rng, sizes)
        shares = lognormal(rng, SHARE_SPREAD, len(load))
        rooms = [(a, b - length_s - SETTLE_S) for a, b in quiet if b - a > length_s + SETTLE_S]
        start_s = _place(rooms, rng.random())
        events.append(Event(start_s, length_s, size, shares * (load if purpose == "taps" else 1)))
    return tuple(sorted(events, key=lambda event: event.start_s))


def _place(rooms: list[Stretch], share: float) -> float:
    """The time at a share of the stretches' total length."""
    lengths = np.array([end_s - start_s for start_s, end_s in rooms])
    reached = np.cumsum(lengths)
    room = min(int(np.searchsorted(reached, share * reached[-1], side="right")), len(rooms) - 1)
    return float(rooms[room][1] - (reached[room] - share * reached[-1]))
