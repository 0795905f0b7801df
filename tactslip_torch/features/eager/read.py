"""Bins as the eager engine takes them: the channels wanted, in float64, with their magnitudes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.guards import ordinary_sizes

_LOW, _HIGH = ordinary_sizes(torch.float64)


def read_bins(bins: Tensor, channels: Tensor) -> tuple[Tensor, Tensor, np.ndarray[Any, Any]]:
    """Channels of bins, their largest magnitudes, and which bins hold ordinary ones alone.

    Shape:
        - bins: ``[M, C, n]``, float32 or float64; channels: ``[C']``, ascending
        - output: ``[M, C', n]`` and ``[M, C']``, float64; ``[M]``, bool
    """
    chosen = bins if len(channels) == bins.shape[1] else bins.index_select(1, channels)
    x = chosen.double().contiguous()
    if x is bins:
        x = x.clone()  # the caller may write into it
    scale = torch.maximum(x.amax(-1), -x.amin(-1))  # aminmax takes four times as long
    size = scale.numpy()
    if size.min() >= _LOW and size.max() <= _HIGH:
        return x, scale, np.ones(len(bins), bool)
    return x, scale, (((size >= _LOW) & (size <= _HIGH)) | (size == 0)).all(axis=1)
