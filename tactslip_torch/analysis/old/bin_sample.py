"""A bounded random sample of bins that any worker would have drawn.

A bin's key is a hash of its recording and number. The sample of a stratum (group and class) is
the bins of smallest key, so it depends on which bins there are and on nothing else: not on their
order, not on who saw them, and on no random state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

_Place = tuple[int, str, int]  # key, recording, bin: what bins are ordered by


def bin_keys(recording: str, num_bins: int) -> Tensor:
    """Numbers uniform in [0, 1) that the bins of a recording carry for good, ``[N]``, float64.

    The smaller, the sooner a bin is in a ``BinSample``.
    """
    return _uniform((recording, index) for index in range(num_bins))


@dataclass(frozen=True)
class SampledBins:
    """Bins of a sample, by recording and then by number.

    Attributes:
        features: ``[n, F]``, float32.
        is_slip: ``[n]``, bool.
        group: ``[n]``, index into ``group_names``.
        group_names: ascending.
        recording: ``[n]``, index into ``recording_names``.
        recording_names: of the sampled bins, ascending.
        bin_index: ``[n]``, number of the bin among those its recording was handed with.
        sample_weight: ``[n]``, float64, for how many bins of its group and class each stands.
    """

    features: Tensor
    is_slip: Tensor
    group: Tensor
    group_names: tuple[str, ...]
    recording: Tensor
    recording_names: tuple[str, ...]
    bin_index: Tensor
    sample_weight: Tensor

    @property
    def keys(self) -> Tensor:
        """What ``bin_keys`` says of each of them, ``[n]``, float64."""
        places = zip(self.recording.tolist(), self.bin_index.tolist(), strict=True)
        return _uniform((self.recording_names[recording], index) for recording, index in places)


class _Stratum(NamedTuple):
    """Bins of one group and class: how many there were, and those of smallest key, ascending."""

    num_seen: int
    places: list[_Place]
    features: Tensor  # [len(places), F]


class BinSample:
    """At most so many bins of every group and class, drawn by ``bin_keys``.

    Args:
        most: bins kept of each group and class.

    Raises:
        ValueError: if ``most`` is negative.
    """

    def __init__(self, most: int) -> None:
        if most < 0:
            raise ValueError(f"a sample keeps 0 bins or more of a group and class, got {most}")
        self.most = most
        self._strata: dict[tuple[str, bool], _Stratum] = {}

    @property
    def num_seen(self) -> dict[tuple[str, bool], int]:
        """How many bins there were of each group and class (True is slip)."""
        return {name: self._strata[name].num_seen for name in sorted(self._strata)}

    def update(self, recording: str, group: str, features: Tensor, is_slip: Tensor) -> None:
        """Add the bins of a recording, all at once and once only (that is not checked).

        Shape:
            - features: ``[N, F]``, float32
            - is_slip: ``[N]``
        """
        features, is_slip = features.detach().cpu(), is_slip.cpu().bool()
        for label in (False, True):
            rows = (is_slip == label).nonzero().squeeze(-1).tolist()
            if rows:
                places = [(_key(recording, row), recording, row) for row in rows]
                self._add((group, label), _Stratum(len(rows), places, features[rows]))

    def merge(self, other: BinSample) -> None:
        """Add the bins of another sample of that size; of other recordings (not checked)."""
        for name, part in other._strata.items():
            self._add(name, part)

    def bins(self) -> SampledBins:
        """The sample, in an order that depends on the bins alone."""
        strata = sorted(self._strata.items())
        rows = [
            (recording, index, group, label, part.num_seen / len(part.places))
            for (group, label), part in strata
            for _, recording, index in part.places
        ]
        order = sorted(range(len(rows)), key=rows.__getitem__)
        columns = list(zip(*(rows[i] for i in order), strict=True)) or [()] * 5
        recordings, groups = sorted(set(columns[0])), sorted({group for (group, _), _ in strata})
        number = {name: i for i, name in enumerate(recordings)}
        whole = [part.features for _, part in strata] or [torch.zeros(0, 0)]
        return SampledBins(
            features=torch.cat(whole)[order],
            is_slip=torch.tensor(columns[3], dtype=torch.bool),
            group=torch.tensor([groups.index(name) for name in columns[2]], dtype=torch.int64),
            group_names=tuple(groups),
            recording=torch.tensor([number[name] for name in columns[0]], dtype=torch.int64),
            recording_names=tuple(recordings),
            bin_index=torch.tensor(columns[1], dtype=torch.int64),
            sample_weight=torch.tensor(columns[4], dtype=torch.float64),
        )

    def _add(self, name: tuple[str, bool], part: _Stratum) -> None:
        if name in self._strata:
            own = self._strata[name]
            part = _Stratum(
                own.num_seen + part.num_seen,
                own.places + part.places,
                torch.cat([own.features, part.features]),
            )
        order = sorted(range(len(part.places)), key=part.places.__getitem__)[: self.most]
        places = [part.places[i] for i in order]
        self._strata[name] = _Stratum(part.num_seen, places, part.features[order])


def _uniform(places: Iterable[tuple[str, int]]) -> Tensor:
    keys = [_key(*place) >> 11 for place in places]
    return torch.tensor(keys, dtype=torch.float64) * 2.0**-53


def _key(recording: str, index: int) -> int:
    digest = hashlib.blake2b(f"{recording}:{index}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big")
