"""Filters without a name: what is refused, and that they are as good as a named wavelet."""

import json

import numpy as np
import pytest
import pywt
import torch
from small_detector import HAND

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.rounding import is_rounding
from tactslip_torch.onset.baselines import largest_detail
from tactslip_torch.signals.wavelet import (
    WaveletFilters,
    as_wavelet,
    branch_matrix,
    highest_level,
    wavelet_branches,
    wavelet_fact,
)

FILTERS = ("dec_lo", "dec_hi", "rec_lo", "rec_hi")


def filters_of(name):
    return WaveletFilters(f"as {name}", *(tuple(taps) for taps in pywt.Wavelet(name).filter_bank))


@pytest.mark.parametrize("name", ["rbio2.2", "haar", "db3", "bior2.4"])
def test_the_filters_of_a_named_wavelet_are_that_wavelet(name):
    filters = filters_of(name)
    level = highest_level(100, filters)
    assert level == highest_level(100, name)
    assert torch.equal(branch_matrix(100, filters, level), branch_matrix(100, name, level))


def test_features_alarms_and_rounding_take_filters(rng):
    bins = torch.from_numpy(rng.standard_normal((3, 4, 100)))
    named, own = FeaturePool(HAND), FeaturePool(HAND, wavelet=filters_of("rbio2.2"))
    assert torch.equal(own(bins), named(bins))
    assert torch.equal(largest_detail(bins, [2, 3], own.wavelet), largest_detail(bins, [2, 3]))
    assert not is_rounding(own).any()
    of_haar = FeaturePool(HAND, wavelet=filters_of("haar"))
    assert torch.equal(is_rounding(of_haar), is_rounding(FeaturePool(HAND, wavelet="haar")))


def test_a_pool_comes_back_from_its_facts():
    pool = FeaturePool(HAND, wavelet=filters_of("bior2.2"))
    again = FeaturePool(HAND, **json.loads(json.dumps(pool.facts())))
    assert again.wavelet == pool.wavelet
    assert hash(again.wavelet) == hash(pool.wavelet)
    assert again.facts() == pool.facts()
    assert FeaturePool(HAND).facts()["wavelet"] == "rbio2.2"


def test_filters_come_back_exactly(rng):
    low, high, low_back, high_back = pywt.Wavelet("rbio2.2").filter_bank
    scale = float(rng.uniform(0.3, 3))  # of no short decimal
    taken = [tuple(scale * tap for tap in taps) for taps in (low, high)]
    back = [tuple(tap / scale for tap in taps) for taps in (low_back, high_back)]
    filters = WaveletFilters("scaled", *taken, *back)
    again = as_wavelet(json.loads(json.dumps(wavelet_fact(filters))))
    assert again == filters
    assert (len(filters), str(filters)) == (6, "scaled")
    assert [tuple(taps.tolist()) for taps in filters.bank] == [*taken, *back]
    torch.testing.assert_close(
        branch_matrix(100, filters), branch_matrix(100), rtol=0, atol=1e-13
    )  # gains cancel in a branch


def test_a_level_too_many_is_refused_by_name():
    with pytest.raises(ValueError, match=r"level must lie in 1\.\.4 .* as rbio2\.2, got 5"):
        branch_matrix(100, filters_of("rbio2.2"), 5)
    with pytest.raises(ValueError, match=r"too short for a level of as db3"):
        highest_level(8, filters_of("db3"))


def haar_but(**taps):
    facts = filters_of("haar").to_dict() | taps
    return {key: value for key, value in facts.items() if value is not None}


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        (haar_but(rec_lo=None), "have the keys name, dec_lo, .* got name, dec_lo, dec_hi"),
        (haar_but(more=[1.0]), "have the keys"),
        (haar_but(name=""), "need a name, got ''"),
        (haar_but(dec_lo=[0.7]), "one even length, got 1, 2, 2, 2"),
        ({"name": "odd"} | {name: [1.0, 2.0, 1.0] for name in FILTERS}, "got 3, 3, 3, 3"),
        ({"name": "none"} | {name: [] for name in FILTERS}, "one even length, got 0, 0, 0, 0"),
        (haar_but(dec_lo=[0.7, float("nan")]), "dec_lo must be finite"),
        (haar_but(dec_hi="ab"), "dec_hi must hold numbers, got 'ab'"),
        (haar_but(dec_hi=3), "dec_hi must hold numbers, got 3"),
        (haar_but(dec_lo=[0.7, 0.7]), r"do not reconstruct: off by 1\.0e-02"),
    ],
)
def test_what_is_no_wavelet_is_refused_in_one_line(facts, message):
    with pytest.raises(ValueError, match=message) as error:
        as_wavelet(facts)
    assert "\n" not in str(error.value)


def test_an_approximation_of_pywavelets_does_not_reconstruct():
    with pytest.raises(ValueError, match=r"as dmey do not reconstruct: off by"):
        filters_of("dmey")


def test_a_constant_must_have_no_detail():
    def taken(low, high):
        """With filters that put together again what these take apart."""
        determinant = low[0] * high[1] - low[1] * high[0]
        rec_lo, rec_hi = np.array([-high[0], high[1]]), np.array([low[0], -low[1]])
        return low, high, rec_lo / determinant, rec_hi / determinant

    low, high = np.array([0.5, 1.0]), np.array([-1.0, 1.0])
    x = torch.arange(10.0, dtype=torch.float64)
    branches = wavelet_branches(x, WaveletFilters("lopsided", *taken(low, high)), 1)
    torch.testing.assert_close(branches.sum(-2), x)
    with pytest.raises(
        ValueError, match=r"dec_hi of tilted sums to 1\.5e-01.* must have no detail"
    ):
        WaveletFilters("tilted", *taken(low, high + 0.1 * low))


@pytest.mark.parametrize("wavelet", [None, 3, ["rbio2.2"]])
def test_a_wavelet_is_a_name_or_filters(wavelet):
    with pytest.raises(ValueError, match="a wavelet is a name or its filters, got"):
        FeaturePool(HAND, wavelet=wavelet)
