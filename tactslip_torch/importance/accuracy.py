"""Balanced accuracy as a mean over groups, and how sure the difference of two machines is.

Of each group, a material as a rule, the mean of its two recalls; then the mean over groups. So a
material with many bins does not drown the others, and a sample of as many bins of every group and
class needs no weights.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins

COVERAGE = 0.95


class Tally(NamedTuple):
    """Right decisions by recording: all that accuracy and its draws need to know.

    Shape:
        - right: ``[R, 2]``, float64, non-slip first
        - whole: ``[R, 2]``, how many bins there are
        - group: ``[R]``, whole numbers
    """

    right: Tensor
    whole: Tensor
    group: Tensor


class Difference(NamedTuple):
    """Balanced accuracy lost, and the ends of its interval; shares, not percent."""

    lost: float
    low: float
    high: float


def tally(is_right: Tensor, bins: SampledBins) -> Tally:
    """Count right decisions by recording and class.

    Shape:
        - is_right: ``[n]``, bool
    """
    num = len(bins.recording_names)
    cell = 2 * bins.recording + bins.is_slip
    whole = torch.bincount(cell, minlength=2 * num).double().view(num, 2)
    right = torch.bincount(cell[is_right], minlength=2 * num).double().view(num, 2)
    group = torch.zeros(num, dtype=torch.int64)
    group[bins.recording] = bins.group  # a recording is of one group
    return Tally(right, whole, group)


def balanced_accuracy(found: Tally, times: Tensor | None = None) -> Tensor:
    """The mean over groups of their balanced accuracy, in draws of recordings or in all of them.

    Groups without bins of both classes are passed over; NaN where none is left.

    Args:
        found: of a machine.
        times: how often each recording is in each draw; default once each in one draw.

    Shape:
        - times: ``[D, R]``, float64
        - output: ``[D]``, float64
    """
    times = torch.ones_like(found.whole[:, 0])[None] if times is None else times
    by_group = []
    for name in found.group.unique():
        mine = found.group == name
        recalls = (times[:, mine] @ found.right[mine]) / (times[:, mine] @ found.whole[mine])
        by_group.append(recalls.mean(-1))
    return torch.stack(by_group).nanmean(0)


def draw_recordings(group: Tensor, num_draws: int, seed: int) -> Tensor:
    """How often each recording is in each draw: as many as there are of its group, replaced.

    Shape:
        - group: ``[R]``
        - output: ``[D, R]``, float64
    """
    generator = torch.Generator().manual_seed(seed)
    times = torch.zeros(num_draws, len(group), dtype=torch.float64)
    for name in group.unique():
        mine = (group == name).nonzero()[:, 0]
        drawn = torch.randint(len(mine), (num_draws, len(mine)), generator=generator)
        times.scatter_add_(1, mine[drawn], torch.ones(drawn.shape, dtype=torch.float64))
    return times


def difference(before: Tally, after: Tally, num_draws: int, seed: int) -> Difference:
    """Balanced accuracy that ``after`` lacks, with a bootstrap interval over recordings.

    Paired: both machines are judged on the same draws, so what makes a recording hard for both
    cancels. The machines are held: another draw of training recordings would change more.

    Args:
        before: of the machine with all sensors.
        after: of the other, on the same bins.
        num_draws: how many.
        seed: of the draws.

    Raises:
        ValueError: if nothing is to be drawn.

    Reference:
        Efron and Tibshirani (1993), An Introduction to the Bootstrap, chapters 8 and 13.
    """
    if num_draws < 1:
        raise ValueError(f"an interval needs at least one draw, got {num_draws}; give draws=1000")
    times = draw_recordings(before.group, num_draws, seed)
    gaps = balanced_accuracy(before, times) - balanced_accuracy(after, times)
    tail = (1 - COVERAGE) / 2
    ends = torch.tensor([tail, 1 - tail], dtype=torch.float64)
    low, high = gaps.nanquantile(ends).tolist()
    return Difference(float(balanced_accuracy(before) - balanced_accuracy(after)), low, high)
