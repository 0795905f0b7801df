"""A detector of four channels that nobody trained, and bins for it."""

import numpy as np
import torch
from extremes import slip_samples

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.sensing import Sensing
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.onset.decisions import KEY, AlarmSettings, score_stream
from tactslip_torch.onset.rules import Cusum
from tactslip_torch.signals.filtering import ChannelFilter

HAND = HandLayout.from_rows(
    {"name": f"{kind}{i}", "kind": kind, "finger": finger, "segment": "distal"}
    for kind in ("SG", "PVDF")
    for i, finger in enumerate(("index", "thumb"), 1)
)
NUM_FEATURES = 12


def raw_bins(
    num_bins: int, seed: int = 0, offset: float = 1.0, num_samples: int = 150
) -> torch.Tensor:
    """Noise of several sizes in volts, the gauges on an offset."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-2, 0, (num_bins, 1, 1))
    away = np.where(np.arange(4) < 2, offset, 0.0)[:, None]
    return torch.from_numpy(size * rng.standard_normal((num_bins, 4, num_samples)) + away)


def small_detector(
    seed: int = 0,
    *,
    arithmetic: str = "double",
    bin_samples: int = 100,
    backend: BackendName = "auto",
) -> SlipDetector:
    """Of random features, without those that the least rounding moves far."""
    rng = np.random.default_rng(seed)
    pool = FeaturePool(HAND, bin_samples=bin_samples, arithmetic=arithmetic)  # type: ignore[arg-type]
    channel_filter = ChannelFilter([51, 51, 11, 11])
    jumpy, is_paper = ("mode", "cv", "entropy"), pool.is_paper.tolist()
    steady = [i for i, n in enumerate(pool.names) if is_paper[i] and n.descriptor not in jumpy]
    of_gauges = rng.choice([i for i in steady if i < 26], 4, replace=False)
    of_films = rng.choice([i for i in steady if i >= 26], NUM_FEATURES - 4, replace=False)
    selected = [int(i) for i in (*of_gauges, *of_films)]
    bins = raw_bins(64, seed=99, num_samples=bin_samples + 50)
    features = pool(channel_filter.valid(bins))[:, selected]
    scaler = FeatureScaler.fit(features)
    bend = torch.from_numpy(rng.standard_normal((NUM_FEATURES, NUM_FEATURES)))
    linear = torch.from_numpy(rng.standard_normal(NUM_FEATURES))
    centre = scaler(features)
    machine = QuadraticForm(bend + bend.T, linear, torch.tensor(0.0, dtype=torch.float64))
    middle = -machine(centre).median()  # so that both decisions occur
    machine = QuadraticForm(bend + bend.T, linear, middle)
    metadata = {"simulated": True}
    return SlipDetector(pool, channel_filter, selected, scaler, machine, metadata, backend=backend)


def with_floors(detector: SlipDetector, min_alive: int, stuck_samples: int = 150) -> SlipDetector:
    """The detector with what such bins tell of channels that work."""
    num = detector.pool.bin_samples + 2 * detector.channel_filter.context
    spans = detector.predict_raw(raw_bins(64, seed=99, num_samples=num)).span
    detector.sensing = Sensing.fit(spans, min_alive, stuck_samples)
    return detector


def alarming_detector(seed: int = 0, bin_samples: int = 100) -> SlipDetector:
    """The small detector, with settings by which the simulated slip raises alarms."""
    made = small_detector(seed, bin_samples=bin_samples)
    scores = score_stream(made, slip_samples(HAND), 20).score
    made.info[KEY] = alarms_of(scores, 20).to_dict()
    return made


def alarms_of(scores: torch.Tensor, hop_samples: int) -> AlarmSettings:
    """By which the highest of these scores raise alarms."""
    rise = 2.0 / float(scores.std())
    return AlarmSettings(
        hop_samples,
        Platt(rise, -rise * float(scores.mean())),
        Cusum(0.5, 0.4, 8.0),
        threshold=2.0,
        target_per_hour=1.0,
        rearm_s=0.03,
        refractory_s=0.1,
    )
