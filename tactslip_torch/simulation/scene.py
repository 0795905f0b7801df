"""Scenes: everything that determines one simulated recording, and how its arm moves.

Every ``*_spread`` is the standard deviation of the logarithm of a factor of median 1. Times are in
seconds from the start of the recording, positions in millimetres from where the arm was then. Three
parameters were calibrated once on test accuracy of seen materials (``calibrated.json``).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import check_number
from tactslip_torch.simulation._blocks import Array, Grid, Key

# --- calibrated parameters ----------------------------------------------------------------------

CALIBRATED_PATH = Path(__file__).parent / "calibrated.json"
"""The frozen values, part of the package."""


def _read_calibrated() -> dict[str, Any]:
    """The frozen values: numbers, and ``(low, high)`` for a range."""
    values = json.loads(CALIBRATED_PATH.read_text(encoding="utf-8"))["values"]
    return {
        name: tuple(map(float, value)) if isinstance(value, list) else float(value)
        for name, value in values.items()
    }


_CALIBRATED = _read_calibrated()

# --- groups of parameters -----------------------------------------------------------------------


@dataclass(frozen=True)
class _Parameters:
    """A group of parameters: lists become tuples, numbers are checked, ranges are in order."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, list):
                value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
                object.__setattr__(self, each.name, value)
            if isinstance(value, int | float):
                fine = math.isfinite(value) and value >= 0
                self._require(each.name, fine, "finite and not negative")
            elif isinstance(value, tuple) and "tuple[float, float]" in str(each.type):
                fine = len(value) == 2 and 0 < value[0] <= value[1] < math.inf
                self._require(each.name, fine, "(low, high), 0 < low <= high")

    def _require(self, name: str, holds: bool, wanted: str) -> None:
        if not holds:
            where, value = type(self).__name__, getattr(self, name)
            raise ValueError(f"{where}.{name} must be {wanted}, got {value!r}")


Moves = Literal["hand", "object", "both"]


@dataclass(frozen=True)
class Stroke(_Parameters):
    """One straight movement after a pause.

    Args:
        speed_mm_s: steady speed.
        distance_mm: travel from rest to rest.
        pause_s: rest before the stroke.
        moves: ``"hand"``: the arm draws the hand over the resting object, as in the paper.
            ``"object"``: the object is pulled along the resting hand; it slides and no motor runs.
            ``"both"``: the arm carries the hand with the object; motors run and nothing slides.

    Raises:
        ValueError: if speed or distance is not positive, the pause negative, or ``moves`` unknown.
    """

    speed_mm_s: float
    distance_mm: float = 100.0
    pause_s: float = 2.0
    moves: Moves = "hand"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("speed_mm_s", self.speed_mm_s > 0, "positive")
        self._require("distance_mm", self.distance_mm > 0, "positive")
        known = get_args(Moves)
        self._require("moves", self.moves in known, f"one of {', '.join(known)}")

    @property
    def slides(self) -> bool:
        """Whether hand and object move against each other."""
        return self.moves != "both"


PAPER_FINGER_LOADS = (
    ("little", 0.6),
    ("ring", 0.8),
    ("middle", 0.8),
    ("index", 2.0),
    ("thumb", 0.6),
)
"""Relative normal load of each finger; fingers not named here carry 1."""


@dataclass(frozen=True)
class Contact(_Parameters):
    """How the hand touches, and what sliding does to the skin.

    Args:
        load_n: median normal force of an element on a finger of relative load 1 (prior, ours).
        finger_loads: ``(finger, relative load)`` pairs.
        session_share_spread: spread of the elements' load shares between sessions.
        recording_share_spread: the same between recordings of a session.
        lifted_fraction: probability that an element does not touch in a recording.
        touching: names of channels whose elements may touch; ``None`` for all. An element is a
            segment of a finger with all its channels.
        mu_s: static friction instead of the material's prior, without spread.
        mu_k: kinetic friction instead of the material's prior, without spread. A ``mu_s`` that
            is drawn is raised to it where it falls below.
        friction_spread: spread of ``mu_s`` between sessions (prior, ours; a fifth of it between
            recordings).
        presliding_mm: *calibrated.* Range of the travel that stretches the skin before a fresh
            contact lets go; log-uniform, drawn per recording.
        presliding_spread: spread of that travel between the elements of a recording (prior,
            ours), cut at a factor 1.5.
        relaxation: range of the share of shear that a long pause relaxes, at most 1.
        relaxation_time_s: range of its time constant.
        recoil_s: time constant of the shear's fall from static to kinetic (prior, ours). On the
            kinematic fidelity alone: bristles integrate that fall.
        friction_noise_mv: *calibrated.* Broadband friction noise of every sliding element, rms
            in a fast channel for mu = 1, 1 N and 40 mm/s.
        friction_noise_exponent: power of speed it grows with.
        friction_noise_low_share: share of its power below 25 Hz.
        texture_scale: factor on every material's texture (prior, ours).
        onset_pulse_v: first swing of a fast channel's burst when an element lets go, per newton of
            friction. On kinematic fidelity alone: see ``Dynamics.release_v_per_n``.
        slide_rise_s: time constant with which an element that let go reaches the speed between
            hand and object (ours): longer for a slip that fades in. On kinematic fidelity alone.
        runout: relative change of normal load along the travel.
        skin_resonance_hz: range of the skin's resonance, drawn per session.
        skin_damping: range of its damping ratio (prior, ours).

    Raises:
        ValueError: if a parameter is negative or not finite, ``mu_k`` exceeds ``mu_s``, or no
            element could touch.
    """

    load_n: float = 1.0
    finger_loads: tuple[tuple[str, float], ...] = PAPER_FINGER_LOADS
    session_share_spread: float = 0.3
    recording_share_spread: float = 0.3
    lifted_fraction: float = 0.1
    touching: tuple[str, ...] | None = None
    mu_s: float | None = None
    mu_k: float | None = None
    friction_spread: float = 0.2
    presliding_mm: tuple[float, float] = _CALIBRATED["presliding_mm"]
    presliding_spread: float = 0.2
    relaxation: tuple[float, float] = (0.1, 0.3)
    relaxation_time_s: tuple[float, float] = (0.2, 2.0)
    recoil_s: float = 0.008
    friction_noise_mv: float = _CALIBRATED["friction_noise_mv"]
    friction_noise_exponent: float = 0.75
    friction_noise_low_share: float = 0.3
    texture_scale: float = 1.0
    onset_pulse_v: float = 0.5
    slide_rise_s: float = 0.004
    runout: float = 0.04
    skin_resonance_hz: tuple[float, float] = (40.0, 100.0)
    skin_damping: tuple[float, float] = (0.1, 0.3)

    def __post_init__(self) -> None:
        super().__post_init__()
        static, kinetic = self.mu_s, self.mu_k
        self._require("mu_s", static is None or static > 0, "positive")
        if static is not None and kinetic is not None and kinetic > static:
            raise ValueError(
                f"Contact.mu_k must not exceed mu_s, got mu_k={kinetic} and mu_s={static}"
            )
        loads = all(0 <= load < math.inf for _, load in self.finger_loads)
        self._require("finger_loads", loads, "finite and not negative")
        for name in ("recoil_s", "slide_rise_s"):
            self._require(name, getattr(self, name) > 0, "positive")
        self._require("friction_noise_low_share", self.friction_noise_low_share <= 1, "at most 1")
        self._require("runout", self.runout <= 1, "at most 1")
        self._require("relaxation", self.relaxation[1] <= 1, "at most 1")
        none = "or no element is in contact"
        self._require("load_n", self.load_n > 0, f"positive, {none}")
        self._require("lifted_fraction", self.lifted_fraction < 1, f"below 1, {none}")
        self._require("touching", self.touching != (), f"null or some channels, {none}")


@dataclass(frozen=True)
class Sensors(_Parameters):
    """The sensing elements and their front end.

    Args:
        white_noise_mv: rms of each channel's white noise.
        white_noise_session_spread: its spread between sessions.
        gain_spread: spread of the channels' gains between sessions (a third between recordings).
        sg_preload_v_per_n: volts of a slow channel per newton of normal force (prior, ours).
        sg_shear_v_per_n: volts of a slow channel per newton of friction (prior, ours).
        sg_session_offset_v: spread of slow channels' offsets between sessions (prior, ours).
        sg_offset_v: spread of slow channels' offsets between recordings, from grasping again.
        sg_drift_mv: size of a slow channel's drift (prior, ours).
        pvdf_shear_v_per_n: volts of a fast channel per newton of friction, before the high-pass
            (prior, ours).
        pvdf_highpass_hz: corner of the film and its amplifier (6.6 Hz at 10 MOhm, MSI
            manual), at least 2 Hz.
        pvdf_offset_mv: largest offset behind the high-pass; keep it at or below 2 mV.
        pvdf_drift_mv: size of a fast channel's (pyroelectric) drift.
        warming_mv: how far a slow channel's zero moves over the recording as the hand warms up,
            with a sign and size of its own in every channel; a fast one moves a fiftieth of it.
        gain: of the front end, on all that a channel has before its converter, noise included.
        num_bits: of the converter.
        rail_v: the converter's range is plus and minus this.

    Raises:
        ValueError: if a parameter is negative or not finite, or the converter has no range.
    """

    white_noise_mv: float = 1.0
    white_noise_session_spread: float = 0.5
    gain_spread: float = 0.3
    sg_preload_v_per_n: float = 0.2
    sg_shear_v_per_n: float = 0.3
    sg_session_offset_v: float = 0.3
    sg_offset_v: float = 0.5
    sg_drift_mv: float = 3.0
    pvdf_shear_v_per_n: float = 0.05
    pvdf_highpass_hz: float = 6.6
    pvdf_offset_mv: float = 2.0
    pvdf_drift_mv: float = 1.0
    warming_mv: float = 0.0
    gain: float = 1.0
    num_bits: int = 16
    rail_v: float = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("num_bits", 2 <= self.num_bits <= 32, "2 to 32")
        for name in ("gain", "rail_v"):
            self._require(name, getattr(self, name) > 0, "positive")
        wanted = "at least 2, for slower ones outlast a block of a quarter second"
        self._require("pvdf_highpass_hz", self.pvdf_highpass_hz >= 2, wanted)


@dataclass(frozen=True)
class Disturbances(_Parameters):
    """What is in the recording but is not slip.

    Args:
        mains_mv: amplitude of the mains' fundamental, the session's median (prior, ours: at
            4 to 10 mV would exceed the 1.5 to 4 mV rms of rest).
        mains_session_spread: its spread between sessions.
        mains_hz: nominal frequency; harmonics up to the ninth share a common phase.
        arm_transient_mv: ringing of the arm's modes at each start and stop, in every channel.
        motor_vibration_mv: rms of the vibration felt in every channel while the arm moves, at
            40 mm/s. In the paper's data slip *is* arm motion, so this one alone can tell slip.
            A pair is a range, drawn per recording, log-uniform.
        mains_bursts_per_s: intervals of a tenth to a whole second in which the mains is stronger
            (a welder, a lift).
        mains_burst_mv: added amplitude of the fundamental in them, with its harmonics.
        machine_mv: vibration of a neighbouring machine, rms, felt in every channel, in intervals
            that start and stop with the machine.
        machine_hz: range of its rotation; it has harmonics (prior, ours).
        burst_rate_hz: *calibrated.* Random bursts (knocks) a second.
        burst_mv: their size.
        label_jitter_ms: standard deviation of a person's onset marks, cut at three times that.

    Raises:
        ValueError: if a parameter is negative or not finite, or a range empty.
    """

    mains_mv: float = 3.0
    mains_session_spread: float = 0.7
    mains_hz: float = 50.0
    arm_transient_mv: float = 50.0
    motor_vibration_mv: float | tuple[float, float] = 1.0
    mains_bursts_per_s: float = 0.0
    mains_burst_mv: float = 50.0
    machine_mv: float = 0.0
    machine_hz: tuple[float, float] = (12.0, 60.0)
    burst_rate_hz: float = _CALIBRATED["burst_rate_hz"]
    burst_mv: float = 30.0
    label_jitter_ms: float = 15.0


@dataclass(frozen=True)
class Handling(_Parameters):
    """Loads on the contact that are not slip. All priors are ours.

    Args:
        carried_kg: mass of the object that moves with the hand (strokes that move ``"both"``);
            its inertia loads the contact with shear, shared among elements by normal load.
        weight_share: of static friction, what the object's weight takes while it is in the air: the
            first stroke that moves ``"both"`` lifts it off a surface, the next one puts it down,
            and so on. 0: it is never put down, and its weight is no change.
        lift_s: how long the weight takes to come and to go, from the begin of the stroke.
        taps_per_s: knocks of the object on the hand a second, at rest and in strokes that move
            ``"both"``, never while the contact slides.
        tap_n: range of a tap's peak force on an element of relative load 1; log-uniform.
        tap_ms: range of a tap's duration, a half sine; log-uniform.
        grips_per_s: changes of grip a second, where taps may be: the normal load rises, stays
            and falls back, never below what it was, so that a contact that sticks sticks on.
        grip_share: range of the rise over the load; log-uniform.
        grip_s: range of its duration with both ramps, which take a quarter each; log-uniform.
        loosenings_per_s: changes of grip a second in which the normal load falls and rises back,
            as long as ``grip_s``; never so far that a contact that sticks would slip.
        loosening_share: range of the fall over the load, below 1; log-uniform.

    Raises:
        ValueError: if a parameter is negative or not finite, or a grip may let go of all load.
    """

    carried_kg: float = 0.2
    weight_share: float = 0.0
    lift_s: float = 0.05
    taps_per_s: float = 0.0
    tap_n: tuple[float, float] = (0.2, 2.0)
    tap_ms: tuple[float, float] = (5.0, 40.0)
    grips_per_s: float = 0.0
    grip_share: tuple[float, float] = (0.1, 1.0)
    grip_s: tuple[float, float] = (0.2, 1.0)
    loosenings_per_s: float = 0.0
    loosening_share: tuple[float, float] = (0.05, 0.5)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("loosening_share", self.loosening_share[1] < 1, "below 1")
        self._require("weight_share", self.weight_share < 1, "below 1")
        self._require("lift_s", self.lift_s > 0, "positive")


@dataclass(frozen=True)
class Faults(_Parameters):
    """Broken channels and lost samples; the truth about the contact is not touched.

    Args:
        dead: channels of which nothing but the converter's zero is recorded.
        saturated: channels that stand at the upper rail.
        swapped: pairs of channels whose cables are exchanged.
        drops_per_s: losses of samples a second, in all channels at once; the last sample before
            a loss is repeated until it ends, as data loggers do.
        drop_ms: range of their length; log-uniform, at most 200 ms.

    Raises:
        ValueError: if a parameter is negative or not finite, a pair is not two channels, a channel
            has two faults, or losses may be longer than 200 ms.
    """

    dead: tuple[str, ...] = ()
    saturated: tuple[str, ...] = ()
    swapped: tuple[tuple[str, str], ...] = ()
    drops_per_s: float = 0.0
    drop_ms: tuple[float, float] = (1.0, 50.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("drop_ms", self.drop_ms[1] <= 200, "at most 200")
        pairs = all(len(pair) == 2 and pair[0] != pair[1] for pair in self.swapped)
        self._require("swapped", pairs, "pairs of channels")
        twice = [name for name, count in Counter(self.names).items() if count > 1]
        if twice:
            raise ValueError(f"Faults names {', '.join(twice)} twice; a channel has one fault")

    @property
    def names(self) -> tuple[str, ...]:
        """Channels with a fault of their own."""
        return (*self.dead, *self.saturated, *(name for pair in self.swapped for name in pair))


@dataclass(frozen=True)
class Dynamics(_Parameters):
    """Friction and steps of fidelity ``"bristles"``; the kinematic one has none.

    Stiffness, mass and damping of the skin follow from what both share: the presliding travel,
    the resonance and its damping ratio.

    Args:
        step_us: of the integration; a whole number of steps makes a sample.
        num_bristles: of an element, under a Hertz pressure. 1 is LuGre's model: an element sticks
            or slides as a whole. 16 to 64 are a patch whose edge lets go first (incipient slip).
        bristle_share: share of the presliding travel that the bristles take, the skin behind them
            the rest (prior, ours). It sets how long incipient slip is, and how gently a patch
            lets go: a bristle's friction falls with the patch's speed.
        bristle_stiffness_n_m: of a single bristle, which takes what of the presliding travel this
            stiffness needs, at most ``bristle_share``. Of no use with more bristles.
        sliding_damping: damping ratio of the skin beyond that with which it rings in the
            closed forms (prior, ours).
        sliding_damping_s_m: more of it, in N s/m per newton of static friction (prior, ours).
            Friction that falls with speed feeds a slide, at 20 mm/s with up to 1.8 of these for a
            smooth material and 8 for a tacky one: between them the one slides smoothly on any skin
            and the other sticks and slips, but for the softest skins of all and most patches.
        bristle_damping: damping ratio of the bristles with the skin's mass (prior, ours).
        viscous_n_s_m: viscous friction, which the closed forms do not have.
        release_v_per_n: volts of a fast channel per newton of the skin's inertia, when the skin
            lets go (prior, ours: so that the bursts of M2 to M5
            stand out of their slides with a single bristle, as the paper shows).

    Raises:
        ValueError: if a parameter is negative or not finite, a step is longer than 5 ms or zero, or
            there are no bristles.
    """

    step_us: float = 250.0
    bristle_share: float = 0.15
    num_bristles: int = 24
    bristle_stiffness_n_m: float = 1e5
    sliding_damping: float = 0.5
    sliding_damping_s_m: float = 1.8
    bristle_damping: float = 1.0
    viscous_n_s_m: float = 0.0
    release_v_per_n: float = 14.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("step_us", 0 < self.step_us <= 5000, "in (0, 5000]")
        self._require("bristle_share", 0 < self.bristle_share < 1, "in (0, 1)")
        whole = self.num_bristles == int(self.num_bristles) >= 1
        self._require("num_bristles", whole, "a whole number of 1 or more")
        self._require("bristle_stiffness_n_m", self.bristle_stiffness_n_m > 0, "positive")


@dataclass(frozen=True)
class Imperfections(_Parameters):
    """What makes channels differ without slip, and what makes slip differ between channels.

    On the paper's simulated hand, slip alone makes channels differ: everything else (mains, arm,
    motor) moves them together. On real electrodes at rest neighbours are nearly independent.
    None of these moves an onset.

    Args:
        local_noise_mv: noise of every element that touches, sliding or not, independent between
            elements, rms in a fast channel at 1 N. It stands for creep and settling of asperities
            behind the skin's resonance, so it has the spectrum of friction noise; its level wanders
            within the recording and differs between elements (prior, ours: below the 1.5 to 4 mV
            rms of rest; independent, as a real fingertip's electrodes in touch).
        share_wander: spread of the logarithm of each element's load while a grasp lasts, over
            half a second to ten (prior: in the real set a channel's level wanders about the mean
            over channels by .2 to .3 within seconds).
        gain_drift: the same of each channel's gain: temperature, glue (prior, ours).
        pickup_mv: broadband pick-up, one signal in all channels, rms at a coupling of 1. Each
            channel has a coupling and sign of its own, so it too makes channels differ; its level
            wanders (a film is a source of high impedance, near motor drives and cables: MSI/TE
            Piezo Film Sensors Technical Manual asks for shielding; level prior, ours).
        partial_slips_per_s: how often a finger does what the hand does not. At rest it creeps over
            a part of its presliding travel and vibrates, while the others hold; in a slide it
            sticks for as long. That is no slip of the hand, and not labelled (slip grows from the
            edge of a contact before all of it slides: Delhaye, Lefevre and Thonnard 2014, J. R.
            Soc. Interface, 10.1098/rsif.2014.0698; Andre et al. 2011, ibid.; rate prior, ours).

    Raises:
        ValueError: if a parameter is negative or not finite.
    """

    local_noise_mv: float = 0.0
    share_wander: float = 0.0
    gain_drift: float = 0.0
    pickup_mv: float = 0.0
    partial_slips_per_s: float = 0.0


# --- materials ------------------------------------------------------------------------------------

Character = Literal["smooth", "textured", "rough", "tacky"]
"""How sliding sounds. ``rough``: sustained vibration. ``tacky``: sustained stick-slip."""


@dataclass(frozen=True)
class Material:
    """A surface, as ranges to draw a session from.

    Args:
        title: the name in words.
        mu_s: static friction coefficient, the centre of its lognormal prior; dimensionless.
        ra_um: lowest and highest roughness Ra; with ``texture_mv`` it sets how strongly the
            material vibrates (a session rougher than the middle of its range vibrates more).
        texture_mv: rms of the texture's vibration at 40 mm/s and 1 N in a fast channel (prior,
            ours).
        character: see ``Character``.
        wavelength_mm: shortest and longest dominant wavelength, or ``None`` without one. For a
            tacky material: travel per stick-slip cycle.
        line_bandwidth: relative spread of the wavelengths around the dominant one.
        line_share: share of the texture's power at the dominant wavelength, if there is one; the
            rest is the broad ``k^-a`` part.
        mu_ratio: lowest and highest kinetic over static friction, dimensionless.
        stribeck_mm_s: speed over which static becomes kinetic friction of bristles;
            near the speeds of sliding it makes a material stick and slip.
        fast_ratio: kinetic over static friction far above that speed, of bristles, where
            it is not ``mu_ratio``: a tacky material's is the mean over sticking and slipping at
            the speeds of sliding. The range is drawn with ``mu_ratio``, low with low.

    Raises:
        ValueError: if friction is not positive, kinetic exceeds static friction, or a range is
            empty.
    """

    title: str
    mu_s: float
    ra_um: tuple[float, float]
    texture_mv: float
    character: Character = "smooth"
    wavelength_mm: tuple[float, float] | None = None
    line_bandwidth: float = 0.1
    line_share: float = 0.4
    mu_ratio: tuple[float, float] = (0.75, 0.95)
    stribeck_mm_s: float = 10.0
    fast_ratio: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        low, high = self.mu_ratio
        if not (self.mu_s > 0 and 0 < low <= high <= 1):
            raise ValueError(
                f"{self.title}: expected mu_s > 0 and mu_ratio (mu_k / mu_s) with "
                f"0 < low <= high <= 1, got {self.mu_s} and {self.mu_ratio}"
            )


# Friction, Ra and wavelengths are usual values of such materials; none was measured on this hand.
# Each session draws its own from the ranges. Texture levels: rough 150 mV and smooth 10 mV
# (its starting values), the materials between by roughness and softness (prior, ours). The tacky
# fast_ratio: with it the force oscillates by about a quarter (prior, ours).
MATERIALS: dict[str, Material] = {
    "M1": Material("ABS", 0.8, (5.0, 12.0), 150.0, "rough", (0.18, 0.22), 0.05),
    "M2": Material("aluminium foil", 0.7, (0.15, 0.25), 10.0),
    "M3": Material("fibreglass aluminium foil", 0.7, (2.5, 3.5), 14.0, "textured", (0.5, 1.5)),
    "M4": Material("oil paper", 0.5, (3.0, 5.0), 12.0, "textured", (0.05, 0.5), 0.5),
    "M5": Material("acrylic", 1.0, (0.02, 0.1), 8.0),
    "M6": Material(
        "PVC tape",
        1.1,
        (1.0, 2.0),
        120.0,
        "tacky",
        (0.8, 2.0),
        0.03,
        0.5,
        stribeck_mm_s=50.0,
        fast_ratio=(0.4, 0.55),
    ),
    "iron": Material("iron", 0.7, (0.8, 3.0), 12.0),
    "cloth": Material("duct tape", 0.8, (10.0, 20.0), 60.0, "rough", (0.5, 1.0)),
    "copper": Material("copper", 0.6, (0.2, 0.8), 10.0),
    "wood": Material("wood", 0.6, (3.0, 10.0), 25.0, "textured", (0.1, 1.0), 0.3),
}
"""Every known material by the short id used everywhere else."""

SEEN_MATERIALS = ("M1", "M2", "M3", "M4", "M5", "M6")
"""The paper's training materials, in its order."""

UNSEEN_MATERIALS = ("iron", "cloth", "copper", "wood")
"""The paper's held-out materials. Nothing is tuned on them."""

# --- scenes ---------------------------------------------------------------------------------------

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

    def __repr__(self) -> str:
        plain = ", ".join(
            f"{each.name}={getattr(self, each.name)!r}"
            for each in fields(self)
            if getattr(self, each.name) != getattr(_usual(self.material), each.name)
        )
        return f"Scene({self.material!r}{plain and ', '}{plain})"

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
            check_number(name, getattr(self, name))
        check_number("tail_s", self.tail_s, least=0)
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
        arm: list[ArmStroke] = []
        now_s, here_mm, a = 0.0, 0.0, 1000.0 * self.acceleration_m_s2
        for stroke in self.strokes:
            peak = min(stroke.speed_mm_s, math.sqrt(a * stroke.distance_mm))
            start_s = now_s + stroke.pause_s
            arm.append(ArmStroke(start_s, here_mm, a, peak, stroke.distance_mm, stroke.moves))
            now_s = arm[-1].stop_s
            here_mm += stroke.distance_mm if stroke.slides else 0.0
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

        Imperfections, and parameters that came later, are left out where they change nothing, so
        that recordings keep their keys.
        """
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        plain["hand"] = self.hand.to_rows()
        for group, names in _ADDED.items():
            for name in names:
                if getattr(getattr(self, group), name) == getattr(_GROUPS[group](), name):
                    del plain[group][name]
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
        values = _grouped({k: v for k, v in plain.items() if k not in beside})
        if "hand" in values:
            values["hand"] = HandLayout.from_rows(values["hand"])
        return cls(**values)


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
    check_number("cycles", cycles, least=1, whole=True)
    values = _grouped(overrides)
    known = {f.name for f in fields(Scene)} - {"material", "hand", "seed", "cycle"}
    if unknown := sorted(set(values) - known):
        names = known.union(*((f.name for f in fields(group)) for group in _GROUPS.values()))
        near = get_close_matches(unknown[0], names, 1)
        hint = f"did you mean {near[0]}?" if near else "see tactslip_torch.Scene"
        raise ValueError(f"a scene has no parameter {', '.join(unknown)}; {hint}")
    return [
        Scene(material, hand or HandLayout.paper24(), seed=seed, cycle=cycle, **values)
        for material in materials
        for cycle in range(cycles)
    ]


@lru_cache(maxsize=16)
def _usual(material: str) -> Scene:
    """The scene of a material with every other parameter as it is by default."""
    return Scene(material)


_GROUPS: dict[str, Any] = {
    each.name: each.default_factory for each in fields(Scene) if is_dataclass(each.default_factory)
}
"""The groups of parameters of a scene, by name."""

_ADDED = {
    "contact": ("slide_rise_s",),
    "sensors": ("gain",),
    "handling": ("loosenings_per_s", "loosening_share"),
}
"""Parameters that older keys of recordings do not have."""


def _grouped(given: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of ``Scene``: mappings become groups and strokes, fields of groups go into theirs."""
    values = dict(given)
    if "strokes" in values:
        made = (s if isinstance(s, Stroke) else Stroke(**s) for s in values["strokes"])
        values["strokes"] = tuple(made)
    for name, group in _GROUPS.items():
        own = values.pop(name, None) or {}
        inner = {f.name: values.pop(f.name) for f in fields(group) if f.name in values}
        values[name] = replace(own if isinstance(own, group) else group(**own), **inner)
    return values


@dataclass(frozen=True)
class ArmStroke:
    """One stroke as the arm runs it: a trapezoid of speed, or a triangle if it is short.

    Args:
        start_s: when the arm begins to move.
        origin_mm: how far the hand has slid before.
        acceleration_mm_s2: of both ramps.
        peak_mm_s: highest speed, the steady one unless the stroke is short.
        distance_mm: travel.
        moves: who does: see ``Stroke``.
    """

    start_s: float
    origin_mm: float
    acceleration_mm_s2: float
    peak_mm_s: float
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

    @cached_property
    def ramp_s(self) -> float:
        """Duration of each ramp."""
        return self.peak_mm_s / self.acceleration_mm_s2

    @cached_property
    def stop_s(self) -> float:
        """When the arm is at rest again."""
        return self.start_s + self.distance_mm / self.peak_mm_s + self.ramp_s

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
