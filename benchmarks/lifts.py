"""Lifts of a gripper whose grip tightens when something says slip: a closed loop, sample by sample.

Forces of the pads (``benchmarks.gripper``) become volts of the hand (``HandSignals``), a trigger
hears them every 5 ms, a reflex raises the force that an actuator brings late. Forces know the grip,
and so do samples: a false alarm costs force, a tightening that comes late costs millimetres.
``python -m benchmarks.lifts FILE`` writes a moving picture of one lift with and without a reflex.
"""

from __future__ import annotations

import argparse
import math
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.gripper import STEP_S, Array, Gripper, Pads
from tactslip_torch import AlarmSettings, SlipDetector, StreamingDetector
from tactslip_torch.report import style
from tactslip_torch.simulation import (
    UNSEEN_MATERIALS,
    Contact,
    Disturbances,
    Handling,
    HandSignals,
    Scene,
    Stroke,
)

Kind = Literal["gradual", "sudden", "heavy", "steady"]
HOP = 10  # samples between two looks of a trigger
REACH_MM = 30.0
"""How far an object may slide until it counts as dropped."""
_CLOSING_S, _CLOSED_S = 0.15, 0.45
WATCHED_S = 0.8
"""From when on a reflex may tighten: the grip has closed, the lift begins later."""
_LIFT_S, _LOADED_S, _REST_S = 1.2, (2.3, 2.7), 0.7
_LAG_S = 0.01  # of the actuator behind its delay: a first-order lag
_MARGIN = 1.5  # of the force that the controller takes over the one that the object should need
_TAP_S = 0.015  # half a sine
_SLIDES_MM_S = 2.0  # of a pad, from when on it counts as sliding
_AGAIN_S = 0.25  # from one tightening to the next; an alarm stands .2 s at least
_PAUSE_S = 0.02  # of a slide, at which it still goes on
_RECENT_S = 0.25  # behind a slide, in which a tightening is not false
_FILMED_HOPS, _FILM_SIZE = 10, (230, 150)  # a frame each 50 ms; height and width


@dataclass(frozen=True)
class Lift:
    """One lift: an object and how it is loaded, drawn by number.

    The controller expects a mass and friction and grips with 1.5 times the force that they need.
    Motors and knocks have levels of the draw, and the object is tapped once before it is loaded.

    Args:
        number: of the draw.
        kind: ``"gradual"``: a pull beside the weight grows within .3 to 1.2 s to ``over`` times
            what static friction holds, ``"sudden"``: within 20 ms; ``"heavy"``: so heavy is the
            object itself; ``"steady"``: the pull grows slowly to .9 of the limit.
        over: of the limit of static friction.
        mass: of the real object over the expected one.
        materials: to draw one from.
        tightens: whether the grip is raised once at a random time, by nobody's alarm.
    """

    number: int
    kind: Kind
    over: tuple[float, float] = (1.02, 1.2)
    mass: tuple[float, float] = (0.7, 1.3)
    materials: tuple[str, ...] = UNSEEN_MATERIALS
    tightens: bool = False

    @cached_property
    def _drawn(self) -> dict[str, float]:
        rng = np.random.default_rng([41, self.number])
        low, high = (0.9, 0.9) if self.kind == "steady" else self.over
        ranges = {
            "mass": self.mass,
            "over": (low, high),
            "load_n": (0.5, 1.5),
            "loaded_s": _LOADED_S,
            "rise_s": (0.02, 0.02) if self.kind == "sudden" else (0.3, 1.2),
            "distance_mm": (35.0, 50.0),
            "tightened_s": (1.8, 2.6),
            "tap_n": (1.0, 4.0),
            "tapped_s": (1.8, 2.3),
            "motor_mv": (1.0, 20.0),
            "knock_mv": (30.0, 200.0),
            "start_mv": (20.0, 100.0),
        }
        return {name: float(rng.uniform(*bounds)) for name, bounds in ranges.items()}

    @cached_property
    def scene(self) -> Scene:
        """The hand, on a mounting of its own, whose arm carries the object up."""
        stroke = Stroke(60.0, self._drawn["distance_mm"], _LIFT_S, moves="both")
        return Scene(
            self.materials[self.number % len(self.materials)],
            strokes=(stroke,),
            contact=Contact(load_n=self._drawn["load_n"]),
            disturbances=Disturbances(
                motor_vibration_mv=self._drawn["motor_mv"],
                burst_mv=self._drawn["knock_mv"],
                arm_transient_mv=self._drawn["start_mv"],
            ),
            handling=Handling(carried_kg=0.0),
            tail_s=3.0,
            seed=1000,
            session=f"lift {self.number}",
            name="lift",
        )

    @property
    def end_s(self) -> float:
        """When all is over: some time behind the last change of load."""
        lifted_s = self.scene.arm[0].stop_s
        loaded_s = self._drawn["loaded_s"] + self._drawn["rise_s"]
        return (lifted_s if self.kind == "heavy" else loaded_s) + _REST_S

    @property
    def shape(self) -> str:
        """Of the object."""
        return "cylinder" if self.number % 3 == 2 else "box"

    def needs(self, signals: HandSignals) -> tuple[float, float, float]:
        """The grip force of a finger to begin with, the object's weight and the largest load, N."""
        grip_n = float(signals.grasp.load_n.sum()) / 2
        limit_n = 2 * signals.grasp.mu_s * grip_n
        over_n = self._drawn["over"] * limit_n
        weight_n = self._drawn["mass"] * limit_n / _MARGIN
        return grip_n, over_n if self.kind == "heavy" else weight_n, max(over_n, weight_n)

    def pull_n(self, time_s: float, most_n: float) -> float:
        """What pulls the object down beside its weight."""
        since = (time_s - self._drawn["loaded_s"]) / self._drawn["rise_s"]
        return most_n * min(max(since, 0.0), 1.0)

    def tap_n(self, time_s: float) -> float:
        """What pushes the object aside: half a sine."""
        phase = (time_s - self._drawn["tapped_s"]) / _TAP_S
        return self._drawn["tap_n"] * math.sin(math.pi * phase) if 0 < phase < 1 else 0.0

    def raised(self, time_s: float) -> float:
        """By what nobody's alarm multiplies the grip."""
        return 1.5 if self.tightens and time_s > self._drawn["tightened_s"] else 1.0


# ------------------------------------------------------------------------------------- triggers
class Trigger(Protocol):
    """What says that the object slips."""

    def hear(self, volts: Array, pads: Pads) -> int:
        """Of the last hop: 2 slip, 1 perhaps, 0 nothing."""


class Never:
    """No reflex."""

    def hear(self, volts: Array, pads: Pads) -> int:
        """Nothing."""
        return 0


class Oracle:
    """Knows how fast every pad slides."""

    def hear(self, volts: Array, pads: Pads) -> int:
        """Slip while pads with half of the force slide."""
        return 2 * int(slides(pads) > 0.5)


class Energy:
    """A threshold on the power of the fast channels' differences over 20 ms.

    Attributes:
        highest: of all hops so far, once the grip has closed.
    """

    def __init__(self, fast: list[int], threshold: float = math.inf) -> None:
        self._fast, self._threshold, self.highest = fast, threshold, -math.inf
        self._power = deque([0.0] * 4, maxlen=4)
        self._time_s = 0.0

    def hear(self, volts: Array, pads: Pads) -> int:
        """Slip while the threshold is reached."""
        self._power.append(float((np.diff(volts[:, self._fast], axis=0) ** 2).mean()))
        self._time_s += HOP * STEP_S
        level = sum(self._power)
        if self._time_s > WATCHED_S:
            self.highest = max(self.highest, level)
        return 2 * int(level >= self._threshold)


class Listening:
    """A ``StreamingDetector``, its alarm and, if wanted, its hint.

    Attributes:
        highest: statistic of the rule so far, once the grip has closed.
    """

    def __init__(
        self,
        detector: SlipDetector,
        settings: AlarmSettings | None = None,
        *,
        with_hint: bool = False,
    ) -> None:
        self._stream, self._with_hint = StreamingDetector(detector, settings), with_hint
        self._is_high, self.highest = False, -math.inf

    def hear(self, volts: Array, pads: Pads) -> int:
        """Slip while the threshold is reached: an alarm stands longer, and the slip may be over."""
        decisions, settings = self._stream.push(volts), self._stream.settings
        if not len(decisions.number):
            return 2 * int(self._is_high)
        reached = decisions.statistic >= settings.threshold
        self._is_high = bool((decisions.by_onset if settings.onset else reached)[-1])
        late = decisions.statistic[decisions.available_s > WATCHED_S].nan_to_num(-math.inf)
        self.highest = max([self.highest, *late.tolist()])
        if self._is_high or bool(decisions.is_alarm.any()):
            return 2
        return int(self._with_hint and bool(decisions.is_hint.any()))


@dataclass
class Reflex:
    """How much a grip is tightened: 1.5 times at a slip, 1.2 times each .25 s that it goes on.

    At what may be slip 1.15 times, at most each .3 s and up to 1.3 times in all; at a slip up to 3
    times.
    """

    factor: float = 1.0
    _next_s: dict[int, float] = field(default_factory=lambda: {1: 0.0, 2: 0.0})
    _last_s: float = -1.0

    def tightens(self, time_s: float, level: int) -> bool:
        """Raise ``factor`` where this level calls for it now."""
        most = 1.3 if level == 1 else 3.0
        step = 1.15 if level == 1 else 1.2 if time_s < self._last_s + 0.3 else 1.5
        if not level or time_s < self._next_s[level] or self.factor * 1.1 > most:
            return False
        if level == 2:
            self._last_s = time_s
        self._next_s[level] = time_s + (0.3 if level == 1 else _AGAIN_S)
        self.factor = min(step * self.factor, most)
        return True


# ----------------------------------------------------------------------------------------- loop
def slides(pads: Pads) -> float:
    """Fraction of the pads' force that slides at the end of a hop, ``[HOP, 6]``."""
    normal_n = pads.normal_n[-1]
    sliding_n = normal_n[pads.slip_mm_s[-1] > _SLIDES_MM_S].sum()
    return float(sliding_n / max(normal_n.sum(), 1e-9))


class Sample(NamedTuple):
    """What is shown of a hop: time, grip of a finger, how far the object has slid, and samples.

    Attributes:
        time_s: of its end.
        grip_n: of each finger.
        slid_mm: so far.
        volts: of the hand, ``[HOP, C]``.
    """

    time_s: float
    grip_n: float
    slid_mm: float
    volts: Array


def run_lift(
    lift: Lift,
    trigger: Trigger,
    delay_s: float,
    *,
    factor: float = 1.0,
    reach_mm: float = REACH_MM,
    seen: Callable[[Gripper, Sample], None] | None = None,
) -> dict[str, Any]:
    """Lift once, in a closed loop.

    Args:
        lift: which.
        trigger: that a reflex obeys, from ``WATCHED_S`` on.
        delay_s: until the actuator begins to follow.
        factor: of the grip from the beginning.
        reach_mm: slid, at which the lift is over.
        seen: is shown every hop.

    Returns:
        Whether it was ``dropped``; ``slid_mm``; ``peak`` and ``mean`` grip force behind
        ``WATCHED_S`` over the least that the largest load needs; ``late_ms`` from when pads
        with half of the force began to slide to the first tightening while they do; and
        ``false_alarms`` and ``false_hints``, tightenings where no pad slid in the quarter second
        before.
    """
    signals = HandSignals(lift.scene)
    grasp, listens = signals.grasp, not isinstance(trigger, Never | Oracle)
    grip_n, weight_n, most_n = lift.needs(signals)
    spread = np.exp(0.1 * np.random.default_rng([42, lift.number]).standard_normal(6))
    mu_s = grasp.mu_s * spread / spread.mean()
    stribeck_mm_s = grasp.material.stribeck_mm_s
    gripper = Gripper(lift.shape, weight_n / 9.81, mu_s, grasp.mu_ratio, stribeck_mm_s)
    pad_of, fraction = _elements_of_pads(signals)
    stroke, reflex = lift.scene.arm[0], Reflex()
    commands = deque([factor * grip_n] * round(delay_s / STEP_S))
    force_n, slid_mm, grips_n = 0.0, 0.0, list[float]()
    begun_s = late_ms = None  # of the slide that goes on
    ends_s = recent_s = -math.inf
    false = {1: 0, 2: 0}
    volts = np.zeros((HOP, len(lift.scene.hand)))
    times_s = np.arange(HOP * round(lift.end_s / STEP_S / HOP), dtype=np.float64) * STEP_S
    heights_m = 1e-3 * stroke.travel_mm(times_s)
    closed = np.clip((times_s - _CLOSING_S) / (_CLOSED_S - _CLOSING_S), 0.0, 1.0)
    for first in range(0, len(times_s), HOP):
        felt = []
        for step in range(first, first + HOP):
            time_s = float(times_s[step])
            commands.append(grip_n * factor * reflex.factor * lift.raised(time_s))
            force_n += (closed[step] * commands.popleft() - force_n) * STEP_S / _LAG_S
            pull_n = lift.pull_n(time_s, most_n - weight_n)
            felt.append(gripper.step(force_n, heights_m[step], pull_n, lift.tap_n(time_s)))
        pads = Pads(*np.array(felt).swapaxes(0, 1))
        if time_s > WATCHED_S:
            grips_n.append(force_n)
            slid_mm += HOP * STEP_S * float(np.median(pads.slip_mm_s, axis=1).mean())
            sliding = slides(pads)
            recent_s = time_s if (pads.slip_mm_s > _SLIDES_MM_S).any() else recent_s
            if sliding > 0.5:
                begun_s = time_s if time_s > ends_s + _PAUSE_S else begun_s
                ends_s = time_s
        if listens or seen:
            normal_n, friction_n, slip_mm_s, inertia_n = (of[:, pad_of] for of in pads)
            forces = fraction * np.stack([normal_n, friction_n, inertia_n])
            volts = signals.push(forces[0], forces[1], slip_mm_s, forces[2])
        level = trigger.hear(volts, pads)
        if time_s > WATCHED_S and reflex.tightens(time_s, level):
            false[level] += time_s - recent_s > _RECENT_S
            if late_ms is None and begun_s is not None and time_s <= ends_s + _PAUSE_S:
                late_ms = 1e3 * (time_s - begun_s)
        if seen:
            seen(gripper, Sample(time_s, force_n, slid_mm, volts))
        if slid_mm >= reach_mm:
            break
    need_n = most_n / (2 * float(mu_s.mean()))
    return {
        "dropped": slid_mm >= REACH_MM,
        "slid_mm": slid_mm,
        "peak": max(grips_n) / need_n,
        "mean": float(np.mean(grips_n)) / need_n,
        "late_ms": late_ms,
        "false_alarms": false[2],
        "false_hints": false[1],
    }


def _elements_of_pads(signals: HandSignals) -> tuple[NDArray[np.int64], Array]:
    """The pad that every element of the hand belongs to, and its fraction of the pad's force.

    The thumb is the right finger and all others are the left one; segments follow each other along
    the lift. A pad none of whose elements touches is not felt.
    """
    rows = {"distal": 2, "middle": 1, "proximal": 0}
    pads = [3 * (finger == "thumb") + rows[segment] for finger, segment in signals.elements]
    pad_of = np.array(pads)
    loads_n = signals.grasp.load_n
    sums = np.bincount(pad_of, loads_n, 6)[pad_of]
    return pad_of, np.where(sums > 0, loads_n / np.maximum(sums, 1e-9), 0.0)


# --------------------------------------------------------------------------------------- picture
class _Camera:
    """Takes a picture of the gripper every few hops, and keeps all samples."""

    def __init__(self) -> None:
        self.images, self.samples = list[Any](), list[Sample]()
        self._renderer: Any = None

    def see(self, gripper: Gripper, sample: Sample) -> None:
        """A hop."""
        import mujoco  # of an extra

        self.samples.append(sample)
        if sample.time_s > _LIFT_S and len(self.samples) % _FILMED_HOPS == 0:
            self._renderer = self._renderer or mujoco.Renderer(gripper.model, *_FILM_SIZE)
            self._renderer.update_scene(gripper.data, "side")
            self.images.append(self._renderer.render())


def film(path: Path, lift: Lift, detector: SlipDetector) -> None:
    """Write a moving picture of a lift without and with a reflex, at half of its speed (WebP)."""
    fast = list(detector.pool.hand.fast)
    taken = [_Camera(), _Camera()]
    triggers: list[Trigger] = [Never(), Listening(detector)]
    for camera, trigger in zip(taken, triggers, strict=True):
        run_lift(lift, trigger, 0.01, reach_mm=math.inf, seen=camera.see)
    times_s = [sample.time_s for sample in taken[0].samples]
    curves = [
        ("grip, N", [[s.grip_n for s in of.samples] for of in taken]),
        ("fast channels, mV", [[1e3 * s.volts[:, fast].std() for s in of.samples] for of in taken]),
        ("slid, mm", [[min(s.slid_mm, REACH_MM) for s in of.samples] for of in taken]),
    ]
    frames = []
    for place in range(len(taken[0].images)):
        figure = style.new_figure(6.4, 3.4, "One lift, half speed", simulated=True)
        grid = figure.add_gridspec(3, 3, width_ratios=[1, 1, 1.6])
        for column, title in enumerate(("no reflex", "tightened by the alarm")):
            axes = figure.add_subplot(grid[:, column])
            axes.imshow(taken[column].images[place])
            axes.set_title(title, fontsize=9, color=(style.VERMILION, style.BLUE)[column])
            axes.set_axis_off()
        last = np.searchsorted(times_s, _LIFT_S) + _FILMED_HOPS * (place + 1)
        for row, (title, both) in enumerate(curves):
            axes = figure.add_subplot(grid[row, 2])
            for values, colour in zip(both, (style.VERMILION, style.BLUE), strict=True):
                axes.plot(times_s[:last], values[:last], color=colour, linewidth=1)
            axes.set_title(title, fontsize=8, loc="left")
            axes.set(xlim=(_LIFT_S, lift.end_s), ylim=(0, 1.05 * max(map(max, both))))
            axes.tick_params(labelsize=7, labelbottom=row == 2)
            axes.set_xlabel("s" if row == 2 else "", fontsize=7)
        figure.savefig(file := BytesIO(), format="png", dpi=100)
        frames.append(Image.open(file).convert("RGB"))
    length_ms = round(2e3 * _FILMED_HOPS * HOP * STEP_S)
    first, *others = frames
    options: dict[str, Any] = {"duration": length_ms, "loop": 0, "quality": 25, "method": 6}
    first.save(path, save_all=True, append_images=others, **options)


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "egl")  # draws without a screen
    parser = argparse.ArgumentParser(description="A moving picture of one lift (WebP, simulated).")
    parser.add_argument("out", type=Path, help="the file to write")
    parser.add_argument("--number", type=int, default=12, help="of the lift")
    parser.add_argument("--kind", default="gradual", choices=get_args(Kind), help="of its load")
    given = parser.parse_args()
    film(given.out, Lift(given.number, given.kind), SlipDetector.pretrained("paper24-sim"))
