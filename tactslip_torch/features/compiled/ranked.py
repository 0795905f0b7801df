"""Kernel for what needs sorted values: median, mode and interquartile range."""

from __future__ import annotations

from tactslip_torch.features.compiled.jit import Array, inner, kernel
from tactslip_torch.features.compiled.steps import MEDIAN, MODE, Sorts


@kernel
def describe_sorted(d: Array, facts: Array, sorts: Sorts, out: Array, limit: float) -> None:
    """Order statistics of rows ``base + unit * d``, clamped to the limit.

    Shape:
        - d: ``[M, S, n]``, each row sorted; facts: ``[M, S, 3]``, base, unit and how near two
          neighbours in ``d`` count as equal; out: ``[M, K]``, written
    """
    for m in range(d.shape[0]):
        for s in range(d.shape[1]):
            row = d[m, s]
            base, unit, tolerance = facts[m, s]
            for k in range(sorts.start[s], sorts.start[s + 1]):
                what = sorts.what[k]
                if what == MEDIAN:
                    value = base + unit * _median(row)
                elif what == MODE:
                    value = base + unit * _mode(row, row.dtype.type(tolerance))
                else:
                    value = unit * _iqr(row)
                out[m, sorts.place[k]] = min(max(value, -limit), limit)


@inner
def _median(row: Array) -> float:
    half = row.size // 2
    if row.size % 2:
        return float(row[half])
    return 0.5 * (float(row[half - 1]) + float(row[half]))


@inner
def _mode(row: Array, tolerance: float) -> float:
    """First value of the first longest run of neighbours within the tolerance."""
    num_near = 0
    for i in range(row.size - 1):
        num_near += row[i + 1] - row[i] <= tolerance
    if num_near == 0:
        return float(row[0])
    start = best = best_start = 0
    for i in range(1, row.size):
        start = start if row[i] - row[i - 1] <= tolerance else i
        is_longer = i - start > best
        best_start = start if is_longer else best_start
        best = i - start if is_longer else best
    return float(row[best_start])


@inner
def _iqr(row: Array) -> float:
    """Between the quantiles at Hazen's positions."""
    return _quantile(row, 0.75) - _quantile(row, 0.25)


@inner
def _quantile(row: Array, share: float) -> float:
    position = min(max(share * row.size - 0.5, 0.0), row.size - 1.0)
    below = int(position)
    part = position - below
    near, far = float(row[below]), float(row[min(below + 1, row.size - 1)])
    return near * (1 - part) + far * part
