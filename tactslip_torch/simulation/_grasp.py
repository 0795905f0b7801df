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

from tactslip_torch.simulation._blocks import Array, generator, log_uniform, lognormal
from tactslip_torch.simulation.parameters import MATERIALS, Material
from tactslip_torch.simulation.scene import MAX_PRESLIDING_FACTOR, ArmStroke, Scene

_RESTICK_FRACTION = 0.5  # of the shear lost at letting go, taken up as the arm stops (ours)
_RUNOUT_PERIOD_MM = 180.0  # travel over which the load rises and falls (prior, ours)


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
        """Shear when the arm has stopped after a slide, as a fraction of ``mu_s N``."""
        ratio = self.surface.mu_ratio
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
        surface=_surface(scene),
    )


def _surface(scene: Scene) -> Surface:
    """The material as this session has it; its friction varies a little per recording too."""
    material, contact = MATERIALS[scene.material], scene.contact
    rng = generator(*scene.session_key("surface"), scene.material)
    deviation = rng.standard_normal() + 0.2 * generator(*scene.key("mu")).standard_normal()
    mu_s = material.mu_s * float(np.exp(contact.friction_spread * deviation))
    mu_ratio = float(rng.uniform(*material.mu_ratio))
    roughness = log_uniform(rng, material.ra_um) / np.sqrt(np.prod(material.ra_um))
    texture_exponent, spectral_exponent = rng.uniform(0.5, 1.0), rng.uniform(1.5, 3.0)
    wavelength_mm = material.wavelength_mm and log_uniform(rng, material.wavelength_mm)
    if contact.mu_s is not None:
        mu_s = contact.mu_s
    if contact.mu_k is not None:
        mu_s = max(mu_s, contact.mu_k)  # one drawn below it would lower what was asked for
        mu_ratio = contact.mu_k / mu_s
    return Surface(
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
    restick_mm = (grasp.shear_after - grasp.surface.mu_ratio) * grasp.presliding_mm
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
