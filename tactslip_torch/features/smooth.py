"""Smooth stand-ins for the descriptors that step or have kinks, for those who ask for them.

``FeaturePool(hand, smooth=0.01)`` makes median, mode, range, iqr, entropy and peak factor by these
in place of the exact ones, all with two continuous derivatives but where another value becomes the
largest or smallest (for entropy, the highest below the top level too); the other eleven are as they
were. A detector that was fitted on exact features must not be given smooth ones.

The temperature ``t`` is a part of the sample's span ``S``, so nothing depends on the unit. With
``n`` values, errors against the exact descriptors are at most the following, beside rounding; each
goes to 0 with ``t`` for any sample that is not itself at a step (``tests/test_smooth.py``).

===========  ======================================================================================
median       ``t S``: order statistics of a kernel-smoothed distribution (``soft_order``)
iqr          ``2 t S``: the same, between Hazen's positions as the exact one
range        ``2 t S``: largest less smallest of the same
peak factor  ``t S / rms``: the largest of the same
entropy      ``a log2(255) + H(a)`` bits, ``a = m / 2n``, ``H(a) = -a log2 a - (1 - a) log2(1 - a)``
             and m the number of values within t S (at most half a level) of where two of the 256
             levels meet; and 1 bit more if one of them is at or next to the two highest occupied
             levels, which share a cell
mode         ``S (2 t ln n + (n - 1) exp(-1 / (2 t)))`` where sorted neighbours are equal to within
             the mode's tolerance or at least t S apart, and equal ones span at most t S / 2; else
             ``S``: it always lies among the values
===========  ======================================================================================

*Entropy*: a value near an edge is shared out between both levels by the integral of a kernel
(a histogram with soft edges); which level joins the top one is decided likewise, as if all values
were rounded by one common dither. The bound is the sharp continuity of entropy in total variation.
*Mode*: each value counts those within t S / 2 wholly and those up to t S in part; the values are
averaged with weights ``exp((count - place / 2) / t)``, place from 0 at the smallest to 1 at the
largest, as the smallest of ties is the exact one. Of a sample without equal values that one is the
minimum; the stand-in goes there only once t S is below the smallest gap, and until then it is
where values crowd.

Cost: let w be the largest number of values within 2 t S of one. An order statistic takes a sort and
some fifteen sums over w values, its gradient one over the sample; entropy takes 256 cells, the mode
n w (in memory too, where gradients are kept). No fast engine and no ONNX graph makes them.

Reference:
    Entropy's continuity: Zhang (2007), IEEE Trans. Inf. Theory 53(9), 3280-3282; Audenaert (2007),
    J. Phys. A 40, 8127-8136. Order statistics: as in ``soft_order``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

from tactslip_torch.features.descriptors import ENTROPY_LEVELS, HALF_SLACK
from tactslip_torch.features.runs import EPS64
from tactslip_torch.features.sample import Sample
from tactslip_torch.features.soft_order import num_near, share_below, smooth_order

StandIn = Callable[[Sample], Tensor]


def stand_ins(temperature: float | None) -> dict[str, StandIn]:
    """The smooth descriptors by the names of the exact ones, for ``describe``.

    Args:
        temperature: part of a sample's span over which values are smeared; None for none of them.

    Raises:
        ValueError: unless the temperature lies above 0 and is at most 1.

    Example:
        >>> from tactslip_torch.features.descriptors import describe
        >>> x = torch.tensor([1.0, 2.0, 2.1, 5.0], requires_grad=True)
        >>> smooth = describe(x, ["median", "range"], stand_ins=stand_ins(0.05))
        >>> smooth.detach(), describe(x.detach(), ["median", "range"])
        (tensor([2.0500, 4.0000]), tensor([2.0500, 4.0000]))
    """
    if temperature is None:
        return {}
    if not 0 < temperature <= 1:
        raise ValueError(
            f"smooth must be a temperature above 0 and at most 1, in parts of a sample's span, "
            f"got {temperature}"
        )
    return {
        name: partial(function, temperature=float(temperature))
        for name, function in _FUNCTIONS.items()
    }


def median(sample: Sample, temperature: float) -> Tensor:
    """Mean of the smoothed middle value or two, ``[*]``."""
    ranks = sorted({(sample.num - 1) // 2, sample.num // 2})
    return _in_unit_of(sample, _ordered(sample, ranks, temperature).mean(-1))


def iqr(sample: Sample, temperature: float) -> Tensor:
    """Between smoothed quantiles at Hazen's positions, ``[*]``."""
    last = sample.num - 1
    positions = [min(max(q * sample.num - 0.5, 0.0), last) for q in (0.25, 0.75)]
    ranks = [rank for p in positions for rank in (int(p), min(int(p) + 1, last))]
    below, above, low, high = _ordered(sample, ranks, temperature).unbind(-1)
    first, second = (position % 1 for position in positions)
    return sample.out_of_unit(
        _span(sample) * (torch.lerp(low, high, second) - torch.lerp(below, above, first))
    )


def range_(sample: Sample, temperature: float) -> Tensor:
    """Smoothed largest minus smoothed smallest value, ``[*]``."""
    low, high = _ordered(sample, [0, sample.num - 1], temperature).unbind(-1)
    return sample.out_of_unit(_span(sample) * (high - low))


def peak_factor(sample: Sample, temperature: float) -> Tensor:
    """Smoothed signed maximum over the root mean square, ``[*]``; 0 for a zero sample."""
    largest = _ordered(sample, [sample.num - 1], temperature).squeeze(-1)
    return (sample.mean + _span(sample) * largest) / sample.rms


def mode(sample: Sample, temperature: float) -> Tensor:
    """Mean of the values, those with most others near them weighing nearly all, ``[*]``."""
    place = _relative(sample).sort(-1).values
    count = 1 + _neighbours(place, temperature)
    weights = torch.softmax((count - place / 2) / temperature, dim=-1)
    return _in_unit_of(sample, (weights * place).sum(-1))


def entropy(sample: Sample, temperature: float) -> Tensor:
    """Shannon entropy in bits of a histogram with soft edges, ``[*]``; 0 for a constant."""
    slack = HALF_SLACK[sample.x.dtype]
    place = _relative(sample)
    level = (place - place.amin(-1, keepdim=True)) * ENTROPY_LEVELS + 0.5 + slack
    edge = level.detach().round().nan_to_num(1.0).clamp(1, ENTROPY_LEVELS)  # the nearest one
    width = min(ENTROPY_LEVELS * temperature, 0.5 - slack)
    upper = share_below((level - edge) / width)
    above = edge.long()
    counts = level.new_zeros(*level.shape[:-1], ENTROPY_LEVELS + 1)
    shares = counts.scatter_add(-1, above, upper).scatter_add(-1, above - 1, 1 - upper) / sample.num
    bits = _bits(shares)
    top = shares[..., -1:]
    # one common dither: the first value below the top is this one if the next higher is not
    is_next = edge == ENTROPY_LEVELS
    at_top = torch.where(is_next, upper, 0.0).sort(-1, descending=True)
    order = level.detach().argsort(-1, descending=True)
    leads = pad(at_top.values[..., :-1], (1, 0), value=1.0) - at_top.values
    lower = torch.where(is_next, 1.0, 1 - upper)
    change = _bits(top + shares) - bits[..., -1:] - bits
    joined = lower * change.gather(-1, above - 1)
    joined = joined + (1 - lower) * change.gather(-1, above)
    merged = (leads * joined.gather(-1, order)).sum(-1)
    return sample.unless_flat(bits.sum(-1) + merged, 0.0)


_FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    "median": median,
    "mode": mode,
    "range": range_,
    "iqr": iqr,
    "entropy": entropy,
    "peak_factor": peak_factor,
}


def _relative(sample: Sample) -> Tensor:
    """Values less their mean, in spans; the span has its derivative here, ``[*, n]``."""
    return sample.centred / sample.unless_flat(_span(sample), 1.0)[..., None]


def _span(sample: Sample) -> Tensor:
    """``sample.span`` by its centred values, so that derivatives add up in the stretched unit."""
    return sample.centred.amax(-1) - sample.centred.amin(-1)


def _in_unit_of(sample: Sample, relative: Tensor) -> Tensor:
    """The way back, ``[*]``."""
    return sample.out_of_unit(sample.mean + _span(sample) * relative)


def _ordered(sample: Sample, ranks: Sequence[int], temperature: float) -> Tensor:
    """Smoothed order statistics of ``_relative``, ``[*, len(ranks)]``."""
    return smooth_order(_relative(sample), ranks, temperature)


def _neighbours(place: Tensor, width: float) -> Tensor:
    """How many others lie within ``width`` of each sorted value, ``[*, n]``; half of it wholly.

    In between, a polynomial with two continuous derivatives leads from 1 to 0.
    """
    count = torch.zeros_like(place)
    for lag in range(1, num_near(place, width) + 1):
        gap = place[..., lag:] - place[..., :-lag]
        part = (2 - 2 * gap / width).clamp(0, 1)
        near = part.pow(3) * (10 + part * (6 * part - 15))
        count = count + pad(near, (lag, 0)) + pad(near, (0, lag))
    return count


def _bits(shares: Tensor) -> Tensor:
    """What cells add to an entropy: ``[*] -> [*]``, as in the exact one."""
    return -shares * (shares + EPS64).log2()
