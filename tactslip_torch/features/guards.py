"""Magnitudes that the fast engines take."""

from __future__ import annotations

import math

import torch


def ordinary_sizes(dtype: torch.dtype) -> tuple[float, float]:
    """Between which magnitudes squares stay well within a dtype: 2^-320 and 2^448 in float64."""
    exponent = math.frexp(torch.finfo(dtype).max)[1]
    return 2.0 ** (-5 * exponent // 16), 2.0 ** (7 * exponent // 16)
