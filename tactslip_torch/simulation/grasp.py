"""How the hand touches: what is drawn of a session and a recording, and the quasi-static contact.

A *session* is one mounting of one material (the paper confounds the two): load shares, gains,
noise floor, mains, offsets, the material's own friction and texture. A *recording* grasps anew:
shares, lifted elements, presliding, offsets vary again, and less. An *element* is a segment of a
finger, with all the channels in it. Every draw is made for the whole hand, whichever channels
are asked for.

While an element sticks, the arm's travel stretches its skin and the friction force grows in
proportion. At ``mu_s N`` it lets go, falls to ``mu_k N`` and slides until, shortly before the arm
stops, the remaining travel is taken up by the skin again. Over the pause the shear relaxes;
the next stroke starts with what is left and needs only the rest of the presliding travel.
PHYSICS.md, friction and skin; the rules are those of a Coulomb slider behind a spring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.blocks import Array, generator, log_uniform, lognormal
from tactslip_torch.simulation.parameters import MATERIALS, Material
from tactslip_torch.simulation.scene import ArmStroke, Scene

MAX_PRESLIDING_FACTOR = 1.5
"""Largest factor of an element's presliding travel on the recording's (``Scene`` relies on it)."""

RESTICK_SHARE = 0.5
"""Share of the shear lost at letting go that the skin takes up again as the arm stops (ours)."""

RUNOUT_PERIOD_MM = 180.0
"""Travel over which the normal load rises and falls (prior, ours)."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The material as this session has it.

    Args:
        material: its row of the table.
        mu_s: static friction of the recording.
        mu_ratio: kinetic over static friction.
        texture_mv: rms of the texture's vibration at 40 mm/s and 1 N.
        texture_exponent: power of speed it grows with, .5 to 1.
        spectral_exponent: ``a`` of the height's power spectrum ``k^-a``, 1.5 to 3.
        wavelength_mm: dominant wavelength, or ``None``.
    """

    material: Material
    mu_s: float
    mu_ratio: float
    texture_mv: float
    texture_exponent: float
    spectral_exponent: float
    wavelength_mm: float | None


def _surface(scene: Scene) -> Surface:
    """The material's parameters: per session, friction a little per recording too."""
    material, contact = MATERIALS[scene.material], scene.contact
    rng = generator(*scene.session_key("surface"), scene.material)
    session_mu, again = rng.standard_normal(), generator(*scene.key("mu"))
    mu_s = material.mu_s * float(
        np.exp(contact.friction_spread * (session_mu + 0.2 * again.standard_normal()))
    )
    ratio = float(rng.uniform(*material.mu_ratio))
    roughness = log_uniform(rng, material.ra_um) / float(np.sqrt(np.prod(material.ra_um)))
    texture_exponent, spectral_exponent = rng.uniform(0.5, 1.0), rng.uniform(1.5, 3.0)
    wavelength = material.wavelength_mm and log_uniform(rng, material.wavelength_mm)
    if contact.mu_s is not None:
        mu_s = contact.mu_s
    if contact.mu_k is not None:
        mu_s = max(mu_s, contact.mu_k)  # one drawn below it would lower what was asked for
        ratio = contact.mu_k / mu_s
    return Surface(
        material=material,
        mu_s=mu_s,
        mu_ratio=ratio,
        texture_mv=material.texture_mv * contact.texture_scale * roughness**0.5,
        texture_exponent=float(texture_exponent),
        spectral_exponent=float(spectral_exponent),
        wavelength_mm=wavelength,
    )


@dataclass(frozen=True, eq=False)
class Grasp:
    """How the hand touches in one recording; arrays over its E elements.

    Args:
        element_of_channel: element of every channel, ``[C]``.
        load_n: normal force, 0 where an element does not touch, ``[E]``.
        presliding_mm: travel that stretches the fresh skin until it lets go, ``[E]``.
        relaxation: share of shear that a long pause relaxes, ``[E]``.
        relaxation_time_s: its time constant, ``[E]``.
        resonance_hz: the skin's resonance, ``[E]``.
        damping: its damping ratio, ``[E]``.
        runout: relative change of load along the travel.
        runout_phase: radians, ``[E]``.
        surface: what it touches.
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
    surface: Surface

    @property
    def touching(self) -> NDArray[np.int64]:
        """Elements in contact."""
        return np.flatnonzero(self.load_n > 0)

    @property
    def friction_n(self) -> Array:
        """Friction at which each element lets go, ``[E]``."""
        return self.surface.mu_s * self.load_n

    @property
    def shear_after(self) -> float:
        """Shear when the arm has stopped after a slide, as a share of ``mu_s N``."""
        ratio = self.surface.mu_ratio
        return ratio + RESTICK_SHARE * (1.0 - ratio)

    def normal_n(
        self, element: int | NDArray[np.int64], position_mm: Array, time_s: Array
    ) -> Array:
        """Load in newtons: the surface's run-out over travel, and creep after the grasp.

        Shape:
            - position_mm, time_s, output: any one shape; with several elements ``[E]`` the times
              are ``[*, 1]`` and the output is ``[*, E]``
        """
        angle = 2 * np.pi / RUNOUT_PERIOD_MM * position_mm
        runout = self.runout * np.sin(angle + self.runout_phase[element])
        since_grasp_s = np.maximum(time_s, 0.0) + 1.0
        creep = np.exp(-since_grasp_s / (5.0 * self.relaxation_time_s[element]))
        normal_n: Array = (
            self.load_n[element] * (1.0 + runout) * (1.0 + 0.3 * self.relaxation[element] * creep)
        )
        return normal_n

    def relaxed(self, rest_s: Array, element: int | slice = slice(None)) -> Array:
        """Share of the shear left after a rest."""
        decay = -np.expm1(-rest_s / self.relaxation_time_s[element])
        return np.asarray(1.0 - self.relaxation[element] * decay, dtype=np.float64)


def draw_grasp(scene: Scene) -> Grasp:
    """The recording's contact. At least one element touches: the one nearest to touching."""
    contact, element_of_channel, loads = scene.contact, *_elements(scene)
    num = len(loads)
    session, rng = generator(*scene.session_key("contact")), generator(*scene.key("g"))
    loads = loads * lognormal(session, contact.session_share_spread, num)
    loads = loads * lognormal(rng, contact.recording_share_spread, num)
    chance = np.where(loads > 0, rng.random(num), -1.0)
    down = (chance >= contact.lifted_fraction) | (chance == chance.max())
    factor = np.clip(
        lognormal(rng, contact.presliding_spread, num),
        1 / MAX_PRESLIDING_FACTOR,
        MAX_PRESLIDING_FACTOR,
    )
    low, high = contact.relaxation
    middle_hz = log_uniform(session, contact.skin_resonance_hz)
    return Grasp(
        element_of_channel=element_of_channel,
        load_n=np.where(down & (loads > 0), loads, 0.0),
        presliding_mm=log_uniform(rng, contact.presliding_mm) * factor,
        relaxation=low + (high - low) * rng.random(num),
        relaxation_time_s=np.full(num, log_uniform(rng, contact.relaxation_time_s)),
        resonance_hz=middle_hz * lognormal(session, 0.1, num),
        damping=np.full(num, log_uniform(session, contact.skin_damping)),
        runout=contact.runout,
        runout_phase=2 * np.pi * rng.random(num),
        surface=_surface(scene),
    )


def _elements(scene: Scene) -> tuple[NDArray[np.int64], Array]:
    """Every channel's element, and every element's nominal load (0 where it may not touch)."""
    contact = scene.contact
    finger_loads = dict(contact.finger_loads)
    places = [(channel.finger, channel.segment) for channel in scene.hand.channels]
    order = list(dict.fromkeys(places))
    allowed = set(
        places
        if contact.touching is None
        else [
            place
            for place, name in zip(places, scene.hand.names, strict=True)
            if name in contact.touching
        ]
    )
    loads = [contact.load_n * finger_loads.get(p[0], 1.0) * (p in allowed) for p in order]
    return np.array([order.index(place) for place in places]), np.array(loads)


@dataclass(frozen=True, eq=False)
class Slips:
    """Every slip of every element; arrays over S strokes that slide and E elements.

    One slip a stroke: where an element sticks and slips, from the first letting go to the last
    sticking, the stick phases between included.

    Args:
        start_s: when the element lets go, ``[S, E]``; NaN for elements that do not touch.
        end_s: when it sticks again for good, ``[S, E]``.
        shear_before: quasi-static shear at the start of each stroke, as a share of ``mu_s N``,
            ``[S, E]``.
    """

    start_s: Array
    end_s: Array
    shear_before: Array


def quasi_static_slips(grasp: Grasp, plan: tuple[ArmStroke, ...]) -> Slips:
    """When each element lets go and sticks again, over a plan of strokes that slide."""
    shape = (len(plan), len(grasp.load_n))
    start_s, end_s, before = np.empty(shape), np.empty(shape), np.zeros(shape)
    restick_mm = (grasp.shear_after - grasp.surface.mu_ratio) * grasp.presliding_mm
    for number, stroke in enumerate(plan):
        if number:
            pause_s = stroke.start_s - plan[number - 1].stop_s
            before[number] = grasp.shear_after * grasp.relaxed(np.asarray(pause_s))
        travel_mm = (1.0 - before[number]) * grasp.presliding_mm
        start_s[number] = stroke.time_of_travel_s(travel_mm)
        end_s[number] = stroke.time_of_travel_s(stroke.distance_mm - restick_mm)
    lifted = grasp.load_n <= 0
    start_s[:, lifted] = end_s[:, lifted] = np.nan
    return Slips(start_s, end_s, before)
