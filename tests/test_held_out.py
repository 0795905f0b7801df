import numpy as np
import pytest
import torch
from torch import Tensor

from tactslip_torch.model import held_out
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.held_out import HeldOut
from tactslip_torch.model.kernels import PAPER_KERNEL, Kernel, Polynomial, RadialBasis

CUBIC, RADIAL, LINE = Polynomial(3), RadialBasis(0.4), Polynomial(1, 0.7)
GROUPS = ("bins", "cycles", "materials", "mixed")


def draw(
    rng: np.random.Generator, num_bins: int, num_features: int = 3, weighted: bool = False
) -> TrainingBins:
    """Noisy labels of both classes everywhere, so that no fold loses one."""
    z = rng.uniform(-1, 1, (num_bins, num_features))
    is_slip = (z[:, 0] - z[:, 1] ** 2 + 0.3 * rng.normal(size=num_bins) > -0.2).copy()
    is_slip[:8] = np.arange(8) % 2 == 0
    weights = torch.from_numpy(rng.uniform(0.2, 3, num_bins)) if weighted else None
    return TrainingBins(torch.from_numpy(z), torch.from_numpy(is_slip), weights)


def grouped(rng: np.random.Generator, num_bins: int, kind: str) -> Tensor:
    """Groups in no order, with names that are not 0, 1, 2, ..."""
    if kind == "bins":
        groups = np.arange(num_bins)
    elif kind == "cycles":
        groups = rng.integers(0, num_bins // 6, num_bins)
    elif kind == "materials":
        groups = rng.integers(0, 4, num_bins)
    else:  # one of half the bins, some of a few, many of one
        groups = np.where(np.arange(num_bins) % 2 == 0, 0, np.arange(num_bins) // 2)
        groups[: num_bins // 5] = 5
    return torch.from_numpy(rng.permutation(7 * groups - 20))


def gram(kernel: Kernel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if isinstance(kernel, RadialBasis):
        return np.exp(-kernel.gamma * ((a[:, None] - b[None]) ** 2).sum(-1))
    return (a @ b.T + kernel.offset) ** kernel.degree


def refitted(bins: TrainingBins, groups: Tensor, penalty: float, kernel: Kernel) -> np.ndarray:
    """Delete the group, solve, predict."""
    z, t, g = bins.features.numpy(), np.where(bins.is_slip, 1.0, -1.0), groups.numpy()
    w = np.ones(len(z)) if bins.weights is None else bins.weights.numpy()
    scores = np.full(len(z), np.nan)
    for name in np.unique(g):
        out, own = g != name, g == name
        system = gram(kernel, z[out], z[out]) + np.diag(1 / (penalty * w[out]))
        scores[own] = gram(kernel, z[own], z[out]) @ np.linalg.solve(system, t[out])
    return scores


def assert_refits(
    bins: TrainingBins, groups: Tensor, penalty: float, kernel: Kernel = PAPER_KERNEL
) -> None:
    fit = HeldOut(bins, groups, kernel).at(penalty)
    expected = refitted(bins, groups, penalty, kernel)
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(fit.scores.numpy(), expected, rtol=0, atol=1e-8 * scale)


@pytest.fixture(params=["blocks", "iterations"])
def primal(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways of the primal, whatever the size of the groups; each without the other."""
    if request.param == "blocks":
        monkeypatch.setattr(held_out, "residuals_without_groups", None)
        monkeypatch.setattr(held_out, "_LARGE", 10**9)
    else:
        monkeypatch.setattr(held_out, "_left_within", None)
        monkeypatch.setattr(held_out, "_LARGE", 0)
    return request.param


@pytest.fixture(params=[None, 4])
def tiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles and chunks as they are, and so small that groups and chunks take several."""
    if request.param:
        monkeypatch.setattr(held_out, "_TILE", request.param)
        monkeypatch.setattr(held_out, "_CHUNK", 3 * request.param - 1)


# Scores --------------------------------------------------------------------------------------
@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("penalty", [1e-3, 0.3, 1e3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kind", GROUPS)
@pytest.mark.parametrize("kernel", [Polynomial(2, 0.5), Polynomial(2, 1.5), LINE, CUBIC, RADIAL])
def test_dual_scores_are_those_of_refits(kernel, kind, weighted, penalty, rng):
    """12 features have 91 monomials of degree 2; degree 1 needs no more bins than features."""
    num_bins, num_features = (40, 41) if kernel is LINE else (60, 12)
    bins = draw(rng, num_bins, num_features, weighted)
    assert_refits(bins, grouped(rng, num_bins, kind), penalty, kernel)


@pytest.mark.usefixtures("tiled", "primal")
@pytest.mark.parametrize("penalty", [1e-3, 0.3, 1e3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kind", GROUPS)
@pytest.mark.parametrize("kernel", [Polynomial(2, 0.5), Polynomial(2, 1.5), LINE])
def test_primal_scores_are_those_of_refits(kernel, kind, weighted, penalty, rng):
    bins = draw(rng, 80, 4, weighted)
    assert_refits(bins, grouped(rng, 80, kind), penalty, kernel)
