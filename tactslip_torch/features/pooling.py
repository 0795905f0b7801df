"""Pooling over channels: statistics of each descriptor over all channels of a kind.

One layer over features that any backend has made, before scaling and head:

    y_c = k sign(x_c) log(1 + |x_c| / k),    pooled = statistic of y_c over the channels c in use

with ``k`` the training median of ``|x|`` of the descriptor. Channels that are lost (missing or
silent, ``features.sensing``) are left out of their pools.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tactslip_torch import native
from tactslip_torch.features.descriptors import FeatureName, like, root
from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import (
    are_unchanged,
    ascending,
    for_each,
    is_concrete,
    signed_log,
    stamps_of,
)

STATISTICS = ("mean", "std", "min", "max", "median")
SORTED = "sorted"
"""In place of a list of statistics: the values in ascending order, ``rank1`` to ``rankN``."""
CHUNK_BINS = 2048  # whose features are pooled at a time
_RANK = re.compile(r"rank([1-9]\d*)")


def over_channels(
    values: Tensor, in_use: Tensor, statistics: Sequence[str], num_channels: int
) -> list[Tensor]:
    """Statistics over the last axis, of the entries in use; 0 where none is.

    Written in operations that tensors and the values of an ONNX graph share.

    Args:
        values: of each row and channel; finite where in use.
        in_use: which channels count, bool.
        statistics: of ``STATISTICS``, or ranks, ``rank1`` being the smallest. With channels left
            out, ranks are spread evenly over those that remain.
        num_channels: length of the last axis.

    Shape:
        - values: ``[*, R, m]``; in_use: ``[*, 1, m]``
        - output: one ``[*, R]`` for each statistic
    """
    present = in_use.type_as(values)
    num = present.sum(-1, keepdim=True)  # [*, 1, 1]
    known = torch.where(in_use, values, 0.0)
    mean = known.sum(-1, keepdim=True) / num.clamp(min=1.0)
    away = (known - mean) * present  # a channel that is not in use stands at the mean
    places = like(torch.arange(num_channels).double(), values)
    ordered = None
    found = []
    for statistic in statistics:
        if statistic == "mean":
            found.append(mean.sum(-1))
        elif statistic == "std":
            found.append(root((away * away).sum(-1) / (num - 1.0).clamp(min=1.0).sum(-1)))
        elif statistic == "min":
            found.append(away.amin(-1) + mean.sum(-1))
        elif statistic == "max":
            found.append(away.amax(-1) + mean.sum(-1))
        else:
            if ordered is None:  # those not in use come last
                ordered = torch.where(in_use, values, known.amax(-1, keepdim=True))
                ordered = ascending(ordered, num_channels)
            position = (num - 1.0) * _fraction(statistic, num_channels)
            weight = (1.0 - (position - places).abs()).clamp(min=0.0)  # linear interpolation
            found.append((ordered * weight).sum(-1))
    return found


def _fraction(statistic: str, num_channels: int) -> float:
    """Where an order statistic lies among ascending values, from 0 to 1."""
    if statistic == "median":
        return 0.5
    rank = _RANK.fullmatch(statistic)
    assert rank is not None  # checked when the layer was made
    return (int(rank[1]) - 1) / max(num_channels - 1, 1)


def statistics_of(setting: str | Sequence[str], num_channels: int) -> tuple[str, ...]:
    """The statistics that ``features.pooling`` asks for, of a kind with so many channels.

    One channel alone has only its value: the mean.

    Raises:
        ValueError: for an unknown statistic, or none.
    """
    if setting == SORTED:
        return tuple(f"rank{number}" for number in range(1, num_channels + 1))
    listed = [setting] if isinstance(setting, str) else list(setting)
    unknown = [name for name in listed if name not in STATISTICS]
    if unknown or not listed:
        raise ValueError(
            f"features.pooling must be {SORTED}, null or some of {', '.join(STATISTICS)}, got "
            f"{setting!r}"
        )
    return tuple(dict.fromkeys(listed)) if num_channels > 1 else ("mean",)


def _pooled_names(
    hand: HandLayout, names: Sequence[FeatureName], setting: str | Sequence[str]
) -> tuple[FeatureName, ...]:
    """What pooling makes of features: each descriptor of a kind, by statistic.

    Raises:
        ValueError: as ``statistics_of``.
    """
    found = []
    for kind, channels in _channels_by_kind(hand).items():
        of_first = [name for name in names if name.channel == hand.names[channels[0]]]
        for statistic in statistics_of(setting, len(channels)):
            found += [
                FeatureName(kind, name.component, name.domain, name.descriptor, statistic)
                for name in of_first
            ]
    return tuple(found)


class ChannelPooling(nn.Module):
    """Columns for scaling and head: pooled features, and features of channels as they are.

    Args:
        hand: the channels.
        names: what comes out, K features, pooled or of channels.
        compression: compression scales ``k``, one for each of ``families``.
        fill: what a pooled column is where no channel of its kind is in use; others are not read.

    Attributes:
        names: of the columns.
        inputs: names of the M features of channels that go in.
        kinds: of the channels that are pooled.
        families: descriptors that are pooled, as names without statistic, kind by kind.

    Shape:
        - compression: ``[families]``; fill: ``[K]``

    Raises:
        ValueError: if shapes disagree or a value is not finite, or a name is unknown.
    """

    compression: Tensor
    fill: Tensor

    def __init__(
        self, hand: HandLayout, names: Sequence[FeatureName], compression: Tensor, fill: Tensor
    ) -> None:
        super().__init__()
        self.hand, self.names = hand, tuple(names)
        by_kind = _channels_by_kind(hand)
        pooled = [name for name in self.names if name.is_pooled]
        self.kinds = tuple(kind for kind in by_kind if any(n.channel == kind for n in pooled))
        if strangers := {name.channel for name in pooled} - set(self.kinds):
            raise ValueError(f"no channel of this hand is of kind {sorted(strangers)[0]!r}")
        if len(set(self.names)) < len(self.names):
            raise ValueError("a column is named twice; name each once")
        for name in pooled:
            if not (name.statistic in STATISTICS or _RANK.fullmatch(name.statistic)):
                raise ValueError(f"unknown statistic over channels in {str(name)!r}")
        self.families = _families(self.kinds, pooled)
        shapes = [tuple(each.shape) for each in (compression, fill)]
        wanted = [(len(self.families),), (len(self.names),)]
        if shapes != wanted:
            raise ValueError(f"expected compression and fill of shapes {wanted}, got {shapes}")
        if not bool((compression > 0).all() & compression.isfinite().all() & fill.isfinite().all()):
            raise ValueError("pooling constants must be finite and scales positive; fit again")
        self.register_buffer("compression", compression.double().clone())
        self.register_buffer("fill", fill.double().clone())
        self._lay_out(by_kind)

    def _lay_out(self, by_kind: Mapping[str, tuple[int, ...]]) -> None:
        """Which inputs there are, and what is made of which."""
        singles = [name for name in self.names if not name.is_pooled]
        members = {
            family: [replace(family, channel=self.hand.names[c]) for c in by_kind[family.channel]]
            for family in self.families
        }
        taken = [*singles, *(name for own in members.values() for name in own)]
        self.inputs = tuple(dict.fromkeys(taken))
        place = {name: index for index, name in enumerate(self.inputs)}
        groups, made = [], list(singles)
        for kind in self.kinds:
            own = [i for i, family in enumerate(self.families) if family.channel == kind]
            statistics = dict.fromkeys(
                n.statistic for n in self.names if n.channel == kind and n.is_pooled
            )
            groups.append(
                _PooledKind(
                    channels=by_kind[kind],
                    families=tuple(own),
                    columns=tuple(place[n] for i in own for n in members[self.families[i]]),
                    statistics=tuple(statistics),
                )
            )
            made += [replace(self.families[i], statistic=s) for s in statistics for i in own]
        self.groups = tuple(groups)
        self.singles = tuple(place[name] for name in singles)
        column = {name: index for index, name in enumerate(made)}
        self.order = tuple(column[name] for name in self.names)
        self.kind_of = tuple(
            self.kinds.index(name.channel) if name.is_pooled else len(self.kinds)
            for name in self.names
        )
        self._engine: tuple[native.Machine, Any] | None = None

    @classmethod
    def fit(
        cls,
        hand: HandLayout,
        names: Sequence[FeatureName],
        features: Tensor,
        setting: str | Sequence[str],
        is_lost: Tensor | None = None,
    ) -> ChannelPooling:
        """Pool all features of training bins; the columns are the pooled features alone.

        Args:
            hand: the channels.
            names: of the features, F; all channels of a kind have the same descriptors.
            features: of training bins.
            setting: ``"sorted"`` or statistics, as ``features.pooling`` has them.
            is_lost: channels that are left out of their bins; default: none.

        Shape:
            - features: ``[N, F]``, at least one bin, finite; is_lost: ``[N, C]``, bool

        Raises:
            ValueError: as ``statistics_of``.
        """
        pooled = _pooled_names(hand, names, setting)
        place = {name: index for index, name in enumerate(names)}
        layer = cls(
            hand, pooled, torch.ones(len(set(map(_family, pooled)))), torch.zeros(len(pooled))
        )
        inputs = torch.tensor([place[name] for name in layer.inputs])
        for group in layer.groups:
            values = features[:, inputs[list(group.columns)]].double().abs()
            values = values.unflatten(1, (-1, len(group.channels)))
            if is_lost is not None:
                lost = is_lost[:, None, list(group.channels)]
                values = values.masked_fill(lost, torch.nan)
            layer.compression[list(group.families)] = _compression_scales(
                values.transpose(0, 1).flatten(1)
            )
        parts = torch.arange(len(features)).split(CHUNK_BINS)
        columns = [
            layer(features[part][:, inputs].double(), None if is_lost is None else is_lost[part])
            for part in parts
        ]
        layer.fill.copy_(torch.cat(columns).median(0).values)
        return layer

    def forward(
        self,
        features: Tensor,
        is_lost: Tensor | None = None,
        backend: native.BackendName = "auto",
    ) -> Tensor:
        """Columns of bins.

        Differentiable; a channel that is left out has no gradient. By the native engine where only
        values are asked for, as ``FeaturePool`` has it; the two agree to 1e-13.

        Shape:
            - features: ``[*, M]``, of ``inputs``, float32 or float64
            - is_lost: ``[*, C]``, bool, channels that are left out; default: none
            - output: ``[*, K]``; NaN where a feature of a channel in use is NaN
        """
        if features.shape[-1] != len(self.inputs):
            raise ValueError(f"expected {len(self.inputs)} features, got {features.shape[-1]}")
        given = [x for x in (features, is_lost, *self.buffers()) if x is not None]
        if all(map(is_concrete, given)) and native.backend_of(backend) == "native":
            return self._by_native(features.detach(), is_lost)
        if is_lost is None:
            is_lost = torch.zeros(len(self.hand), dtype=torch.bool, device=features.device)
            is_lost = is_lost.expand(*features.shape[:-1], -1)
        parts, is_some = [features[..., list(self.singles)]], []
        for group in self.groups:
            in_use = ~is_lost[..., list(group.channels)]
            is_some.append(in_use.any(-1))
            num_channels = len(group.channels)
            values = features[..., list(group.columns)].unflatten(-1, (-1, num_channels))
            values = signed_log(values, self.compression[list(group.families), None].to(features))
            parts += over_channels(values, in_use[..., None, :], group.statistics, num_channels)
        columns = torch.cat(parts, dim=-1)[..., list(self.order)]
        known = torch.stack([*is_some, torch.ones_like(is_some[0])], -1)[..., list(self.kind_of)]
        return torch.where(known, columns, self.fill.to(features))

    def _by_native(self, features: Tensor, is_lost: Tensor | None) -> Tensor:
        with torch.inference_mode(False), torch.no_grad():
            buffers = [self.compression, self.fill]
            if self._engine is None or not are_unchanged(buffers, self._engine[1]):
                self._engine = self.machine(), stamps_of(buffers)
            machine = self._engine[0]
            flat = features.reshape(-1, features.shape[-1]).contiguous().numpy()
            found = torch.empty(len(flat), len(self.names), dtype=features.dtype, device="cpu")
            masks = None
            if is_lost is not None:
                shape = (*features.shape[:-1], len(self.hand))
                masks = is_lost.bool().expand(shape).reshape(-1, shape[-1]).numpy()

            def work(start: int) -> None:
                some = slice(start, start + CHUNK_BINS)
                columns = machine.columns(flat[some], None if masks is None else masks[some])
                found[some] = torch.from_numpy(columns)

            for_each(work, range(0, len(flat), CHUNK_BINS))
            return found.reshape(*features.shape[:-1], len(self.names))

    def machine(self, **more: Any) -> native.Machine:
        """The native engine of the layer and of what follows it, ``scaling`` and ``head``."""
        column = {made: index for index, made in enumerate(self.order)}
        pools, first = [], len(self.singles)
        for group in self.groups:
            num, shape = len(group.channels), (len(group.statistics), len(group.families))
            own = range(first, first := first + shape[0] * shape[1])
            pools.append(
                native.Pool(
                    channels=group.channels,
                    inputs=np.reshape(group.columns, (-1, num)),
                    statistics=[
                        _fraction(s, num) if s == "median" or _RANK.fullmatch(s) else s
                        for s in group.statistics
                    ],
                    columns=np.reshape([column.get(made, -1) for made in own], shape),
                    scales=self.compression[list(group.families)].cpu().numpy(),
                )
            )
        return native.Machine(
            num_channels=len(self.hand),
            num_inputs=len(self.inputs),
            num_columns=len(self.names),
            singles=[(place, column[made]) for made, place in enumerate(self.singles)],
            pools=pools,
            fill=self.fill.cpu().numpy(),
            **more,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without the engine, which holds addresses."""
        return {**self.__dict__, "_engine": None}

    def select(self, index: Sequence[int]) -> ChannelPooling:
        """The layer of some of its columns, in that order; it takes no more than they need."""
        names = [self.names[i] for i in index]
        return self._with(names, self.fill[list(index)])

    def with_channels(self, names: Sequence[FeatureName]) -> ChannelPooling:
        """The layer whose columns are these features of channels as they are, then its own."""
        return self._with(
            [*names, *self.names], torch.cat([self.fill.new_zeros(len(names)), self.fill])
        )

    def _with(self, names: Sequence[FeatureName], fill: Tensor) -> ChannelPooling:
        pooled = [name for name in names if name.is_pooled]
        kinds = [kind for kind in self.kinds if any(name.channel == kind for name in pooled)]
        families = [self.families.index(family) for family in _families(kinds, pooled)]
        return ChannelPooling(self.hand, names, self.compression[families], fill)

    def to_dict(self) -> dict[str, Any]:
        """Names of the columns as JSON-able rows; ``from_dict`` takes them with the tensors."""
        return {"names": [astuple(name) for name in self.names]}

    @classmethod
    def from_dict(
        cls, hand: HandLayout, plain: Mapping[str, Any], tensors: Mapping[str, Tensor]
    ) -> ChannelPooling:
        """The layer that ``to_dict`` and ``state_dict`` described."""
        return cls(hand, [FeatureName(*row) for row in plain["names"]], **tensors)


@dataclass(frozen=True)
class _PooledKind:
    """What is pooled over the channels of one kind.

    Attributes:
        channels: indices in the hand, m of them.
        families: places of its descriptors in ``ChannelPooling.families``, R of them.
        columns: of the inputs, ``R * m``: each descriptor of all channels, one after the other.
        statistics: over the channels.
    """

    channels: tuple[int, ...]
    families: tuple[int, ...]
    columns: tuple[int, ...]
    statistics: tuple[str, ...]


def _channels_by_kind(hand: HandLayout) -> dict[str, tuple[int, ...]]:
    return {kind: hand.indices(kind) for kind in hand.kinds}


def _families(kinds: Sequence[str], pooled: Sequence[FeatureName]) -> tuple[FeatureName, ...]:
    """The descriptors that are pooled, kind by kind."""
    own = (_family(name) for kind in kinds for name in pooled if name.channel == kind)
    return tuple(dict.fromkeys(own))


def _family(name: FeatureName) -> FeatureName:
    """A descriptor of a kind, whatever the statistic."""
    return replace(name, statistic="")


def _compression_scales(sizes: Tensor) -> Tensor:
    """Median of each row without NaN; its largest where that is 0, and 1 where that is 0 too."""
    middle = sizes.nanmedian(-1).values.nan_to_num(0.0)
    largest = sizes.nan_to_num(0.0).amax(-1)
    found = torch.where(middle > 0, middle, largest)
    return torch.where(found > 0, found, 1.0)
