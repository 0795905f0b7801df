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
    dtype_info, source = torch.finfo(dtype), generated.generator(0)
    few = torch.randint(-2, 3, (4, 24, NUM), generator=source).to(dtype)
    highest = dtype_info.max if dtype == torch.float32 else dtype_info.max / 2.0**66
    for bins in (few.sign() * highest, few * (dtype_info.tiny * dtype_info.eps)):
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
def test_float32_is_right_or_silent_at_an_offset_of_1e3(kind, vibration, rng):
    """Against float64 on the same float32 input; a tone leaves branches of rounding alone."""
    wide = 1e3 + vibration * vibrations(kind, 40, rng)
    bins = torch.from_numpy(wide).float()
    single, double = POOL(bins).double(), POOL(bins.double())
    least = 64 * torch.finfo(torch.float32).eps * bins.abs().amax(-1)
    silent = bins.amax(-1) - bins.amin(-1) <= least
    channel = torch.tensor([POOL.hand.names.index(name.channel) for name in POOL.names])
    excused = silent[:, channel]
    error = (single - double).abs() / double.abs().clamp(min=torch.finfo(torch.float32).tiny)
    for descriptors, limit in ((("std",), 0.01), (SHAPES, 0.05)):
        mine = torch.tensor([name.descriptor in descriptors for name in POOL.names])
        assert mine.any()
        assert bool(((error < limit) | excused | ~mine).all())
    if vibration == 1e-2:
        assert not silent.any()


def test_a_branch_far_smaller_than_its_bin_is_kept():
    """Its span is below 16 eps32 of the offset; branches are float64 in either arithmetic."""
    t = torch.arange(100) / 2000
    bins = (1e3 + 1e-2 * torch.sin(2 * torch.pi * 50 * t)).expand(24, 100).float()
    branch = next(i for i, n in enumerate(POOL.names) if str(n) == "PVDF1 D1 time std")
    assert POOL(bins)[branch] > 0
    native = FeaturePool(POOL.hand, arithmetic="native")
    torch.testing.assert_close(native(bins)[branch], POOL(bins)[branch])
