import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.signals.binning import bins_at, split_bins


@given(
    num_samples=st.integers(1, 60),
    bin_samples=st.integers(1, 20),
    hop_samples=st.none() | st.integers(1, 25),
)
def test_split_equals_slicing(num_samples, bin_samples, hop_samples):
    x = torch.arange(3 * num_samples).reshape(3, num_samples)
    starts = range(0, num_samples - bin_samples + 1, hop_samples or bin_samples)
    if not starts:
        with pytest.raises(ValueError, match=rf"{bin_samples}.*{num_samples}"):
            split_bins(x, bin_samples, hop_samples)
        return
    expected = torch.stack([x[:, s : s + bin_samples] for s in starts])
    assert torch.equal(split_bins(x, bin_samples, hop_samples), expected)


@given(starts=st.lists(st.integers(0, 50), max_size=9), bin_samples=st.integers(1, 10))
def test_bins_at_equals_slicing(starts, bin_samples):
    x = np.arange(120.0).reshape(2, 60)
    expected = np.array([x[:, s : s + bin_samples] for s in starts]).reshape(-1, 2, bin_samples)
    actual = bins_at(torch.from_numpy(x), torch.tensor(starts, dtype=torch.long), bin_samples)
    assert torch.equal(actual, torch.from_numpy(expected))


def test_manners(rng, device):
    x = torch.from_numpy(oracles.random_bins(rng, 4, 3, 105)).to(device)
    oracles.assert_manners(lambda x: split_bins(x, 20, 7), x, num_axes=2)
    bins = bins_at(x[0].float(), torch.tensor([5, 0, 5], device=device), 10)
    assert (bins.dtype, bins.device.type) == (torch.float32, device.type)


def test_gradients_count_how_often_a_sample_is_used():
    x = torch.zeros(1, 6, requires_grad=True)
    split_bins(x, 4, 2).sum().backward()
    assert x.grad.tolist() == [[1, 1, 2, 2, 1, 1]]
    x.grad = None
    bins_at(x, torch.tensor([0, 0, 2]), 2).sum().backward()
    assert x.grad.tolist() == [[2, 2, 1, 1, 0, 0]]


@pytest.mark.parametrize(("bin_samples", "hop_samples"), [(0, None), (-1, None), (5, 0), (5, -2)])
def test_lengths_must_be_positive(bin_samples, hop_samples):
    with pytest.raises(ValueError, match="positive"):
        split_bins(torch.zeros(1, 20), bin_samples, hop_samples)


@pytest.mark.parametrize("start", [-1, 51, 1000])
def test_a_bin_may_not_leave_the_recording(start):
    with pytest.raises(ValueError, match=rf"10 samples at sample {start}\b.*60 samples"):
        bins_at(torch.zeros(2, 60), torch.tensor([0, start]), 10)
