import numpy as np
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge

from tactslip_torch.model import fit
from tactslip_torch.model.fit import (
    TrainingBins,
    fit_machine,
)
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import PAPER_KERNEL, Polynomial, RadialBasis
from tactslip_torch.model.quadratic import QuadraticForm, num_quadratic_features

FOLDING = [PAPER_KERNEL, Polynomial(2, 1.5), Polynomial(2, 0.0), Polynomial(1, 0.5)]
KEEPING = [Polynomial(3, 0.5), Polynomial(4, 1.0), RadialBasis(0.3)]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def labels(num_quiet, num_slip, seed=0):
    is_slip = torch.arange(num_quiet + num_slip) >= num_quiet
    return is_slip[torch.randperm(len(is_slip), generator=generator(seed))]


def draw(rng, num_bins, num_features=3, weighted=False):
    z = torch.from_numpy(rng.uniform(-1, 1, (num_bins, num_features)))
    is_slip = torch.from_numpy(rng.uniform(size=num_bins) < 0.6)
    is_slip[:2] = torch.tensor([True, False])
    weights = torch.from_numpy(rng.uniform(0.3, 2, num_bins)) if weighted else None
    return TrainingBins(z, is_slip, weights)


def ridge(bins, penalty, kernel=PAPER_KERNEL):
    """The same machine from scikit-learn."""
    if isinstance(kernel, Polynomial):
        kind = {"kernel": "poly", "degree": kernel.degree, "gamma": 1, "coef0": kernel.offset}
    else:
        kind = {"kernel": "rbf", "gamma": kernel.gamma}
    weights = None if bins.weights is None else bins.weights.numpy()
    model = KernelRidge(alpha=1 / penalty, **kind)
    return model.fit(bins.features.numpy(), bins.targets.numpy(), sample_weight=weights)


# Balance -------------------------------------------------------------------------------------


def test_targets_are_plus_one_for_slip():
    bins = TrainingBins(torch.zeros(2, 1, dtype=torch.float64), torch.tensor([True, False]))
    assert bins.targets.tolist() == [1.0, -1.0]
    assert bins.targets.dtype == torch.float64


@pytest.mark.parametrize(
    ("is_slip", "weights", "message"),
    [
        (torch.ones(4, dtype=torch.bool), None, r"one N, got \(5, 2\), \(4,\)$"),
        (torch.ones(5, dtype=torch.bool), torch.ones(4), r"got \(5, 2\), \(5,\), \(4,\)$"),
        (torch.ones(5, dtype=torch.bool), torch.arange(5.0), "positive and finite, got 0"),
        (
            torch.ones(5, dtype=torch.bool),
            torch.full((5,), torch.nan),
            "positive and finite, got nan",
        ),
        (torch.ones(5, dtype=torch.bool), torch.full((5,), torch.inf), "and finite, got inf"),
    ],
)
def test_bins_that_do_not_fit_together_are_refused(is_slip, weights, message):
    with pytest.raises(ValueError, match=message):
        TrainingBins(torch.zeros(5, 2), is_slip, weights)


# Fit -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kernel", [*FOLDING, *KEEPING], ids=str)
@pytest.mark.parametrize("num_bins", [8, 10, 11, 60])
def test_every_machine_equals_kernel_ridge(num_bins, kernel, weighted, rng):
    """Three features have ten monomials: the dual up to ten bins, the primal above if it folds."""
    assert num_quadratic_features(3) == 10
    bins = draw(rng, num_bins, weighted=weighted)
    new = rng.uniform(-1, 1, (20, 3))
    for penalty in (0.05, 3.0):
        machine = fit_machine(bins, penalty, kernel)
        assert isinstance(machine, QuadraticForm if kernel in FOLDING else KernelSum)
        expected = ridge(bins, penalty, kernel).predict(new)
        actual = machine(torch.from_numpy(new)).numpy()
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kernel", FOLDING, ids=str)
@pytest.mark.parametrize(
    ("num_features", "num_bins"), [(3, 9), (3, 11), (8, 44), (8, 46), (8, 300)]
)
def test_the_two_routes_agree(num_features, num_bins, kernel, weighted, rng):
    """Around the crossover (10 and 45 monomials) and beyond, to 1e-9 of sum |beta k|."""
    bins = draw(rng, num_bins, num_features, weighted)
    new = rng.uniform(-1, 1, (20, num_features))
    for penalty in (0.1, 30.0):
        beta = ridge(bins, penalty, kernel).dual_coef_
        terms = (new @ bins.features.numpy().T + kernel.offset) ** kernel.degree * beta
        primal, dual = (
            fit_machine(bins, penalty, kernel, route=route)(torch.from_numpy(new)).numpy()
            for route in ("primal", "dual")
        )
        scale = np.abs(terms).sum(-1)
        assert (np.abs(primal - dual) <= 1e-9 * scale).all()
        assert (np.abs(primal - terms.sum(-1)) <= 1e-9 * scale).all()


@pytest.mark.parametrize(("kernel", "crossover"), [(PAPER_KERNEL, 16), (Polynomial(1, 0.5), 4)])
def test_many_bins_go_through_the_primal_and_few_do_not(kernel, crossover, rng, monkeypatch):
    few, many = draw(rng, crossover), draw(rng, crossover + 1)
    monkeypatch.setattr(fit, "solve_kernel_elm_", None)  # the primal has no need of it
    fit_machine(many, 0.3, kernel)
    fit_machine(few, 0.3, kernel, route="primal")
    for bins, route in ((few, "auto"), (many, "dual")):
        with pytest.raises(TypeError):
            fit_machine(bins, 0.3, kernel, route=route)


@pytest.mark.parametrize("kernel", KEEPING, ids=str)
def test_a_kernel_that_does_not_fold_says_what_it_costs_and_has_no_primal(kernel, rng, caplog):
    bins = draw(rng, 60)
    with caplog.at_level("INFO"):
        machine = fit_machine(bins, 0.3, kernel)
    assert machine.cost_note in caplog.messages
    assert "60 training bins" in machine.cost_note
    with pytest.raises(ValueError, match="has no primal of fixed size; take route='dual'"):
        fit_machine(bins, 0.3, kernel, route="primal")


def test_an_unknown_route_is_refused(rng):
    with pytest.raises(ValueError, match="route must be 'auto', 'primal' or 'dual', got 'back'"):
        fit_machine(draw(rng, 5), 0.3, route="back")


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kernel", [PAPER_KERNEL, Polynomial(1, 0.5)], ids=str)
@pytest.mark.parametrize("chunk", [1, 7, 20, 39, 41])
def test_chunks_leave_no_seam(chunk, kernel, weighted, rng, monkeypatch):
    bins = draw(rng, 40, weighted=weighted)
    whole = fit_machine(bins, 0.3, kernel)
    monkeypatch.setattr(fit, "CHUNK_BINS", chunk)
    cut = fit_machine(bins, 0.3, kernel)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(cut.state_dict()[name], value, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("kernel", [PAPER_KERNEL, Polynomial(1, 0.5)], ids=str)
def test_progress_sees_every_chunk(kernel, rng, monkeypatch):
    monkeypatch.setattr(fit, "CHUNK_BINS", 16)
    seen = []

    def progress(items, what):
        for item in items:
            seen.append((item, what))
            yield item

    fit_machine(draw(rng, 40), 0.3, kernel, progress)
    assert seen == [(0, "normal equations"), (16, "normal equations"), (32, "normal equations")]


@pytest.mark.parametrize("kernel", [PAPER_KERNEL, Polynomial(1, 0.5), RadialBasis(0.3)], ids=str)
@pytest.mark.parametrize("num_bins", [4, 40])
def test_training_bins_are_kept(kernel, num_bins, rng):
    """What is solved in place is never what the caller holds."""
    bins = draw(rng, num_bins, weighted=True)
    copies = [part.clone() for part in (bins.features, bins.is_slip, bins.weights)]
    fit_machine(bins, 0.3, kernel)
    for part, copy in zip((bins.features, bins.is_slip, bins.weights), copies, strict=True):
        assert torch.equal(part, copy)


@pytest.mark.parametrize("route", ["primal", "dual"])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("num_bins", [3, 8, 40])
def test_an_infinite_penalty_is_least_squares(num_bins, degree, route, rng):
    """Interpolation with fewer bins than monomials, the normal equations with more."""
    bins = draw(rng, num_bins)
    machine = fit_machine(bins, float("inf"), Polynomial(degree, 0.5), route=route)
    z = bins.features.numpy()
    columns = [np.ones(num_bins), *z.T]
    if degree == 2:
        columns += [z[:, i] * z[:, j] for i in range(3) for j in range(i, 3)]
    design = np.stack(columns, axis=-1)
    fitted = design @ np.linalg.lstsq(design, bins.targets.numpy(), rcond=None)[0]
    np.testing.assert_allclose(machine(bins.features).numpy(), fitted, rtol=1e-7, atol=1e-7)


def test_twice_the_weight_is_twice_the_bin(rng):
    bins = draw(rng, 30)
    doubled = TrainingBins(
        torch.cat([bins.features, bins.features[:5]]), torch.cat([bins.is_slip, bins.is_slip[:5]])
    )
    weights = torch.where(torch.arange(30) < 5, 2.0, 1.0).double()
    weighted = fit_machine(TrainingBins(bins.features, bins.is_slip, weights), 0.3)
    for name, value in fit_machine(doubled, 0.3).state_dict().items():
        torch.testing.assert_close(weighted.state_dict()[name], value, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("num_bins", [8, 40])
@pytest.mark.parametrize("penalty", [0.0, -1.0])
def test_a_penalty_that_is_not_positive_is_refused(num_bins, penalty, rng):
    with pytest.raises(ValueError, match=r"penalty .* must be positive"):
        fit_machine(draw(rng, num_bins), penalty)


@pytest.mark.parametrize("route", ["auto", "primal", "dual"])
def test_no_bins_are_no_machine(route):
    none = TrainingBins(torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"^a machine needs training bins, got none; add"):
        fit_machine(none, 1.0, route=route)


# Validation ----------------------------------------------------------------------------------
