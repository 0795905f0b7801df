"""The descriptors by their definitions, as the naive export has them, without a guard."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import (
    CV_FLOOR,
    ENTROPY_LEVELS,
    HALF_SLACK,
    RUN_TOLERANCE,
)
from tactslip_torch.features.runs import entropy_growth, rank_in_run


def described(
    x: Tensor,
    scale: Tensor,
    *,
    reference: Tensor | None = None,
    frequency_hz: Tensor | None = None,
) -> dict[str, Tensor]:
    """Every descriptor that can be made of samples, by name; ordinary samples only.

    Args:
        x: the values.
        scale: largest magnitude of the bin they come from.
        reference: that bin, for ``correlation``.
        frequency_hz: of the lines of a spectrum, for its centroid and spread.

    Shape:
        - x: ``[*, n]``; scale: broadcastable to ``[*]``; reference: to ``x``; frequency_hz: ``[n]``
        - output: ``[*]`` each
    """
    num = x.shape[-1]
    ordered = torch.sort(x, dim=-1).values
    low, high = ordered[..., 0], ordered[..., -1]
    mean = x.mean(-1)
    centred = x - mean[..., None]
    squares = centred * centred
    variance = squares.mean(-1)
    std = (squares.sum(-1) / (num - 1)).sqrt()
    energy = (x * x).sum(-1)
    rms = (energy / num).sqrt()
    floor = torch.maximum(mean.abs(), CV_FLOOR * rms)
    values = {
        "mean": mean,
        "median": _quantile(ordered, 0.5),
        "mode": _mode(ordered, RUN_TOLERANCE[x.dtype] * scale),
        "range": high - low,
        "mean_deviation": centred.abs().mean(-1),
        "std": std,
        "cv": std / torch.where(mean < 0, -floor, floor),
        "iqr": _quantile(ordered, 0.75) - _quantile(ordered, 0.25),
        "skewness": (squares * centred).mean(-1) / variance**1.5,
        "kurtosis": (squares * squares).mean(-1) / variance**2,
        "energy": energy,
        "entropy": _entropy(ordered),
        "peak_factor": high / rms,
    }
    if reference is not None:
        other = reference - reference.mean(-1, keepdim=True)
        norms = (squares.sum(-1) * (other * other).sum(-1)).sqrt()
        values["correlation"] = (centred * other).sum(-1) / norms
    if frequency_hz is not None:
        total = x.sum(-1)
        centroid = (x * frequency_hz).sum(-1) / total
        distance = frequency_hz - centroid[..., None]
        values["spectral_centroid"] = centroid
        values["spectral_spread"] = ((x * distance * distance).sum(-1) / total).sqrt()
    return values


def _quantile(ordered: Tensor, share: float) -> Tensor:
    """At Hazen's position, as ``numpy.quantile(method="hazen")``."""
    place = share * ordered.shape[-1] - 0.5
    near, far = ordered[..., math.floor(place)], ordered[..., math.ceil(place)]
    return near + (far - near) * (place % 1)


def _mode(ordered: Tensor, tolerance: Tensor) -> Tensor:
    """First value of the longest run of values no further apart than a tolerance."""
    rank = rank_in_run(ordered[..., 1:] - ordered[..., :-1] > tolerance[..., None])
    last = rank.argmax(-1, keepdim=True)
    return ordered.gather(-1, last - rank.gather(-1, last).long()).squeeze(-1)


def _entropy(ordered: Tensor) -> Tensor:
    """Of 256 levels in bits; the two highest that occur share a cell."""
    low, high = ordered[..., :1], ordered[..., -1:]
    half = 0.5 + HALF_SLACK[ordered.dtype]
    level = ((ordered - low) * (ENTROPY_LEVELS / (high - low)) + half).floor()
    is_new = (level[..., 1:] != level[..., :-1]) & (level[..., 1:] != ENTROPY_LEVELS)
    growth = entropy_growth(ordered.shape[-1]).to(ordered)
    return growth[rank_in_run(is_new).long()].sum(-1)
