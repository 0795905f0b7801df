"""The kernel extreme learning machine, solved in closed form (paper section IV-E).

On targets of +-1 this is kernel ridge regression with ``alpha = 1 / C``; with class weights it is
the weighted ELM of Zong, Huang and Chen (2013). Two routes to the same machine: dual, one
unknown per training bin, and primal, one unknown per monomial of the features. Functions whose
name ends in ``_`` solve within the matrix they are given; the others are differentiable.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_, cholesky_solve


def solve_kernel_elm(
    gram: Tensor, targets: Tensor, penalty: float, weights: Tensor | None = None
) -> Tensor:
    """Output weights of the kernel machine: ``(gram + diag(1 / (penalty * weights)))^-1 targets``.

    One Cholesky factorisation, no inverse. Differentiable in ``gram`` and ``targets``. With
    ``penalty=inf`` the minimum-norm (weighted) least-squares solution through the Moore-Penrose
    pseudo-inverse, the paper's wording.

    Args:
        gram: kernel matrix of the training bins, symmetric, positive semi-definite; only its
            lower triangle is read.
        targets: +1 for slip and -1 for non-slip.
        penalty: the paper's ``C``, positive; larger fits the training bins more closely.
        weights: positive weight of each bin; default 1.

    Shape:
        - gram: ``[*, N, N]``; targets, weights, output: ``[*, N]``

    Raises:
        ValueError: if shapes disagree, ``penalty`` is not positive, or the system is not positive
            definite in its dtype.

    Reference:
        Huang, Zhou, Ding and Zhang (2012), IEEE Trans. SMC-B 42(2), 513-529. Equals ``dual_coef_``
        of ``sklearn.kernel_ridge.KernelRidge(alpha=1 / penalty)``.

    Example:
        >>> solve_kernel_elm(torch.eye(2), torch.tensor([1.0, -1.0]), penalty=1.0)
        tensor([ 0.5000, -0.5000])
    """
    _check_system(gram, targets, weights, penalty)
    if math.isinf(penalty):
        root = torch.ones_like(targets) if weights is None else weights.sqrt()
        weighted = root[..., :, None] * gram * root[..., None, :]
        return root * _pseudo_solve(weighted, root * targets)
    ridge = torch.diag_embed(_ridge(targets, penalty, weights))
    return _cholesky_solve(gram + ridge, targets, "gram + I/C", penalty)


def solve_kernel_elm_(
    gram: Tensor, targets: Tensor, penalty: float, weights: Tensor | None = None
) -> Tensor:
    """``solve_kernel_elm`` within the matrix it is given: no second one of its size.

    The factor overwrites ``gram``; the bits do not depend on the number of threads. Not
    differentiable. The pseudo-inverse of ``penalty=inf`` takes further matrices all the same.

    Shape:
        - gram: ``[N, N]``, row-major; targets, weights, output: ``[N]``

    Raises:
        ValueError: as ``solve_kernel_elm``.
    """
    if math.isinf(penalty):
        return solve_kernel_elm(gram, targets, penalty, weights)
    _check_system(gram, targets, weights, penalty)
    gram.diagonal().add_(_ridge(targets, penalty, weights))
    return _cholesky_solve_(gram, targets, "gram + I/C", penalty)


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
    weighted = features if weights is None else features * weights[:, None]
    return solve_normal_equations(features.mT @ weighted, weighted.mT @ targets, penalty)


def solve_normal_equations(normal: Tensor, moment: Tensor, penalty: float) -> Tensor:
    """``(normal + I / penalty)^-1 moment``; what ``solve_primal`` does once the sums are known.

    Shape:
        - normal: ``[P, P]``, ``X' W X``, only its lower triangle is read; moment: ``[P]``,
          ``X' W t``; output: ``[P]``

    Raises:
        ValueError: as ``solve_primal``.
    """
    _check_penalty(penalty)
    if math.isinf(penalty):
        return _pseudo_solve(normal, moment)
    ridged = normal.clone()
    ridged.diagonal().add_(1 / penalty)
    return _cholesky_solve(ridged, moment, "X'WX + I/C", penalty)


def solve_normal_equations_(normal: Tensor, moment: Tensor, penalty: float) -> Tensor:
    """``solve_normal_equations`` within the matrix it is given, as ``solve_kernel_elm_`` does.

    Shape:
        - normal: ``[P, P]``, row-major, only its lower triangle is read; moment, output: ``[P]``

    Raises:
        ValueError: as ``solve_primal``.
    """
    if math.isinf(penalty):
        return solve_normal_equations(normal, moment, penalty)
    _check_penalty(penalty)
    normal.diagonal().add_(1 / penalty)
    return _cholesky_solve_(normal, moment, "X'WX + I/C", penalty)


def _ridge(targets: Tensor, penalty: float, weights: Tensor | None) -> Tensor:
    """``1 / (penalty * weights)`` of every bin."""
    return torch.full_like(targets, 1 / penalty) if weights is None else 1 / (penalty * weights)


def _pseudo_solve(system: Tensor, targets: Tensor) -> Tensor:
    inverse: Tensor = torch.linalg.pinv(system, hermitian=True)
    return (inverse @ targets[..., None]).squeeze(-1)


def _cholesky_solve(system: Tensor, targets: Tensor, name: str, penalty: float) -> Tensor:
    factor, info = torch.linalg.cholesky_ex(system)
    if bool(info.any()):
        raise ValueError(
            f"{name} is not positive definite at penalty={penalty:g} in {system.dtype}; "
            "lower the penalty, scale the features, or solve in float64"
        )
    return torch.cholesky_solve(targets[..., None], factor).squeeze(-1)


def _cholesky_solve_(system: Tensor, targets: Tensor, name: str, penalty: float) -> Tensor:
    try:
        cholesky_(system)
    except ValueError as error:
        raise ValueError(f"{name} at penalty={penalty:g}: {error}") from error
    return cholesky_solve(system, targets)


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
