"""Tables of REPRODUCTION.md and of README.md, from stored runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import mean
from typing import Any

from benchmarks.harness import Table
from benchmarks.reproduction.results import (
    POOLED,
    SCORES,
    Runs,
    by_seed,
    gains,
    labels_of,
    mean_sd,
    percent,
    recall_beside_onset,
    roles_of,
)
from tactslip_torch.hand import HandLayout
from tactslip_torch.report import published
from tactslip_torch.report.results import BASELINES

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
