"""The knobs of a scene, in groups: strokes, contact, sensors, disturbances.

Defaults are the starting values of PHYSICS.md unless marked (prior, ours). Three knobs are *the
calibrated ones*, set once on seen-material test accuracy alone: ``Contact.friction_noise_mv``,
``Contact.presliding_mm`` and ``Disturbances.burst_rate_hz``. Every ``*_spread`` is the standard
deviation of the logarithm of a factor of median 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

PAPER_FINGER_LOADS = (
    ("little", 0.6),
    ("ring", 0.8),
    ("middle", 0.8),
    ("index", 2.0),
    ("thumb", 0.6),
)
"""Relative normal load of each finger; fingers not named here carry 1."""


def require_finite(group: object, *, signed: tuple[str, ...] = ()) -> None:
    """Check every number of a group of knobs, and turn lists into tuples.

    Raises:
        ValueError: if a number is not finite, or negative and not in ``signed``, or a
            pair is not ``0 < low <= high``.
    """
    where = type(group).__name__
    for field in fields(group):  # type: ignore[arg-type]  # always a dataclass
        value = getattr(group, field.name)
        if isinstance(value, list):
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
            object.__setattr__(group, field.name, value)
        if isinstance(value, bool | str) or value is None or field.name in signed:
            continue
        if isinstance(value, int | float):
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"{where}.{field.name} must be finite and not negative, got {value}"
                )
        elif "tuple[float, float]" in str(field.type) and not (
            len(value) == 2 and 0 < value[0] <= value[1] < math.inf
        ):
            raise ValueError(
                f"{where}.{field.name} must be (low, high), 0 < low <= high, got {value}"
            )


@dataclass(frozen=True)
class Stroke:
    """One straight movement of the arm after a pause.

    Args:
        speed_mm_s: steady speed.
        distance_mm: travel of the arm from rest to rest.
        pause_s: rest before the stroke.

    Raises:
        ValueError: if speed or distance is not positive, or the pause negative.
    """

    speed_mm_s: float
    distance_mm: float = 100.0
    pause_s: float = 2.0

    def __post_init__(self) -> None:
        for name in ("speed_mm_s", "distance_mm"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"Stroke.{name} must be positive and finite, got {value}")
        if not 0 <= self.pause_s < math.inf:
            raise ValueError(f"Stroke.pause_s must be finite and not negative, got {self.pause_s}")


@dataclass(frozen=True)
class Contact:
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
        mu_k: kinetic friction instead of the material's prior, without spread.
        friction_spread: spread of ``mu_s`` between sessions (prior, ours; a fifth of it between
            recordings).
        presliding_mm: *calibrated.* Range of the travel that stretches the skin before a fresh
            contact lets go; log-uniform, drawn per recording.
        presliding_spread: spread of that travel between the elements of a recording (prior,
            ours), cut at a factor 1.5.
        relaxation: range of the share of shear that a long pause relaxes, at most 1.
        relaxation_time_s: range of its time constant.
        recoil_s: time constant of the shear's fall from static to kinetic (prior, ours).
        friction_noise_mv: *calibrated.* Broadband friction noise of every sliding element, rms
            at a PVDF film for mu = 1, 1 N and 40 mm/s.
        friction_noise_exponent: power of speed it grows with.
        friction_noise_low_share: share of its power below 25 Hz.
        texture_scale: factor on every material's texture (prior, ours).
        onset_pulse_v: first swing of the PVDF burst when an element lets go, per newton of
            friction.
        runout: relative change of normal load along the travel.
        skin_resonance_hz: range of the skin's resonance, drawn per session.
        skin_damping: range of its damping ratio (prior, ours).

    Raises:
        ValueError: if a knob is negative or not finite, ``mu_k`` exceeds ``mu_s``, or no
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
    presliding_mm: tuple[float, float] = (0.3, 3.0)
    presliding_spread: float = 0.2
    relaxation: tuple[float, float] = (0.1, 0.3)
    relaxation_time_s: tuple[float, float] = (0.2, 2.0)
    recoil_s: float = 0.008
    friction_noise_mv: float = 8.0
    friction_noise_exponent: float = 0.75
    friction_noise_low_share: float = 0.3
    texture_scale: float = 1.0
    onset_pulse_v: float = 0.5
    runout: float = 0.04
    skin_resonance_hz: tuple[float, float] = (40.0, 100.0)
    skin_damping: tuple[float, float] = (0.1, 0.3)

    def __post_init__(self) -> None:
        require_finite(self)
        if self.mu_s is not None and not self.mu_s > 0:
            raise ValueError(f"Contact.mu_s must be positive, got {self.mu_s}")
        if self.mu_s is not None and self.mu_k is not None and self.mu_k > self.mu_s:
            raise ValueError(
                f"Contact.mu_k must not exceed mu_s, got mu_k={self.mu_k} and mu_s={self.mu_s}"
            )
        if not self.recoil_s > 0:
            raise ValueError(f"Contact.recoil_s must be positive, got {self.recoil_s}")
        for name in ("friction_noise_low_share", "runout"):
            if getattr(self, name) > 1:
                raise ValueError(f"Contact.{name} must be at most 1, got {getattr(self, name)}")
        if self.relaxation[1] > 1:
            raise ValueError(f"Contact.relaxation must be at most 1, got {self.relaxation}")
        self._require_some_contact()

    def _require_some_contact(self) -> None:
        """Refuse a contact without contact."""
        for finger, load in self.finger_loads:
            if not 0 <= load < math.inf:
                raise ValueError(f"Contact.finger_loads of {finger} must be >= 0, got {load}")
        if self.lifted_fraction >= 1:
            raise ValueError(
                "no element in contact: lifted_fraction must be below 1, "
                f"got {self.lifted_fraction}"
            )
        if self.touching is not None and not self.touching:
            raise ValueError("no element in contact: touching names no channel")
        if self.load_n == 0:
            raise ValueError("no element in contact: load_n must be positive, got 0")


@dataclass(frozen=True)
class Sensors:
    """The sensing elements and their front end.

    Args:
        white_noise_mv: rms of each channel's white noise.
        white_noise_session_spread: its spread between sessions.
        gain_spread: spread of the channels' gains between sessions (a third between recordings).
        sg_preload_v_per_n: SG volts per newton of normal force (prior, ours).
        sg_shear_v_per_n: SG volts per newton of friction (prior, ours).
        sg_session_offset_v: spread of SG offsets between sessions (prior, ours).
        sg_offset_v: spread of SG offsets between recordings, from grasping again.
        sg_drift_mv: size of the SG's slow drift (prior, ours).
        pvdf_shear_v_per_n: PVDF volts per newton of friction, before the high-pass (prior, ours).
        pvdf_highpass_hz: corner of the film and its amplifier (6.6 Hz at 10 MOhm, MSI
            manual), at least 2 Hz.
        pvdf_offset_mv: largest offset behind the high-pass; keep it at or below 2 mV.
        pvdf_drift_mv: size of the film's slow (pyroelectric) drift.
        num_bits: of the converter.
        rail_v: the converter's range is plus and minus this.

    Raises:
        ValueError: if a knob is negative or not finite, or the converter has no range.
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
    num_bits: int = 16
    rail_v: float = 5.0

    def __post_init__(self) -> None:
        require_finite(self)
        if not 2 <= self.num_bits <= 32:
            raise ValueError(f"Sensors.num_bits must be 2 to 32, got {self.num_bits}")
        if not self.rail_v > 0:
            raise ValueError(f"Sensors.rail_v must be positive, got {self.rail_v}")
        if self.pvdf_highpass_hz < 2:
            raise ValueError(
                "Sensors.pvdf_highpass_hz must be at least 2, for slower films outlast a block of "
                f"a quarter second, got {self.pvdf_highpass_hz}"
            )


@dataclass(frozen=True)
class Disturbances:
    """What is in the recording but is not slip.

    Args:
        mains_mv: amplitude of the mains' fundamental, the session's median (prior, ours: at
            PHYSICS.md's 4 to 10 mV rest would exceed the 1.5 to 4 mV rms it asks for).
        mains_session_spread: its spread between sessions.
        mains_hz: nominal frequency; harmonics up to the ninth share a common phase.
        arm_transient_mv: ringing of the arm's modes at each start and stop, in every channel.
        motor_vibration_mv: rms of the vibration felt in every channel while the arm moves, at
            40 mm/s. In the paper's data slip *is* arm motion, so this one alone can tell slip.
        burst_rate_hz: *calibrated.* Random bursts (knocks) a second.
        burst_mv: their size.
        label_jitter_ms: standard deviation of a person's onset marks, cut at three times that.

    Raises:
        ValueError: if a knob is negative or not finite.
    """

    mains_mv: float = 3.0
    mains_session_spread: float = 0.7
    mains_hz: float = 50.0
    arm_transient_mv: float = 50.0
    motor_vibration_mv: float = 1.0
    burst_rate_hz: float = 0.3
    burst_mv: float = 30.0
    label_jitter_ms: float = 15.0

    def __post_init__(self) -> None:
        require_finite(self)
