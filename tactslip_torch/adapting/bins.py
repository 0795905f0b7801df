"""Bins of which more is known than their sums: witnesses of training, and recordings brought later.

What they are for: scores of bins by the machine without their recording, which tell whether the old
materials are still known.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins, bin_keys
from tactslip_torch.planning import Plan


@dataclass(frozen=True, eq=False)
class RecordingBins:
    """All bins of one recording.

    Args:
        material: of the recording.
        z: ``[N, K]``, float64, scaled selected features.
        is_slip: ``[N]``, bool.
        key: digest of what determines the samples, as ``train_recordings`` of a detector has it.
    """

    material: str
    z: Tensor
    is_slip: Tensor
    key: str = ""


@dataclass(frozen=True, eq=False)
class Witnesses:
    """A bounded sample of the training bins, each in the sums with weight 1.

    Args:
        z: ``[n, K]``, float64, scaled selected features.
        is_slip: ``[n]``, bool.
        represents: ``[n]``, float64, for how many training bins each stands.
        recording: ``[n]``, int64, index into the two lists that follow.
        recordings: names.
        materials: of each of these recordings.
    """

    z: Tensor
    is_slip: Tensor
    represents: Tensor
    recording: Tensor
    recordings: tuple[str, ...]
    materials: tuple[str, ...]

    @classmethod
    def of(cls, plan: Plan, sample: SampledBins, materials: Mapping[str, str]) -> Witnesses:
        """Those bins of a survey's sample that were trained on.

        Args:
            plan: which features, how scaled, and which share of each class was trained on.
            sample: of the first pass.
            materials: of each recording, by its name.
        """
        shares = torch.tensor(plan.shares, dtype=torch.float64)[sample.is_slip.long()]
        most = int(sample.bin_index.max()) + 1
        keys = torch.stack([bin_keys(name, most) for name in sample.recording_names])
        kept = (shares >= 1) | (keys[sample.recording, sample.bin_index] < shares)
        return cls(
            plan.frame(sample.features[kept]),
            sample.is_slip[kept],
            (sample.represents * shares)[kept],
            sample.recording[kept],
            sample.recording_names,
            tuple(materials[name] for name in sample.recording_names),
        )

    def without(self, recordings: Collection[str]) -> Witnesses:
        """Those of other recordings."""
        out = torch.tensor([name in recordings for name in self.recordings])
        kept = ~out[self.recording]
        return Witnesses(
            self.z[kept],
            self.is_slip[kept],
            self.represents[kept],
            self.recording[kept],
            self.recordings,
            self.materials,
        )

    def tensors(self) -> dict[str, Tensor]:
        """For a file."""
        return {name: getattr(self, name) for name in ("z", "is_slip", "represents", "recording")}

    def facts(self) -> dict[str, Any]:
        """For a file, JSON-able."""
        return {"recordings": list(self.recordings), "materials": list(self.materials)}

    @classmethod
    def from_file(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Witnesses:
        """What ``facts`` and ``tensors`` told."""
        return cls(
            tensors["z"],
            tensors["is_slip"],
            tensors["represents"],
            tensors["recording"],
            tuple(facts["recordings"]),
            tuple(facts["materials"]),
        )


class KnownBins(NamedTuple):
    """Bins that are in the sums, of old and new materials.

    Attributes:
        z: ``[n, K]``, float64.
        is_slip: ``[n]``, bool.
        weight: ``[n]``, float64, of each bin in the sums.
        represents: ``[n]``, float64, total weight of the bins that it stands for.
        material: ``[n]``, int64, index into ``materials``.
        recording: ``[n]``, int64, index into ``recordings``.
        materials: names, ascending.
        recordings: names.
    """

    z: Tensor
    is_slip: Tensor
    weight: Tensor
    represents: Tensor
    material: Tensor
    recording: Tensor
    materials: tuple[str, ...]
    recordings: tuple[str, ...]

    def of(self, recordings: Collection[str]) -> Tensor:
        """Which bins are of these recordings, ``[n]``, bool."""
        return torch.tensor([name in recordings for name in self.recordings])[self.recording]


def known_bins(
    witnesses: Witnesses, bins: Mapping[str, RecordingBins], weights: Mapping[str, float]
) -> KnownBins:
    """Witnesses, and all bins of recordings that came later and are in.

    Args:
        witnesses: of training; those of recordings in ``bins`` give way to all of their bins.
        bins: by recording.
        weights: of a bin of each recording of ``bins``; 0 where it is out.
    """
    old = witnesses.without(bins)
    new = {name: own for name, own in sorted(bins.items()) if weights[name] > 0}
    materials = sorted({*old.materials, *(own.material for own in new.values())})
    place = torch.tensor([materials.index(name) for name in old.materials])
    sizes = torch.tensor([len(own.z) for own in new.values()], dtype=torch.int64)
    of_new = torch.arange(len(new)).repeat_interleave(sizes)
    weight = torch.tensor([weights[name] for name in new], dtype=torch.float64)[of_new]
    material = torch.tensor(
        [materials.index(own.material) for own in new.values()], dtype=torch.int64
    )[of_new]
    return KnownBins(
        torch.cat([old.z, *(own.z for own in new.values())]),
        torch.cat([old.is_slip, *(own.is_slip for own in new.values())]),
        torch.cat([torch.ones_like(old.represents), weight]),
        torch.cat([old.represents, weight]),
        torch.cat([place[old.recording], material]),
        torch.cat([old.recording, of_new + len(old.recordings)]),
        tuple(materials),
        (*old.recordings, *new),
    )
