"""What is in a recording but is not slip."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.simulation.knobs.calibrated import CALIBRATED
from tactslip_torch.simulation.knobs.checks import require_finite


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
            A pair is a range, drawn per recording, log-uniform.
        mains_bursts_per_s: stretches of a tenth to a whole second in which the mains is stronger
            (a welder, a lift).
        mains_burst_mv: added amplitude of the fundamental in them, with its harmonics.
        machine_mv: vibration of a neighbouring machine, rms, felt in every channel, in stretches
            that start and stop with the machine.
        machine_hz: range of its rotation; it has harmonics (prior, ours).
        burst_rate_hz: *calibrated.* Random bursts (knocks) a second.
        burst_mv: their size.
        label_jitter_ms: standard deviation of a person's onset marks, cut at three times that.

    Raises:
        ValueError: if a knob is negative or not finite, or a range empty.
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
    burst_rate_hz: float = CALIBRATED["burst_rate_hz"]
    burst_mv: float = 30.0
    label_jitter_ms: float = 15.0

    def __post_init__(self) -> None:
        require_finite(self)
