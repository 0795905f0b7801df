"""How kernels are compiled: once for each kind of number, and kept until a source changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.extending import intrinsic

from tactslip_torch.features.compiled.kept import folder

Array = np.ndarray[Any, Any]
Function = TypeVar("Function", bound=Callable[..., Any])

_FAST = frozenset({"reassoc", "contract", "nsz", "arcp", "nnan"})
"""Sums in any order; values are finite and no quotient is 0/0, so there is no NaN."""


def inner(function: Function) -> Function:
    """``function`` compiled into the kernels that call it."""
    return _compiled(function, fastmath=set(_FAST), forceinline=True)


def kernel(function: Function) -> Function:
    """``function`` compiled to be called from Python, without the interpreter lock, and kept."""
    return _kept(function, fastmath=set(_FAST))


def careful_kernel(function: Function) -> Function:
    """A ``kernel`` that may meet NaN and Inf."""
    return _kept(function, fastmath=False)


def _kept(function: Function, **options: Any) -> Function:
    before = numba.config.CACHE_DIR
    wanted = folder(before)
    if wanted is None:
        return _compiled(function, **options)
    numba.config.CACHE_DIR = str(wanted)
    try:
        compiled = _compiled(function, cache=True, **options)
    except RuntimeError:  # numba keeps nothing of a function without a file
        return _compiled(function, **options)
    finally:
        numba.config.CACHE_DIR = before
    path = cast(Any, compiled).stats.cache_path
    if not Path(path).is_relative_to(wanted):  # numba took another folder, which may be stale
        return _compiled(function, **options)
    return compiled


def _compiled(function: Function, **options: Any) -> Function:
    # counting who uses which array would take as long as the work on a row
    compiled = numba.njit(nogil=True, error_model="numpy", _nrt=False, **options)
    return cast(Function, compiled(function))


def _of_two(name: str, fast: bool) -> Callable[..., Any]:
    """An instruction of two numbers of one kind, which loops are vectorised with."""

    def typed(context: Any, a: Any, b: Any) -> Any:
        def emitted(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            kind = values[0].type
            function = builder.module.declare_intrinsic(
                name, [kind], ir.FunctionType(kind, [kind] * 2)
            )
            return builder.call(function, values, fastmath=("fast",) if fast else ())

        return a(a, b), emitted

    return cast(Callable[..., Any], intrinsic(typed))


smaller = _of_two("llvm.minnum", fast=True)
"""The smaller of two floats, neither of them NaN; ``min`` keeps LLVM from vectorising a loop."""
larger = _of_two("llvm.maxnum", fast=True)
"""The larger of two floats, neither of them NaN."""
larger_number = _of_two("llvm.maxnum", fast=False)
"""The larger of two floats; of a float and a NaN the float."""
