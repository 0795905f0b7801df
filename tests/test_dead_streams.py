"""Streams of hands with dead sensors: live, whole, and by the command."""

from dataclasses import replace

import pytest
import torch
from extremes import slip_samples
from small_detector import HAND, alarming_detector

from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

SAMPLES = slip_samples(HAND)


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
        assert parts[-1].is_valid.all()  # two of four are enough
        assert {parts[-1].names_lost(i) for i in range(len(parts[-1].score))} == {tuple(dead)}
    whole = StreamingDetector(detector, dtype=torch.float64).push(SAMPLES.T)
    kept = torch.cat([~part.channels_lost.any(-1) for part in parts])
    score = torch.cat([part.score for part in parts])
    torch.testing.assert_close(score[kept], whole.score[kept], rtol=1e-9, atol=1e-9)
    assert (score[~kept] != whole.score[~kept]).all()


def test_a_hand_that_is_lost_raises_nothing_and_a_standing_alarm_ends(detector):
    """An alarm stands for ``hold_s`` after the last sample that is known, and no longer."""
    settings = replace(AlarmSettings.of(detector), threshold=-1.0, rearm_s=9.0)
    live = StreamingDetector(detector, settings, dtype=torch.float64)
    before = live.push(SAMPLES[:, :1000].T)
    assert before.is_on[-1]
    lost = live.push(torch.full((2000, 4), torch.nan, dtype=torch.float64))
    assert not lost.is_alarm.any()
    is_known = lost.is_valid
    assert int(is_known.sum()) <= 150 / settings.hop_samples  # whose samples came before
    assert lost.score[~is_known].isnan().all()
    assert lost.channels_lost[~is_known].all()
    lasted_s = lost.available_s[lost.is_on].max() - 0.5
    assert settings.hold_s <= lasted_s <= settings.hold_s + 0.2
    after = live.push(SAMPLES[:, :1000].T)
    assert after.is_alarm.any()
