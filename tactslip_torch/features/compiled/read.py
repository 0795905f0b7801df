"""Kernel that reads bins: the channels wanted, in float64, with their magnitudes."""

from __future__ import annotations

import numpy as np

from tactslip_torch.features.compiled.jit import Array, careful_kernel, larger_number


@careful_kernel
def read_bins(
    bins: Array,
    channels: Array,
    low: float,
    high: float,
    x: Array,
    scale: Array,
    is_ordinary: Array,
) -> None:
    """Copy channels, and see which bins hold magnitudes 0 or from ``low`` to ``high`` alone.

    Shape:
        - bins: ``[M, C, n]``, any floats, NaN and Inf too; channels: ``[C']``
        - x: ``[M, C', n]``, written; scale: ``[M, C']``, largest magnitudes, written, of no meaning
          where a bin is not ordinary; is_ordinary: ``[M]``, bool, written
    """
    for m in range(bins.shape[0]):
        is_good = True
        for c in range(channels.size):
            row, to = bins[m, channels[c]], x[m, c]
            most, num_bad = 0.0, 0
            for i in range(row.size):
                v = np.float64(row[i])
                size = abs(v)
                to[i] = v
                most = larger_number(most, size)
                num_bad += not size <= high
            scale[m, c] = most
            is_good &= num_bad == 0 and (most >= low or most == 0)
        is_ordinary[m] = is_good
