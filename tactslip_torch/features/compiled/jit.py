"""How kernels are compiled: once for each kind of number, and kept on disk until a source changes.

numba looks at the file of a cached function alone, and would not notice a change in another file
that it calls into; so the folder of the cache carries a digest of all of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.extending import intrinsic

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
    numba.config.CACHE_DIR = str(_folder(before))
    try:
        return _compiled(function, cache=True, **options)
    except RuntimeError:  # no folder may be written to
        return _compiled(function, **options)
    finally:
        numba.config.CACHE_DIR = before


def _compiled(function: Function, **options: Any) -> Function:
    # counting who uses which array would take as long as the work on a row
    compiled = numba.njit(nogil=True, error_model="numpy", _nrt=False, **options)
    return cast(Function, compiled(function))


def _of_two(name: str) -> Callable[..., Any]:
    """An instruction of two numbers of one kind, which loops are vectorised with."""

    def typed(context: Any, a: Any, b: Any) -> Any:
        def emitted(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            kind = values[0].type
            function = builder.module.declare_intrinsic(
                name, [kind], ir.FunctionType(kind, [kind] * 2)
            )
            return builder.call(function, values, fastmath=("fast",))

        return a(a, b), emitted

    return cast(Callable[..., Any], intrinsic(typed))


smaller = _of_two("llvm.minnum")
"""The smaller of two floats; ``min`` keeps LLVM from vectorising a loop."""
larger = _of_two("llvm.maxnum")
"""The larger of two floats."""


def _folder(chosen: str) -> Path:
    """Where compiled code is kept: beneath ``NUMBA_CACHE_DIR`` if set, else beside the sources."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(here.glob("*.py")):
        digest.update(source.read_bytes())
    return (Path(chosen) if chosen else here / "__pycache__") / digest.hexdigest()[:16]
