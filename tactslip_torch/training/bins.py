"""Labelled bins of recordings, and a bounded random sample that any worker would have drawn.

A bin's key is a hash of its recording and number. The sample of a stratum (group, scene and class)
is the bins of smallest key, so it depends neither on their order nor on who saw them. Of many
groups each gives fewer bins, so that the sample does not grow with their number.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.recording import PAPER_SCENE

MOST_GROUPS = 10
"""Of more groups each stratum is sampled less, and validation leaves several out together."""


@dataclass(frozen=True)
class RecordingBins:
    """Labelled bins of one recording.

    Args:
        name: of the recording.
        group: that validation leaves out as a whole, such as its material.
        features: of the bins, finite.
        is_slip: which they are.
        scene: of the recording.
        longest_run: most equal samples in a row of a channel that moves; ``None``: not known.
        weight: for how many bins each stands, alike for those of a group, scene and class;
            ``None``: for itself.

    Shape:
        - features: ``[N, F]``; is_slip: ``[N]``, bool; weight: ``[N]``, float64
    """

    name: str
    group: str
    features: Tensor
    is_slip: Tensor
    scene: str = PAPER_SCENE
    longest_run: int | None = None
    weight: Tensor | None = None


@dataclass(frozen=True)
class SampledBins:
    """Bins of a sample, by recording and then by number.

    Attributes:
        features: ``[n, F]``.
        is_slip: ``[n]``, bool.
        group: ``[n]``, index into ``group_names``.
        group_names: ascending.
        scene: ``[n]``, index into ``scene_names``.
        scene_names: ascending.
        weight: ``[n]``, float64, for how many bins of its stratum each stands.
        recording: ``[n]``, index into ``recording_names``.
        recording_names: ascending.
        longest_run: most equal samples in a row, of all recordings; ``None``: not known.
    """

    features: Tensor
    is_slip: Tensor
    group: Tensor
    group_names: tuple[str, ...]
    scene: Tensor
    scene_names: tuple[str, ...]
    weight: Tensor
    recording: Tensor
    recording_names: tuple[str, ...]
    longest_run: int | None = None

    @property
    def stratum(self) -> Tensor:
        """Group, scene and class of each bin as one number, ``[n]``."""
        return 2 * (self.group * len(self.scene_names) + self.scene) + self.is_slip.long()

    def joined(self, most: int = MOST_GROUPS) -> SampledBins:
        """The same bins in at most so many groups (``join_groups``)."""
        label, names = self.is_slip.long(), self.group_names
        group, named = join_groups(self.group, label, self.weight, names, most)
        return self if named is names else replace(self, group=group, group_names=named)

    def thinned(self, most: int) -> SampledBins:
        """At most about so many of the bins, even over strata, which stand for all of them."""
        places, weight = even_places(self.stratum, self.weight, most)
        names = ("features", "is_slip", "group", "scene", "recording")
        return replace(self, weight=weight, **{name: getattr(self, name)[places] for name in names})

    def by_recording(self) -> list[RecordingBins]:
        """The same bins, those of each recording together, to be fitted to again."""
        found = []
        for index, name in enumerate(self.recording_names):
            rows = (self.recording == index).nonzero()[:, 0]
            if len(rows):
                group = self.group_names[int(self.group[rows[0]])]
                scene = self.scene_names[int(self.scene[rows[0]])]
                features, is_slip = self.features[rows], self.is_slip[rows]
                bins = RecordingBins(name, group, features, is_slip, scene, self.longest_run)
                found.append(replace(bins, weight=self.weight[rows]))
        return found


def join_groups(
    group: Tensor, label: Tensor, weight: Tensor, names: tuple[str, ...], most: int = MOST_GROUPS
) -> tuple[Tensor, tuple[str, ...]]:
    """At most so many groups, ``[N]``, and their names; those joined are ``cup and 4 more``.

    In fewer where no two groups have every class, so that as many as can have them do. Groups are
    dealt out from the largest on, each to where bins of its commoner class are fewest; of equal
    ones the name decides. Where that would leave a class in one group alone, which it is not in
    before, nothing is joined.

    Args:
        group: of each bin, index into ``names``.
        label: class of each bin, from 0.
        weight: of each bin.
        names: of the groups, ascending.
        most: groups.

    Shape:
        - group, label, weight: ``[N]``
    """
    num = len(names)
    counts = torch.zeros(num, max(int(label.max()) + 1, 2), dtype=torch.float64)
    counts.index_put_((group, label), weight, accumulate=True)
    has = counts > 0
    if int(has.all(1).sum()) < 2 <= int(has.sum(0).min()):
        most = min(most, int(has.sum(0).min()))
    if num <= most:
        return group, names
    joined = torch.zeros(most, counts.shape[1], dtype=torch.float64)
    members = [list[int]() for _ in range(most)]
    order = sorted(range(num), key=lambda one: (-float(counts[one].sum()), one))
    for one in order:
        of_class = joined[:, int(counts[one].argmax())].tolist()
        place = min(range(most), key=lambda each: (of_class[each], len(members[each])))
        members[place].append(one)
        joined[place] += counts[one]
    if bool((((joined > 0).sum(0) < 2) & (has.sum(0) >= 2)).any()):
        return group, names
    members = sorted(sorted(own) for own in members)
    to = torch.empty(num, dtype=torch.long)
    for place, own in enumerate(members):
        to[own] = place
    firsts = [names[own[0]] for own in members]
    more = [f" and {len(own) - 1} more" if len(own) > 1 else "" for own in members]
    return to[group], tuple(name + behind for name, behind in zip(firsts, more, strict=True))


def even_places(stratum: Tensor, weights: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Places of at most about so many bins, even over strata, and weights for those left out.

    Each stratum keeps two bins at least, if it has them.

    Shape:
        - stratum, weights: ``[N]``
        - output: ``[n]``, ascending, and ``[n]``
    """
    if len(stratum) <= most:
        return torch.arange(len(stratum)), weights
    strata = [(stratum == one).nonzero()[:, 0] for one in stratum.unique().tolist()]
    share = most // len(strata)
    for _ in range(len(strata)):  # strata that have fewer leave their part to the others
        short = [len(rows) for rows in strata if len(rows) < share]
        share = max((most - sum(short)) // max(len(strata) - len(short), 1), share)
    weights, kept = weights.clone(), list[Tensor]()
    for rows in strata:
        some = torch.linspace(0, len(rows) - 1, min(len(rows), max(share, 2))).round().long()
        weights[rows] *= len(rows) / len(some)
        kept.append(rows[some])
    places = torch.cat(kept).sort().values
    return places, weights[places]


class _Stratum(NamedTuple):
    """Bins of one stratum: how many there were, and those of smallest key, ascending."""

    num_seen: float
    places: list[tuple[float, str, int]]  # key, recording, bin
    features: Tensor  # [len(places), F]


class BinSample:
    """At most so many bins of every group, scene and class, drawn by ``bin_keys``.

    Args:
        most: bins kept of each stratum; of more than ``MOST_GROUPS`` groups fewer, in proportion.

    Raises:
        ValueError: if ``most`` is negative.
    """

    def __init__(self, most: int) -> None:
        if most < 0:
            raise ValueError(f"a sample keeps 0 bins or more of a group and class, got {most}")
        self.most = most
        self._longest_run: int | None = None
        self._strata: dict[tuple[str, str, bool], _Stratum] = {}
        self._groups: set[str] = set()

    @property
    def kept(self) -> int:
        """Bins kept of each stratum by the number of groups so far, at least 2 if any are."""
        share = self.most * MOST_GROUPS // max(len(self._groups), MOST_GROUPS)
        return max(share, min(self.most, 2))

    def update(self, bins: RecordingBins) -> None:
        """Add the bins of a recording, all at once and once only (that is not checked)."""
        self._add_run(bins.longest_run)
        self._add_groups({bins.group} if len(bins.is_slip) else set())
        keys = bin_keys(bins.name, len(bins.is_slip))
        for label in (False, True):
            rows = (bins.is_slip == label).nonzero()[:, 0]
            kept = rows[keys[rows].argsort()[: self.kept]]
            places = [(float(keys[row]), bins.name, row) for row in kept.tolist()]
            if len(rows):
                stratum = bins.group, bins.scene, label
                num = len(rows) if bins.weight is None else float(bins.weight[rows].sum())
                self._add(stratum, _Stratum(num, places, bins.features[kept]))

    def merge(self, other: BinSample) -> None:
        """Add the bins of another sample of that size; of other recordings (not checked)."""
        self._add_run(other._longest_run)
        self._add_groups(other._groups)
        for name, part in other._strata.items():
            self._add(name, part)

    def bins(self) -> SampledBins:
        """The sample, in an order that depends on the bins alone.

        Raises:
            ValueError: if there is no bin.
        """
        if not self._strata:
            raise ValueError("training needs bins of both classes, got none; add recordings")
        strata = sorted(self._strata.items())
        rows = [
            (recording, index, group, scene, label, part.num_seen / len(part.places))
            for (group, scene, label), part in strata
            for _, recording, index in part.places
        ]
        order = sorted(range(len(rows)), key=rows.__getitem__)
        columns = zip(*(rows[i] for i in order), strict=True)
        of_recording, _, of_group, of_scene, is_slip, weight = columns
        groups, scenes = sorted(set(of_group)), sorted(set(of_scene))
        recordings = sorted(set(of_recording))
        number = {name: index for index, name in enumerate(recordings)}
        return SampledBins(
            features=torch.cat([part.features for _, part in strata])[order],
            is_slip=torch.tensor(is_slip),
            group=torch.tensor([groups.index(name) for name in of_group]),
            group_names=tuple(groups),
            scene=torch.tensor([scenes.index(name) for name in of_scene]),
            scene_names=tuple(scenes),
            weight=torch.tensor(weight, dtype=torch.float64),
            recording=torch.tensor([number[name] for name in of_recording]),
            recording_names=tuple(recordings),
            longest_run=self._longest_run,
        )

    def _add_run(self, longest_run: int | None) -> None:
        runs = [run for run in (self._longest_run, longest_run) if run is not None]
        self._longest_run = max(runs, default=None)

    def _add_groups(self, groups: set[str]) -> None:
        """Note groups; where there are many, strata that are there are cut to what all may have."""
        before = self.kept
        self._groups |= groups
        if self.kept < before:
            for name, part in self._strata.items():
                if len(part.places) > self.kept:
                    features = part.features[: self.kept].clone()  # a view would keep the rest
                    self._strata[name] = _Stratum(part.num_seen, part.places[: self.kept], features)

    def _add(self, name: tuple[str, str, bool], part: _Stratum) -> None:
        if name in self._strata:
            own = self._strata[name]
            part = _Stratum(
                own.num_seen + part.num_seen,
                own.places + part.places,
                torch.cat([own.features, part.features]),
            )
        order = sorted(range(len(part.places)), key=part.places.__getitem__)[: self.kept]
        places = [part.places[i] for i in order]
        self._strata[name] = _Stratum(part.num_seen, places, part.features[order])


def bin_keys(recording: str, num_bins: int) -> Tensor:
    """Numbers uniform in [0, 1) that the bins of a recording carry for good, ``[N]``, float64.

    The smaller, the sooner a bin is in a ``BinSample``.
    """
    keys = [
        int.from_bytes(
            hashlib.blake2b(f"{recording}:{row}".encode(), digest_size=8).digest(), "big"
        )
        for row in range(num_bins)
    ]
    return torch.tensor([key >> 11 for key in keys], dtype=torch.float64) * 2.0**-53
