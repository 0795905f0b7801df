"""Contact of a hand: how its elements stick, let go and slide.

A *session* is one mounting of one material, a *recording* grasps anew, an *element* is a segment of
a finger with all the channels in it. Every draw is made for the whole hand.

*Kinematic* contact is a Coulomb slider behind a spring, every sample a formula: while an element
sticks, friction grows with the arm's travel. At ``mu_s N`` it lets go, falls to ``mu_k N`` and
slides until shortly before the arm stops. Over the pause the shear relaxes.

With *bristles* each stroke that slides is integrated alone, element by element, from the shear that
the kinematic contact has at its start, through a quarter second of settling behind its end; then
the two are blended. An element slides grossly from the first to the last time at which its slip
speed exceeds half of the arm's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.simulation._blocks import (
    Array,
    Grid,
    generator,
    log_uniform,
    lognormal,
    smooth_step,
)
from tactslip_torch.simulation._bristles import (
    Lanes,
    LaneState,
    hertz_pressure,
    integrate,
    stage_times_s,
)
from tactslip_torch.simulation.scene import (
    MATERIALS,
    MAX_PRESLIDING_FACTOR,
    ArmStroke,
    Material,
    Motion,
    Scene,
)

_GROSS_FRACTION = 0.5
"""Of the arm's speed, above which an element of bristles slides grossly."""

_BURSTS = (1.0, -0.2)  # of letting go and of sticking again, over that of letting go (ours)
_SETTLING_S = 0.25  # how long a stroke is integrated on behind its end, at most its pause (ours)
_MOVING_FRACTION = 0.02  # of its highest speed, below which the arm counts as at rest (ours)
_LEAST_STIFFNESS = 0.01  # of the skin's, what stays however much relaxes (ours)
_RECORDINGS_KEPT = 4  # whose traces are kept, about 4 MB each
_SAMPLES_AT_ONCE = 1024  # that are driven and integrated in one call
_RESTICK_FRACTION = 0.5  # of the shear lost at letting go, taken up as the arm stops (ours)
_RUNOUT_PERIOD_MM = 180.0  # travel over which the load rises and falls (prior, ours)

# --- how the hand touches -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Grasp:
    """How the hand touches in one recording; arrays over its E elements.

    Args:
        element_of_channel: element of every channel, ``[C]``.
        load_n: normal force, 0 where an element does not touch, ``[E]``.
        presliding_mm: travel that stretches the fresh skin until it lets go, ``[E]``.
        relaxation: fraction of shear that a long pause relaxes, ``[E]``.
        relaxation_time_s: its time constant, ``[E]``.
        resonance_hz: the skin's resonance, ``[E]``.
        damping: its damping ratio, ``[E]``.
        runout: relative change of load along the travel.
        runout_phase: radians, ``[E]``.
        material: the row of the table that it touches.
        mu_s: static friction of the recording.
        mu_ratio: kinetic over static friction.
        texture_mv: rms of the texture's vibration at 40 mm/s and 1 N.
        texture_exponent: power of speed it grows with, .5 to 1.
        spectral_exponent: ``a`` of the height's power spectrum ``k^-a``, 1.5 to 3.
        wavelength_mm: dominant wavelength, or ``None``.
    """

    element_of_channel: NDArray[np.int64]
    load_n: Array
    presliding_mm: Array
    relaxation: Array
    relaxation_time_s: Array
    resonance_hz: Array
    damping: Array
    runout: float
    runout_phase: Array
    material: Material
    mu_s: float
    mu_ratio: float
    texture_mv: float
    texture_exponent: float
    spectral_exponent: float
    wavelength_mm: float | None

    @property
    def touching(self) -> NDArray[np.int64]:
        """Elements in contact."""
        return np.flatnonzero(self.load_n > 0)

    @property
    def friction_n(self) -> Array:
        """Friction at which each element lets go, ``[E]``."""
        return self.mu_s * self.load_n

    @property
    def shear_after(self) -> float:
        """Shear when the arm has stopped after a slide, as a fraction of ``mu_s N``."""
        ratio = self.mu_ratio
        return ratio + _RESTICK_FRACTION * (1.0 - ratio)

    def normal_n(
        self, element: int | NDArray[np.int64], position_mm: Array, time_s: Array
    ) -> Array:
        """Load in newtons: the surface's run-out over travel, and creep after the grasp.

        Shape:
            - position_mm, time_s, output: any one shape; with several elements ``[E]`` the times
              are ``[*, 1]`` and the output is ``[*, E]``
        """
        angle = 2 * np.pi / _RUNOUT_PERIOD_MM * position_mm + self.runout_phase[element]
        since_grasp_s = np.maximum(time_s, 0.0) + 1.0
        creep = np.exp(-since_grasp_s / (5.0 * self.relaxation_time_s[element]))
        creep *= 0.3 * self.relaxation[element]
        load_n = self.load_n[element] * (1.0 + self.runout * np.sin(angle)) * (1.0 + creep)
        return np.asarray(load_n)

    def relaxed(self, rest_s: Array | float, element: int | slice = slice(None)) -> Array:
        """Fraction of the shear left after a rest."""
        decay = -np.expm1(-rest_s / self.relaxation_time_s[element])
        return np.asarray(1.0 - self.relaxation[element] * decay)


def draw_grasp(scene: Scene) -> Grasp:
    """The recording's contact. At least one element touches: the one nearest to touching."""
    contact, channels = scene.contact, scene.hand.channels
    places = [(channel.finger, channel.segment) for channel in channels]
    elements = list(dict.fromkeys(places))
    num = len(elements)
    names = scene.hand.names if contact.touching is None else contact.touching
    allowed = {place for place, c in zip(places, channels, strict=True) if c.name in names}
    finger_loads = dict(contact.finger_loads)
    load_n = contact.load_n * np.array(
        [finger_loads.get(place[0], 1.0) * (place in allowed) for place in elements]
    )
    session, rng = generator(*scene.session_key("contact")), generator(*scene.key("g"))
    load_n = load_n * lognormal(session, contact.session_share_spread, num)
    load_n = load_n * lognormal(rng, contact.recording_share_spread, num)
    chance = np.where(load_n > 0, rng.random(num), -1.0)
    is_down = (chance >= contact.lifted_fraction) | (chance == chance.max())
    most = MAX_PRESLIDING_FACTOR
    factor = np.clip(lognormal(rng, contact.presliding_spread, num), 1 / most, most)
    low, high = contact.relaxation
    middle_hz = log_uniform(session, contact.skin_resonance_hz)
    # the material as this session has it; its friction varies a little per recording too
    material = MATERIALS[scene.material]
    of_surface = generator(*scene.session_key("surface"), scene.material)
    deviation = of_surface.standard_normal() + 0.2 * generator(*scene.key("mu")).standard_normal()
    mu_s = material.mu_s * float(np.exp(contact.friction_spread * deviation))
    mu_ratio = float(of_surface.uniform(*material.mu_ratio))
    roughness = log_uniform(of_surface, material.ra_um) / np.sqrt(np.prod(material.ra_um))
    texture_exponent, spectral_exponent = of_surface.uniform(0.5, 1.0), of_surface.uniform(1.5, 3.0)
    wavelength_mm = material.wavelength_mm and log_uniform(of_surface, material.wavelength_mm)
    if contact.mu_s is not None:
        mu_s = contact.mu_s
    if contact.mu_k is not None:
        mu_s = max(mu_s, contact.mu_k)  # one drawn below it would lower what was asked for
        mu_ratio = contact.mu_k / mu_s
    return Grasp(
        element_of_channel=np.array([elements.index(place) for place in places]),
        load_n=np.where(is_down & (load_n > 0), load_n, 0.0),
        presliding_mm=log_uniform(rng, contact.presliding_mm) * factor,
        relaxation=low + (high - low) * rng.random(num),
        relaxation_time_s=np.full(num, log_uniform(rng, contact.relaxation_time_s)),
        resonance_hz=middle_hz * lognormal(session, 0.1, num),
        damping=np.full(num, log_uniform(session, contact.skin_damping)),
        runout=contact.runout,
        runout_phase=2 * np.pi * rng.random(num),
        material=material,
        mu_s=mu_s,
        mu_ratio=mu_ratio,
        texture_mv=material.texture_mv * contact.texture_scale * float(roughness) ** 0.5,
        texture_exponent=texture_exponent,
        spectral_exponent=spectral_exponent,
        wavelength_mm=wavelength_mm,
    )


@dataclass(frozen=True, eq=False)
class Slips:
    """Every slip of every element; arrays ``[S, E]`` over S strokes that slide and E elements.

    One slip a stroke: where an element sticks and slips, from the first letting go to the last
    sticking, the stick phases between included.

    Args:
        start_s: when the element lets go; NaN for elements that do not touch.
        end_s: when it sticks again for good.
        shear_before: quasi-static shear at the start of each stroke, as a fraction of ``mu_s N``.
    """

    start_s: Array
    end_s: Array
    shear_before: Array


def quasi_static_slips(grasp: Grasp, strokes: tuple[ArmStroke, ...]) -> Slips:
    """When each element lets go and sticks again, over the strokes that slide."""
    shape = (len(strokes), len(grasp.load_n))
    start_s, end_s, before = np.empty(shape), np.empty(shape), np.zeros(shape)
    restick_mm = (grasp.shear_after - grasp.mu_ratio) * grasp.presliding_mm
    for number, stroke in enumerate(strokes):
        if number:
            pause_s = stroke.start_s - strokes[number - 1].stop_s
            before[number] = grasp.shear_after * grasp.relaxed(pause_s)
        travel_mm = (1.0 - before[number]) * grasp.presliding_mm
        start_s[number] = stroke.time_of_travel_s(travel_mm)
        end_s[number] = stroke.time_of_travel_s(stroke.distance_mm - restick_mm)
    lifted = grasp.load_n <= 0
    start_s[:, lifted] = end_s[:, lifted] = np.nan
    return Slips(start_s, end_s, before)


# --- how elements stick and slide -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ElementContact:
    """One touching element's contact on a grid of blocks and on its history.

    Args:
        normal_n: newtons, on ``grid.history``.
        friction_n: newtons, on ``grid.history``; never above static friction.
        slide: slip speed over the speed between hand and object, on the grid: 0 sticking, or
            where nothing drives it; 1 sliding steadily; above 1 where the skin springs back, by
            much where the arm is slow.
        release_v: fast channel's volts by letting go and sticking again, on the grid.
    """

    normal_n: Array
    friction_n: Array
    slide: Array
    release_v: Array


def _with_next_starts(strokes: Sequence[ArmStroke]) -> Iterator[tuple[ArmStroke, float]]:
    """Strokes, each with the start of the one behind it; infinite for the last."""
    yield from zip(strokes, [*(s.start_s for s in strokes[1:]), math.inf], strict=False)


class _KinematicContact:
    """Contact by closed forms.

    Args:
        scene: whose contact.
        grasp: how the hand touches.

    Attributes:
        slips: when each element slides, over all strokes that do.
    """

    def __init__(self, scene: Scene, grasp: Grasp) -> None:
        self.slips = quasi_static_slips(grasp, scene.slides)
        self._scene, self._grasp = scene, grasp

    def element(self, element: int, grid: Grid, motion: Motion) -> ElementContact:
        """A touching element's contact.

        Args:
            element: which.
            grid: where.
            motion: of the strokes that slide, on the grid's history.
        """
        grasp, slide = self._grasp, grid.zeros()
        for start_s, end_s in self._slips_of(element):
            rows = grid.overlapping(start_s, end_s)
            time_s = grid.time_s[rows]
            since = np.where((time_s >= start_s) & (time_s < end_s), time_s - start_s, 0.0)
            slide[rows] -= np.expm1(-since / self._scene.contact.slide_rise_s)
        normal_n = grasp.normal_n(element, motion.position_mm, motion.grid.time_s)
        friction_n = grasp.mu_s * normal_n * self._shear(element, motion)
        return ElementContact(normal_n, friction_n, slide, self._release_v(element, grid))

    def _slips_of(self, element: int) -> Array:
        """Start and end in seconds of every slip of an element, ``[S, 2]``."""
        return np.stack([self.slips.start_s[:, element], self.slips.end_s[:, element]], axis=1)

    def _shear(self, element: int, motion: Motion) -> Array:
        """Friction over ``mu_s N`` on the motion's grid; zero before the first stroke, ``[K, B]``.

        It grows as the skin stretches, falls as it lets go, grows back as it sticks, relaxes.
        """
        grasp, slips, shear = self._grasp, self.slips, motion.grid.zeros()
        presliding_mm = grasp.presliding_mm[element]
        ratio, after = grasp.mu_ratio, grasp.shear_after
        for number, (stroke, next_s) in enumerate(_with_next_starts(motion.strokes)):
            rows = motion.grid.overlapping(stroke.start_s, next_s)
            t, travel_mm = motion.grid.time_s[rows], motion.travel_mm[number][rows]
            let_go_s, stick_s = self._slips_of(element)[number]
            fall = np.exp(-np.maximum(t - let_go_s, 0.0) / self._scene.contact.recoil_s)
            stretching = slips.shear_before[number, element] + travel_mm / presliding_mm
            value = np.where(
                t > let_go_s, ratio + (1.0 - ratio) * fall, np.minimum(stretching, 1.0)
            )
            sticking = after - (stroke.distance_mm - travel_mm) / presliding_mm
            value = np.where(t >= stick_s, sticking, value)
            rest = after * grasp.relaxed(np.maximum(t - stroke.stop_s, 0.0), element)
            value = np.where(t >= stroke.stop_s, rest, value)
            np.copyto(shear[rows], value, where=(t >= stroke.start_s) & (t <= next_s))
        return shear

    def _release_v(self, element: int, grid: Grid) -> Array:
        """The ringing of the skin at each letting go and, weaker, at each sticking again."""
        scene, grasp, volts = self._scene, self._grasp, grid.zeros()
        omega = 2 * np.pi * grasp.resonance_hz[element]
        decay = grasp.damping[element] * omega
        times_s = self._slips_of(element)
        sizes = lognormal(generator(*scene.key("onset pulse"), element), 0.3, times_s.shape)
        sizes = sizes * np.array(_BURSTS) * scene.contact.onset_pulse_v * grasp.friction_n[element]
        for start_s, size in zip(times_s.flat, sizes.flat, strict=True):
            rows, wave = grid.ringing(start_s, 12.0 / decay, omega, decay)
            volts[rows] += size * wave
        return volts


class _BristleContact:
    """Contact read from integrated skin and bristles.

    Args:
        scene: whose contact; its fidelity is ``"bristles"``.
        grasp: how the hand touches.

    Attributes:
        slips: when each element slides grossly, over all strokes that do.

    Raises:
        ValueError: if no whole number of steps makes a sample, or the hand never slides.
    """

    def __init__(self, scene: Scene, grasp: Grasp) -> None:
        self._scene, self._grasp, self._traces = scene, grasp, _scene_traces(scene)
        rest = quasi_static_slips(grasp, scene.slides)
        start_s, end_s = np.full_like(rest.start_s, np.nan), np.full_like(rest.end_s, np.nan)
        load = grasp.load_n[grasp.touching]
        for number, trace in enumerate(self._traces):
            start_s[number, grasp.touching] = trace.start_s
            end_s[number, grasp.touching] = trace.end_s
            sliding = load[np.isfinite(trace.start_s)].sum() / load.sum()
            if sliding < 0.5:  # its onset would not exist
                raise ValueError(
                    f"stroke {number + 1} never slides: elements that carry {100 * sliding:.0f} % "
                    "of the load let go, 50 % must; give it more travel or less friction"
                )
        self.slips = replace(rest, start_s=start_s, end_s=end_s)

    def element(self, element: int, grid: Grid, motion: Motion) -> ElementContact:
        """A touching element's contact: see ``_KinematicContact.element``."""
        grasp, history = self._grasp, motion.grid
        lane = int(np.searchsorted(grasp.touching, element))
        normal_n = grasp.normal_n(element, motion.position_mm, history.time_s)
        friction_n, slide, inertia_n = history.zeros(), grid.zeros(), grid.zeros()
        places = ((friction_n, history), (inertia_n, grid), (slide, grid))
        for trace in self._traces:
            stop_s, next_s = trace.stroke.stroke.stop_s, trace.stroke.next_s
            rows = history.overlapping(stop_s, next_s)
            t = history.time_s[rows]
            rest_n = grasp.mu_s * normal_n[rows] * grasp.shear_after
            rest_n *= grasp.relaxed(np.maximum(t - stop_s, 0.0), element)
            np.copyto(friction_n[rows], rest_n, where=(t >= stop_s) & (t <= next_s))
            for (out, own), values in zip(places, trace.values[..., lane], strict=True):
                _blend(out, own, trace.stroke, values)
        release_v = self._scene.dynamics.release_v_per_n * inertia_n
        return ElementContact(normal_n, friction_n, slide, release_v)


Contacts = _KinematicContact | _BristleContact
"""Either model of a recording's contact."""


def scene_contact(scene: Scene, grasp: Grasp) -> Contacts:
    """The contact of a scene by its fidelity."""
    model = _KinematicContact if scene.fidelity == "kinematic" else _BristleContact
    return model(scene, grasp)


def _blend(out: Array, grid: Grid, stroke: _Stroke, values: NDArray[np.float32]) -> None:
    """Put a stroke's samples in their places, fading into what is there over the settling."""
    first, num, rate_hz = stroke.first, stroke.num, grid.sample_rate_hz
    rows = grid.overlapping(first / rate_hz, (first + num) / rate_hz)
    sample = grid.blocks[rows, None] * grid.block_samples + np.arange(grid.block_samples)
    place = sample - first
    settled = (grid.time_s[rows] - stroke.stroke.stop_s) / max(stroke.settling_s, 1e-9)
    weight = np.where((place >= 0) & (place <= num), 1.0 - smooth_step(settled), 0.0)
    out[rows] += weight * (values[np.clip(place, 0, num)] - out[rows])


# --- strokes, integrated ------------------------------------------------------------------------


def _lanes_of(scene: Scene, grasp: Grasp) -> Lanes:
    """Skin and bristles of every touching element, ``[E]``.

    ``mu_s N0`` over the presliding travel is the stiffness of skin and bristles in series; the
    bristles take ``bristle_share`` of the travel, a single one what its stiffness leaves it.
    Resonance and damping ratio give mass and damping of the skin, its relaxation which part
    of it is a Maxwell arm. Part of the damping goes with friction, as what feeds stick-slip does:
    a damping ratio alone is too little for some skins or too much for others.
    """
    dynamics, material = scene.dynamics, grasp.material
    touching = grasp.touching
    static_n = grasp.friction_n[touching]
    series_n_m = static_n / (1e-3 * grasp.presliding_mm[touching])
    fraction = np.full(len(touching), dynamics.bristle_share)
    if dynamics.num_bristles == 1:
        fraction = np.minimum(series_n_m / dynamics.bristle_stiffness_n_m, fraction)
    bristles, skin = series_n_m / fraction, series_n_m / (1.0 - fraction)
    omega = 2 * np.pi * grasp.resonance_hz[touching]
    mass = skin / omega**2
    relaxing = np.minimum(grasp.relaxation[touching], 1.0 - _LEAST_STIFFNESS)
    damping = 2.0 * (dynamics.sliding_damping + grasp.damping[touching]) * mass * omega
    fast_ratio = grasp.mu_ratio  # far above the Stribeck speed
    if material.fast_ratio is not None and scene.contact.mu_k is None:
        fast_ratio = np.interp(grasp.mu_ratio, material.mu_ratio, material.fast_ratio)
    same = np.ones(len(touching))
    columns = {
        "mass_kg": mass,
        "stiffness_n_m": (1.0 - relaxing) * skin,
        "relaxing_n_m": relaxing * skin,
        "relaxation_time_s": grasp.relaxation_time_s[touching],
        "damping_n_s_m": damping + dynamics.sliding_damping_s_m * static_n,
        "mu_s": grasp.mu_s * same,
        "mu_k": fast_ratio * grasp.mu_s * same,
        "stribeck_m_s": 1e-3 * material.stribeck_mm_s * same,
        "bristle_stiffness_n_m": bristles,
        "bristle_damping_n_s_m": 2.0 * dynamics.bristle_damping * np.sqrt(bristles * mass),
        "viscous_n_s_m": dynamics.viscous_n_s_m * same,
        "pressure": hertz_pressure(int(dynamics.num_bristles)).numpy(),
    }
    return Lanes(**{name: torch.from_numpy(column) for name, column in columns.items()})


@dataclass(frozen=True, eq=False)
class _Stroke:
    """One stroke of one recording that slides, to be integrated.

    Args:
        scene: of the recording.
        grasp: how the hand touches.
        stroke: as the arm runs it.
        next_s: when the next one that slides starts; infinite for the last.
        shear: of the touching elements as the stroke starts, as a fraction of ``mu_s N``, ``[E]``.
    """

    scene: Scene
    grasp: Grasp
    stroke: ArmStroke
    next_s: float
    shear: Array

    @cached_property
    def settling_s(self) -> float:
        """How long it is integrated on behind its end."""
        return min(_SETTLING_S, self.next_s - self.stroke.stop_s)

    @cached_property
    def first(self) -> int:
        """The sample at which or before which it starts."""
        return math.floor(self.stroke.start_s * self.scene.sample_rate_hz)

    @cached_property
    def num(self) -> int:
        """Samples behind the first."""
        end_s = self.stroke.stop_s + self.settling_s
        return math.ceil(end_s * self.scene.sample_rate_hz) - self.first

    def drive(self, since_s: Array) -> tuple[Array, Array]:
        """The arm's speed in m/s and the elements' loads in N, at times from the first sample.

        Shape:
            - since_s: ``[n]``
            - output: ``[n, E]`` each
        """
        time_s = self.first / self.scene.sample_rate_hz + since_s[:, None]
        position_mm = self.stroke.origin_mm + self.stroke.travel_mm(time_s)
        load_n = self.grasp.normal_n(self.grasp.touching, position_mm, time_s)
        return np.broadcast_to(1e-3 * self.stroke.speed_mm_s(time_s), load_n.shape), load_n


class _StrokeTrace(NamedTuple):
    """One stroke of the touching elements of a recording, integrated, at its samples.

    Attributes:
        stroke: which.
        values: friction, what the skin transmits, and inertia of the skin, newtons; slip speed
            over the arm's, 0 where it slips back or the arm rests, ``[3, num + 1, E]``.
        start_s: when gross sliding begins, NaN where it never does, ``[E]``.
        end_s: when it ends for good, ``[E]``.
    """

    stroke: _Stroke
    values: NDArray[np.float32]
    start_s: Array
    end_s: Array


def _strokes_of(scene: Scene) -> list[_Stroke]:
    """The strokes of a scene that slide, ready to be integrated."""
    grasp = draw_grasp(scene)
    before = quasi_static_slips(grasp, scene.slides).shear_before[:, grasp.touching]
    pairs = zip(_with_next_starts(scene.slides), before, strict=True)
    return [_Stroke(scene, grasp, stroke, next_s, shear) for (stroke, next_s), shear in pairs]


def _steps_per_sample(scene: Scene) -> int:
    """How many steps of the integration make a sample.

    Raises:
        ValueError: if that is not a whole number.
    """
    sample_us = 1e6 / scene.sample_rate_hz
    steps = round(sample_us / scene.dynamics.step_us)
    if steps < 1 or abs(steps * scene.dynamics.step_us - sample_us) > 1e-6 * sample_us:
        raise ValueError(
            f"a whole number of steps must make a sample, got dynamics.step_us="
            f"{scene.dynamics.step_us:g} at sample_rate_hz={scene.sample_rate_hz:g} "
            f"({sample_us:g} us); take {sample_us / max(steps, 1):g}"
        )
    return steps


@lru_cache(maxsize=_RECORDINGS_KEPT)
def _scene_traces(scene: Scene) -> tuple[_StrokeTrace, ...]:
    """Every stroke that slides; of the last few scenes, as a timeline and samples need them.

    Raises:
        ValueError: if no whole number of steps makes a sample.
    """
    return tuple(map(_integrated, _strokes_of(scene)))


def _integrated(stroke: _Stroke) -> _StrokeTrace:
    """A stroke of the touching elements, side by side."""
    scene = stroke.scene
    every, rate_hz = _steps_per_sample(scene), scene.sample_rate_hz
    step_s, lanes = 1.0 / (rate_hz * every), _lanes_of(scene, stroke.grasp)

    def drive(since_s: Array) -> list[torch.Tensor]:
        """Arm and load of all lanes, ``[n, E]``."""
        return [torch.from_numpy(np.ascontiguousarray(of)) for of in stroke.drive(since_s)]

    _, load_n = drive(np.zeros(1))
    shear_n = torch.from_numpy(stroke.shear) * lanes.mu_s * load_n[0]
    state, pieces = LaneState.sticking(lanes, shear_n), []
    for first in range(0, stroke.num, _SAMPLES_AT_ONCE):
        num_steps = every * (min(first + _SAMPLES_AT_ONCE, stroke.num) - first)
        arm, load = drive(stage_times_s(num_steps, step_s, first * every).numpy())
        trace, state = integrate(lanes, state, arm, load, step_s, every)
        pieces.append(torch.stack(trace).numpy())
    start = np.stack([shear_n.numpy(), *np.zeros((2, len(shear_n)))])
    whole = np.concatenate([start[:, None], *pieces], axis=1)  # friction, inertia, slip
    return _trace(stroke, whole)


def _trace(stroke: _Stroke, values: Array) -> _StrokeTrace:
    """What is kept of a stroke's friction, inertia and slip speed, ``[3, num + 1, E]``."""
    slip, rate_hz = values[2], stroke.scene.sample_rate_hz
    arm, _ = stroke.drive(np.arange(stroke.num + 1) / rate_hz)
    least_m_s = _MOVING_FRACTION * 1e-3 * stroke.stroke.peak_mm_s
    moves = arm > least_m_s
    excess = np.where(moves, slip - _GROSS_FRACTION * arm, -np.abs(slip))
    relative = np.where(moves, np.maximum(slip / np.maximum(arm, least_m_s), 0.0), 0.0)
    kept = np.stack([*values[:2], relative]).astype(np.float32)
    return _StrokeTrace(
        stroke, kept, *(t + stroke.first / rate_hz for t in _gross(excess, rate_hz))
    )


def _gross(excess: Array, rate_hz: float) -> tuple[Array, Array]:
    """First and last time at which elements slide grossly, between samples by straight lines.

    Args:
        excess: of the slip speed over the threshold, ``[num + 1, E]``.
        rate_hz: of the samples.
    """
    lanes, is_gross = np.arange(excess.shape[1]), excess > 0
    padded = np.concatenate([excess, np.zeros((1, len(lanes)))])

    def crossing(inside: NDArray[np.int64], outside: NDArray[np.int64]) -> Array:
        """From the sample inside towards that outside, in seconds."""
        high, low = padded[inside, lanes], padded[outside, lanes]
        with np.errstate(invalid="ignore", divide="ignore"):
            place = inside + (outside - inside) * high / (high - low)
        return np.where(is_gross.any(0), place / rate_hz, np.nan)

    begins, ends = is_gross.argmax(0), len(excess) - 1 - is_gross[::-1].argmax(0)
    return crossing(begins, begins - 1), crossing(ends, ends + 1)
