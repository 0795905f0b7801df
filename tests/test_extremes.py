"""Generated extremes are what their names say."""

import pytest
import torch

from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", EXTREMES)
def test_same_seed_same_finite_bins(kind: str, dtype: torch.dtype) -> None:
    made = [extreme_bins(kind, (4, 3, 50), torch.Generator().manual_seed(5), dtype) for _ in "ab"]
    assert made[0].shape == (4, 3, 50)
    assert made[0].dtype == dtype
    assert bool(made[0].isfinite().all())
    assert torch.equal(*made)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sizes_reach_the_ends_of_the_dtype(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    facts = torch.finfo(dtype)
    tiny = extreme_bins("denormal", (50, 100), generator, dtype).abs()
    assert float(tiny.median()) < facts.tiny
    assert float(tiny.median()) > 0
    huge = extreme_bins("huge", (50, 100), generator, dtype)
    assert float(huge.abs().max()) > 1e30
    if dtype == torch.float32:  # its square is no float32
        assert bool((huge * huge).isinf().any())


def test_shapes_of_the_kinds() -> None:
    generator = torch.Generator().manual_seed(1)
    shape = (8, 40)
    assert int((extreme_bins("spike", shape, generator) != 0).sum()) == 8
    constant = extreme_bins("constant", shape, generator)
    assert bool((constant == constant[:, :1]).all())
    assert len(constant.unique()) == 8
    assert (extreme_bins("outlier", shape, generator) == 5).sum(-1).tolist() == [1] * 8
    assert extreme_bins("alternating", shape, generator).sum().abs() < 1e-12
    offset = extreme_bins("offset 1e6, vibration 1e-6", shape, generator, torch.float32)
    assert bool((offset == 1e6).all())  # what float32 leaves of it


def test_bad_arguments() -> None:
    generator = torch.Generator()
    with pytest.raises(ValueError, match=r"kind must be one of plain, .*, got 'odd'"):
        extreme_bins("odd", (3, 4), generator)
    with pytest.raises(ValueError, match=r"at least two samples, got shape \(3, 1\)"):
        extreme_bins("zero", (3, 1), generator)
