"""The kernel extreme learning machine, solved in closed form (paper section IV-E).

On targets of +-1 this is kernel ridge regression with ``alpha = 1 / C``; with class weights it is
the weighted ELM of Zong, Huang and Chen (2013). Two routes to the same machine: dual, one
unknown per training bin, and primal, one unknown per monomial of the features. Functions whose
name ends in ``_`` solve within the matrix they are given; the others are differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import check_finite
from tactslip_torch.model.symmetric_solve import (
    Solution,
    check_spectrum,
    conditions_of,
    largest_condition,
    solve_symmetric_,
)

LARGEST_LOSS = 1e-3  # of what the lightest bin says, in a sum with the heaviest
_EPS = torch.finfo(torch.float64).eps


def solve_kernel_elm(
    gram: Tensor, targets: Tensor, penalty: float, weights: Tensor | None = None
) -> Tensor:
    """Output weights of the kernel machine: ``(gram + diag(1 / (penalty * weights)))^-1 targets``.

    One Cholesky factorisation, no inverse. Differentiable in ``gram`` and ``targets``. Where the
    system is too close to singular for that (``symmetric_solve`` has the rule), components of the
    weighted Gram matrix that are rounding noise are left out: they add nothing to any score, and
    derivatives are those at constant rank. With ``penalty=inf`` that is the minimum-norm (weighted)
    least-squares solution through the Moore-Penrose pseudo-inverse, the paper's wording.

    Solved in float64. A float32 ``gram`` carries its rounding times the condition into the
    solution: it is refused where that exceeds 1e-2.

    Args:
        gram: kernel matrix of the training bins, symmetric, positive semi-definite; only its
            lower triangle is read.
        targets: +1 for slip and -1 for non-slip.
        penalty: the paper's ``C``, positive; larger fits the training bins more closely.
        weights: positive weight of each bin; default 1.

    Shape:
        - gram: ``[*, N, N]``; targets, weights, output: ``[*, N]``

    Raises:
        ValueError: if shapes disagree, ``penalty`` is not positive, a number is not finite,
            ``gram`` is not positive semi-definite, or float32 is not enough.

    Reference:
        Huang, Zhou, Ding and Zhang (2012), IEEE Trans. SMC-B 42(2), 513-529. Equals ``dual_coef_``
        of ``sklearn.kernel_ridge.KernelRidge(alpha=1 / penalty)``.

    Example:
        >>> solve_kernel_elm(torch.eye(2), torch.tensor([1.0, -1.0]), penalty=1.0)
        tensor([ 0.5000, -0.5000])
    """
    _check_system(gram, targets, weights, penalty)
    weights = torch.ones_like(targets) if weights is None else weights
    return _solve(gram, targets, penalty, weights, "gram")


def solve_kernel_elm_(
    gram: Tensor,
    targets: Tensor,
    penalty: float,
    weights: Tensor | None = None,
    *,
    restore: Callable[[Tensor], object] | None = None,
    most_condition: float | None = None,
) -> Solution:
    """``solve_kernel_elm`` within the matrix it is given, and a report: ``solve_symmetric_``.

    Not differentiable. The factor overwrites ``gram``; the bits do not depend on the number of
    threads.

    Args:
        gram: as in ``solve_kernel_elm``.
        targets: likewise.
        penalty: likewise.
        weights: likewise.
        restore: as in ``solve_symmetric_``.
        most_condition: likewise.

    Shape:
        - gram: ``[N, N]``, row-major; targets, weights, output: ``[N]``

    Raises:
        ValueError: as ``solve_kernel_elm``.
    """
    _check_system(gram, targets, weights, penalty)
    return solve_symmetric_(
        gram, targets, penalty, weights, name="gram", restore=restore, most_condition=most_condition
    )


def solve_primal(
    features: Tensor, targets: Tensor, penalty: float, weights: Tensor | None = None
) -> Tensor:
    """Weights of explicit features: ``(X' W X + I / penalty)^-1 X' W targets``.

    The same machine as ``solve_kernel_elm`` on ``gram = X X'``, cheaper when there are more bins
    than features (``beta = penalty W (t - X w)``, ``w = X' beta``).

    Args:
        features: explicit feature map of the training bins, such as ``quadratic_features``.
        targets: +1 for slip and -1 for non-slip.
        penalty: the paper's ``C``, positive; ``inf`` for the minimum-norm least squares.
        weights: positive weight of each bin; default 1.

    Shape:
        - features: ``[N, P]``; targets, weights: ``[N]``; output: ``[P]``

    Raises:
        ValueError: as ``solve_kernel_elm``.
    """
    if features.shape[:1] != targets.shape:
        raise ValueError(
            f"expected features [N, P] and targets [N], got {tuple(features.shape)} "
            f"and {tuple(targets.shape)}"
        )
    _check_weights(weights, targets)
    x = features.double()  # exact, so that only the result is rounded
    if weights is not None and x.numel():
        check_spread(weights.detach(), penalty, float(x.detach().square().sum(-1).max()))
    weighted = x if weights is None else x * weights[:, None]
    moment = weighted.mT @ targets.double()
    return solve_normal_equations(x.mT @ weighted, moment, penalty).to(features.dtype)


def lost_in_sums(weights: Tensor, penalty: float, square: float) -> float:
    """How much of what the lightest bin says ``X'WX`` loses to rounding; the dual loses none.

    Args:
        weights: of the bins.
        penalty: the paper's ``C``.
        square: of the longest row of ``X``.
    """
    return _EPS * float(weights.max()) * square / (float(weights.min()) * square + 1 / penalty)


def check_spread(weights: Tensor, penalty: float, square: float) -> None:
    """Refuse weights too far apart for ``X'WX``; arguments of ``lost_in_sums``.

    Raises:
        ValueError: if more than ``LARGEST_LOSS`` is lost.
    """
    lost = lost_in_sums(weights, penalty, square)
    if lost > LARGEST_LOSS:
        raise ValueError(
            f"weights from {float(weights.min()):.1e} to {float(weights.max()):.1e} are too far "
            f"apart for X'WX: it loses {lost:.0e} of the lightest bin to rounding, wanted up to "
            f"{LARGEST_LOSS:.0e}; take the dual, or lower the penalty"
        )


def solve_normal_equations(normal: Tensor, moment: Tensor, penalty: float) -> Tensor:
    """``(normal + I / penalty)^-1 moment``; what ``solve_primal`` does once the sums are known.

    Shape:
        - normal: ``[P, P]``, ``X' W X``, only its lower triangle is read; moment: ``[P]``,
          ``X' W t``; output: ``[P]``

    Raises:
        ValueError: as ``solve_primal``.
    """
    _check_penalty(penalty)
    return _solve(normal, moment, penalty, torch.ones_like(moment), "X'WX")


def solve_normal_equations_(
    normal: Tensor,
    moment: Tensor,
    penalty: float,
    *,
    restore: Callable[[Tensor], object] | None = None,
    most_condition: float | None = None,
) -> Solution:
    """``solve_normal_equations`` within the matrix it is given, as ``solve_kernel_elm_`` does.

    Args:
        normal: as in ``solve_normal_equations``.
        moment: likewise.
        penalty: likewise.
        restore: as in ``solve_symmetric_``.
        most_condition: likewise.

    Shape:
        - normal: ``[P, P]``, row-major, only its lower triangle is read; moment, output: ``[P]``

    Raises:
        ValueError: as ``solve_primal``.
    """
    _check_penalty(penalty)
    return solve_symmetric_(
        normal,
        moment,
        penalty,
        name="X'WX",
        restore=restore,
        in_span=True,
        most_condition=most_condition,
    )


def _solve(system: Tensor, right: Tensor, penalty: float, weights: Tensor, name: str) -> Tensor:
    """``(system + diag(1 / (penalty weights)))^-1 right``, differentiable; batched, in float64."""
    given, eps = right.dtype, torch.finfo(system.dtype).eps
    system, right, weights = system.double(), right.double(), weights.double()
    check_finite(system, right, name)
    if math.isinf(penalty):
        return _pseudo_solve(system, right, penalty, weights, eps, name).to(given)
    ridged = system + torch.diag_embed(1 / (penalty * weights))
    factor, info = torch.linalg.cholesky_ex(ridged)
    conditions = conditions_of(ridged.detach(), factor.detach(), info)
    most = largest_condition(right.shape[-1], eps)
    singular = torch.tensor([not condition <= most for condition in conditions])
    singular = singular.view(info.shape).to(info.device)
    if eps > _EPS and bool(singular.any()):
        raise ValueError(
            f"{name} + I/C at penalty={penalty:g} has condition {max(conditions):.1e}, too much "
            "for a matrix in float32; make it in float64, or lower the penalty"
        )
    if bool(singular.any()):
        safe = torch.where(singular[..., None, None], torch.eye(right.shape[-1]).to(right), ridged)
        solved = torch.cholesky_solve(right[..., None], torch.linalg.cholesky(safe)).squeeze(-1)
        escalated = _pseudo_solve(system, right, penalty, weights, eps, name)
        return torch.where(singular[..., None], escalated, solved)
    return torch.cholesky_solve(right[..., None], factor).squeeze(-1).to(given)


def _pseudo_solve(
    system: Tensor, right: Tensor, penalty: float, weights: Tensor, eps: float, name: str
) -> Tensor:
    """Likewise, without the components of ``sqrt(w) system sqrt(w)`` that are rounding noise.

    ``(M + I/C)^-1`` on the span of ``M`` is ``(I + M^+/C)^-1 M^+``: of these one is well-posed and
    the other has derivatives.
    """
    roots = weights.sqrt()
    weighted = roots[..., :, None] * system * roots[..., None, :]
    noise = right.shape[-1] * eps
    check_spectrum(torch.linalg.eigvalsh(weighted.detach()), noise, eps, name)
    inverse: Tensor = torch.linalg.pinv(weighted, rtol=noise, hermitian=True)
    solved = inverse @ (roots * right)[..., None]
    if not math.isinf(penalty):
        ridged = inverse / penalty + torch.eye(right.shape[-1]).to(inverse)
        solved = torch.cholesky_solve(solved, torch.linalg.cholesky(ridged))
    return roots * solved.squeeze(-1)


def _check_system(gram: Tensor, targets: Tensor, weights: Tensor | None, penalty: float) -> None:
    num_bins = gram.shape[-1]
    if gram.shape[-2] != num_bins or targets.shape[-1] != num_bins:
        raise ValueError(
            f"expected gram [*, N, N] and targets [*, N] with one N, got {tuple(gram.shape)} "
            f"and {tuple(targets.shape)}"
        )
    _check_weights(weights, targets)
    _check_penalty(penalty)


def _check_weights(weights: Tensor | None, targets: Tensor) -> None:
    if weights is None:
        return
    if weights.shape != targets.shape:
        raise ValueError(
            f"weights must have one entry per bin, {tuple(targets.shape)}, "
            f"got {tuple(weights.shape)}"
        )
    if not bool((weights > 0).all()):
        raise ValueError(f"weights must be positive, got {float(weights.min()):g}")


def _check_penalty(penalty: float) -> None:
    if not penalty > 0:
        raise ValueError(f"penalty (the paper's C) must be positive, got {penalty}")
