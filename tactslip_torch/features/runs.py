"""What entropy is made of, for the fast engines."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

EPS64 = torch.finfo(torch.float64).eps


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
