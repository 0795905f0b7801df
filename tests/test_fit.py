import numpy as np
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge

from tactslip_torch.model import fit
from tactslip_torch.model.fit import (
    TrainingBins,
    balanced_choice,
    fit_machine,
    validation_scores,
)
from tactslip_torch.model.quadratic import num_quadratic_features


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


def ridge(bins, penalty, offset=0.5):
    model = KernelRidge(kernel="poly", degree=2, gamma=1, coef0=offset, alpha=1 / penalty)
    weights = None if bins.weights is None else bins.weights.numpy()
    return model.fit(bins.features.numpy(), bins.targets.numpy(), sample_weight=weights)


# Balance -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("num_quiet", "num_slip"), [(60, 183), (183, 60), (7, 7)])
def test_undersampling_keeps_the_smaller_class_whole(num_quiet, num_slip):
    is_slip = labels(num_quiet, num_slip)
    index, weights = balanced_choice(is_slip, "undersample", generator())
    assert weights is None
    smaller = min(num_quiet, num_slip)
    assert int(is_slip[index].sum()) == smaller
    assert len(index) == 2 * smaller
    assert bool((index.diff() > 0).all())  # ascending, none twice
    rare = num_slip <= num_quiet
    assert set((is_slip == rare).nonzero().squeeze(-1).tolist()) <= set(index.tolist())


def test_undersampling_draws_all_over_the_larger_class():
    is_slip = torch.arange(1000) >= 100
    index, _ = balanced_choice(is_slip, "undersample", generator())
    drawn = index[is_slip[index]].double()
    assert abs(float(drawn.mean()) - 550) < 5 * 900 / np.sqrt(12 * 100)


def test_the_draw_follows_the_generator():
    is_slip = labels(60, 183)
    first, second, other = (
        balanced_choice(is_slip, "undersample", generator(s))[0] for s in (1, 1, 2)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("most", [None, 50])
def test_weights_give_each_class_one_total(most):
    is_slip = labels(60, 183)
    index, weights = balanced_choice(is_slip, "weights", generator(), most)
    assert len(index) == len(weights) == (243 if most is None else 49)  # 12 and 37, rounded down
    assert weights.dtype == torch.float64
    slip = is_slip[index]
    torch.testing.assert_close(weights[slip].sum(), weights[~slip].sum(), rtol=1e-12, atol=0)
    assert float(weights.sum()) == pytest.approx(len(index))  # as much as without weights


def test_balanced_classes_weigh_one():
    _, weights = balanced_choice(labels(20, 20), "weights", generator())
    torch.testing.assert_close(weights, torch.ones(40, dtype=torch.float64), rtol=0, atol=0)


@pytest.mark.parametrize("balance", ["undersample", "weights"])
@pytest.mark.parametrize("most", [2, 3, 10, 99])
def test_at_most_so_many_bins_of_both_classes(balance, most):
    is_slip = labels(5, 500)
    index, weights = balanced_choice(is_slip, balance, generator(), most)
    assert 2 <= len(index) <= most
    slip = is_slip[index]
    assert bool(slip.any())
    assert not bool(slip.all())
    assert weights is None or len(weights) == len(index)
    if balance == "undersample":
        assert int(slip.sum()) == len(index) // 2


def test_a_limit_above_the_number_of_bins_changes_nothing():
    is_slip = labels(60, 183)
    free = balanced_choice(is_slip, "undersample", generator())[0]
    assert torch.equal(free, balanced_choice(is_slip, "undersample", generator(), 120)[0])


@pytest.mark.parametrize(("value", "name"), [(True, "non-slip"), (False, "slip")])
@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_an_absent_class_is_named(value, name, balance):
    with pytest.raises(ValueError, match=f"both classes, got no {name} bin"):
        balanced_choice(torch.full((9,), value), balance, generator())


def test_an_unknown_balance_is_refused():
    with pytest.raises(ValueError, match="balance must be 'undersample' or 'weights', got 'smote'"):
        balanced_choice(labels(3, 3), "smote", generator())


def test_targets_are_plus_one_for_slip():
    bins = TrainingBins(torch.zeros(2, 1, dtype=torch.float64), torch.tensor([True, False]))
    assert bins.targets.tolist() == [1.0, -1.0]
    assert bins.targets.dtype == torch.float64


# Fit -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("offset", [0.5, 1.5])
@pytest.mark.parametrize("num_bins", [8, 10, 11, 60])
def test_both_routes_equal_kernel_ridge(num_bins, offset, weighted, rng):
    """Three features have ten monomials: the dual up to ten bins, the primal above."""
    assert num_quadratic_features(3) == 10
    bins = draw(rng, num_bins, weighted=weighted)
    new = rng.uniform(-1, 1, (20, 3))
    for penalty in (0.05, 3.0):
        machine = fit_machine(bins, penalty, offset)
        expected = ridge(bins, penalty, offset).predict(new)
        actual = machine(torch.from_numpy(new)).numpy()
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_two_routes_agree(weighted, rng, monkeypatch):
    bins = draw(rng, 40, weighted=weighted)
    primal = fit_machine(bins, 0.3)
    monkeypatch.setattr(fit, "num_quadratic_features", lambda num_features: 1000)
    monkeypatch.setattr(fit, "_solve_primal_in_chunks", None)  # the dual has no need of it
    dual = fit_machine(bins, 0.3)
    for name, value in primal.state_dict().items():
        torch.testing.assert_close(value, dual.state_dict()[name], rtol=1e-10, atol=1e-10)


def test_many_bins_go_through_the_primal_and_few_do_not(rng, monkeypatch):
    monkeypatch.setattr(fit, "solve_kernel_elm", None)
    fit_machine(draw(rng, 11), 0.3)
    with pytest.raises(TypeError):
        fit_machine(draw(rng, 10), 0.3)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("chunk", "block"), [(1, 1), (7, 4), (20, 9), (40, 10), (41, 11)])
def test_chunks_leave_no_seam(chunk, block, weighted, rng, monkeypatch):
    bins = draw(rng, 40, weighted=weighted)
    whole = fit_machine(bins, 0.3)
    monkeypatch.setattr(fit, "CHUNK_BINS", chunk)
    monkeypatch.setattr(fit, "BLOCK_FEATURES", block)
    cut = fit_machine(bins, 0.3)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(cut.state_dict()[name], value, rtol=1e-11, atol=1e-12)


def test_progress_sees_every_chunk(rng, monkeypatch):
    monkeypatch.setattr(fit, "CHUNK_BINS", 16)
    seen = []

    def progress(items, what):
        for item in items:
            seen.append((item, what))
            yield item

    fit_machine(draw(rng, 40), 0.3, progress=progress)
    assert seen == [(0, "normal equations"), (16, "normal equations"), (32, "normal equations")]


@pytest.mark.parametrize("num_bins", [8, 40])
def test_an_infinite_penalty_is_least_squares(num_bins, rng):
    """Interpolation with fewer bins than monomials, the normal equations with more."""
    bins = draw(rng, num_bins)
    machine = fit_machine(bins, float("inf"))
    z = bins.features.numpy()
    columns = [np.ones(num_bins), *z.T] + [z[:, i] * z[:, j] for i in range(3) for j in range(i, 3)]
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


# Validation ----------------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("num_bins", [9, 60])
def test_validation_equals_refitting_for_every_penalty(num_bins, weighted, rng):
    train, held_out = draw(rng, num_bins, weighted=weighted), draw(rng, 200)
    truth = held_out.is_slip.numpy()
    penalties = [0.05, 0.3, 3.0, 50.0]
    expected = []
    for penalty in penalties:
        says_slip = ridge(train, penalty).predict(held_out.features.numpy()) >= 0
        expected.append((says_slip[truth].mean() + (~says_slip[~truth]).mean()) / 2)
    assert validation_scores(train, held_out, penalties) == pytest.approx(expected, abs=1e-12)
    assert len(set(expected)) > 1


def test_validation_follows_the_offset(rng):
    train, held_out = draw(rng, 30), draw(rng, 100)
    machine = fit_machine(train, 0.3, offset=2.0)
    says_slip, truth = machine(held_out.features) >= 0, held_out.is_slip
    recalls = says_slip[truth].double().mean(), (~says_slip[~truth]).double().mean()
    scores = validation_scores(train, held_out, [0.3], offset=2.0)
    assert scores == pytest.approx([float(sum(recalls)) / 2])


def test_held_out_bins_do_not_move_each_others_scores(rng):
    """The score of two halves is the mean of theirs where both have the same classes."""
    train, held_out = draw(rng, 30), draw(rng, 40)
    twice = TrainingBins(held_out.features.repeat(2, 1), held_out.is_slip.repeat(2))
    assert validation_scores(train, twice, [0.1, 3.0]) == pytest.approx(
        validation_scores(train, held_out, [0.1, 3.0])
    )


@pytest.mark.parametrize("value", [True, False])
def test_a_class_absent_from_the_held_out_bins_is_refused(value, rng):
    held_out = draw(rng, 10)
    one_class = TrainingBins(held_out.features, torch.full((10,), value))
    with pytest.raises(ValueError, match="held-out bins of both classes"):
        validation_scores(draw(rng, 12), one_class, [0.3])
