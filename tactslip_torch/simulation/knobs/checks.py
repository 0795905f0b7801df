"""What every group of knobs is checked for."""

from __future__ import annotations

import math
from dataclasses import fields


def require_finite(group: object, *, signed: tuple[str, ...] = ()) -> None:
    """Check every number of a group of knobs, and turn lists into tuples.

    Raises:
        ValueError: if a number is not finite, or negative and not in ``signed``, or a
            pair is not ``0 < low <= high``.
    """
    where = type(group).__name__
    for field in fields(group):  # type: ignore[arg-type]  # always a dataclass
        value = getattr(group, field.name)
        if isinstance(value, list):
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
            object.__setattr__(group, field.name, value)
        if isinstance(value, bool | str) or value is None or field.name in signed:
            continue
        if isinstance(value, int | float):
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"{where}.{field.name} must be finite and not negative, got {value}"
                )
        elif "tuple[float, float]" in str(field.type) and not (
            len(value) == 2 and 0 < value[0] <= value[1] < math.inf
        ):
            raise ValueError(
                f"{where}.{field.name} must be (low, high), 0 < low <= high, got {value}"
            )
