"""The expected score without some features, against quadrature and SciPy's Gaussians."""

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import expit
from scipy.stats import multivariate_normal

from tactslip_torch.model.calibration import Isotonic, Platt, widened_llr
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.missing_channels import RESOLUTION, ClassGaussians, expected_score

NUM = 7
MOST_OFF = 0.02  # by which a probability may be off the integral's, of equal priors


def head_of(rng, num=NUM):
    bend = torch.from_numpy(rng.standard_normal((num, num)))
    linear = torch.from_numpy(rng.standard_normal(num))
    return QuadraticForm(bend + bend.T, linear, torch.tensor(0.3, dtype=torch.float64))


def gaussians_of(rng, num=NUM):
    factor = torch.from_numpy(rng.standard_normal((2, num, 2 * num)))
    mean = torch.from_numpy(rng.uniform(-0.5, 0.5, (2, num)))
    return ClassGaussians(mean, factor @ factor.mT / (8 * num))


def by_quadrature(head, gaussians, z, lost):
    """Mean and variance of the score over both classes' conditionals, from their definitions.

    Three Gauss-Hermite points an axis are exact for the fourth powers of a squared quadratic.
    """
    seen = [i for i in range(len(z)) if i not in lost]
    points, heights = np.polynomial.hermite_e.hermegauss(3)
    grid = np.stack(np.meshgrid(*[points] * len(lost), indexing="ij"), -1).reshape(-1, len(lost))
    share = np.prod(np.meshgrid(*[heights] * len(lost), indexing="ij"), 0).reshape(-1)
    share = share / share.sum()
    density, moments = [], []
    for mean, covariance in zip(gaussians.mean.numpy(), gaussians.covariance.numpy(), strict=True):
        across = covariance[np.ix_(lost, seen)] @ np.linalg.inv(covariance[np.ix_(seen, seen)])
        middle = mean[lost] + across @ (z[seen] - mean[seen])
        left = covariance[np.ix_(lost, lost)] - across @ covariance[np.ix_(seen, lost)]
        bins = np.tile(z, (len(grid), 1))
        bins[:, lost] = middle + grid @ np.linalg.cholesky(left).T
        scores = head(torch.from_numpy(bins)).numpy()
        moments.append((share @ scores, share @ scores**2))
        of_seen = covariance[np.ix_(seen, seen)]
        density.append(multivariate_normal(mean[seen], of_seen).pdf(z[seen]) if seen else 1.0)
    weight = np.array(density) / np.sum(density)
    first, second = weight @ np.array(moments)
    return first, second - first**2


@pytest.fixture
def expected(rng):
    """Mean and variance of bins, given which features are missing."""
    return partial(expected_score, head_of(rng), gaussians_of(rng))


@pytest.mark.parametrize("lost", [[2], [0, 6], [1, 3, 4, 5], list(range(NUM))], ids=str)
def test_mean_and_variance_are_those_of_the_mixture(lost, rng):
    head, gaussians = head_of(rng), gaussians_of(rng)
    z = torch.from_numpy(rng.uniform(-1, 1, (5, NUM)))
    is_missing = torch.zeros(5, NUM, dtype=torch.bool)
    is_missing[:, lost] = True
    mean, variance = expected_score(head, gaussians, z, is_missing)
    for row in range(5):
        expected = by_quadrature(head, gaussians, z[row].numpy(), lost)
        np.testing.assert_allclose([mean[row], variance[row]], expected, rtol=1e-9)


def test_bins_that_miss_other_features_are_judged_each_by_their_own(expected, rng):
    z = torch.from_numpy(rng.uniform(-1, 1, (40, NUM)))
    is_missing = torch.from_numpy(rng.integers(0, 4, (40, 1)) == np.arange(NUM) % 4)
    z[is_missing] = torch.nan  # what stands there does not matter
    together = expected(z, is_missing)
    alone = [expected(z[i : i + 1], is_missing[i : i + 1]) for i in range(40)]
    for found, each in zip(together, zip(*alone, strict=True), strict=True):
        torch.testing.assert_close(found, torch.cat(each), rtol=1e-12, atol=1e-12)


def test_gradients_in_what_is_observed(expected, rng):
    is_missing = torch.zeros(3, NUM).bool()
    is_missing[:2, [1, 5]] = True
    z = torch.from_numpy(rng.uniform(-1, 1, (3, NUM))).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: expected(x, is_missing), z)
    mean, _ = expected(z, is_missing)
    (slope,) = torch.autograd.grad(mean.sum(), z)
    assert torch.equal(slope[:2, [1, 5]], torch.zeros(2, 2, dtype=torch.float64))


def test_threads_may_share_what_is_kept(expected):
    """Once a KeyError, where one thread forgot what another had just found."""
    masks = torch.eye(3, NUM, dtype=torch.bool)
    z = torch.zeros(1, NUM, dtype=torch.float64)
    alone = [float(expected(z, mask[None])[0]) for mask in masks]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            found = pool.map(lambda i: float(expected(z, masks[i % 3][None])[0]), range(300))
            assert list(found) == alone * 100
    finally:
        sys.setswitchinterval(before)


def test_few_bins_constant_and_repeated_features_still_give_gaussians(rng):
    z = torch.from_numpy(rng.standard_normal((9, 20)))
    z[:, 3], z[:, 5] = 0.5, z[:, 4]
    found = ClassGaussians.fit(z, torch.arange(9) < 4)
    least = torch.linalg.eigvalsh(found.covariance).min()
    assert float(least) > RESOLUTION / 2
    assert float(found.covariance[0, 3, 3]) == RESOLUTION


@pytest.mark.parametrize(
    ("mean", "covariance", "said"),
    [
        (torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), "float64"),
        (torch.zeros(3).double(), torch.eye(3).double(), "mean .2, K. and covariance"),
        (torch.zeros(2, 3).double(), torch.zeros(2, 3, 3).double(), "positive definite"),
    ],
)
def test_what_are_no_gaussians_is_refused(mean, covariance, said):
    with pytest.raises(ValueError, match=said):
        ClassGaussians(mean, covariance)


# Log likelihood ratios of uncertain scores -----------------------------------------------------


def integral(mean, spread):
    """Mean of the logistic function over ``N(mean, spread^2)``."""

    def at(x):
        return expit(mean + spread * x) * np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)

    return quad(at, -12, 12, limit=400)[0]


@pytest.mark.parametrize("spread", [0.1, 1.0, 3.0, 10.0])
def test_the_probability_is_that_of_the_integral(spread):
    calibration = Platt(2.0, -0.5)
    score = torch.linspace(-8, 8, 41, dtype=torch.float64)
    variance = torch.full_like(score, (spread / 2) ** 2)
    stated = torch.sigmoid(widened_llr(calibration, score, variance)).numpy()
    expected = [integral(mean, spread) for mean in calibration.llr(score).tolist()]
    assert np.abs(stated - expected).max() < MOST_OFF


@pytest.mark.parametrize(
    "calibration", [Platt(3.0, 0.2), Isotonic((-1.0, 0.5, 2.0), (-3.0, 0.0, 4))]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_certain_score_is_left_to_the_bit(calibration, dtype):
    score = torch.linspace(-3, 3, 101, dtype=dtype)
    found = widened_llr(calibration, score, torch.zeros_like(score))
    assert found.dtype == dtype
    assert torch.equal(found, calibration.llr(score))
