"""What holds of the pool for every bin there can be: extremes and ordinary ones, side by side."""

import math

import generated
import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch import FeaturePool, HandLayout

HAND = HandLayout.paper24()
NUM = 100
POOL = FeaturePool(HAND)
BACKENDS = {name: FeaturePool(HAND, backend=name) for name in ("torch", "auto")}
NAMES = oracles.pool_names()
PLAIN = [" ".join(name) for name in NAMES]
CHANNEL_OF = {name: i for i, name in enumerate(HAND.names)}
DTYPES = [torch.float64, torch.float32]


def columns(descriptor, domain=None):
    """Columns of a descriptor, in an order that all descriptors of a domain share."""
    return [i for i, n in enumerate(NAMES) if n[3] == descriptor and domain in (None, n[2])]


def assert_none(wrong, batch, what):
    """No feature of ``wrong [N, 2582]`` is True."""
    found = batch.blame(wrong, PLAIN, CHANNEL_OF)
    assert not found, f"{what}: {found}"


def batches(num, dtype):
    return generated.batches(num, dtype, len(HAND), NUM)


# Values --------------------------------------------------------------------------------------

SLACK = 16 * NUM  # eps that sums of 100 may cost a bound


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", DTYPES)
@settings(max_examples=8)
@given(data=st.data())
def test_every_value_is_finite_and_ratios_of_energies_add_up_to_one(dtype, backend, data):
    batch = data.draw(batches(32, dtype))
    features = BACKENDS[backend](batch.bins)
    assert features.dtype == dtype
    assert_none(~features.isfinite(), batch, "not finite")
    ratios = features[:, columns("band_energy_ratio")].double().unflatten(-1, (10, 8)).sum(-1)
    is_zero = (batch.bins[:, 14:] == 0).all(-1)
    slack = SLACK * torch.finfo(dtype).eps
    assert torch.equal(ratios == 0, is_zero)
    assert (ratios[~is_zero] - 1).abs().max() <= slack


@pytest.mark.parametrize("dtype", DTYPES)
@settings(max_examples=10)
@given(data=st.data())
def test_validity_is_its_rule(dtype, data):
    """In longdouble, where neither the span nor 64 eps of the magnitude is rounded."""
    bins = data.draw(batches(16, dtype)).bins.clone()
    bins[0, 5, 3], bins[1, 20, 99], bins[2, 0, 0] = math.nan, math.inf, -math.inf
    bins[:, 7] = 1  # with spans of 56 to 71 eps
    bins[:, 7, 50] = 1 - torch.arange(56, 72) * torch.finfo(dtype).eps
    exact = bins.numpy().astype(np.longdouble)
    with np.errstate(invalid="ignore"):  # the NaN and Inf just put there
        span, size = np.ptp(exact, axis=-1), np.abs(exact).max(-1)
    expected = np.isfinite(size) & (span > 64 * np.longdouble(torch.finfo(dtype).eps) * size)
    assert np.array_equal(POOL.validity(bins).numpy(), expected)


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=10)
@given(data=st.data())
def test_float32_bins_give_what_they_give_in_float64_rounded_once(backend, data):
    batch = data.draw(batches(32, torch.float32))
    largest = torch.finfo(torch.float32).max
    exact = BACKENDS[backend](batch.bins.double())
    expected = exact.clamp(-largest, largest).float()
    assert_none(BACKENDS[backend](batch.bins) != expected, batch, "float32 differs")


# Gradients -----------------------------------------------------------------------------------


def where_not_finite(bins):
    """Channels of the bins in which the gradient of the sum of all features is not finite."""
    bins = bins.clone().requires_grad_()
    POOL(bins).backward(torch.ones(len(bins), len(NAMES), dtype=bins.dtype))
    return (~bins.grad.isfinite()).any(-1).nonzero().tolist()


@pytest.mark.parametrize("dtype", DTYPES)
@settings(max_examples=12)
@given(data=st.data())
def test_gradients_are_finite(dtype, data):
    batch = data.draw(batches(8, dtype))
    assert [(HAND.names[c], batch.kinds[row][c]) for row, c in where_not_finite(batch.bins)] == []


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_are_finite_at_both_ends_of_the_dtype(dtype):
    """Above 1e290 V, which float64 alone has, the gradient of a spectrum may overflow."""
    facts, source = torch.finfo(dtype), generated.generator(0)
    few = torch.randint(-2, 3, (4, 24, NUM), generator=source).to(dtype)
    highest = facts.max if dtype == torch.float32 else facts.max / 2.0**66
    for bins in (few.sign() * highest, few * (facts.tiny * facts.eps)):
        assert where_not_finite(bins) == []


# Who influences whom -------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", DTYPES)
@settings(max_examples=8)
@given(data=st.data())
def test_a_bin_speaks_for_itself_alone(dtype, backend, data):
    """Bit by bit, whatever the other bins are, NaN too, and however the batch is folded."""
    batch, other = data.draw(batches(16, dtype)), data.draw(batches(16, dtype))
    is_kept = torch.rand(16, generator=generated.generator(batch.drawn)) < 0.5
    others = torch.where(torch.arange(16)[:, None, None] % 3 == 0, math.nan, other.bins)
    mixed = torch.where(is_kept[:, None, None], batch.bins, others)
    features = BACKENDS[backend](batch.bins)
    wrong = is_kept[:, None] & (BACKENDS[backend](mixed) != features)
    assert_none(wrong, batch, "another bin shows")
    folded = BACKENDS[backend](batch.bins.reshape(2, 8, 24, NUM)).flatten(0, 1)
    assert_none(folded != features, batch, "folding shows")


SHAPES = ("cv", "skewness", "kurtosis", "peak_factor", "correlation", "entropy")
SHAPES += ("spectral_centroid", "spectral_spread", "band_energy_ratio")


def vibrations(kind, num_bins, rng):
    """Unit vibrations ``[num_bins, 24, 100]``."""
    t = np.arange(100) / 2000
    if kind == "noise":
        return rng.standard_normal((num_bins, 24, 100))
    hertz = rng.uniform(20, 400, (num_bins, 24, 1))
    phase = rng.uniform(0, 2 * np.pi, (num_bins, 24, 1))
    return np.sin(2 * np.pi * hertz * t + phase)


@pytest.mark.parametrize("vibration", [1e-2, 1e-3])
@pytest.mark.parametrize("kind", ["noise", "tone"])
def test_float32_is_right_or_flagged_at_an_offset_of_1e3(kind, vibration, rng):
    """Against float64 on the same float32 input; a tone leaves branches of rounding alone."""
    wide = 1e3 + vibration * vibrations(kind, 40, rng)
    bins = torch.from_numpy(wide).float()
    single, double = POOL(bins).double(), POOL(bins.double())
    flagged = ~POOL.validity(bins)
    channel = torch.tensor([POOL.hand.names.index(name.channel) for name in POOL.names])
    excused = flagged[:, channel]
    error = (single - double).abs() / double.abs().clamp(min=torch.finfo(torch.float32).tiny)
    for descriptors, limit in ((("std",), 0.01), (SHAPES, 0.05)):
        mine = torch.tensor([name.descriptor in descriptors for name in POOL.names])
        assert mine.any()
        assert bool(((error < limit) | excused | ~mine).all())
    if vibration == 1e-2:
        assert not flagged.any()


def test_a_branch_far_smaller_than_its_bin_is_kept_or_flagged():
    """Its span is below 16 eps32 of the offset; branches are float64 in either arithmetic."""
    t = torch.arange(100) / 2000
    bins = (1e3 + 1e-2 * torch.sin(2 * torch.pi * 50 * t)).expand(24, 100).float()
    branch = next(i for i, n in enumerate(POOL.names) if str(n) == "PVDF1 D1 time std")
    assert POOL(bins)[branch] > 0
    assert POOL.validity(bins).all()
    native = FeaturePool(POOL.hand, arithmetic="native")
    films = list(native.hand.indices("PVDF"))
    torch.testing.assert_close(native(bins)[branch], POOL(bins)[branch])
    assert not native.validity(bins)[films].any()
    assert native.validity(bins)[list(native.hand.indices("SG"))].all()
    assert native.validity(bins - 1e3)[films].all()
    assert native.validity(bins.double()).all()


def test_what_leaves_float64_on_its_way_counts_as_missing():
    """Rail to rail at its end: the samples are finite, their branches are not."""
    bins = torch.full((2, 24, 100), torch.finfo(torch.float64).max, dtype=torch.float64)
    bins[:, :, ::2] *= -1
    bins[1] /= 64
    assert POOL.is_missing(bins).all(-1).tolist() == [True, False]
    assert POOL.validity(bins).all(-1).tolist() == [False, True]
    assert POOL(bins[1]).isfinite().all()
    assert POOL.validity(torch.full((24, 100), 3e38).cumsum(-1).clamp(max=3.4e38)).all()
