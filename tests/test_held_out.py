import numpy as np
import pytest
import torch
from torch import Tensor

from tactslip_torch.model import downdate, held_out, left_out
from tactslip_torch.model.fit import TrainingBins, fit_machine
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


@pytest.fixture(params=["blocks", "iterations"])
def primal(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both ways of the primal, whatever the size of the groups; each without the other."""
    if request.param == "blocks":
        monkeypatch.setattr(held_out, "residuals_by_iteration", None)
        monkeypatch.setattr(held_out, "_num_small", lambda groups, num_monomials: len(groups))
    else:
        monkeypatch.setattr(held_out, "_left_within", None)
        monkeypatch.setattr(held_out, "_num_small", lambda groups, num_monomials: 0)
    return request.param


@pytest.fixture(params=[None, 4])
def tiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles and chunks as they are, and so small that groups and chunks take several."""
    if request.param:
        monkeypatch.setattr(held_out, "TILE", request.param)
        monkeypatch.setattr(left_out, "TILE", request.param)
        monkeypatch.setattr(left_out, "_CHUNK", 3 * request.param - 1)


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


def inverse_and_residuals(bins: TrainingBins, penalty: float) -> tuple[np.ndarray, np.ndarray]:
    z, t = bins.features.numpy(), bins.targets.numpy()
    system = gram(PAPER_KERNEL, z, z) + np.eye(len(z)) / penalty
    return np.linalg.inv(system), t - gram(PAPER_KERNEL, z, z) @ np.linalg.solve(system, t)


@pytest.mark.parametrize("route", ["primal", "dual"])
def test_leaving_one_bin_out_is_the_classic_formula(route, rng):
    """``(t - f)_i / (1 - h_ii)``, and the same as ``beta_i / (G^-1)_ii`` (Rasmussen 2006, 5.12)."""
    bins = draw(rng, 50, 5)
    inverse, residuals = inverse_and_residuals(bins, 2.0)
    hat = 1 - np.diag(inverse) / 2.0
    scores = HeldOut(bins, torch.arange(50), route=route).at(2.0).scores
    left = bins.targets.numpy() - scores.numpy()
    np.testing.assert_allclose(left, residuals / (1 - hat), rtol=1e-10)
    beta = inverse @ bins.targets.numpy()
    np.testing.assert_allclose(left, beta / np.diag(inverse), rtol=1e-10)


@pytest.mark.usefixtures("primal")
@pytest.mark.parametrize("route", ["primal", "dual"])
@pytest.mark.parametrize("kind", ["bins", "materials"])
def test_labels_of_a_group_do_not_move_its_scores(kind, route, rng):
    bins, groups = draw(rng, 60, 3), grouped(rng, 60, kind)
    own = groups == groups[7]
    flipped = TrainingBins(bins.features, bins.is_slip ^ own)
    before = HeldOut(bins, groups, route=route).at(0.7).scores
    after = HeldOut(flipped, groups, route=route).at(0.7).scores
    torch.testing.assert_close(after[own], before[own], rtol=0, atol=1e-9)
    assert float((after - before)[~own].abs().max()) > 1e-3  # they do move the others'


@pytest.mark.usefixtures("primal")
@pytest.mark.parametrize("route", ["primal", "dual"])
@pytest.mark.parametrize("apart", [True, False])
def test_duplicate_bins_within_a_group_and_across(apart, route, rng):
    """A copy in another group tells of the bin, one in the same group does not."""
    bins, groups = draw(rng, 40, 3), torch.arange(40) // 4
    twice = TrainingBins(bins.features.repeat(2, 1), bins.is_slip.repeat(2))
    groups = torch.cat([groups, groups + 100 if apart else groups])
    for penalty in (0.1, 100.0):
        actual = HeldOut(twice, groups, route=route).at(penalty).scores.numpy()
        expected = refitted(twice, groups, penalty, PAPER_KERNEL)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8)
        np.testing.assert_allclose(actual[:40], actual[40:], rtol=0, atol=1e-8)


@pytest.mark.usefixtures("primal")
@pytest.mark.parametrize("route", ["primal", "dual"])
def test_scores_follow_the_bins_in_any_order(route, rng):
    bins, groups = draw(rng, 60, 3, weighted=True), grouped(rng, 60, "mixed")
    mixed = torch.from_numpy(rng.permutation(60))
    turned = TrainingBins(bins.features[mixed], bins.is_slip[mixed], bins.weights[mixed])
    scores = HeldOut(bins, groups, route=route).at(0.7).scores
    again = HeldOut(turned, groups[mixed], route=route).at(0.7).scores
    torch.testing.assert_close(again, scores[mixed], rtol=0, atol=1e-9)


def test_a_weight_of_two_is_a_bin_twice_in_its_group(rng):
    bins, groups = draw(rng, 30, 3), torch.arange(30) // 3
    weights = torch.where(torch.arange(30) < 6, 2.0, 1.0).double()
    doubled = TrainingBins(
        torch.cat([bins.features, bins.features[:6]]), torch.cat([bins.is_slip, bins.is_slip[:6]])
    )
    weighted = TrainingBins(bins.features, bins.is_slip, weights)
    scores = HeldOut(doubled, torch.cat([groups, groups[:6]])).at(0.4).scores
    other = HeldOut(weighted, groups).at(0.4).scores
    torch.testing.assert_close(scores[:30], other, rtol=0, atol=1e-9)


# Machine and routes --------------------------------------------------------------------------
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(
    ("num_bins", "kernel"),
    [(12, PAPER_KERNEL), (60, PAPER_KERNEL), (5, LINE), (60, LINE), (60, CUBIC), (60, RADIAL)],
)
def test_the_head_is_the_machine_of_all_bins(num_bins, kernel, weighted, rng):
    bins = draw(rng, num_bins, 4, weighted)
    new = torch.from_numpy(rng.uniform(-1, 1, (30, 4)))
    head = HeldOut(bins, torch.arange(num_bins) % 2, kernel).at(0.3).head
    expected = fit_machine(bins, 0.3, kernel)
    assert type(head) is type(expected)
    torch.testing.assert_close(head(new), expected(new), rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("num_bins", "kernel", "route"),
    [
        (23, PAPER_KERNEL, "dual"),  # 4 features: 15 monomials, 70 sums at degree 2; 5 at degree 1
        (24, PAPER_KERNEL, "primal"),
        (5, LINE, "dual"),
        (6, LINE, "primal"),
        (60, CUBIC, "dual"),
        (60, RADIAL, "dual"),
    ],
)
def test_the_route_goes_by_size(num_bins, kernel, route, rng, monkeypatch):
    other = {"primal": "_dual", "dual": "_primal"}[route]
    monkeypatch.setattr(HeldOut, other, None)
    fit = HeldOut(draw(rng, num_bins, 4), torch.arange(num_bins) % 2, kernel).at(0.3)
    assert fit.scores.shape == (num_bins,)


def test_the_two_routes_agree(rng):
    for num_bins in (12, 60):
        bins, groups = draw(rng, num_bins, 4, weighted=True), torch.arange(num_bins) % 3
        primal, dual = (HeldOut(bins, groups, route=r).at(0.3) for r in ("primal", "dual"))
        torch.testing.assert_close(primal.scores, dual.scores, rtol=0, atol=1e-8)


def test_materials_go_by_iteration_and_cycles_by_blocks():
    """At 7381 monomials; one huge group never takes a matrix of its bins by its bins."""
    assert held_out._num_small([(name, 2640) for name in range(6)], 7381) == 0
    assert held_out._num_small([(name, 1) for name in range(15840)], 7381) == 15840
    assert held_out._num_small([(name, 94) for name in range(168)], 7381) == 168
    assert held_out._num_small([(0, 40), (1, 600)], 7381) == 2  # not worth the passes over L
    assert held_out._num_small([(0, 5), (1, 100_000)], 231) == 1


def test_one_matrix_serves_every_penalty(rng, monkeypatch):
    for num_bins in (12, 60):
        bins, groups = draw(rng, num_bins, 4), torch.arange(num_bins) % 3
        machine = HeldOut(bins, groups)
        first = [machine.at(penalty) for penalty in (0.1, 10.0, 0.1)]
        assert torch.equal(first[0].scores, first[2].scores)
        assert not torch.equal(first[0].scores, first[1].scores)
        assert torch.equal(first[1].scores, HeldOut(bins, groups).at(10.0).scores)


def test_tensors_of_the_caller_are_kept(rng):
    bins, groups = draw(rng, 60, 4, weighted=True), grouped(rng, 60, "mixed")
    tensors = [bins.features, bins.is_slip, bins.weights, groups]
    before = [tensor.clone() for tensor in tensors]
    HeldOut(bins, groups).at(0.3)
    assert all(map(torch.equal, tensors, before))


def test_views_and_narrow_whole_numbers_will_do(rng):
    wide, groups = torch.from_numpy(rng.uniform(-1, 1, (40, 6))), torch.arange(40) % 5
    is_slip = torch.arange(40) % 2 == 0
    strided = HeldOut(TrainingBins(wide[:, ::2], is_slip), groups.to(torch.int32)).at(0.3)
    plain = HeldOut(TrainingBins(wide[:, ::2].contiguous(), is_slip), groups).at(0.3)
    torch.testing.assert_close(strided.scores, plain.scores, rtol=0, atol=1e-12)


# Refusals ------------------------------------------------------------------------------------
@pytest.mark.parametrize("num_bins", [12, 60])
@pytest.mark.parametrize("penalty", [0.0, -1.0, float("inf"), float("nan")])
def test_a_penalty_must_be_positive_and_finite(num_bins, penalty, rng):
    machine = HeldOut(draw(rng, num_bins, 4), torch.arange(num_bins) % 3)
    with pytest.raises(ValueError, match=r"positive and finite penalty .*, got"):
        machine.at(penalty)


def test_one_group_of_all_bins_is_refused(rng):
    with pytest.raises(ValueError, match=r"at least two groups, all 20 bins are in \[7\]"):
        HeldOut(draw(rng, 20), torch.full((20,), 7))


@pytest.mark.parametrize(("value", "kind"), [(True, "slip"), (False, "non-slip")])
def test_a_group_with_all_of_a_class_is_named(value, kind, rng):
    bins = draw(rng, 20)
    groups = torch.where(bins.is_slip == value, 9, torch.arange(20) % 3)
    with pytest.raises(ValueError, match=f"without group 9 no {kind} bin is left"):
        HeldOut(bins, groups)


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        (torch.zeros(19, dtype=torch.int64), r"each of 20 bins, got \(19,\)"),
        (torch.zeros(20, 1, dtype=torch.int64), r"each of 20 bins, got \(20, 1\)"),
        (torch.zeros(20), r"whole number .*, got \(20,\) torch.float32"),
    ],
)
def test_groups_must_be_one_whole_number_a_bin(groups, message, rng):
    with pytest.raises(ValueError, match=message):
        HeldOut(draw(rng, 20), groups)


def test_a_primal_of_a_kernel_that_does_not_fold_is_refused(rng):
    with pytest.raises(ValueError, match=r"RadialBasis.* has no primal of fixed size"):
        HeldOut(draw(rng, 20), torch.arange(20) % 2, RADIAL, route="primal")


@pytest.mark.usefixtures("primal")
@pytest.mark.parametrize("size", [1, 20])
@pytest.mark.parametrize("penalty", [1e7, 1e8])
def test_a_bin_alone_in_a_feature_is_refused_by_name_where_float64_ends(penalty, size, rng):
    """Only bin 25 has the last feature: its leverage is 1 but for about 1 / penalty."""
    bins, groups = draw(rng, 80, 4), torch.arange(80) // size + 100
    bins.features[:, -1] = 0
    bins.features[25, -1] = 1
    assert_refits(bins, groups, 1e3)
    with pytest.raises(ValueError, match=f"the machine without group {25 // size + 100} is too"):
        HeldOut(bins, groups).at(penalty)


def test_iterations_come_to_an_end(rng, monkeypatch):
    monkeypatch.setattr(held_out, "_num_small", lambda groups, num_monomials: 0)
    monkeypatch.setattr(downdate, "MOST_ITERATIONS", 2)
    with pytest.raises(ValueError, match=r"the machine without group [0-2] is too far"):
        HeldOut(draw(rng, 60, 4), torch.arange(60) % 3).at(10.0)
