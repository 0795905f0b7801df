"""A new material in a detector without training again: recordings into its sums, and out again.

``statistics.pt`` beside a detector keeps what it is solved again from: sums over all training bins,
a bounded sample of these bins, and all that came later: recordings with their bins and weights, and
every step with the detector it replaced. Bins are taken out as they were put in, so any step can be
undone.

A change is accepted only if the old materials keep their accuracy. What every known bin scores by
the machine without its recording follows in closed form from the factor that solves for the machine
(``model.fit.HeldOut``). Of an added recording all bins are known, of one trained on those
sampled; its other bins stay in, so a score is a little better than that of a machine without the
recording, before and after a change alike.
"""

from __future__ import annotations

import bisect
import copy
import itertools
import logging
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import (
    MOST_CONDITION,
    HeldOut,
    TrainingBins,
    ordered_groups,
    residuals_without,
)
from tactslip_torch.model.kernels import Polynomial, QuadraticForm
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.onset.decisions import KEY as ALARM
from tactslip_torch.own_files import FORGED, load_table, save_table
from tactslip_torch.own_files import STATISTICS as _FORMAT
from tactslip_torch.runtime import bar, content_digest
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.plan import TrainingPass, solve_metadata
from tactslip_torch.training.recipe import recalls

log = logging.getLogger(__name__)

FILE = "statistics.pt"

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Weights that ``auto`` tries, in parts of that of an average old material.

Where every training material in turn was new (simulated, ``benchmarks.adapting``), its own accuracy
kept rising to about the last of these, and what the others lost rose with it.
"""

_JOURNAL = "adaptations"  # under which SlipDetector.info keeps the entries of all steps
_MOST_WEIGHT = 8000.0  # of a bin; more would hide the others
_OF_ONE = 4.0
"""A single material may fall by so many margins: some 800 sampled bins tell its change to half a
point at best, so a tighter limit would refuse by chance. Their mean is known far better."""
_OF_MARGIN = 0.5
"""``auto`` spends this part of the margin: how far old materials fall is itself an estimate."""


# What a detector is solved again from ------------------------------------------------------------


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

    def __post_init__(self) -> None:
        each = (self.is_slip, self.weight, self.sample_weight, self.recording)
        is_whole = all(x.shape == (len(self.z),) for x in each)
        if not is_whole or len(self.recordings) != len(self.materials):
            raise ValueError("known bins must have a class, weights and a recording each")
        places = self.recording
        if len(places) and not 0 <= int(places.min()) <= int(places.max()) < len(self.recordings):
            raise ValueError(f"recordings of bins must lie in 0..{len(self.recordings) - 1}")

    def with_others(
        self, bins: Mapping[str, RecordingBins], weights: Mapping[str, float]
    ) -> KnownBins:
        """These with the bins of some recordings replaced: by all, or by none at weight 0."""
        kept = ~self.of_recordings(bins)
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
        replaced: bins before it of recordings that came back with others.
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
    bins: Mapping[str, RecordingBins] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)
    steps: Sequence[Step] = ()

    @classmethod
    def of_training(
        cls,
        gathered: TrainingPass,
        sample: SampledBins,
        materials: Mapping[str, str],
        labels: Mapping[str, Any],
        detector: SlipDetector,
    ) -> Statistics:
        """What a second pass gathered, with a sample of its bins.

        A machine of few bins was solved from the bins themselves; their sums give the same to
        rounding.

        Args:
            gathered: the second pass, with its plan.
            sample: of the first pass.
            materials: of each training recording, by its name.
            labels: arguments of ``LabelRule``.
            detector: that was solved.
        """
        plan = gathered.plan
        assert isinstance(plan.kernel, Polynomial)  # check_recipe
        sums = gathered.stats
        if sums is None:
            sums = SufficientStats(len(plan.selection.selected))
            for name in sorted(gathered.bins):
                sums.update(name, *gathered.bins[name])
        # of the sampled bins those that were trained on
        fraction = torch.tensor(plan.fractions, dtype=torch.float64)[sample.is_slip.long()]
        kept = (fraction >= 1) | (sample.keys < fraction)
        rehearsal = KnownBins(
            plan.selection(sample.features[kept]),
            sample.is_slip[kept],
            torch.ones_like(fraction[kept]),
            (sample.sample_weight * fraction)[kept],
            sample.recording[kept],
            sample.recording_names,
            tuple(materials[name] for name in sample.recording_names),
        )
        machine = Machine(plan.penalty, plan.kernel.offset, plan.balance)
        return cls(sums, machine, dict(labels), rehearsal, detector_digest(detector))

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
            ValueError: if a recording that is taken out holds something else than was put in.
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

    def with_step(
        self, after: Statistics, entry: Mapping[str, object], file: Tensor, digest: str
    ) -> Statistics:
        """The statistics after a change of these, with the step.

        Args:
            after: the changed ones.
            entry: of the journal.
            file: of the detector before it, bytes.
            digest: of the detector after it.
        """
        changed = {
            name: before
            for name in after.bins
            if (before := self.weight_of(name)) != after.weight_of(name)
        }
        replaced = {name: own for name, own in self.bins.items() if own is not after.bins[name]}
        step = Step(entry, self.weights, changed, replaced, self.detector, file)
        return replace(after, steps=(*self.steps, step), detector=digest)

    def undo(self) -> tuple[Statistics, Tensor]:
        """The statistics before the last step, and the file of the detector they belong to.

        Raises:
            ValueError: if there is no step.
        """
        if not self.steps:
            raise ValueError("there is nothing to undo: this detector is as it was trained")
        *earlier, last = self.steps
        back = self.reweighed(dict.fromkeys(last.changed, 0.0))
        back = back.reweighed(last.changed, last.replaced)
        bins = {name: own for name, own in back.bins.items() if name in last.weights}
        steps = tuple(earlier)
        state = replace(back, bins=bins, weights=last.weights, steps=steps, detector=last.detector)
        return state, last.file

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all."""
        plain = vars(self) | {
            "sums": {
                "num_features": self.sums.num_features,
                "about": self.sums.about,
                "seen_batches": dict(self.sums.seen_batches),
                "sums": self.sums.sums,
                "count": self.sums.count,
            }
        }
        tensors: dict[str, Tensor] = {}
        save_table(path, _FORMAT, _without_tensors(plain, tensors), tensors)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Statistics:
        """What ``save`` wrote; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is another kind of file, or damaged.
        """
        metadata, tensors = load_table(path, _FORMAT)
        try:
            return cls._restored(_with_tensors(metadata, tensors))
        except FORGED as error:
            raise ValueError(f"{os.fspath(path)} is damaged: {error}; train again") from error

    @classmethod
    def _restored(cls, plain: dict[str, Any]) -> Statistics:
        of_sums = plain["sums"]
        rehearsal = plain["rehearsal"]
        for name in ("recordings", "materials"):
            rehearsal[name] = tuple(rehearsal[name])

        def bins(by_name: Mapping[str, Any]) -> dict[str, RecordingBins]:
            return {name: RecordingBins(**own) for name, own in by_name.items()}

        steps = [Step(**own | {"replaced": bins(own["replaced"])}) for own in plain["steps"]]
        restored = {
            "sums": SufficientStats.restored(batches=of_sums.pop("seen_batches"), **of_sums),
            "machine": Machine(**plain["machine"]),
            "rehearsal": KnownBins(**rehearsal),
            "bins": bins(plain["bins"]),
            "steps": tuple(steps),
        }
        made = cls(**plain | restored)
        num = made.sums.num_features
        every: list[KnownBins | RecordingBins] = [made.rehearsal, *made.bins.values()]
        for own in every:
            if own.z.shape != (len(own.is_slip), num) or own.is_slip.dtype != torch.bool:
                raise ValueError(f"bins must have {num} features and their classes")
        return made


def _without_tensors(value: Any, tensors: dict[str, Tensor], path: str = "") -> Any:
    """A tree of dataclasses, mappings and lists in what JSON has; its tensors go by their path."""
    if isinstance(value, Tensor):
        tensors[path] = value
        return {"tensor": path}
    if isinstance(value, list | tuple):
        return [_without_tensors(x, tensors, f"{path}/{i}") for i, x in enumerate(value)]
    if isinstance(value, RecordingBins | KnownBins | Machine | Step):
        value = vars(value)
    if isinstance(value, Mapping):
        return {name: _without_tensors(x, tensors, f"{path}/{name}") for name, x in value.items()}
    return value


def _with_tensors(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The tree that ``_without_tensors`` wrote, dataclasses as dictionaries."""
    if isinstance(value, list):
        return [_with_tensors(item, tensors) for item in value]
    if isinstance(value, dict):
        if value.keys() == {"tensor"}:
            return tensors[value["tensor"]]
        return {name: _with_tensors(item, tensors) for name, item in value.items()}
    return value


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
        path.touch(exist_ok=False)
    except FileExistsError:
        raise ValueError(
            f"another adapt is changing {os.fspath(model)}; wait for it or, if none runs any more, "
            f"remove {path}"
        ) from None
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


# Machines, and what they score without a recording -----------------------------------------------


class Solved(NamedTuple):
    """A machine, and what known bins score without their recordings.

    Attributes:
        head: the machine of all bins.
        known: the bins.
        scores: ``[n]``, of these.
    """

    head: QuadraticForm
    known: KnownBins
    scores: Tensor

    def accuracies(self, recordings: Collection[str]) -> dict[str, float]:
        """Mean recall of every material in these recordings, from held-out scores."""
        known, says_slip = self.known, self.scores >= 0
        wanted, material = known.of_recordings(recordings), known.material
        return {
            name: mean_recall(says_slip[mine], known.is_slip[mine])
            for number, name in enumerate(known.material_names)
            if bool((mine := wanted & (material == number)).any())
        }


def solve(statistics: Statistics) -> Solved:
    """The machine of the sums, and the scores of known bins.

    Takes what ``SufficientStats.solve`` takes, and ``P^2 / 2`` multiply-adds for each known bin.

    Raises:
        ValueError: if a class is absent, the system is too ill-conditioned to tell machines without
            a recording, or a recording weighs so much that the machine without it cannot be told.
    """
    sums, machine, known = statistics.sums, statistics.machine, statistics.known()
    kernel = Polynomial(2, machine.offset)
    normal, moment = sums.normal_equations(machine.offset, balance=machine.balance)
    head, factor = kernel.solve(normal, moment, machine.penalty, sums.num_features, MOST_CONDITION)
    assert factor is not None  # as most_condition is given
    order, groups = ordered_groups(known.recording)
    z, is_slip = known.z[order], known.is_slip[order]
    scale = sums.class_scale(machine.balance)
    roots = (scale[is_slip.long()] * known.weight[order]).sqrt()
    targets = torch.where(is_slip, 1.0, -1.0).double()
    residuals = residuals_without(groups, kernel, factor, z, roots, targets - head(z))
    scores = torch.empty_like(residuals)
    scores[order] = targets - residuals
    return Solved(head, known, scores)


def mean_recall(says_slip: Tensor, is_slip: Tensor) -> float:
    """Mean recall of the classes that are there: the balanced accuracy, or one recall.

    Shape:
        - says_slip, is_slip: ``[N]``, bool, N at least 1
    """
    return fmean(recalls(says_slip, is_slip))


@dataclass(frozen=True)
class AccuracyChange:
    """Balanced accuracy of every old material before and after a change.

    Args:
        before: by material, from 0 to 1, each bin scored by the machine without its recording.
        after: likewise, of the same materials.
    """

    before: Mapping[str, float]
    after: Mapping[str, float]

    @classmethod
    def of(cls, before: Mapping[str, float], after: Mapping[str, float]) -> AccuracyChange:
        """Of the materials in both."""
        both = sorted(before.keys() & after.keys())
        return cls({n: before[n] for n in both}, {n: after[n] for n in both})

    @property
    def mean_fall(self) -> float:
        """How much they lose on average; 0 if there is none."""
        return sum(self._falls.values()) / max(len(self.before), 1)

    @property
    def _falls(self) -> dict[str, float]:
        return {name: before - self.after[name] for name, before in self.before.items()}

    def problem(self, margin: float) -> str | None:
        """Why the change is not accepted, in a line with figures; ``None`` if it is.

        Args:
            margin: that the mean may fall by; any one material by ``_OF_ONE`` times as much.
        """
        if not self.before:
            return None
        if self.mean_fall > margin:
            mean = [sum(of.values()) / len(of) for of in (self.before, self.after)]
            return (
                f"old materials fall from {100 * mean[0]:.2f} to {100 * mean[1]:.2f} % balanced "
                f"accuracy on average, {100 * margin:g} points are allowed"
            )
        worst = max(self._falls, key=self._falls.__getitem__)
        if self._falls[worst] > _OF_ONE * margin:
            return (
                f"{worst} falls from {100 * self.before[worst]:.2f} to "
                f"{100 * self.after[worst]:.2f} % balanced accuracy, {100 * _OF_ONE * margin:g} "
                "points are allowed of one material"
            )
        return None


# Steps -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Change:
    """What a step would make.

    Args:
        statistics: after it.
        solved: their machine.
        old: old materials, before and after, on the recordings that both machines know.
        since_training: those of them that there were before the first step, as they were then,
            and after.
        weight: of a bin that was added; ``None`` where none was.
        factor: the weight in parts of an average old material, where ``auto`` chose it.
        tried: such parts, each with the mean fall it brought; those that led to a machine.
        new: balanced accuracy of the recordings that were added: ``before``, by the machine
            without them, and ``after``, each without its own recording; of a lone recording that
            is ``None``.
    """

    statistics: Statistics
    solved: Solved
    old: AccuracyChange
    since_training: AccuracyChange
    weight: float | None = None
    factor: float | None = None
    tried: Mapping[float, float] = field(default_factory=dict)
    new: Mapping[str, float | None] = field(default_factory=dict)

    @classmethod
    def between(
        cls, statistics: Statistics, before: Solved, after: Statistics, weight: float | None = None
    ) -> Change:
        """From some statistics and their machine to others.

        Raises:
            ValueError: as ``solve``.
        """
        solved = solve(after)
        both = set(before.known.recordings) & set(solved.known.recordings)
        old = AccuracyChange.of(before.accuracies(both), solved.accuracies(both))
        first = statistics.steps[0].entry.get("old", {}).get("before") if statistics.steps else None
        since_training = AccuracyChange.of(first or old.before, old.after)
        return cls(after, solved, old, since_training, weight)

    def problem(self, margin: float, fraction: float = 1.0) -> str | None:
        """Why the old materials do not allow it, in a line; ``None`` if they do.

        Args:
            margin: that their mean may fall by, by all steps together.
            fraction: of it that this step may take.
        """
        if problem := self.old.problem(fraction * margin):
            return problem
        problem = self.since_training.problem(margin)
        return problem and f"since before the first step, {problem}"


def add(
    statistics: Statistics,
    before: Solved,
    bins: Mapping[str, RecordingBins],
    weight: float | None,
    margin: float,
) -> Change:
    """Recordings of one material come in.

    All recordings of the material that were added, now or earlier, get one weight.

    Args:
        statistics: as they are.
        before: their machine.
        bins: of the recordings, by name; of one material.
        weight: of a bin, where one of training has 1; ``None`` for ``auto``, the largest of
            ``FACTORS`` by which old materials keep ``_OF_MARGIN`` of the margin, in all steps the
            margin; a weight that leads to no machine is too large.
        margin: that the old materials' mean may fall by.

    Raises:
        ValueError: if a recording is in already, there are several materials or no bins, the weight
            is not positive, or as ``solve``; of ``auto``, at the smallest weight.
    """
    _check_new(statistics, bins)
    checked_weight("auto" if weight is None else weight)
    material = next(iter(bins.values())).material
    mine = dict(bins) | {
        name: own
        for name, own in statistics.bins.items()
        if own.material == material and statistics.weight_of(name) > 0
    }

    def change(value: float) -> Change:
        after = statistics.reweighed(dict.fromkeys(mine, value), bins)
        return Change.between(statistics, before, after, value)

    tried: dict[float, Change] = {}
    if weight is not None:
        chosen = change(weight)
    else:
        unit = _average_weight(before.known, material, list(mine.values()))

        def is_refused(factor: float) -> bool:
            with suppress(ValueError):
                tried[factor] = replace(change(factor * unit), factor=factor)
            return factor not in tried or bool(tried[factor].problem(margin, _OF_MARGIN))

        factor = FACTORS[bisect.bisect_left(FACTORS, True, lo=1, key=is_refused) - 1]
        chosen = tried.get(factor) or replace(change(factor * unit), factor=factor)
        tried[factor] = chosen
    falls = {factor: of.old.mean_fall for factor, of in sorted(tried.items())}
    own = [each for each in bins.values() if len(each.z)]
    says_slip = torch.cat([before.head(each.z) >= 0 for each in own])
    found = {
        "before": mean_recall(says_slip, torch.cat([each.is_slip for each in own])),
        "after": chosen.solved.accuracies(bins)[material] if len(own) > 1 else None,
    }
    return replace(chosen, tried=falls, new=found)


def forget(statistics: Statistics, before: Solved, bins: Mapping[str, RecordingBins]) -> Change:
    """Recordings go out again, exactly.

    Args:
        statistics: as they are.
        before: their machine.
        bins: of the recordings to take out, by name; those that training put in must hold what it
            put in, to the bit.

    Raises:
        ValueError: if one is not in or holds something else, no class is left, or as ``solve``.
    """
    if absent := [name for name in bins if not statistics.weight_of(name)]:
        raise ValueError(
            f"{absent[0]} is not in these statistics; action=list shows what was added"
        )
    return Change.between(statistics, before, statistics.reweighed(dict.fromkeys(bins, 0.0), bins))


def checked_weight(given: Any) -> float | None:
    """The weight of a bin as ``adapt`` takes it; ``None`` of ``"auto"``.

    Raises:
        ValueError: if it is no positive number, or too large.
    """
    if given == "auto":
        return None
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    if not is_number or not 0 < given < _MOST_WEIGHT:
        raise ValueError(
            f"weight must be auto or a positive number below {_MOST_WEIGHT:g}, got {given!r}"
        )
    weight: float = given
    return weight


def _check_new(statistics: Statistics, bins: Mapping[str, RecordingBins]) -> None:
    if not any(len(own.z) for own in bins.values()):
        raise ValueError("there is no labelled bin in these recordings; say when they slip")
    materials = sorted({own.material for own in bins.values()})
    if len(materials) > 1:
        raise ValueError(
            f"one material at a time, got {', '.join(materials)}; choose by data.materials=[...], "
            "or name them all material=NAME"
        )
    if there := [name for name in bins if statistics.weight_of(name) > 0]:
        raise ValueError(
            f"{there[0]} is in already; forget it first, or give another name, material=NAME"
        )


def _average_weight(known: KnownBins, material: str, mine: Sequence[RecordingBins]) -> float:
    """Of a bin of new recordings that together weigh as much as an average old material.

    Only classes that the new recordings have are counted.
    """
    is_slip = torch.cat([own.is_slip for own in mine])
    counted = (known.is_slip & is_slip.any()) | (~known.is_slip & (~is_slip).any())
    totals = [
        float(known.sample_weight[counted & (known.material == number)].sum())
        for number, name in enumerate(known.material_names)
        if name != material
    ]
    totals = [total for total in totals if total > 0]
    return sum(totals) / len(totals) / len(is_slip) if totals else 1.0


# The detector after a step -----------------------------------------------------------------------


def refitted(
    detector: SlipDetector, statistics: Statistics, solved: Solved, entry: Mapping[str, Any]
) -> SlipDetector:
    """A detector with another machine; features, scaling and filter stay.

    As training does it, but of the bins that are known: imputation values; the calibration, of
    scores by machines without the bin's material, an alarm's too. An alarm keeps its threshold,
    which then stands for no rate.

    Args:
        detector: as it was; kept.
        statistics: after the step.
        solved: their machine.
        entry: of the journal.
    """
    new, known, machine = copy.deepcopy(detector), solved.known, statistics.machine
    new.head = solved.head
    scale = statistics.sums.class_scale(machine.balance)
    weights = scale[known.is_slip.long()] * known.sample_weight
    bins = TrainingBins(known.z, known.is_slip, weights)
    z, is_slip = bins.features.double(), bins.is_slip
    means = [weights[own] @ z[own] / weights[own].sum() for own in (is_slip, ~is_slip)]
    new.imputation.copy_((means[0] + means[1]) / 2)  # both classes counting alike
    info, taken_in = new.info, statistics.sums.seen_batches
    info["solve"] = solve_metadata(solved.head)
    info["num_bins"] = int(statistics.sums.count.sum())
    info[_JOURNAL] = [*info.get(_JOURNAL, []), dict(entry)]
    info["train_materials"] = [known.material_names[i] for i in known.material.unique()]
    keys = info.get("train_recordings", {}) | {n: b.key for n, b in statistics.bins.items()}
    out = {name for name in statistics.bins if name not in taken_in}
    info["train_recordings"] = {name: key for name, key in keys.items() if name not in out}
    if info.get("calibration") or ALARM in info:
        calibration = None
        try:
            scores = _scores_without(known.material, bins, machine)
            calibration = fit_platt(scores, known.is_slip, weights).to_dict()
        except ValueError as error:
            log.warning("the calibration stays as it was: %s", error)
        if info.get("calibration"):
            info["calibration"] = calibration or info["calibration"]
        if ALARM in info:
            info[ALARM] = _alarm(info[ALARM], calibration)
    return new


def _scores_without(groups: Tensor, bins: TrainingBins, machine: Machine) -> Tensor:
    """Of each known bin, by the machine of known bins without its group."""
    return HeldOut(bins, groups, Polynomial(2, machine.offset)).at(machine.penalty).scores


def _alarm(plain: Mapping[str, Any], calibration: Mapping[str, Any] | None) -> dict[str, Any]:
    """Settings of an alarm without its rate, with the calibration if there is a new one."""
    which = "that of the machine before" if calibration is None else "made anew"
    adapted = (
        "the machine changed after the threshold was set: it stands for no rate; the calibration "
        f"is {which}; train with +exp=onset"
    )
    return {
        **plain,
        "calibration": calibration or plain["calibration"],
        "target_per_hour": None,
        "metadata": {**(plain.get("metadata") or {}), "adapted": adapted},
    }


# Recordings of a source --------------------------------------------------------------------------


def recording_bins(
    detector: SlipDetector,
    maker: FeatureMaker,
    statistics: Statistics,
    *,
    material: str | None = None,
    slip_free: bool = False,
    is_new: bool = True,
) -> dict[str, RecordingBins]:
    """The bins of every recording of a source, by name; those without a labelled bin are left out.

    A recording that the statistics know by its content has the name that it has there.

    Args:
        detector: whose features are made.
        maker: of the recordings, with the detector's pool and filter.
        statistics: of the detector.
        material: to call new recordings, whatever they are called; they are numbered then in their
            order, on from those that there are.
        slip_free: take the bins without slip alone.
        is_new: whether the recordings are to come in, not to go out.

    Raises:
        ValueError: if a recording cannot be read, or is to come in twice, by whatever name.
    """
    trained: Mapping[str, str] = detector.info.get("train_recordings", {})
    names = names_in = _names(statistics, trained, is_in=True)
    if is_new:
        ever = _names(statistics, trained, is_in=False)
        names = {key: name for key, name in ever.items() if name[1] == material}
    everyone = Split("adapt", dict.fromkeys(maker.source.ids, "train"))
    found: dict[str, RecordingBins] = {}
    numbers, first = itertools.count(), dict[str, str]()
    for recording in bar(maker.source.ids, "features, new recordings", "recording"):
        key = cache_key(maker.source.key(recording))
        name, called = names.get(key) or _named(recording, material, numbers, statistics.materials)
        made = maker(recording, everyone)
        kept = ~made.is_slip if slip_free else made.is_slip | True
        z = detector.scaler(made.features[kept][:, list(detector.selected)].double())
        if not len(z):
            continue
        if is_new and key in names_in:
            known = "" if names_in[key][0] == name else f" as {names_in[key][0]}"
            raise ValueError(f"{name} is in already{known}; action=forget takes it out first")
        if is_new and (other := first.setdefault(key, name)) != name:
            raise ValueError(f"{name} is the same recording as {other}; give it once")
        found[name] = RecordingBins(called, z, made.is_slip[kept], key)
    return found


def _names(
    statistics: Statistics, trained: Mapping[str, str], *, is_in: bool
) -> dict[str, tuple[str, str]]:
    """Name and material of recordings by key: those that are in, or were."""
    materials = statistics.materials
    keys = dict(trained) | {name: own.key for name, own in statistics.bins.items()}
    order = sorted(keys, key=lambda name: statistics.weight_of(name) > 0)  # one that is in wins
    return {
        keys[name]: (name, materials[name])
        for name in order
        if keys[name] and name in materials and (statistics.weight_of(name) > 0 or not is_in)
    }


def _named(
    recording: RecordingId, material: str | None, numbers: Iterator[int], taken: Collection[str]
) -> tuple[str, str]:
    """Name and material; of one that is renamed the next number that is free."""
    if material is None:
        return str(recording), recording.material
    names = (str(replace(recording, material=material, cycle=cycle)) for cycle in numbers)
    return next(name for name in names if name not in taken), material
