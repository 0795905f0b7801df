"""What a session and a recording are, drawn once: the contact's and the sensors' parameters.

A *session* is one mounting of one material (the paper confounds the two): load shares, gains,
noise floor, mains, offsets, the material's own friction and texture. A *recording* grasps anew:
shares, lifted elements, presliding, offsets vary again, and less. An *element* is a segment of a
finger, with all the channels in it. Every draw is made for the whole hand, whichever channels
are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.materials import MATERIALS, Material
from tactslip_torch.simulation.randomness import Array, Key, generator, log_uniform, lognormal
from tactslip_torch.simulation.scene import PAPER, Scene

MAX_PRESLIDING_FACTOR = 1.5
"""Largest factor of an element's presliding travel on the recording's (``Scene`` relies on it)."""


def session_key(scene: Scene, purpose: str) -> Key:
    """The key of a draw that all recordings of a session share."""
    return (scene.seed, "session", _session(scene), purpose)


def recording_key(scene: Scene, purpose: str) -> Key:
    """The key of a draw that belongs to one recording."""
    kind = () if scene.name == PAPER else (scene.name,)
    return (scene.seed, "recording", _session(scene), scene.material, scene.cycle, *kind, purpose)


def _session(scene: Scene) -> str | int:
    """The session's name; a scene always has one."""
    return scene.material if scene.session is None else scene.session


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


def draw_surface(scene: Scene) -> Surface:
    """The material's parameters: per session, friction a little per recording too."""
    material, contact = MATERIALS[scene.material], scene.contact
    rng = generator(*session_key(scene, "surface"), scene.material)
    session_mu, again = rng.standard_normal(), generator(*recording_key(scene, "mu"))
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


def draw_grasp(scene: Scene) -> Grasp:
    """The recording's contact. At least one element touches: the one nearest to touching."""
    contact, element_of_channel, loads = scene.contact, *_elements(scene)
    num = len(loads)
    session, rng = generator(*session_key(scene, "contact")), generator(*recording_key(scene, "g"))
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
        runout_phase=2 * np.pi * rng.random(num),
        surface=draw_surface(scene),
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
