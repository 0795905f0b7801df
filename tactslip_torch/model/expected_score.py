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

from collections import OrderedDict
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.class_gaussians import ClassGaussians
from tactslip_torch.model.quadratic import QuadraticForm

MOST_KEPT = 32
"""Masks whose matrices are kept, 460 KB each of 120 features."""


class Swept(NamedTuple):
    """What a mask makes of both classes.

    Attributes:
        matrix: ``[2, K, K]``: ``-S`` among missing features, ``-B`` from observed to missing ones,
            ``Sigma_oo^-1`` among observed ones.
        log_det: ``[2]``, of ``Sigma_oo``.
        lift: ``[2]``, ``tr(Q_mm S)``.
        spread: ``[2]``, ``2 tr((Q_mm S)^2)``.
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
        self._quadratic, self._linear, self._constant = (
            part.detach().double() for part in (head.quadratic, head.linear, head.constant)
        )
        self._mean = gaussians.mean
        self._precision = Precision.of(gaussians)
        self._kept: OrderedDict[bytes, Swept] = OrderedDict()

    def __call__(self, z: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances of scores, float64; differentiable in ``z`` where it is observed.

        Bins are taken pattern by pattern, as many as there are of one at once.

        Shape:
            - z: ``[N, K]``, anything where missing
            - is_missing: ``[N, K]``, bool
            - output: ``[N]`` each; the variance is 0 where nothing is missing
        """
        patterns, place = torch.unique(is_missing, dim=0, return_inverse=True)
        order = place.argsort(stable=True)
        sizes = place.bincount(minlength=len(patterns)).tolist()
        parts = [
            self._of_pattern(part, pattern)
            for part, pattern in zip(z.double()[order].split(sizes), patterns, strict=True)
        ]
        back = order.argsort()
        means, variances = (torch.cat(each)[back] for each in zip(*parts, strict=True))
        return means, variances

    def _of_pattern(self, z: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Of bins ``[n, K]`` that miss the same features ``[K]``."""
        if not bool(is_missing.any()):
            return self._score(z), z.new_zeros(len(z))
        swept = self._swept(is_missing)
        away = torch.where(is_missing, 0.0, z - self._mean[:, None])  # [2, n, K]
        turned = away @ swept.matrix
        filled = torch.where(is_missing, self._mean[:, None] - turned, z)
        evidence = -((turned * away).sum(-1) + swept.log_det[:, None]) / 2
        slope = torch.where(is_missing, 2 * filled @ self._quadratic + self._linear, 0.0)
        mean = self._score(filled) + swept.lift[:, None]
        variance = swept.spread[:, None] - ((slope @ swept.matrix) * slope).sum(-1)
        weight = evidence.softmax(0)
        middle = (weight * mean).sum(0)
        return middle, (weight * (variance + (mean - middle).square())).sum(0)

    def _score(self, z: Tensor) -> Tensor:
        return ((z @ self._quadratic + self._linear) * z).sum(-1) + self._constant

    def _swept(self, is_missing: Tensor) -> Swept:
        key = is_missing.cpu().numpy().tobytes()
        if key in self._kept:
            self._kept.move_to_end(key)
        else:
            self._kept[key] = sweep(self._precision, is_missing, self._quadratic)
            if len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        return self._kept[key]


def sweep(precision: Precision, is_missing: Tensor, quadratic: Tensor) -> Swept:
    """The matrices of a mask.

    Args:
        precision: of both classes.
        is_missing: ``[K]``, bool.
        quadratic: ``[K, K]``, that of the head.
    """
    lost, seen = is_missing.nonzero().squeeze(-1), (~is_missing).nonzero().squeeze(-1)
    of_lost = precision.matrix[:, lost][:, :, lost]
    across = precision.matrix[:, lost][:, :, seen]
    factor = torch.linalg.cholesky(of_lost)
    covariance = torch.cholesky_inverse(factor)  # S
    onto = covariance @ across  # -B
    matrix = torch.empty_like(precision.matrix)
    for rows, columns, block in (
        (lost, lost, -covariance),
        (lost, seen, onto),
        (seen, lost, onto.mT),
        (seen, seen, precision.matrix[:, seen][:, :, seen] - across.mT @ onto),
    ):
        matrix[:, rows[:, None], columns] = block
    bent = quadratic[lost][:, lost] @ covariance
    log_det = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) - precision.log_det
    return Swept(
        matrix,
        log_det,
        bent.diagonal(dim1=-2, dim2=-1).sum(-1),
        2 * (bent * bent.mT).sum((-2, -1)),
    )
