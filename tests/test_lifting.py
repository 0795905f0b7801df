"""A wavelet that is learned is a wavelet, whatever was learned; it starts at a named one."""

import numpy as np
import oracles
import pytest
import pywt
import torch
from hypothesis import given
from hypothesis import strategies as st
from ptwt.wavelets_learnable import ProductFilter
from small_detector import HAND
from torch.func import functional_call

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.filter_bank import WaveletFilters
from tactslip_torch.signals.lifting import LiftedWavelet
from tactslip_torch.signals.wavelet import branch_matrix, highest_level

FAMILIES = ["rbio2.2", "bior2.2", "rbio1.3", "bior1.3", "rbio2.4", "bior2.8", "rbio1.5", "haar"]


def moved(name, seed, size=0.5):
    """A learned wavelet, with parameters of such a size."""
    wavelet, generator = LiftedWavelet(name), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in wavelet.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(size * noise)
    return wavelet


@pytest.mark.parametrize("name", FAMILIES)
def test_it_starts_at_the_named_wavelet(name):
    wavelet = LiftedWavelet(name)
    for found, expected in zip(wavelet.filter_bank, pywt.Wavelet(name).filter_bank, strict=True):
        np.testing.assert_allclose(found.detach().numpy(), expected, rtol=0, atol=1e-15)
    level = min(4, highest_level(100, name))
    matrix = wavelet.branch_matrix(100, level)
    assert (matrix - branch_matrix(100, name, level)).abs().max() < 1e-14


@given(
    name=st.sampled_from(FAMILIES), seed=st.integers(0, 2**31), size=st.sampled_from([0.1, 1, 3])
)
def test_whatever_was_learned_reconstructs(name, seed, size):
    bank = [taps.detach() for taps in moved(name, seed, size).filter_bank]
    largest = max(1.0, *(float(taps.abs().max()) for taps in bank))
    assert ProductFilter(*bank).wavelet_loss() < 1e-20 * largest**4  # squares of products
    for high in (bank[1], bank[3]):  # neither wavelet feels a constant
        assert abs(high.sum()) < 1e-14 * largest * len(high)
    assert float(bank[0].sum()) == pytest.approx(2**0.5, abs=1e-13 * largest)


@pytest.mark.parametrize("name", FAMILIES)
def test_its_branches_add_up_and_are_pywavelets(name, rng):
    wavelet = moved(name, seed=3)
    level = min(3, highest_level(100, name))
    x = torch.from_numpy(rng.standard_normal(100))
    branches = wavelet.branch_matrix(100, level).detach() @ x
    torch.testing.assert_close(branches[0] + branches[1], x, rtol=0, atol=1e-12)
    frozen = wavelet.frozen()
    bank = (frozen.dec_lo, frozen.dec_hi, frozen.rec_lo, frozen.rec_hi)
    expected = oracles.wavelet_branches(x.numpy(), pywt.Wavelet("own", bank), level)
    np.testing.assert_allclose(branches.numpy(), expected, rtol=0, atol=1e-12)
    constant = wavelet.branch_matrix(100, level).detach() @ torch.ones(100).double()
    torch.testing.assert_close(constant[::2], torch.ones(level, 100).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close(constant[1::2], torch.zeros(level, 100).double(), rtol=0, atol=1e-12)


def test_frozen_it_goes_into_a_pool_and_comes_back():
    wavelet = moved("rbio2.2", seed=1)
    frozen = wavelet.frozen()
    assert (frozen.name, wavelet.frozen("mine").name) == ("rbio2.2, learned", "mine")
    assert WaveletFilters.from_dict(frozen.to_dict()) == frozen
    pool = FeaturePool(HAND, wavelet=frozen)
    matrix = wavelet.branch_matrix(100)
    torch.testing.assert_close(branch_matrix(100, frozen), matrix, rtol=0, atol=1e-13)
    bins = torch.randn(5, 4, 100, generator=torch.Generator().manual_seed(0)).double()
    learning = FeaturePool(HAND).with_branches(matrix.detach())
    torch.testing.assert_close(learning(bins), pool(bins), rtol=1e-9, atol=1e-9)
    assert not torch.allclose(learning(bins), FeaturePool(HAND)(bins))


class Branches(torch.nn.Module):
    """The branches of bins of 24 samples, or features of them, as a function of the parameters."""

    def __init__(self, wavelet, bins=None):
        super().__init__()
        self.wavelet, self.bins, self.pool = (
            wavelet,
            bins,
            FeaturePool(HAND, bin_samples=24, level=2),
        )
        smooth = [n.descriptor not in ("mode", "entropy") for n in self.pool.names]
        self.kept = torch.tensor(smooth).nonzero().flatten()

    def forward(self):
        matrix = self.wavelet.branch_matrix(24, 2)
        if self.bins is None:
            return matrix
        return self.pool.with_branches(matrix)(self.bins)[:, self.kept]


def of_parameters(module):
    names, values = zip(*module.named_parameters(), strict=True)

    def made(*values):
        return functional_call(module, dict(zip(names, values, strict=True)), ())

    return made, tuple(value.detach().clone().requires_grad_() for value in values)


@pytest.mark.parametrize("seed", [None, 7])
def test_gradients_of_branches_are_differences(seed):
    wavelet = LiftedWavelet() if seed is None else moved("rbio2.2", seed)
    made, values = of_parameters(Branches(wavelet))
    assert torch.autograd.gradcheck(made, values, fast_mode=True)


def test_gradients_of_features_are_differences(rng):
    bins = torch.from_numpy(rng.standard_normal((2, 4, 24)))
    made, values = of_parameters(Branches(moved("rbio2.2", 5, 0.1), bins))
    assert torch.autograd.gradcheck(made, values, fast_mode=True)
    features = made(*values)
    for gradient in torch.autograd.grad(features.square().mean(), values):
        assert gradient.abs().max() > 0


def test_three_numbers_may_be_learned_of_the_papers_wavelet():
    wavelet, columns = LiftedWavelet(), []
    for parameter in wavelet.parameters():
        for place in range(parameter.numel()):
            sides = []
            for step in (1e-5, -1e-5):
                with torch.no_grad():
                    parameter.view(-1)[place] += step
                    sides.append(wavelet.branch_matrix(100))
                    parameter.view(-1)[place] = 0.0
            columns.append((sides[0] - sides[1]).flatten() / 2e-5)
    sizes = torch.linalg.svdvals(torch.stack(columns))
    assert len(sizes) == 5
    assert sizes[2] > 1e-2 * sizes[0]
    assert sizes[3] < 1e-8 * sizes[0]  # the means of both spreads change nothing


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("db4", "db4 is not made by two lifting steps; start at rbio2.2"),
        ("rbio3.3", "rbio3.3 is not made"),
        ("dmey", "dmey is not made"),
        ("mine", "unknown wavelet 'mine'"),
    ],
)
def test_other_wavelets_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        LiftedWavelet(name)


def test_a_level_too_many_is_refused():
    with pytest.raises(ValueError, match=r"1\.\.4 .* and a learned rbio2\.2, got 5"):
        LiftedWavelet().branch_matrix(100, 5)


def test_what_went_astray_is_not_frozen():
    wavelet = LiftedWavelet()
    with torch.no_grad():
        wavelet.log_sum.fill_(torch.nan)
    with pytest.raises(ValueError, match="dec_lo must be finite"):
        wavelet.frozen()


def test_branches_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"expected branches \(8, 100, 100\), got \(6, 100, 100\)"):
        FeaturePool(HAND).with_branches(torch.zeros(6, 100, 100))


def test_it_follows_its_parameters_to_another_device():
    wavelet = LiftedWavelet().to("meta")
    assert wavelet.branch_matrix(100).device.type == "meta"
    assert all(taps.device.type == "meta" for taps in wavelet.filter_bank)


@given(name=st.sampled_from(["rbio2.2", "bior2.2"]), seed=st.integers(0, 2**31))
def test_near_its_start_branches_are_about_as_large_as_the_bin(name, seed):
    """Also at the far end of what weight decay leaves: parameters of a tenth, in any direction."""
    wavelet = moved(name, seed, 1.0)
    with torch.no_grad():
        for parameter in wavelet.parameters():
            parameter.clamp_(-0.1, 0.1)
        matrix = wavelet.branch_matrix(100)
    assert torch.linalg.matrix_norm(matrix, 2).max() < 3
