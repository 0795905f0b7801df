"""Scaling to [-1, 1], fitted on training bins, with a signed log before it on request.

The authors take the plain range of the training bins. Compression and ranges between quantiles are
for features whose tails are heavy on real recordings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tactslip_torch.runtime import ascending, is_concrete, signed_log

_COLUMNS = 128  # sorted at a time, which keeps memory small


class FeatureScaler(nn.Module):
    """Takes a range of every feature to [-1, 1] and clips the rest.

    Clipping is ours: a quadratic kernel grows with the fourth power of what leaves the range.
    A feature whose range is a point becomes 0. With ``columns`` a feature may be scaled several
    times, each with a compression scale and a range of its own.

    Args:
        minimum: ``[S]``, what becomes -1, of the compressed feature where there is compression.
        maximum: ``[S]``, what becomes 1.
        compression: ``[S]``, compression scales of ``signed_log``, which comes first; without it
            features are not compressed.
        columns: ``[S]``, whole numbers, which of the K features each is; without it all of them
            in their order, so that S is K.

    Raises:
        ValueError: if shapes disagree, a range is not finite, a minimum exceeds its maximum, a
            compression is not positive and finite or a column is no index.
    """

    minimum: Tensor
    maximum: Tensor
    compression: Tensor | None
    columns: Tensor | None

    def __init__(
        self,
        minimum: Tensor,
        maximum: Tensor,
        compression: Tensor | None = None,
        columns: Tensor | Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        if columns is not None:
            columns = torch.as_tensor(columns, device=minimum.device)
        parts = minimum, maximum, compression, columns
        shapes = [tuple(x.shape) for x in parts if x is not None]
        if len(set(shapes)) > 1:
            raise ValueError(
                "minimum, maximum, compression and columns must agree in shape, got "
                f"{', '.join(map(str, shapes))}"
            )
        bad = ~(minimum.isfinite() & maximum.isfinite() & (minimum <= maximum))
        bad |= ~(maximum - minimum).isfinite()
        if bool(bad.any()):
            i = int(bad.nonzero()[0])
            raise ValueError(
                f"feature {i}: expected finite minimum <= maximum, got "
                f"{float(minimum[i]):g} and {float(maximum[i]):g}"
            )
        if compression is not None:
            bad = ~(compression.isfinite() & (compression > 0))
            if bool(bad.any()):
                i = int(bad.nonzero()[0])
                raise ValueError(
                    f"feature {i}: compression must be positive and finite, got "
                    f"{float(compression[i]):g}"
                )
        if columns is not None and (columns.dtype != torch.int64 or bool((columns < 0).any())):
            raise ValueError(
                f"columns must be whole numbers from 0 on, got {columns.tolist()!r:.80}"
            )
        self.register_buffer("minimum", minimum.clone())
        self.register_buffer("maximum", maximum.clone())
        self.register_buffer("compression", None if compression is None else compression.clone())
        self.register_buffer("columns", None if columns is None else columns.clone())

    @classmethod
    def fit(cls, features: Tensor, *, compress: bool = False, tail: float = 0.0) -> FeatureScaler:
        """The scaler of training bins.

        Args:
            features: the bins, at least one, finite.
            compress: by the median of ``|f|`` of each feature; its maximum where
                the median is 0, 1 where that is 0 too.
            tail: share of the bins at either end of a feature that may be clipped: the range
                lies between the quantiles ``tail`` and ``1 - tail`` of the compressed values,
                interpolated linearly as ``numpy.quantile`` does, and is that of all bins where
                the two coincide.

        Shape:
            - features: ``[N, K]``

        Raises:
            ValueError: if there is no bin, a value is not finite or ``tail`` is not in [0, 0.5).
        """
        if not 0 <= tail < 0.5:
            raise ValueError(f"tail must lie in [0, 0.5), got {tail}")
        if features.ndim != 2 or not len(features):
            raise ValueError(
                f"expected features [N, K] with at least one bin, got {tuple(features.shape)}"
            )
        if not compress and tail == 0:
            return cls(features.amin(0), features.amax(0))
        cls(features.amin(0), features.amax(0))  # refuses what is not finite, by feature
        columns = [_ranges_of(part, compress, tail) for part in features.split(_COLUMNS, 1)]
        minimum, maximum, compression = (torch.cat(part) for part in zip(*columns, strict=True))
        return cls(minimum, maximum, compression if compress else None)

    def forward(self, features: Tensor) -> Tensor:
        """Scale bins; NaN stays NaN, gradients are 0 where a value is clipped.

        Shape:
            - features: ``[*, K]``
            - output: ``[*, S]``
        """
        if self.columns is not None:
            features = features.index_select(-1, self.columns)
        if self.compression is not None:
            features = signed_log(features, self.compression)
        width = self.maximum - self.minimum
        if is_concrete(width) and width.numel() and width.numpy().min() > 0:
            return (2 * ((features - self.minimum) / width) - 1).clamp(-1, 1)
        is_constant = width == 0
        relative = (features - self.minimum) / torch.where(is_constant, 1.0, width)
        scaled = (2 * relative - 1).clamp(-1, 1)
        return torch.where(is_constant, 0 * relative.clamp(0, 0), scaled)


def _ranges_of(columns: Tensor, compress: bool, tail: float) -> tuple[Tensor, Tensor, Tensor]:
    """Minimum, maximum, compression scale of features ``[N, k]``, ``[k]`` each, with gradients."""
    ordered = ascending(columns.mT, len(columns))
    compression = torch.ones_like(ordered[:, 0])
    if compress:
        size = ascending(columns.mT.abs(), len(columns))
        middle, largest = _quantile(size, 0.5), size[:, -1]
        compression = torch.where(
            middle > 0, middle, torch.where(largest > 0, largest, compression)
        )
        ordered = signed_log(ordered, compression[:, None])
    low, high = _quantile(ordered, tail), -_quantile(-ordered.flip(1), tail)
    is_range = low < high
    return (
        torch.where(is_range, low, ordered[:, 0]),
        torch.where(is_range, high, ordered[:, -1]),
        compression,
    )


def _quantile(ordered: Tensor, share: float) -> Tensor:
    """``numpy.quantile`` of ascending rows, for a share below 1."""
    position = share * (ordered.shape[1] - 1)
    index = math.floor(position)
    above = ordered[:, min(index + 1, ordered.shape[1] - 1)]
    return torch.lerp(ordered[:, index], above, position - index)
