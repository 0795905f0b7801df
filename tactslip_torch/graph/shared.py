"""What descriptors of rows share, as nodes, each made when first asked for.

All there is one of per sample is in the dtype of the rows; all there is one of per row (moments,
means, units) is float64, where no square of a float32 leaves the range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from tactslip_torch.graph.rows import Rows
from tactslip_torch.graph.value import F64, Value
from tactslip_torch.graph.writer import Graph

NEXT_TO_NOTHING = 1e-60  # variances of rows of order one are 0 or far above
_MOMENTS = (
    "mean",
    "std",
    "cv",
    "mean_deviation",
    "skewness",
    "kurtosis",
    "energy",
    "peak_factor",
    "correlation",
)


class Part:
    """A quantity of some rows: ``value [B, R', ...]`` of the rows at ``places``."""

    def __init__(self, value: Value, places: Sequence[int]) -> None:
        self.value = value
        self.places = tuple(places)

    def of(self, places: Sequence[int]) -> Value:
        """That of fewer rows, in their order."""
        if tuple(places) == self.places:
            return self.value
        return self.value.take([self.places.index(place) for place in places], 1)


class Shared:
    """What the descriptors of rows of one length and dtype share, each made once.

    Args:
        graph: to which nodes are added.
        rows: the rows.
        wanted: descriptors, each with the places of the rows it is wanted of, ascending.
        dtype: of the form; rows may be more exact.
        frequency_hz: of the lines, if rows are spectra.
    """

    def __init__(
        self,
        graph: Graph,
        rows: Rows,
        wanted: Mapping[str, Sequence[int]],
        *,
        dtype: np.dtype[Any],
        frequency_hz: torch.Tensor,
    ) -> None:
        self.graph = graph
        self.rows = rows
        self.dtype = dtype
        self._wanted = wanted
        self._axis_hz = frequency_hz
        self._made: dict[str, Part] = {}

    @property
    def all_rows(self) -> tuple[int, ...]:
        """Places of all rows: to pick some of them costs more than it spares."""
        return tuple(range(len(self.rows.rows)))

    def of_rows(self, names: Iterable[str]) -> tuple[int, ...]:
        """Places of the rows that one of these descriptors is wanted of."""
        return tuple(sorted({place for name in names for place in self._wanted.get(name, ())}))

    def of_all(self, value: Value, places: Sequence[int]) -> Value:
        """The part at these places of what there is one of for every row."""
        return Part(value, range(len(self.rows.rows))).of(places)

    def once(self, name: str, make: Callable[[], Part]) -> Part:
        """A shared part, made when first asked for."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    @property
    def num(self) -> int:
        """Values of a row."""
        return len(self._axis_hz)

    # Values [B, R', n] -------------------------------------------------------------------------

    def values(self, places: Sequence[int]) -> Value:
        """Values as they are: branches less their mean, spectra in full."""
        return self.once(
            f"values {tuple(places)}",
            lambda: Part(self.of_all(self.rows.values, places), places),
        ).value

    def centred(self) -> Part:
        """Values less their mean, of all rows that have a moment."""

        def make() -> Part:
            places = self.all_rows
            values = self.values(places)
            if self.rows.mean is not None:
                return Part(values, places)
            return Part(values - self.plain_mean().of(places), places)

        return self.once("centred", make)

    def plain_mean(self) -> Part:
        """Mean of a spectrum, in its dtype, ``[B, R', 1]``."""
        places = self.all_rows
        return self.once("plain mean", lambda: Part(self.values(places).mean(keep=True), places))

    def squares(self) -> Part:
        """Squared centred values."""

        def make() -> Part:
            centred = self.centred()
            return Part(centred.value * centred.value, centred.places)

        return self.once("squares", make)

    # One of each row, float64 ------------------------------------------------------------------

    def unit(self, places: Sequence[int]) -> Value:
        """By which values are volts."""
        return self.of_all(self.rows.unit, places)

    def mean(self, places: Sequence[int]) -> Value:
        """In the unit."""
        if self.rows.mean is not None:
            return self.of_all(self.rows.mean, places)
        return self.once(
            "mean",
            lambda: Part(self.plain_mean().value.squeeze(2).cast(F64), self.plain_mean().places),
        ).of(places)

    def variance(self) -> Part:
        """Mean square of centred values."""
        return self.once(
            "variance", lambda: Part(self.squares().value.mean().cast(F64), self.squares().places)
        )

    def third(self) -> Part:
        """Mean cube."""
        places = self.all_rows
        cubes = self.squares().of(places) * self.centred().of(places)
        return Part(cubes.mean().cast(F64), places)

    def fourth(self) -> Part:
        """Mean fourth power."""
        places = self.all_rows
        squares = self.squares().of(places)
        return Part((squares * squares).mean().cast(F64), places)

    def safe_variance(self, places: Sequence[int]) -> Value:
        """The variance; next to nothing where all values are equal, and all moments 0."""
        return self.variance().of(places).max(NEXT_TO_NOTHING)

    def rms(self, places: Sequence[int]) -> Value:
        """Root mean square, in the unit; next to nothing for a zero row, over which all is 0."""
        mean = self.mean(places)
        square = mean * mean + self.variance().of(places)
        return square.max(NEXT_TO_NOTHING).sqrt()

    def in_volts(self, value: Value, places: Sequence[int]) -> Part:
        """A quantity of the unit."""
        return Part(value * self.unit(places), places)

    def centroid_and_spread(self) -> tuple[Part, Part]:
        """Of spectra, in hertz.

        About the middle of the band, beside which neither is small, so that little cancels.
        """
        places = self.of_rows(("spectral_centroid", "spectral_spread"))
        middle = float(self._axis_hz.mean())
        half = max(float((self._axis_hz - middle).abs().max()), 1.0)
        place = (self._axis_hz - middle) / half
        powers = torch.stack([torch.ones_like(place), place, place.square()], dim=-1).numpy()
        sums = self.once(
            "sums", lambda: Part((self.values(places) @ powers).cast(F64), places)
        ).value
        total, first, second = (sums.slice(k, k + 1, 2).squeeze(2) for k in range(3))
        is_some = (total > 0.0).cast(F64)
        total = total.max(NEXT_TO_NOTHING)
        centre = first / total
        spread = (second / total - centre * centre).max(0.0).sqrt() * half
        return Part((centre * half + middle) * is_some, places), Part(spread, places)

    def with_mean(self, value: Value, places: Sequence[int]) -> Value:
        """Values less their mean, one of each row, with it again."""
        return value if self.rows.mean is None else value + self.mean(places)
