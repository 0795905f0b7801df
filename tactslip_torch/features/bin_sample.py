"""A bounded random sample of bins that any worker would have drawn.

A bin's key is a hash of its recording and number. The sample of a stratum (group and class) is
the bins of smallest key, so it depends on which bins there are and on nothing else: not on their
order, not on who saw them, and on no random state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

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


@dataclass
class _Stratum:
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
                places = [(_key(recording, row), recording, row) for row in rows]
                self._add((group, label), _Stratum(len(rows), places, features[rows]))

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
            self._add(name, part)

    def bins(self) -> SampledBins:
        """The sample, in an order that depends on the bins alone."""
        facts, tensors = self.state_dict().values()
        kept = torch.tensor([num_kept for *_, num_kept in facts["strata"]], dtype=torch.int64)
        seen = torch.tensor([num for *_, num, _ in facts["strata"]], dtype=torch.float64)
        groups = sorted({group for group, *_ in facts["strata"]})
        group = torch.tensor([groups.index(g) for g, *_ in facts["strata"]], dtype=torch.int64)
        is_slip = torch.tensor([label for _, label, *_ in facts["strata"]], dtype=torch.bool)
        # by recording, then by number
        order = tensors["bin_index"].argsort(stable=True)
        order = order[tensors["recording"][order].argsort(stable=True)]
        stratum = torch.arange(len(kept)).repeat_interleave(kept)[order]
        return SampledBins(
            features=tensors["features"][order],
            is_slip=is_slip[stratum],
            group=group[stratum],
            group_names=tuple(groups),
            recording=tensors["recording"][order],
            recording_names=tuple(facts["recordings"]),
            bin_index=tensors["bin_index"][order],
            sample_weight=(seen / kept)[stratum],
        )

    def state_dict(self) -> dict[str, Any]:
        """``facts`` that JSON holds and ``tensors`` by name, the same for the same bins."""
        strata = sorted(self._strata.items())
        places = [place for _, part in strata for place in part.places]
        recordings = sorted({recording for _, recording, _ in places})
        number = {recording: i for i, recording in enumerate(recordings)}
        features = [part.features for _, part in strata]
        return {
            "facts": {
                "most": self.most,
                "strata": [[*name, part.num_seen, len(part.places)] for name, part in strata],
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
        bins = zip(recordings, tensors["bin_index"].tolist(), strict=True)
        places = [(_key(*place), *place) for place in bins]
        stop = 0
        for group, label, num_seen, num_kept in facts["strata"]:
            own = slice(stop, stop := stop + num_kept)
            part = _Stratum(num_seen, places[own], tensors["features"][own])
            sample._add((group, label), part)
        return sample

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

    def _width(self) -> int | None:
        """How many features the bins have; None before the first."""
        return next((part.features.shape[1] for part in self._strata.values()), None)

    def _check_width(self, width: int) -> None:
        if self._width() not in (None, width):
            raise ValueError(f"the sample has bins of {self._width()} features, got {width}")


def _uniform(places: Iterable[tuple[str, int]]) -> Tensor:
    keys = [_key(*place) >> 11 for place in places]
    return torch.tensor(keys, dtype=torch.float64) * 2.0**-53


def _key(recording: str, index: int) -> int:
    digest = hashlib.blake2b(f"{recording}:{index}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big")
