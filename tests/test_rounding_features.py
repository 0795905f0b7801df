"""Features that rounding decides are found for the wavelets that have them, and never selected."""

import pytest
import torch
from any_hands import AnyHand

from tactslip_torch.features.pool import FeaturePool, is_rounding
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.training.recipe import Paper

HAND = AnyHand({("PVDF", "fast"): 2, ("SG", "slow"): 1}, 2000.0, 64, 20, {}).layout()


def pool_of(wavelet, bin_samples=64, **options):
    return FeaturePool(HAND, bin_samples=bin_samples, wavelet=wavelet, level=2, **options)


@pytest.mark.parametrize("wavelet", ["rbio2.2", "db2", "db3", "sym4", "bior2.2"])
@pytest.mark.parametrize("bin_samples", [41, 100])
@pytest.mark.parametrize("spectrum", ["reference", "clean"])
def test_most_wavelets_have_none(wavelet, bin_samples, spectrum):
    pool = pool_of(wavelet, bin_samples, spectrum=spectrum)
    assert not is_rounding(pool).any()
    assert torch.equal(Paper().allowed(pool), pool.is_paper)


def test_neither_have_the_papers_pool_and_a_hand_without_fast_channels():
    slow = HandLayout((Channel("a", "SG", "index", "distal"),))
    assert not is_rounding(FeaturePool(HandLayout.paper24())).any()
    assert not is_rounding(FeaturePool(slow, wavelet="haar")).any()


@pytest.mark.parametrize("bin_samples", [64, 100])
def test_of_haars_details_the_mean_is_rounding_and_with_it_what_hangs_on_it(bin_samples):
    """Each detail is a, -a by turns (of its level's length): its mean and third moment are zero."""
    pool = pool_of("haar", bin_samples)
    found = {str(pool.names[i]) for i in is_rounding(pool).nonzero()}
    for channel in ("PVDF0", "PVDF1"):
        for detail in ("D1", "D2"):
            zero = {f"{channel} {detail} time {what}" for what in ("mean", "cv", "skewness")}
            assert zero <= found
    assert not {name for name in found if name.startswith("SG")}
    assert not {name for name in found if name.split()[-1] in ("std", "range", "energy", "entropy")}
    bins = torch.randn(50, 3, bin_samples, generator=torch.Generator().manual_seed(1)).double()
    values = pool(bins)
    by_name = dict(zip(map(str, pool.names), values.T, strict=True))
    assert by_name["PVDF0 D1 time mean"].abs().max() < 1e-15 * float(bins.abs().max())


def test_a_recipe_leaves_them_out():
    pool = pool_of("haar")
    mask = Paper().allowed(pool)
    assert torch.equal(mask, ~is_rounding(pool) & pool.is_paper)
    among = Paper(feature_filter={"component": "D1", "descriptor": ["mean", "std"]}).allowed(pool)
    assert [str(pool.names[i]) for i in among.nonzero()] == [
        f"{channel} D1 {what}"
        for channel in ("PVDF0", "PVDF1")
        for what in ("time std", "freq mean", "freq std")
    ]
    nothing = Paper(feature_filter={"component": "D1", "domain": "time", "descriptor": "mean"})
    with pytest.raises(ValueError, match="more than rounding"):
        nothing.allowed(pool)
