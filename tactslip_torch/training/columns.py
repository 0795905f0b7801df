"""The columns of a view: which features, how pooled, compressed, clipped and scaled.

Three views look at the same bins. ``simple``: five statistics of the filtered bin of each channel,
as they are and as logarithms. ``channel``: descriptors of each channel's branches and spectra,
compressed mildly and strongly. ``pooled``: statistics of those over the channels of a kind, both
ways. All of it is learned without labels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.sensing import Sensing, SpanFeatures
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.scaling import FeatureScaler

VIEWS = ("simple", "channel", "pooled")
TAIL = 0.01
"""Part of the training bins beyond the scaled range on either side; they are clipped."""
MILD, STRONG = 1.0, 0.01
"""Compression scales of descriptors, as parts of the training median of their size."""
LINEAR, LOGARITHM = 1e6, 1e-3
"""The same of simple statistics: so large that nothing is compressed, so small that nearly all is a
logarithm."""
_ROWS = 1024  # scaled at a time


@dataclass(frozen=True)
class FeatureSelection:
    """Which features, and how they are scaled.

    Args:
        selected: indices of the features that are read.
        scaler: of the columns, each of which may be scaled more than once.
        pooling: from those features to the columns; ``None``: they are the columns.
        silence: what tells which channels are silent, and what is known of them; they are lost.
            ``None``: none is.
        channel: of each scaled column, ``[S]``; one past the last for a pooled one. ``None``: lost
            channels are not filled.
        fill: scaled columns of lost channels, ``[S]``.
        names: of the features that are read, where selections are to be joined.
    """

    selected: tuple[int, ...]
    scaler: FeatureScaler
    pooling: ChannelPooling | None = None
    silence: tuple[SpanFeatures, Sensing] | None = None
    channel: Tensor | None = None
    fill: Tensor | None = None
    names: tuple[FeatureName, ...] = ()

    @property
    def size(self) -> int:
        """Number of scaled columns, S."""
        return len(self.scaler.minimum)

    @property
    def column_names(self) -> list[FeatureName]:
        """What each scaled column is of, S names."""
        names = self.names if self.pooling is None else self.pooling.names
        assert self.scaler.columns is not None  # view_columns
        return [names[column] for column in self.scaler.columns.tolist()]

    def __call__(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """Scaled columns in float64, ``[N, F] -> [N, S]``, without lost channels ``[N, C]``."""
        if self.silence is not None:
            spans, sensing = self.silence
            silent = spans.is_silent(spans(features), sensing)
            is_lost = silent if is_lost is None else silent | is_lost
        columns = features[:, list(self.selected)].double()
        if self.pooling is not None:
            columns = self.pooling(columns, is_lost)
        scaled: Tensor = self.scaler(columns)
        if is_lost is None or self.channel is None or self.fill is None:
            return scaled
        pooled = torch.zeros_like(is_lost[:, :1])  # a pooled column is of the other channels
        return torch.where(torch.cat([is_lost, pooled], 1)[:, self.channel], self.fill, scaled)

    def in_parts(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """The same of many bins, in little memory beside the result."""
        made = torch.empty(len(features), self.size, dtype=torch.float64)
        for rows in torch.arange(len(features)).split(_ROWS):
            made[rows] = self(features[rows], None if is_lost is None else is_lost[rows])
        return made

    def take(self, places: Sequence[int]) -> FeatureSelection:
        """The selection of some of the scaled columns, which reads no more than they need."""
        scaler, index = self.scaler, torch.tensor(places)
        columns = index if scaler.columns is None else scaler.columns[index]
        used, place = columns.unique(return_inverse=True)
        parts = (scaler.minimum, scaler.maximum, scaler.compression)
        minimum, maximum, compression = (p if p is None else p[index] for p in parts)
        assert minimum is not None
        assert maximum is not None
        own = FeatureScaler(minimum, maximum, compression, place)
        pooling, names = None, tuple(self.names[i] for i in used.tolist() if self.pooling is None)
        if self.pooling is not None:
            pooling = self.pooling.select(used.tolist())
            names = pooling.inputs
        of_name = dict(zip(self.names, self.selected, strict=True))
        selected = tuple(of_name[name] for name in names)
        rest = {name: value[index] for name in ("channel", "fill")
                if (value := getattr(self, name)) is not None}  # fmt: skip
        return replace(self, selected=selected, names=names, scaler=own, pooling=pooling, **rest)


def view_columns(
    view: str,
    hand: HandLayout,
    known: Sequence[FeatureName],
    spans: SpanFeatures,
    allowed: Tensor,
    features: Tensor,
    weights: Tensor,
    pooling: str | Sequence[str] | None,
) -> FeatureSelection:
    """All columns of a view, learned from training bins.

    Args:
        view: one of ``VIEWS``.
        hand: the channels.
        known: names of the features of the bins.
        spans: of these features.
        allowed: which of them the view may use, ``[F]``, bool.
        features: of the bins.
        weights: of the bins, for the means that stand for lost channels.
        pooling: statistics over channels, for the view ``pooled``.

    Shape:
        - features: ``[N, F]``; weights: ``[N]``

    Raises:
        ValueError: as ``ChannelPooling.fit``.
    """
    span = spans(features)
    silence = spans, Sensing.fit(span, 1, 1)
    is_lost = spans.is_silent(span, silence[1])
    places = allowed.nonzero()[:, 0].tolist()
    names = [known[place] for place in places]
    layer, x, inputs = None, features[:, places], tuple(names)
    if view == "pooled":
        assert pooling is not None  # General
        layer = ChannelPooling.fit(hand, names, x, pooling, is_lost)
        of_name = dict(zip(names, places, strict=True))
        inputs, places = layer.inputs, [of_name[name] for name in layer.inputs]
        x, names = layer(features[:, places].double(), is_lost), list(layer.names)
    x = x.double()
    if view == "simple":
        level = torch.tensor([name.descriptor != "mean" for name in names]).nonzero()[:, 0]
        columns = torch.cat([torch.arange(len(names)), level])
        scalers = [_widened(FeatureScaler.fit(x, compress=LINEAR)),
                   _widened(FeatureScaler.fit(x[:, level], compress=LOGARITHM))]  # fmt: skip
    else:
        columns = torch.arange(len(names)).repeat(2)
        scalers = [FeatureScaler.fit(x, compress=share, tail=TAIL) for share in (MILD, STRONG)]
    scaler = FeatureScaler(
        torch.cat([each.minimum for each in scalers]),
        torch.cat([each.maximum for each in scalers]),
        torch.cat([each.compression for each in scalers if each.compression is not None]),
        columns,
    )
    place = {name: index for index, name in enumerate(hand.names)}
    channel = torch.tensor([place.get(name.channel, len(place)) for name in names])[columns]
    selection = FeatureSelection(tuple(places), scaler, layer, silence, channel, names=inputs)
    fill = (weights @ selection.in_parts(features)) / weights.sum()
    return replace(selection, fill=fill)


def _widened(scaler: FeatureScaler) -> FeatureScaler:
    """A scaler that clips only what lies beyond the range of training by its width."""
    width = scaler.maximum - scaler.minimum
    return FeatureScaler(scaler.minimum - width, scaler.maximum + width, scaler.compression)


def joined(selections: Sequence[FeatureSelection]) -> FeatureSelection:
    """One selection with the scaled columns of several, in their order; one may have pools."""
    if len(selections) == 1:
        return selections[0]
    names = dict[int, FeatureName]()
    for each in selections:
        if each.pooling is None:
            names |= zip(each.selected, each.names, strict=True)
    place = {selected: index for index, selected in enumerate(names)}
    layer, selected, columns = None, tuple(names), list[Tensor]()
    for each in selections:
        own = each.scaler.columns
        assert own is not None  # view_columns
        if each.pooling is None:
            columns.append(torch.tensor([place[index] for index in each.selected])[own])
        else:
            layer = each.pooling.with_channels(list(names.values()))
            of_name = dict(zip(each.names, each.selected, strict=True))
            of_name |= {name: index for index, name in names.items()}
            selected = tuple(of_name[name] for name in layer.inputs)
            columns.append(own + len(names))

    def of(get: Callable[[FeatureSelection], Tensor | None]) -> Tensor:
        return torch.cat([found for each in selections if (found := get(each)) is not None])

    scaler = FeatureScaler(
        of(lambda each: each.scaler.minimum),
        of(lambda each: each.scaler.maximum),
        of(lambda each: each.scaler.compression),
        torch.cat(columns),
    )
    return replace(
        selections[0],
        selected=selected,
        names=tuple(names.values()),
        scaler=scaler,
        pooling=layer,
        channel=of(lambda each: each.channel),
        fill=of(lambda each: each.fill),
    )
