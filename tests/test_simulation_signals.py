"""What every simulated signal keeps to; what it looks like is in ``test_facts.py``."""

import numpy as np

from tactslip_torch.simulation import Contact, Disturbances, Scene, simulate

RATE_HZ = 2000


def test_no_channel_is_ever_silent_and_none_leaves_the_rails():
    samples = simulate(Scene("M6", cycle=4)).samples
    bins = samples[:, : samples.shape[1] // 100 * 100].unflatten(-1, (-1, 100))
    assert bins.std(-1).min() > 5e-5
    assert samples.abs().max() <= 5.0


def test_texture_frequency_is_speed_over_wavelength():
    # Lines of M3's weave: the power spectrum over *travel* peaks at the same wavelength at
    # every speed, so its frequency grows in proportion to speed.
    contact = Contact(lifted_fraction=0.0, friction_noise_mv=0.0, texture_scale=10.0)
    quiet = Disturbances(mains_mv=0.0, arm_transient_mv=0.0, burst_rate_hz=0.0)
    scene = Scene("M3", contact=contact, disturbances=quiet, cycle=1)
    recording = simulate(scene, channels=["PVDF7", "PVDF8"])
    peaks_hz = []
    for start_s, end_s in recording.sliding_s:
        first, last = round((start_s + 0.2) * RATE_HZ), round((end_s - 0.2) * RATE_HZ)
        x = recording.samples[20:22, first:last].double().numpy()
        power = np.abs(np.fft.rfft(x * np.hanning(x.shape[1]))) ** 2
        hertz = np.fft.rfftfreq(x.shape[1], 1 / RATE_HZ)
        power = power.sum(0) * (hertz > 8)
        peaks_hz.append(np.sum(hertz * power**2) / np.sum(power**2))
    wavelengths_mm = np.array([20, 40, 60]) / np.array(peaks_hz)
    assert np.all((wavelengths_mm > 0.4) & (wavelengths_mm < 1.8))
    assert peaks_hz[0] < 0.7 * peaks_hz[1] < 0.7 * peaks_hz[2]
