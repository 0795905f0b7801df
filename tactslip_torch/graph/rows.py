"""From raw windows to rows of order one: gauges, branches and spectra, as nodes of a graph."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Row
from tactslip_torch.features.pool import LARGEST_SAMPLE
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.maps import Block, Matrix, block, energy_matrix, filter_matrix
from tactslip_torch.graph.value import F64, TINY, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.detector import SlipDetector

EXACT = frozenset({"mode", "entropy"})
"""Descriptors that step: two roundings of one value may differ by a whole step."""
SPAN_OF_LENGTH = 0.35  # span of 100 centred values of length 1: from .2 (two levels) to 1.41
_LEAST_SPAN = 16 * float(np.finfo(np.float64).eps)  # guards.is_constant


class Rows(NamedTuple):
    """Rows of one length and dtype.

    Attributes:
        rows: which, in order; ``R`` of them.
        values: less their mean; of spectra as they are; of order one, ``[B, R, n]``.
        mean: in the unit, ``[B, R]``, float64; None for spectra.
        unit: by which values and mean are multiplied to be volts, ``[B, R]``, float64.
        scale: largest magnitude of the filtered bin, in the unit, ``[B, R]``, float64; or None.
        film: the filtered bin less its mean, of order one, ``[B, R, n]``; None for spectra.
    """

    rows: tuple[Row, ...]
    values: Value
    mean: Value | None
    unit: Value
    scale: Value | None
    film: Value | None


class _Scaled(NamedTuple):
    """Coordinates of all blocks of some channels brought to length one."""

    narrow: Value  # [B, c, sum of ranks], in the precision of the form
    exact: Value  # the same in float64
    length: Value  # [B, c, blocks]
    is_kept: Value  # [B, c, blocks], 1 or 0: not rounding beside its bin


@dataclass(frozen=True)
class _Channels:
    """Channels that share a frame and a kind, and their nodes; all in one unit a channel."""

    channels: tuple[int, ...]
    smooth: torch.Tensor
    shifted: Value  # [B, c, W + 1]
    unit: Value | None  # [B, c], in volts; None: everything is in volts
    moving: Value  # the filtered bin but for a constant, [B, c, n]
    scale: Value  # largest magnitude of the filtered bin, [B, c]
    blocks: Mapping[int, Block]  # by branch
    mean: Value | None  # of rows that are no spectra, over their length, [B, c, blocks]
    scaled: Mapping[bool, _Scaled]  # for spectra, or not


class Front:
    """The part of a graph that is linear: filter, branches, and spectra before their modulus.

    Args:
        graph: to which nodes are added.
        detector: whose plan.
        windows: raw samples of the channels in use, ``[B, channels, Window.length]``.
        form: precision.

    Attributes:
        is_missing: ``[B, channels]``, bool: a NaN or Inf is within the frame of the filter.
        is_trusted: ``[B, channels]``, bool: neither missing nor dead (``FeaturePool.validity``).
    """

    def __init__(self, graph: Graph, detector: SlipDetector, windows: Value, form: Form) -> None:
        self._graph = graph
        self._form = form
        self._plan = detector.extractor.plan
        self._maps = LinearMaps.of(detector.pool)
        self._detector = detector
        self.window = Window.of(detector)
        stepping = (self._plan.rows[row] for row in self._plan.rows_for(*EXACT))
        self._stepping = {(row.branch, row.kind == "freq") for row in stepping}
        self._missing: list[Value] = []
        self._trusted: list[Value] = []
        frames: dict[tuple[int, bool], list[int]] = {}
        films = set(detector.pool.hand.fast)
        lengths = detector.channel_filter.window_lengths
        for channel in self.window.channels:
            frames.setdefault((lengths[channel], channel in films), []).append(channel)
        self._groups = [self._make(tuple(channels), windows) for channels in frames.values()]
        self._of = {channel: group for group in self._groups for channel in group.channels}
        self._order = [channel for group in self._groups for channel in group.channels]
        places = [self._order.index(channel) for channel in self.window.channels]
        self.is_missing, self.is_trusted = (
            _taken(graph.concat(*parts, axis=1), places, places)
            for parts in (self._missing, self._trusted)
        )

    def of(
        self, rows: Sequence[Row], *, exact: bool, with_scale: bool = False, with_film: bool = False
    ) -> Rows:
        """Rows of one length: gauges and branches, or spectra; in an order of their own.

        Args:
            rows: which.
            exact: in float64 whatever the form.
            with_scale: whether ``scale`` is wanted.
            with_film: whether ``film`` is wanted.
        """
        graph, is_freq = self._graph, rows[0].kind == "freq"
        dtype = F64 if exact else self._form.dtype
        ordered = sorted(rows, key=lambda row: (self._place(row), row.channel))
        parts = [list(own) for _, own in itertools.groupby(ordered, self._place)]
        values = [self._values(own, dtype) for own in parts]
        made = [graph.concat(*each, axis=1) for each in zip(*values, strict=True)]
        if is_freq:
            real, imaginary = made
            made = [(real * real + imaginary * imaginary).sqrt()]
        length = self._cells(ordered, lambda group: group.scaled[is_freq].length)
        scale = film = None
        if with_scale:
            scale = self._of_channels(ordered, lambda group: group.scale) / length
        if with_film and not is_freq:
            film = self._films(ordered, dtype)
        mean = None if is_freq else self._cells(ordered, lambda group: group.mean)
        unit = length
        if self._form.dtype == F64:
            unit = unit * self._of_channels(ordered, lambda group: group.unit)
        return Rows(tuple(ordered), made[0], mean, unit, scale, film)

    def shares(self, channel: int, branches: Sequence[int]) -> Value:
        """Shares of branches in the energy of all spectra of a film, ``[B, branches]``."""
        group = self._of[channel]
        matrix, ranks = energy_matrix(self._maps, group.smooth, branches)
        place = group.channels.index(channel)
        own = group.shifted.slice(place, place + 1, 1).squeeze(1)
        parts = (own.cast(self._form.dtype) @ matrix).cast(F64)  # whose squares may leave float32
        of_branch: Matrix = np.repeat(np.eye(len(ranks)), ranks, axis=0)
        energies = (parts * parts) @ of_branch
        total = energies.slice(0, 1, 1).max(TINY)
        return energies.slice(1, len(ranks), 1) / total

    def _place(self, row: Row) -> tuple[int, int]:
        """Of a row's block among all."""
        return self._groups.index(self._of[row.channel]), row.branch

    def _values(self, rows: Sequence[Row], dtype: np.dtype[Any]) -> tuple[Value, ...]:
        """Of rows of one block: values, or the two parts of spectra."""
        group, branch, is_freq = self._of[rows[0].channel], rows[0].branch, rows[0].kind == "freq"
        start = sum(each.rank + 1 for key, each in group.blocks.items() if key < branch)
        shape, scaled = group.blocks[branch], group.scaled[is_freq]
        source = scaled.narrow if dtype == self._form.dtype else scaled.exact
        own = source.slice(start, start + shape.rank + is_freq, 2)
        chosen = _taken(own, [group.channels.index(row.channel) for row in rows], group.channels)
        maps = (shape.cosine, shape.sine) if is_freq else (shape.out,)
        kept = F64 if (branch, is_freq) in self._stepping else dtype  # one copy for both
        return tuple(
            chosen if each is None else chosen @ self._graph.constant(each, kept).cast(dtype)
            for each in maps
        )

    def _cells(self, rows: Sequence[Row], of: Callable[[_Channels], Value | None]) -> Value:
        """What there is one of per channel and block, of each row, ``[B, R]``."""
        tables, cells = list[Value](), list[tuple[int, int]]()
        for group in self._groups:
            is_asked = any(row.channel in group.channels for row in rows)
            if is_asked and (table := of(group)) is not None:
                cells += itertools.product(group.channels, group.blocks)
                tables.append(table.reshape(0, len(group.channels) * len(group.blocks)))
        places = [cells.index((row.channel, row.branch)) for row in rows]
        return _taken(self._graph.concat(*tables, axis=1), places, cells)

    def _of_channels(self, rows: Sequence[Row], of: Callable[[_Channels], Value | None]) -> Value:
        """What there is one of per channel, of each row, ``[B, R]``."""
        tables = [table for group in self._groups if (table := of(group)) is not None]
        whole = self._graph.concat(*tables, axis=1)
        return whole.take([self._order.index(row.channel) for row in rows], 1)

    def _films(self, rows: Sequence[Row], dtype: np.dtype[Any]) -> Value:
        """Filtered bins of rows less their mean, of order one; 0 where that is rounding."""
        places = [self._order.index(row.channel) for row in rows]
        film = self._graph.concat(*(group.moving for group in self._groups), axis=1)
        film = film.take(places, 1).cast(F64)
        centred = film - film.mean(2, keep=True)
        size = centred.abs().amax(2, keep=True)
        scale = self._of_channels(rows, lambda group: group.scale).expand(2)
        least = (scale * (_LEAST_SPAN / 2)).max(TINY)
        kept = (size >= least).cast(F64) / size.max(least)
        return (centred * kept).cast(dtype)

    def _make(self, channels: tuple[int, ...], windows: Value) -> _Channels:
        """The nodes of channels that share a frame."""
        graph, num, used = self._graph, self.window.bin, self.window.channels
        before, after = self._detector.channel_filter.reaches[channels[0]]
        x = _taken(windows, [used.index(channel) for channel in channels], used)
        if (before, after) != (self.window.before, self.window.after):
            start = self.window.before - before
            x = x.slice(start, start + before + num + after, 2)
        unit = None
        if self._form.dtype == F64:  # whose squares float64 does not hold
            unit = x.abs().amax(2, keep=True).max(TINY)
            x = x / unit
        smooth = filter_matrix(self._detector.channel_filter, channels[0], num)
        first = x.slice(before, before + 1, 2)
        moving = (x - first).cast(self._form.dtype) @ smooth.T.numpy()
        filtered = moving + first.cast(self._form.dtype)
        scale = self._judge(channels, filtered, unit)
        first = first.cast(F64)
        shifted = graph.concat(x.cast(F64) - first, first, axis=2)
        rows = [row for row in self._plan.rows if row.channel in channels]
        own = {
            branch: block(branch, self._maps, smooth)
            for branch in sorted({row.branch for row in rows})
        }
        mean, scaled = None, dict[bool, _Scaled]()
        if own:
            coordinates = shifted @ np.concatenate([each.into for each in own.values()], axis=1)
            for is_freq in sorted({row.kind == "freq" for row in rows}):
                scaled[is_freq] = self._scaled(coordinates, own, scale, is_freq)
        if False in scaled:
            mean = self._mean(coordinates, own, scaled[False])
        unit = None if unit is None else unit.squeeze(2)
        return _Channels(channels, smooth, shifted, unit, moving, scale, own, mean, scaled)

    def _judge(self, channels: tuple[int, ...], filtered: Value, unit: Value | None) -> Value:
        """Which channels can be trusted, by what sensors resolve; and the largest magnitudes."""
        high, low = filtered.amax(2), filtered.amin(2)
        scale = high.max(-low)
        probe = filtered.slice(0, 1, 2).squeeze(2)  # NaN if anything in the window is no number
        probe = scale + (probe - probe)
        largest = min(LARGEST_SAMPLE, float(np.finfo(self._form.dtype).max))
        is_known = (probe if unit is None else probe * unit.squeeze(2)) <= largest
        like = torch.empty(0, dtype=torch.float64 if self._form.dtype == F64 else torch.float32)
        inverse = self._detector.pool.inverse_span(like)[list(channels)].numpy()
        is_alive = (high - low) * self._graph.constant(inverse, self._form.dtype) > scale
        self._missing.append(~is_known)
        self._trusted.append(is_alive & is_known)
        return scale.cast(F64)

    def _scaled(
        self, coordinates: Value, own: Mapping[int, Block], scale: Value, with_mean: bool
    ) -> _Scaled:
        """Coordinates of length one, and 0 of blocks that are rounding beside their bin.

        Args:
            coordinates: of all blocks, ``[B, c, sum of ranks + 1]``.
            own: the blocks.
            scale: largest magnitude of the filtered bin, ``[B, c]``.
            with_mean: whether the length is that of the branch in full.
        """
        length = ((coordinates * coordinates) @ _of_block(own, mean=with_mean)).sqrt()
        least = (scale * (_LEAST_SPAN / SPAN_OF_LENGTH)).max(TINY).expand(2)
        is_kept = (length >= least).cast(F64)
        length = length.max(least)
        exact = coordinates * ((is_kept / length) @ _of_block(own, mean=True).T)
        return _Scaled(exact.cast(self._form.dtype), exact, length, is_kept)

    def _mean(self, coordinates: Value, own: Mapping[int, Block], scaled: _Scaled) -> Value:
        """Means over lengths, ``[B, c, blocks]``; of details 0 where the rest is."""
        mean_alone = _of_block(own, mean=True) - _of_block(own, mean=False)
        mean = coordinates @ (mean_alone / math.sqrt(self.window.bin)) / scaled.length
        if any(each.is_detail for each in own.values()):
            stays = [float(not each.is_detail) for each in own.values()]
            mean = mean * scaled.is_kept.max(self._graph.constant(stays, F64))
        return mean


def _of_block(own: Mapping[int, Block], *, mean: bool) -> Matrix:
    """Which coordinate is of which block, with or without their means, ``[.., blocks]``."""
    widths = [each.rank + 1 for each in own.values()]
    matrix: Matrix = np.repeat(np.eye(len(own)), widths, axis=0)
    if not mean:
        matrix[np.cumsum(widths) - 1] = 0.0
    return matrix


def _taken(value: Value, places: Sequence[int], of: Sequence[Any]) -> Value:
    """Entries of the second axis, which is ``of``; all of them in order as they are."""
    return value if list(places) == list(range(len(of))) else value.take(places, 1)
