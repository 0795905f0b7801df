"""Hands of other channels, kinds, rates, bins and wavelets: from noise to an exported detector."""

from types import SimpleNamespace

import pytest
import torch
from any_hands import HANDS, detector_of
from oracles import assert_columns_close
from test_commands import composed

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.features.pool import is_rounding
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.training.experiment import feature_maker

any_hand = pytest.mark.parametrize("name", HANDS)


@any_hand
def test_the_engine_gives_the_reference(name):
    pool = HANDS[name].pool()
    bins, _ = HANDS[name].noise(12, pool.bin_samples, seed=0)
    firm = (~is_rounding(pool)).nonzero().flatten().tolist()
    found, expected = (pool.select(firm, backend)(bins) for backend in ("auto", "torch"))
    assert_columns_close(found, expected.numpy(), 1e-9)


@any_hand
def test_a_detector_tells_slip_and_comes_back_from_its_file(name, tmp_path):
    hand, detector = HANDS[name], detector_of(name)
    num = hand.bin_samples + 2 * detector.channel_filter.context
    samples, is_slip = hand.noise(200, num, seed=2)
    score = detector.score_raw(samples)
    assert ((score >= 0) == is_slip).double().mean() > 0.7  # one channel knows little
    one, again = tmp_path / "detector.pt", tmp_path / "again.pt"
    detector.save(one)
    loaded = SlipDetector.load(one, backend="auto")
    assert loaded.pool.hand == detector.pool.hand == hand.layout()
    assert loaded.pool.config() == detector.pool.config()
    assert loaded.channel_filter.config() == detector.channel_filter.config()
    assert torch.equal(loaded.score_raw(samples), score)
    loaded.save(again)
    assert again.read_bytes() == one.read_bytes()


# From the configuration ----------------------------------------------------------------------


def parts_of(bin_ms=50.0, **changes):
    """Pool and filter from the ``features`` section, which no recording is read for."""
    source = SimpleNamespace(
        hand=HANDS["five slow"].layout(), sample_rate_hz=1000.0, is_simulated=False
    )
    features = {"frames": {"SG": 5, "PVDF": 5, "force": None}, **changes}
    maker = feature_maker(source, LabelRule(bin_ms=bin_ms), **{**composed().features, **features})
    return maker.pool, maker.channel_filter


@pytest.mark.parametrize(
    ("bin_ms", "wavelet", "expected"),
    [(50, "rbio2.2", 3), (200, "rbio2.2", 4), (30, "db3", 2), (10, "rbio2.2", 1), (1000, "db1", 4)],
)
def test_a_level_of_null_is_as_many_as_there_can_be(bin_ms, wavelet, expected):
    assert parts_of(bin_ms, wavelet=wavelet, level=None)[0].level == expected


def test_a_frame_of_null_or_one_filters_nothing():
    _, channel_filter = parts_of(level=3)
    assert sorted(channel_filter.window_lengths) == [1, 1, 5, 5, 5]
    same = parts_of(level=3, frames={"SG": 5, "force": 1})[1]
    assert same.window_lengths == channel_filter.window_lengths


REFUSED = [
    (50, {"level": 4}, r"level must lie in 1\.\.3 for bins of 50 .*=rbio2.2, got 4; .* or null"),
    (9, {}, "bins of 9 samples are too short for a level of rbio2.2, which needs 10"),
    (50, {"wavelet": "db99"}, "unknown wavelet 'db99'"),
    (50, {"level": 3, "frames": {"SG": 5}}, r"for force .* \+features.frames.force=11, or null"),
    (50, {"level": 3, "frames": {"SG": 4, "force": 1}}, "frames.SG must be an odd .* got 4"),
]


@pytest.mark.parametrize(("bin_ms", "changes", "message"), REFUSED)
def test_features_that_a_hand_cannot_have_are_refused_in_one_line(bin_ms, changes, message):
    with pytest.raises(ValueError, match=message):
        parts_of(bin_ms, **changes)
