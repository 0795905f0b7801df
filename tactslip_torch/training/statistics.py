"""What a detector is solved again from, in one file beside it: ``statistics.pt``.

Sums over all training bins, a bounded sample of these bins (``Rehearsal``), and all that came
later: recordings with their bins and weights, and every step with the detector it replaced. Bins
are taken out as they were taken in, so any step can be taken back.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins, bin_keys
from tactslip_torch.ledger import Ledger, content_digest
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.runtime import load_table, save_table
from tactslip_torch.training.selection import Plan


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
class Rehearsal:
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
    def of(cls, plan: Plan, sample: SampledBins, materials: Mapping[str, str]) -> Rehearsal:
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

    def without(self, recordings: Collection[str]) -> Rehearsal:
        """Those of other recordings."""
        out = torch.tensor([name in recordings for name in self.recordings])
        kept = ~out[self.recording]
        return Rehearsal(
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
    def from_file(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Rehearsal:
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


def _known_bins(
    rehearsal: Rehearsal, bins: Mapping[str, RecordingBins], weights: Mapping[str, float]
) -> KnownBins:
    """Rehearsal, and all bins of recordings that came later and are in.

    Args:
        rehearsal: of training; those of recordings in ``bins`` give way to all of their bins.
        bins: by recording.
        weights: of a bin of each recording of ``bins``; 0 where it is out.
    """
    old = rehearsal.without(bins)
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


FILE = "statistics.pt"
FORMAT = "tactslip_torch statistics 3"


@dataclass(frozen=True)
class Machine:
    """How sums become a machine.

    Args:
        penalty: the paper's ``C``.
        offset: the kernel's ``c``.
        balance: of the classes, as ``SufficientStats.solve`` takes it.
    """

    penalty: float
    offset: float
    balance: Literal["weights", "none"]


@dataclass(frozen=True, eq=False)
class Step:
    """One change of a detector.

    Args:
        entry: of the journal, JSON-able.
        weights: of ``Statistics``, before it.
        changed: weight before it of each recording that it changed.
        replaced: what it found under the names of recordings that came back with other bins.
        detector: digest of the detector before it.
        file: that detector's file, bytes.
    """

    entry: Mapping[str, Any]
    weights: Mapping[str, float]
    changed: Mapping[str, float]
    replaced: Mapping[str, RecordingBins]
    detector: str
    file: Tensor


@dataclass(frozen=True, eq=False)
class Statistics:
    """Sums, rehearsal, and what changed since training.

    Args:
        sums: over all bins that are in.
        machine: how they are solved.
        labels: how bins were laid and labelled, arguments of ``LabelRule``.
        rehearsal: of the training bins.
        detector: digest of the detector that these sums make.
        bins: of recordings that were added, or trained on and taken out, by name.
        weights: of a bin of each recording of ``bins``; 0 where it is out.
        steps: in their order.
    """

    sums: SufficientStats
    machine: Machine
    labels: Mapping[str, Any]
    rehearsal: Rehearsal
    detector: str
    bins: Mapping[str, RecordingBins]
    weights: Mapping[str, float]
    steps: Sequence[Step] = ()

    def weight_of(self, recording: str) -> float:
        """Of a bin of a recording: 1 as trained, 0 if it is not in."""
        return self.weights.get(recording, float(recording in self.sums.ledger.entries))

    def known(self) -> KnownBins:
        """Bins that are in the sums and known one by one."""
        return _known_bins(self.rehearsal, self.bins, self.weights)

    def reweighed(
        self, weights: Mapping[str, float], bins: Mapping[str, RecordingBins] | None = None
    ) -> Statistics:
        """The same with other weights of some recordings; exact, whatever was before.

        Args:
            weights: by recording; 0 takes it out.
            bins: of recordings that are not known yet, or are out and come back with others.

        Raises:
            ValueError: if a recording that is taken out holds something else than was put in, or
                the sums have no room.
        """
        known = {**self.bins, **(bins or {})}
        sums = copy.deepcopy(self.sums)
        for name, weight in weights.items():
            own, before = known[name], self.weight_of(name)
            if weight == before:
                continue
            for value, change in ((before, sums.remove), (weight, sums.update)):
                if value > 0:
                    change(name, own.z, own.is_slip, own.z.new_full((len(own.z),), value))
        return replace(self, sums=sums, bins=known, weights={**self.weights, **weights})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all."""
        facts = {
            "sums": {
                "num_features": self.sums.num_features,
                "about": self.sums.about,
            },
            "batches": self.sums.ledger.entries,
            "machine": vars(self.machine),
            "labels": dict(self.labels),
            "rehearsal": self.rehearsal.facts(),
            "detector": self.detector,
            "bins": _bins_facts(self.bins),
            "weights": dict(self.weights),
            "steps": [
                [
                    step.entry,
                    dict(step.weights),
                    dict(step.changed),
                    _bins_facts(step.replaced),
                    step.detector,
                ]
                for step in self.steps
            ],
        }
        tensors = {"sums": self.sums.sums, "count": self.sums.count}
        tensors |= {f"rehearsal.{name}": t for name, t in self.rehearsal.tensors().items()}
        tensors |= _bins_tensors("bins", self.bins)
        for number, step in enumerate(self.steps):
            tensors |= {f"steps.{number}": step.file}
            tensors |= _bins_tensors(f"steps.{number}.replaced", step.replaced)
        save_table(path, FORMAT, facts, tensors)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Statistics:
        """What ``save`` wrote; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is another kind of file, or damaged.
        """
        facts, tensors = load_table(path, FORMAT)
        sums = SufficientStats(**facts["sums"])
        sums.ledger = Ledger(facts["batches"])
        sums.sums, sums.count = tensors["sums"], tensors["count"]
        of_witnesses = {n.partition(".")[2]: t for n, t in tensors.items() if n[:9] == "rehearsal"}
        return cls(
            sums,
            Machine(**facts["machine"]),
            facts["labels"],
            Rehearsal.from_file(facts["rehearsal"], of_witnesses),
            facts["detector"],
            _bins_of_file(facts["bins"], tensors, "bins"),
            facts["weights"],
            tuple(
                Step(
                    entry,
                    weights,
                    changed,
                    _bins_of_file(replaced, tensors, f"steps.{number}.replaced"),
                    digest,
                    tensors[f"steps.{number}"],
                )
                for number, (entry, weights, changed, replaced, digest) in enumerate(facts["steps"])
            ),
        )


def _bins_facts(bins: Mapping[str, RecordingBins]) -> list[list[str]]:
    return [[name, own.material, own.key] for name, own in bins.items()]


def _bins_tensors(place: str, bins: Mapping[str, RecordingBins]) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for number, own in enumerate(bins.values()):
        found |= {f"{place}.{number}.z": own.z, f"{place}.{number}.is_slip": own.is_slip}
    return found


def _bins_of_file(
    facts: Sequence[Sequence[str]], tensors: Mapping[str, Tensor], place: str
) -> dict[str, RecordingBins]:
    return {
        name: RecordingBins(
            material, tensors[f"{place}.{number}.z"], tensors[f"{place}.{number}.is_slip"], key
        )
        for number, (name, material, key) in enumerate(facts)
    }


def detector_digest(detector: SlipDetector) -> str:
    """Of what a detector computes with: scaling and machine, whatever else its file says."""
    state = detector.state_dict()
    names = sorted(name for name in state if name.startswith(("scaler.", "head.")))
    places = torch.tensor(detector.selected)
    return content_digest(places, *(state[name] for name in names))


def statistics_of(model: str | os.PathLike[str], detector: SlipDetector) -> Statistics:
    """The statistics beside a detector's file.

    Args:
        model: where the detector is.
        detector: what is there.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if they are damaged, or of another detector.
    """
    path = Path(model).with_name(FILE)
    if not path.is_file():
        raise FileNotFoundError(
            f"no {FILE} beside {model}; train with recipe=robust statistics=true, which leaves it "
            "there"
        )
    found = Statistics.load(path)
    if found.detector != (digest := detector_digest(detector)):
        if found.steps and found.steps[-1].detector == digest:
            raise ValueError(
                f"{path} is one step ahead of {model}, as when writing was cut off between the "
                "two; action=undo takes that step back"
            )
        raise ValueError(f"{path} belongs to another detector than {model}; train again")
    return found


@contextmanager
def locked(model: str | os.PathLike[str]) -> Iterator[None]:
    """A lock file beside a detector, for as long as it is changed.

    A program that is killed leaves it; the message to the next says how to go on.

    Raises:
        ValueError: if another program changes the detector.

    Example:
        >>> model = getfixture("tmp_path") / "detector.pt"
        >>> with locked(model):
        ...     [path.name for path in model.parent.iterdir()]
        ['.detector.pt.lock']
        >>> list(model.parent.iterdir())
        []
    """
    path = Path(model).with_name(f".{Path(model).name}.lock")
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    except FileExistsError:
        raise ValueError(
            f"another adapt is changing {os.fspath(model)}; wait for it or, if none runs any more, "
            f"remove {path}"
        ) from None
    try:
        os.close(descriptor)
        yield
    finally:
        path.unlink(missing_ok=True)
