"""What real contacts do and the paper's simulated hand does not; all off by default."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.simulation.knobs.checks import require_finite


@dataclass(frozen=True)
class Imperfections:
    """What makes channels differ without slip, and what makes slip differ between channels.

    On the paper's simulated hand, slip alone makes channels differ: everything else (mains, arm,
    motor) moves them together. On real electrodes at rest neighbours are nearly independent
    (``python -m benchmarks.simulation.realism``). None of these moves an onset.

    Args:
        local_noise_mv: noise of every element that touches, sliding or not, independent between
            elements, rms at a PVDF film at 1 N. It stands for creep and settling of asperities
            behind the skin's resonance, so it has the spectrum of friction noise; its level wanders
            within the recording and differs between elements (prior, ours: below the 1.5 to 4 mV
            rms that PHYSICS.md gives rest; independent, as a real fingertip's electrodes in touch).
        share_wander: spread of the logarithm of each element's load while a grasp lasts, over
            half a second to ten (prior: in the real set a channel's level wanders about the mean
            over channels by .2 to .3 within seconds).
        gain_drift: the same of each channel's gain: temperature, glue (prior, ours).
        pickup_mv: broadband pick-up, one signal in all channels, rms at a film of coupling 1. Each
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

    def __post_init__(self) -> None:
        require_finite(self)
