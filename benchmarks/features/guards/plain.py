"""The descriptors without care for extremes: for bins that are none, and for nothing else.

``PlainSample`` takes every span, magnitude and sum as nonzero and every value as finite, and keeps
how the package computes: two-pass moments of values shifted by the first and divided by the span.
``TextbookSample`` leaves that away too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.features import descriptors
from tactslip_torch.features.runs import entropy_growth, rank_in_run
from tactslip_torch.features.sample import Sample


class PlainSample(Sample):
    """A ``Sample`` of which only ``ordered``, ``largest`` and ``smallest`` are the package's."""

    reference: PlainSample | None

    @cached_property
    def span(self) -> Tensor:
        """Largest minus smallest value."""
        return self.largest - self.smallest

    @cached_property
    def shift_and_centred(self) -> tuple[Tensor, Tensor]:
        """Mean of the values minus the first, and values minus their mean."""
        shifted = self.x - self.x[..., :1].detach()
        shift = shifted.mean(-1, keepdim=True)
        return shift, shifted - shift

    @cached_property
    def mean(self) -> Tensor:
        """Arithmetic mean."""
        return self.x[..., 0].detach() + self.shift_and_centred[0].squeeze(-1)

    @cached_property
    def centred(self) -> Tensor:
        """Values minus their mean."""
        return self.shift_and_centred[1]

    @cached_property
    def deviation(self) -> Tensor:
        """Values minus their mean, over the span."""
        return self.centred / self.span.detach()[..., None]

    @cached_property
    def squares(self) -> Tensor:
        """Squared ``deviation``."""
        return self.deviation * self.deviation

    @cached_property
    def variance(self) -> Tensor:
        """Mean of ``squares``."""
        return self.squares.mean(-1)

    @cached_property
    def std(self) -> Tensor:
        """Standard deviation."""
        square = (self.centred * self.centred).mean(-1)
        return (square * (self.num / (self.num - 1))).sqrt()

    @cached_property
    def rms(self) -> Tensor:
        """Root mean square."""
        return (self.x * self.x).mean(-1).sqrt()

    @cached_property
    def weights(self) -> Tensor:
        """A spectrum's lines as shares of their sum."""
        return self.x / self.x.sum(-1, keepdim=True)

    @property
    def hertz(self) -> Tensor:
        """The axis of a spectrum."""
        assert self.frequency_hz is not None  # describe
        return self.frequency_hz.to(self.x)

    @cached_property
    def centroid(self) -> Tensor:
        """Mean frequency."""
        return (self.weights * self.hertz).sum(-1)


class TextbookSample(PlainSample):
    """Deviations are from the plain mean, in the unit of the values."""

    @cached_property
    def mean(self) -> Tensor:
        """Arithmetic mean."""
        return self.x.mean(-1)

    @cached_property
    def centred(self) -> Tensor:
        """Values minus their mean."""
        return self.x - self.mean[..., None]

    @cached_property
    def deviation(self) -> Tensor:
        """Likewise."""
        return self.centred


def describer(kind: type[PlainSample]) -> Callable[..., Tensor]:
    """A ``describe`` by plain formulas; arguments are not checked."""

    def describe(
        x: Tensor,
        names: Sequence[str],
        *,
        scale: Tensor | None = None,
        reference: Tensor | None = None,
        frequency_hz: Tensor | None = None,
    ) -> Tensor:
        sample = kind(x, scale, None if reference is None else kind(reference), frequency_hz)
        return torch.stack([_FORMULAS[name](sample) for name in names], dim=-1)

    return describe


def _mode(sample: PlainSample) -> Tensor:
    ordered = sample.ordered.detach()
    tolerance = descriptors.RUN_TOLERANCE[sample.x.dtype] * sample.scale[..., None]
    rank = rank_in_run(ordered[..., 1:] - ordered[..., :-1] > tolerance)
    last = rank.argmax(-1, keepdim=True)
    return sample.ordered.gather(-1, last - rank.gather(-1, last).long()).squeeze(-1)


def _iqr(sample: PlainSample) -> Tensor:
    def quantile(q: float) -> Tensor:
        position = q * sample.num - 0.5
        low, share = int(position), position % 1
        values = sample.ordered
        return values[..., low] * (1 - share) + values[..., low + 1] * share

    return quantile(0.75) - quantile(0.25)


def _entropy(sample: PlainSample) -> Tensor:
    ordered, top = sample.ordered.detach(), descriptors.ENTROPY_LEVELS
    levels = (top / sample.span.detach())[..., None]
    half = 0.5 + descriptors.HALF_SLACK.get(sample.x.dtype, 0.0)
    level = ((ordered - ordered[..., :1]) * levels + half).floor()
    new_cell = (level[..., 1:] != level[..., :-1]) & (level[..., 1:] != top)
    growth = entropy_growth(sample.num).to(sample.x)
    rank = rank_in_run(new_cell)
    return growth.index_select(0, rank.flatten()).reshape(rank.shape).sum(-1)


def _correlation(sample: PlainSample) -> Tensor:
    other = sample.reference
    assert other is not None  # describe
    covariance = (sample.deviation * other.deviation).mean(-1)
    return covariance / (sample.variance.sqrt() * other.variance.sqrt())


def _spread(sample: PlainSample) -> Tensor:
    distance = sample.hertz - sample.centroid[..., None]
    return (sample.weights * distance * distance).sum(-1).sqrt()


_FORMULAS: dict[str, Callable[[Any], Tensor]] = {
    "mean": lambda sample: sample.mean,
    "median": lambda s: s.ordered[..., (s.num - 1) // 2 : s.num // 2 + 1].mean(-1),
    "mode": _mode,
    "range": lambda sample: sample.span,
    "mean_deviation": lambda sample: sample.centred.abs().mean(-1),
    "std": lambda sample: sample.std,
    "cv": lambda sample: sample.std / sample.mean,
    "iqr": _iqr,
    "skewness": lambda s: (s.squares * s.deviation).mean(-1) / s.variance**1.5,
    "kurtosis": lambda s: (s.squares * s.squares).mean(-1) / s.variance**2,
    "energy": lambda sample: (sample.x * sample.x).sum(-1),
    "entropy": _entropy,
    "peak_factor": lambda sample: sample.largest / sample.rms,
    "correlation": _correlation,
    "spectral_centroid": lambda sample: sample.centroid,
    "spectral_spread": _spread,
}
