"""Closed-form scores without a group against refits without it, and their gradients."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tactslip_torch.model import fit
from tactslip_torch.model.fit import HeldOut, TrainingBins, held_out_scores
from tactslip_torch.model.kernels import PAPER_KERNEL, Kernel, Polynomial, RadialBasis

CUBIC, RADIAL, LINE = Polynomial(3), RadialBasis(0.4), Polynomial(1, 0.7)
GROUPS = ("bins", "cycles", "materials", "mixed")


def draw(
    rng: np.random.Generator, num_bins: int, num_features: int = 3, weighted: bool = False
) -> TrainingBins:
    """Noisy labels of both classes everywhere, so that no fold loses one."""
    z = rng.uniform(-1, 1, (num_bins, num_features))
    is_slip = (z[:, 0] - z[:, 1] ** 2 + 0.3 * rng.normal(size=num_bins) > -0.2).copy()
    first = min(8, num_bins)
    is_slip[:first] = np.arange(first) // 2 % 2 == 0
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


# Scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [256, 11])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kind", GROUPS)
@pytest.mark.parametrize(
    ("kernel", "num_bins", "num_features"),
    [
        (PAPER_KERNEL, 60, 12),  # the dual: 91 monomials
        (LINE, 40, 41),
        (CUBIC, 60, 12),
        (RADIAL, 60, 12),
        (Polynomial(2, 1.5), 80, 4),  # the primal: 15 monomials, groups of more and of fewer bins
        (LINE, 80, 4),
    ],
)
def test_scores_are_those_of_refits(
    kernel, num_bins, num_features, kind, weighted, chunk, rng, monkeypatch
):
    monkeypatch.setattr(fit, "_CHUNK", chunk)
    bins = draw(rng, num_bins, num_features, weighted)
    assert_refits(bins, grouped(rng, num_bins, kind), 1e3, kernel)


# Gradients ------------------------------------------------------------------------------------


def inputs_of(rng, num_bins, num_features, kind):
    """Features, labels, groups, C, c and weights; a gradient is wanted of all that have one."""
    bins, groups = draw(rng, num_bins, num_features, weighted=True), grouped(rng, num_bins, kind)
    numbers = [torch.tensor(value, dtype=torch.float64) for value in (0.7, 0.4)]
    z, weights = bins.features.requires_grad_(), bins.weights.requires_grad_()
    penalty, offset = [number.requires_grad_() for number in numbers]
    return z, bins.is_slip, groups, penalty, offset, weights


@pytest.mark.parametrize(("kind", "num_features"), [("mixed", 2), ("bins", 5)])
def test_scores_are_those_in_closed_form_with_derivatives_right_twice(kind, num_features, rng):
    """With more bins than monomials, and fewer."""
    z, is_slip, groups, *numbers = inputs_of(rng, 10, num_features, kind)

    def scores(z, *numbers):
        return held_out_scores(z, is_slip, groups, *numbers)

    bins = TrainingBins(z.detach(), is_slip, numbers[2].detach())
    closed = HeldOut(bins, groups, Polynomial(2, 0.4), "dual").at(0.7).scores
    torch.testing.assert_close(scores(z, *numbers).detach(), closed, rtol=0, atol=1e-10)
    assert torch.autograd.gradcheck(scores, (z, *numbers))
    assert torch.autograd.gradgradcheck(scores, (z, *numbers))


# Refusals -------------------------------------------------------------------------------------


def held_out(bins, groups, *numbers, **more):
    return held_out_scores(bins.features, bins.is_slip, groups, *numbers, **more)


def with_all_of(value, bins):
    """Groups of which number 9 has all bins of a class."""
    return torch.where(bins.is_slip == value, 9, torch.arange(len(bins.is_slip)) % 3)


def twice(bins):
    return TrainingBins(bins.features.repeat(2, 1), bins.is_slip.repeat(2))


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        *(
            (lambda b, g, f=f, c=c: f(b, g, c), r"positive and finite penalty .*, got")
            for f in (held_out, lambda b, g, c: HeldOut(b, g).at(c))
            for c in (0.0, -1.0, float("inf"), float("nan"))
        ),
        (lambda b, g: held_out(b, g[:19], 1.0), r"each of 20 bins, got \(19,\)"),
        (lambda b, g: HeldOut(b, g[:19]), r"each of 20 bins, got \(19,\)"),
        (lambda b, g: HeldOut(b, g.float()), r"whole number .*, got \(20,\) torch.float32"),
        (lambda b, g: HeldOut(b, 0 * g + 7), r"at least two groups, all 20 bins are in \[7\]"),
        (lambda b, g: HeldOut(b, with_all_of(True, b)), "without group 9 no slip bin is left"),
        (lambda b, g: HeldOut(b, with_all_of(False, b)), "without group 9 no non-slip bin is left"),
        (lambda b, g: HeldOut(b, g, RADIAL, "primal"), r"RadialBasis.* has no primal"),
        (lambda b, g: held_out(b, g, 1.0, -0.5), r"offset .* at least 0, got -0.5"),
        (lambda b, g: held_out(b, g, 1.0, weights=torch.zeros(20)), "weights must be positive"),
        (lambda b, g: held_out(twice(b), g.repeat(2), 1e12), r"condition .*, wanted up to 1e\+10"),
    ],
)
def test_what_has_no_held_out_scores_is_refused(fit, message, rng):
    with pytest.raises(ValueError, match=message):
        fit(draw(rng, 20), torch.arange(20) % 4)


@pytest.mark.parametrize("penalty", [1e7, 1e8])
def test_a_bin_alone_in_a_feature_is_refused_by_name_where_float64_ends(penalty, rng):
    """Only bin 25 has the last feature: its leverage is 1 but for about 1 / penalty."""
    bins, groups = draw(rng, 80, 4), torch.arange(80) + 100
    bins.features[:, -1] = 0
    bins.features[25, -1] = 1
    assert_refits(bins, groups, 1e3)
    with pytest.raises(ValueError, match="the machine without group 125 is too"):
        HeldOut(bins, groups).at(penalty)
