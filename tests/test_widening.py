"""Probabilities of uncertain scores beside the integral that they stand for."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import expit

from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.widening import MOST_OFF, widened_llr


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


def test_the_less_certain_a_score_the_nearer_to_even_and_never_across():
    score = torch.tensor([-2.0, -0.1, 0.1, 2.0], dtype=torch.float64)
    variance = torch.tensor([0.0, 0.1, 1.0, 10.0, 1e6], dtype=torch.float64)[:, None]
    found = widened_llr(
        Isotonic((-3.0, 3.0), (-6.0, 6.0)), *torch.broadcast_tensors(score, variance)
    )
    assert torch.equal(found.sign(), score.sign().expand(5, 4))
    assert (found.abs().diff(dim=0) <= 0).all()


def test_what_saturates_stays_finite():
    found = widened_llr(Platt(1e20, 0.0), torch.tensor([1e30, -1e30]), torch.tensor([1e38, 0.0]))
    assert found.isfinite().all()
