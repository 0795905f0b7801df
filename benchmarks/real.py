"""Real recordings, ours and baselines: ``python -m benchmarks.real data.root=FOLDER``.

On the BioTac SP set (``+exp=biotacsp_dos``), each object left out in turn. In one run, on the same
windows and folds: the machine of three recipes, logistic regression on the features of the first,
logistic regression and a random forest on simple statistics, and MiniRocket and MultiRocketHydra
with ridge. All that is fitted or chosen is so inside the fold. Writes docs/real_data.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from itertools import groupby, islice, product, starmap
from pathlib import Path
from statistics import median
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import balanced_accuracy_score, roc_auc_score, roc_curve
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from benchmarks.harness import Benchmark, Job
from benchmarks.peers import others
from benchmarks.subjects import composed
from benchmarks.tables import Report, Table, chart, limits, lines, listed, number, percent
from benchmarks.timing import interleaved, on_threads, paired_ratio, timed
from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.commands.detect import detect
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.runtime import bar
from tactslip_torch.training.alarm import DebouncedAlarm
from tactslip_torch.training.bins import RecordingBins
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_maker
from tactslip_torch.training.recipe import Recipe

Array = NDArray[Any]
RECIPES = ("general", "paper")
"""Of ours; the first is the one that limits are for."""
SCENES = {
    "n": "north",
    "s": "south",
    "e": "east",
    "w": "west",
    "cw": "clockwise",
    "aw": "anticlockwise",
    "t": "stable touch",
}
"""What the set's folders mean."""
_AIMS, _TIMES_FASTER = {"balanced_accuracy": 0.952, "auc": 0.99}, 10.0
COVERAGE = 0.95
HOP_MS = 40.0
_AT_ONCE = 64
_CORNER = 0.3


@dataclass(frozen=True)
class Real(Benchmark):
    """Every method on every object, left out of everything.

    Args:
        objects: how many at most; ``None`` for all.
        each: recordings of each object and scene at most; ``None`` for all.
        inner: groups that the training objects of a fold make to choose from, at most.
        rocket_seeds: of the kernels of MiniRocket; MultiRocketHydra, which is slow, has the first.
        rocket_kernels: of MiniRocket.
        multi_rocket_kernels: of MultiRocket; it makes eight features of each.
        hydra_groups: of Hydra's kernels, eight each, for every dilation.
        trees: of a forest.
        leaves: windows in a leaf of a tree at least, to choose from.
        regression_penalties: C of logistic regression, to choose from.
        draws: of the bootstrap.
        rounds: of the clock.
        batch: windows that are scored at once.
    """

    title = "Real recordings: slip against stable touch on a BioTac SP"
    about = "slip against stable touch on a real BioTac SP, each object left out in turn"
    page, is_page, is_simulated = "docs/real_data.md", True, False
    libraries = ("aeon",)
    quick = (
        "objects=3 each=1 inner=2 rocket_seeds=[0,1] rocket_kernels=168 multi_rocket_kernels=84 "
        "hydra_groups=4 trees=5 leaves=[1] regression_penalties=[0.1,1.0] draws=50 rounds=2 batch=8"
    )
    drawn: ClassVar = {"*.png": "_watched"}
    charts: ClassVar = {"": ()}
    objects: int | None = None
    each: int | None = None
    inner: int = 5
    rocket_seeds: tuple[int, ...] = (0, 1, 2)
    rocket_kernels: int = 10_000
    multi_rocket_kernels: int = 6_250
    hydra_groups: int = 64
    trees: int = 100
    leaves: tuple[int, ...] = (1, 4)
    regression_penalties: tuple[float, ...] = (0.001, 0.01, 0.1, 1.0, 10.0)
    draws: int = 2000
    rounds: int = 11
    batch: int = 128

    def measure(self, job: Job) -> dict[str, Any]:
        """Scores, times, and what follows from them."""
        configs = [
            composed("train", ["+exp=biotacsp_dos", *job.overrides, f"recipe={name}"])
            for name in RECIPES
        ]
        recipes = [instantiate(config.recipe, _convert_="all") for config in configs]
        with on_threads(1):
            windows, folds = read_windows(configs[0], self)
            found = on_folds(windows, folds, methods_of(windows, recipes, self))
            ours = next(iter(found))
            names = [name for name in found if "Rocket" in name]
            times = times_of(windows, found, names[0], self)
            detectors = [of.detector for of in found[ours].fitted]
            streams = as_streams(windows, folds, detectors, configs[0], job.folder)
        methods = {
            name: evaluated(of, windows) | {"time": times.get(name)} for name, of in found.items()
        }
        return {
            "data": {
                "recordings": len(windows.recordings),
                "windows": {"slip": int(windows.is_slip.sum()), "all": len(windows.is_slip)},
                "objects": sorted(set(windows.objects.tolist())),
                "channels": windows.samples.shape[1],
                "samples": windows.samples.shape[2],
                "pool": windows.pool.shape[1],
            },
            "settings": asdict(self),
            "ours": ours,
            "rockets": names,
            "methods": methods,
            "differences": differences(found, ours, windows, self.draws),
            "streams": streams,
            "folder": str(job.folder),
        }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All tables, by the heading that they stand under."""
        return {
            "The recordings": _data(numbers),
            "Limits": _limits(numbers),
            "Scores": _scores(numbers),
            "Each object, left out of everything": _groups(numbers, "objects"),
            "Each direction of slip": _groups(numbers, "scenes"),
            "As streams": _streams(numbers),
            "How sure the differences are": _differences(numbers),
            "Time": _times(numbers),
            "What the folds chose": _choices(numbers),
        }

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Balanced accuracy by object, and the corner of the ROC curves that matters."""
        drawing.set_size_inches(9.2, 9.0)
        dots, curves = drawing.subplots(2, 1)
        chart(dots, *_groups(numbers, "objects").columns(""), "balanced accuracy by object, %")
        shown = {n: of["curve"] for n, of in numbers["methods"].items() if of["time"] is not None}
        rates = {name: (of["false_alarms"], of["found"]) for name, of in shown.items()}
        lines(curves, rates, "stable touch called slip", "slip detected")
        curves.set(xlim=(0, _CORNER), ylim=(1 - _CORNER, 1.0))


# ------------------------------------------------------------------------------------- windows
@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of all recordings, in the order of the recordings and of time.

    Attributes:
        maker: what reads, cuts and describes them.
        recordings: whose windows there are.

    Shape:
        - samples: ``[N, C, n]``, float64, tared and filtered as the configuration says
        - is_slip: ``[N]``, bool
        - recording: ``[N]``, place in ``recordings``
        - pool: ``[N, F]``, float32, all features of every window; no label is looked at
    """

    maker: FeatureMaker
    recordings: tuple[RecordingId, ...]
    samples: Array
    is_slip: Array
    recording: Array
    pool: Array
    pool_s: float

    @cached_property
    def objects(self) -> Array:
        """What each window was touched with, ``[N]``, text."""
        return np.array([recording.material for recording in self.recordings])[self.recording]

    @cached_property
    def scenes(self) -> Array:
        """How it slid, or that it did not, ``[N]``, text."""
        return np.array([recording.scene for recording in self.recordings])[self.recording]

    def of(self, recordings: Sequence[RecordingId]) -> Array:
        """Which windows are of these recordings, ``[N]``, bool."""
        wanted = set(recordings)
        return np.array([each in wanted for each in self.recordings])[self.recording]

    def by_recording(self, mask: Array) -> Iterable[tuple[RecordingId, torch.Tensor, torch.Tensor]]:
        """Features and labels of the windows in ``mask``, one recording after the other."""
        for place in np.unique(self.recording[mask]).tolist():
            own = mask & (self.recording == place)
            features, labels = torch.from_numpy(self.pool[own]), torch.from_numpy(self.is_slip[own])
            yield self.recordings[place], features, labels


def read_windows(config: DictConfig, sizes: Real) -> tuple[Windows, list[Split]]:
    """All windows and the folds of ``train``.

    Raises:
        ValueError: as source, label rule and split do, or if recordings are simulated, a class is
            absent, or a window is not left out by exactly one fold.
    """
    source: RecordingSource = instantiate(config.data, _convert_="all")
    if source.is_simulated:
        raise ValueError("recordings of data.root are marked as simulated; give real ones")
    maker = feature_maker(source, instantiate(config.labels), **config.features)
    recordings = _some_of(source.ids, sizes)
    folds: list[Split] = instantiate(config.split, _convert_="all")(recordings)
    cut = [maker.filtered_bins(each) for each in bar(recordings, "read and cut", "recording")]
    bins = torch.cat([own.double() for own, _ in cut])
    is_slip = torch.cat([laid.is_slip for _, laid in cut]).numpy().astype(bool)
    where = np.repeat(np.arange(len(cut)), [len(own) for own, _ in cut])
    if is_slip.all() or not is_slip.any():
        which = "no window of stable touch" if is_slip.all() else "no window of slip"
        raise ValueError(f"the {len(is_slip)} windows of data.root hold {which}; give both")
    maker.extractor(bins[:_AT_ONCE])  # compiles
    with torch.no_grad():
        seconds, rows = timed(
            lambda: torch.cat([maker.extractor(part).float() for part in bins.split(_AT_ONCE)])
        )
    pool_s = seconds / len(bins)
    windows = Windows(maker, tuple(recordings), bins.numpy(), is_slip, where, rows.numpy(), pool_s)
    if (np.sum([windows.of(fold.having("unseen")) for fold in folds], axis=0) != 1).any():
        raise ValueError("expected each window left out by one fold; use leave_one_material_out")
    return windows, folds


def _some_of(recordings: Sequence[RecordingId], sizes: Real) -> list[RecordingId]:
    """So many objects at most, and so many recordings of each and scene; sorted."""
    materials = sorted({recording.material for recording in recordings})[: sizes.objects]
    own = sorted((r.material, r.scene, r) for r in recordings if r.material in materials)
    groups = groupby(own, key=lambda of: of[:2])
    return sorted(r for _, group in groups for *_, r in islice(group, sizes.each))


# ------------------------------------------------------------------------------------- methods
class Fitted(NamedTuple):
    """What a fit to a fold made.

    Attributes:
        score: of windows ``[n, C, T]``, with all that takes; at least 0 means slip.
        chosen: inside the fold, JSON-able.
        detector: of ours.
    """

    score: Callable[[Array], Array]
    chosen: dict[str, Any]
    detector: SlipDetector | None = None


Fit = Callable[[Array, SlipDetector | None], Fitted]
"""To the training windows of a fold, a mask ``[N]``, and the detector that the first method fitted
to the same."""


def methods_of(
    windows: Windows, recipes: Sequence[Recipe], sizes: Real
) -> dict[str, tuple[Fit, float]]:
    """All methods, ours first, and the seconds that describing a window took beforehand."""
    seconds, simple = timed(lambda: simple_statistics(windows.samples))
    forests = {
        f"leaf {leaf}": RandomForestClassifier(
            sizes.trees, min_samples_leaf=leaf, class_weight="balanced", random_state=0
        )
        for leaf in sizes.leaves
    }
    regressions = _regressions(sizes, {"as they are, ": None, "with logs, ": _with_logs()})
    found: dict[str, tuple[Fit, float]] = {
        f"ours, recipe={recipe.name}": (partial(_ours, windows, recipe), windows.pool_s)
        for recipe in recipes
    }
    same = partial(_same_features, windows, sizes)
    found["our features, logistic regression"] = (same, windows.pool_s)
    for name, grid in (("logistic regression", regressions), ("random forest", forests)):
        best = partial(_best_of, grid, windows, sizes, simple, simple_statistics)
        found[f"simple statistics, {name}"] = (best, seconds / len(simple))
    mini, multi = others.MINI_ROCKET, others.MULTI_ROCKET_HYDRA
    kinds = [(mini, seed, sizes.rocket_kernels) for seed in sizes.rocket_seeds]
    for kind in [*kinds, (multi, sizes.rocket_seeds[0], sizes.multi_rocket_kernels)]:
        rocket = partial(_rocket, windows, *kind, sizes.hydra_groups)
        found[f"{kind[0]}, seed {kind[1]}"] = (rocket, 0.0)
    return found


def _ours(windows: Windows, recipe: Recipe, train: Array, _: SlipDetector | None) -> Fitted:
    """The detector that ``train`` makes of these windows."""
    bins = [
        RecordingBins(str(recording), recording.material, features, is_slip)
        for recording, features, is_slip in windows.by_recording(train)
    ]
    fit = recipe.fit(bins, windows.maker.pool, is_nested=False)
    metadata = fit.metadata | {"calibration": fit.calibration}
    detector = fit.detector(windows.maker.pool, windows.maker.channel_filter, metadata)

    @torch.no_grad()
    def score(samples: Array) -> Array:
        return detector.predict(torch.from_numpy(samples)).score.numpy()

    pooled = sum(name.is_pooled for name in detector.selected_names)
    chosen = {"features": len(detector.selected), "pooled": pooled, "degree": fit.kernel.degree}
    return Fitted(score, chosen | {"C": fit.penalty}, detector)


def _same_features(
    windows: Windows, sizes: Real, train: Array, detector: SlipDetector | None
) -> Fitted:
    """Logistic regression on the scaled columns of our detector of the same fold."""
    assert detector is not None  # ours is fitted first
    with torch.no_grad():
        known = torch.from_numpy(windows.pool[:, list(detector.selected)]).double()
        rows = detector.scaled(known).numpy()

    @torch.no_grad()
    def describe(samples: Array) -> Array:
        return detector.scaled(detector.extractor(torch.from_numpy(samples)).double()).numpy()

    grid = _regressions(sizes, {"": None})  # columns are compressed already
    return _best_of(grid, windows, sizes, rows, describe, train, detector)


def _rocket(
    windows: Windows, name: str, seed: int, kernels: int, groups: int, train: Array, _: Any
) -> Fitted:
    """Features by random convolutions, and ridge with a penalty chosen by objects left out."""
    samples, sizes = windows.samples[train].astype(np.float32), {"num_groups": groups}
    objects, is_slip = windows.objects[train], windows.is_slip[train]
    made = others.fit(samples, is_slip, objects, name=name, seed=seed, num_kernels=kernels, **sizes)
    return Fitted(made.score, {"alpha": made.alpha})


def simple_statistics(samples: Array) -> Array:
    """Mean, std, rms, range and mean size of differences: ``[N, C, n] -> [N, 5 C]``."""
    found = [
        samples.mean(-1),
        samples.std(-1),
        np.sqrt(np.square(samples).mean(-1)),
        np.ptp(samples, axis=-1),
        np.abs(np.diff(samples, axis=-1)).mean(-1),
    ]
    return np.concatenate(found, 1)


def _with_logs() -> Any:
    """Adds the signed logs of rows beside them."""
    return FunctionTransformer(
        lambda rows: np.concatenate([rows, np.sign(rows) * np.log1p(np.abs(rows))], 1)
    )


def _regressions(sizes: Real, forms: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"{name}C {penalty:g}": make_pipeline(
            form,
            StandardScaler(),
            LogisticRegression(C=penalty, class_weight="balanced", max_iter=2000),
        )
        for name, form in forms.items()
        for penalty in sizes.regression_penalties
    }


def _best_of(
    grid: Mapping[str, Any],
    windows: Windows,
    sizes: Real,
    rows: Array,
    describe: Callable[[Array], Array],
    train: Array,
    _: SlipDetector | None,
) -> Fitted:
    """The classifier of the grid that is best on training objects left out."""
    objects, choices = windows.objects[train], {"classifier": list(grid.values())}
    folds = GroupKFold(min(sizes.inner, len(set(objects.tolist()))))
    every = Pipeline([("classifier", None)])
    search = GridSearchCV(every, choices, scoring="balanced_accuracy", cv=folds)
    best = search.fit(rows[train], windows.is_slip[train], groups=objects).best_estimator_

    def score(samples: Array) -> Array:
        described = describe(samples)
        if hasattr(best, "decision_function"):
            return np.asarray(best.decision_function(described))
        return np.asarray(best.predict_proba(described)[:, 1] - 0.5)

    return Fitted(score, {"": list(grid)[search.best_index_]})


# ------------------------------------------------------------------------------------- scores
@dataclass(eq=False)
class OnFolds:
    """What the folds of one method gave.

    Attributes:
        scores: ``[N]``, of every window by the fold that left its object out.
        fit_s: seconds of each fold's fit, with describing its training windows.
        fitted: by each fold.
    """

    scores: Array
    fit_s: list[float] = field(default_factory=list)
    fitted: list[Fitted] = field(default_factory=list)


def on_folds(
    windows: Windows, folds: Sequence[Split], methods: Mapping[str, tuple[Fit, float]]
) -> dict[str, OnFolds]:
    """Fit every method to the training windows of every fold, and score the others.

    Raises:
        ValueError: if a score is not finite.
    """
    found = {name: OnFolds(np.full(len(windows.is_slip), np.nan)) for name in methods}
    detector: SlipDetector | None = None
    for fold, name in bar(list(product(folds, methods)), "fits, fold by fold", "fit"):
        held, train = windows.of(fold.having("unseen")), windows.of(fold.having("train"))
        (fit, describe_s), of = methods[name], found[name]
        seconds, fitted = timed(partial(fit, train, detector))
        of.fit_s.append(seconds + describe_s * int(train.sum()))
        of.scores[held] = fitted.score(windows.samples[held])
        if not np.isfinite(of.scores[held]).all():
            raise ValueError(f"{name} gave scores that are not finite")
        of.fitted.append(fitted)
        detector = found[next(iter(methods))].fitted[-1].detector
    return found


def evaluated(of: OnFolds, windows: Windows) -> dict[str, Any]:
    """All that tables say of the scores of a method, JSON-able."""
    is_slip, called = windows.is_slip, of.scores >= 0
    by_object = {
        name: float(balanced_accuracy_score(is_slip[own], called[own]))
        for name in sorted(set(windows.objects.tolist()))
        for own in [windows.objects == name]
    }
    worst = min(by_object, key=by_object.__getitem__)
    quiet, detected, _ = (part.round(6).tolist() for part in roc_curve(is_slip, of.scores))
    return {
        "balanced_accuracy": float(balanced_accuracy_score(is_slip, called)),
        "auc": float(roc_auc_score(is_slip, of.scores)),
        "sensitivity": float(called[is_slip].mean()),
        "specificity": float((~called[~is_slip]).mean()),
        "objects": by_object,
        "objects_mean": float(np.mean(list(by_object.values()))),
        "worst": {"object": worst, "balanced_accuracy": by_object[worst]},
        "scenes": {
            name: float((called == is_slip)[windows.scenes == name].mean())
            for name in sorted(set(windows.scenes.tolist()))
        },
        "curve": {"false_alarms": quiet, "found": detected},
        "fit_s": median(of.fit_s),
        "chosen": [one.chosen for one in of.fitted],
    }


def differences(
    found: Mapping[str, OnFolds], ours: str, windows: Windows, draws: int
) -> dict[str, dict[str, dict[str, float]]]:
    """Ours minus every other method, with a bootstrap interval by recording.

    Recordings are drawn anew within their class, the same for all methods. Scores are held: what
    another draw of training recordings would change is not in it.

    Returns:
        By other method and measure: ``value``, ``low`` and ``high`` of the interval, and the
        ``share`` of draws in which ours is above.
    """
    generator, is_slip = np.random.default_rng(0), windows.is_slip
    names, first = np.unique(windows.recording, return_index=True)
    by_class = [names[is_slip[first] == value] for value in (False, True)]
    values = {name: np.empty((2, draws + 1)) for name in found}
    for draw in bar(range(draws + 1), "bootstrap", "draw"):
        weights: Array = np.ones(len(is_slip))
        if draw:  # the first is the set itself
            taken = np.concatenate([generator.choice(of, len(of)) for of in by_class])
            weights = np.bincount(taken, minlength=names.max() + 1)[windows.recording]
        for name, of in found.items():
            accuracy = balanced_accuracy_score(is_slip, of.scores >= 0, sample_weight=weights)
            auc = roc_auc_score(is_slip, of.scores, sample_weight=weights)
            values[name][:, draw] = accuracy, auc

    def interval(gaps: Array) -> dict[str, float]:
        low, high = np.quantile(gaps[1:], [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2]).tolist()
        share = float((gaps[1:] > 0).mean())
        return {"value": float(gaps[0]), "low": low, "high": high, "share": share}

    measures = ("balanced_accuracy", "auc")
    return {
        name: dict(zip(measures, map(interval, values[ours] - values[name]), strict=True))
        for name in found
        if name != ours
    }


def times_of(
    windows: Windows, found: Mapping[str, OnFolds], beside: str, sizes: Real
) -> dict[str, dict[str, Any]]:
    """From a window to its score on one thread, all methods in turns; JSON-able.

    Of random methods with several seeds the first alone is timed.

    Returns:
        By method: ``batch``, how many windows at once, ``batched_s`` and ``alone_s`` for one
        window, ``batched_times_faster`` and ``alone_times_faster`` than the method ``beside``.
    """
    inputs = {
        "batched": windows.samples[-sizes.batch :].copy(),
        "alone": windows.samples[-1:].copy(),
    }
    names = [name for name in found if "seed" not in name or name.endswith("seed 0")]
    calls = {
        f"{name}, {how}": partial(found[name].fitted[-1].score, inputs[how])
        for name, how in product(names, inputs)
    }
    seconds = {name: of["seconds"] for name, of in interleaved(calls, sizes.rounds).items()}
    rows: dict[str, dict[str, Any]] = {name: {"batch": len(inputs["batched"])} for name in names}
    for (name, row), how in product(rows.items(), inputs):
        own, other = seconds[f"{name}, {how}"], seconds[f"{beside}, {how}"]
        row[f"{how}_s"] = median(own) / len(inputs[how])
        row[f"{how}_times_faster"] = paired_ratio(other, own)._asdict()
    return rows


# ------------------------------------------------------------------------------------- streams
def as_streams(
    windows: Windows,
    folds: Sequence[Split],
    detectors: Sequence[SlipDetector | None],
    config: DictConfig,
    folder: Path,
) -> dict[str, Any]:
    """Which whole recordings raise an alarm; JSON-able.

    Each is watched by the detector of the fold that left its object out, with an alarm that was
    set on nothing (``onset=debounced``). Nobody knows when slip begins in this set, so there are
    no delays. ``folder`` gets what ``detect`` leaves of the first slip.
    """
    source = windows.maker.source
    assert isinstance(source, FileRecordings)
    alarm = DebouncedAlarm(HOP_MS)
    slips = {windows.recordings[place] for place in windows.recording[windows.is_slip]}
    counts = {r.scene: {"recordings": 0, "with_alarm": 0} for r in windows.recordings}
    shown = ""
    for fold, detector in zip(bar(folds, "as streams", "fold"), detectors, strict=True):
        assert detector is not None  # of ours
        alarm(detector)
        for recording in sorted(set(fold.having("unseen")) & set(windows.recordings)):
            samples = source.load(recording).samples.T
            stream = StreamingDetector(detector, dtype=samples.dtype)
            alarms = len(stream.push(samples).alarms) + len(stream.flush().alarms)
            counts[recording.scene]["recordings"] += 1
            counts[recording.scene]["with_alarm"] += alarms > 0
            if not shown and recording in slips:
                shown = source.entry(recording).file
                _through_detect(detector, source.root / shown, config, folder)
    return {"by_scene": counts, "shown": shown, "hop_ms": HOP_MS, "k": alarm.k, "n": alarm.n}


def _through_detect(detector: SlipDetector, file: Path, config: DictConfig, folder: Path) -> None:
    """What ``tactslip detect`` does with that file."""
    folder.mkdir(parents=True, exist_ok=True)
    detector.info |= {"simulated": False, "units": config.data.units}
    detector.save(folder / "detector.pt")
    given = composed("detect", [f"model='{folder / 'detector.pt'}'", f"input='{file}'"])
    OmegaConf.update(given, "reading", config.data.reading, force_add=True)
    detect(given, folder)


# ------------------------------------------------------------------------------------- tables


def _data(numbers: Report) -> Table:
    """What was read, and what the run was set to."""
    data, settings = numbers["data"], numbers["settings"]
    rows = {
        "recordings": data["recordings"],
        "objects": len(data["objects"]),
        "channels": data["channels"],
        "samples in a window": data["samples"],
        "windows": data["windows"]["all"],
        "of them slip": data["windows"]["slip"],
        "features in the pool": data["pool"],
        "groups of objects that choose classifiers on simple statistics": settings["inner"],
        "kernels of MiniRocket": f"{settings['rocket_kernels']:,}",
        "kernels of MultiRocket": f"{settings['multi_rocket_kernels']:,}",
        "groups of Hydra's kernels": settings["hydra_groups"],
        "trees of the forest": settings["trees"],
    }
    return listed("number of", rows)


def _limits(numbers: Report) -> Table:
    """What was wanted of ours, whether it is met, and what is better."""
    methods, rockets = numbers["methods"], numbers["rockets"]
    ours = methods[numbers["ours"]]
    own, key = 100 * ours["balanced_accuracy"], "balanced_accuracy"
    goals = [
        (f"balanced accuracy of {name}", own, 100 * methods[name][key], "%") for name in rockets
    ]
    for measure, words in (("balanced_accuracy", "balanced accuracy"), ("auc", "AUC")):
        goals.append((f"{words}, the aim", 100 * ours[measure], 100 * _AIMS[measure], "%"))
    for how, words in (("batched", "many windows at once"), ("alone", "one window alone")):
        ratio = ours["time"][f"{how}_times_faster"]["median"]
        goals.append((f"times faster than {rockets[0]}: {words}", ratio, _TIMES_FASTER, ""))
    above = [name for name, of in methods.items() if 100 * of[key] > own]
    found = limits(goals, is_least=True)
    met = [row[""] for row in found.rows].count("met")
    note = (
        f"{met} of {len(goals)} limits are met, by {numbers['ours']}. "
        f"Higher in balanced accuracy, of all methods and seeds: {'; '.join(above) or 'none'}."
    )
    return Table(found.rows, note)


def _scores(numbers: Report) -> Table:
    titles = {
        "balanced_accuracy": "balanced accuracy %",
        "auc": "AUC %",
        "sensitivity": "sensitivity %",
        "specificity": "specificity %",
        "objects_mean": "mean over objects %",
    }
    rows = []
    for name, of in numbers["methods"].items():
        worst = f"{of['worst']['object']} {percent(of['worst']['balanced_accuracy'], 1)}"
        scores = {title: percent(of[key]) for key, title in titles.items()}
        rows.append({"method": name} | scores | {"worst object %": worst})
    return Table(rows)


def _groups(numbers: Report, kind: str) -> Table:
    """Balanced accuracy on each object, or the part of windows decided right in each scene."""
    head = "balanced accuracy %" if kind == "objects" else "windows decided right, %"
    return Table(
        [
            {head: method}
            | {SCENES.get(name, name): percent(of, 1) for name, of in row[kind].items()}
            for method, row in numbers["methods"].items()
        ]
    )


def _streams(numbers: Report) -> Table:
    found = numbers["streams"]
    rows = [
        {
            "whole recordings as streams": words,
            "recordings": found["by_scene"][name]["recordings"],
            "with an alarm": found["by_scene"][name]["with_alarm"],
        }
        for name, words in SCENES.items()
        if name in found["by_scene"]
    ]
    note = (
        "Each whole recording through `StreamingDetector`, by the machine of the fold that left "
        f"its object out: a decision every {found['hop_ms']:g} ms, an alarm when {found['k']} of "
        f"{found['n']} decisions say slip (`onset=debounced`). Nothing was set on alarms, and no "
        "rate of false alarms is stated; when slip begins nobody knows, so there are no delays. "
        f"The picture is what `detect` leaves of one of them, `{found['shown']}`.\n\n"
        "![One recording](../benchmarks/results/real_watched.png)"
    )
    return Table(rows, note)


def _differences(numbers: Report) -> Table:
    def words(found: Mapping[str, float]) -> str:
        value, low, high = (100 * found[name] for name in ("value", "low", "high"))
        return f"{value:+.2f} ({low:+.2f} to {high:+.2f})"

    rows, unsettled = [], []
    for name, found in numbers["differences"].items():
        gap = found["balanced_accuracy"]
        row = {f"{numbers['ours']} minus": name, "balanced accuracy, points": words(gap)}
        row["above in"] = f"{percent(gap['share'], 1)} % of draws"
        rows.append(row | {"AUC, points": words(found["auc"])})
        unsettled += [name] if gap["low"] <= 0 <= gap["high"] else []
    note = f"**Nothing is settled beside:** {'; '.join(unsettled)}." if unsettled else ""
    note = (
        "Recordings are drawn anew within slip and within stable touch, "
        f"{numbers['settings']['draws']:,} times with a fixed seed, the same for both methods; "
        f"brackets hold {100 * COVERAGE:g} % of the differences. Where they hold 0, nothing is "
        "settled. Scores are held, so this says nothing of other training recordings or other "
        f"objects. {note}"
    )
    return Table(rows, note)


def _times(numbers: Report) -> Table:
    cells = []
    for name, row in numbers["methods"].items():
        of = row["time"]
        times: dict[str, object] = {"batch": of and of["batch"]}
        for how in ("batched", "alone"):
            faster = f"{number(of[f'{how}_times_faster']['median'])} x" if of else None
            times[f"us a window, {how}"] = 1e6 * of[f"{how}_s"] if of else None
            times[f"faster, {how}"] = faster
        cells.append({"method": name, "fit of a fold, s": row["fit_s"]} | times)
    note = (
        "On one thread, from a window in memory to its score, all methods in turns, medians of "
        f"{numbers['settings']['rounds']} rounds. For one window alone the calls themselves weigh "
        "most. A fit counts the description of its training windows. Faster: than "
        f"{numbers['rockets'][0]}, round by round; below 1 is slower."
    )
    return Table(cells, note)


def _choices(numbers: Report) -> Table:
    def words(key: str, value: Any) -> str:
        return f"{key} {value if isinstance(value, str) else format(value, '.3g')}".strip()

    cells = []
    for name, row in numbers["methods"].items():
        counts = Counter(", ".join(starmap(words, of.items())) for of in row["chosen"])
        text = "; ".join(f"{choice} ({times}x)" for choice, times in counts.most_common())
        cells.append({"method": name, "chosen inside the folds": text})
    return Table(cells)


if __name__ == "__main__":
    raise SystemExit(Real().run())
