"""A new material in a detector without training again: recordings into its sums, and out again.

Sums with other bins are solved in closed form, and so is what every known bin scores by the machine
without its recording, from one factor: without the bins of a group ``g`` the residuals are
``e_g = (I - H_gg)^-1 (t - f)_g`` with the hat matrix of the machine of all bins
(``HeldOut``). Here all bins are in the sums, and a group is what is known of a recording: of
one that was added all bins, of one trained on those sampled. The rest of the latter stays in, so a
score is a little better than that of a machine without the recording; before and after a change
alike. By these scores a change is accepted only if the old materials are still known.
"""

from __future__ import annotations

import copy
import itertools
import logging
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.abstention import KEY as ABSTAIN
from tactslip_torch.model.abstention import Abstention, abstention_of, conformal_abstention
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Polynomial, QuadraticForm
from tactslip_torch.model.leave_one_group_out import MOST_CONDITION, HeldOut, residuals_without
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.solve import solve_symmetric
from tactslip_torch.onset.settings import KEY as ALARM
from tactslip_torch.runtime import bar
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.fitting import TrainingPass, solve_metadata
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.statistics import (
    KnownBins,
    Machine,
    RecordingBins,
    Statistics,
    Step,
    detector_digest,
)

_CHUNK = 1024  # bins of whole recordings whose columns are solved at a time, unless one has more


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


def _class_scales(sums: SufficientStats, machine: Machine) -> Tensor:
    """What the balance multiplies the weight of non-slip and of slip with, ``[2]``."""
    weight = sums.weight
    if machine.balance == "none":
        return torch.ones_like(weight)
    return weight.sum() / (2 * weight)


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
    weights, report, factor = solve_symmetric(
        normal,
        moment,
        machine.penalty,
        name="X'WX",
        in_span=True,
        most_condition=MOST_CONDITION,
    )
    assert factor is not None  # as most_condition is given
    head = kernel.head(weights, sums.num_features)
    head.solved = report
    scales = _class_scales(sums, machine)
    roots = (scales[known.is_slip.long()] * known.weight).sqrt()
    targets = torch.where(known.is_slip, 1.0, -1.0).double()
    right = roots * (targets - head(known.z))
    residuals = torch.empty_like(right)
    for groups in _chunks(known.recording):
        rows = torch.cat(groups)
        scaled = kernel.monomials(known.z[rows]) * roots[rows, None]
        columns = torch.linalg.solve_triangular(factor, scaled.mT, upper=False)
        parts = columns.split([len(group) for group in groups], dim=1)
        for group, part in zip(groups, parts, strict=True):
            name = int(known.recording[group[0]])
            residuals[group] = residuals_without(part.mT @ part, right[group], name)
    return Solved(head, known, targets - residuals / roots)


def _chunks(recording: Tensor) -> Iterator[list[Tensor]]:
    """Rows of whole recordings, some at a time."""
    order = recording.argsort(stable=True)
    _, sizes = torch.unique(recording, return_counts=True)
    groups: list[Tensor] = []
    for rows in order.split(sizes.tolist()):
        if groups and sum(map(len, groups)) + len(rows) > _CHUNK:
            yield groups
            groups = []
        groups.append(rows)
    if groups:
        yield groups


_OF_ONE = 4.0
"""A single material may fall by so many margins: some 800 rehearsal tell its change to half a point
at best, so a tighter limit would refuse by chance. Their mean is told several times better."""


@dataclass(frozen=True)
class AccuracyChange:
    """Balanced accuracy of every old material before and after a change.

    Args:
        before: by material, from 0 to 1, each bin scored by the machine without its recording.
        after: likewise, of the same bins.
    """

    before: Mapping[str, float]
    after: Mapping[str, float]

    @property
    def falls(self) -> dict[str, float]:
        """How much each material loses; negative where it gains."""
        return {name: before - self.after[name] for name, before in self.before.items()}

    @property
    def mean_fall(self) -> float:
        """How much they lose on average; 0 if there is none."""
        falls = self.falls.values()
        return sum(falls) / len(falls) if falls else 0.0

    def problem(self, margin: float) -> str | None:
        """Why the change is not accepted, in a line with figures; ``None`` if it is.

        Args:
            margin: that the mean may fall by; any one material by ``_OF_ONE`` times as much.
        """
        if not self.falls:
            return None
        if self.mean_fall > margin:
            mean = [sum(of.values()) / len(of) for of in (self.before, self.after)]
            return (
                f"old materials fall from {100 * mean[0]:.2f} to {100 * mean[1]:.2f} % balanced "
                f"accuracy on average, {100 * margin:g} points are allowed"
            )
        worst = max(self.falls, key=lambda name: self.falls[name])
        if self.falls[worst] > _OF_ONE * margin:
            return (
                f"{worst} falls from {100 * self.before[worst]:.2f} to "
                f"{100 * self.after[worst]:.2f} % balanced accuracy, {100 * _OF_ONE * margin:g} "
                "points are allowed of one material"
            )
        return None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"before": dict(self.before), "after": dict(self.after)}


def compare(before: Solved, after: Solved) -> AccuracyChange:
    """Both machines on the bins of recordings that both know."""
    both = set(before.known.recordings) & set(after.known.recordings)
    return _change_of(accuracies(before, both), accuracies(after, both))


def _change_of(before: Mapping[str, float], after: Mapping[str, float]) -> AccuracyChange:
    """Of the materials in both."""
    both = sorted(before.keys() & after.keys())
    return AccuracyChange({n: before[n] for n in both}, {n: after[n] for n in both})


def accuracies(solved: Solved, recordings: Collection[str]) -> dict[str, float]:
    """Balanced accuracy of every material in these recordings, held out in closed form."""
    known, says_slip = solved.known, solved.scores >= 0
    wanted, material = known.of_recordings(recordings), known.material
    found = {}
    for number, name in enumerate(known.material_names):
        mine = wanted & (material == number)
        if bool(mine.any()):
            found[name] = mean_recall(says_slip[mine], known.is_slip[mine])
    return found


def mean_recall(says_slip: Tensor, is_slip: Tensor) -> float:
    """Mean recall of the classes that are there: the balanced accuracy, or one recall.

    Shape:
        - says_slip, is_slip: ``[N]``, bool, N at least 1
    """
    right = (says_slip == is_slip).double()
    recalls = [right[mine].mean() for mine in (is_slip, ~is_slip) if bool(mine.any())]
    return float(torch.stack(recalls).mean())


FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Weights that ``auto`` tries, in parts of that of an average old material.

Where every training material in turn was new (simulated, ``benchmarks.adapting``), its own accuracy
kept rising to about the last of these, and what the others lost rose with it.
"""
_MOST_WEIGHT = 8000.0  # of a bin; more drowns the others
_OF_MARGIN = 0.5
"""``auto`` spends this part of the margin: how far old materials fall is itself an estimate."""


@dataclass(frozen=True, eq=False)
class Change:
    """What a step would make.

    Args:
        statistics: after it.
        solved: their machine.
        old: old materials, before and after.
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

    def problem(self, margin: float, share: float = 1.0) -> str | None:
        """Why the old materials do not allow it, in a line; ``None`` if they do.

        Args:
            margin: that their mean may fall by, by all steps together.
            share: the part of it that this step may take.
        """
        if problem := self.old.problem(share * margin):
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
    check_weight(weight)
    material = next(iter(bins.values())).material
    mine = dict(bins) | {
        name: own
        for name, own in statistics.bins.items()
        if own.material == material and statistics.weight_of(name) > 0
    }
    changes: dict[float, Change] = {}

    def change(value: float) -> Change:
        after = statistics.reweighed(dict.fromkeys(mine, value), bins)
        solved = solve(after)
        return _change(statistics, before, after, solved, value)

    if weight is not None:
        chosen = change(weight)
    else:
        unit = _average_weight(before, material, list(mine.values()))
        low, high = 0, len(FACTORS)  # the largest that is accepted is among low..high-1
        while high - low > 1:
            middle = (low + high) // 2
            factor = FACTORS[middle]
            with suppress(ValueError):
                changes[factor] = replace(change(factor * unit), factor=factor)
            is_fine = factor in changes and changes[factor].problem(margin, _OF_MARGIN) is None
            low, high = (middle, high) if is_fine else (low, middle)
        factor = FACTORS[low]
        chosen = changes.get(factor) or replace(change(factor * unit), factor=factor)
        changes[factor] = chosen
    tried_falls = {factor: of.old.mean_fall for factor, of in sorted(changes.items())}
    return replace(chosen, tried=tried_falls, new=_new_scores(before, chosen.solved, bins))


def forget(
    statistics: Statistics, before: Solved, bins: Mapping[str, RecordingBins] | None = None
) -> Change:
    """Recordings go out again, exactly.

    Args:
        statistics: as they are.
        before: their machine.
        bins: of the recordings to take out, by name; those that training put in must hold what it
            put in, to the bit.

    Raises:
        ValueError: if one is not in or holds something else, no class is left, or as ``solve``.
    """
    bins = bins or {}
    if absent := [name for name in bins if not statistics.weight_of(name)]:
        raise ValueError(
            f"{absent[0]} is not in these statistics; action=list shows what was added"
        )
    after = statistics.reweighed(dict.fromkeys(bins, 0.0), bins)
    return _change(statistics, before, after, solve(after))


def _change(
    statistics: Statistics,
    before: Solved,
    after: Statistics,
    solved: Solved,
    weight: float | None = None,
) -> Change:
    old = compare(before, solved)
    first = statistics.steps[0].entry.get("old", {}).get("before") if statistics.steps else None
    return Change(after, solved, old, _change_of(first or old.before, old.after), weight)


def undo(statistics: Statistics) -> tuple[Statistics, Tensor]:
    """The statistics before the last step, and the file of the detector they belong to.

    Raises:
        ValueError: if there is no step.
    """
    if not statistics.steps:
        raise ValueError("there is nothing to undo: this detector is as it was trained")
    *earlier, last = statistics.steps
    out = statistics.reweighed(dict.fromkeys(last.changed, 0.0))
    back = out.reweighed(last.changed, last.replaced)
    known = {name: own for name, own in back.bins.items() if name in last.weights}
    return replace(
        back, bins=known, weights=last.weights, steps=tuple(earlier), detector=last.detector
    ), last.file


def accepted(
    before: Statistics, change: Change, entry: Mapping[str, object], file: Tensor, digest: str
) -> Statistics:
    """The statistics after a step, with the step.

    Args:
        before: the statistics it started from.
        change: the step.
        entry: of the journal.
        file: of the detector before it, bytes.
        digest: of the detector after it.
    """
    after = change.statistics
    moved = {name: before.weight_of(name) for name in after.bins}
    moved = {name: value for name, value in moved.items() if value != after.weight_of(name)}
    replaced = {name: own for name, own in before.bins.items() if own is not after.bins[name]}
    step = Step(entry, before.weights, moved, replaced, before.detector, file)
    return replace(after, steps=(*before.steps, step), detector=digest)


def check_weight(weight: float | None) -> None:
    """Refuse what is no weight of a bin; ``None`` stands for ``auto``.

    Raises:
        ValueError: if it is not positive, or too large.
    """
    if weight is not None and not 0 < weight < _MOST_WEIGHT:
        raise ValueError(
            f"weight must be auto or a positive number below {_MOST_WEIGHT:g}, got {weight:g}"
        )


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


def _average_weight(before: Solved, material: str, mine: Sequence[RecordingBins]) -> float:
    """Of a bin of new recordings that together weigh as much as an average old material.

    Only classes that the new recordings have are counted.
    """
    known = before.known
    slip = [bool(own.is_slip.any()) for own in mine]
    rest = [bool((~own.is_slip).any()) for own in mine]
    counted = (known.is_slip & any(slip)) | (~known.is_slip & any(rest))
    totals = [
        float(known.sample_weight[counted & (known.material == number)].sum())
        for number, name in enumerate(known.material_names)
        if name != material
    ]
    totals = [total for total in totals if total > 0]
    num_bins = sum(len(own.z) for own in mine)
    return sum(totals) / len(totals) / num_bins if totals else 1.0


def _new_scores(
    before: Solved, after: Solved, bins: Mapping[str, RecordingBins]
) -> dict[str, float | None]:
    """Balanced accuracy of new recordings before and after."""
    parts = [own for own in bins.values() if len(own.z)]
    says_slip = torch.cat([before.head(own.z) >= 0 for own in parts])
    is_slip = torch.cat([own.is_slip for own in parts])
    held_out = accuracies(after, bins)[parts[0].material] if len(parts) > 1 else None
    return {"before": mean_recall(says_slip, is_slip), "after": held_out}


log = logging.getLogger(__name__)

_JOURNAL = "adaptations"
"""Under which ``SlipDetector.info`` keeps the entries of all steps."""


def refitted(
    detector: SlipDetector, statistics: Statistics, solved: Solved, entry: Mapping[str, Any]
) -> SlipDetector:
    """A detector with another machine; features, scaling and filter stay.

    As training does it, but of the bins that are known: imputation values; the calibration, of
    scores by machines without the bin's material, an alarm's too; thresholds for abstaining, by
    machines without the recording or, as in training, the material. The latter go where they cannot
    be told. An alarm keeps its threshold, which then stands for no rate.

    Args:
        detector: as it was; kept.
        statistics: after the step.
        solved: their machine.
        entry: of the journal.
    """
    new, known = copy.deepcopy(detector), solved.known
    new.head = solved.head
    bins = _training_bins(statistics, known)
    _refit_imputation(new, bins)
    info = new.info
    info["solve"] = solve_metadata(solved.head)
    info["num_bins"] = int(statistics.sums.count.sum())
    info[_JOURNAL] = [*info.get(_JOURNAL, []), dict(entry)]
    info["train_materials"] = [known.material_names[i] for i in known.material.unique()]
    keys = info.get("train_recordings", {}) | {n: b.key for n, b in statistics.bins.items()}
    entries = statistics.sums.seen_batches
    out = {name for name in statistics.bins if name not in entries}
    info["train_recordings"] = {n: key for n, key in keys.items() if n not in out}
    if info.get("calibration") or ALARM in info:
        found = _calibration(bins, known, statistics.machine)
        if info.get("calibration"):
            info["calibration"] = found or info["calibration"]
        if ALARM in info:
            info[ALARM] = _alarm(info[ALARM], found)
    if (answers := abstention_of(new)) is not None:
        info[ABSTAIN] = _thresholds(bins, known, statistics.machine, answers)
    return new


def _training_bins(statistics: Statistics, known: KnownBins) -> TrainingBins:
    """Known bins, each weighing as much as all that it stands for, the classes balanced."""
    scales = _class_scales(statistics.sums, statistics.machine)
    weights = scales[known.is_slip.long()] * known.sample_weight
    return TrainingBins(known.z, known.is_slip, weights)


def _refit_imputation(detector: SlipDetector, bins: TrainingBins) -> None:
    """What is expected of a sensor that is missing."""
    gaussians = ClassGaussians.fit(bins.features, bins.is_slip, bins.weights)
    detector.imputation.copy_(gaussians.mean.mean(0))  # both classes counting alike
    if detector.gaussians is not None:
        detector.gaussians = gaussians


def _scores_without(groups: Tensor, bins: TrainingBins, machine: Machine) -> Tensor:
    """Of each known bin, by the machine of known bins without its group."""
    return HeldOut(bins, groups, Polynomial(2, machine.offset)).at(machine.penalty).scores


def _calibration(bins: TrainingBins, known: KnownBins, machine: Machine) -> dict[str, Any] | None:
    """From held-out scores, each material left out; ``None`` where that cannot be told."""
    try:
        scores = _scores_without(known.material, bins, machine)
        return fit_platt(scores, known.is_slip, bins.weights).to_dict()
    except ValueError as error:
        log.warning("the calibration stays as it was: %s", error)
        return None


def _alarm(plain: Mapping[str, Any], calibration: Mapping[str, Any] | None) -> dict[str, Any]:
    """Settings of an alarm without its rate, with the calibration if there is a new one."""
    which = "that of the machine before" if calibration is None else "made anew"
    said = (
        "the machine changed after the threshold was set: it stands for no rate; the calibration "
        f"is {which}; train with +exp=onset"
    )
    return {
        **plain,
        "calibration": calibration or plain["calibration"],
        "target_per_hour": None,
        "facts": {**(plain.get("facts") or {}), "adapted": said},
    }


def _thresholds(
    bins: TrainingBins, known: KnownBins, machine: Machine, answers: Abstention
) -> dict[str, Any] | None:
    """Conformal thresholds for the same coverage on the recordings that are known."""
    left_out = "recording" if answers.metadata.get("left_out") == "recording" else "material"
    metadata = dict(answers.metadata) | {
        "left_out": left_out,
        "adapted": "set anew on all recordings that are known, added ones included, each bin "
        f"scored by a machine of the others without its {left_out}",
    }
    try:
        groups = known.recording if left_out == "recording" else known.material
        scores = _scores_without(groups, bins, machine)
        found = conformal_abstention(
            scores, known.is_slip, known.recording, answers.coverage, metadata
        )
    except ValueError as error:
        log.warning("the detector abstains no more: %s", error)
        return None
    return found.to_dict()


def known_names(
    statistics: Statistics, trained: Mapping[str, str], *, is_in: bool
) -> dict[str, tuple[str, str]]:
    """Name and material of recordings, by key.

    Args:
        statistics: of a detector.
        trained: the keys it tells of recordings that it was trained on, by name.
        is_in: those alone that are in; else those that were taken out too.
    """
    materials = statistics.materials
    keys = dict(trained) | {name: own.key for name, own in statistics.bins.items()}
    order = sorted(keys, key=lambda name: statistics.weight_of(name) > 0)  # one that is in wins
    return {
        keys[name]: (name, materials[name])
        for name in order
        if keys[name] and name in materials and (statistics.weight_of(name) > 0 or not is_in)
    }


def check_once(bins: Mapping[str, RecordingBins], names_in: Mapping[str, tuple[str, str]]) -> None:
    """That no recording comes in twice.

    Args:
        bins: of the recordings that are to come in, by name.
        names_in: what ``known_names`` tells of those that are in.

    Raises:
        ValueError: if one is in already, or is there twice, by whatever name.
    """
    first: dict[str, str] = {}
    for name, own in bins.items():
        if own.key in names_in:
            known, _ = names_in[own.key]
            called = "" if known == name else f" as {known}"
            raise ValueError(f"{name} is in already{called}; action=forget takes it out first")
        if (other := first.setdefault(own.key, name)) != name:
            raise ValueError(f"{name} is the same recording as {other}; give it once")


def recording_bins(
    detector: SlipDetector,
    maker: FeatureMaker,
    *,
    material: str | None = None,
    slip_free: bool = False,
    names: Mapping[str, tuple[str, str]] | None = None,
    taken: Collection[str] = (),
) -> dict[str, RecordingBins]:
    """The bins of every recording of a source, by name; those without a labelled bin are left out.

    Args:
        detector: whose features are made.
        maker: of the recordings, with the detector's pool and filter.
        material: to call them, whatever they are called; they are numbered then in their order.
        slip_free: take the bins without slip alone.
        names: what recordings are called and their materials, by key, whatever else holds.
        taken: names that none is numbered to.

    Raises:
        ValueError: if a recording cannot be read.
    """
    ids = maker.source.ids
    everyone = Split("adapt", dict.fromkeys(ids, "train"))
    found, number = {}, itertools.count()
    for recording in bar(ids, "features, new recordings", "recording"):
        key = cache_key(maker.source.key(recording))
        name, called = (names or {}).get(key) or _named(recording, material, number, taken)
        made = maker(recording, everyone)
        kept = ~made.is_slip if slip_free else made.is_slip | True
        z = detector.scaler(made.features[kept][:, list(detector.selected)].double())
        if len(z):
            found[name] = RecordingBins(called, z, made.is_slip[kept], key)
    return found


def _named(
    recording: RecordingId, material: str | None, number: Iterator[int], taken: Collection[str]
) -> tuple[str, str]:
    """Name and material; of one that is renamed the next number that is free."""
    if material is None:
        return str(recording), recording.material
    names = (str(replace(recording, material=material, cycle=cycle)) for cycle in number)
    return next(name for name in names if name not in taken), material


def check_recipe(recipe: Recipe) -> None:
    """That a detector made this way can be solved again from sums.

    Raises:
        ValueError: if its kernel does not add up, a penalty is not finite, or it is chosen nested.
    """
    if recipe.validation == "nested":
        raise ValueError(
            "statistics=true needs a machine of degree 2 on features of channels, which "
            f"recipe={recipe.name} does not always make; take recipe=robust or recipe=paper"
        )
    if not all(isinstance(k, Polynomial) and k.degree == 2 for k in recipe.kernels):
        raise ValueError(
            "statistics=true needs recipe.kernel=polynomial recipe.degree=2, whose bins add up; "
            f"got {recipe.kernels[0]}"
        )
    if not math.isfinite(most := recipe.penalties_ascending[-1]):
        raise ValueError(
            f"statistics=true needs finite recipe.penalties, got {most:g}: without a ridge no "
            "machine without a recording can be told"
        )


def gathered_statistics(
    gathered: TrainingPass,
    sample: SampledBins,
    materials: Mapping[str, str],
    labels: Mapping[str, Any],
    detector: SlipDetector,
) -> Statistics:
    """What a second pass gathered, with a sample of its bins.

    A machine of few bins was solved from the bins themselves; their sums give the same to rounding.

    Args:
        gathered: the second pass, with its plan.
        sample: of the first pass.
        materials: of each training recording, by its name.
        labels: arguments of ``LabelRule``.
        detector: that was solved.

    Raises:
        ValueError: if there is no room for a sum.
    """
    plan = gathered.plan
    assert isinstance(plan.kernel, Polynomial)  # check_recipe
    sums = gathered.stats
    if sums is None:
        sums = SufficientStats(len(plan.selection.selected))
        for name in sorted(gathered.bins):
            sums.update(name, *gathered.bins[name])
    return Statistics(
        sums,
        Machine(
            plan.penalty,
            plan.kernel.offset,
            "weights" if plan.recipe.balance == "weights" else "none",
        ),
        dict(labels),
        KnownBins.of(plan, sample, materials),
        detector_digest(detector),
        {},
        {},
    )
