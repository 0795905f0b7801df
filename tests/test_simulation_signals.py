"""What a simulated recording must look like: REFERENCE.md section 6, row *signals*.

Each statistic is compared with a threshold on the filtered recordings of every seen material, and
must miss that threshold once the samples are shuffled in time (or negated, where sign matters).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import pywt
from scipy.signal import savgol_filter

from tactslip_torch.simulation import SEEN_MATERIALS, Contact, Disturbances, Scene, simulate

RATE_HZ = 2000
NUM_CYCLES = 3
SUSTAINED, QUIET = ("M1", "M6"), ("M2", "M3", "M4", "M5")


@dataclass
class Seen:
    """Filtered samples of one recording, and where its parts are."""

    sg: np.ndarray
    pvdf: np.ndarray
    onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]

    def part(self, kind: str, start_s: float, end_s: float) -> np.ndarray:
        return getattr(self, kind)[:, round(start_s * RATE_HZ) : round(end_s * RATE_HZ)]

    def slide(self, kind: str, stroke: int) -> np.ndarray:
        """The second half of a slide, away from the onset."""
        start_s, end_s = self.sliding_s[stroke]
        return self.part(kind, 0.5 * (start_s + end_s), end_s - 0.05)

    def rest(self, kind: str, stroke: int = 0) -> np.ndarray:
        """From 1.2 to .3 s before an onset: before stretching, after the last stop's ringing."""
        return self.part(kind, self.onsets_s[stroke] - 1.2, self.onsets_s[stroke] - 0.3)

    def changed(self, change: Callable[[np.ndarray], np.ndarray]) -> "Seen":
        return Seen(change(self.sg), change(self.pvdf), self.onsets_s, self.sliding_s)


@pytest.fixture(scope="module")
def recordings() -> dict[str, list[Seen]]:
    return {
        material: [_filtered(Scene(material, cycle=cycle)) for cycle in range(NUM_CYCLES)]
        for material in SEEN_MATERIALS
    }


def _filtered(scene: Scene) -> Seen:
    recording = simulate(scene)
    samples = recording.samples.double().numpy()
    sg = savgol_filter(samples[:14], 51, 1, axis=-1)
    pvdf = savgol_filter(samples[14:], 11, 1, axis=-1)
    return Seen(sg, pvdf, recording.onsets_s, recording.sliding_s)


def shuffled(samples: np.ndarray) -> np.ndarray:
    """The same values of every channel in another order."""
    return samples[:, np.random.default_rng(0).permutation(samples.shape[1])]


def rms(samples: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean((samples - samples.mean(-1, keepdims=True)) ** 2, -1))


# --- statistics: recordings of one material -> number -------------------------------------------


def sg_offset_spread(seen: list[Seen]) -> float:
    """Spread of the SGs' levels before the first onset, over how much one SG varies there."""
    return np.median([np.std(s.rest("sg").mean(-1)) / np.median(rms(s.rest("sg"))) for s in seen])


def sg_rise_v(seen: list[Seen]) -> float:
    """How much the SGs' mean level rises from before the first onset to its slide."""
    return np.mean([(s.slide("sg", 0).mean(-1) - s.rest("sg").mean(-1)).mean() for s in seen])


def sg_variation(seen: list[Seen]) -> float:
    """SG variation in sliding over that at rest."""
    ratio = [rms(s.slide("sg", 1)) / rms(s.rest("sg")) for s in seen]
    return np.median(np.concatenate(ratio))


def pvdf_onset_burst(seen: list[Seen]) -> float:
    """PVDF vibration in the 60 ms around an onset over that later in the slide."""
    ratio = [
        rms(s.part("pvdf", s.onsets_s[k] - 0.02, s.onsets_s[k] + 0.04)) / rms(s.slide("pvdf", k))
        for s in seen
        for k in range(3)
    ]
    return np.median(np.concatenate(ratio))


def pvdf_slide_over_rest(seen: list[Seen]) -> float:
    """PVDF vibration while sliding at 40 mm/s over that before the first onset."""
    return np.median(np.concatenate([rms(s.slide("pvdf", 1)) / rms(s.rest("pvdf")) for s in seen]))


def pvdf_speed_growth(seen: list[Seen]) -> float:
    """The smaller of the growths of PVDF vibration from 20 to 40 and from 40 to 60 mm/s."""
    level = [np.median([rms(s.slide("pvdf", k)) for s in seen], axis=0) for k in range(3)]
    return min(np.median(level[1] / level[0]), np.median(level[2] / level[1]))


def num_barely_responding(seen: list[Seen]) -> float:
    """PVDF channels a recording in which the onset is hardly felt."""
    ratio = [
        rms(s.part("pvdf", s.onsets_s[1] - 0.05, s.onsets_s[1] + 0.1)) / rms(s.rest("pvdf", 1))
        for s in seen
    ]
    return float(np.mean([np.sum(r < 4.0) for r in ratio]))


def finest_detail_share(seen: list[Seen]) -> float:
    """Power of the finest wavelet detail over the vibration's, while sliding."""
    shares = []
    for s in seen:
        slide = s.slide("pvdf", 1)
        detail = pywt.wavedec(slide, "rbio2.2", mode="symmetric", level=1)[1]
        shares.append(np.sum(detail**2, -1) / np.sum((slide - slide.mean(-1)[:, None]) ** 2, -1))
    return np.median(np.concatenate(shares))


ALL = SEEN_MATERIALS
CASES = [
    (sg_offset_spread, ALL, 30.0, np.inf, shuffled),
    (sg_rise_v, ALL, 0.02, 1.0, np.negative),
    (sg_rise_v, ALL, 0.02, 1.0, shuffled),
    (sg_variation, ALL, 1.3, np.inf, shuffled),
    (pvdf_onset_burst, QUIET, 2.5, np.inf, shuffled),
    (pvdf_slide_over_rest, ALL, 1.5, np.inf, shuffled),
    (pvdf_slide_over_rest, SUSTAINED, 8.0, np.inf, shuffled),
    (pvdf_speed_growth, ALL, 1.05, 3.0, shuffled),
    (finest_detail_share, ALL, 0.0, 0.02, shuffled),
]


@pytest.mark.parametrize(
    ("statistic", "material", "low", "high", "spoilt"),
    [
        pytest.param(f, m, low, high, s, id=f"{f.__name__}-{m}-{low}-{s.__name__}")
        for f, materials, low, high, s in CASES
        for m in materials
    ],
)
def test_recordings_look_as_the_paper_describes(recordings, statistic, material, low, high, spoilt):
    seen = recordings[material]
    assert low < statistic(seen) < high
    assert not low < statistic([s.changed(spoilt) for s in seen]) < high


def test_only_rough_and_tacky_materials_vibrate_throughout(recordings):
    def sustained_share(change):
        """Vibration late in the slide over that at the onset: quiet over sustained materials."""
        burst = {
            m: np.mean([pvdf_onset_burst([s.changed(change)]) for s in recordings[m]])
            for m in SEEN_MATERIALS
        }
        return min(burst[m] for m in QUIET) / max(burst[m] for m in SUSTAINED)

    assert sustained_share(np.copy) > 1.5
    assert not sustained_share(shuffled) > 1.5
    level_v = {
        m: np.median([rms(s.slide("pvdf", 1)) for s in recordings[m]]) for m in SEEN_MATERIALS
    }
    assert min(level_v[m] for m in SUSTAINED) > 3 * max(level_v[m] for m in QUIET)


def test_a_few_channels_barely_respond():
    seen = [_filtered(Scene(m, cycle=c)) for m in ("M2", "M5") for c in range(6)]
    assert 0.3 < num_barely_responding(seen) < 4
    assert not 0.3 < num_barely_responding([s.changed(shuffled) for s in seen]) < 4


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
