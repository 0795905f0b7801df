"""Calls made ready: operations on fixed memory, by NumPy for few values and PyTorch for many.

NumPy starts a call in half the time, PyTorch is two to four times faster along rows. A step is
called without arguments, so what is done for one bin costs little but the calls themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import torch

Array = np.ndarray[Any, Any]
Step = Callable[[], object]
FEW = 2**15
"""Values for which NumPy is the quicker one."""
FEW_PRODUCTS = 2**17
"""Multiplications for which NumPy's product is, and uses one thread."""


def memory(*shape: int, dtype: torch.dtype = torch.float64) -> Array:
    """Uninitialised, aligned to cache lines, so that the same values take the same way."""
    found: Array = torch.empty(shape, dtype=dtype).numpy()
    return found


def run(steps: Iterable[Step]) -> None:
    """One after the other."""
    for step in steps:
        step()


def product(left: Array, right: Array, out: Array) -> Step:
    """Matrix product of ``[m, k]`` and ``[k, n]``."""
    if left.size * right.shape[1] <= FEW_PRODUCTS:
        return partial(np.matmul, left, right, out)
    return partial(torch.mm, torch.from_numpy(left), torch.from_numpy(right), out=_tensor(out))


def add(left: Array, right: Array, out: Array) -> Step:
    """Sum of equal shapes."""
    if out.size <= FEW:
        return partial(np.add, left, right, out)
    return partial(torch.add, _tensor(left), _tensor(right), out=_tensor(out))


def multiply(left: Array, right: Array, out: Array) -> Step:
    """Product, value by value, or row by row if ``right`` is ``[rows, 1]``."""
    if out.size <= FEW:
        return partial(np.multiply, left, right, out)
    return partial(torch.mul, _tensor(left), _tensor(right), out=_tensor(out))


def subtract(left: Array, right: Array, out: Array) -> Step:
    """Difference; shapes as those of ``multiply``, or ``left`` a row."""
    if out.size <= FEW:
        return partial(np.subtract, left, right, out)
    return partial(torch.sub, _tensor(left), _tensor(right), out=_tensor(out))


def largest(values: Array, out: Array) -> Step:
    """Largest value of each row, ``[rows, n]`` to ``[rows]``."""
    if values.size <= FEW:
        return partial(np.maximum.reduce, values, 1, None, out)
    return partial(torch.amax, _tensor(values), 1, out=_tensor(out))


def least(values: Array, out: Array) -> Step:
    """Smallest value of each row."""
    if values.size <= FEW:
        return partial(np.minimum.reduce, values, 1, None, out)
    return partial(torch.amin, _tensor(values), 1, out=_tensor(out))


def total(values: Array, out: Array) -> Step:
    """Sum of each row."""
    if values.size <= FEW:
        return partial(np.add.reduce, values, 1, None, out)
    return partial(torch.sum, _tensor(values), 1, out=_tensor(out))


def _tensor(values: Array) -> torch.Tensor:
    return torch.from_numpy(values)
