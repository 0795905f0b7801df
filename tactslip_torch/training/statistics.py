"""What a detector is solved again from, in one file beside it: ``statistics.pt``.

Sums over all training bins, a bounded sample of these bins, and all that came later: recordings
with their bins and weights, and every step with the detector it replaced. Bins are taken out as
they were taken in, so any step can be taken back.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins, bin_keys
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.runtime import SeenBatches, content_digest, load_table, save_table
from tactslip_torch.training.selection import Plan

FILE = "statistics.pt"
FORMAT = "tactslip_torch statistics 3"


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
class KnownBins:
    """Bins in the sums that are known one by one: a sample of training, and all that were added.

    Args:
        z: ``[n, K]``, float64, scaled selected features.
        is_slip: ``[n]``, bool.
        weight: ``[n]``, float64, of each bin in the sums; 1 of those of training.
        sample_weight: ``[n]``, float64, total weight of the bins that it was drawn from.
        recording: ``[n]``, int64, index into the two lists that follow.
        recordings: names.
        materials: of each of these recordings.
    """

    z: Tensor
    is_slip: Tensor
    weight: Tensor
    sample_weight: Tensor
    recording: Tensor
    recordings: tuple[str, ...]
    materials: tuple[str, ...]

    @classmethod
    def of(cls, plan: Plan, sample: SampledBins, materials: Mapping[str, str]) -> KnownBins:
        """Those bins of the first pass's sample that were trained on.

        Args:
            plan: which features, how scaled, and which part of each class was trained on.
            sample: of the first pass.
            materials: of each recording, by its name.
        """
        part = torch.tensor(plan.fractions, dtype=torch.float64)[sample.is_slip.long()]
        most = int(sample.bin_index.max()) + 1
        keys = torch.stack([bin_keys(name, most) for name in sample.recording_names])
        kept = (part >= 1) | (keys[sample.recording, sample.bin_index] < part)
        return cls(
            plan.selection(sample.features[kept]),
            sample.is_slip[kept],
            torch.ones_like(part[kept]),
            (sample.represents * part)[kept],
            sample.recording[kept],
            sample.recording_names,
            tuple(materials[name] for name in sample.recording_names),
        )

    def with_others(
        self, bins: Mapping[str, RecordingBins], weights: Mapping[str, float]
    ) -> KnownBins:
        """These without the bins of some recordings, in whose place come all that are weighed."""
        out = torch.tensor([name in bins for name in self.recordings])
        kept = ~out[self.recording]
        new = {name: own for name, own in sorted(bins.items()) if weights[name] > 0}
        sizes = torch.tensor([len(own.z) for own in new.values()], dtype=torch.int64)
        place = torch.arange(len(new)).repeat_interleave(sizes)
        weight = torch.tensor([weights[name] for name in new], dtype=torch.float64)[place]
        return KnownBins(
            torch.cat([self.z[kept], *(own.z for own in new.values())]),
            torch.cat([self.is_slip[kept], *(own.is_slip for own in new.values())]),
            torch.cat([self.weight[kept], weight]),
            torch.cat([self.sample_weight[kept], weight]),
            torch.cat([self.recording[kept], place + len(self.recordings)]),
            (*self.recordings, *new),
            (*self.materials, *(own.material for own in new.values())),
        )

    @property
    def material_names(self) -> list[str]:
        """Of all recordings, ascending."""
        return sorted(set(self.materials))

    @property
    def material(self) -> Tensor:
        """``[n]``, int64, index into ``material_names``."""
        names = self.material_names
        return torch.tensor([names.index(name) for name in self.materials])[self.recording]

    def of_recordings(self, recordings: Collection[str]) -> Tensor:
        """Which bins are of these recordings, ``[n]``, bool."""
        return torch.tensor([name in recordings for name in self.recordings])[self.recording]


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
    """Sums, a sample of training bins, and what changed since training.

    Args:
        sums: over all bins that are in.
        machine: how they are solved.
        labels: how bins were laid and labelled, arguments of ``LabelRule``.
        rehearsal: a bounded sample of the training bins.
        detector: digest of the detector that these sums make.
        bins: of recordings that were added, or trained on and taken out, by name.
        weights: of a bin of each recording of ``bins``; 0 where it is out.
        steps: in their order.
    """

    sums: SufficientStats
    machine: Machine
    labels: Mapping[str, Any]
    rehearsal: KnownBins
    detector: str
    bins: Mapping[str, RecordingBins]
    weights: Mapping[str, float]
    steps: Sequence[Step] = ()

    def weight_of(self, recording: str) -> float:
        """Of a bin of a recording: 1 as trained, 0 if it is not in."""
        return self.weights.get(recording, float(recording in self.sums.seen_batches))

    def known(self) -> KnownBins:
        """Bins that are in the sums and known one by one."""
        return self.rehearsal.with_others(self.bins, self.weights)

    @property
    def materials(self) -> dict[str, str]:
        """The material of every recording that is or was in, by name."""
        trained = dict(zip(self.rehearsal.recordings, self.rehearsal.materials, strict=True))
        return trained | {name: own.material for name, own in self.bins.items()}

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
        tensors = {"sums": self.sums.sums, "count": self.sums.count}
        rehearsal = vars(self.rehearsal)
        for name, value in rehearsal.items():
            if isinstance(value, Tensor):
                tensors[f"rehearsal.{name}"] = value

        def listed(bins: Mapping[str, RecordingBins], place: str) -> list[list[str]]:
            for number, own in enumerate(bins.values()):
                tensors[f"{place}.{number}.z"] = own.z
                tensors[f"{place}.{number}.is_slip"] = own.is_slip
            return [[name, own.material, own.key] for name, own in bins.items()]

        for number, step in enumerate(self.steps):
            tensors[f"steps.{number}"] = step.file
        metadata = {
            "sums": {"num_features": self.sums.num_features, "about": self.sums.about},
            "batches": self.sums.seen_batches,
            "machine": vars(self.machine),
            "labels": dict(self.labels),
            "rehearsal": {name: rehearsal[name] for name in ("recordings", "materials")},
            "detector": self.detector,
            "bins": listed(self.bins, "bins"),
            "weights": dict(self.weights),
            "steps": [
                {name: value for name, value in vars(step).items() if name != "file"}
                | {"replaced": listed(step.replaced, f"steps.{number}.replaced")}
                for number, step in enumerate(self.steps)
            ],
        }
        save_table(path, FORMAT, metadata, tensors)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Statistics:
        """What ``save`` wrote; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is another kind of file, or damaged.
        """
        metadata, tensors = load_table(path, FORMAT)
        sums = SufficientStats(**metadata["sums"])
        sums.seen_batches = SeenBatches(metadata["batches"])
        sums.sums, sums.count = tensors["sums"], tensors["count"]

        def bins(listed: Sequence[Sequence[str]], place: str) -> dict[str, RecordingBins]:
            found = {}
            for number, (name, material, key) in enumerate(listed):
                at = f"{place}.{number}"
                z, is_slip = tensors[f"{at}.z"], tensors[f"{at}.is_slip"]
                found[name] = RecordingBins(material, z, is_slip, key)
            return found

        start = "rehearsal."
        rehearsal: dict[str, Any] = {
            name.removeprefix(start): x for name, x in tensors.items() if name.startswith(start)
        }
        rehearsal |= {name: tuple(value) for name, value in metadata["rehearsal"].items()}
        steps = []
        for number, plain in enumerate(metadata["steps"]):
            replaced = bins(plain["replaced"], f"steps.{number}.replaced")
            steps.append(Step(**plain | {"replaced": replaced, "file": tensors[f"steps.{number}"]}))
        return cls(
            sums,
            Machine(**metadata["machine"]),
            metadata["labels"],
            KnownBins(**rehearsal),
            metadata["detector"],
            bins(metadata["bins"], "bins"),
            metadata["weights"],
            tuple(steps),
        )


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
