"""Min-max scaling to [-1, 1], fitted on training bins (REFERENCE.md section 5)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class MinMaxScaler(nn.Module):
    """Scales every feature to [-1, 1] by the range of the training bins and clips the rest.

    Clipping is ours: a quadratic kernel grows with the fourth power of what leaves the range.
    A feature that was constant in training becomes 0.

    Args:
        minimum: ``[K]``, smallest training value of each feature.
        maximum: ``[K]``, largest.

    Raises:
        ValueError: if shapes disagree, a value is not finite or a minimum exceeds its maximum.
    """

    minimum: Tensor
    maximum: Tensor

    def __init__(self, minimum: Tensor, maximum: Tensor) -> None:
        super().__init__()
        if minimum.shape != maximum.shape:
            raise ValueError(
                f"minimum and maximum must agree in shape, got {tuple(minimum.shape)} "
                f"and {tuple(maximum.shape)}"
            )
        bad = ~(minimum.isfinite() & maximum.isfinite() & (minimum <= maximum))
        if bool(bad.any()):
            i = int(bad.nonzero()[0])
            raise ValueError(
                f"feature {i}: expected finite minimum <= maximum, got "
                f"{float(minimum[i]):g} and {float(maximum[i]):g}"
            )
        self.register_buffer("minimum", minimum.clone())
        self.register_buffer("maximum", maximum.clone())

    @classmethod
    def fit(cls, features: Tensor) -> MinMaxScaler:
        """The scaler of training bins ``[N, K]``, ``N >= 1``."""
        return cls(features.amin(0), features.amax(0))

    def forward(self, features: Tensor) -> Tensor:
        """Scale bins; NaN stays NaN, gradients are 0 where a value is clipped.

        Shape:
            - features, output: ``[*, K]``
        """
        width = self.maximum - self.minimum
        is_constant = width == 0
        relative = (features - self.minimum) / torch.where(is_constant, 1.0, width)
        scaled = (2 * relative - 1).clamp(-1, 1)
        return torch.where(is_constant, 0 * relative.clamp(0, 0), scaled)
