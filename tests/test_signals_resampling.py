"""Samples at another rate against closed forms, and channels of several rates brought together."""

import math

import numpy as np
import pytest
import scipy.signal
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.signals.resampling import MOST_CUT_S, bring_together, resample

RATES = [
    (2000.0, 1000.0),
    (1000.0, 2000.0),
    (2000.0, 48.0),
    (92.3, 100.0),
    (100.0, 92.3),
    (44.1, 2000.0),
    (2000.0, 2048.0),
]


def tone(hz, rate_hz, num, phase=0.7, offset=0.0):
    times_s = torch.arange(num, dtype=torch.float64) / rate_hz
    return (offset + torch.sin(2 * math.pi * hz * times_s + phase))[None]


def middle(x, margin):
    return x[..., margin:-margin]


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES)
@pytest.mark.parametrize("part", [0.03, 0.3, 0.6, 0.8])
def test_a_tone_below_half_the_lower_rate_keeps_amplitude_and_phase(from_hz, to_hz, part):
    hz, low = part * min(from_hz, to_hz) / 2, min(from_hz, to_hz)
    found = resample(tone(hz, from_hz, round(200 * from_hz / low), offset=3.0), from_hz, to_hz)
    expected = tone(hz, to_hz, found.shape[-1], offset=3.0)
    error = middle(found - expected, math.ceil(10 * to_hz / low) + 1).abs().max()
    assert error < 5e-3


@pytest.mark.parametrize(("from_hz", "to_hz"), [(2000.0, 1000.0), (2000.0, 100.0), (100.0, 61.0)])
@pytest.mark.parametrize("part", [1.2, 1.35, 1.6])
def test_a_tone_above_half_the_new_rate_does_not_fold_back(from_hz, to_hz, part):
    hz = part * to_hz / 2
    found = resample(tone(hz, from_hz, round(200 * from_hz / to_hz)), from_hz, to_hz)
    assert middle(found, 11).abs().max() < 5e-3
    every = tone(hz, from_hz, 4000)[:, :: round(from_hz / to_hz)]
    assert every.abs().max() > 0.5  # left out samples alone would have folded it


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_stays_one_to_its_ends(from_hz, to_hz, dtype):
    x = torch.tensor([[1.7], [-1e6], [0.0]], dtype=dtype).expand(3, 50).contiguous()
    before = x.clone()
    found = resample(x, from_hz, to_hz)
    assert found.dtype == dtype
    assert found.shape == (3, math.ceil(50 * to_hz / from_hz))
    torch.testing.assert_close(found, x[:, :1].expand_as(found), rtol=1e-6, atol=0)
    assert torch.equal(x, before)


def test_away_from_the_ends_it_is_scipys(rng):
    x = torch.from_numpy(rng.standard_normal((3, 400)))
    x -= x.mean(-1, keepdim=True)
    found = resample(x, 500.0, 300.0)
    expected = scipy.signal.resample_poly(x.numpy(), 3, 5, axis=-1)
    np.testing.assert_allclose(middle(found, 10), expected[:, 10:-10], rtol=0, atol=1e-13)


@given(
    num=st.integers(0, 40),
    up=st.integers(1, 30),
    down=st.integers(1, 30),
    scale=st.sampled_from([0.1, 1.0, 92.3]),
)
def test_the_length_is_that_of_the_stretch_of_time(num, up, down, scale):
    found = resample(torch.ones(2, num), down * scale, up * scale)
    assert found.shape == (2, -(-num * up // down))
    assert (found == 1).all()


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 577, 1199])
def test_what_is_not_finite_spoils_what_reaches_it_and_nothing_else(
    from_hz, to_hz, bad, place, rng
):
    x = torch.from_numpy(rng.standard_normal((2, 1200)))
    whole = resample(x, from_hz, to_hz)
    x[1, place] = bad
    found = resample(x, from_hz, to_hz)
    torch.testing.assert_close(found[0], whole[0], rtol=0, atol=0)
    away_s = (torch.arange(found.shape[1]) / to_hz - place / from_hz).abs()
    reach_s = 10 / min(from_hz, to_hz)
    assert found[1, away_s < 0.999 * reach_s].isnan().all()
    far = away_s > 1.001 * reach_s
    assert far.any()
    moved = x[1].clone()
    moved[place] = 0.0
    assert found[1, far].isfinite().all()
    expected = resample(moved[None], from_hz, to_hz)[0, far]
    torch.testing.assert_close(found[1, far], expected, rtol=0, atol=1e-3)  # of another mean


def test_all_nan_stays_so():
    assert resample(torch.full((1, 30), torch.nan), 100.0, 150.0).isnan().all()


def test_the_same_rate_gives_the_same_samples_in_other_memory():
    x = torch.tensor([[1.0, math.nan, -0.0]])
    found = resample(x, 92.3, 92.3)
    assert found.numpy().tobytes() == x.numpy().tobytes()
    assert found.data_ptr() != x.data_ptr()


def test_rates_are_ratios_as_they_are_written():
    assert resample(torch.ones(1, 923), 92.3, 100.0).shape == (1, 1000)
    measured = resample(torch.ones(1, 1000), 1999.8734217, 2000.0)  # near enough to 15801 / 15800
    assert measured.shape == (1, 1001)


@pytest.mark.parametrize(
    ("samples", "from_hz", "to_hz", "message"),
    [
        (torch.ones(5), 1.0, 2.0, r"samples \[C, T\] to resample, got torch.float32 \(5,\)"),
        (torch.ones(1, 5).int(), 1.0, 2.0, "got torch.int32"),
        (torch.ones(1, 5), 0.0, 2.0, "rate must be positive to resample, got 0 Hz"),
        (torch.ones(1, 5), 1.0, math.inf, "got inf Hz"),
        (torch.ones(1, 5), math.nan, 1.0, "got nan Hz"),
        (torch.ones(1, 5), 2000.0, 2000.008, "from 2000 to 2000.008 Hz is no ratio of whole"),
        (torch.ones(1, 5), 1e6, 1.0, "from 1000000 to 1 Hz is no ratio"),
    ],
)
def test_what_cannot_be_resampled_is_refused_in_one_line(samples, from_hz, to_hz, message):
    with pytest.raises(ValueError, match=message) as refused:
        resample(samples, from_hz, to_hz)
    assert "\n" not in str(refused.value)


# Several rates -------------------------------------------------------------------------------


def test_parts_of_several_rates_tell_one_time():
    slow, fast = tone(3.0, 100.0, 200), tone(3.0, 2200.0, 4400).expand(2, -1)
    found = bring_together([(slow, 100.0), (fast.float(), 2200.0)], 400.0)
    assert found.dtype == torch.float64
    assert found.shape == (3, 800)
    expected = tone(3.0, 400.0, 800)
    assert middle(found - expected, 41).abs().max() < 5e-3


def test_parts_of_one_rate_are_put_together_and_end_with_the_shortest():
    parts = [(torch.ones(2, 100), 1000.0), (torch.zeros(1, 103), 1000.0)]
    found = bring_together(parts)
    assert torch.equal(found, torch.cat([torch.ones(2, 100), torch.zeros(1, 100)]))
    assert found.dtype == torch.float32
    assert bring_together(parts, 500.0).shape == (3, 50)


@pytest.mark.parametrize(
    ("parts", "to_hz", "message"),
    [
        ([], 100.0, "nothing to bring together"),
        (
            [(torch.ones(1, 20), 100.0), (torch.ones(1, 400), 2000.0), (torch.ones(1, 20), 100.0)],
            None,
            "channels come at 100, 2000 Hz; .* data.resample_hz=2000",
        ),
        (
            [(torch.ones(1, 100), 100.0), (torch.ones(1, 2400), 2000.0)],
            100.0,
            f"last 1 to 1.2 s; cut them to lengths within {MOST_CUT_S:g} s",
        ),
        ([(torch.ones(1, 20), 100.0), (torch.ones(1, 1), -1.0)], 100.0, "must be positive"),
        ([(torch.ones(1, 20), 0.0)], None, "must be positive"),
    ],
)
def test_what_does_not_belong_together_is_refused_in_one_line(parts, to_hz, message):
    with pytest.raises(ValueError, match=message) as refused:
        bring_together(parts, to_hz)
    assert "\n" not in str(refused.value)
