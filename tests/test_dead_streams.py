"""Streams of hands with dead sensors: live, whole, and by the command."""

import pytest
import torch
from small_detector import HAND, alarming_detector

from tactslip_torch.deploy.check import simulated_stream
from tactslip_torch.onset.streaming import StreamingDetector

SAMPLES = simulated_stream(HAND, 2000.0, torch.float64)


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


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
