"""A small vibration on a large offset in float32: right, or flagged. Silence is not allowed."""

import numpy as np
import pytest
import torch

from tactslip_torch import FeaturePool, HandLayout

SHAPES = ("cv", "skewness", "kurtosis", "peak_factor", "correlation", "entropy")
SHAPES += ("spectral_centroid", "spectral_spread", "band_energy_ratio")


@pytest.fixture(scope="module")
def pool():
    return FeaturePool(HandLayout.paper24())


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
def test_float32_is_right_or_flagged_at_an_offset_of_1e3(kind, vibration, pool, rng):
    """Against float64 on the same float32 input; a tone leaves branches of rounding alone."""
    wide = 1e3 + vibration * vibrations(kind, 40, rng)
    bins = torch.from_numpy(wide).float()
    single, double = pool(bins).double(), pool(bins.double())
    flagged = ~pool.validity(bins)
    channel = torch.tensor([pool.hand.names.index(name.channel) for name in pool.names])
    excused = flagged[:, channel]
    error = (single - double).abs() / double.abs().clamp(min=torch.finfo(torch.float32).tiny)
    for descriptors, limit in ((("std",), 0.01), (SHAPES, 0.05)):
        mine = torch.tensor([name.descriptor in descriptors for name in pool.names])
        assert mine.any()
        assert bool(((error < limit) | excused | ~mine).all())
    if vibration == 1e-2:
        assert not flagged.any()


def test_a_branch_far_smaller_than_its_bin_is_kept_or_flagged(pool):
    """Its span is below 16 eps32 of the offset; branches are float64 in either arithmetic."""
    t = torch.arange(100) / 2000
    bins = (1e3 + 1e-2 * torch.sin(2 * torch.pi * 50 * t)).expand(24, 100).float()
    branch = next(i for i, n in enumerate(pool.names) if str(n) == "PVDF1 D1 time std")
    assert pool(bins)[branch] > 0
    assert pool.validity(bins).all()
    native = FeaturePool(pool.hand, arithmetic="native")
    films = list(native.hand.indices("PVDF"))
    torch.testing.assert_close(native(bins)[branch], pool(bins)[branch])
    assert not native.validity(bins)[films].any()
    assert native.validity(bins)[list(native.hand.indices("SG"))].all()
    assert native.validity(bins - 1e3)[films].all()
    assert native.validity(bins.double()).all()


def test_what_leaves_float64_on_its_way_counts_as_missing(pool):
    """Rail to rail at its end: the samples are finite, their branches are not."""
    bins = torch.full((2, 24, 100), torch.finfo(torch.float64).max, dtype=torch.float64)
    bins[:, :, ::2] *= -1
    bins[1] /= 64
    assert pool.is_missing(bins).all(-1).tolist() == [True, False]
    assert pool.validity(bins).all(-1).tolist() == [False, True]
    assert pool(bins[1]).isfinite().all()
    assert pool.validity(torch.full((24, 100), 3e38).cumsum(-1).clamp(max=3.4e38)).all()
