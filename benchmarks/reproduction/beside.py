"""Published scores beside ours, each row marked: calibrated, predicted or not comparable."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from benchmarks.reproduction.results import MeanSd, Report, percent, runs_of, seeds_text
from benchmarks.tables import Table
from tactslip_torch.report import published

CALIBRATED, PREDICTED, NOT_COMPARABLE = "*calibrated*", "*predicted*", "*not comparable*"
HEADER = ("published", "paper", "ours, simulated", "ours - paper", "", "why")


class Quantity(NamedTuple):
    """A number that the paper states, or that follows from one it states.

    Attributes:
        what: it is, with its unit.
        role: whose bins.
        paper: the published value.
        ours: values of an experiment, one a seed.
        digits: behind the point.
    """

    what: str
    role: str
    paper: float
    ours: Callable[[Report, str], list[float]]
    digits: int = 2


class Setting(NamedTuple):
    """A way to lay and split bins.

    Attributes:
        title: heads its table.
        experiment: as it is stored.
        marks: mark and reason of a quantity, from the report.
    """

    title: str
    experiment: str
    marks: Callable[[Quantity, Report], tuple[str, str]]


def _of(role: str, score: str) -> Callable[[Report, str], list[float]]:
    return lambda report, experiment: percent(report, experiment, role, score)


def _false_slips(role: str) -> Callable[[Report, str], list[float]]:
    return lambda report, experiment: [
        (100 - value) / 100 * published.BINS_PER_MINUTE
        for value in percent(report, experiment, role, "non_slip_recall")
    ]


def larger_class(report: Report, experiment: str) -> list[float]:
    """Share of the larger class among test bins, in percent, a number a seed."""
    found = []
    for run in runs_of(report, experiment):
        of_classes = [sum(row) for row in run["splits"]["test"]["confusion"]]
        found.append(100 * max(of_classes) / sum(of_classes))
    return found


def _quantities() -> list[Quantity]:
    names = {
        "accuracy": "accuracy",
        "non_slip_recall": "non-slip recall",
        "slip_recall": "slip recall",
        "balanced_accuracy": "balanced accuracy",
    }
    where = {"train": "training bins", "test": "test bins", "unseen": "unseen materials"}
    found = []
    for role, paper in published.SPLITS.items():
        for score, name in names.items():
            value = getattr(paper, score)
            if value is not None:
                what = f"{name}, {where[role]}, %"
                found.append(Quantity(what, role, 100 * value, _of(role, score)))
        if paper.non_slip_recall is not None:
            alarms = (1 - paper.non_slip_recall) * published.BINS_PER_MINUTE
            what = f"false slips a minute of non-slip, {where[role]}"
            found.append(Quantity(what, role, alarms, _false_slips(role), 0))
    what = "share of the larger class, test bins, %"
    return [*found, Quantity(what, "test", 100 * published.LARGER_CLASS, larger_class)]


QUANTITIES = tuple(_quantities())
AIM = "accuracy, test bins, %"


def _authors(quantity: Quantity, report: Report) -> tuple[str, str]:
    if quantity.what == AIM and is_calibrated(report):
        verdict = report["calibrated"]["verdict"]
        return CALIBRATED, f"three knobs were set by it, on other seeds: {verdict}"
    if quantity.what == AIM:
        return PREDICTED, "the knobs stand at their starting values"
    if quantity.ours is larger_class:
        return PREDICTED, "follows from where bins are laid"
    return PREDICTED, "no knob was calibrated by it"


def _by_cycle(quantity: Quantity, report: Report) -> tuple[str, str]:
    if quantity.role == "unseen":
        return PREDICTED, "calibration looked at none"
    if quantity.role == "train":
        return PREDICTED, "no knob was calibrated by it"
    if quantity.ours is larger_class:
        return PREDICTED, "follows from where bins are laid"
    return NOT_COMPARABLE, "the paper's test bins have neighbours among its training bins"


def _never(why: str) -> Callable[[Quantity, Report], tuple[str, str]]:
    return lambda quantity, report: (NOT_COMPARABLE, why)


_HALF = "the published matrices do not fit half a second on either side: it makes 50 % non-slip"
SETTINGS = (
    Setting(
        "Split at random over bins, whole slides, the paper's recipe: as the authors did",
        "random_bins",
        _authors,
    ),
    Setting("Split by cycle, whole slides, the paper's recipe", "unseen4", _by_cycle),
    Setting(
        "Split by cycle, whole slides, the default recipe, `robust`",
        "unseen4 robust",
        _never("the recipe is ours"),
    ),
    Setting(
        "Split at random over bins, half a second on either side of an onset, the paper's recipe",
        "half_second random_bins",
        _never(_HALF),
    ),
    Setting(
        "Split by cycle, half a second on either side of an onset, the paper's recipe",
        "half_second",
        _never(_HALF),
    ),
)


def is_calibrated(report: Report) -> bool:
    """Whether the knobs were set by a calibration."""
    return "target" in report["calibrated"]


def beside(report: Report) -> dict[str, Table]:
    """Tables by title: every published score that a setting has, with its mark."""
    found = {}
    for setting in SETTINGS:
        rows = _rows(report, setting)
        if rows:
            found[setting.title] = Table(HEADER, rows, seeds_note(report, setting.experiment))
    return found


def _rows(report: Report, setting: Setting) -> list[Sequence[str]]:
    rows: list[Sequence[str]] = []
    for quantity in QUANTITIES:
        values = quantity.ours(report, setting.experiment)
        if values:
            ours, digits = MeanSd.of(values), quantity.digits
            mark, why = setting.marks(quantity, report)
            cells = [quantity.what, f"{quantity.paper:.{digits}f}", ours.text(digits)]
            rows.append([*cells, f"{ours.mean - quantity.paper:+.{digits}f}", mark, why])
    return rows


def seeds_note(report: Report, experiment: str) -> str:
    """How many seeds, and the overrides, in a line."""
    settings = " ".join(report["commands"][experiment])
    return f"{seeds_text(len(runs_of(report, experiment)))}; `train {settings} seed=...`"


def signals_table(report: Report) -> Table:
    """What the paper says its signals look like, and whether the simulated ones do."""
    facts: dict[str, list[Mapping[str, float | bool | str | None]]] = {}
    values: dict[str, list[float]] = {}
    for of_seed in report["signals"]:
        for fact in of_seed:
            facts.setdefault(fact["says"], []).append(fact)
            values.setdefault(fact["says"], []).extend(fact["values"].values())
    mark = f"{CALIBRATED}, as a condition" if is_calibrated(report) else PREDICTED
    rows = []
    for says, judged in facts.items():
        low, high = judged[0]["low"], judged[0]["high"]
        limit = f"above {low:g}" if high is None else f"{low:g} to {high:g}"
        found = f"{min(values[says]):.3g} to {max(values[says]):.3g}"
        holds = f"{sum(bool(fact['holds']) for fact in judged)} of {len(judged)}"
        rows.append([says, found, limit, holds, mark])
    header = ["the paper's signals", "ours, simulated", "asked", "holds, seeds", ""]
    note = "A statistic of each fact, least to largest over materials and seeds (`facts.py`)."
    return Table(header, rows, note)
