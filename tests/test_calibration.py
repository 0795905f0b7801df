"""Scores become log likelihood ratios; scikit-learn and SciPy say what the fits must be."""

import math

import numpy as np
import pytest
import torch
from scipy.special import expit, logit
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import brier_score_loss, log_loss

from tactslip_torch.model import calibration


def logistic_bins(rng, num, slope, offset, share=0.5, spread=2.0):
    """Scores and truth whose log likelihood ratio is ``slope * score + offset`` but for a constant.

    The scores of both classes come from one law tilted by the ratio, so at any share of slip the
    log odds are linear with this slope.
    """
    scores = rng.normal(0, spread, num)
    is_slip = rng.uniform(size=num) < expit(slope * scores + offset + logit(share))
    return scores, is_slip


def tensors(*arrays):
    return tuple(torch.from_numpy(np.asarray(array)) for array in arrays)


# ------------------------------------------------------------------------------------- Platt
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-6, 3.0), (1e4, -2e4)])
def test_platt_is_sklearns_logistic_regression_towards_platts_targets(scale, shift, weighted, rng):
    scores, is_slip = logistic_bins(rng, 400, 1.2, -0.7)
    weights = rng.uniform(0.2, 3, 400) if weighted else np.ones(400)
    n, m = weights[is_slip].sum(), weights[~is_slip].sum()
    target = np.where(is_slip, (n + 1) / (n + 2), 1 / (m + 2))
    # a soft target is a bin of each class, weighted by it
    parts = np.concatenate([weights * target, weights * (1 - target)])
    oracle = LogisticRegression(C=1e15, tol=1e-14, solver="newton-cholesky", max_iter=500)
    oracle.fit(np.tile(scores, 2)[:, None], np.repeat([1, 0], 400), sample_weight=parts)
    balance = logit((weights * target).sum() / weights.sum())
    fitted = calibration.fit_platt(*tensors(scale * scores + shift, is_slip, weights))
    llr = fitted.llr(torch.from_numpy(scale * scores + shift)).numpy()
    expected = oracle.coef_[0, 0] * scores + oracle.intercept_[0] - balance
    np.testing.assert_allclose(llr, expected, atol=1e-6, rtol=1e-6)


def test_backward_scores_are_refused(rng):
    scores, is_slip = tensors(*logistic_bins(rng, 300, -1.5, 0.0))
    with pytest.raises(ValueError, match="slip has the lower scores; change their sign"):
        calibration.fit_platt(scores, is_slip)
    assert calibration.fit_platt(-scores, is_slip).slope > 1


# ----------------------------------------------------------------------------- what all share
CALIBRATIONS = {
    "platt": calibration.Platt(1.7, -0.4),
    "flat": calibration.Platt(0.0, 0.0),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", CALIBRATIONS)
def test_huge_scores_give_finite_ratios_and_nan_stays(name, dtype):
    most = torch.finfo(dtype).max
    x = torch.tensor([-torch.inf, -most, -1e30, 1e30, most, torch.inf], dtype=dtype)
    x.requires_grad_()
    for each in (CALIBRATIONS[name], calibration.Platt(1e20, 3.0)):
        llr = each.llr(x)
        assert llr.dtype == dtype
        assert llr.abs().max() <= torch.tensor(calibration.LARGEST_LLR, dtype=dtype)
        assert (llr.diff() >= 0).all()
        (gradient,) = torch.autograd.grad(llr.sum(), x)
        assert gradient.isfinite().all()
        assert each.llr(torch.tensor([torch.nan, 0.0])).isnan().tolist() == [True, False]


NO_CALIBRATIONS = [
    {"kind": "platt", "slope": -1.0, "offset": 0.0},
    {"kind": "platt", "slope": 1.0, "offset": 0.0, "more": 1.0},
    {},
]


@pytest.mark.parametrize("plain", NO_CALIBRATIONS)
def test_what_is_no_calibration_is_refused_in_a_line(plain):
    with pytest.raises(ValueError, match="no calibration of this version"):
        calibration.calibration_from_dict(plain)


NOT_TO_BE_FITTED = [
    ([1.0, 2.0], [True, True], None, "needs slip and non-slip"),
    ([1.0, 2.0, 3.0], [True, False, True], [0.0, 1.0, 0.0], "needs slip and non-slip"),
    ([1.0, math.nan], [True, False], None, "scores must lie in"),
    ([1.0, 2.0], [True], None, "of one N"),
    ([1.0, 2.0], [True, False], [1.0, -1.0], "weights must be finite"),
    ([], [], None, "weights must be finite"),
]


@pytest.mark.parametrize(("scores", "is_slip", "weights", "message"), NOT_TO_BE_FITTED)
def test_what_cannot_be_fitted_is_refused_in_a_line(scores, is_slip, weights, message):
    given = torch.tensor(scores), torch.tensor(is_slip, dtype=torch.bool)
    with pytest.raises(ValueError, match=message):
        calibration.fit_platt(*given, None if weights is None else torch.tensor(weights))


# -------------------------------------------------------------------------------- probability
@pytest.mark.parametrize("share", [0.001, 0.5])
def test_probability_is_bayes_at_another_balance(share):
    """Two known densities: the ratio from one balance gives the posterior at any other."""
    slip, rest = np.exp(-np.array([0.1, 1.0, 5.0])), np.exp(-np.array([4.0, 1.0, 0.3]))
    posterior = share * slip / (share * slip + (1 - share) * rest)
    llr = torch.from_numpy(np.log(slip / rest))
    np.testing.assert_allclose(calibration.probability(llr, share), posterior, rtol=1e-12)


# -------------------------------------------------------------------------------- reliability
def plain_reliability(p, y, w, num_cells):
    """Cells by where the middle of a probability's weight falls, tied ones together."""
    done, cells = 0.0, {}
    for value in np.unique(p):
        own = p == value
        middle = done + w[own].sum() / 2
        done += w[own].sum()
        number = min(int(num_cells * middle / w.sum()), num_cells - 1)
        cells[number] = cells.get(number, False) | own
    means = [[np.average(x[own], weights=w[own]) for x in (p, y)] for own in cells.values()]
    return *np.array(means).T, [w[own].sum() for own in cells.values()]


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("levels", [None, 5])
def test_cells_and_errors_are_the_definitions(weighted, levels, rng):
    p = rng.uniform(size=800) ** 2
    if levels:
        p = np.round(p * levels) / levels
    y = rng.uniform(size=800) < p**1.5
    w = rng.uniform(0.2, 3, 800) if weighted else np.ones(800)
    found = calibration.reliability(*tensors(p, y), num_cells=10, weights=torch.from_numpy(w))
    stated, happened, count = plain_reliability(p, y, w, 10)
    np.testing.assert_allclose(found["probabilities"], stated, rtol=1e-12)
    np.testing.assert_allclose(found["slip_shares"], happened, atol=1e-12)
    np.testing.assert_allclose(found["counts"], count, rtol=1e-12)
    gap = np.abs(stated - happened)
    errors = {"ece": np.average(gap, weights=count), "mce": gap.max()}
    errors["brier"] = brier_score_loss(y, p, sample_weight=w)
    assert {name: found[name] for name in errors} == pytest.approx(errors, rel=1e-12)
    inside = np.clip(p, 1e-9, 1 - 1e-9)
    found = calibration.reliability(*tensors(inside, y), weights=torch.from_numpy(w))
    assert found["log_loss"] == pytest.approx(log_loss(y, inside, sample_weight=w), rel=1e-9)


@pytest.mark.parametrize(
    ("p", "message"),
    [
        ([0.5, 1.1], "must lie in 0 to 1"),
        ([0.5, math.nan], "must lie in 0 to 1"),
        ([1], "of one N"),
    ],
)
def test_reliability_of_no_probabilities_is_refused(p, message):
    with pytest.raises(ValueError, match=message):
        calibration.reliability(torch.tensor(p), torch.tensor([True, False]))
