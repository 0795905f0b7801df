"""Features of some channels, machines without a channel, and the best few channels in order."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.selection import rank_distinct, rank_features
from tactslip_torch.hand import HandLayout
from tactslip_torch.importance.refit import Refit, Verdict
from tactslip_torch.threads import for_each

Item = TypeVar("Item")
Units = Mapping[str, frozenset[str]]
"""What is taken or left out together, by name: the channels of each."""
Progress = Callable[[Iterable[Any], str], Iterable[Any]]


def units_of(hand: HandLayout) -> dict[str, dict[str, frozenset[str]]]:
    """The channels of a hand one by one, by finger and by kind.

    Example:
        >>> units = units_of(HandLayout.paper24())
        >>> sorted(units["finger"]["thumb"]), len(units["kind"]["SG"])
        (['PVDF10', 'PVDF9', 'SG13', 'SG14'], 14)
    """
    found: dict[str, dict[str, set[str]]] = {"channel": {}, "finger": {}, "kind": {}}
    for channel in hand.channels:
        for what, name in zip(found, (channel.name, channel.finger, channel.kind), strict=True):
            found[what].setdefault(name, set()).add(channel.name)
    return {
        what: {name: frozenset(channels) for name, channels in units.items()}
        for what, units in found.items()
    }


@dataclass(frozen=True)
class Ranking:
    """Selects features anew among some channels.

    Args:
        scores: ``[F]``, of the t-test on all training bins, made once.
        channels: the channel of each feature.
        allowed: ``[F]``, bool, what may be selected at all; ``None``: everything.
        sample: of training bins, for correlations.
        num_features: how many are selected, where there are so many.
        most_correlation: as in ``Recipe``.
        is_shared: every channel gives as many features (one at least), so that none of them is
            crowded out by others with larger scores; else the recipe's way, the best of all.
    """

    scores: Tensor
    channels: Sequence[str]
    allowed: Tensor | None
    sample: SampledBins
    num_features: int
    most_correlation: float
    is_shared: bool = False

    def __call__(self, channels: Collection[str]) -> list[int]:
        """Pool indices of the best features of these channels, best first; none if none may be."""
        if not self.is_shared:
            return self._best(channels, self.num_features)
        each = max(1, self.num_features // max(1, len(channels)))
        found = [index for name in sorted(channels) for index in self._best({name}, each)]
        return sorted(found, key=lambda index: (-float(self.scores[index]), index))

    def _best(self, channels: Collection[str], most: int) -> list[int]:
        wanted = torch.tensor([name in channels for name in self.channels])
        places = (wanted if self.allowed is None else wanted & self.allowed).nonzero()[:, 0]
        num = min(most, len(places))
        if not num:
            return []
        scores = self.scores[places]
        if self.most_correlation < 1:
            features, is_slip = self.sample.features[:, places], self.sample.is_slip
            order = rank_distinct(scores, features, is_slip, num, self.most_correlation)
        else:
            order = rank_features(scores, num)
        return [int(place) for place in places[order]]


def without(features: Iterable[int], channels: Collection[str], names: Sequence[str]) -> list[int]:
    """Those features that are of none of the channels.

    Args:
        features: pool indices.
        channels: to leave out.
        names: the channel of each feature of the pool.
    """
    return [index for index in features if names[index] not in channels]


def side_by_side(function: Callable[[Item], Verdict], items: Sequence[Item]) -> list[Verdict]:
    """``function`` of every item, on as many threads as torch has; the same bits on any number."""
    found: dict[int, Verdict] = {}

    def judge(place: int) -> None:
        found[place] = function(items[place])

    for_each(judge, range(len(items)))
    return [found[place] for place in range(len(items))]


def best_first(
    refit: Refit,
    select: Callable[[Collection[str]], Sequence[int]],
    units: Units,
    most: int,
    progress: Progress,
    what: str,
) -> list[tuple[str, Verdict]]:
    """Greedy forward selection: at each step the unit that serves held-out groups best joins.

    Features are selected anew among the channels taken. Candidates are compared at the C of the
    step before (the first at every C), and C is chosen anew for the one that joins. Units that
    tie go by the smaller held-out error, then in order. That a set was chosen by its held-out
    accuracy makes this one optimistic; judged roles choose nothing.

    Args:
        refit: fits and judges.
        select: features of channels, such as a ``Ranking``.
        units: to choose from; those none of whose features may be selected never join.
        most: steps at most.
        progress: wraps the steps.
        what: is done, for it.

    Returns:
        For each step the name of the unit that joined, and the verdict with it.
    """
    left = [name for name, channels in units.items() if len(select(channels))]
    taken: frozenset[str] = frozenset()
    steps: list[tuple[str, Verdict]] = []
    for number in progress(range(min(most, len(left))), what):
        sets = [taken | units[name] for name in left]
        near = [steps[-1][1].penalty] if number else refit.penalties
        selections = [select(channels) for channels in sets]
        verdicts = side_by_side(partial(refit.held_out, penalties=near), selections)
        best = max(range(len(left)), key=lambda i: (*verdicts[i].merit, -i))
        steps.append((left.pop(best), refit(selections[best])))
        taken = sets[best]
    return steps
