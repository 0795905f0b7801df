"""Published numbers beside ours: ``python -m benchmarks.reproduction [key=value ...]``.

Trains every experiment on every seed. Runs that this very code finished are kept, so it resumes.
Writes the tables of REPRODUCTION.md and of README.md between their markers, and the figures.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.figure import Figure
from omegaconf import OmegaConf

from benchmarks import ROOT
from benchmarks.harness import (
    GREY,
    LIGHT,
    OURS,
    PEER,
    Benchmark,
    Job,
    Report,
    Table,
    between_markers,
    finish,
    trained,
    write_text,
)
from tactslip_torch.analysis.signal_checks import check_signals, filtered
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.hand import HandLayout
from tactslip_torch.report import published
from tactslip_torch.report.metrics import split_metrics, summed_metrics
from tactslip_torch.report.results import BASELINES
from tactslip_torch.simulation.scene import CALIBRATED_PATH, SEEN_MATERIALS
from tactslip_torch.simulation.source import SimulatedRecordings

GROUPS = ("per_material", "per_speed", "per_scene")

_PAPER = "recipe=paper"
EXPERIMENTS: Mapping[str, tuple[tuple[str, ...], int]] = {
    # these use the features of one set of recordings ...
    "unseen4": (("+exp=unseen4", _PAPER), 5),
    "unseen4 robust": (("+exp=unseen4", "recipe=robust"), 5),
    "random_bins": (("+exp=random_bins", _PAPER), 5),
    "shuffled": (("+exp=seen6", _PAPER, "labels.shuffle_seed=1"), 1),
    "SG means only": (
        ("+exp=unseen4", _PAPER, "recipe.feature_filter={kind:SG,descriptor:mean}"),
        3,
    ),
    "PVDF only": (("+exp=unseen4", _PAPER, "recipe.feature_filter={kind:PVDF}"), 2),
    # ... these of another ...
    "half_second": (("+exp=unseen4", _PAPER, "labels=half_second"), 5),
    "half_second random_bins": (("+exp=random_bins", _PAPER, "labels=half_second"), 5),
    # ... and each of these its own
    "motor_off": (("+exp=unseen4", _PAPER, "scene=motor_off"), 2),
    "motor_only": (("+exp=unseen4", _PAPER, "scene=motor_only"), 2),
    "confound": (("+exp=confound",), 2),
}
"""Overrides and seeds of each, in the order that shares most features."""


@dataclass(frozen=True)
class Sizes:
    """Seeds at most, experiments, and overrides of every run."""

    seeds: int = 5
    experiments: tuple[str, ...] = tuple(EXPERIMENTS)
    overrides: tuple[str, ...] = ()
    cycles: int = 3


class Reproduction(Benchmark[Sizes]):
    """Every experiment on every seed."""

    name = "reproduction"
    title = "Published numbers beside ours"
    about = "every number of ours is SIMULATED, the paper's are of a real hand"
    page, markers = "REPRODUCTION.md", "results"
    sizes = Sizes()
    quick = Sizes(
        1,
        ("random_bins", "unseen4", "confound"),
        ("data.cycles=2", "split.train_fraction=0.5", "recipe.sample_bins=60"),
        1,
    )

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """Trainings, one after the other, and checks of the signals."""
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in job.sizes.experiments}
        commands = {}
        for seed in range(job.sizes.seeds):
            for name in runs:
                overrides, seeds = EXPERIMENTS[name]
                given = [*overrides, *job.sizes.overrides, *job.overrides]
                if job.is_quick and name == "confound":
                    extra = OmegaConf.load(ROOT / "conf" / "extra_scenes" / "confound.yaml")
                    given += [
                        f"extra_scenes.{o}.cycles=2" for o in map(str, extra) if o != "defaults"
                    ]
                commands[name] = " ".join(given)
                if seed < seeds:
                    folder = job.folder / f"{name.replace(' ', '-')}-{seed}"
                    cache = job.folder / "cache"
                    metrics = trained(
                        f"{name}, seed {seed}", [*given, f"seed={seed}"], folder, cache
                    )
                    runs[name].append(kept(metrics, folder))
        return {
            "runs": runs,
            "commands": commands,
            "calibrated": json.loads(CALIBRATED_PATH.read_text(encoding="utf-8")),
            "signals": [_signal_checks(seed, job.sizes.cycles) for seed in range(job.sizes.seeds)],
        }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All of REPRODUCTION.md, and what was run."""
        rows = [
            [
                name,
                f"`train {numbers['commands'][name]}`",
                str(len(of)),
                f"{sum(run['seconds'] for run in of) / 60:.1f}",
            ]
            for name, of in numbers["runs"].items()
        ]
        ran = Table(["experiment", "command", "seeds", "minutes"], rows)
        return {**all_tables(numbers), "What was run": ran}

    def publish(self, report: Report, folder: Path) -> None:
        """The page, and the table between the markers of README.md."""
        super().publish(report, folder)
        if not report["quick"]:
            path, table = ROOT / "README.md", short_table(report["numbers"]["runs"]).markdown()
            text = path.read_text(encoding="utf-8")
            write_text(path, between_markers(text, "reproduction", table))

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Balanced accuracy of every seed, the paper's as a bar."""
        runs, axes = numbers["runs"], drawing.subplots()
        names = [(name, role) for name in runs for role in roles_of(runs, name)]
        beside = {("random_bins", "test"), ("unseen4", "unseen")}
        for place, (name, role) in enumerate(names):
            for baseline, marker, color in ((POOLED, "|", PEER), (None, "o", OURS)):
                values = percent(runs, name, role, "balanced_accuracy", baseline=baseline)
                axes.plot(values, [place] * len(values), marker, color=color, alpha=0.7, ms=5)
            if (name, role) in beside:
                x = 100 * (published.SPLITS[role].balanced_accuracy or 0)
                axes.plot([x, x], [place - 0.4, place + 0.4], color="black", lw=2)
        for marker, color, label in (
            ("o", OURS, "ours, a dot a seed"),
            ("|", PEER, "best pooled number"),
        ):
            axes.plot([], [], marker, color=color, label=label)
        axes.plot([], [], color="black", lw=2, label="paper, real hand")
        axes.set_yticks(range(len(names)), [", ".join(of) for of in names], fontsize=6)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlabel("balanced accuracy, %")
        axes.grid(axis="x", color=LIGHT)
        drawing.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)

    def figures(self, report: Report, path: Path) -> None:
        """Every seed, recall beside the onset, scenes, and the pipeline."""
        super().figures(report, path)
        runs = report["numbers"]["runs"]
        drawing = Figure(figsize=(8.4, 3.6), layout="constrained")
        axes = drawing.subplots()
        for name, color in (("unseen4", OURS), ("unseen4 robust", PEER)):
            for role, style in (("test", "o-"), ("unseen", "s--")):
                found = {
                    place: recall_beside_onset(
                        runs, name, role, [str(place) if place < 20 else "20+"]
                    )
                    for place in range(-20, 21)
                }
                means = {place: mean(values) for place, values in found.items() if values}
                label = f"{name}, {role}"
                axes.plot(list(means), list(means.values()), style, color=color, ms=3, label=label)
        axes.axvline(-0.5, color=GREY, ls="--", lw=1)
        axes.set_xlabel("bins of 50 ms beside the labelled onset: non-slip before 0, slip from 0")
        axes.set_ylabel("recall, %, mean of seeds")
        axes.legend(frameon=False, fontsize=8)
        finish(drawing, report, "Recall beside the onset", path.with_stem(f"{path.stem}_places"))
        if "confound" in runs:
            drawing = Figure(figsize=(9.2, 4.4), layout="constrained")
            panels, scenes = drawing.subplots(1, 2, sharey=True), scenes_of(runs)
            for axes, role in zip(panels, ("test", "unseen"), strict=True):
                for fold, color in zip(FOLDS, (PEER, OURS), strict=True):
                    for place, scene in enumerate(scenes):
                        values = list(scene_recalls(runs, fold, role, scene).values())
                        words = f"trained on {FOLDS[fold]}" if place == 0 else None
                        axes.plot(values, [place] * len(values), "o", color=color, label=words)
                axes.set_xlabel(f"mean recall of the classes there are, %, {role}")
                axes.grid(axis="x", color=LIGHT)
            panels[0].set_yticks(range(len(scenes)), scenes, fontsize=8)
            panels[0].legend(frameon=False, fontsize=8)
            finish(drawing, report, "Slip or the arm", path.with_stem(f"{path.stem}_confound"))


def _signal_checks(seed: int, cycles: int) -> list[dict[str, Any]]:
    """What the paper says of its signals, checked on recordings of seen materials of a seed."""
    source = SimulatedRecordings(seed=seed, cycles=cycles, materials=list(SEEN_MATERIALS))
    recordings = {
        material: [
            filtered(source.load(RecordingId(material, cycle)), source.hand)
            for cycle in range(cycles)
        ]
        for material in SEEN_MATERIALS
    }
    return check_signals(recordings)


# --------------------------------------------------------------------- counts and scores of runs
def kept(metrics: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What is kept of a run, JSON-able; of several folds, each, with the scenes trained on.

    Args:
        metrics: as the run left them.
        folder: where it did, with its resolved configuration.
    """
    row: dict[str, Any] = {name: metrics[name] for name in ("simulated", "seed")}
    row["seconds"] = metrics["timing_s"]["total"]
    if "folds" in metrics:
        config = OmegaConf.load(folder / "config.yaml")
        row["trained_scenes"] = list(OmegaConf.select(config, "split.trained_scenes"))
        return row | {"folds": {name: _of_fold(of) for name, of in metrics["folds"].items()}}
    return row | _of_fold(metrics)


def _of_fold(metrics: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "splits": {role: _counts(scores) for role, scores in metrics["splits"].items()},
        "baselines": {
            name: {
                "feature": found.get("feature"),
                "splits": {role: _counts(scores) for role, scores in found["splits"].items()},
            }
            for name, found in metrics["baselines"].items()
        },
        "penalty": metrics["penalty"],
        "validation": max((row["mean"] for row in metrics.get("validation", [])), default=None),
        "selected": metrics["selected"],
        "feature_filter": metrics.get("feature_filter"),
    }


def _counts(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Confusions of all bins and of groups; right and all bins of every place beside onsets."""
    groups = {
        kind: {label: of["confusion"] for label, of in scores[kind].items()}
        for kind in GROUPS
        if scores.get(kind)
    }
    places = {
        label: [of["num_right"], of["num_bins"]]
        for label, of in scores.get("per_position", {}).items()
    }
    return {"confusion": scores["confusion"], **groups, "per_position": places}


Runs = Mapping[str, Sequence[Mapping[str, Any]]]
"""Of each experiment, one a seed, as ``runs.kept`` has them."""
SCORES = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "non_slip_recall": "non-slip recall",
    "slip_recall": "slip recall",
}
POOLED = "best_pooled_number"


def mean_sd(values: Sequence[float], digits: int = 2, sign: str = "") -> str:
    """``mean ± sd`` over seeds, the mean alone of one, or ``-`` of nothing.

    Example:
        >>> mean_sd([1.0, 2.0, 3.0])
        '2.00 ± 1.00'
    """
    if not values:
        return "-"
    spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{sign}.{digits}f}{spread}"


def runs_of(runs: Runs, experiment: str) -> list[Mapping[str, Any]]:
    """Of an experiment; ``"confound: protocol"`` is the fold ``protocol`` of ``confound``."""
    name, _, fold = experiment.partition(": ")
    found = runs.get(name, [])
    return [run["folds"][fold] | {"seed": run["seed"]} for run in found] if fold else list(found)


def roles_of(runs: Runs, experiment: str) -> list[str]:
    """Roles that an experiment evaluates."""
    return [role for run in runs_of(runs, experiment)[:1] for role in run.get("splits", {})]


def labels_of(runs: Runs, experiment: str, role: str, kind: str) -> list[str]:
    """Labels of the groups of a kind, such as speeds."""
    splits = [run["splits"].get(role, {}) for run in runs_of(runs, experiment)]
    return list(dict.fromkeys(label for split in splits for label in split.get(kind, {})))


def by_seed(
    runs: Runs,
    experiment: str,
    role: str,
    score: str,
    *,
    group: tuple[str, str] | None = None,
    baseline: str | None = None,
) -> dict[int, float]:
    """A score in percent by seed; seeds without any are left out.

    Args:
        runs: stored.
        experiment: its name.
        role: ``"train"``, ``"test"`` or ``"unseen"``.
        score: a key of ``SCORES``.
        group: such as ``("per_speed", "20")``: of these bins alone.
        baseline: of this in the place of the detector.
    """
    found = {}
    for run in runs_of(runs, experiment):
        judged = run if baseline is None else run.get("baselines", {}).get(baseline, {})
        split = judged.get("splits", {}).get(role)
        if split is None:
            continue
        if group is None:
            value = split_metrics(split["confusion"])[score]
        elif group[1] in split.get(group[0], {}):
            value = summed_metrics([{"confusion": split[group[0]][group[1]]}])[score]
        else:
            continue
        if value is not None:
            found[run["seed"]] = 100 * value
    return found


def percent(runs: Runs, experiment: str, role: str, score: str, **of: Any) -> list[float]:
    """As ``by_seed``, the numbers alone."""
    return list(by_seed(runs, experiment, role, score, **of).values())


def gains(after: Mapping[int, float], before: Mapping[int, float]) -> list[float]:
    """What each seed that both have gains.

    Example:
        >>> gains({0: 90.0, 1: 91.0}, {1: 80.0, 2: 70.0})
        [11.0]
    """
    return [value - before[seed] for seed, value in after.items() if seed in before]


def recall_beside_onset(
    runs: Runs, experiment: str, role: str, places: Sequence[str]
) -> list[float]:
    """Recall, in percent, of bins at these places beside their onsets; a number a seed."""
    found = []
    for run in runs_of(runs, experiment):
        counts = run["splits"].get(role, {}).get("per_position", {})
        own = [counts[place] for place in places if place in counts]
        if own:
            found.append(100 * sum(right for right, _ in own) / sum(num for _, num in own))
    return found


# ------------------------------------------------------------------------------------- tables
CALIBRATED, PREDICTED, NOT_COMPARABLE = "*calibrated*", "*predicted*", "*not comparable*"
_HALF = "the published matrices do not fit half a second on either side"
SETTINGS = {
    "random_bins": ("Split at random over bins, as the authors did, the paper's recipe", ""),
    "unseen4": ("Split by cycle, whole slides, the paper's recipe", ""),
    "unseen4 robust": ("Split by cycle, whole slides, the default recipe", "the recipe is ours"),
    "half_second random_bins": ("Split at random, half a second on either side", _HALF),
    "half_second": ("Split by cycle, half a second on either side", _HALF),
}
"""By experiment its title, and why nothing of it compares with the paper, if so."""
WHERE = {"train": "training bins", "test": "test bins", "unseen": "held-out materials"}
ABLATIONS = {
    "unseen4": "everything",
    "PVDF only": "PVDF films only",
    "SG means only": "means of the SGs only",
    "motor_off": "everything, motors and jolts of the arm off",
    "motor_only": "motors and jolts of the arm, the contact as good as silent",
    "shuffled": "everything, labels permuted; must show 50 %",
}
LAYOUTS = {
    "whole slides": ("random_bins", "unseen4"),
    "half a second on either side": ("half_second random_bins", "half_second"),
}
"""The experiment split at random over bins and the one split by cycle."""
PLACES: Mapping[str, Sequence[str]] = {
    "-20 to -11": [str(place) for place in range(-20, -10)],
    "-10 to -4": [str(place) for place in range(-10, -3)],
    **{str(place): [str(place)] for place in range(-3, 3)},
    "3 to 9": [str(place) for place in range(3, 10)],
    "10 to 19": [str(place) for place in range(10, 20)],
    "20 and on": ["20+"],
}
"""Bins beside an onset by where they stand; 0 is the first that is labelled slip."""
FOLDS = {"protocol": "the protocol alone", "with_scenes": "such scenes as well"}
PAPER_SCENE = "paper"
CLEARLY, NO_WORSE = 2.0, 0.5
"""Points that scenes must gain in every seed, and that the protocol may lose in the mean."""
SHORT = {
    "random_bins": ("test",),
    "unseen4": ("train", "test", "unseen"),
    "unseen4 robust": ("test", "unseen"),
    "half_second": ("test", "unseen"),
    "shuffled": ("test",),
}
"""Experiments and roles of the table in README.md."""


def all_tables(numbers: Mapping[str, Any]) -> dict[str, Table]:
    """Every table by title."""
    runs: Runs = numbers["runs"]
    found = {
        SETTINGS[name][0]: _beside(runs, name, numbers["calibrated"])
        for name in SETTINGS
        if name in runs
    }
    found["Selected features"] = _selected(runs)
    found["Signals"] = _signals(numbers["signals"])
    found["Beside the onset"] = _places(runs)
    found["By stroke"] = _strokes(runs)
    found["With less"] = _ablations(runs)
    found["Baselines"] = _baselines(runs)
    found["Recipes"] = _validation(runs)
    found["Leakage"] = _leakage(runs)
    if "confound" in runs:
        found |= _confound(runs)
    found["What was calibrated"] = _parameters(numbers["calibrated"])
    return {title: table for title, table in found.items() if table.rows}


def _beside(runs: Runs, experiment: str, calibrated: Mapping[str, Any]) -> Table:
    """Every published score beside ours, marked."""
    rows = []
    for role, paper in published.SPLITS.items():
        for score, words in SCORES.items():
            value, ours = getattr(paper, score), percent(runs, experiment, role, score)
            if value is None or not ours:
                continue
            mark = _mark(experiment, role, score, calibrated)
            rows.append(_row(f"{words}, {WHERE[role]}, %", 100 * value, ours, 2, mark))
        quiet = percent(runs, experiment, role, "non_slip_recall")
        if paper.non_slip_recall is not None and quiet:
            alarms = (1 - paper.non_slip_recall) * published.BINS_PER_MINUTE
            ours = [(100 - value) / 100 * published.BINS_PER_MINUTE for value in quiet]
            mark = _mark(experiment, role, "", calibrated)
            what = f"false slips a minute of non-slip, {WHERE[role]}"
            rows.append(_row(what, alarms, ours, 0, mark))
    classes = [[sum(c) for c in r["splits"]["test"]["confusion"]] for r in runs[experiment]]
    larger = [100 * max(of) / sum(of) for of in classes]
    mark = _mark(experiment, "labels", "", calibrated)
    what = "fraction of the larger class, test bins, %"
    rows.append(_row(what, 100 * published.LARGER_CLASS, larger, 2, mark))
    header = ["published", "paper", "ours, simulated", "ours - paper", "", "why"]
    return Table(header, rows, f"{len(runs[experiment])} seeds.")


def _row(
    what: str, paper: float, ours: Sequence[float], digits: int, mark: tuple[str, str]
) -> list[str]:
    values = [f"{paper:.{digits}f}", mean_sd(ours, digits), f"{mean(ours) - paper:+.{digits}f}"]
    return [what, *values, *mark]


def _mark(experiment: str, role: str, score: str, calibrated: Mapping[str, Any]) -> tuple[str, str]:
    if SETTINGS[experiment][1]:
        return NOT_COMPARABLE, SETTINGS[experiment][1]
    if role == "labels":
        return PREDICTED, "follows from where bins are laid"
    if role == "unseen":
        return PREDICTED, "calibration looked at none"
    if role == "test" and experiment == "unseen4":
        return NOT_COMPARABLE, "the paper's test bins have neighbours among its training bins"
    if (experiment, role, score) == ("random_bins", "test", "accuracy") and "target" in calibrated:
        return CALIBRATED, f"three parameters were set by it: {calibrated['verdict']}"
    return PREDICTED, "no parameter was calibrated by it"


def _selected(runs: Runs) -> Table:
    """Where selected features come from: mean counts over seeds."""
    recipes = {"random_bins": "the paper's recipe", "unseen4 robust": "`robust`"}
    recipes = {name: words for name, words in recipes.items() if name in runs}
    hand = HandLayout.paper24()
    ranks = {name: f"rank {at}" for at, name in enumerate(published.DESCRIPTORS_RANKED, 1)}
    ranks |= dict.fromkeys(published.DESCRIPTORS_NEVER, "0")
    wanted: list[tuple[str, str, Callable[[list[str]], bool]]] = []

    def count(what: str, paper: object, is_one: Callable[[list[str]], bool]) -> None:
        wanted.append((what, str(paper), is_one))

    for kind, num in published.SELECTED_BY_KIND.items():
        count(kind, num, lambda f, kind=kind: hand.channel(f[0]).kind == kind)  # type: ignore[misc]
        for finger, of in published.SELECTED_BY_FINGER[kind].items():
            at = (kind, finger)
            count(f"{kind}, {finger}", of, lambda f, at=at: _place(hand, f[0]) == at)  # type: ignore[misc]
    for letter, words, paper in (("A", "approximations", "more"), ("D", "details", "fewer")):
        count(words, paper, lambda f, letter=letter: f[1][0] == letter)  # type: ignore[misc]
    count("D1", 0, lambda f: f[1] == "D1")
    count("PVDF, of spectra", "more", lambda f: f[2] == "freq" and f[0].startswith("PVDF"))
    count("PVDF, in time", "fewer", lambda f: f[2] == "time" and f[0].startswith("PVDF"))
    for name, rank in ranks.items():
        count(name, rank, lambda f, name=name: f[3] == name)  # type: ignore[misc]
    rows = []
    for what, paper, is_one in wanted:
        cells = [what.replace("_", " "), paper]
        for name in recipes:
            of_seeds = [[feature.split() for feature in run["selected"]] for run in runs[name]]
            cells.append(mean_sd([float(sum(map(is_one, of))) for of in of_seeds], 1))
        rows.append(cells)
    note = (
        f"Counts; the paper selects {published.NUM_SELECTED}, and prints of descriptors an order "
        "only. Its features were ranked on all bins, ours on training bins."
    )
    return Table(["selected", "paper", *(f"{w}, simulated" for w in recipes.values())], rows, note)


def _place(hand: HandLayout, channel: str) -> tuple[str, str]:
    of = hand.channel(channel)
    return of.kind, of.finger


def _signals(signals: Sequence[Sequence[Mapping[str, Any]]]) -> Table:
    """What the paper says its signals look like, and whether the simulated ones do."""
    rows = []
    for facts in zip(*signals, strict=True):
        values = [value for fact in facts for value in fact["values"].values()]
        low, high = facts[0]["low"], facts[0]["high"]
        asked = f"above {low:g}" if high is None else f"{low:g} to {high:g}"
        holds = f"{sum(bool(fact['holds']) for fact in facts)} of {len(facts)}"
        rows.append([facts[0]["says"], f"{min(values):.3g} to {max(values):.3g}", asked, holds])
    note = "Least to largest over materials and seeds."
    return Table(["the paper's signals", "ours, simulated", "asked", "holds, seeds"], rows, note)


def _places(runs: Runs) -> Table:
    names = [name for name in ("unseen4", "unseen4 robust") if name in runs]
    columns = [(name, role) for name in names for role in ("test", "unseen")]
    rows = []
    for words, places in PLACES.items():
        found = [recall_beside_onset(runs, *column, places) for column in columns]
        label = "non-slip" if words.startswith("-") else "slip"
        rows.append([f"{words} ({label})", *map(mean_sd, found)])
    header = ["bin beside its onset", *(", ".join(column) for column in columns)]
    return Table(header, rows, "Recall, %. A bin is 50 ms; 0 is the first that is labelled slip.")


def _strokes(runs: Runs) -> Table:
    rows = []
    for name in ("unseen4", "unseen4 robust"):
        for role in ("test", "unseen"):
            for speed in labels_of(runs, name, role, "per_speed"):
                group = ("per_speed", speed)
                cells = [mean_sd(percent(runs, name, role, of, group=group)) for of in SCORES]
                rows.append([f"{name}, {role}, {speed} mm/s", *cells])
    return Table(["stroke", *(f"{name}, %" for name in SCORES.values())], rows)


def _ablations(runs: Runs) -> Table:
    """With a part of the signals or of the scene, and the best pooled number with a threshold."""
    rows = []
    ways: list[tuple[str, str, str | None]]
    ways = [(name, words, None) for name, words in ABLATIONS.items() if name in runs]
    if "unseen4" in runs:
        ways.insert(1, ("unseen4", "the best single pooled number with a threshold", POOLED))
    for name, words, baseline in ways:
        cells = []
        for role in ("test", "unseen"):
            own = by_seed(runs, name, role, "balanced_accuracy", baseline=baseline)
            whole = by_seed(runs, "unseen4", role, "balanced_accuracy")
            cells += [mean_sd(list(own.values())), mean_sd(gains(own, whole), sign="+")]
        rows.append([words, *cells, str(len(runs[name]))])
    header = ["trained and evaluated with", "test %", "to everything", "unseen %", "to everything"]
    note = "Balanced accuracy; differences in points at the same seeds; the paper's recipe."
    return Table([*header, "seeds"], rows, note)


def _baselines(runs: Runs) -> Table:
    rows = []
    for name in runs:
        for role in roles_of(runs, name):
            cells = [
                mean_sd(percent(runs, name, role, "balanced_accuracy", baseline=baseline))
                for baseline in (None, *BASELINES)
            ]
            rows.append([f"{name}, {role}", *cells])
    note = "All are fitted on the same training recordings; baselines on a sample of their bins."
    return Table(["balanced accuracy, %", "detector", *BASELINES.values()], rows, note)


def _validation(runs: Runs) -> Table:
    rows = []
    for name in ("unseen4", "unseen4 robust"):
        values = [run.get("validation") for run in runs.get(name, [])]
        if values and None not in values:
            percents = [100 * value for value in values if value is not None]
            rows.append([name, mean_sd(percents), ", ".join(f"{of:.2f}" for of in percents)])
    note = "Balanced accuracy of the best choice of K and C; no test and no held-out bin is in it."
    return Table(["recipe", "left-out training materials, %", "by seed"], rows, note)


def _leakage(runs: Runs) -> Table:
    rows = []
    for layout, (at_random, by_cycle) in LAYOUTS.items():
        for score, name in SCORES.items():
            both = [by_seed(runs, of, "test", score) for of in (at_random, by_cycle)]
            if found := gains(*both):
                cells = [mean_sd(list(of.values())) for of in both]
                cells += [mean_sd(found, sign="+"), str(len(found))]
                rows.append([f"{name}, {layout}", *cells])
    header = ["test bins", "at random over bins, %", "by cycle, %", "leak, points", "seeds"]
    return Table(header, rows, "The leak is that of each seed, then mean and spread.")


def scene_gains(runs: Runs, role: str, scene: str) -> list[float]:
    """Points of mean recall that a scene gains when such scenes are trained on, by seed."""
    before, after = (scene_recalls(runs, fold, role, scene) for fold in FOLDS)
    return gains(after, before)


def scene_recalls(runs: Runs, fold: str, role: str, scene: str) -> dict[int, float]:
    """Mean recall of the classes that a scene has, in percent by seed."""
    name, group = f"confound: {fold}", ("per_scene", scene)
    classes = ("non_slip_recall", "slip_recall")
    both = [by_seed(runs, name, role, score, group=group) for score in classes]
    there = [of for of in both if of]
    return {seed: mean(of[seed] for of in there) for seed in (there[0] if there else {})}


def scenes_of(runs: Runs) -> list[str]:
    """Scenes that both detectors are evaluated on, the protocol first."""
    found = labels_of(runs, "confound: protocol", "test", "per_scene")
    return sorted(found, key=lambda scene: scene != PAPER_SCENE)


def _confound(runs: Runs) -> dict[str, Table]:
    """Slip or the arm: recalls on each scene, and what training on such scenes does."""
    trained = set(runs["confound"][0]["trained_scenes"])
    roles = ("test", "unseen")
    rows = []
    for scene, fold in ((scene, fold) for scene in scenes_of(runs) for fold in FOLDS):
        is_known = scene == PAPER_SCENE or (fold == "with_scenes" and scene in trained)
        cells = [
            mean_sd(percent(runs, f"confound: {fold}", role, score, group=("per_scene", scene)))
            for role in roles
            for score in ("non_slip_recall", "slip_recall")
        ]
        mark = " (trained on)" if is_known else ""
        rows.append([f"{scene}, trained on {FOLDS[fold]}{mark}", *cells])
    header = ["scene", *(f"{role}: {of}, %" for role in roles for of in ("non-slip", "slip"))]
    others = [scene for scene in scenes_of(runs) if scene != PAPER_SCENE]
    on_scenes = [
        mean(of) for of in zip(*(scene_gains(runs, "test", s) for s in others), strict=True)
    ]
    changes = {role: scene_gains(runs, role, PAPER_SCENE) for role in roles}
    is_better = min(on_scenes) > CLEARLY
    is_no_worse = min(mean(values) for values in changes.values()) >= -NO_WORSE
    gained = [
        ["scenes, test cycles, mean of all but the protocol", mean_sd(on_scenes, sign="+")],
        *([f"the protocol, {role}", mean_sd(changes[role], sign="+")] for role in roles),
        ["clearly better on scenes", "yes" if is_better else "no"],
        ["no worse on the protocol", "yes" if is_no_worse else "no"],
    ]
    note = (
        f"Clearly better: more than {CLEARLY:g} points in every seed; no worse: a mean loss of at "
        f"most {NO_WORSE:g}. Both are asked for before training on such scenes is recommended."
    )
    return {
        "Slip or the arm": Table(header, rows, "Recalls; - where a scene has no bin of a class."),
        "What training on such scenes gains": Table(["points", "gain"], gained, note),
    }


def _parameters(calibrated: Mapping[str, Any]) -> Table:
    rows = [
        [name, " to ".join(f"{of:g}" for of in (value if isinstance(value, list) else [value]))]
        for name, value in calibrated["values"].items()
    ]
    note = f"Provenance: {calibrated['provenance'].rstrip('.')}."
    if "target" in calibrated:
        target = calibrated["target"]
        note += (
            f" Aim: {100 * target['accuracy']:.2f} % ({target['row']}); reached: "
            f"{100 * calibrated['accuracy']:.2f} %, mean over other seeds: {calibrated['verdict']}."
        )
    return Table(["parameter", "frozen value"], rows, note)


def short_table(runs: Runs) -> Table:
    """The table of README.md."""
    return Table(
        ["experiment", *(f"{of} %" for of in SCORES.values()), "best pooled number, balanced %"],
        list(_short_rows(runs)),
    )


def _short_rows(runs: Runs) -> Iterator[list[str]]:
    compared = {("random_bins", "test"), ("unseen4", "unseen")}
    for name, role in ((name, role) for name, roles in SHORT.items() for role in roles):
        if name not in runs:
            continue
        cells = [mean_sd(percent(runs, name, role, score)) for score in SCORES]
        pooled = mean_sd(percent(runs, name, role, "balanced_accuracy", baseline=POOLED))
        yield [f"`{name}` {role}, simulated, {len(runs[name])} seeds", *cells, pooled]
        if (name, role) in compared:
            values = [getattr(published.SPLITS[role], score) for score in SCORES]
            of_paper = ["" if value is None else f"{100 * value:.2f}" for value in values]
            yield [f"paper, real hand, {role}", *of_paper, ""]


if __name__ == "__main__":
    raise SystemExit(Reproduction().run())
