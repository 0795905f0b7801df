"""Whether a changed detector still knows what it knew: its scores of old bins, before and after."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.adapting.held_out import Solved

OF_ONE = 4.0
"""A single material may fall by so many margins: some 800 witnesses tell its change to half a point
at best, so a tighter limit would refuse by chance. Their mean is told several times better."""


@dataclass(frozen=True)
class Verdict:
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
            margin: that the mean may fall by; any one material by ``OF_ONE`` times as much.
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
        if self.falls[worst] > OF_ONE * margin:
            return (
                f"{worst} falls from {100 * self.before[worst]:.2f} to "
                f"{100 * self.after[worst]:.2f} % balanced accuracy, {100 * OF_ONE * margin:g} "
                "points are allowed of one material"
            )
        return None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"before": dict(self.before), "after": dict(self.after)}


def compared(before: Solved, after: Solved) -> Verdict:
    """Both machines on the bins of recordings that both know."""
    both = set(before.known.recordings) & set(after.known.recordings)
    scores = accuracies(before, both), accuracies(after, both)
    materials = scores[0].keys() & scores[1].keys()
    return Verdict(*({name: of[name] for name in sorted(materials)} for of in scores))


def since(before: Mapping[str, float], verdict: Verdict) -> Verdict:
    """From an earlier ``before`` to a verdict's ``after``, of the materials in both."""
    both = sorted(before.keys() & verdict.after.keys())
    return Verdict({n: before[n] for n in both}, {n: verdict.after[n] for n in both})


def accuracies(solved: Solved, recordings: Collection[str]) -> dict[str, float]:
    """Balanced accuracy of every material in these recordings, held out in closed form."""
    known, says_slip = solved.known, solved.scores >= 0
    wanted = known.of(recordings)
    found = {}
    for number, name in enumerate(known.materials):
        mine = wanted & (known.material == number)
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
