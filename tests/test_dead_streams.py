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


@pytest.fixture(scope="module")
def detector():
    return alarming_with_gaussians()


@pytest.fixture(scope="module")
def samples():
    return simulated_stream(HAND, 2000.0, torch.float64)


def test_probability_and_statistic_are_of_the_widened_ratio(detector, samples):
    found = StreamingDetector(detector, dtype=torch.float64, masked_channels="PVDF1").push(
        samples.T
    )
    broken = samples.clone()
    broken[2] = torch.nan
    scores = score_stream(detector, broken, AlarmSettings.of(detector).hop_samples)
    calibration = AlarmSettings.of(detector).calibration
    llr = widened_llr(calibration, scores.score, scores.variance)
    torch.testing.assert_close(found.llr, llr[: len(found.llr)], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.probability, torch.sigmoid(found.llr), rtol=1e-12, atol=0)
    assert (found.llr.abs() < calibration.llr(found.score).abs()).all()


def test_sensors_die_and_come_back_in_the_middle_of_a_stream(detector, samples):
    live = StreamingDetector(detector, dtype=torch.float64)
    thirds = samples.T.tensor_split(3)
    parts = []
    for third, dead in zip(thirds, ([], ["SG1", "PVDF2"], []), strict=True):
        live.masked_channels = dead
        assert live.masked_channels == tuple(dead)
        parts.append(live.push(third))
    assert [bool(part.is_valid.all()) for part in parts] == [True, False, True]
    assert not parts[1].is_valid.any()
    whole = StreamingDetector(detector, dtype=torch.float64).push(samples.T)
    kept = torch.cat([part.is_valid for part in parts])
    score = torch.cat([part.score for part in parts])
    torch.testing.assert_close(score[kept], whole.score[kept], rtol=1e-9, atol=1e-9)
    assert (score[~kept] != whole.score[~kept]).all()
