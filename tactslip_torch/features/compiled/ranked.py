"""Kernel for what needs sorted values: median, mode and interquartile range."""

from __future__ import annotations

from tactslip_torch.features.compiled.jit import Array, inner, kernel
from tactslip_torch.features.compiled.numbering import MEDIAN, MODE
from tactslip_torch.features.compiled.steps import Sorts

_CROWDED = 2e-3
"""Part of a row's span; float32 rounds to 3e-8 of it."""


@kernel
def describe_sorted(
    d: Array,
    facts: Array,
    sorts: Sorts,
    x: Array,
    dense: Array,
    room: Array,
    out: Array,
    limit: float,
) -> None:
    """Order statistics of rows ``base + unit * d``, clamped to the limit.

    Where float32 values crowd about the median or from quartile to quartile, of a quiet bin with a
    tap say, their rounding is no small part of the result: the row is formed again in float64.

    Shape:
        - d: ``[M, S, n]``, each row sorted; facts: ``[M, S, 3]``, base, unit and how near two
          neighbours in ``d`` count as equal; x: ``[M, C, n]``, the bins; dense: ``[B, n, n]``,
          each branch as one matrix; room: ``[2, n]``, to work in; out: ``[M, K]``, written
    """
    for m in range(d.shape[0]):
        for s in range(d.shape[1]):
            row = d[m, s]
            base, unit, tolerance = facts[m, s]
            branch = sorts.branch[s]
            is_crowded = row.itemsize == 4 and branch > -2 and unit > 0 and _is_crowded(row)
            first = 0.0
            if is_crowded:
                bin_ = x[m, sorts.channel[s]]
                first = bin_[0]
                _form_sorted(bin_, dense[max(branch, 0)], branch >= 0, room)
                if branch % 2 and branch > 0:
                    first = 0.0  # a detail keeps no constant
            for k in range(sorts.start[s], sorts.start[s + 1]):
                what = sorts.what[k]
                if what == MODE:
                    value = base + unit * _mode(row, row.dtype.type(tolerance))
                elif what == MEDIAN:
                    value = first + _median(room[0]) if is_crowded else base + unit * _median(row)
                else:
                    value = _iqr(room[0]) if is_crowded else unit * _iqr(row)
                out[m, sorts.place[k]] = min(max(value, -limit), limit)


@inner
def _is_crowded(row: Array) -> bool:
    """Whether a tenth of sorted values about the median, or the middle half, hardly differ."""
    half, few = row.size // 2, row.size // 25
    about = row[min(half + few, row.size - 1)] - row[max(half - 1 - few, 0)]
    return bool(about < _CROWDED or _iqr(row) < _CROWDED)


@inner
def _form_sorted(bin_: Array, dense: Array, is_branch: bool, room: Array) -> None:
    """A bin less its first sample, or that bin's branch, in ascending order in ``room[0]``."""
    values, shifted = room[0], room[1]
    n = bin_.size
    for i in range(n):
        shifted[i] = bin_[i] - bin_[0]
    for i in range(n):
        value = shifted[i]
        if is_branch:
            value = 0.0
            for j in range(n):
                value += dense[i, j] * shifted[j]
        at = i
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value


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
