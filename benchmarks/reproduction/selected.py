"""Where selected features come from, the paper's counts beside ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from benchmarks.reproduction.beside import PREDICTED
from benchmarks.reproduction.results import MeanSd, Report, runs_of
from benchmarks.tables import Table
from tactslip_torch.hand import HandLayout
from tactslip_torch.report import published

RECIPES = {"random_bins": "the paper's recipe", "unseen4 robust": "`robust`"}
HAND = HandLayout.paper24()


class Selected(NamedTuple):
    """A selected feature in words."""

    kind: str
    finger: str
    component: str
    domain: str
    definition: str

    @classmethod
    def of(cls, name: str) -> Selected:
        """Of a name as a run leaves it.

        Example:
            >>> Selected.of("PVDF3 A2 freq kurtosis").finger
            'ring'
        """
        channel, component, domain, definition = name.split()
        at = HAND.channel(channel)
        return cls(at.kind, at.finger, component, domain, definition)


def counts(report: Report, experiment: str, is_one: Callable[[Selected], bool]) -> list[float]:
    """How many of the selected features are of a kind, a number a seed."""
    return [
        float(sum(is_one(Selected.of(name)) for name in run["selected"]))
        for run in runs_of(report, experiment)
    ]


def _is(attribute: str, value: str, kind: str | None, feature: Selected) -> bool:
    return getattr(feature, attribute) == value and kind in (None, feature.kind)


def groups() -> dict[str, dict[str, tuple[Callable[[Selected], bool], str]]]:
    """What is counted, by what it is counted by, with what the paper says of it."""
    fingers = published.SELECTED_BY_FINGER
    ranks: dict[str, str] = {
        name: f"rank {rank}" for rank, name in enumerate(published.DESCRIPTORS_RANKED, 1)
    }
    ranks |= dict.fromkeys(published.DESCRIPTORS_NEVER, "0")
    components = {f"{kind}{level}": "-" for kind in "AD" for level in range(1, 5)} | {"D1": "0"}
    found: dict[str, dict[str, tuple[Callable[[Selected], bool], str]]] = {
        "kind": {
            kind: (partial(_is, "kind", kind, None), str(count))
            for kind, count in published.SELECTED_BY_KIND.items()
        }
    }
    for kind, of_kind in fingers.items():
        found[f"finger, {kind}"] = {
            finger: (partial(_is, "finger", finger, kind), str(count))
            for finger, count in of_kind.items()
        }
    found["component"] = {
        "approximations": (lambda feature: feature.component[0] == "A", "more"),
        "details": (lambda feature: feature.component[0] == "D", "fewer"),
    } | {name: (partial(_is, "component", name, None), of) for name, of in components.items()}
    found["domain, PVDF"] = {
        "frequency": (partial(_is, "domain", "freq", "PVDF"), "more"),
        "time": (partial(_is, "domain", "time", "PVDF"), "fewer"),
    }
    found["definition"] = {
        name.replace("_", " "): (partial(_is, "definition", name, None), of)
        for name, of in ranks.items()
    }
    return found


def selected_table(report: Report) -> Table:
    """Mean counts over seeds by kind, finger, component, domain and definition."""
    recipes = {name: words for name, words in RECIPES.items() if runs_of(report, name)}
    header = ["selected by", "", "paper", *(f"{words}, simulated" for words in recipes.values())]
    rows = []
    for by, members in groups().items():
        of_paper = _places(report, recipes, members) if by == "definition" else {}
        for place, (value, (is_one, paper)) in enumerate(members.items()):
            cells = [by if place == 0 else "", value, paper]
            for name in recipes:
                own = MeanSd.of(counts(report, name, is_one)).text(1)
                rank = of_paper.get((name, value))
                cells.append(f"{own}, rank {rank}" if rank else own)
            rows.append([*cells, PREDICTED])
    note = (
        "Counts of features, of "
        + " and of ".join(
            f"{MeanSd.of([float(len(run['selected'])) for run in runs_of(report, name)]).text(0)} "
            f"({words})"
            for name, words in recipes.items()
        )
        + f"; the paper selects {published.NUM_SELECTED}. Of definitions it prints an order only. "
        "Its features were ranked on all bins, ours on training bins. - where it says nothing."
    )
    return Table([*header, ""], rows, note)


def _places(
    report: Report,
    recipes: Mapping[str, str],
    members: Mapping[str, tuple[Callable[[Selected], bool], str]],
) -> dict[tuple[str, str], int]:
    """Rank of each definition that is selected at all, by experiment and definition."""
    found = {}
    for name in recipes:
        means = {
            value: MeanSd.of(counts(report, name, is_one)).mean
            for value, (is_one, _) in members.items()
        }
        for value, mean in means.items():
            if mean > 0:
                found[name, value] = 1 + sum(other > mean for other in means.values())
    return found
