"""Which engine a name means on this machine: kernels that numba compiles, or eager code."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec


def usable_engine(
    engine: str, known: Sequence[str], load_kernels: Callable[[], object], work: str
) -> str:
    """The engine that carries out the work here: ``"auto"`` becomes compiled or eager.

    Args:
        engine: a name.
        known: names there are.
        load_kernels: imports the compiled kernels; a second, once, and only if numba is there.
        work: what is done by the engine, for the warning where numba cannot be used.

    Raises:
        ValueError: for an unknown engine, or ``"compiled"`` where numba cannot be used.
    """
    if engine not in known:
        raise ValueError(f"engine must be one of {', '.join(known)}, got {engine!r}")
    if engine not in ("auto", "compiled"):
        return engine
    is_installed, trouble = find_spec("numba") is not None, _trouble(load_kernels)
    if engine == "compiled" and trouble:
        raise ValueError(
            f'engine "compiled" needs numba, which {trouble}; pip install '
            '"tactslip_torch[fast]", or use engine "eager"'
        )
    if trouble and is_installed:
        warnings.warn(f"numba {trouble}; {work} by engine eager", stacklevel=4)
    return "eager" if trouble else "compiled"


def _trouble(load_kernels: Callable[[], object]) -> str:
    """Why kernels cannot be compiled here; empty if they can."""
    if find_spec("numba") is None:
        return "is not installed"
    try:
        load_kernels()
    except Exception as error:  # another numba or NumPy than it was made for
        return f"cannot be used: {str(error).splitlines()[0]}"
    return ""
