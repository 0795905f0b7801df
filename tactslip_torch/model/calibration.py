"""From a detector's score to a log likelihood ratio, and whether probabilities mean what they say.

A *log likelihood ratio* (llr, natural) is what a score tells of slip against non-slip, apart from
how common either is. A stream's share of slip comes in afterwards, by Bayes (``probability``).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, softplus

from tactslip_torch.runtime import check_share

log = logging.getLogger(__name__)

LARGEST_LLR = 1e30  # where llrs saturate, so that what adds them up stays finite in float32
LARGEST_SCORE = 1e300  # beyond it the difference of two scores may leave float64


@dataclass(frozen=True)
class Platt:
    """``llr = slope * score + offset``, in float64, rounded once, at most ``LARGEST_LLR``.

    Written in operations that values of an ONNX graph have too.

    Raises:
        ValueError: if a number is not finite or the slope negative.
    """

    slope: float
    offset: float

    def __post_init__(self) -> None:
        if not (0 <= self.slope < math.inf and math.isfinite(self.offset)):
            raise ValueError(
                f"expected a finite slope of at least 0 and a finite offset, got {self.slope:g} "
                f"and {self.offset:g}; fit again on other scores"
            )

    def llr(self, score: Tensor) -> Tensor:
        """Log likelihood ratios: ``[*] -> [*]``, dtype of ``score``; NaN stays NaN."""
        line = self.slope * score.double().clamp(-LARGEST_SCORE, LARGEST_SCORE) + self.offset
        return line.clamp(-LARGEST_LLR, LARGEST_LLR).type_as(score)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; ``calibration_from_dict`` reads them."""
        return {"kind": "platt", **asdict(self)}


def calibration_from_dict(plain: Mapping[str, Any]) -> Platt:
    """The calibration that ``to_dict`` wrote.

    Raises:
        ValueError: if it is none of this version.
    """
    try:
        match dict(plain):
            case {"kind": "platt", **rest}:
                return Platt(**{name: float(value) for name, value in rest.items()})
        raise ValueError("kind must be platt")
    except (TypeError, ValueError) as error:
        raise ValueError(f"no calibration of this version: {error}") from error


def fit_platt(scores: Tensor, is_slip: Tensor, weights: Tensor | None = None) -> Platt:
    """Logistic regression on the score, the balance of the bins taken out of it.

    Newton's method on the log loss towards Platt's targets, ``(n + 1) / (n + 2)`` for the ``n``
    bins of slip and ``1 / (m + 2)`` for the ``m`` others: separable scores get a finite slope.
    Equal scores tell nothing, ``llr = 0``.

    Args:
        scores: of held-out bins.
        is_slip: their truth.
        weights: of the bins; one of weight 2 counts as two. Default: 1 each.

    Shape:
        - scores, is_slip (bool), weights: ``[N]``

    Raises:
        ValueError: if lengths differ, a class is absent, a score is not finite, a weight negative,
            or if slip has the lower scores.

    Reference:
        Platt (1999), Advances in Large Margin Classifiers, 61-74; Lin, Lin and Weng (2007), Machine
        Learning 68, 267-276.
    """
    x, slip, w = _checked("scores", scores, is_slip, weights)
    if (x == x[0]).all():
        return Platt(0.0, 0.0)
    n, m = w[slip].sum(), w[~slip].sum()
    target = torch.where(slip, (n + 1) / (n + 2), 1 / (m + 2))
    prior = float(torch.logit((w * target).sum() / w.sum()))
    x = x / (size := float(x.abs().max()))
    centre = float((w * x).sum() / w.sum())
    spread = float(((w * (x - centre).square()).sum() / w.sum()).sqrt())
    slope, offset = _logistic((x - centre) / spread, target, w, prior)
    if slope < -1e-9:  # in units of the spread, more than rounding
        raise ValueError("slip has the lower scores; change their sign or look at the labels")
    slope = max(slope, 0.0) / spread
    return Platt(slope / size, offset - prior - slope * centre)


def platt_or_none(scores: Tensor, is_slip: Tensor, weights: Tensor | None) -> dict[str, Any] | None:
    """Platt's calibration of held-out scores, JSON-able; ``None``, logged, if they are reversed."""
    try:
        return fit_platt(scores, is_slip, weights).to_dict()
    except ValueError as error:
        log.warning("scores are not calibrated: %s", error)
        return None


def probability(llr: Tensor, slip_share: float) -> Tensor:
    """How probable slip is where this share of all bins is slip (Bayes): ``[*] -> [*]``.

    Raises:
        ValueError: if the share does not lie between 0 and 1.
    """
    check_share("slip_share", slip_share)
    return (llr + (math.log(slip_share) - math.log1p(-slip_share))).sigmoid()


def reliability(
    probability: Tensor, is_slip: Tensor, num_cells: int = 15, weights: Tensor | None = None
) -> dict[str, Any]:
    """How far probabilities ``[N]`` are from what happened, in cells of equal weight.

    Equal probabilities share a cell, so there may be fewer. Chance alone gives a perfect detector
    an error of about ``sqrt(2 / pi * num_cells * p (1 - p) / N)``.

    Returns:
        ``probabilities``, the mean of each cell, rising, its ``slip_shares`` and ``counts`` (of
        bins, or their weight); ``ece``, the mean distance of the first two over bins (expected
        calibration error), ``mce``, the largest of a cell, ``brier``, the mean squared error, and
        ``log_loss``, the mean of -log of the probability of what was true, of a bin at most 100.

    Raises:
        ValueError: if lengths differ, no bin weighs anything, a weight is negative or a probability
            lies outside 0 to 1.

    Reference:
        Guo et al. (2017), ICML; cells of equal mass: Nixon et al. (2019), CVPR workshops.
    """
    p, slip, w = _checked("probability", probability, is_slip, weights)
    values, place = torch.unique(p, return_inverse=True)
    mass = w.new_zeros(len(values)).index_add(0, place, w)
    middle = (mass.cumsum(0) - mass / 2) / mass.sum()
    cell = (middle * num_cells).long().clamp(0, num_cells - 1)[place]
    truth = slip.to(p)
    sums = w.new_zeros(num_cells, 3)
    sums.index_add_(0, cell, torch.stack([w, w * p, w * truth], dim=-1))
    count, stated, happened = sums[sums[:, 0] > 0].unbind(-1)
    gap = (stated - happened).abs()
    return {
        "probabilities": (stated / count).tolist(),
        "slip_shares": (happened / count).tolist(),
        "counts": count.tolist(),
        "ece": float(gap.sum() / w.sum()),
        "mce": float((gap / count).max()),
        "brier": float((w * (p - truth).square()).sum() / w.sum()),
        "log_loss": float(binary_cross_entropy(p, truth, w, reduction="sum") / w.sum()),
    }


def _logistic(x: Tensor, target: Tensor, w: Tensor, offset: float) -> tuple[float, float]:
    """Slope and offset of least log loss, for ``x`` of mean 0 and spread 1."""

    def loss(at: Tensor) -> Tensor:
        z = at[0] * x + at[1]
        return (w * (softplus(z) - target * z)).sum()

    at, least = x.new_tensor([0.0, offset]), 1e-12 * w.sum()  # as Lin et al.: it never vanishes
    for _ in range(100):  # some ten are needed
        p, q = (torch.sigmoid(sign * (at[0] * x + at[1])) for sign in (1, -1))
        downhill, curvature = w * (target - p), w * p * q
        middle = (curvature * x).sum() / (curvature.sum() + least)  # slope and offset part there
        turn = (downhill * (x - middle)).sum()
        by = turn / ((curvature * (x - middle).square()).sum() + least)
        lift = downhill.sum() / (curvature.sum() + least)
        step = torch.stack([by, lift - by * middle])
        gain = turn * by + downhill.sum() * lift
        move = float((step[0] * x + step[1]).abs().max())
        part, here = 1.0, loss(at)
        while move * part > 0.1 and loss(at + part * step) > here - 1e-4 * part * gain:
            part /= 2  # shorter moves are safe: the curvature hardly changes along them
        at = at + part * step
        if move < 1e-9:  # what is left is its square
            break
    return float(at[0]), float(at[1])


def _checked(
    name: str, values: Tensor, is_slip: Tensor, weights: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Values, truth and weights of the bins that weigh anything; float64, without gradient."""
    x, slip = values.detach().double(), is_slip.bool()
    w = torch.ones_like(x) if weights is None else weights.detach().to(x)
    if not (x.ndim == 1 and x.shape == slip.shape == w.shape):
        shapes = f"{tuple(x.shape)}, {tuple(slip.shape)} and {tuple(w.shape)}"
        raise ValueError(f"expected {name}, is_slip and weights [N] of one N, got {shapes}")
    if not ((w >= 0).all() and 0 < float(w.sum()) < math.inf):
        raise ValueError("weights must be finite, at least 0 and not all 0; give some to a bin")
    x, slip, w = x[w > 0], slip[w > 0], w[w > 0]
    least, most = (0.0, 1.0) if name == "probability" else (-LARGEST_SCORE, LARGEST_SCORE)
    if not ((x >= least) & (x <= most)).all():
        raise ValueError(f"{name} must lie in {least:g} to {most:g}; leave out what is not valid")
    if name == "scores" and slip.all() == slip.any():
        raise ValueError(f"calibration needs slip and non-slip, got one of them in {len(x)} bins")
    return x, slip, w
