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

from tactslip_torch.model.cholesky import check_finite, in_dtype
from tactslip_torch.model.condition import conditions_of
from tactslip_torch.model.differentiable_solve import DENSE, solve_by_factor
from tactslip_torch.model.symmetric_solve import (
    Solution,
    largest_condition,
    ridge_of,
    solve_symmetric_,
)
from tactslip_torch.model.truncation import (
    LARGEST_LOSS,
    check_light,
    light_bins,
    lost_in_sums,
    truncated,
)

_EPS = torch.finfo(torch.float64).eps


def solve_kernel_elm(
    gram: Tensor, targets: Tensor, penalty: float, weights: Tensor | None = None
) -> Tensor:
    """Output weights of the kernel machine: ``(gram + diag(1 / (penalty * weights)))^-1 targets``.

    One Cholesky factorisation, no inverse. Differentiable in ``gram``, ``targets`` and ``weights``
    any number of times, by solves with the same factor (``differentiable_solve``). Where the
    system is too close to singular for that (``symmetric_solve`` has the rule), components of the
    weighted Gram matrix that are rounding noise are left out: null ones add nothing to a score, and
    derivatives are those at constant rank. With ``penalty=inf`` that is the minimum-norm (weighted)
    least-squares solution through the Moore-Penrose pseudo-inverse, the paper's wording.

    Solved in float64, and handed out in the dtype of ``gram``, whatever that of the targets. A
    float32 ``gram`` carries its rounding times the condition into the solution: it is refused
    where that exceeds 1e-2.

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
    return _solve(gram, targets, penalty, weights, in_span=False, name="gram")


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
    if weights is not None and len(x):
        square = float(x.detach().square().sum(-1).max())
        if lost_in_sums(weights.detach(), penalty, square) > LARGEST_LOSS:
            raise ValueError(
                f"weights are too far apart for X'WX, by {float(weights.max() / weights.min()):.0e}"
                "; take the dual, or lower the penalty"
            )
    weighted = x if weights is None else x * weights[:, None]
    moment = weighted.mT @ targets.double()
    return solve_normal_equations(x.mT @ weighted, moment, penalty).to(features.dtype)


def solve_normal_equations(normal: Tensor, moment: Tensor, penalty: float) -> Tensor:
    """``(normal + I / penalty)^-1 moment``; what ``solve_primal`` does once the sums are known.

    Shape:
        - normal: ``[P, P]``, ``X' W X``, only its lower triangle is read; moment: ``[P]``,
          ``X' W t``; output: ``[P]``

    Raises:
        ValueError: as ``solve_primal``.
    """
    _check_penalty(penalty)
    return _solve(normal, moment, penalty, torch.ones_like(moment), in_span=True, name="X'WX")


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


def _solve(
    system: Tensor, right: Tensor, penalty: float, weights: Tensor, *, in_span: bool, name: str
) -> Tensor:
    """``(system + diag(1 / (penalty weights)))^-1 right``, differentiable; batched, in float64."""
    given, eps = system.dtype, torch.finfo(system.dtype).eps
    system, right, weights = system.double(), right.double(), weights.double()
    check_finite(system, right, name)
    ridged = system + torch.diag_embed(ridge_of(penalty, weights))
    system, right = system.expand(ridged.shape), right.expand(ridged.shape[:-1])
    plain = torch.ones(right.shape[:-1], dtype=torch.bool, device=right.device)
    if math.isinf(penalty):  # no Cholesky first, but for bins that a cut would lose
        plain = light_bins(system.detach().diagonal(dim1=-2, dim2=-1), weights, eps).any(-1)
    singular = ~plain
    if bool(plain.any()):
        factor, info = torch.linalg.cholesky_ex(ridged.detach())
        conditions = torch.tensor(conditions_of(ridged.detach(), factor, info))
        singular |= ~(conditions <= largest_condition(right.shape[-1], eps)).view(info.shape)
    if not bool(singular.any()):
        return in_dtype(solve_by_factor(DENSE, factor, right, ridged), given, name)
    if eps > _EPS and bool((plain & singular).any()):
        raise ValueError(
            f"{name} + I/C at penalty={penalty:g} has condition {float(conditions.max()):.1e}, too "
            f"much for a matrix in {str(given)[6:]}; make it in float64, or lower the penalty"
        )
    terms = right[singular], penalty, weights.expand(right.shape)[singular].sqrt()
    escalated = _pseudo_solve(system[singular], *terms, given, in_span=in_span, name=name)
    solved = torch.zeros_like(right)
    if not bool(singular.all()):
        others = factor[~singular], right[~singular], ridged[~singular]
        solved[~singular] = solve_by_factor(DENSE, *others)
    solved[singular] = escalated
    return in_dtype(solved, given, name)


def _pseudo_solve(
    system: Tensor,
    right: Tensor,
    penalty: float,
    roots: Tensor,
    given: torch.dtype,
    *,
    in_span: bool,
    name: str,
) -> Tensor:
    """Likewise, without the components of ``sqrt(w) system sqrt(w)`` that are rounding noise.

    ``(M + I/C)^-1`` on the span of ``M`` is ``(I + M^+/C)^-1 M^+``: of these one is well-posed and
    the other has derivatives.

    Shape:
        - system: ``[B, N, N]``; right, roots, output: ``[B, N]``
    """
    weighted = roots[..., :, None] * system * roots[..., None, :]
    for matrix, own, root in zip(weighted.detach(), right.detach(), roots.detach(), strict=True):
        check_light(matrix.diagonal() / root**2, root**2, penalty, given, name)
        truncated(matrix, own, root, penalty, given, in_span=in_span, name=name)
    noise = right.shape[-1] * torch.finfo(given).eps
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
    if num_bins == 0 or not gram.is_floating_point():
        raise ValueError(f"gram must have bins and be floating, got {num_bins} of {gram.dtype}")
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
    check_weights(weights)


def check_weights(weights: Tensor) -> None:
    """That they are positive and finite."""
    wrong = weights[~((weights > 0) & weights.isfinite())]
    if len(wrong):
        raise ValueError(f"weights must be positive and finite, got {float(wrong[0]):g}")


def _check_penalty(penalty: float) -> None:
    if not penalty > 0:
        raise ValueError(f"penalty (the paper's C) must be positive, got {penalty}")
