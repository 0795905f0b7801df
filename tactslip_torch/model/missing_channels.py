"""What a detector says where channels are missing, and how sure it can be of that.

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

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tactslip_torch.features.ops import saturating
from tactslip_torch.model.calibration import Calibration
from tactslip_torch.model.kernels import Head, QuadraticForm
from tactslip_torch.runtime import has_values

ChannelMask = Sequence[str] | Tensor
"""Channels that are not to be listened to: their names, or a mask ``[C]``, bool."""

RESOLUTION = 1e-5
"""Variance that every scaled feature has at least (a sixth of a percent of its range), so that
constant and repeated features leave a covariance that can be inverted."""

MOST_KEPT = 32
"""Masks whose matrices are kept, 460 KB each of 120 features."""

MOST_OFF = 0.02
"""By which a probability may be off that of the integral, at any mean and variance.

Of equal shares of slip and non-slip, as the classes were weighed for the variance; other shares
come in afterwards by Bayes (``probability``), and no bound is stated for them.
"""


def channel_mask(masked: ChannelMask, names: Sequence[str]) -> Tensor:
    """The mask ``[C]`` of masked channels.

    Raises:
        ValueError: for a channel that is none of these names, or a mask of another shape or dtype.
    """
    if isinstance(masked, Tensor):
        if masked.shape != (len(names),) or masked.dtype != torch.bool:
            raise ValueError(
                f"masked_channels must be names of channels or a bool mask [{len(names)}], "
                f"got {masked.dtype} {tuple(masked.shape)}"
            )
        return masked
    listed = [masked] if isinstance(masked, str) else masked
    if not isinstance(listed, Iterable):
        raise ValueError(f"masked_channels must be a list of names of channels, got {masked!r}")
    if unknown := [name for name in listed if name not in names]:
        raise ValueError(
            f"masked_channels names the channel {unknown[0]!r}, which this hand does not have; "
            f"take some of {', '.join(names)}"
        )
    return torch.tensor([name in listed for name in names], dtype=torch.bool)


def masked_names(masked: ChannelMask, names: Sequence[str]) -> tuple[str, ...]:
    """Names of masked channels, in the order of the hand.

    Raises:
        ValueError: as ``channel_mask``.
    """
    mask = channel_mask(masked, names).tolist()
    return tuple(name for name, is_masked in zip(names, mask, strict=True) if is_masked)


def without(samples: Tensor, masked: ChannelMask | None, names: Sequence[str]) -> Tensor:
    """Samples ``[*, C, n]`` with NaN in masked channels, which is how a missing one looks.

    Raises:
        ValueError: as ``channel_mask``.
    """
    if masked is None:
        return samples
    mask = channel_mask(masked, names).to(samples.device)
    return samples.masked_fill(mask[:, None], torch.nan) if bool(mask.any()) else samples


class MissingScores:
    """Scores of bins some of whose channels are missing.

    Of a quadratic form with Gaussians of its features, the expected score and its variance
    (``ExpectedScore``). Of any other, the score of imputation values in the place of those missing,
    and no variance.

    Args:
        head: the machine.
        imputation: scaled features, ``[K]``.
        channel_index: of each column, ``[K]``; one past the last channel for a pooled one.
        gaussians: of the features, if they are known.
    """

    def __init__(
        self,
        head: Head,
        imputation: Tensor,
        channel_index: Tensor,
        gaussians: ClassGaussians | None,
    ) -> None:
        self._head, self._imputation, self._channel_index = head, imputation, channel_index
        self._expected: ExpectedScore | None = None
        if gaussians is not None and isinstance(head, QuadraticForm):
            self._expected = ExpectedScore(head, gaussians)
        of = _tensors(head, imputation, channel_index, gaussians)
        self._stamps = [(each, _state(each)) for each in of]

    def is_of(
        self,
        head: Head,
        imputation: Tensor,
        channel_index: Tensor,
        gaussians: ClassGaussians | None,
    ) -> bool:
        """Whether it was made of these, none of them replaced or changed since."""
        now = _tensors(head, imputation, channel_index, gaussians)
        return len(now) == len(self._stamps) and all(map(_is_as_stamped, now, self._stamps))

    def __call__(self, score: Tensor, scaled: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Scores and their variances; those of bins that miss no feature are as they came, and 0.

        Shape:
            - score: ``[*]``, of all features
            - scaled: ``[*, K]``, features; anything finite where missing
            - is_missing: ``[*, C]``, bool, of channels
            - output: ``[*]`` each
        """
        pooled = torch.zeros_like(is_missing[..., :1])  # never lost: it is of the other channels
        is_lost = torch.cat([is_missing, pooled], -1).index_select(-1, self._channel_index)
        rows = is_lost.any(-1)
        if has_values(rows):
            mean, spread = self._of(scaled[rows], is_lost[rows])
            return _put(score, rows, mean), _put(torch.zeros_like(score), rows, spread)
        mean, spread = (saturating(each, score.dtype) for each in self._of(scaled, is_lost))
        return torch.where(rows, mean, score), torch.where(rows, spread, 0.0)

    def _of(self, scaled: Tensor, is_lost: Tensor) -> tuple[Tensor, Tensor]:
        """Of features ``[*, K]``, and which of them are missing."""
        if self._expected is None:
            score = self._head(torch.where(is_lost, self._imputation, scaled))
            return score, torch.zeros_like(score)
        return self._expected(scaled, is_lost)


def _put(values: Tensor, where: Tensor, others: Tensor) -> Tensor:
    """The same with others where a mask holds, of any number of axes, 0 too."""
    return values.masked_scatter(where, saturating(others, values.dtype))


def _tensors(
    head: Head, imputation: Tensor, channel_index: Tensor, gaussians: ClassGaussians | None
) -> list[Tensor]:
    of_features = [] if gaussians is None else gaussians.buffers()
    return [*head.buffers(), imputation, channel_index, *of_features]


def _state(x: Tensor) -> int | Tensor:
    """How often a tensor was changed in place; of inference tensors, which do not count, a copy."""
    return x.clone() if x.is_inference() else x._version


def _is_as_stamped(x: Tensor, stamp: tuple[Tensor, int | Tensor]) -> bool:
    same, state = stamp
    if x is not same:
        return False
    return torch.equal(x, state) if isinstance(state, Tensor) else x._version == state


class ClassGaussians(nn.Module):
    """Mean and covariance of scaled features of either class, both classes counting alike.

    Args:
        mean: ``[2, K]``, float64; of non-slip, then of slip.
        covariance: ``[2, K, K]``, float64.

    Raises:
        ValueError: for another shape or dtype, or a covariance that is not positive definite.
    """

    mean: Tensor
    covariance: Tensor

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        num = mean.shape[-1]
        if mean.shape != (2, num) or covariance.shape != (2, num, num):
            raise ValueError(
                "expected mean [2, K] and covariance [2, K, K], got "
                f"{tuple(mean.shape)} and {tuple(covariance.shape)}"
            )
        if not mean.dtype == covariance.dtype == torch.float64:
            raise ValueError(f"expected float64, got {mean.dtype} and {covariance.dtype}")
        failed = torch.linalg.cholesky_ex(covariance).info
        if bool(failed.any()) or not bool(mean.isfinite().all()):
            raise ValueError("covariances must be positive definite and means finite; fit again")
        self.register_buffer("mean", mean.clone())
        self.register_buffer("covariance", covariance.clone())

    @property
    def num_features(self) -> int:
        """How many features they are of."""
        return self.mean.shape[-1]

    @classmethod
    def fit(cls, z: Tensor, is_slip: Tensor, weights: Tensor | None = None) -> ClassGaussians:
        """Of scaled bins; covariances are shrunk to their diagonals as far as bins are few.

        Shape:
            - z: ``[N, K]``; is_slip: ``[N]``, bool; weights: ``[N]``, positive, default 1 each

        Raises:
            ValueError: if a class is absent.
        """
        weights = torch.ones(len(z), dtype=torch.float64) if weights is None else weights.double()
        found = []
        for name, mine in (("non-slip", ~is_slip), ("slip", is_slip)):
            if not bool(mine.any()):
                raise ValueError(f"Gaussians of both classes need bins of both, got no {name}")
            found.append(_gaussian(z[mine].double(), weights[mine]))
        means, covariances = zip(*found, strict=True)
        return cls(torch.stack(means), torch.stack(covariances))


def _gaussian(z: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    share = weights / weights.sum()
    mean = share @ z
    away = z - mean
    covariance = away.mT @ (away * share[:, None])
    spread = covariance.diagonal()
    kept = 1 - shrinkage(covariance, 1 / float(share.square().sum()))
    covariance = kept * covariance + ((1 - kept) * spread + RESOLUTION).diag()
    return mean, (covariance + covariance.mT) / 2


def shrinkage(covariance: Tensor, num_bins: float) -> float:
    """The part of a covariance ``[K, K]`` of so many bins to be replaced by its diagonal.

    The expected error of all correlations over their size, which minimises the expected squared
    error of the shrunk ones; the error is that of Gaussian bins, ``(1 - r^2)^2 / (n - 1)``.

    Reference:
        Schaefer and Strimmer (2005), Statistical Applications in Genetics and Molecular Biology 4,
        32.
    """
    if num_bins <= 1:
        return 1.0
    scale = covariance.diagonal().clamp(min=RESOLUTION).rsqrt()
    squares = (covariance * scale[:, None] * scale).square()
    squares = squares.triu(1)[torch.ones_like(squares, dtype=torch.bool).triu(1)].clamp(max=1)
    error = float((1 - squares).square().sum()) / (num_bins - 1)
    size = float(squares.sum())
    return min(1.0, error / size) if size > 0 else 1.0


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
        return cls(_inverse(factor), log_det)


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
    covariance = torch.where(rows & columns, _inverse(factor), 0.0)  # S
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


def _inverse(factor: Tensor) -> Tensor:
    """``(L L')^-1``; ``cholesky_inverse`` takes thirty times as long."""
    one = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    return torch.cholesky_solve(one.expand(factor.shape), factor)


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
