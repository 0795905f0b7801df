"""An alarm that promises no rate: k of the last n decisions."""

import math

import pytest
import torch
from small_detector import small_detector

from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.decisions import Decider
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.training.alarm import DebouncedAlarm


def calibrated(**info):
    detector = small_detector(3)
    detector.info["calibration"] = Platt(2.0, -0.5).to_dict()
    detector.info |= info
    return detector


def test_it_is_kept_in_the_file_with_no_rate_promised(tmp_path):
    detector = calibrated()
    assert DebouncedAlarm(k=1, n=4, probability=0.8, slip_share=0.25)(detector) == {}
    detector.save(tmp_path / "a.pt")
    settings = AlarmSettings.of(type(detector).load(tmp_path / "a.pt"))
    assert settings.target_per_hour is None
    assert settings.calibration == Platt(2.0, -0.5)
    assert settings.rule == KOfN(1, 4)
    assert settings.hop_samples == detector.pool.bin_samples // 2
    # at the threshold, odds of slip are those of its share times the likelihood ratio
    odds = math.exp(settings.threshold) * 0.25 / 0.75
    assert odds / (1 + odds) == pytest.approx(0.8)


def test_two_of_three_say_when():
    detector = calibrated()
    DebouncedAlarm(hop_ms=50.0)(detector)
    settings = AlarmSettings.of(detector)
    rate, bin_samples = detector.pool.sample_rate_hz, detector.pool.bin_samples
    assert settings.hop_samples == round(0.05 * rate)
    decider = Decider(settings, rate, bin_samples, 0)
    scores = torch.tensor([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    alarms = decider.decide(scores, torch.ones(len(scores), dtype=torch.bool)).alarms
    assert [round((a.alarm_s * rate - bin_samples) / settings.hop_samples) for a in alarms] == [6]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"k": 4}, "k must lie between 1 and n"),
        ({"probability": 1.0}, "onset.probability must lie between 0 and 1, got 1.0"),
        ({"slip_share": 0.0}, "onset.slip_share must lie between 0 and 1"),
        ({"hop_ms": 0.0}, "onset.hop_ms must be positive"),
        ({"hop_ms": "abc"}, "onset.hop_ms must be positive, or null, got 'abc'"),
        ({"k": "a"}, "onset.k must be a whole number, got 'a'"),
        ({"n": 2.5}, "onset.n must be a whole number, got 2.5"),
        ({"probability": "abc"}, "onset.probability must lie between 0 and 1, got 'abc'"),
        ({"rearm_s": "abc"}, "onset.rearm_s must be seconds from 0, got 'abc'"),
        ({"rearm_s": -1.0}, "onset.rearm_s must be seconds from 0, got -1.0"),
        ({"refractory_s": math.inf}, "onset.refractory_s must be seconds from 0, got inf"),
    ],
)
def test_numbers_that_cannot_be(options, said):
    with pytest.raises(ValueError, match=said):
        DebouncedAlarm(**options)


def test_scores_without_a_calibration_are_refused():
    detector = small_detector(3)
    detector.info.pop("calibration", None)
    with pytest.raises(ValueError, match=r"training chose nothing; give several recipe\.penalties"):
        DebouncedAlarm()(detector)
    detector = calibrated()
    with pytest.raises(ValueError, match=r"onset\.hop_ms=0\.3 is 0\.6 samples"):
        DebouncedAlarm(hop_ms=0.3)(detector)


def test_a_hop_is_half_a_bin_or_so_many_milliseconds():
    assert DebouncedAlarm().hop_samples(2000.0, 100) == 50
    assert DebouncedAlarm().hop_samples(2000.0, 1) == 1
    assert DebouncedAlarm(hop_ms=2.5).hop_samples(2000.0, 100) == 5
    with pytest.raises(ValueError, match=r"onset\.hop_ms=0\.3 is 0\.6 samples"):
        DebouncedAlarm(hop_ms=0.3).hop_samples(2000.0, 100)
