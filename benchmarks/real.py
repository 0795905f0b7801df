"""Real recordings, ours and baselines: ``python -m benchmarks.real FOLDER``.

Takes every set of ``benchmarks.real_sets`` in the folder. Each group is left out in turn, and all
that is fitted or chosen is so on the others. Writes docs/real_data.md.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, ClassVar

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from benchmarks import ROOT
from benchmarks.deployment import host
from benchmarks.harness import Benchmark, Job, put_between, say
from benchmarks.peers import others
from benchmarks.real_sets import RealSet, read_set
from benchmarks.tables import Report, Table, mean_sd, times
from benchmarks.timing import interleaved, on_threads
from benchmarks.trainings import resumed
from tactslip_torch import SlipClassifier
from tactslip_torch.onset.events import Bootstrap
from tactslip_torch.report import style

Array = NDArray[Any]
OURS, CONSTANT = "SlipClassifier", "larger class"
SEEDED = ("random forest", "MiniRocket and ridge")
DRAWN = {"recordings": "recordings", "within": "recordings of each group"}
FLOOR = 1e-3
"""Added to a statistic before its logarithm is taken, in medians of training windows."""

Scorer = Callable[[Array], Array]
"""Scores of windows ``[N, C, T]``: of two classes ``[N]``, at least 0 for the second; of more
``[N, K]``, the highest for the class."""
Fit = Callable[[RealSet, Array, int], Scorer]
"""To training windows, the class of each, ``[N]``, from 0, and a seed."""


@dataclass(frozen=True)
class Real(Benchmark):
    """Every method on every set, each group left out of everything.

    Args:
        groups: of a set at most; ``None`` for all.
        every: one of so many windows is taken, drawn at random.
        seeds: of the methods that draw at random.
        inner: parts that the training groups are put into to choose, at most.
        penalties: C of logistic regression to choose from, strongest first.
        trees: of the forest; a tenth of them when its leaves are chosen.
        leaves: windows in a leaf at least, to choose from.
        kernels: of MiniRocket.
        draws: of the bootstrap.
        rounds: of the clock.
    """

    title = "Real recordings, objects left out (development data)"
    about = (
        "slip or not, and directions of slip, in real windows, each object left out in turn; the "
        "windows of BioTac SP and `osu` are development data of the default recipe"
    )
    page, is_page, is_simulated = "docs/real_data.md", True, False
    libraries = ("aeon", "onnxruntime")
    quick = (
        "groups=3 every=2 seeds=[0,1] inner=2 penalties=[0.1,1.0] trees=10 leaves=[4,1] kernels=84 "
        "draws=50 rounds=2"
    )
    charts: ClassVar = {"": ()}
    groups: int | None = None
    every: int = 1
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    inner: int = 5
    penalties: tuple[float, ...] = (0.0001, 0.001, 0.01, 0.1, 1.0, 10.0)
    trees: int = 500
    leaves: tuple[int, ...] = (32, 16, 4, 1)
    kernels: int = 10_000
    draws: int = 4000
    rounds: int = 40

    def measure(self, job: Job) -> dict[str, Any]:
        """Scores, times and intervals of every set in the folder that is given."""
        folders = [Path(text) for text in job.overrides if "=" not in text]
        paths = sorted(path for folder in folders for path in folder.glob("*.npz"))
        if not paths:
            raise ValueError("give a folder of sets: python -m benchmarks.real FOLDER")
        found = {}
        with on_threads(1):
            for path in paths:
                made_by = [hashlib.sha256(path.read_bytes()).hexdigest(), repr(self)]
                make = partial(_measured, read_set(path), path.stem, self)
                found[path.stem] = resumed(job.folder / f"{path.stem}.json", made_by, make)
        return {"sets": found}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All tables, by the heading that they stand under."""
        sets = numbers["sets"]
        return {
            "Sets": Table([{"set": name} | of["about"] for name, of in sets.items()]),
            "Scores": _scores(sets),
            "Cost": _costs(sets),
        }

    def publish_more(self, report: Report) -> None:
        """README's table: ours beside the best of the other methods."""
        rows = []
        for name, of in report["numbers"]["sets"].items():
            methods = dict(of["methods"])
            ours = methods.pop(OURS)
            best = max(methods, key=lambda method: mean(methods[method]["balanced_accuracy"]))
            other = methods[best]
            rows.append(
                {
                    "set": name,
                    "`SlipClassifier`, balanced accuracy % [95 %]": style.interval(
                        ours["interval"], 1, scale=100
                    ),
                    "best baseline": best,
                    "its balanced accuracy %": style.interval(other["interval"], 1, scale=100),
                    "ours ahead by, points": style.interval(
                        other["lead"]["recordings"], 1, scale=100
                    ),
                }
            )
        text = f"**Real** (`python -m benchmarks.real FOLDER`, code {report['code']}):\n\n"
        put_between(ROOT / "README.md", "real sets", text + Table(rows).markdown())

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Balanced accuracy of every method with its interval, a panel for each set."""
        sets = numbers["sets"]
        drawing.set_size_inches(9.2, 0.8 + 1.9 * len(sets))
        panels = drawing.subplots(len(sets), squeeze=False)[:, 0]
        for axes, (name, of) in zip(panels, sets.items(), strict=True):
            shown = [method for method in of["methods"] if method != CONSTANT]  # 50 % by definition
            for lane, method in enumerate(shown):
                found = of["methods"][method]["interval"]
                value, low, high = (100 * found[end] for end in ("value", "low", "high"))
                color = style.BLUE if method == OURS else style.GREY
                look: Any = {"fmt": "o", "color": color, "capsize": 3}
                axes.errorbar(value, lane, xerr=[[value - low], [high - value]], **look)
            style.lanes(axes, shown)
            axes.set_title(name)
        axes.set_xlabel("balanced accuracy, %, with 95 % interval over recordings")


# ------------------------------------------------------------------------------------- methods
class SimpleStatistics(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Mean, std, rms, range and mean size of differences of each channel, ``[N, C, T] -> [N, F]``.

    Args:
        with_logs: whether the logarithms of the last four are added.
    """

    def __init__(self, with_logs: bool = False) -> None:
        self.with_logs = with_logs

    def fit(self, X: Array, y: Any = None) -> SimpleStatistics:
        """Learn the floors of the logarithms."""
        self.floor_ = FLOOR * np.median(self._statistics(X)[:, 1:], axis=0) + 1e-12
        return self

    def transform(self, X: Array) -> Array:
        """The statistics of windows."""
        found = self._statistics(X)
        columns = [found, np.log(found[:, 1:] + self.floor_)] if self.with_logs else [found]
        return np.concatenate([part.reshape(len(X), -1) for part in columns], 1)

    @staticmethod
    def _statistics(windows: Array) -> Array:
        x = windows.astype(np.float64)
        rms, steps = np.sqrt(np.square(x).mean(-1)), np.abs(np.diff(x, axis=-1)).mean(-1)
        return np.stack([x.mean(-1), x.std(-1), rms, np.ptp(x, axis=-1), steps], 1)


def methods_of(sizes: Real, num_classes: int = 2) -> dict[str, Fit]:
    """All methods by name, ours first; of more than two classes without MiniRocket."""
    rocket = {SEEDED[1]: partial(_rocket, sizes)} if num_classes == 2 else {}
    return {
        OURS: _ours,
        "logistic regression": partial(_regression, sizes, False),
        "logistic regression, logs": partial(_regression, sizes, True),
        SEEDED[0]: partial(_forest, sizes),
        **rocket,
        CONSTANT: _constant,
    }


def classifier(train: RealSet, known: Array) -> SlipClassifier:
    """Ours with its defaults."""
    made = SlipClassifier(sample_rate_hz=float(train.sample_rate_hz), hand=train.layout)
    return made.fit(train.X, known, groups=train.group)


def _ours(train: RealSet, known: Array, seed: int) -> Scorer:
    model = classifier(train, known)
    if known.max() > 1:
        return model.decision_function
    return lambda x: np.where(model.predict_valid(x), model.decision_function(x), -1e-9)


def _regression(sizes: Real, logs: bool, train: RealSet, known: Array, seed: int) -> Scorer:
    solver = "newton-cholesky" if known.max() == 1 else "lbfgs"  # of more classes the faster one
    made = LogisticRegression(class_weight="balanced", solver=solver, max_iter=1000)
    whole = make_pipeline(SimpleStatistics(logs), StandardScaler(), made)
    whole.set_params(**_chosen(whole, {"C": sizes.penalties}, train, known, sizes))
    return whole.fit(train.X, known).decision_function  # type: ignore[no-any-return]


def _forest(sizes: Real, train: RealSet, known: Array, seed: int) -> Scorer:
    few = max(1, sizes.trees // 10)
    made = RandomForestClassifier(few, class_weight="balanced", random_state=seed)
    whole = make_pipeline(SimpleStatistics(), made)
    grid = {"min_samples_leaf": sizes.leaves}
    whole.set_params(**_chosen(whole, grid, train, known, sizes))
    made.set_params(n_estimators=sizes.trees)
    whole.fit(train.X, known)
    if known.max() > 1:
        return whole.predict_proba  # type: ignore[no-any-return]
    return lambda x: whole.predict_proba(x)[:, 1] - 0.5


def _chosen(
    whole: Pipeline, grid: Mapping[str, Any], train: RealSet, known: Array, sizes: Real
) -> dict[str, Any]:
    """Of values of its last step those that are best on training groups left out."""
    last = {f"{whole.steps[-1][0]}__{name}": values for name, values in grid.items()}
    folds = GroupKFold(min(sizes.inner, len(np.unique(train.group))))
    search = GridSearchCV(whole, last, scoring="balanced_accuracy", cv=folds, refit=False)
    found: dict[str, Any] = search.fit(train.X, known, groups=train.group).best_params_
    return found


def _rocket(sizes: Real, train: RealSet, known: Array, seed: int) -> Scorer:
    options = {"seed": seed, "num_kernels": sizes.kernels}
    return others.fit(train.X, known == 1, train.group, **options)


def _constant(train: RealSet, known: Array, seed: int) -> Scorer:
    counts = np.bincount(known)
    if len(counts) > 2:
        return lambda x: np.tile(counts == counts.max(), (len(x), 1)).astype(float)
    return lambda x: np.full(len(x), 1.0 if counts[1] >= counts[0] else -1.0)


# ------------------------------------------------------------------------------------- a set
def left_out_scores(of: RealSet, fit: Fit, seed: int) -> tuple[Array, list[float]]:
    """Scores of all windows by the fits that left their group out, and CPU seconds of each fold.

    Shape:
        - scores: ``[N, M]``, M the number of classes, or 1 of two
    """
    names, index = of.classes()
    num_columns = 1 if len(names) == 2 else len(names)
    scores, cpu_s = np.full((len(index), num_columns), np.nan), []
    for group in np.unique(of.group):
        held = of.group == group
        started = process_time()
        score = fit(of.part(~held), index[~held], seed)
        cpu_s.append(process_time() - started)
        scores[held] = score(of.X[held]).reshape(-1, num_columns)
    return scores, cpu_s


def confusions(of: RealSet, scores: Array) -> Tensor:
    """Windows by recording, true and decided class, ``[N, M] -> [R, K, K]``."""
    names, index = of.classes()
    trial, group = of.trials()
    counts = np.zeros((len(group), len(names), len(names)))
    np.add.at(counts, (trial, index, _decided(scores)), 1)
    return torch.from_numpy(counts)


def recording_confusions(of: RealSet, scores: Array) -> Tensor | None:
    """The same of whole recordings, decided by the mean of their windows' scores.

    ``None`` where a recording has windows of several classes.
    """
    names, index = of.classes()
    trial, group = of.trials()
    truth = np.zeros(len(group), dtype=int)
    truth[trial] = index
    if (truth[trial] != index).any():
        return None
    sums = np.zeros((len(group), scores.shape[1]))
    np.add.at(sums, trial, scores)
    counts = np.zeros((len(group), len(names), len(names)))
    counts[np.arange(len(group)), truth, _decided(sums)] = 1
    return torch.from_numpy(counts)


def _decided(scores: Array) -> Array:
    """The class of scores ``[N, M]``, ``[N]``."""
    found: Array = scores[:, 0] >= 0 if scores.shape[1] == 1 else scores.argmax(1)
    return found.astype(int)


def balanced_accuracy(counts: Tensor) -> Tensor:
    """The mean over seeds and classes of those decided right, ``[n, S, K, K] -> [n]``."""
    return (counts.diagonal(dim1=-2, dim2=-1) / counts.sum(-1)).mean((-1, -2))


def _measured(of: RealSet, name: str, sizes: Real) -> dict[str, Any]:
    """Scores of every method, differences from ours with intervals, and costs; JSON-able."""
    chosen = np.flatnonzero(np.isin(of.group, np.unique(of.group)[: sizes.groups]))
    of = of.part(np.sort(np.random.default_rng(0).permutation(chosen)[:: sizes.every]))
    of.check()
    truth, counts, whole_recordings = of.classes()[1], dict[str, Tensor](), dict[str, Tensor]()
    rows: dict[str, dict[str, Any]] = {}
    num_classes = len(of.classes()[0])
    for method, fit in methods_of(sizes, num_classes).items():
        seeds = sizes.seeds if method in SEEDED else sizes.seeds[:1]
        runs = [left_out_scores(of, fit, seed) for seed in seeds]
        counts[method] = torch.stack([confusions(of, scores) for scores, _ in runs], 1)
        each = balanced_accuracy(counts[method].sum(0)[:, None]).tolist()
        say(f"{name}, {method}: {style.percent(mean(each))} %")
        rows[method] = {
            "balanced_accuracy": each,
            "auc": [
                float(roc_auc_score(truth, scores[:, 0]))
                for scores, _ in runs
                if scores.shape[1] == 1
            ],
            "cpu_s": [seconds for _, folds in runs for seconds in folds],
            "recordings": None,
        }
        wholes = [recording_confusions(of, scores) for scores, _ in runs]
        if known := [whole for whole in wholes if whole is not None]:
            whole_recordings[method] = torch.stack(known, 1)
    groups = torch.from_numpy(of.trials()[1])
    draws = {
        "recordings": Bootstrap(len(groups), num=sizes.draws),
        "within": Bootstrap(len(groups), num=sizes.draws, groups=groups),
    }
    for method, found in whole_recordings.items():
        rows[method]["recordings"] = draws["recordings"].statistic(balanced_accuracy, found)
    ours = counts[OURS]

    def lead(both: Tensor) -> Tensor:
        own, other = both[:, : ours.shape[1]], both[:, ours.shape[1] :]
        return balanced_accuracy(own) - balanced_accuracy(other)

    for method, found in counts.items():
        rows[method]["interval"] = draws["recordings"].statistic(balanced_accuracy, found)
        both = torch.cat([ours, found], 1)
        rows[method]["lead"] = {n: drawn.statistic(lead, both) for n, drawn in draws.items()}
    measured = cost(of, sizes.rounds) if num_classes == 2 else None
    return {"about": _about(of), "methods": rows, "cost": measured}


def _about(of: RealSet) -> dict[str, object]:
    names, index = of.classes()
    fractions = np.bincount(index) / len(index)
    classes = [
        f"{name} {style.percent(part, 1)} %" for name, part in zip(names, fractions, strict=True)
    ]
    return {
        "recordings": len(of.trials()[1]),
        "windows": len(of.y),
        "classes (True: slip)": ", ".join(classes),
        "groups": len(np.unique(of.group)),
        "channels": of.X.shape[1],
        "samples": of.X.shape[2],
        "Hz": f"{float(of.sample_rate_hz):g}",
        "source and licence": str(of.source),
    }


def cost(of: RealSet, rounds: int) -> dict[str, Any]:
    """Times of one raw window to its score, and sizes of files, of a fit without the last group."""
    index = of.classes()[1]
    train = of.group != of.group[-1]
    model = classifier(of.part(train), index[train])
    window = of.X[~train][:1]
    with TemporaryDirectory(prefix="tactslip-bench-") as folder, torch.inference_mode():
        model.save(Path(folder) / "detector.pt")
        (graph, *_) = model.export_onnx(folder)
        session, metadata = host("files").load_model(graph, "bin")
        x = window.astype(metadata["precision"])
        calls: dict[str, Callable[[], Any]] = {
            "native": partial(model.detector_.score_raw, torch.from_numpy(window)),
            "onnxruntime": partial(session.run, ["score", "valid"], {"samples": x}),
        }
        timings = interleaved(calls, rounds, block_s=0.02)
        return {
            "window_s": {name: timing["seconds"] for name, timing in timings.items()},
            "detector_bytes": (Path(folder) / "detector.pt").stat().st_size,
            "onnx_bytes": graph.stat().st_size,
        }


# ------------------------------------------------------------------------------------- tables
def _scores(sets: Mapping[str, Any]) -> Table:
    rows = []
    for name, method in ((n, m) for n, of in sets.items() for m in of["methods"]):
        found = sets[name]["methods"][method]
        row = {"set": name, "method": method}
        row["balanced accuracy %"] = mean_sd(times(found["balanced_accuracy"], 100))
        row["AUC %"] = mean_sd(times(found["auc"], 100))
        whole = found["recordings"]
        row["whole recordings, balanced accuracy %"] = (
            "-" if whole is None else style.interval(whole, 2, scale=100)
        )
        leads = found["lead"]
        for drawn, words in DRAWN.items():
            row[f"ours ahead by, points; 95 % over {words}"] = (
                "-" if method == OURS else style.interval(leads[drawn], 2, scale=100)
            )
        row["ours is"] = "-" if method == OURS else word(leads)
        rows.append(row)
    note = (
        "Mean and standard deviation over seeds where a method draws at random. *Whole "
        "recordings* are decided by the mean of their windows' scores; - where a recording has "
        "windows of several classes. Intervals are by a paired bootstrap: recordings are drawn "
        "with all their windows, the same for both methods, once from all and once within each "
        "left-out group. *ahead* or *behind*: neither interval includes 0. The bootstrap does not "
        "fit again: variation between training recordings and between objects is not in the "
        "intervals."
    )
    return Table(rows, note)


def word(leads: Mapping[str, Mapping[str, float | None]]) -> str:
    """``ahead`` or ``behind`` where no interval includes 0."""
    lows, highs = ([one[end] for one in leads.values()] for end in ("low", "high"))
    if all(low is not None and low > 0 for low in lows):
        return "ahead"
    if all(high is not None and high < 0 for high in highs):
        return "behind"
    return "interval includes 0"


def _costs(sets: Mapping[str, Any]) -> Table:
    rows = []
    for name, of in sets.items():
        found = of["cost"]
        row: dict[str, object] = {"set": name}
        for method in (OURS, SEEDED[1]):
            timed = of["methods"].get(method)
            row[f"{method}: fit of a fold, CPU s"] = None if timed is None else mean(timed["cpu_s"])
        for way in ("native", "onnxruntime"):
            seconds = None if found is None else times(found["window_s"][way], 1e6)
            row[f"one raw window, {way}, us"] = seconds
        row["detector.pt, MB"] = None if found is None else found["detector_bytes"] / 1e6
        row["model.onnx, MB"] = None if found is None else found["onnx_bytes"] / 1e6
        rows.append(row)
    note = (
        "On one thread. A fit includes the choice of its parameters. Limits on `biotacsp`: 15 CPU "
        "s for a fold, 300 us for a window (1,200 us in onnxruntime), 8 MB for a file. With more "
        "than two classes there is no detector to export."
    )
    return Table(rows, note)


if __name__ == "__main__":
    raise SystemExit(Real().run())
