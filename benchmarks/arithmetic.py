"""In which dtype bins come, and in which their features are computed."""

from __future__ import annotations

from typing import NamedTuple

import torch

from tactslip_torch.features.pool import Arithmetic


class Way(NamedTuple):
    """A way to features.

    Attributes:
        dtype: of the bins, and of what comes out.
        arithmetic: of ``FeaturePool``.
    """

    dtype: torch.dtype
    arithmetic: Arithmetic


FLOAT64, WIDE, NATIVE = "float64", "float32, computed in float64", "float32 throughout"
ARITHMETIC = {
    FLOAT64: Way(torch.float64, "double"),
    WIDE: Way(torch.float32, "double"),
    NATIVE: Way(torch.float32, "native"),
}
