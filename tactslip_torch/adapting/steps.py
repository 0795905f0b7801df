"""The changes there are: add recordings at a weight, take some out, take a step back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from tactslip_torch.adapting.acceptance import (
    Verdict,
    accuracies,
    compared,
    mean_recall,
    since,
)
from tactslip_torch.adapting.bins import RecordingBins
from tactslip_torch.adapting.held_out import Solved, solve
from tactslip_torch.adapting.statistics import Statistics, Step

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Weights that ``auto`` tries, in parts of that of an average old material.

Where every training material in turn was new (simulated, ``benchmarks.adapting``), its own accuracy
kept rising to about the last of these, and what the others lost rose with it.
"""
MOST_WEIGHT = 8000.0  # of a bin; more has no room on the grid of the sums
OF_MARGIN = 0.5
"""``auto`` spends this part of the margin: how far old materials fall is itself an estimate."""


@dataclass(frozen=True, eq=False)
class Change:
    """What a step would make.

    Args:
        statistics: after it.
        solved: their machine.
        verdict: old materials, before and after.
        drift: those of them that there were before the first step, as they were then, and after.
        weight: of a bin that was added; ``None`` where none was.
        factor: the weight in parts of an average old material, where ``auto`` chose it.
        tried: such parts, each with the mean fall it brought; those that led to a machine.
        new: balanced accuracy of the recordings that were added: ``before``, by the machine that
            never met them, and ``after``, each without its own recording; of a lone recording that
            is ``None``.
    """

    statistics: Statistics
    solved: Solved
    verdict: Verdict
    drift: Verdict
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
        if problem := self.verdict.problem(share * margin):
            return problem
        problem = self.drift.problem(margin)
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
            ``FACTORS`` by which old materials keep ``OF_MARGIN`` of the margin, in all steps the
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
            is_fine = factor in changes and changes[factor].problem(margin, OF_MARGIN) is None
            low, high = (middle, high) if is_fine else (low, middle)
        factor = FACTORS[low]
        chosen = changes.get(factor) or replace(change(factor * unit), factor=factor)
        changes[factor] = chosen
    tried_falls = {factor: of.verdict.mean_fall for factor, of in sorted(changes.items())}
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
    verdict = compared(before, solved)
    first = statistics.steps[0].entry.get("old", {}).get("before") if statistics.steps else None
    return Change(after, solved, verdict, since(first or verdict.before, verdict), weight)


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


def taken(
    before: Statistics, change: Change, entry: Mapping[str, object], file: Tensor, digest: str
) -> Statistics:
    """The statistics behind a step that was accepted, with the step.

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
    if weight is not None and not 0 < weight < MOST_WEIGHT:
        raise ValueError(
            f"weight must be auto or a positive number below {MOST_WEIGHT:g}, got {weight:g}"
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
        float(known.represents[counted & (known.material == number)].sum())
        for number, name in enumerate(known.materials)
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
