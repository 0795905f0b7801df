"""What an uncertain score tells of slip: the log likelihood ratio drawn towards 0."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tactslip_torch.model.calibration import Calibration

MOST_OFF = 0.02
"""By which a probability may be off that of the integral, at any mean and variance.

Of equal shares of slip and non-slip, as the classes were weighed for the variance; other shares
come in afterwards by Bayes (``probability``), and no bound is stated for them.
"""


def widened_llr(calibration: Calibration, score: Tensor, variance: Tensor) -> Tensor:
    """Log likelihood ratios of scores that are known up to a variance.

    The mean of ``sigmoid(llr)`` over scores ``N(score, variance)`` is about ``sigmoid(llr / sqrt(1
    + pi / 8 s^2))``, ``s`` being the standard deviation of llr; here half the difference of the
    ratios one standard deviation above and below, which for ``Platt`` is exact. A variance of 0
    leaves the ratio as it is.

    Args:
        calibration: from a score to its ratio.
        score: expected.
        variance: of the score.

    Shape:
        - score, variance, output: ``[*]``; dtype of ``score``

    Reference:
        MacKay (1992), Neural Computation 4(5), 720-736.
    """
    llr = calibration.llr(score).double()
    # 0 gives way to what changes no ratio, and has a finite slope
    away = variance.double().clamp(min=torch.finfo(torch.float64).tiny).sqrt()
    above, below = (calibration.llr(score.double() + sign * away) for sign in (1, -1))
    spread = (above - below) / 2
    return (llr / (1 + math.pi / 8 * spread.square()).sqrt()).to(score.dtype)
