"""Branches that are constant to rounding, whose spectra are then those of a constant.

A span below 16 eps of the raw bin's size is rounding (``guards.is_constant``): a detail counts as
0, an approximation as its mean. Where a branch is a row its span is known. Where only its spectrum
is wanted it is not formed; a weighted sum of it, no larger than its span, tells in nearly all bins
that it is not constant, and the few others are looked at exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.eager.forming import Forming, index_of
from tactslip_torch.features.eager.layout import Layout

Array = np.ndarray[Any, Any]
ROUNDING = 16 * torch.finfo(torch.float64).eps
"""Part of a raw bin's size below which a span is rounding."""
WATCH = 64.0
"""A watching sum so many times that, well above its own rounding, tells that the span is not."""


@dataclass
class Known:
    """What is known of branches in some bins.

    Args:
        constant: ``[rows, M]``, which rows in time are constant, though their film is not; none
            if no one is.
        mean: ``[rows, M]``, of rows in time with their offset.
        finest: ``[films, M]``, ``ROUNDING`` of the sizes of raw bins.
        suspicious: ``[films, M, watched]``; none if nothing is.
    """

    constant: Array | None
    mean: Array
    finest: Array
    suspicious: Array | None

    @property
    def is_plain(self) -> bool:
        """Whether no branch can be constant."""
        return self.constant is None and self.suspicious is None


class Constants:
    """Puts right spectra and energies of constant branches.

    Args:
        layout: what is formed.
    """

    def __init__(self, layout: Layout) -> None:
        self._linear, self._maps = layout.linear, layout.maps
        self._channels = index_of(layout.linear.films)
        self._watches = bool(layout.linear.watched)
        self._ones: Array = layout.maps.ones_lines.numpy()
        self._row_of = np.full((len(layout.maps.branches), len(layout.linear.films)), -1)
        self._film_of = np.zeros(layout.num_in_time, np.intp)
        for block in layout.linear.time:
            rows = range(layout.num_before + block.first, layout.num_before + block.stop)
            self._row_of[block.branch, list(block.films)] = rows
            self._film_of[rows] = block.films
        self._dense: dict[int, Tensor] = {}
        for branch in layout.linear.watched:
            matrix = layout.maps.dense[branch].T.clone()
            matrix[0] = 0.0  # where the first sample stands instead of a difference
            self._dense[branch] = matrix

    def known(self, forming: Forming, constant: Array | None, mean: Array, finest: Array) -> Known:
        """What there is to go by, once rows in time are taken in.

        Shape:
            - constant, mean: as ``Known``; finest: ``[C', M]``
        """
        finest = finest[self._channels]
        suspicious: Array | None = None
        if self._watches:
            suspicious = np.abs(forming.watch) < (finest * WATCH)[..., None]
            if not suspicious.any():
                suspicious = None
        if len(finest) and (constant is not None or suspicious is not None):
            # of a film that stands still all is right
            moves: Array = np.any(forming.bins[..., 1:], -1)
            constant = _somewhere(constant, moves[self._film_of])
            suspicious = _somewhere(suspicious, moves[..., None])
        return Known(constant, mean, finest, suspicious)

    def mend_spectra(self, forming: Forming, known: Known) -> None:
        """Replace lines of branches that are constant."""
        for block in self._linear.freq:
            which, value = self._found(forming, known, block.branch, list(block.films))
            if which.any():
                lines = forming.lines[block.first : block.stop]
                lines[which] = value[which][:, None] * self._ones

    def mend_energies(self, forming: Forming, known: Known) -> None:
        """Replace energies of branches that are constant."""
        for place, branch in enumerate(self._linear.energy_branches):
            films = list(self._linear.energy_films)
            which, value = self._found(forming, known, branch, films)
            forming.energies[..., place][which] = value[which] ** 2 * (self._ones**2).sum()

    def _found(
        self, forming: Forming, known: Known, branch: int, films: list[int]
    ) -> tuple[Array, Array]:
        """Whether a branch is constant, and the constant that stands for it, ``[films, M]``."""
        rows = self._row_of[branch, films]
        is_constant = np.zeros((len(films), known.finest.shape[1]), bool)
        value = np.zeros(is_constant.shape)
        formed = rows >= 0
        if known.constant is not None and formed.any():
            is_constant[formed] = known.constant[rows[formed]]
            value[formed] = known.mean[rows[formed]]
        if known.suspicious is not None and not formed.all():
            look = known.suspicious[films, :, self._linear.watched.index(branch)]
            some, bins = np.nonzero(look & ~formed[:, None])
            if len(some):
                place = np.asarray(films)[some]
                samples = forming.bins[place, bins]
                row = (torch.from_numpy(samples) @ self._dense[branch]).numpy()
                span = row.max(-1) - row.min(-1)
                is_constant[some, bins] = (span < known.finest[place, bins]) | (span == 0)
                value[some, bins] = row.mean(-1) + samples[:, 0]
        if not self._maps.is_approximation[branch]:
            value[...] = 0.0
        return is_constant, value


def _somewhere(mask: Array | None, other: Array) -> Array | None:
    """Where both hold; none if nowhere."""
    if mask is None:
        return None
    found: Array = mask & other
    return found if found.any() else None
