"""A scene: everything that determines one simulated recording, and how its arm moves.

Times in seconds from the start of the recording, positions in millimetres from where the arm was
then.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from tactslip_torch.hand import HandLayout
from tactslip_torch.simulation._blocks import Array, Grid, Key
from tactslip_torch.simulation.parameters import (
    MATERIALS,
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Contact,
    Disturbances,
    Dynamics,
    Faults,
    Handling,
    Imperfections,
    Moves,
    Sensors,
    Stroke,
)

FIDELITIES = ("kinematic", "bristles")
"""How contacts are modelled: by closed forms, or by skin and bristles integrated in time."""

SIMULATION_VERSION = 2
"""Raised when samples of some scene change by more than a step of the converter here and there.

It is part of ``Scene.to_dict``, so of cache keys.
"""

MAX_PRESLIDING_FACTOR = 1.5
"""Largest factor of an element's presliding travel on the recording's (ours)."""

PAPER_STROKES = (Stroke(20.0), Stroke(40.0), Stroke(60.0))
"""100 mm at 20, 40 and 60 mm/s after 2 s of rest each; the strokes run on without return."""

_GROUPS: dict[str, type[Any]] = {
    "contact": Contact,
    "sensors": Sensors,
    "disturbances": Disturbances,
    "handling": Handling,
    "faults": Faults,
    "dynamics": Dynamics,
    "imperfections": Imperfections,
}

PAPER = "paper"
"""The scene that the paper recorded, by the name of its configuration."""


@dataclass(frozen=True)
class Scene:
    """What is simulated. Equal scenes give equal bytes.

    With bristles they do by one backend in one release: by the native engine or by torch, which
    round apart. Provenance and the keys of ``SimulatedRecordings`` name which.

    Args:
        material: id in ``MATERIALS``.
        hand: the channels; elements are its distinct (finger, segment) pairs.
        name: of the kind of scene; scenes of other names are other draws of the same session.
        strokes: none for a hand that only holds; those that slide are longer than 1.5 times the
            longest presliding travel.
        contact: how the hand touches and slides.
        sensors: the sensing elements and their front end.
        disturbances: what is not slip.
        handling: what loads the contact without sliding.
        faults: what is broken behind the sensors.
        dynamics: of the bristles.
        imperfections: what makes channels differ without slip; none by default.
        tail_s: rest behind the last stroke, or all there is.
        acceleration_m_s2: of the arm, at each start and stop.
        sample_rate_hz: samples per second and channel.
        fidelity: of the contact, one of ``FIDELITIES``.
        seed: of the whole set.
        session: the mounting: noise floor, mains, offsets, gains and load shares belong to it.
            ``None`` stands for the material's id: one session per material, as in the paper.
        cycle: index of the recording within its session.

    Raises:
        ValueError: if the material or fidelity is unknown, there is neither stroke nor rest, a rate
            or acceleration is not positive, no element can touch, kinetic friction exceeds static,
            or a stroke is too short to slip.

    Example:
        >>> scene = Scene("M1", cycle=3)
        >>> scene.session, Scene.from_dict(scene.to_dict()) == scene
        ('M1', True)
    """

    material: str
    hand: HandLayout = field(default_factory=HandLayout.paper24)
    strokes: tuple[Stroke, ...] = PAPER_STROKES
    contact: Contact = field(default_factory=Contact)
    sensors: Sensors = field(default_factory=Sensors)
    disturbances: Disturbances = field(default_factory=Disturbances)
    handling: Handling = field(default_factory=Handling)
    faults: Faults = field(default_factory=Faults)
    dynamics: Dynamics = field(default_factory=Dynamics)
    imperfections: Imperfections = field(default_factory=Imperfections)
    tail_s: float = 0.0
    acceleration_m_s2: float = 0.5
    sample_rate_hz: float = 2000.0
    fidelity: str = "kinematic"
    seed: int = 0
    session: str | int | None = None
    cycle: int = 0
    name: str = PAPER

    def __post_init__(self) -> None:
        object.__setattr__(self, "strokes", tuple(self.strokes))
        if self.session is None:
            object.__setattr__(self, "session", self.material)
        for what, value, known in (
            ("material", self.material, tuple(MATERIALS)),
            ("fidelity", self.fidelity, FIDELITIES),
        ):
            if value not in known:
                raise ValueError(f"unknown {what} {value!r}; known are {', '.join(known)}")
        for name in ("sample_rate_hz", "acceleration_m_s2"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        if not 0 <= self.tail_s < math.inf:
            raise ValueError(f"tail_s must be finite and not negative, got {self.tail_s}")
        if not self.strokes and self.tail_s == 0:
            raise ValueError("a scene needs a stroke, or a tail_s to rest for; it has neither")
        longest_mm = MAX_PRESLIDING_FACTOR * self.contact.presliding_mm[1]
        for number, stroke in enumerate(self.strokes, 1):
            if stroke.slides and stroke.distance_mm <= 1.5 * longest_mm:
                raise ValueError(
                    f"stroke {number} of {stroke.distance_mm:g} mm is too short to slip surely: "
                    f"presliding may take {longest_mm:g} mm; it needs {1.5 * longest_mm:g} mm"
                )
        self._require_contact()

    def _require_contact(self) -> None:
        """Refuse contacts and faults that do not fit this hand or this material."""
        contact, names = self.contact, self.hand.names
        for what, named in (
            ("contact.touching", contact.touching or ()),
            ("faults", self.faults.names),
        ):
            if unknown := sorted(set(named) - set(names)):
                raise ValueError(f"{what} names {unknown}, which this hand does not have")
        loads = dict(contact.finger_loads)
        touching = names if contact.touching is None else contact.touching
        if not any(loads.get(self.hand.channel(name).finger, 1.0) > 0 for name in touching):
            raise ValueError("no element in contact: every element that may touch has zero load")
        mu_s = MATERIALS[self.material].mu_s
        if contact.mu_s is None and contact.mu_k is not None and contact.mu_k > mu_s:
            raise ValueError(
                f"contact.mu_k must not exceed mu_s, got {contact.mu_k} above {self.material}'s "
                f"{mu_s}; set contact.mu_s too"
            )

    def key(self, purpose: str) -> Key:
        """The key of a draw that belongs to the recording alone."""
        kind = () if self.name == PAPER else (self.name,)
        session = cast("str | int", self.session)
        return (self.seed, "recording", session, self.material, self.cycle, *kind, purpose)

    def session_key(self, purpose: str) -> Key:
        """The key of a draw that all recordings of the session share."""
        return (self.seed, "session", cast("str | int", self.session), purpose)

    @cached_property
    def arm(self) -> tuple[ArmStroke, ...]:
        """The strokes as the arm runs them, one after the other.

        A stroke at speed v over the distance d lasts ``d/v + v/a``, so the paper's nominal onsets
        of 2, 9 and 13.5 s become arm starts at 2, 9.04 and 13.62 s.
        """
        arm, now_s, here_mm = [], 0.0, 0.0
        a = 1000.0 * self.acceleration_m_s2
        for stroke in self.strokes:
            distance_mm = stroke.distance_mm
            peak = min(stroke.speed_mm_s, math.sqrt(a * distance_mm))
            start_s = now_s + stroke.pause_s
            now_s = start_s + distance_mm / peak + peak / a
            arm.append(
                ArmStroke(start_s, here_mm, a, peak, peak / a, now_s, distance_mm, stroke.moves)
            )
            here_mm += distance_mm if stroke.slides else 0.0
        return tuple(arm)

    @property
    def slides(self) -> tuple[ArmStroke, ...]:
        """The strokes in which hand and object move against each other."""
        return tuple(stroke for stroke in self.arm if stroke.slides)

    @property
    def end_s(self) -> float:
        """When all is over; not yet a whole number of samples."""
        return (self.arm[-1].stop_s if self.arm else 0.0) + self.tail_s

    def to_dict(self) -> dict[str, Any]:
        """The scene as plain JSON types, without loss: with its version, a cache key.

        Imperfections are left out where there are none, as before there were any.
        """
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        plain["hand"] = self.hand.to_rows()
        if self.imperfections == Imperfections():
            del plain["imperfections"]
        return {**plain, "simulation_version": SIMULATION_VERSION}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Scene:
        """The scene that ``to_dict`` wrote, or of a recording's key.

        Raises:
            ValueError: if the scene is a bad one.
            TypeError: if a key is unknown.
        """
        beside = ("simulation_version", "integrator")
        values = {k: v for k, v in plain.items() if k not in beside}
        if "hand" in values:
            values["hand"] = HandLayout.from_rows(values["hand"])
        if "strokes" in values:
            values["strokes"] = _strokes(values["strokes"])
        for name, group in _GROUPS.items():
            if name in values:
                values[name] = group(**values[name])
        return cls(**values)


def _strokes(given: Iterable[Stroke | Mapping[str, Any]]) -> tuple[Stroke, ...]:
    return tuple(one if isinstance(one, Stroke) else Stroke(**one) for one in given)


def paper_scenes(
    *,
    seed: int = 0,
    cycles: int = 28,
    materials: Iterable[str] = SEEN_MATERIALS + UNSEEN_MATERIALS,
    hand: HandLayout | None = None,
    **overrides: Any,
) -> list[Scene]:
    """The paper's protocol: every cycle of every material, ordered by material, then cycle.

    Args:
        seed: of the whole set.
        cycles: recordings per material.
        materials: ids in ``MATERIALS``.
        hand: defaults to the paper's.
        overrides: any field of ``Scene``, or directly any field of one of its groups, such as the
            calibrated ``friction_noise_mv``, ``presliding_mm`` and ``burst_rate_hz``. A group or a
            stroke may be a mapping of its fields.

    Raises:
        ValueError: if a scene is bad, an override is no such field, or there is no cycle.

    Example:
        >>> scenes = paper_scenes(cycles=2, materials=("M1", "iron"), burst_rate_hz=0.1)
        >>> [(s.material, s.cycle) for s in scenes]
        [('M1', 0), ('M1', 1), ('iron', 0), ('iron', 1)]
        >>> scenes[0].disturbances.burst_rate_hz
        0.1
    """
    if cycles < 1:
        raise ValueError(f"cycles must be at least 1, got {cycles}")
    values = _grouped(overrides)
    return [
        Scene(material, hand or HandLayout.paper24(), seed=seed, cycle=cycle, **values)
        for material in materials
        for cycle in range(cycles)
    ]


def _grouped(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides as fields of ``Scene``, the groups' own fields sorted into their groups."""
    values = dict(overrides)
    if "strokes" in values:
        values["strokes"] = _strokes(values["strokes"])
    for name, group in _GROUPS.items():
        given = values.pop(name, {})
        base = given if isinstance(given, group) else group(**(given or {}))
        inner = {f.name: values.pop(f.name) for f in fields(group) if f.name in values}
        values[name] = replace(base, **inner)
    known = {f.name for f in fields(Scene)} - {"material", "hand", "seed", "cycle"}
    if unknown := sorted(set(values) - known):
        raise ValueError(
            f"unknown override {', '.join(unknown)}; a scene has {', '.join(sorted(known))} "
            f"and the fields of {', '.join(group.__name__ for group in _GROUPS.values())}"
        )
    return values


@dataclass(frozen=True)
class ArmStroke:
    """One stroke as the arm runs it: a trapezoid of speed, or a triangle if it is short.

    Args:
        start_s: when the arm begins to move.
        origin_mm: how far the hand has slid before.
        acceleration_mm_s2: of both ramps.
        peak_mm_s: highest speed, the steady one unless the stroke is short.
        ramp_s: duration of each ramp.
        stop_s: when the arm is at rest again.
        distance_mm: travel.
        moves: who does: see ``Stroke``.
    """

    start_s: float
    origin_mm: float
    acceleration_mm_s2: float
    peak_mm_s: float
    ramp_s: float
    stop_s: float
    distance_mm: float
    moves: Moves = "hand"

    @property
    def slides(self) -> bool:
        """Whether hand and object move against each other."""
        return self.moves != "both"

    @property
    def drives(self) -> bool:
        """Whether the arm moves."""
        return self.moves != "object"

    def travel_mm(self, time_s: Array) -> Array:
        """Distance from the stroke's origin, clamped before and after the stroke."""
        t = np.clip(time_s - self.start_s, 0.0, self.stop_s - self.start_s)
        up: Array = np.minimum(t, self.ramp_s)
        down: Array = np.maximum(t - (self.stop_s - self.start_s - self.ramp_s), 0.0)
        half = 0.5 * self.acceleration_mm_s2
        return half * up * up + self.peak_mm_s * (t - up) - half * down * down

    def speed_mm_s(self, time_s: Array) -> Array:
        """Speed; zero outside the stroke."""
        ramp = np.minimum(time_s - self.start_s, self.stop_s - time_s)
        return np.clip(self.acceleration_mm_s2 * ramp, 0.0, self.peak_mm_s)

    def time_of_travel_s(self, travel_mm: Array) -> Array:
        """When the arm has come so far; the inverse of ``travel_mm`` within the stroke."""
        ramp_mm = 0.5 * self.acceleration_mm_s2 * self.ramp_s**2
        early = np.sqrt(2 * np.minimum(travel_mm, ramp_mm) / self.acceleration_mm_s2)
        left_mm = np.clip(self.distance_mm - travel_mm, 0.0, ramp_mm)
        late = self.stop_s - np.sqrt(2 * left_mm / self.acceleration_mm_s2)
        middle = self.start_s + self.ramp_s + (travel_mm - ramp_mm) / self.peak_mm_s
        time = np.where(travel_mm <= ramp_mm, self.start_s + early, middle)
        return np.where(self.distance_mm - travel_mm < ramp_mm, late, time)


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion on a grid, computed once for all elements.

    Args:
        strokes: those that count: all that slide for the contact's motion, all that the arm
            drives for its own.
        grid: where.
    """

    strokes: tuple[ArmStroke, ...]
    grid: Grid

    @cached_property
    def travel_mm(self) -> list[Array]:
        """Of every stroke from its own origin, ``[K, B]`` each."""
        return [stroke.travel_mm(self.grid.time_s) for stroke in self.strokes]

    @cached_property
    def position_mm(self) -> Array:
        """Over all strokes, ``[K, B]``."""
        return sum(self.travel_mm, self.grid.zeros())

    @cached_property
    def speed_mm_s(self) -> Array:
        """Over all strokes, ``[K, B]``."""
        speeds = (stroke.speed_mm_s(self.grid.time_s) for stroke in self.strokes)
        return sum(speeds, self.grid.zeros())
