"""Which inputs a set of bins covers, channel by channel: what lies outside was never tried."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Coverage(NamedTuple):
    """Ranges of the channels of bins.

    Attributes:
        low_v: ``[*, C]``, least raw sample, volts.
        high_v: ``[*, C]``, greatest.
        span_v: ``[*, C]``, span of the filtered bin.
        relative_span: ``[*, C]``, that over its magnitude; 0 for a zero one.
    """

    low_v: Tensor
    high_v: Tensor
    span_v: Tensor
    relative_span: Tensor


def coverage(samples: Tensor, filtered: Tensor) -> Coverage:
    """What each bin covers.

    Shape:
        - samples: ``[*, C, T]``, raw, volts; filtered: ``[*, C, n]``
        - output: ``[*, C]`` each
    """
    span, magnitude = filtered.amax(-1) - filtered.amin(-1), filtered.abs().amax(-1)
    is_zero = magnitude == 0
    relative = torch.where(is_zero, 0.0, span / torch.where(is_zero, 1.0, magnitude))
    low, high = samples.amin(-1).to(relative), samples.amax(-1).to(relative)
    return Coverage(low, high, span, relative)


class KnownInputs:
    """The inputs that bins cover together; channels of a kind share a range.

    Args:
        bins: ``[N, C]`` each, those that are known.
        kinds: of the channels by name, in the order of the bins.
        used: names of the channels that matter; default all.

    Example:
        >>> bins = coverage(torch.tensor([[[-1.0, 1.0], [-2.0, 2.0]]]), torch.ones(1, 2, 1))
        >>> new = coverage(torch.tensor([[[1.5, 1.5], [0.0, 0.0]]]), torch.ones(1, 2, 1))
        >>> KnownInputs(bins, {"SG1": "SG", "SG2": "SG"}).cover(new)
        tensor([True])
        >>> KnownInputs(bins, {"SG1": "SG", "PVDF1": "PVDF"}).cover(new)
        tensor([False])
    """

    def __init__(
        self, bins: Coverage, kinds: Mapping[str, str], used: Iterable[str] | None = None
    ) -> None:
        self._names = tuple(kinds)
        self._kinds = {
            kind: [place for place, name in enumerate(kinds) if kinds[name] == kind]
            for kind in dict.fromkeys(kinds.values())
        }
        self._used = {self._names.index(name) for name in (kinds if used is None else used)}
        low, high, span, relative = bins
        self._covered = Coverage(low.amin(0), high.amax(0), span.amin(0), relative.amin(0))

    def cover(self, bins: Coverage) -> Tensor:
        """Whether every channel that matters lies within the range of its kind.

        Shape:
            - bins: ``[N, C]`` each; output: ``[N]``, bool
        """
        inside = torch.ones(len(bins.low_v), dtype=torch.bool, device=bins.low_v.device)
        for places in self._kinds.values():
            known = self._range(places)
            own = Coverage(*(part[:, [i for i in places if i in self._used]] for part in bins))
            inside &= ((own.low_v >= known.low_v) & (own.high_v <= known.high_v)).all(-1)
            inside &= (own.span_v >= known.span_v).all(-1)
            inside &= (own.relative_span >= known.relative_span).all(-1)
        return inside

    def facts(self) -> dict[str, Any]:
        """Least and greatest samples and least spans, by kind and by channel."""

        def of(places: list[int]) -> dict[str, float]:
            return {name: float(x) for name, x in self._range(places)._asdict().items()}

        return {
            "kinds": {kind: of(places) for kind, places in self._kinds.items()},
            "channels": {name: of([place]) for place, name in enumerate(self._names)},
        }

    def _range(self, places: list[int]) -> Coverage:
        low, high, span, relative = (part[places] for part in self._covered)
        return Coverage(low.min(), high.max(), span.min(), relative.min())
