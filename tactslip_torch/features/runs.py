"""Runs of values that count as one among sorted values: what mode and entropy are made of."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

EPS64 = torch.finfo(torch.float64).eps


def rank_in_run(is_boundary: Tensor) -> Tensor:
    """Position of each sorted value within its run, from 0.

    The running maximum of where runs start, by doubling: log2(n) plain maxima of windows, which
    export to ONNX as ``cummax`` does not.

    Shape:
        - is_boundary: ``[*, n - 1]``, bool: a new run starts behind this value
        - output: ``[*, n]``, int32
    """
    num = is_boundary.shape[-1] + 1
    position = torch.arange(num, dtype=torch.int32, device=is_boundary.device)
    start = pad(torch.where(is_boundary, position[1:], 0), (num, 0))  # the window before the first
    left, width = num - 1, 1
    while left:
        step = min(width, left)
        start = torch.maximum(start[..., step:], start[..., :-step])
        left, width = left - step, 2 * width
    return position - start


def entropy_growth(num: int) -> Tensor:
    """What the value of rank ``r`` in its cell adds to the entropy of ``num`` values.

    Shape:
        - output: ``[num]``, float64, in bits
    """
    return torch.tensor(_growth(num), dtype=torch.float64)


@lru_cache
def _growth(num: int) -> list[float]:
    shares = (count / num for count in range(num + 1))
    parts = [-share * math.log2(share + EPS64) for share in shares]
    return [after - before for before, after in pairwise(parts)]
