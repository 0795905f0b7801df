"""The expected score where features are missing, and its variance: a quadratic of a Gaussian.

Scaled features ``z`` of class y are taken as ``N(mu_y, Sigma_y)``. Of a bin whose features m are
missing and o observed, class y leaves ``z_m ~ N(mu_m + B (z_o - mu_o), S)`` with ``B = Sigma_mo
Sigma_oo^-1`` and ``S = Sigma_mm - B Sigma_om``. The head ``f = z'Q z + l'z + a`` then has the mean
``E_y = f(z^) + tr(Q_mm S)``, ``z^`` being z with the conditional mean filled in, and the variance
``V_y = 2 tr((Q_mm S)^2) + g'S g`` with ``g = (2 Q z^ + l)_m``. The classes are weighed by how
probable they are given ``z_o``, both alike beforehand.

All of a mask is in one matrix: the precision ``Sigma^-1`` *swept* on m holds ``-S``, ``-B`` and
``Sigma_oo^-1``, at the price of an inverse of the size of m.

Reference:
    Mathai and Provost (1992), Quadratic Forms in Random Variables; Little and Rubin (2002),
    Statistical Analysis with Missing Data, section 7.4.3, for the sweep operator.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.class_gaussians import ClassGaussians
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.runtime import has_values

MOST_KEPT = 32
"""Masks whose matrices are kept, 460 KB each of 120 features."""


class Swept(NamedTuple):
    """What a mask, or each of many ``[*]``, makes of both classes.

    Attributes:
        matrix: ``[*, 2, K, K]``: ``-S`` among missing features, ``-B`` from observed to missing
            ones, ``Sigma_oo^-1`` among observed ones.
        log_det: ``[*, 2]``, of ``Sigma_oo``.
        lift: ``[*, 2]``, ``tr(Q_mm S)``.
        spread: ``[*, 2]``, ``2 tr((Q_mm S)^2)``.
    """

    matrix: Tensor
    log_det: Tensor
    lift: Tensor
    spread: Tensor


class Precision(NamedTuple):
    """Inverse covariances ``[2, K, K]`` and the logs of their determinants ``[2]``."""

    matrix: Tensor
    log_det: Tensor

    @classmethod
    def of(cls, gaussians: ClassGaussians) -> Precision:
        """Those of both classes."""
        factor = torch.linalg.cholesky(gaussians.covariance)
        log_det = -2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return cls(torch.cholesky_inverse(factor), log_det)


class ExpectedScore:
    """Scores of bins whose features may be missing.

    Args:
        head: the machine; gradients do not reach it.
        gaussians: of its features.
    """

    def __init__(self, head: QuadraticForm, gaussians: ClassGaussians) -> None:
        with torch.inference_mode(False):  # what is kept outlives the mode
            parts = head.dense_quadratic, head.linear, head.constant, gaussians.mean
            self._quadratic, self._linear, self._constant, self._mean = (
                part.detach().clone().double() for part in parts
            )
            self._precision = precision = Precision.of(gaussians)
        quadratic = self._quadratic

        @lru_cache(MOST_KEPT)  # which threads may share
        def swept(mask: bytes) -> Swept:
            is_missing = torch.frombuffer(bytearray(mask), dtype=torch.bool)
            with torch.inference_mode(False), torch.no_grad():
                return sweep(precision, is_missing.to(quadratic.device), quadratic)

        self._swept = swept

    def __call__(self, z: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances of scores, float64; differentiable in ``z`` where it is observed.

        Bins are taken pattern by pattern, as many as there are of one at once. Where the patterns
        cannot be looked at (vmap, func.grad, a trace) each bin has matrices ``[2, K, K]`` of its
        own, so that large sets are best mapped in chunks.

        Shape:
            - z: ``[N, K]``, anything where missing; ``[*, K]`` where patterns cannot be looked at
            - is_missing: as ``z``, bool
            - output: ``[N]`` each; the variance is 0 where nothing is missing
        """
        z = z.double()
        if not has_values(is_missing):
            swept = sweep(self._precision, is_missing, self._quadratic)
            mean, variance = self._expected(z[..., None, :], is_missing, swept)
            return mean.squeeze(-1), variance.squeeze(-1)
        if not bool(is_missing.any()):  # no bins at all have no patterns
            return self._score(z), torch.zeros_like(z[..., 0])
        patterns, place = torch.unique(is_missing, dim=0, return_inverse=True)
        order = place.argsort(stable=True)
        sizes = place.bincount(minlength=len(patterns)).tolist()
        parts = [
            self._of_pattern(part, pattern)
            for part, pattern in zip(z[order].split(sizes), patterns, strict=True)
        ]
        back = order.argsort()
        means, variances = (torch.cat(each)[back] for each in zip(*parts, strict=True))
        return means, variances

    def _of_pattern(self, z: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Of bins ``[n, K]`` that miss the same features ``[K]``."""
        if not bool(is_missing.any()):
            return self._score(z), z.new_zeros(len(z))
        swept = self._swept(is_missing.cpu().numpy().tobytes())
        return self._expected(z, is_missing, swept)

    def _expected(self, z: Tensor, is_missing: Tensor, swept: Swept) -> tuple[Tensor, Tensor]:
        """Of bins ``[*, n, K]``, those of a row missing the same features ``[*, K]``."""
        z, is_missing = z[..., None, :, :], is_missing[..., None, None, :]
        middle = self._mean[:, None]
        away = torch.where(is_missing, 0.0, z - middle)  # [*, 2, n, K]
        turned = away @ swept.matrix
        filled = torch.where(is_missing, middle - turned, z)
        evidence = -((turned * away).sum(-1) + swept.log_det[..., None]) / 2
        slope = torch.where(is_missing, 2 * filled @ self._quadratic + self._linear, 0.0)
        mean = self._score(filled) + swept.lift[..., None]
        variance = swept.spread[..., None] - ((slope @ swept.matrix) * slope).sum(-1)
        weight = evidence.softmax(-2)
        total = (weight * mean).sum(-2)
        return total, (weight * (variance + (mean - total[..., None, :]).square())).sum(-2)

    def _score(self, z: Tensor) -> Tensor:
        return ((z @ self._quadratic + self._linear) * z).sum(-1) + self._constant


def sweep(precision: Precision, is_missing: Tensor, quadratic: Tensor) -> Swept:
    """The matrices of masks, by operations whose shapes no mask changes.

    Args:
        precision: of both classes.
        is_missing: ``[*, K]``, bool.
        quadratic: ``[K, K]``, that of the head.
    """
    whole = precision.matrix
    rows, columns = is_missing[..., None, :, None], is_missing[..., None, None, :]
    one = torch.eye(whole.shape[-1], dtype=whole.dtype, device=whole.device)
    factor = torch.linalg.cholesky(torch.where(rows & columns, whole, one))
    covariance = torch.where(rows & columns, torch.cholesky_inverse(factor), 0.0)  # S
    onto = covariance @ whole  # -B where columns are observed
    seen = torch.where(columns, onto.mT, whole - whole @ onto)
    matrix = torch.where(rows, torch.where(columns, -covariance, onto), seen)
    bent = quadratic @ covariance
    return Swept(
        matrix,
        2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) - precision.log_det,
        bent.diagonal(dim1=-2, dim2=-1).sum(-1),
        2 * (bent * bent.mT).sum((-2, -1)),
    )
