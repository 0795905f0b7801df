"""A bounded random sample of bins that any worker would have drawn.

A bin's key is a hash of its recording and number. The sample of a stratum (group and class) is
the bins of smallest key, so it depends on which bins there are and on nothing else: not on their
order, not on who saw them, and on no random state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

_Place = tuple[int, str, int]  # key, recording, bin: what bins are ordered by


def bin_keys(recording: str, num_bins: int) -> Tensor:
    """Numbers uniform in [0, 1) that the bins of a recording carry for good, ``[N]``, float64.

    The smaller, the sooner a bin is in a ``BinSample``.
    """
    keys = [_key(recording, index) >> 11 for index in range(num_bins)]
    return torch.tensor(keys, dtype=torch.float64) * 2.0**-53


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
        represents: ``[n]``, float64, for how many bins of its group and class each stands.
    """

    features: Tensor
    is_slip: Tensor
    group: Tensor
    group_names: tuple[str, ...]
    recording: Tensor
    recording_names: tuple[str, ...]
    bin_index: Tensor
    represents: Tensor


@dataclass
class _Stratum:
    """Bins of one group and class: how many there were, and those of smallest key."""

    num_seen: int
    kept: list[tuple[_Place, int]]  # ascending, each with its row of ``rows``
    rows: Tensor  # [at least len(kept), F]

    def features(self) -> Tensor:
        """Of the kept bins, in their order."""
        return self.rows[[row for _, row in self.kept]]

    def add(self, num_seen: int, others: list[tuple[_Place, int]], rows: Tensor, most: int) -> None:
        """Let bins in that have rows of their own; only rows of newcomers are copied."""
        self.num_seen += num_seen
        merged = sorted(self.kept + [(place, ~row) for place, row in others])[:most]
        newcomers = [~row for _, row in merged if row < 0]
        if not newcomers:
            return
        if len(merged) > len(self.rows):
            grown = self.rows.new_empty(min(2 * len(merged), most), self.rows.shape[1])
            grown[: len(self.rows)] = self.rows
            self.rows = grown
        stay = {row for _, row in merged if row >= 0}
        free = [row for row in range(len(merged)) if row not in stay]
        self.rows[free] = rows[newcomers]
        places = iter(free)
        self.kept = [(place, row if row >= 0 else next(places)) for place, row in merged]


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

        Raises:
            ValueError: for another shape or dtype; nothing is added then.
        """
        if features.ndim != 2 or is_slip.shape != features.shape[:1]:
            raise ValueError(
                f"expected features [N, F] and is_slip [N], got {tuple(features.shape)} and "
                f"{tuple(is_slip.shape)}"
            )
        if features.dtype != torch.float32:
            raise ValueError(f"a sample keeps float32 features, got {features.dtype}")
        self._check_width(features.shape[1])
        features, is_slip = features.detach().cpu(), is_slip.cpu().bool()
        for label in (False, True):
            rows = (is_slip == label).nonzero().squeeze(-1).tolist()
            if rows:
                others = [((_key(recording, row), recording, row), row) for row in rows]
                self._add((group, label), len(rows), others, features)

    def merge(self, other: BinSample) -> None:
        """Add the bins of another sample; they must be of other recordings (not checked).

        Raises:
            ValueError: if the samples differ in size or features; nothing is added then.
        """
        if self.most != other.most:
            raise ValueError(f"cannot merge samples of {self.most} and of {other.most} bins")
        if (width := other._width()) is not None:
            self._check_width(width)
        for name, part in other._strata.items():
            self._add(name, part.num_seen, part.kept, part.rows)

    def bins(self) -> SampledBins:
        """The sample, in an order that depends on the bins alone."""
        state = self.state_dict()
        strata, recordings = state["facts"]["strata"], state["facts"]["recordings"]
        tensors = state["tensors"]
        kept = torch.tensor([num_kept for *_, num_kept in strata], dtype=torch.int64)
        seen = torch.tensor([num_seen for *_, num_seen, _ in strata], dtype=torch.float64)
        groups = sorted({group for group, *_ in strata})
        group = torch.tensor([groups.index(group) for group, *_ in strata], dtype=torch.int64)
        is_slip = torch.tensor([label for _, label, *_ in strata], dtype=torch.bool)
        places = list(
            zip(tensors["recording"].tolist(), tensors["bin_index"].tolist(), strict=True)
        )
        order = sorted(range(len(places)), key=places.__getitem__)
        stratum = torch.arange(len(strata)).repeat_interleave(kept)[order]
        return SampledBins(
            features=tensors["features"][order],
            is_slip=is_slip[stratum],
            group=group[stratum],
            group_names=tuple(groups),
            recording=tensors["recording"][order],
            recording_names=tuple(recordings),
            bin_index=tensors["bin_index"][order],
            represents=(seen / kept)[stratum],
        )

    def state_dict(self) -> dict[str, Any]:
        """``facts`` that JSON holds and ``tensors`` by name, the same for the same bins."""
        strata = sorted(self._strata.items())
        places = [place for _, part in strata for place, _ in part.kept]
        recordings = sorted({recording for _, recording, _ in places})
        number = {recording: i for i, recording in enumerate(recordings)}
        features = [part.features() for _, part in strata]
        return {
            "facts": {
                "most": self.most,
                "strata": [[*name, part.num_seen, len(part.kept)] for name, part in strata],
                "recordings": recordings,
            },
            "tensors": {
                "recording": torch.tensor([number[r] for _, r, _ in places], dtype=torch.int64),
                "bin_index": torch.tensor([i for _, _, i in places], dtype=torch.int64),
                "features": torch.cat(features) if features else torch.zeros(0, 0),
            },
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> BinSample:
        """The sample that ``state_dict`` described."""
        facts, tensors = state["facts"], state["tensors"]
        sample = cls(facts["most"])
        recordings = [facts["recordings"][i] for i in tensors["recording"].tolist()]
        places = list(zip(recordings, tensors["bin_index"].tolist(), strict=True))
        start = 0
        for group, label, num_seen, num_kept in facts["strata"]:
            own = places[start : start + num_kept]
            others = [((_key(*place), *place), start + i) for i, place in enumerate(own)]
            sample._add((group, label), num_seen, others, tensors["features"])
            start += num_kept
        return sample

    def _add(
        self,
        name: tuple[str, bool],
        num_seen: int,
        others: list[tuple[_Place, int]],
        rows: Tensor,
    ) -> None:
        empty = _Stratum(0, [], rows.new_empty(0, rows.shape[1]))
        self._strata.setdefault(name, empty).add(num_seen, others, rows, self.most)

    def _width(self) -> int | None:
        """How many features the bins have; None before the first."""
        return next((part.rows.shape[1] for part in self._strata.values()), None)

    def _check_width(self, width: int) -> None:
        if self._width() not in (None, width):
            raise ValueError(f"the sample has bins of {self._width()} features, got {width}")


def _key(recording: str, index: int) -> int:
    digest = hashlib.blake2b(f"{recording}:{index}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big")
