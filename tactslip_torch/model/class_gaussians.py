"""Scaled features as two Gaussians, of non-slip and of slip: what one sensor tells of another."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

PREFIX = "gaussians."
RESOLUTION = 1e-5
"""Variance that every scaled feature has at least (a sixth of a percent of its range), so that
constant and repeated features leave a covariance that can be inverted."""


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

    def tensors(self) -> dict[str, Tensor]:
        """By the names under which a table of tensors holds them beside others."""
        return {PREFIX + name: value for name, value in self.state_dict().items()}

    @classmethod
    def among(cls, tensors: Mapping[str, Tensor]) -> ClassGaussians | None:
        """Those in a table of tensors, of which older ones hold none."""
        own = {n.removeprefix(PREFIX): x for n, x in tensors.items() if n.startswith(PREFIX)}
        return cls(**own) if own else None


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
