"""What a detector says of bins, and of those whose channels are missing: how sure it can be.

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

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple, TypeVar, get_args

import torch
from torch import Tensor, nn

from tactslip_torch.features.ops import (
    are_unchanged,
    full_precision,
    has_values,
    is_concrete,
    saturating,
    stamps_of,
)
from tactslip_torch.model.kernels import Head, QuadraticForm
from tactslip_torch.runtime import in_parts
from tactslip_torch.signals.filtering import refuse_nonfinite

ChannelMask = Sequence[str] | Tensor
"""Channels that are not to be listened to: their names, or a mask ``[C]``, bool."""

Nonfinite = Literal["mask", "raise"]
"""What to do about NaN and Inf: their channels count as missing, or they are refused."""

RESOLUTION = 1e-5
"""Variance that every scaled feature has at least (a sixth of a percent of its range), so that
constant and repeated features leave a covariance that can be inverted."""

_Stamps = list[tuple[Tensor, int | Tensor]]
_PART_BINS = 256  # that stay in a cache
_MOST_KEPT = 32  # masks whose matrices are kept, 230 KB each of 120 features


class Prediction(NamedTuple):
    """Scores, and whether they can be relied on.

    Attributes:
        score: ``[*]``, at least 0 means slip; finite, unless the head overflows its dtype.
        is_valid: ``[*]``, bool: every channel that the score depends on can be trusted, and the
            score is finite.
        is_missing: ``[*, C]``, bool: the channel holds a NaN or Inf, or was said to be dead, and
            was left out.
        variance: ``[*]``, of the score, which is an expected one where a channel in use is missing;
            0 where none is.
    """

    score: Tensor
    is_valid: Tensor
    is_missing: Tensor
    variance: Tensor

    def __repr__(self) -> str:
        num, slip = self.score.numel(), int((self.score >= 0).sum())
        lost = int(self.is_missing.any(-1).sum())
        return (
            f"Prediction({num} bins: {slip} slip, {num - slip} non-slip; "
            f"{int(self.is_valid.sum())} valid, {lost} with missing channels)"
        )


Said = TypeVar("Said", Tensor, Prediction)


def check_nonfinite(policy: str, samples: Tensor, names: Sequence[str]) -> None:
    """Hold samples ``[*, C, n]`` of the named channels against a policy.

    Raises:
        ValueError: for an unknown policy, or under ``"raise"`` for a NaN or Inf.
    """
    if policy not in get_args(Nonfinite):
        raise ValueError(f"nonfinite must be 'mask' or 'raise', got {policy!r}")
    if policy == "raise":
        refuse_nonfinite(samples, names, "repair the samples, or take nonfinite='mask'")


def predict_in_parts(predict: Callable[[Tensor], Said], x: Tensor) -> Said:
    """What ``predict`` says of bins ``[*, C, n]``: of many in parts that stay in a cache."""

    def joined(parts: Sequence[Tensor]) -> Tensor:
        whole: Tensor = torch.cat(list(parts)).unflatten(0, x.shape[:-2])
        return whole

    with full_precision(x):
        if x.ndim < 3 or x.shape[:-2].numel() <= _PART_BINS or not is_concrete(x):
            return predict(x)
        found = in_parts(predict, x.flatten(0, -3).split(_PART_BINS))
    if isinstance(found[0], Prediction):
        return Prediction(*map(joined, zip(*found, strict=True)))
    return joined(found)


# Missing channels ------------------------------------------------------------------------------


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
        self._kept: tuple[_Stamps, dict[bytes, _Swept]] = ([], {})

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

    def precision(self) -> tuple[Tensor, Tensor]:
        """Inverse covariances ``[2, K, K]``, and the logs of their determinants ``[2]``."""
        factor = torch.linalg.cholesky(self.covariance)
        return _inverse(factor), -_log_det(factor)

    def _swept_on(self, is_missing: Tensor) -> _Swept:
        """The matrices of one mask ``[K]``, kept for the next bins that miss the same.

        Threads may share what is kept; it is made anew once the covariance has changed.
        """
        stamps, kept = self._kept
        if not are_unchanged([self.covariance], stamps):
            stamps, kept = self._kept = (stamps_of([self.covariance]), {})
        key = is_missing.cpu().numpy().tobytes()
        if (swept := kept.get(key)) is None:
            if len(kept) >= _MOST_KEPT:
                kept.clear()
            with torch.inference_mode(False), torch.no_grad():  # what is kept outlives the mode
                swept = kept[key] = _sweep(self, is_missing.clone())
        return swept


def _gaussian(z: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    share = weights / weights.sum()
    mean = share @ z
    away = z - mean
    covariance = away.mT @ (away * share[:, None])
    spread = covariance.diagonal()
    kept = 1 - _shrinkage(covariance, 1 / float(share.square().sum()))
    covariance = kept * covariance + ((1 - kept) * spread + RESOLUTION).diag()
    return mean, (covariance + covariance.mT) / 2


def _shrinkage(covariance: Tensor, num_bins: float) -> float:
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


def missing_scores(
    head: Head,
    gaussians: ClassGaussians | None,
    imputation: Tensor,
    score: Tensor,
    scaled: Tensor,
    is_lost: Tensor,
) -> tuple[Tensor, Tensor]:
    """Scores and their variances; those of bins that miss nothing are as they came, and 0.

    Of a quadratic form with Gaussians of its features, the expected score and its variance
    (``expected_score``). Of any other, the score of imputation values in the place of the features
    that are missing, and no variance.

    Args:
        head: the machine.
        gaussians: of the scaled features, if they are known.
        imputation: scaled features, ``[K]``.
        score: of all features.
        scaled: features; anything finite where missing.
        is_lost: which features are missing.

    Shape:
        - scaled, is_lost: ``[*, K]``; score and output: ``[*]``, dtype of ``score``
    """

    def scores(z: Tensor, is_lost: Tensor) -> tuple[Tensor, ...]:
        if gaussians is not None and isinstance(head, QuadraticForm):
            found: tuple[Tensor, ...] = expected_score(head, gaussians, z, is_lost)
        else:
            filled = head(torch.where(is_lost, imputation, z))
            found = filled, torch.zeros_like(filled)
        return tuple(saturating(each, score.dtype) for each in found)

    rows = is_lost.any(-1)
    if has_values(rows):
        if not bool(rows.any()):
            return score, torch.zeros_like(score)
        mean, variance = scores(scaled[rows], is_lost[rows])
        none = torch.zeros_like(score)
        return score.masked_scatter(rows, mean), none.masked_scatter(rows, variance)
    mean, variance = scores(scaled, is_lost)
    return torch.where(rows, mean, score), torch.where(rows, variance, 0.0)


def expected_score(
    head: QuadraticForm, gaussians: ClassGaussians, z: Tensor, is_missing: Tensor
) -> tuple[Tensor, Tensor]:
    """Means and variances of scores of bins whose features are missing in part, float64.

    Differentiable in ``z`` where it is observed; gradients do not reach the head. Bins that miss
    the same are taken together. Where masks cannot be looked at (vmap, func.grad, a trace) each
    bin has matrices ``[2, K, K]`` of its own, so that large sets are best mapped in chunks.

    Args:
        head: the machine.
        gaussians: of its features.
        z: features, anything where missing.
        is_missing: which they are.

    Shape:
        - z, is_missing: ``[N, K]``; ``[*, K]`` where masks cannot be looked at
        - output: ``[N]`` each
    """
    z = z.double()
    if not has_values(is_missing):
        swept = _sweep(gaussians, is_missing)
        found = _expected(head, gaussians, z[..., None, :], is_missing, swept)
        return found[0].squeeze(-1), found[1].squeeze(-1)
    masks, place = torch.unique(is_missing, dim=0, return_inverse=True)
    order = place.argsort(stable=True)
    sizes = place.bincount(minlength=len(masks)).tolist()
    parts = [
        _expected(head, gaussians, part, mask, gaussians._swept_on(mask))
        for part, mask in zip(z[order].split(sizes), masks, strict=True)
    ]
    back = order.argsort()
    mean, variance = (torch.cat(each)[back] for each in zip(*parts, strict=True))
    return mean, variance


class _Swept(NamedTuple):
    """What a mask, or each of many ``[*]``, makes of both classes.

    Attributes:
        matrix: ``[*, 2, K, K]``: ``-S`` among missing features, ``-B`` from observed to missing
            ones, ``Sigma_oo^-1`` among observed ones.
        log_det: ``[*, 2]``, of ``Sigma_oo``.
    """

    matrix: Tensor
    log_det: Tensor


def _sweep(gaussians: ClassGaussians, is_missing: Tensor) -> _Swept:
    """The matrices of masks ``[*, K]``, by operations whose shapes no mask changes."""
    whole, log_det = gaussians.precision()
    rows, columns = is_missing[..., None, :, None], is_missing[..., None, None, :]
    one = torch.eye(whole.shape[-1], dtype=whole.dtype, device=whole.device)
    factor = torch.linalg.cholesky(torch.where(rows & columns, whole, one))
    covariance = torch.where(rows & columns, _inverse(factor), 0.0)  # S
    onto = covariance @ whole  # -B where columns are observed
    seen = torch.where(columns, onto.mT, whole - whole @ onto)
    matrix = torch.where(rows, torch.where(columns, -covariance, onto), seen)
    return _Swept(matrix, _log_det(factor) - log_det)


def _expected(
    head: QuadraticForm, gaussians: ClassGaussians, z: Tensor, is_missing: Tensor, swept: _Swept
) -> tuple[Tensor, Tensor]:
    """Of bins ``[*, n, K]``, those of a row missing the same features ``[*, K]``."""
    is_both = is_missing[..., None, :, None] & is_missing[..., None, None, :]
    added = added_by_missing(head, is_both.double(), swept.matrix)
    z, is_missing = z[..., None, :, :], is_missing[..., None, None, :]
    return score_of_mixture(head, gaussians, z, is_missing, swept, added)


def added_by_missing(head: QuadraticForm, is_both: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """What the missing features of a mask add to the mean and the variance of a score.

    ``tr(Q_mm S)`` and ``2 tr((Q_mm S)^2)`` of both classes, in operations that values of an ONNX
    graph have too, like ``score_of_mixture``.

    Args:
        head: the machine.
        is_both: 1 where both features of a pair are missing, else 0.
        matrix: of the mask.

    Shape:
        - is_both: ``[*, 1, K, K]``, float64; matrix: ``[*, 2, K, K]``; output: ``[*, 2]`` each
    """
    bend = is_both * head.dense_quadratic.detach().double()
    squares = (bend @ matrix) * (matrix @ bend)
    return -(bend * matrix).sum(-1).sum(-1), squares.sum(-1).sum(-1) * 2.0


def score_of_mixture(
    head: QuadraticForm,
    gaussians: ClassGaussians,
    z: Tensor,
    is_missing: Tensor,
    swept: tuple[Tensor, Tensor],
    added: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Mean and variance of the scores of bins that miss the same features, ``[*, n]`` each.

    Args:
        head: the machine.
        gaussians: of its features.
        z: features, anything finite where missing.
        is_missing: which they are.
        swept: matrix and log determinant of the mask (``_Swept``).
        added: by ``added_by_missing``.

    Shape:
        - z: ``[*, 1, n, K]`` or ``[n, K]``; is_missing: ``[*, 1, 1, K]`` or ``[K]``
    """
    (matrix, log_det), (lift, spread) = swept, added
    quadratic, linear, constant = (
        part.detach().double() for part in (head.dense_quadratic, head.linear, head.constant)
    )
    middle = gaussians.mean[:, None]
    away = torch.where(is_missing, 0.0, z - middle)  # [*, 2, n, K]
    turned = away @ matrix
    filled = torch.where(is_missing, -(turned - middle), z)
    evidence = ((turned * away).sum(-1) + log_det[..., None]) * -0.5
    bend = filled @ quadratic
    slope = torch.where(is_missing, bend * 2.0 + linear, 0.0)
    mean = ((bend + linear) * filled).sum(-1) + constant + lift[..., None]
    variance = spread[..., None] - ((slope @ matrix) * slope).sum(-1)
    weight = evidence.softmax(-2)
    total = (weight * mean).sum(-2)
    apart = mean - total.unsqueeze(-2)
    return total, (weight * (variance + apart * apart)).sum(-2)


def _log_det(factor: Tensor) -> Tensor:
    return 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _inverse(factor: Tensor) -> Tensor:
    """``(L L')^-1``; ``cholesky_inverse`` takes thirty times as long."""
    one = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    return torch.cholesky_solve(one.expand(factor.shape), factor)
