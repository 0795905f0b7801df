"""The features of a plan: rows are formed by linear maps, brought to order one, and described.

``make_plan`` finds which channels, branches and spectra some features need; ``Bank`` computes them,
on tensors as the reference, on values of an ONNX graph to write the graph. Filter and wavelet are
one matrix in float64; what is rounding beside its bin becomes exactly constant.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import (
    COMMON_DESCRIPTORS,
    DESCRIPTORS,
    SIMPLE_STATISTICS,
    SORTED,
    SPECTRUM_DESCRIPTORS,
    STEPPED,
    TIME_DESCRIPTORS,
    TINY,
    FeatureName,
    Rows,
    band_energy_ratios,
    like,
    root,
    taken,
)
from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import ascending, is_traced
from tactslip_torch.signals.wavelet import (
    SpectrumMethod,
    Wavelet,
    branch_matrix,
    branch_names,
    frequency_axis_hz,
    spectrum_matrix,
)

RowKind = Literal["raw", "time", "freq"]
ROW_KINDS: tuple[RowKind, ...] = ("raw", "time", "freq")


def pool_names(hand: HandLayout, level: int, *, is_paper: bool = False) -> tuple[FeatureName, ...]:
    """Names of all features of a hand: the paper's in its order, then what else there is.

    Args:
        hand: the channels.
        level: number of wavelet levels.
        is_paper: the paper's alone. The others are, by channel in the order of the hand, those of
            ``SIMPLE_STATISTICS`` that the paper does not have of it.
    """
    names = [
        FeatureName(hand.names[i], "raw", "time", descriptor)
        for i in hand.slow
        for descriptor in COMMON_DESCRIPTORS
    ]
    domains = (("time", TIME_DESCRIPTORS), ("freq", SPECTRUM_DESCRIPTORS))
    for channel in (hand.names[i] for i in hand.fast):
        names += [
            FeatureName(channel, f"{kind}{m}", domain, descriptor)
            for m in range(1, level + 1)
            for domain, descriptors in domains
            for kind in "AD"
            for descriptor in descriptors
        ]
        names += [
            FeatureName(channel, f"{kind}{m}", "freq", "band_energy_ratio")
            for kind in "AD"
            for m in range(1, level + 1)
        ]
    if not is_paper:
        known = set(names)
        simple = [
            FeatureName(channel, "raw", "time", descriptor)
            for channel in hand.names
            for descriptor in SIMPLE_STATISTICS
        ]
        names += [name for name in simple if name not in known]
    return tuple(names)


class _Row(NamedTuple):
    """Values that are described together: a channel's bin, or a fast one's branch or spectrum.

    Attributes:
        kind: which of the three.
        channel: index in the hand.
        branch: index in ``branch_names``; -1 for the bin.
    """

    kind: RowKind
    channel: int
    branch: int


class _Wanted(NamedTuple):
    """A descriptor of a row, and the column it goes to."""

    row: int
    descriptor: str
    place: int


class _Share(NamedTuple):
    """A band energy ratio of a fast channel, and the column it goes to."""

    channel: int
    branch: int
    place: int


@dataclass(frozen=True)
class Plan:
    """What has to be done for a set of features.

    Args:
        channels: indices in the hand of the channels that are read, ascending.
        rows: what is formed and described: bins, branches and spectra, each by channel and branch.
        wanted: descriptors, in the order of their columns.
        shares: band energy ratios, in the order of their columns. Their energies are of all
            branches of the channel, whether or not those are rows.
        num_features: number of columns.
    """

    channels: tuple[int, ...]
    rows: tuple[_Row, ...]
    wanted: tuple[_Wanted, ...]
    shares: tuple[_Share, ...]
    num_features: int

    @property
    def share_channels(self) -> tuple[int, ...]:
        """Fast channels of which band energy ratios are wanted, ascending."""
        return tuple(sorted({share.channel for share in self.shares}))


def make_plan(hand: HandLayout, level: int, names: Sequence[FeatureName | str]) -> Plan:
    """The least work for these features, which come out in this order.

    Args:
        hand: the channels, in the order in which bins hold them.
        level: number of wavelet levels.
        names: any features of the pool, as names or as their text; repeats are allowed.

    Raises:
        ValueError: if there is no name, or one is none of the pool.

    Example:
        >>> make_plan(HandLayout.paper24(), 4, ["PVDF3 A2 freq kurtosis"]).rows
        (_Row(kind='freq', channel=16, branch=2),)
    """
    known = {str(name): name for name in pool_names(hand, level)}
    if not names:
        raise ValueError("an empty selection, expected at least one feature; name some of the pool")
    unknown = [str(name) for name in names if str(name) not in known]
    if unknown:
        example = next(iter(known))
        raise ValueError(
            f"unknown feature {unknown[0]!r}, expected one of the pool's {len(known)} names, such "
            f"as {example!r}; pool.names lists them"
        )
    branches = {name: index for index, name in enumerate(branch_names(level))} | {"raw": -1}
    channel_of = {name: index for index, name in enumerate(hand.names)}
    found: list[tuple[_Row, str]] = []
    for name in (known[str(name)] for name in names):
        branch = branches[name.component]
        kind: RowKind = "raw" if branch < 0 else "time" if name.domain == "time" else "freq"
        found.append((_Row(kind, channel_of[name.channel], branch), name.descriptor))
    is_share = [descriptor == "band_energy_ratio" for _, descriptor in found]
    rows = sorted(
        {row for (row, _), shared in zip(found, is_share, strict=True) if not shared},
        key=lambda row: (ROW_KINDS.index(row.kind), row.channel, row.branch),
    )
    place_of = {row: index for index, row in enumerate(rows)}
    wanted, shares = [], []
    for place, ((row, descriptor), shared) in enumerate(zip(found, is_share, strict=True)):
        if shared:
            shares.append(_Share(row.channel, row.branch, place))
        else:
            wanted.append(_Wanted(place_of[row], descriptor, place))
    channels = tuple(sorted({row.channel for row, _ in found}))
    return Plan(channels, tuple(rows), tuple(wanted), tuple(shares), len(found))


_RANK_TOLERANCE = 1e-12
"""Singular values below this part of the largest are rounding."""


_LEAST_LENGTH = 16 * torch.finfo(torch.float64).eps / 0.35
"""Of a row less its mean, as a part of its bin's magnitude; below it is rounding. A span of 16 eps:
that of 100 centred values of length 1 lies between .2 (two levels) and 1.41."""
_CHUNK_BINS = 32  # what fits the cache of a processor
_OWN_ROWS = (*SORTED, "entropy", "correlation", "spectral_spread", "mean_abs_change")
"""Descriptors of so much work, or of so few rows, that they are taken of the rows that want them
alone; those of sorted values together, of the rows that want any of them."""


@dataclass(frozen=True)
class Block:
    """The coordinates of one branch, or of the bin, and what is made of them.

    There are ``r`` of the branch less its mean, of the same length as it, and then its sum: the sum
    of whole numbers is exact.

    Args:
        into: from a bin to all coordinates, ``[n, r + 1]``.
        out: from the first r to the branch less its mean, ``[r, n]``; None if they are that.
        lines: from all to the spectrum before its modulus, ``[r + 1, 2 L]``: L real parts, then L
            imaginary ones.
        is_detail: whether its mean vanishes with the rest.
    """

    into: Tensor
    out: Tensor | None
    lines: Tensor
    is_detail: bool

    @property
    def rank(self) -> int:
        """Number of coordinates but the mean."""
        return self.into.shape[1] - 1

    def of_window(self, smooth: Tensor | None) -> Tensor:
        """From ``[x - first, first]`` to all coordinates, ``[W + 1, r + 1]``.

        ``first`` is the first sample of the bin: a small vibration keeps its digits on any offset,
        and details of a constant are exactly 0.

        Args:
            smooth: the filter, ``[n, W]``; None: ``x`` is filtered.
        """
        into = self.into if smooth is None else smooth.T @ self.into
        of_first = into.new_zeros(1, into.shape[1])
        of_first[0, -1] = 0.0 if self.is_detail else len(self.into)
        return torch.cat([into, of_first])

    @cached_property
    def energy_root(self) -> Tensor:
        """From coordinates to numbers whose squares add up to the energy of the spectrum."""
        triangle: Tensor = torch.linalg.qr(self.lines.T, mode="r").R
        return triangle.T


@dataclass(frozen=True)
class LinearMaps:
    """Constant matrices of one kind of bin; ``n`` samples, ``L`` lines, ``r`` the branch's rank.

    Args:
        branches: names of the branches, in their order everywhere.
        is_approximation: which of them keep a constant; details remove it.
        dense: each branch, ``[n, n]``: ``branch = dense @ bin``.
        dense_lines: from a branch (or any signal) to its spectrum before the modulus, ``[2 L, n]``:
            L cosine rows, then L sine rows.
        frequency_hz: of the lines, ``[L]``.
    """

    branches: tuple[str, ...]
    is_approximation: tuple[bool, ...]
    dense: tuple[Tensor, ...]
    dense_lines: Tensor
    frequency_hz: Tensor

    @property
    def num_samples(self) -> int:
        """Samples of a bin."""
        return self.dense_lines.shape[1]

    @property
    def num_lines(self) -> int:
        """Lines of a spectrum."""
        return len(self.frequency_hz)

    def block(self, branch: int) -> Block:
        """The coordinates of a branch by its index; of the bin itself for -1."""
        return self._blocks[branch]

    @cached_property
    def _blocks(self) -> dict[int, Block]:
        num = self.num_samples
        identity = torch.eye(num, dtype=torch.float64)
        blocks = {}
        for branch, dense in enumerate((identity, *self.dense), -1):
            centred = dense - dense.mean(0)
            if branch < 0:
                into, out = centred, identity
            else:
                into, out = _low_rank(centred)
            lines = self.dense_lines @ torch.cat([out, out.new_full((num, 1), 1 / num)], dim=-1)
            blocks[branch] = Block(
                into=torch.cat([into, dense.sum(0, keepdim=True)]).T.contiguous(),
                out=None if branch < 0 else out.T.contiguous(),
                lines=lines.T.contiguous(),
                is_detail=branch >= 0 and not self.is_approximation[branch],
            )
        return blocks


@lru_cache(maxsize=16)
def linear_maps(
    num: int, sample_rate_hz: float, wavelet: Wavelet, level: int, method: SpectrumMethod
) -> LinearMaps:
    """The maps of bins of ``num`` samples; made once, so do not write into them.

    Raises:
        ValueError: if a bin is too short for the levels.
    """
    with torch.inference_mode(False):  # they may be needed for a gradient later
        spectrum = spectrum_matrix(num, method)
        names = branch_names(level)
        return LinearMaps(
            branches=names,
            is_approximation=tuple(name[0] == "A" for name in names),
            dense=tuple(branch_matrix(num, wavelet, level)),
            dense_lines=torch.cat([spectrum.real, spectrum.imag]).contiguous(),
            frequency_hz=frequency_axis_hz(num, sample_rate_hz, method),
        )


def _low_rank(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """``into [r, n]`` and ``out [n, r]``, orthonormal, whose product is ``matrix``."""
    left, sizes, right = torch.linalg.svd(matrix)
    rank = max(1, int((sizes > _RANK_TOLERANCE * sizes[0]).sum()))
    return (sizes[:rank, None] * right[:rank]).contiguous(), left[:, :rank].contiguous()


class Frame(NamedTuple):
    """Channels of one kind whose samples are filtered alike.

    Attributes:
        channels: positions in the hand.
        is_fast: whether they adapt fast, so have branches.
        smooth: from their ``W`` samples to the ``n`` of a filtered bin, ``[n, W]``, float64; None:
            they are filtered.
    """

    channels: tuple[int, ...]
    is_fast: bool
    smooth: Tensor | None = None


class Samples(NamedTuple):
    """Samples of the channels of a frame, on the way to rows.

    Attributes:
        shifted: less the first sample of the bin, then that first sample alone, ``[*, c, W + 1]``,
            float64: so a small vibration keeps its digits on any offset.
        moving: the filtered bin but for a constant, ``[*, c, n]``.
        scale: largest magnitude of the filtered bin, ``[*, c]``, float64; no gradient.
        unit: in which all these are given, volts, ``[*, c]``; None: they are volts. No gradient.
    """

    shifted: Tensor
    moving: Tensor
    scale: Tensor
    unit: Tensor | None


def power_of_two_below(magnitude: Tensor) -> Tensor:
    """The largest power of two that is no larger, by which to divide rounds nothing; no gradient.

    Of magnitudes below 1e-300, 0 among them, that of 1e-300 (the dtype's smallest normal number).
    """
    tiny = max(TINY, torch.finfo(magnitude.dtype).tiny)
    return magnitude.detach().clamp(min=tiny).log2().floor().exp2()


def bounded_gradient(x: Tensor) -> Tensor:
    """``x``, whose gradient saturates at the largest finite number of the dtype.

    The derivative of a shape is of order 1/span, which for denormals no float can hold. Backward
    only: derivatives taken forwards become Inf there.

    Shape:
        - x, output: ``[*]``
    """
    if not (x.requires_grad and torch.is_grad_enabled()) or is_traced():
        return x
    x = x.view_as(x)
    largest = torch.finfo(x.dtype).max
    # autograd hands on None for a gradient that is undefined
    x.register_hook(lambda g: None if g is None else g.clamp(-largest, largest))
    return x


class Bank:
    """Makes the features of a plan.

    Args:
        maps: branches and spectra.
        plan: the features.
        frames: which hold every channel of the plan.
        dtype: of all that there is one of per sample, but for ``STEPPED`` descriptors.
            Samples, coordinates and what there is one of per row are float64.
    """

    @torch.inference_mode(False)  # what it keeps may be needed for a gradient later
    def __init__(
        self,
        maps: LinearMaps,
        plan: Plan,
        frames: Sequence[Frame],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self.dtype = dtype
        self.frames = tuple(frames)
        self._plan = plan
        wanted: dict[_Row, set[str]] = {row: set() for row in plan.rows}
        for each in plan.wanted:
            wanted[plan.rows[each.row]].add(each.descriptor)
        families = (
            _Family(maps, wanted, frames, is_fast, is_raw)
            for is_fast, is_raw in ((False, True), (True, True), (True, False))
        )
        self._families = [family for family in families if family.blocks]
        self._sets: list[_RowSet] = []
        for is_freq in (False, True):
            own = {row: names for row, names in wanted.items() if (row.kind == "freq") == is_freq}
            steps = {row: names.intersection(_steps(names)) for row, names in own.items()}
            rest = {row: names - steps[row] for row, names in own.items()}
            sets = [(own, dtype)]
            if dtype != torch.float64:
                sets = [(steps, torch.float64), (rest, dtype)]
            for names_of, own_dtype in sets:
                names_of = {row: names for row, names in names_of.items() if names}
                if names_of:
                    self._sets.append(_RowSet(self._families, maps, names_of, is_freq, own_dtype))
        self._ratios = [_Ratios(maps, plan, frame) for frame in frames]
        made = [place for rows in self._sets for place in rows.made]
        made += [place for ratios in self._ratios for place in ratios.made]
        column = {place: index for index, place in enumerate(made)}
        order = [0] * plan.num_features
        channel = [0] * plan.num_features
        for each in plan.wanted:
            order[each.place] = column[plan.rows[each.row], each.descriptor]
            channel[each.place] = plan.rows[each.row].channel
        for share in plan.shares:
            order[share.place] = column[_Row("freq", share.channel, share.branch), "ratio"]
            channel[share.place] = share.channel
        self._order = _index(order, len(made))
        self._channel = torch.tensor(channel)

    def __call__(self, samples: Sequence[Samples]) -> Tensor:
        """Features in the order of the plan, ``[*, K]``, float64.

        Args:
            samples: of each frame.
        """
        families = [_Coordinates(family, samples) for family in self._families]
        made = [value for rows in self._sets for value in rows(families)]
        made += [
            ratios(own, self.dtype)
            for ratios, own in zip(self._ratios, samples, strict=True)
            if ratios.made
        ]
        return taken(torch.cat(made, dim=-1), self._order, -1)

    def of_bins(self, bins: Tensor) -> Tensor:
        """Features of filtered bins, float64; NaN of a channel that holds a NaN or Inf.

        Here extremes end: what is not finite becomes 0 (and its features NaN at the end), and each
        channel is divided by the power of two below its magnitude, which rounds nothing.

        Shape:
            - bins: ``[*, C, n]``, float32 or float64, volts
            - output: ``[*, K]``; what is beyond float64 saturates
        """
        bins = bounded_gradient(bins).double()
        flat = bins.reshape(-1, *bins.shape[-2:])
        features = torch.cat([self._of_chunk(chunk) for chunk in flat.split(_CHUNK_BINS)])
        return features.reshape(*bins.shape[:-2], self._plan.num_features)

    def _of_chunk(self, bins: Tensor) -> Tensor:
        magnitude = bins.detach().abs().amax(-1)
        is_broken = ~magnitude.isfinite()
        magnitude = torch.where(is_broken, 0.0, magnitude)
        unit = power_of_two_below(magnitude)
        x = torch.where(is_broken[..., None], 0.0, bins) / unit[..., None]
        scale = magnitude / unit
        samples = []
        for frame in self.frames:
            index = torch.tensor(frame.channels, device=x.device)
            own = x.index_select(-2, index)
            first = own[..., :1].detach()
            shifted = own - first
            samples.append(
                Samples(
                    torch.cat([shifted, first], dim=-1),
                    shifted,
                    scale.index_select(-1, index),
                    unit.index_select(-1, index),
                )
            )
        largest = torch.finfo(torch.float64).max
        features = self(samples).clamp(-largest, largest)
        return torch.where(taken(is_broken, self._channel, -1), torch.nan, features)


class _Family:
    """Channels of one kind, and the coordinates that the rows of any of them are made of.

    The coordinates of all blocks (of branches, or of the bin) lie side by side, those of one block
    followed by its sum; ``c`` channels, ``K`` coordinates in ``b`` blocks.
    """

    def __init__(
        self,
        maps: LinearMaps,
        wanted: Iterable[_Row],
        frames: Sequence[Frame],
        is_fast: bool,
        is_raw: bool,
    ) -> None:
        self.num = maps.num_samples
        self.frames = [i for i, frame in enumerate(frames) if frame.is_fast == is_fast]
        own = [frames[i] for i in self.frames]
        self.channels = tuple(channel for frame in own for channel in frame.channels)
        own_rows = (row for row in wanted if row.channel in self.channels)
        self.blocks = sorted({row.branch for row in own_rows if (row.branch < 0) == is_raw})
        blocks = [maps.block(branch) for branch in self.blocks]
        if not blocks:
            return
        self.into = [torch.cat([each.of_window(f.smooth) for each in blocks], -1) for f in own]
        widths = [each.rank + 1 for each in blocks]
        self.ends = list(itertools.accumulate(widths))
        self.starts = [0, *self.ends[:-1]]
        self.of_block = _ones_of(widths)  # [K, b]
        self.sums = torch.tensor(self.ends) - 1
        self.without_sum = self.of_block.index_fill(0, self.sums, 0.0)
        self.of_sum = self.of_block - self.without_sum
        self.with_mean = self.without_sum + self.of_sum / self.num
        self.stays = torch.tensor([float(not each.is_detail) for each in blocks]).double()


class _Coordinates:
    """The coordinates of a family's channels, brought to length one, for branches and for spectra.

    Attributes:
        scaled: by whether they are for spectra, ``[*, c, K]``; exactly 0 but for the sum where a
            block is constant, and 0 for constant details.
        length: by which they were divided: of a block less its mean, of spectra in full,
            ``[*, c, b]``.
        mean: of the samples of each block, over its length, ``[*, c, b]``.
        scale: largest magnitude of the filtered bins, ``[*, c]``.
        unit: of all these but ``scaled`` and ``mean``, ``[*, c]``; None: volts.
    """

    def __init__(self, family: _Family, samples: Sequence[Samples]) -> None:
        own = [samples[i] for i in family.frames]
        parts = zip((each.shifted for each in own), family.into, strict=True)
        x = torch.cat([shifted @ like(into, shifted) for shifted, into in parts], dim=-2)
        self.scale = torch.cat([each.scale for each in own], dim=-1)
        units = [each.unit for each in own if each.unit is not None]
        self.unit = torch.cat(units, dim=-1) if units else None
        self._moving = [each.moving for each in own]
        length = _length(x, family.without_sum)
        least = (self.scale * _LEAST_LENGTH).clamp(min=TINY)[..., None]
        is_kept = (length >= least).double()
        mean_is_kept = torch.maximum(is_kept, like(family.stays, is_kept))
        length = torch.maximum(length, least)
        settled = x * (
            is_kept @ like(family.without_sum.T, x) + mean_is_kept @ like(family.of_sum.T, x)
        )
        whole = _length(settled, family.with_mean).clamp(min=TINY)
        to_all = like(family.of_block.T, x)
        self.scaled = {
            False: x * ((is_kept / length) @ to_all),
            True: settled * ((1.0 / whole) @ to_all),
        }
        self.length = {False: length, True: whole}
        self.mean = taken(x, family.sums, -1) / float(family.num) / length * mean_is_kept

    def filtered(self, dtype: torch.dtype) -> Tensor:
        """Filtered bins less their mean, of order one, ``[*, c, n]``; 0 where that is rounding."""
        x = torch.cat(self._moving, dim=-2).double()
        x = x - x.mean(-1, keepdim=True)
        size = x.detach().abs().amax(-1, keepdim=True)
        least = (self.scale * (8 * torch.finfo(torch.float64).eps)).clamp(min=TINY)[..., None]
        return (x * ((size >= least).double() / torch.maximum(size, least))).to(dtype)


def _length(x: Tensor, weights: Tensor) -> Tensor:
    """Roots of weighted sums of squares; no gradient, as features do not depend on their unit."""
    return ((x.detach() * x.detach()) @ like(weights, x)).sqrt()


class _RowSet:
    """Rows of one length and dtype, and the descriptors that are wanted of them."""

    def __init__(
        self,
        families: Sequence[_Family],
        maps: LinearMaps,
        wanted: Mapping[_Row, set[str]],
        is_freq: bool,
        dtype: torch.dtype,
    ) -> None:
        self._is_freq = is_freq
        self._dtype = dtype
        self._maps = maps
        self._pieces: list[tuple[int, slice, Tensor | None, Tensor | None]] = []
        rows, cells, owners = list[_Row](), list[int](), list[int]()
        num_cells = num_owners = 0
        self._families: list[int] = []
        for number, family in enumerate(families):
            num_blocks = len(family.blocks)
            for place, branch in enumerate(family.blocks):
                kind: RowKind = "freq" if is_freq else "raw" if branch < 0 else "time"
                own = [_Row(kind, channel, branch) for channel in family.channels]
                chosen = [i for i, row in enumerate(own) if row in wanted]
                if not chosen:
                    continue
                if number not in self._families:
                    self._families.append(number)
                block = maps.block(branch)
                stop = family.ends[place] - (not is_freq)
                matrix = block.lines if is_freq else block.out
                self._pieces.append(
                    (number, slice(family.starts[place], stop), _index(chosen, len(own)), matrix)
                )
                rows += [own[i] for i in chosen]
                cells += [num_cells + i * num_blocks + place for i in chosen]
                owners += [num_owners + i for i in chosen]
            if number in self._families:
                num_cells += len(family.channels) * num_blocks
                num_owners += len(family.channels)
        self._cells, self._owners = torch.tensor(cells), torch.tensor(owners)
        names = {name for own in wanted.values() for name in own}
        ordered = [name for name in DESCRIPTORS if name in names]
        self._is_sorted = not names.isdisjoint(("mode", "iqr"))
        shared = [name for name in ordered if self._is_sorted and name in SORTED]
        groups = [[name for name in ordered if name not in _OWN_ROWS], shared]
        groups += [[name] for name in ordered if name in _OWN_ROWS and name not in shared]
        self.made: list[tuple[_Row, str]] = []
        self._groups: list[tuple[list[str], Tensor | None]] = []
        for group in filter(None, groups):
            is_of_all = group[0] not in _OWN_ROWS
            chosen = [
                i for i, row in enumerate(rows) if is_of_all or not wanted[row].isdisjoint(group)
            ]
            self.made += [(rows[i], name) for name in group for i in chosen]
            self._groups.append((group, _index(chosen, len(rows))))
        of_fast = families[-1].channels
        correlated = [row.channel for row in rows if "correlation" in wanted[row]]
        self._correlated = torch.tensor([of_fast.index(channel) for channel in correlated])

    def __call__(self, families: Sequence[_Coordinates]) -> list[Tensor]:
        rows = self._rows(families)
        made = []
        for names, index in self._groups:
            own = rows.take(index)
            if names[0] in SORTED and (self._is_sorted or isinstance(own.values, Tensor)):
                own = replace(own, in_order=ascending(own.values, own.num))
            if names == ["correlation"]:
                own = replace(
                    own, filtered=taken(families[-1].filtered(self._dtype), self._correlated, -2)
                )
            made += [DESCRIPTORS[name](own) for name in names]
        return made

    def _rows(self, families: Sequence[_Coordinates]) -> Rows:
        is_freq, own = self._is_freq, [families[i] for i in self._families]
        scaled = {i: families[i].scaled[is_freq].to(self._dtype) for i in self._families}
        parts = []
        for number, columns, index, matrix in self._pieces:
            x = scaled[number]
            x = taken(x[..., columns.start : columns.stop], index, -2)
            parts.append(x if matrix is None else x @ like(matrix, x))
        values = torch.cat(parts, dim=-2)
        amplitude = None
        if is_freq:
            num = self._maps.num_lines
            real, imaginary = values[..., :num], values[..., num:]
            amplitude = root(real * real + imaginary * imaginary)
            middle = amplitude.mean(-1, keepdim=True)
            values, mean = amplitude - middle, middle.squeeze(-1).double()
        else:
            num = self._maps.num_samples
            mean = self._of_cells([each.mean for each in own])
        length = self._of_cells([each.length[is_freq] for each in own])
        scale = taken(torch.cat([each.scale for each in own], dim=-1), self._owners, -1)
        unit = length
        units = [each.unit for each in own if each.unit is not None]
        if units:
            unit = length * taken(torch.cat(units, dim=-1), self._owners, -1)
        return Rows(
            values,
            mean,
            unit,
            num,
            scale / length,
            amplitude=amplitude,
            frequency_hz=self._maps.frequency_hz if is_freq else None,
        )

    def _of_cells(self, tables: Sequence[Tensor]) -> Tensor:
        """What there is one of per channel and block, of each row, ``[*, R]``."""
        return taken(torch.cat([each.flatten(-2) for each in tables], dim=-1), self._cells, -1)


class _Ratios:
    """Band energy ratios of the fast channels of a frame."""

    def __init__(self, maps: LinearMaps, plan: Plan, frame: Frame) -> None:
        own = [i for i, channel in enumerate(frame.channels) if channel in plan.share_channels]
        branches = range(len(maps.branches))
        self.made = [
            (_Row("freq", frame.channels[i], branch), "ratio") for i in own for branch in branches
        ]
        if not own:
            return
        blocks = [maps.block(branch) for branch in branches]
        self._index = _index(own, len(frame.channels))
        self._into = torch.cat([b.of_window(frame.smooth) @ b.energy_root for b in blocks], dim=-1)
        self._of_branch = _ones_of([each.rank + 1 for each in blocks])

    def __call__(self, samples: Samples, dtype: torch.dtype) -> Tensor:
        """``[*, channels of the frame * branches]``, float64."""
        x = taken(samples.shifted, self._index, -2).to(dtype)
        parts = (x @ like(self._into, x)).double()  # whose squares may leave float32
        ratios = band_energy_ratios((parts * parts) @ like(self._of_branch, parts))
        return ratios.flatten(-2)


def _steps(names: set[str]) -> tuple[str, ...]:
    """What is made of float64 rows; with the mode all that its sorted values serve."""
    return (*STEPPED, *SORTED) if "mode" in names else STEPPED


def _index(chosen: Sequence[int], num: int) -> Tensor | None:
    """Places to be taken of ``num``; None if that is all of them in order."""
    return None if list(chosen) == list(range(num)) else torch.tensor(chosen)


def _ones_of(widths: Sequence[int]) -> Tensor:
    """Which entry is of which block, 1 or 0, ``[sum of widths, blocks]``, float64."""
    blocks = torch.eye(len(widths), dtype=torch.float64)
    return blocks.repeat_interleave(torch.tensor(widths), dim=0)
