"""What is measured on: bins, streams, and a detector with settings for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch import AlarmSettings, FeaturePool, SlipDetector
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.onset.decisions import KEY
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence, Perceptron
from tactslip_torch.onset.rules import Cusum
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.datamodule import FeatureMaker

Array = NDArray[Any]
WINDOW_LENGTHS = (51,) * 14 + (11,) * 10
RATE_HZ = 2000.0


# ----------------------------------------------------------------------------- bins and streams
@cache
def _recordings(num: int) -> tuple[SimulatedRecordings, list[RecordingId]]:
    materials = [f"M{index}" for index in range(1, 7)]
    source = SimulatedRecordings(cycles=-(-num // 6), materials=materials)
    return source, sorted(source.ids, key=lambda each: (each.cycle, each.material))[:num]


@cache
def labelled_bins(num_recordings: int) -> tuple[Tensor, Tensor]:
    """Filtered bins ``[N, C, n]`` of simulated recordings, and which are slip; read-only."""
    source, ids = _recordings(num_recordings)
    maker = FeatureMaker(
        source, FeaturePool(source.hand), ChannelFilter(WINDOW_LENGTHS), LabelRule()
    )
    parts = [maker.filtered_bins(recording) for recording in ids]
    return torch.cat([bins for bins, _ in parts]), torch.cat([laid.is_slip for _, laid in parts])


@cache
def stream_samples(num_recordings: int) -> Array:
    """Simulated recordings, one behind the other, ``[T, 24]`` float32; read-only."""
    source, ids = _recordings(num_recordings)
    parts = [source.load(recording).samples.float().numpy().T for recording in ids]
    return np.ascontiguousarray(np.concatenate(parts))


def raw_bins(num: int, num_recordings: int = 1) -> Tensor:
    """Raw bins of simulated recordings with their context, ``[num, 24, 150]``, float32."""
    samples = torch.from_numpy(stream_samples(num_recordings)).T
    length = 100 + 2 * ChannelFilter(WINDOW_LENGTHS).context
    starts = torch.linspace(0, samples.shape[-1] - length, num).long().tolist()
    return torch.stack([samples[:, start : start + length] for start in starts]).contiguous()


def pushing(push: Callable[[Array], object], samples: Array, num: int) -> Callable[[], object]:
    """A call that pushes the next ``num`` samples, over and over; a rest is passed over."""
    starts = cycle(range(0, len(samples) - num + 1, num))
    return lambda: push(samples[(start := next(starts)) : start + num])


# ------------------------------------------------------------------------------- a detector
def loaded(
    path: str | Path,
    dtype: torch.dtype = torch.float64,
    backend: BackendName = "auto",
    hop: int = 20,
) -> SlipDetector:
    """The detector of a file, in this dtype, with settings for streams."""
    detector = SlipDetector.load(path, backend=backend)
    detector.info[KEY] = alarm_settings(hop).to_dict()
    return detector.to(dtype).eval()


def alarm_settings(hop: int) -> AlarmSettings:
    """Usual settings of a stream; their decisions do not matter here."""
    rule = Cusum(drift=0.1, evidence=min(1.0, hop / 100), ceiling=10.0)
    return AlarmSettings(hop, Platt(1.0, 0.0), rule, 8.0, target_per_hour=1.0)


def onset_settings(detector: SlipDetector, samples: Array) -> AlarmSettings:
    """Those of an alarm with an onset classifier, its numbers drawn; samples ``[T, C]``.

    The rule on bins is that of ``+exp=onset``, and seldom raises an alarm.
    """
    rule, pool = Cusum(drift=3.0, evidence=0.5, ceiling=600.0), detector.pool
    settings = AlarmSettings(50, Platt(1.0, 0.0), rule, 400.0, target_per_hour=1.0)
    plain = OnsetEvidence(pool.hand, pool.sample_rate_hz)
    columns, _, _ = plain.columns(plain.blocks_of_recording(torch.from_numpy(samples.T)))
    draw = np.random.default_rng(0).standard_normal
    quadratic = draw((plain.num_columns,) * 2) / plain.num_columns
    numbers = quadratic + quadratic.T, draw(plain.num_columns), np.array(0.0)
    head = QuadraticForm(*map(torch.from_numpy, numbers))
    onset = OnsetClassifier(plain, FeatureScaler.fit(columns), head, threshold=1e9)
    return replace(settings, onset=onset)


def drawn_network(evidence: OnsetEvidence, *widths: int) -> Perceptron:
    """A network on all inputs of an onset classifier, its weights drawn: it costs what any does."""
    torch.manual_seed(0)
    network = Perceptron.drawn(evidence.num_columns * (1 + len(evidence.lags)), widths)
    return network.double().requires_grad_(False)
