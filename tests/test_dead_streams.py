"""Streams of hands with dead sensors: live, whole, and by the command."""

import pytest
import torch
from small_detector import HAND, alarming_detector, raw_bins

from tactslip_torch.deploy.check import simulated_stream
from tactslip_torch.model.calibration import widened_llr
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.onset.decisions import AlarmSettings, score_stream
from tactslip_torch.onset.streaming import StreamingDetector


def alarming_with_gaussians(seed=0):
    made = alarming_detector(seed)
    z = made.scaler(made.pool(made.channel_filter.valid(raw_bins(200, 5)))[:, list(made.selected)])
    made.gaussians = ClassGaussians.fit(z, made.head(z) >= 0)
    return made


SAMPLES = simulated_stream(HAND, 2000.0, torch.float64)


@pytest.fixture(scope="module")
def detector():
    return alarming_with_gaussians()


def test_probability_and_statistic_are_of_the_widened_ratio(detector):
    live = StreamingDetector(detector, dtype=torch.float64, masked_channels="PVDF1")
    found, broken = live.push(SAMPLES.T), SAMPLES.clone()
    broken[2] = torch.nan
    settings = AlarmSettings.of(detector)
    scores = score_stream(detector, broken, settings.hop_samples)
    llr = widened_llr(settings.calibration, scores.score, scores.variance)
    torch.testing.assert_close(found.llr, llr[: len(found.llr)], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.probability, torch.sigmoid(found.llr), rtol=1e-12, atol=0)
    assert (found.llr.abs() < settings.calibration.llr(found.score).abs()).all()


def test_sensors_die_and_come_back_in_the_middle_of_a_stream(detector):
    live, parts = StreamingDetector(detector, dtype=torch.float64), []
    thirds = SAMPLES.T.tensor_split(3)
    for third, dead in zip(thirds, ([], ["SG1", "PVDF2"], []), strict=True):
        live.masked_channels = dead
        assert live.masked_channels == tuple(dead)
        parts.append(live.push(third))
    assert [bool(part.is_valid.all()) for part in parts] == [True, False, True]
    assert not parts[1].is_valid.any()
    whole = StreamingDetector(detector, dtype=torch.float64).push(SAMPLES.T)
    kept, score = (torch.cat([getattr(p, n) for p in parts]) for n in ("is_valid", "score"))
    torch.testing.assert_close(score[kept], whole.score[kept], rtol=1e-9, atol=1e-9)
    assert (score[~kept] != whole.score[~kept]).all()
