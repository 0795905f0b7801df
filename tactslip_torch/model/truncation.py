"""What rounding and truncation may take from a system, and when that is refused.

Close to singular, components of a matrix that are rounding noise are left out. What that may cost
a score is reckoned beforehand: components that are no noise, bins lost for their small weight, and
what sums with heavy bins leave of the lightest one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LARGEST_ERROR = 1e-3  # of a solution that is handed out
LARGEST_ERROR_FROM_FLOAT32 = 1e-2  # of one whose matrix came in float32
LARGEST_LOSS = 1e-3  # of what the lightest bin says, in a sum with the heaviest
_MOST_LEFT_OUT = 1e-2  # that what is left out, and is there, may add to a score
_TINY = torch.finfo(torch.float64).tiny
_EPS = torch.finfo(torch.float64).eps


def truncated(
    matrix: Tensor,
    right: Tensor,
    roots: Tensor,
    penalty: float,
    given: torch.dtype,
    *,
    noise: float = 0.0,
    in_span: bool = False,
    name: str = "matrix",
) -> tuple[Tensor, float, float, float, int]:
    """``roots (matrix + I / penalty)^-1 roots right`` on what is above rounding.

    The matrix is ``sqrt(w) A sqrt(w)``, roots are ``sqrt(w)``, given is the dtype that A came in;
    all else as in ``solve_symmetric_``. Returns the solution, condition and error of what is kept,
    what is left out (``SolveReport``) and the rank.

    Raises:
        ValueError: if the matrix is not positive semi-definite, its errors drown what is kept, or
            what is left out is above rounding and adds a hundredth to a score.
    """
    values, vectors = torch.linalg.eigh(matrix)
    top, low, num = float(values[-1]), float(values[0]), len(values)
    eps = torch.finfo(given).eps
    rounding, cutoff = max(eps * max(top, -low), noise), max(num * eps * top, noise)
    if low < -max(10 * cutoff, 0.0):
        raise ValueError(
            f"{name} is not positive semi-definite: it has the eigenvalue {low:.3g} beside "
            f"{top:.3g}; it must be a sum of squares"
        )
    kept = values > cutoff
    rank, ridge = int(kept.sum()), 1 / penalty
    shares = vectors.mT @ (roots * right)
    parts = torch.where(kept, shares / torch.where(kept, values + ridge, 1.0), 0.0)
    least = float(values[num - rank] + ridge) if rank else math.inf
    condition, error = (top + ridge) / least, rounding / least
    if (noise > 0 and rank < num) or error > (
        LARGEST_ERROR if eps <= _EPS else LARGEST_ERROR_FROM_FLOAT32
    ):
        raise ValueError(
            f"{name} at penalty={penalty:g} has rank {rank} of {num} and a condition of "
            f"{condition:.1e}, too much for the error it came with ({error:.0e}, from "
            f"{str(given).removeprefix('torch.')}); lower the penalty, or make it exactly"
        )
    dropped, away = values[: num - rank], vectors[:, : num - rank]
    size = float(torch.linalg.vector_norm(values.clamp(min=0).sqrt() * parts))

    def added(at: Tensor) -> float:
        """To a score of a training bin, relative, were these the eigenvalues left out."""
        share = shares[: num - rank].abs()
        if in_span:  # that of the targets is this over the root of the eigenvalue
            part = (at.sqrt() / (at + ridge)).nan_to_num(0.0) * share
            most = torch.linalg.vector_norm(part) / size
        else:
            part = (at / (at + ridge)).nan_to_num(0.0) * share
            most = (away.abs() @ part / roots).max() / right.abs().max()
        return min(float(most.nan_to_num(0.0)), 1.0)

    seen = added(torch.where(dropped > math.sqrt(num) * rounding, dropped, 0.0))
    if seen > _MOST_LEFT_OUT:
        raise ValueError(
            f"{name} at penalty={penalty:g} is nearly singular: eigenvalues of "
            f"{float(dropped[-1]) / top:.0e} of the largest add {seen:.0e} to scores, but drown in "
            "rounding; leave out what is nearly duplicate, or lower the penalty"
        )
    unseen = dropped.clamp(min=0) + rounding
    if in_span:
        unseen = unseen.clamp(max=max(ridge, _TINY))  # where it would add most
    return roots * (vectors @ parts), condition, error, added(unseen), rank


def light_bins(diagonal: Tensor, weights: Tensor, eps: float) -> Tensor:
    """Which bins a cut at rounding would lose for their weights: ``[*, n]``, bool."""
    own, least = diagonal * weights, diagonal.shape[-1] * eps
    lost, faint = ((x <= least * x.amax(-1, keepdim=True)) for x in (own, diagonal))
    return lost & ~faint


def check_light(
    diagonal: Tensor, weights: Tensor, penalty: float, given: torch.dtype, name: str
) -> None:
    """Refuse to lose a bin of which C makes a hundredth of its score."""
    own = diagonal * weights
    lost = light_bins(diagonal, weights, torch.finfo(given).eps) & (
        own > 1e-2 * (own + 1 / penalty)
    )
    if bool(lost.any()):
        raise ValueError(
            f"{name} at penalty={penalty:g} is singular, with weights from "
            f"{float(weights.min()):.1e} to {float(weights.max()):.1e} too far apart to leave only "
            "noise out; bring them closer, or lower the penalty"
        )


def lost_in_sums(weights: Tensor, penalty: float, square: float) -> float:
    """How much of the lightest bin ``X'WX`` loses; ``square`` is of the longest row of ``X``."""
    light, heavy = (float(bound) * square for bound in weights.aminmax())
    return _EPS * heavy / (light + 1 / penalty)
