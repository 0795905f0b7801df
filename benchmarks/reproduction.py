"""Published numbers beside ours: ``python -m benchmarks.reproduction [key=value ...]``.

Trains every experiment on every seed. Runs that this very code finished are kept, so it resumes.
Writes the tables of docs/reproduction.md between their markers, and the figures.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Any, ClassVar

import numpy as np
from omegaconf import OmegaConf

from benchmarks import ROOT
from benchmarks.harness import Benchmark, Job, put_between
from benchmarks.signal_checks import check_signals, filtered
from benchmarks.tables import Report, Table, mean_sd, percent
from benchmarks.trainings import trained
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.hand import HandLayout
from tactslip_torch.report import published
from tactslip_torch.report.metrics import split_metrics
from tactslip_torch.report.results import BASELINES
from tactslip_torch.simulation.scene import CALIBRATED_PATH, SEEN_MATERIALS
from tactslip_torch.simulation.simulate import SimulatedRecordings

GROUPS = ("per_material", "per_speed", "per_scene")

_PAPER = "recipe=paper"
_QUICK_SCENES = ("arm_motion", "pulled", "motor_off", "mains_bursts")
EXPERIMENTS: Mapping[str, tuple[tuple[str, ...], int]] = {
    # these use the features of one set of recordings ...
    "unseen4": (("+exp=unseen4", _PAPER), 5),
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
class Reproduction(Benchmark):
    """Every experiment on every seed.

    Seeds at most, experiments, and overrides of every run.
    """

    title = "Published numbers beside ours"
    about = "every number of ours is SIMULATED, the paper's are of a real hand"
    page, markers = "docs/reproduction.md", "results"
    quick = (
        "seeds=1 experiments=[random_bins,unseen4,confound] overrides=[data.cycles=2,num_workers=0,"
        'split.train_fraction=0.5,recipe.sample_bins=30,"data.materials=[M1,M4,iron]",'
        '"split.seen=[M1,M4]"] cycles=1'
    )
    charts: ClassVar = {
        "": [("Baselines", "")],
        "_places": [("Beside the onset", "")],
        "_confound": [("Slip or the arm", "")],
    }
    seeds: int = 5
    experiments: tuple[str, ...] = tuple(EXPERIMENTS)
    overrides: tuple[str, ...] = ()
    cycles: int = 3

    def measure(self, job: Job) -> dict[str, Any]:
        """Trainings, one after the other, and checks of the signals."""
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in self.experiments}
        commands = {}
        for seed in range(self.seeds):
            for name in runs:
                overrides, seeds = EXPERIMENTS[name]
                given = [*overrides, *self.overrides, *job.overrides]
                if job.is_quick and name != "random_bins":
                    given.append("split.unseen=[iron]")
                if job.is_quick and name == "confound":
                    given += [f"extra_scenes.{scene}.cycles=2" for scene in _QUICK_SCENES]
                    given += [f"~extra_scenes.{scene}" for scene in ("grips", "machine", "taps")]
                commands[name] = " ".join(given)
                if seed < seeds:
                    folder = job.folder / f"{name.replace(' ', '-')}-{seed}"
                    metrics = trained([*given, f"seed={seed}"], folder, job.folder / "cache")
                    runs[name].append(kept(metrics, folder))
        return {
            "runs": runs,
            "commands": commands,
            "calibrated": json.loads(CALIBRATED_PATH.read_text(encoding="utf-8")),
            "signals": [_signal_checks(seed, self.cycles) for seed in range(self.seeds)],
        }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All of docs/reproduction.md, and what was run."""
        runs, calibrated = numbers["runs"], numbers["calibrated"]
        scores = Scores(runs)
        found = {
            title: _beside(numbers, scores, name)
            for name, (title, _) in SETTINGS.items()
            if name in runs
        }
        found |= {
            "Selected features": _selected(runs),
            "Signals": _signals(numbers["signals"]),
            "Beside the onset": _places(runs, scores),
            "By stroke": _strokes(scores),
            "With less": _ablations(runs, scores),
            "Baselines": _baselines(runs, scores),
            "Recipes": _validation(runs),
            "Leakage": _leakage(scores),
            **(_confound(runs, scores) if "confound" in runs else {}),
            "What was calibrated": _parameters(calibrated),
        }
        ran = [
            {
                "experiment": name,
                "command": f"`train {numbers['commands'][name]}`",
                "seeds": len(of),
                "minutes": f"{sum(run['seconds'] for run in of) / 60:.1f}",
            }
            for name, of in runs.items()
        ]
        found["What was run"] = Table(ran)
        return {title: table for title, table in found.items() if table.rows}

    def publish_more(self, report: Report) -> None:
        """The page's summary, between markers of its own."""
        table = _short_table(report["numbers"]["runs"]).markdown()
        put_between(ROOT / self.page, "reproduction", table)


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
    def counted(of: Mapping[str, Any]) -> dict[str, Any]:
        return {role: _counts(scores) for role, scores in of["splits"].items()}

    return {
        "splits": counted(metrics),
        "baselines": {
            name: {"feature": found.get("feature"), "splits": counted(found)}
            for name, found in metrics["baselines"].items()
        },
        "penalty": metrics["penalty"],
        "validation": max((row["mean"] for row in metrics.get("validation", [])), default=None),
        "selected": metrics["selected"],
        "feature_filter": metrics.get("feature_filter"),
    }


def _counts(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Confusions of all bins and of groups; right and all bins of every place beside onsets."""
    places = scores.get("per_position", {}).items()
    return {
        "confusion": scores["confusion"],
        **{
            kind: {label: of["confusion"] for label, of in scores[kind].items()}
            for kind in GROUPS
            if scores.get(kind)
        },
        "per_position": {label: [of["num_right"], of["num_bins"]] for label, of in places},
    }


Runs = Mapping[str, Sequence[Mapping[str, Any]]]
"""Of each experiment, one a seed, as ``kept`` has them."""
SCORES = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "non_slip_recall": "non-slip recall",
    "slip_recall": "slip recall",
}
POOLED = "best_pooled_number"
BySeed = dict[int, float]


class Scores:
    """Every score of every run, in percent.

    Args:
        runs: stored; of several folds each counts as an experiment ``"name: fold"`` of its own.
    """

    def __init__(self, runs: Runs) -> None:
        self._splits: dict[tuple[str, str, str], dict[int, Mapping[str, Any]]] = {}
        for name, of in runs.items():
            folds = [(run["seed"], *fold) for run in of for fold in _folds_of(run)]
            for seed, fold, one in folds:
                experiment = f"{name}: {fold}" if fold else name
                for way, found in {"": one, **one.get("baselines", {})}.items():
                    for role, split in found["splits"].items():
                        self._splits.setdefault((experiment, way, role), {})[seed] = split

    def of(
        self,
        experiment: str,
        role: str,
        score: str = "balanced_accuracy",
        *,
        group: tuple[str, str] | None = None,
        baseline: str = "",
    ) -> BySeed:
        """A score by seed; seeds without any are left out.

        Args:
            experiment: its name.
            role: ``"train"``, ``"test"`` or ``"unseen"``.
            score: a key of ``SCORES``.
            group: such as ``("per_speed", "20")``: of these bins alone.
            baseline: of this in the place of the detector.
        """
        found = {}
        for seed, split in self._splits.get((experiment, baseline, role), {}).items():
            confusion = split.get(group[0], {}).get(group[1]) if group else split["confusion"]
            if confusion and (value := split_metrics(confusion)[score]) is not None:
                found[seed] = 100 * value
        return found

    def beside_onset(self, experiment: str, role: str, places: Sequence[str]) -> list[float]:
        """Recall of bins at these places beside their onsets; a number a seed."""
        found = []
        for split in self._splits.get((experiment, "", role), {}).values():
            counts = split.get("per_position", {})
            if own := [counts[place] for place in places if place in counts]:
                right, num = map(sum, zip(*own, strict=True))
                found.append(100 * right / num)
        return found

    def roles(self, experiment: str) -> list[str]:
        """Roles that an experiment evaluates."""
        return [role for name, way, role in self._splits if (name, way) == (experiment, "")]

    def labels(self, experiment: str, role: str, kind: str) -> list[str]:
        """Labels of the groups of a kind, such as speeds."""
        splits = self._splits.get((experiment, "", role), {}).values()
        return list(dict.fromkeys(label for split in splits for label in split.get(kind, {})))


def _folds_of(run: Mapping[str, Any]) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """The folds of a run by name; a run without any is one without a name."""
    folds: Mapping[str, Mapping[str, Any]] = run.get("folds", {"": run})
    return folds.items()


def gains(after: BySeed, before: BySeed) -> list[float]:
    """What each seed that both have gains.

    Example:
        >>> gains({0: 90.0, 1: 91.0}, {1: 80.0, 2: 70.0})
        [11.0]
    """
    return [value - before[seed] for seed, value in after.items() if seed in before]


# ------------------------------------------------------------------------------------- tables
CALIBRATED, PREDICTED, NOT_COMPARABLE = "*calibrated*", "*predicted*", "*not comparable*"
_HALF = "the published confusion matrices do not fit this layout of bins"
SETTINGS = {
    "random_bins": ("Split at random over bins, as the authors did, the paper's recipe", ""),
    "unseen4": ("Split by cycle, whole slides, the paper's recipe", ""),
    "half_second random_bins": (
        "Split at random, half a second on either side of the onset",
        _HALF,
    ),
    "half_second": ("Split by cycle, half a second on either side of the onset", _HALF),
}
"""By experiment its title, and why nothing of it compares with the paper, if so."""
WHERE = {"train": "training bins", "test": "test bins", "unseen": "held-out materials"}
ROLES = {"train": "train", "test": "test", "unseen": "held-out materials"}
"""In words, of bins and of experiments."""
ABLATIONS = {
    "unseen4": "everything",
    "PVDF only": "PVDF films only",
    "SG means only": "means of the SGs only",
    "motor_off": "everything, motors and jolts of the arm off",
    "motor_only": "motors and jolts of the arm, the contact nearly silent",
    "shuffled": "everything, labels permuted; must give 50 %",
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
BY_CYCLE = ("unseen4",)
COMPARED = (("random_bins", "test"), ("unseen4", "unseen"))
"""Experiments and roles that the paper has too."""
CLASS_RECALLS = {"non-slip": "non_slip_recall", "slip": "slip_recall"}
SHORT = {
    "random_bins": ("test",),
    "unseen4": ("train", "test", "unseen"),
    "half_second": ("test", "unseen"),
    "shuffled": ("test",),
}
"""Experiments and roles of the summary."""


def _beside(numbers: Report, scores: Scores, experiment: str) -> Table:
    """Every published score beside ours, marked."""
    rows: list[dict[str, object]] = []

    def row(
        what: str, paper: float, values: Collection[float], digits: int, role: str, of: str
    ) -> None:
        mark, why = _mark(experiment, role, of, numbers["calibrated"])
        cells: dict[str, object] = {"published": what, "paper": f"{paper:.{digits}f}"}
        cells["ours, simulated"] = mean_sd(values, digits)
        cells["ours - paper"] = f"{mean(values) - paper:+.{digits}f}"
        rows.append(cells | {"": mark, "why": why})

    for role, paper in published.SPLITS.items():
        for score, words in SCORES.items():
            value, ours = getattr(paper, score), scores.of(experiment, role, score)
            if value is not None and ours:
                row(f"{words}, {WHERE[role]}, %", 100 * value, ours.values(), 2, role, score)
        quiet = scores.of(experiment, role, "non_slip_recall").values()
        if paper.non_slip_recall is not None and quiet:
            alarms = (1 - paper.non_slip_recall) * published.BINS_PER_MINUTE
            ours_a_minute = [(100 - value) / 100 * published.BINS_PER_MINUTE for value in quiet]
            what = f"false slips a minute without slip, {WHERE[role]}"
            row(what, alarms, ours_a_minute, 0, role, "")
    runs = numbers["runs"][experiment]
    classes = [[sum(of) for of in run["splits"]["test"]["confusion"]] for run in runs]
    larger = [100 * max(of) / sum(of) for of in classes]
    what = "fraction of the larger class, test bins, %"
    row(what, 100 * published.LARGER_CLASS, larger, 2, "labels", "")
    return Table(rows, f"{_seeds(len(runs))}.")


def _seeds(number: int) -> str:
    return f"{number} seed{'s' * (number != 1)}"


def _mark(experiment: str, role: str, score: str, calibrated: Mapping[str, Any]) -> tuple[str, str]:
    if SETTINGS[experiment][1]:
        return NOT_COMPARABLE, SETTINGS[experiment][1]
    if role == "labels":
        return PREDICTED, "follows from the layout of bins"
    if role == "unseen":
        return PREDICTED, "calibration used no held-out material"
    if role == "test" and experiment == "unseen4":
        return NOT_COMPARABLE, "the paper's test bins have neighbours among its training bins"
    if (experiment, role, score) == ("random_bins", "test", "accuracy") and "target" in calibrated:
        return CALIBRATED, f"three parameters were set by it: {_outcome(calibrated)}"
    return PREDICTED, "not used in calibration"


def _selected(runs: Runs) -> Table:
    """Where selected features come from: mean counts over seeds."""
    paper: dict[str, object] = {}
    for kind, num in published.SELECTED_BY_KIND.items():
        by_finger = published.SELECTED_BY_FINGER[kind].items()
        paper |= {kind: num} | {f"{kind}, {finger}": of for finger, of in by_finger}
    paper |= {"approximations": "more", "details": "fewer", "D1": 0}
    paper |= {"PVDF, of spectra": "more", "PVDF, in time": "fewer"}
    paper |= {name: f"rank {at}" for at, name in enumerate(published.DESCRIPTORS_RANKED, 1)}
    paper |= dict.fromkeys(published.DESCRIPTORS_NEVER, "0")
    recipes = {"random_bins": "the paper's recipe"}
    counts = {
        f"{words}, simulated": [_kinds_of(run["selected"]) for run in runs[name]]
        for name, words in recipes.items()
        if name in runs
    }
    rows = [
        {"selected": what.replace("_", " "), "paper": of}
        | {words: mean_sd([seed[what] for seed in seeds], 1) for words, seeds in counts.items()}
        for what, of in paper.items()
    ]
    note = (
        f"Counts. The paper selects {published.NUM_SELECTED} features, and of descriptors it gives "
        "the order only. Its features were ranked on all bins, ours on training bins."
    )
    return Table(rows, note)


def _kinds_of(selected: Sequence[str]) -> Counter[str]:
    """How many features are of a kind of channel, finger, component, domain and descriptor."""
    hand, counts = HandLayout.paper24(), Counter[str]()
    branches = {"A": "approximations", "D": "details"}
    for channel, component, domain, descriptor in map(str.split, selected):
        of = hand.channel(channel)
        counts.update([of.kind, f"{of.kind}, {of.finger}", component, descriptor])
        counts[branches.get(component[0], "")] += 1
        counts[f"{of.kind}, {'of spectra' if domain == 'freq' else 'in time'}"] += 1
    return counts


def _signals(signals: Sequence[Sequence[Mapping[str, Any]]]) -> Table:
    """What the paper says its signals look like, and whether the simulated ones do."""
    rows = []
    for checks in zip(*signals, strict=True):
        values = [value for check in checks for value in check["values"].values()]
        low, high = checks[0]["low"], checks[0]["high"]
        row = {"the paper's signals": checks[0]["says"]}
        row["ours, simulated"] = f"{min(values):.3g} to {max(values):.3g}"
        row["limits"] = f"above {low:g}" if high is None else f"{low:g} to {high:g}"
        holds = sum(bool(check["holds"]) for check in checks)
        rows.append(row | {"met, seeds": f"{holds} of {len(checks)}"})
    return Table(rows, "Lowest to highest over materials and seeds.")


def _places(runs: Runs, scores: Scores) -> Table:
    columns = [(name, role) for name in BY_CYCLE if name in runs for role in ("test", "unseen")]
    rows = [
        {"bin": f"{words} ({'non-slip' if words.startswith('-') else 'slip'})"}
        | {
            f"{name}, {ROLES[role]}": mean_sd(scores.beside_onset(name, role, places))
            for name, role in columns
        }
        for words, places in PLACES.items()
    ]
    return Table(rows, "Recall, %. A bin is 50 ms; bin 0 is the first that is labelled slip.")


def _strokes(scores: Scores) -> Table:
    rows = [
        {"stroke": f"{name}, {ROLES[role]}, {speed} mm/s"}
        | {
            f"{words}, %": mean_sd(scores.of(name, role, of, group=("per_speed", speed)).values())
            for of, words in SCORES.items()
        }
        for name in BY_CYCLE
        for role in ("test", "unseen")
        for speed in scores.labels(name, role, "per_speed")
    ]
    return Table(rows)


def _ablations(runs: Runs, scores: Scores) -> Table:
    """With a part of the signals or of the scene, and the best pooled number with a threshold."""
    rows = []
    ways = [(name, words, "") for name, words in ABLATIONS.items() if name in runs]
    if "unseen4" in runs:
        ways.insert(1, ("unseen4", "the best single pooled number with a threshold", POOLED))
    for name, words, baseline in ways:
        row: dict[str, object] = {"trained and evaluated with": words}
        for role in ("test", "unseen"):
            own, whole = scores.of(name, role, baseline=baseline), scores.of("unseen4", role)
            row[f"{ROLES[role]} %"] = mean_sd(own.values())
            row[f"{ROLES[role]}: change"] = mean_sd(gains(own, whole), sign="+")
        rows.append(row | {"seeds": len(runs[name])})
    note = (
        "Balanced accuracy, with the paper's recipe. *Change*: the difference to *everything* at "
        "the same seeds, in points."
    )
    return Table(rows, note)


def _baselines(runs: Runs, scores: Scores) -> Table:
    rows = [
        {"balanced accuracy, %": f"{name}, {ROLES[role]}"}
        | {
            words: mean_sd(scores.of(name, role, baseline=baseline).values())
            for baseline, words in {"": "detector", **BASELINES}.items()
        }
        for name in runs
        for role in scores.roles(name)
    ]
    note = "All are fitted on the same training recordings, baselines on a sample of their bins."
    return Table(rows, note)


def _validation(runs: Runs) -> Table:
    rows = []
    for name in BY_CYCLE:
        percents = [100 * run["validation"] for run in runs.get(name, []) if run["validation"]]
        if percents:
            row = {"experiment": name, "training materials left out, %": mean_sd(percents)}
            rows.append(row | {"by seed": ", ".join(f"{of:.2f}" for of in percents)})
    note = (
        "Balanced accuracy of the best choice of K and C, without any bin of test cycles or of "
        "held-out materials."
    )
    return Table(rows, note)


def _leakage(scores: Scores) -> Table:
    rows = []
    for layout, experiments in LAYOUTS.items():
        for score, name in SCORES.items():
            at_random, by_cycle = (scores.of(of, "test", score) for of in experiments)
            if found := gains(at_random, by_cycle):
                rows.append(
                    {
                        "test bins": f"{name}, {layout}",
                        "at random over bins, %": mean_sd(at_random.values()),
                        "by cycle, %": mean_sd(by_cycle.values()),
                        "leakage, points": mean_sd(found, sign="+"),
                        "seeds": len(found),
                    }
                )
    return Table(rows, "Leakage is computed for each seed; mean and standard deviation over seeds.")


def _confound(runs: Runs, scores: Scores) -> dict[str, Table]:
    """Slip or the arm: recalls on each scene, and what training on such scenes does."""
    trained_on, roles = set(runs["confound"][0]["trained_scenes"]), ("test", "unseen")
    found = scores.labels("confound: protocol", "test", "per_scene")
    scenes = sorted(found, key=lambda scene: scene != PAPER_SCENE)  # that both are evaluated on

    def recalls(fold: str, role: str, scene: str) -> dict[str, BySeed]:
        """Of the classes, in percent by seed; empty of one that a scene has not."""
        group = "per_scene", scene
        return {
            words: scores.of(f"confound: {fold}", role, score, group=group)
            for words, score in CLASS_RECALLS.items()
        }

    rows = []
    for scene, fold in product(scenes, FOLDS):
        is_known = scene == PAPER_SCENE or (fold == "with_scenes" and scene in trained_on)
        mark = " (in training)" if is_known else ""
        row = {"scene": f"{scene}, trained on {FOLDS[fold]}{mark}"}
        for role in roles:
            for words, of in recalls(fold, role, scene).items():
                row[f"{ROLES[role]}: {words}, %"] = mean_sd(of.values())
        rows.append(row)

    def scene_gains(role: str, scene: str) -> list[float]:
        """Points of mean recall that a scene gains when such scenes are trained on, by seed."""
        means = []
        for fold in FOLDS:
            there = [of for of in recalls(fold, role, scene).values() if of]
            means.append({seed: mean(of[seed] for of in there) for seed in there[0]})
        return gains(means[1], means[0])

    others = [scene_gains("test", scene) for scene in scenes if scene != PAPER_SCENE]
    on_scenes = [mean(of) for of in zip(*others, strict=True)]
    changes = {role: scene_gains(role, PAPER_SCENE) for role in roles}
    gained: dict[str, object] = {
        "scenes, test cycles, mean of all but the protocol": mean_sd(on_scenes, sign="+"),
        **{f"the protocol, {ROLES[role]}": mean_sd(changes[role], sign="+") for role in roles},
        "clearly better on scenes": min(on_scenes) > CLEARLY,
        "not worse on the protocol": min(map(mean, changes.values())) >= -NO_WORSE,
    }
    note = (
        f"Clearly better: more than {CLEARLY:g} points in every seed. Not worse: a mean loss of at "
        f"most {NO_WORSE:g}. Training on such scenes is recommended only if both hold."
    )
    return {
        "Slip or the arm": Table(rows, "Recall; - where a scene has no bins of a class."),
        "What training on such scenes gains": Table(
            [{"points": name, "gain": gain} for name, gain in gained.items()], note
        ),
    }


def _parameters(calibrated: Mapping[str, Any]) -> Table:
    values = {name: np.atleast_1d(value) for name, value in calibrated["values"].items()}
    rows = [
        {"parameter": name, "frozen value": " to ".join(f"{of:g}" for of in value)}
        for name, value in values.items()
    ]
    note = (
        "Set once, by a command of version 0.1.0, from the test accuracy on simulated seen "
        "materials and the signal checks alone."
    )
    if "target" in calibrated:
        target = calibrated["target"]
        note += (
            f" Target: {100 * target['accuracy']:.2f} % ({target['row']}). Reached: "
            f"{100 * calibrated['accuracy']:.2f} %, mean over other seeds. This is "
            f"{_outcome(calibrated)}."
        )
    return Table(rows, note)


def _outcome(calibrated: Mapping[str, Any]) -> str:
    """How far from its target the calibration of 0.1.0 ended."""
    gap = 100 * (calibrated["accuracy"] - calibrated["target"]["accuracy"])
    is_at_limit = calibrated["difficulty"] in calibrated["protocol"]["bounds"]
    why = ", at the limit of the priors (two standard deviations)" if is_at_limit else ""
    return f"{gap:+.2f} points from the target{why}"


def _short_table(runs: Runs) -> Table:
    """The summary."""
    rows, scores = [], Scores(runs)

    def row(what: str, cells: Mapping[str, str], pooled: str) -> None:
        titled = {f"{words} %": cells[of] for of, words in SCORES.items()}
        rows.append(
            {"experiment": what} | titled | {"best pooled number, balanced accuracy %": pooled}
        )

    shown = [(name, role) for name, roles in SHORT.items() if name in runs for role in roles]
    for name, role in shown:
        cells = {of: mean_sd(scores.of(name, role, of).values()) for of in SCORES}
        pooled = mean_sd(scores.of(name, role, baseline=POOLED).values())
        row(f"`{name}`, {ROLES[role]}, simulated, {_seeds(len(runs[name]))}", cells, pooled)
        if (name, role) in COMPARED:
            paper = {of: percent(getattr(published.SPLITS[role], of)) for of in SCORES}
            row(f"paper, real hand, {ROLES[role]}", paper, "")
    return Table(rows)


if __name__ == "__main__":
    raise SystemExit(Reproduction().run())
