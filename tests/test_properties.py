"""What holds of the pool for every bin there can be: extremes and ordinary ones, side by side."""

import pytest
import torch
from extremes import batches
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch import FeaturePool, HandLayout

HAND = HandLayout.paper24()
POOLS = {name: FeaturePool(HAND, backend=name) for name in ("torch", "auto")}
each_backend = pytest.mark.parametrize("backend", POOLS)
each_dtype = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])


@each_backend
@each_dtype
@settings(max_examples=6)
@given(data=st.data())
def test_every_value_is_finite_and_ratios_of_energies_add_up_to_one(dtype, backend, data):
    bins, pool = data.draw(batches((32, len(HAND), 100), dtype)), POOLS[backend]
    features = pool(bins)
    assert features.dtype == dtype
    assert features.isfinite().all()
    ratio = [name.descriptor == "band_energy_ratio" for name in pool.names]
    sums = features[:, torch.tensor(ratio)].double().unflatten(-1, (len(HAND.fast), -1)).sum(-1)
    is_zero = (bins[:, HAND.fast] == 0).all(-1)
    assert torch.equal(sums == 0, is_zero)
    slack = 1600 * torch.finfo(dtype).eps  # of sums of 100
    assert (sums[~is_zero] - 1).abs().max() <= slack


@each_backend
@settings(max_examples=6)
@given(bins=batches((32, len(HAND), 100), torch.float32))
def test_float32_bins_give_what_they_give_in_float64_rounded_once(backend, bins):
    largest = torch.finfo(torch.float32).max
    expected = POOLS[backend](bins.double()).clamp(-largest, largest).float()
    assert torch.equal(POOLS[backend](bins), expected)


@each_dtype
@settings(max_examples=8)
@given(data=st.data())
def test_gradients_are_finite(dtype, data):
    bins = data.draw(batches((8, len(HAND), 100), dtype)).requires_grad_()
    POOLS["torch"](bins).sum().backward()
    assert bins.grad.isfinite().all()
