"""The sensing elements and their front end."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.simulation.knobs.checks import require_finite


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
        warming_mv: how far a strain gauge's zero moves over the recording as the hand warms up,
            with a sign and size of its own in every channel; a film feels a fiftieth of it.
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
    warming_mv: float = 0.0
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
