"""All that ``sensors`` tells of channels, fingers and kinds, as values that JSON holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from tactslip_torch.hand import HandLayout
from tactslip_torch.importance.accuracy import difference
from tactslip_torch.importance.choosing import (
    Ranking,
    best_first,
    side_by_side,
    units_of,
    without,
)
from tactslip_torch.importance.refit import Refit, Verdict

Progress = Callable[[Iterable[Any], str], Iterable[Any]]


class Draws(NamedTuple):
    """How recordings are drawn for intervals."""

    num: int
    seed: int


def measure(
    refit: Refit,
    ranking: Ranking,
    selected: Sequence[int],
    hand: HandLayout,
    gradient: Mapping[str, Mapping[str, float]],
    *,
    most: int,
    draws: Draws,
    progress: Progress,
) -> dict[str, Any]:
    """What absence costs, what each tells alone, and the best few.

    Args:
        refit: fits and judges.
        ranking: selects features anew.
        selected: pool indices of the features that the detector has.
        hand: whose channels, fingers and kinds are gone through.
        gradient: by channel, to be put into its row.
        most: of the best few, at most.
        draws: for intervals.
        progress: wraps what is gone through.

    Returns:
        ``with_all``: machines with every sensor. ``units``: a row for every channel, finger and
        kind. ``best``: by these, the steps in which they join. Accuracies are shares.
    """
    everything = frozenset(hand.names)
    whole = {"as_selected": refit(selected), "selected_anew": refit(ranking(everything))}
    in_use = Counter(ranking.channels[index] for index in selected)
    rows: list[dict[str, Any]] = []
    best: dict[str, list[dict[str, Any]]] = {}
    for what, units in units_of(hand).items():
        for name in progress(list(units), f"without each {what}"):
            channels = units[name]
            choices = [
                without(selected, channels, ranking.channels),
                ranking(everything - channels),
                ranking(channels),
            ]
            fewer, anew, alone = side_by_side(refit, choices)
            rows.append(
                {
                    "unit": what,
                    "name": name,
                    "num_channels": len(channels),
                    "features_in_use": sum(in_use[channel] for channel in channels),
                    "gradient": dict(gradient[name]) if what == "channel" else None,
                    "lost": _lost(whole["as_selected"], fewer, draws),
                    "lost_anew": _lost(whole["selected_anew"], anew, draws),
                    "alone": _accuracies(alone),
                }
            )
        steps = best_first(refit, ranking, units, most, progress, f"best {what}s")
        best[what] = [
            {"joins": name, "lost": _lost(whole["selected_anew"], verdict, draws)} | _facts(verdict)
            for name, verdict in steps
        ]
    return {
        "with_all": {name: _facts(verdict) for name, verdict in whole.items()},
        "units": rows,
        "best": best,
    }


def _lost(whole: Verdict, part: Verdict, draws: Draws) -> dict[str, dict[str, float]]:
    return {
        role: difference(tallies, part.tallies[role], draws.num, draws.seed)._asdict()
        for role, tallies in whole.tallies.items()
    }


def _accuracies(verdict: Verdict) -> dict[str, float]:
    return {role: verdict.accuracy(role) for role in verdict.tallies}


def _facts(verdict: Verdict) -> dict[str, Any]:
    return {
        "num_features": verdict.num_features,
        "penalty": verdict.penalty,
        "balanced_accuracy": _accuracies(verdict),
    }
