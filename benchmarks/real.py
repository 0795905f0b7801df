"""Real recordings, ours and baselines: ``python -m benchmarks.real data.root=FOLDER``.

On the BioTac SP set (``+exp=biotacsp_dos``), each object left out in turn. In one run, on the same
windows and folds: the machine of three recipes, logistic regression on the features of the first,
logistic regression and a random forest on simple statistics, and MiniRocket and MultiRocketHydra
with ridge. All that is fitted or chosen is so inside the fold. Writes docs/real_data.md.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from sklearn.base import clone
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import balanced_accuracy_score, roc_auc_score, roc_curve
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from benchmarks.harness import (
    GREY,
    OURS,
    PEER,
    QUICK_LINE,
    SECOND,
    THIRD,
    Benchmark,
    Job,
    Report,
    Table,
    interleaved,
    limits,
    number,
    on_threads,
    paired_ratio,
    percent,
    ran_on,
)
from benchmarks.peers.rockets import MINI_ROCKET, MULTI_ROCKET_HYDRA
from benchmarks.peers.rockets import fit as fit_rocket
from benchmarks.subjects import composed
from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.commands.configuration import unknown_choice
from tactslip_torch.commands.detect import detect
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.report.style import styled
from tactslip_torch.runtime import bar, whole_file
from tactslip_torch.training.alarm import DebouncedAlarm
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_maker
from tactslip_torch.training.plan import TrainingPass, plan_detector
from tactslip_torch.training.recipe import Recipe

Array = NDArray[Any]
EXPERIMENT = "+exp=biotacsp_dos"
RECIPES = ("general", "robust", "paper")
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
AIM_BALANCED, AIM_AUC, TIMES_FASTER = 0.952, 0.99, 10.0
COVERAGE = 0.95
HOP_MS = 40.0
_AT_ONCE = 64
_CORNER = 0.3


@dataclass(frozen=True)
class Sizes:
    """The sizes of a run, and what baselines choose from inside a fold.

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

    @property
    def objects(self) -> Array:
        """What each window was touched with, ``[N]``, text."""
        return np.array([recording.material for recording in self.recordings])[self.recording]

    @property
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


def configuration(overrides: Sequence[str], recipe: str) -> DictConfig:
    """That of ``train`` on this set.

    Raises:
        ValueError: if an override names what does not exist.
    """
    every = [EXPERIMENT, *overrides, f"recipe={recipe}"]
    if problem := unknown_choice(every):
        raise ValueError(problem)
    try:
        return composed("train", every)
    except HydraException as error:
        raise ValueError(str(error)) from None


def read_windows(config: DictConfig, sizes: Sizes) -> tuple[Windows, list[Split]]:
    """All windows and the folds of ``train``.

    Raises:
        ValueError: as source, label rule and split do, or if recordings are simulated, a class is
            absent, or a window is not left out by exactly one fold.
    """
    source: RecordingSource = instantiate(config.data, _convert_="all")
    if source.is_simulated:
        raise ValueError("recordings of data.root say that they are simulated; give real ones")
    rule = instantiate(config.labels)
    maker = feature_maker(source, rule, **config.features)
    recordings = _some_of(source.ids, sizes)
    folds: list[Split] = instantiate(config.split, _convert_="all")(recordings)
    samples, labels, places = [], [], []
    for place, recording in enumerate(bar(recordings, "read and cut", "recording")):
        cut, laid = maker.filtered_bins(recording)
        samples.append(cut.double())
        labels.append(laid.is_slip)
        places.append(np.full(len(laid.is_slip), place))
    bins, is_slip = torch.cat(samples), torch.cat(labels).numpy().astype(bool)
    if is_slip.all() or not is_slip.any():
        which = "no window of stable touch" if is_slip.all() else "no window of slip"
        raise ValueError(f"the {len(is_slip)} windows of data.root hold {which}; give both")
    maker.extractor(bins[:_AT_ONCE])  # compiles
    started = time.perf_counter()
    with torch.no_grad():
        rows = torch.cat([maker.extractor(part).float() for part in bins.split(_AT_ONCE)]).numpy()
    pool_s = (time.perf_counter() - started) / len(bins)
    where = np.concatenate(places)
    windows = Windows(maker, tuple(recordings), bins.numpy(), is_slip, where, rows, pool_s)
    if (np.sum([windows.of(fold.having("unseen")) for fold in folds], axis=0) != 1).any():
        raise ValueError("expected each window left out by one fold; use leave_one_material_out")
    return windows, folds


def _some_of(recordings: Sequence[RecordingId], sizes: Sizes) -> list[RecordingId]:
    """So many objects at most, and so many recordings of each and scene; sorted."""
    materials = sorted({recording.material for recording in recordings})[: sizes.objects]
    kept: dict[tuple[str, str], list[RecordingId]] = {}
    for recording in sorted(recordings):
        if recording.material in materials:
            kept.setdefault((recording.material, recording.scene), []).append(recording)
    return sorted(each for of in kept.values() for each in of[: sizes.each])


# ------------------------------------------------------------------------------------- methods
class Fitted(NamedTuple):
    """What a fit to a fold made.

    Attributes:
        score: of windows by their places ``[n]``; at least 0 means slip.
        score_samples: of windows ``[n, C, T]``, with all that takes; the clock runs on it.
        chosen: inside the fold, JSON-able.
        detector: of ours.
    """

    score: Callable[[Array], Array]
    score_samples: Callable[[Array], Array]
    chosen: dict[str, Any]
    detector: SlipDetector | None = None


Fit = Callable[[Array, SlipDetector | None], Fitted]
"""To the training windows of a fold, a mask ``[N]``, and the detector that the first method fitted
to the same."""


def methods_of(
    windows: Windows, recipes: Sequence[Recipe], sizes: Sizes
) -> dict[str, tuple[Fit, float]]:
    """All methods, ours first, and the seconds that describing a window took beforehand."""
    started = time.perf_counter()
    simple = simple_statistics(windows.samples)
    simple_s = (time.perf_counter() - started) / len(simple)
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

        def fit(train: Array, _: Any, grid: Mapping[str, Any] = grid) -> Fitted:
            return _best_of(grid, windows, sizes, simple, train, simple_statistics)

        found[f"simple statistics, {name}"] = (fit, simple_s)
    rockets = [(MINI_ROCKET, seed, sizes.rocket_kernels) for seed in sizes.rocket_seeds]
    rockets += [(MULTI_ROCKET_HYDRA, sizes.rocket_seeds[0], sizes.multi_rocket_kernels)]
    for name, seed, kernels in rockets:
        rocket = partial(_rocket, windows, sizes, name, seed, kernels)
        found[f"{name}, seed {seed}"] = (rocket, 0.0)
    return found


def _ours(windows: Windows, recipe: Recipe, train: Array, _: SlipDetector | None) -> Fitted:
    """The detector that ``train`` makes of these windows."""
    pool = windows.maker.pool
    statistics = TrainingStatistics(len(pool.names), recipe.sample_bins)
    for recording, features, is_slip in windows.by_recording(train):
        statistics.update(str(recording), recipe.group(recording), features, is_slip)
    plan = plan_detector(recipe, statistics, pool, is_nested=False)
    second = TrainingPass(plan)
    for recording, features, is_slip in windows.by_recording(train):
        second.update(str(recording), features, is_slip)
    kernel = plan.kernel.to_dict()
    info = {"penalty": plan.penalty, "calibration": plan.calibration, "kernel": kernel}
    detector = plan.detector(pool, windows.maker.channel_filter, second.solve(), info)
    selected = list(detector.selected)

    @torch.no_grad()
    def score(places: Array) -> Array:
        rows = torch.from_numpy(windows.pool[places][:, selected]).double()
        return detector.score_features(rows).numpy()

    @torch.no_grad()
    def score_samples(samples: Array) -> Array:
        return detector.predict(torch.from_numpy(samples)).score.numpy()

    names = detector.selected_names
    chosen = {
        "features": len(names),
        "pooled": sum(name.is_pooled for name in names),
        "degree": kernel.get("degree"),
        "C": plan.penalty,
    }
    return Fitted(score, score_samples, chosen, detector)


def _same_features(
    windows: Windows, sizes: Sizes, train: Array, detector: SlipDetector | None
) -> Fitted:
    """Logistic regression on the scaled columns of our detector of the same fold."""
    assert detector is not None  # ours is fitted first
    selected = list(detector.selected)
    with torch.no_grad():
        rows = detector.scaled(torch.from_numpy(windows.pool[:, selected]).double()).numpy()
    grid = _regressions(sizes, {"": None})  # columns are compressed already

    @torch.no_grad()
    def describe(samples: Array) -> Array:
        features = detector.extractor(torch.from_numpy(samples)).double()
        return detector.scaled(features).numpy()

    return _best_of(grid, windows, sizes, rows, train, describe)


def _rocket(
    windows: Windows,
    sizes: Sizes,
    name: str,
    seed: int,
    kernels: int,
    train: Array,
    _: SlipDetector | None,
) -> Fitted:
    """Features by random convolutions, and ridge with a penalty chosen by objects left out."""
    samples = windows.samples.astype(np.float32)
    made = fit_rocket(
        samples[train],
        windows.is_slip[train],
        windows.objects[train],
        name=name,
        seed=seed,
        num_kernels=kernels,
        num_groups=sizes.hydra_groups,
    )
    return Fitted(lambda places: made.score(samples[places]), made.score, {"alpha": made.alpha})


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


def _regressions(sizes: Sizes, forms: Mapping[str, Any]) -> dict[str, Any]:
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
    sizes: Sizes,
    rows: Array,
    train: Array,
    describe: Callable[[Array], Array],
) -> Fitted:
    """The classifier of the grid that is best on training objects left out."""
    objects = windows.objects[train]
    folds = GroupKFold(min(sizes.inner, len(set(objects.tolist()))))
    every = Pipeline([("classifier", None)])
    choices = {"classifier": list(grid.values())}
    search = GridSearchCV(every, choices, scoring="balanced_accuracy", cv=folds, refit=False)
    search.fit(rows[train], windows.is_slip[train], groups=objects)
    name = list(grid)[search.best_index_]
    made = clone(grid[name]).fit(rows[train], windows.is_slip[train])

    def score(rows: Array) -> Array:
        found: Array
        if hasattr(made, "decision_function"):
            found = made.decision_function(rows)
        else:
            found = made.predict_proba(rows)[:, 1] - 0.5
        return found

    return Fitted(
        lambda places: score(rows[places]), lambda samples: score(describe(samples)), {"": name}
    )


# ------------------------------------------------------------------------------------- scores
@dataclass(eq=False)
class OnFolds:
    """What the folds of one method gave.

    Attributes:
        scores: ``[N]``, of every window by the fold that left its object out.
        fit_s: seconds of each fold's fit, with describing its training windows.
        chosen: by each fold.
        last: what the last fold fitted, for the clock.
        detectors: of ours, by fold.
    """

    scores: Array
    fit_s: list[float] = field(default_factory=list)
    chosen: list[dict[str, Any]] = field(default_factory=list)
    last: Fitted | None = None
    detectors: list[SlipDetector | None] = field(default_factory=list)


def on_folds(
    windows: Windows, folds: Sequence[Split], methods: Mapping[str, tuple[Fit, float]]
) -> dict[str, OnFolds]:
    """Fit every method to the training windows of every fold, and score the others.

    Raises:
        ValueError: if a score is not finite.
    """
    found = {name: OnFolds(np.full(len(windows.is_slip), np.nan)) for name in methods}
    first = next(iter(found.values()))
    for fold, name in bar(list(product(folds, methods)), "fits, fold by fold", "fit"):
        held, train = windows.of(fold.having("unseen")), windows.of(fold.having("train"))
        (fit, describe_s), of = methods[name], found[name]
        started = time.perf_counter()
        fitted = fit(train, first.detectors[-1] if first.detectors else None)
        of.fit_s.append(time.perf_counter() - started + describe_s * int(train.sum()))
        of.scores[held] = fitted.score(held.nonzero()[0])
        if not np.isfinite(of.scores[held]).all():
            raise ValueError(f"{name} gave scores that are not finite")
        of.chosen.append(fitted.chosen)
        of.detectors.append(fitted.detector)
        of.last = fitted
    return found


def evaluated(of: OnFolds, windows: Windows) -> dict[str, Any]:
    """All that tables say of the scores of a method, JSON-able."""
    is_slip, says = windows.is_slip, of.scores >= 0
    by_object = {
        name: float(balanced_accuracy_score(is_slip[own], says[own]))
        for name in sorted(set(windows.objects.tolist()))
        for own in [windows.objects == name]
    }
    worst = min(by_object, key=by_object.__getitem__)
    false_alarms, detected, _ = roc_curve(is_slip, of.scores)
    return {
        "balanced_accuracy": float(balanced_accuracy_score(is_slip, says)),
        "auc": float(roc_auc_score(is_slip, of.scores)),
        "sensitivity": float(says[is_slip].mean()),
        "specificity": float((~says[~is_slip]).mean()),
        "objects": by_object,
        "objects_mean": float(np.mean(list(by_object.values()))),
        "worst": {"object": worst, "balanced_accuracy": by_object[worst]},
        "scenes": {
            name: float((says == is_slip)[windows.scenes == name].mean())
            for name in sorted(set(windows.scenes.tolist()))
        },
        "curve": {
            "false_alarms": false_alarms.round(6).tolist(),
            "found": detected.round(6).tolist(),
        },
        "fit_s": median(of.fit_s),
        "chosen": of.chosen,
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
    values: dict[str, list[list[float]]] = {name: [] for name in found}
    for draw in bar(range(draws + 1), "bootstrap", "draw"):
        weights: Array = np.ones(len(is_slip))
        if draw:  # the first is the set itself
            taken = np.concatenate([generator.choice(of, len(of)) for of in by_class])
            weights = np.bincount(taken, minlength=names.max() + 1)[windows.recording]
        for name, of in found.items():
            accuracy = balanced_accuracy_score(is_slip, of.scores >= 0, sample_weight=weights)
            values[name].append(
                [accuracy, roc_auc_score(is_slip, of.scores, sample_weight=weights)]
            )
    tails = [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2]
    gaps: dict[str, dict[str, dict[str, float]]] = {}
    for name in found:
        if name != ours:
            table = np.array(values[ours]) - np.array(values[name])
            gaps[name] = {}
            for measure, column in zip(("balanced_accuracy", "auc"), table.T, strict=True):
                low, high = np.quantile(column[1:], tails).tolist()
                share = float((column[1:] > 0).mean())
                gaps[name][measure] = {"value": column[0], "low": low, "high": high, "share": share}
    return gaps


def timed(
    windows: Windows, found: Mapping[str, OnFolds], beside: str, sizes: Sizes
) -> dict[str, dict[str, Any]]:
    """From a window to its score on one thread, all methods in turns; JSON-able.

    Of random methods with several seeds the first alone is timed.

    Returns:
        By method: ``batch``, how many windows at once, ``batched_s`` and ``alone_s`` for one
        window, ``batched_times_faster`` and ``alone_times_faster`` than the method ``beside``, and
        ``differs``, how far the timed scores are from those that are evaluated.
    """
    count = min(sizes.batch, len(windows.samples))
    places = np.arange(len(windows.samples))[-count:]
    batch = windows.samples[places].copy()
    calls: dict[str, Callable[[], object]] = {}
    rows: dict[str, dict[str, Any]] = {}
    for name, of in found.items():
        if of.last is not None and ("seed" not in name or name.endswith("seed 0")):
            gap = of.last.score_samples(batch) - of.last.score(places)
            rows[name] = {"batch": count, "differs": float(np.abs(gap).max())}
            calls[f"{name}, batched"] = partial(of.last.score_samples, batch)
            calls[f"{name}, alone"] = partial(of.last.score_samples, batch[-1:].copy())
    seconds = {name: of.per_round for name, of in interleaved(calls, sizes.rounds).items()}
    for name, row in rows.items():
        for how, windows_at_once in (("batched", count), ("alone", 1)):
            own, other = seconds[f"{name}, {how}"], seconds[f"{beside}, {how}"]
            row[f"{how}_s"] = median(own) / windows_at_once
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
    counts: dict[str, dict[str, int]] = {}
    shown = ""
    for fold, detector in zip(bar(folds, "as streams", "fold"), detectors, strict=True):
        assert detector is not None  # of ours
        alarm(detector)
        for recording in sorted(set(fold.having("unseen")) & set(windows.recordings)):
            samples = source.load(recording).samples.T
            stream = StreamingDetector(detector, dtype=samples.dtype)
            alarms = len(stream.push(samples).alarms) + len(stream.flush().alarms)
            of = counts.setdefault(recording.scene, {"recordings": 0, "with_alarm": 0})
            of["recordings"] += 1
            of["with_alarm"] += alarms > 0
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
    OmegaConf.update(given, "tare_s", config.data.tare_s, force_add=True)
    detect(given, folder)


# ------------------------------------------------------------------------------------- the page
class Real(Benchmark[Sizes]):
    """Every method on every object, left out of everything."""

    name = "real"
    title = "Real recordings: slip against stable touch on a BioTac SP"
    about = "slip against stable touch on a real BioTac SP, each object left out in turn"
    page = "docs/real_data.md"
    is_simulated = False
    libraries = ("aeon",)
    sizes = Sizes()
    quick = Sizes(
        objects=3,
        each=1,
        inner=2,
        rocket_seeds=(0, 1),
        rocket_kernels=168,
        multi_rocket_kernels=84,
        hydra_groups=4,
        trees=5,
        leaves=(1,),
        regression_penalties=(0.1, 1.0),
        draws=50,
        rounds=2,
        batch=8,
    )

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """Scores, times, and what follows from them."""
        config = configuration(job.overrides, RECIPES[0])
        recipes = [
            instantiate(configuration(job.overrides, name).recipe, _convert_="all")
            for name in RECIPES
        ]
        with on_threads(1):
            windows, folds = read_windows(config, job.sizes)
            found = on_folds(windows, folds, methods_of(windows, recipes, job.sizes))
            ours = next(iter(found))
            rockets = [name for name in found if "Rocket" in name]
            times = timed(windows, found, rockets[0], job.sizes)
            streams = as_streams(windows, folds, found[ours].detectors, config, job.folder)
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
            "settings": asdict(job.sizes),
            "ours": ours,
            "rockets": rockets,
            "methods": methods,
            "differences": differences(found, ours, windows, job.sizes.draws),
            "streams": streams | {"folder": str(job.folder)},
        }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All tables, by the heading that they stand under."""
        objects = {name: name for name in numbers["data"]["objects"]}
        return {
            "The recordings": Table(_data_rows(numbers)),
            "Limits": limits(_limit_rows(numbers)),
            "Scores": Table(_score_rows(numbers)),
            "Each object, left out of everything": _groups_table(numbers, "objects", objects),
            "Each direction of slip": _groups_table(numbers, "scenes", SCENES),
            "As streams": _streams_table(numbers),
            "How sure the differences are": _differences_table(numbers),
            "Time": _times_table(numbers),
            "What the folds chose": _choices_table(numbers),
        }

    def section(self, report: Report) -> str:
        """All that is measured; what the data are and how methods are evaluated the page says."""
        numbers = report["numbers"]
        texts = {
            "Limits": _limits_text(numbers),
            "How sure the differences are": _differences_text(numbers),
            "As streams": _streams_text(numbers),
            "Time": "On one thread, from a window in memory to its score, all methods in turns, "
            f"medians of {numbers['settings']['rounds']} rounds. For one window alone the calls "
            "themselves weigh most. A fit counts the description of its training windows.",
        }
        parts = [f"Measured in one run, {ran_on(report)}."]
        if report["quick"]:
            parts.append(f"**{QUICK_LINE}.**")
        for title, table in self.tables(numbers).items():
            parts += [f"## {title}", *([texts[title]] if title in texts else []), table.markdown()]
            if title == "Scores":
                parts.append("![Objects and ROC curves](../benchmarks/results/real.png)")
            if title == "As streams":
                parts.append("![One recording](../benchmarks/results/real_watched.png)")
        return "\n\n".join(parts)

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Balanced accuracy by object, and the corner of the ROC curves that matters."""
        drawing.set_size_inches(11.0, 5.2)
        rows = numbers["methods"]
        shown = [name for name, row in rows.items() if row["time"] is not None]
        palette = (OURS, SECOND, PEER, "#f0a07a", THIRD, "#cc79a7", "#56b4e9", "#e69f00")
        colors = dict(zip(shown, palette, strict=False))
        dots, curves = drawing.subplots(1, 2, width_ratios=(1.25, 1.0))
        _draw_objects(dots, rows, colors)
        for name in shown:
            row, width = rows[name], 2.0 if name == numbers["ours"] else 1.2
            label = f"{name}: AUC {100 * row['auc']:.1f} %"
            x, y = row["curve"]["false_alarms"], row["curve"]["found"]
            curves.plot(x, y, color=colors[name], lw=width, label=label)
            curves.plot(1 - row["specificity"], row["sensitivity"], "o", color=colors[name], ms=5)
        curves.set_xlim(0, _CORNER)
        curves.set_ylim(1 - _CORNER, 1.0)
        curves.set_xlabel("stable touch called slip")
        curves.set_ylabel("slip detected")
        curves.set_title("ROC curves, their corner; dots: at 0, where it decides")
        drawing.legend(loc="outside lower center", ncols=3)

    @styled
    def figures(self, report: Report, path: Path) -> None:
        """Ours, and what ``detect`` has drawn of one recording."""
        super().figures(report, path)
        drawn = next(Path(report["numbers"]["streams"]["folder"]).glob("*.png"), None)
        if drawn is not None:
            with whole_file(path.with_name("real_watched.png")) as temporary:
                shutil.copy(drawn, temporary)


def _data_rows(numbers: Report) -> list[dict[str, object]]:
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
    return [{"": name, "number": of} for name, of in rows.items()]


def _limit_rows(numbers: Report) -> list[dict[str, Any]]:
    """What was wanted of ours, and by how much it is met or missed."""
    rows = numbers["methods"]
    ours, found = rows[numbers["ours"]], []

    def row(what: str, measured: str, limit: str, ok: bool) -> None:
        found.append({"limits": what, "measured": measured, "limit": limit, "": ok})

    for rocket in numbers["rockets"]:
        other = rows[rocket]["balanced_accuracy"]
        gap = ours["balanced_accuracy"] - other
        measured = f"{percent(ours['balanced_accuracy'])} %, {100 * gap:+.2f} points"
        row(f"balanced accuracy above {rocket}", measured, f"above {percent(other)} %", gap > 0)
    aims = [("balanced accuracy", "balanced_accuracy", AIM_BALANCED), ("AUC", "auc", AIM_AUC)]
    for name, key, aim in aims:
        measured = f"{percent(ours[key])} %, {100 * (ours[key] - aim):+.2f} points"
        row(f"{name}, the aim", measured, f"at least {100 * aim:g} %", ours[key] >= aim)
    for how, words in (("batched", "many windows at once"), ("alone", "one window alone")):
        ratio, what = ours["time"][f"{how}_times_faster"]["median"], numbers["rockets"][0]
        limit = f"at least {TIMES_FASTER:g}"
        row(f"times faster than {what}: {words}", number(ratio), limit, ratio >= TIMES_FASTER)
    return found


def _limits_text(numbers: Report) -> str:
    met = [row[""] for row in _limit_rows(numbers)]
    rows = {name: row["balanced_accuracy"] for name, row in numbers["methods"].items()}
    above = [name for name, value in rows.items() if value > rows[numbers["ours"]]]
    return (
        f"{sum(met)} of {len(met)} limits are met, by {numbers['ours']}. Higher in balanced "
        f"accuracy, of all methods and seeds: {'; '.join(above) or 'none'}."
    )


_SCORES = {
    "balanced_accuracy": "balanced accuracy %",
    "auc": "AUC %",
    "sensitivity": "sensitivity %",
    "specificity": "specificity %",
    "objects_mean": "mean over objects %",
}


def _score_rows(numbers: Report) -> list[dict[str, object]]:
    rows = []
    for name, of in numbers["methods"].items():
        worst = f"{of['worst']['object']} {percent(of['worst']['balanced_accuracy'], 1)}"
        scores = {title: percent(of[key]) for key, title in _SCORES.items()}
        rows.append({"method": name} | scores | {"worst object %": worst})
    return rows


def _groups_table(numbers: Report, kind: str, names: Mapping[str, str]) -> Table:
    """Balanced accuracy on each object, or the part of windows told right in each scene."""
    head = "balanced accuracy %" if kind == "objects" else "windows told right, %"
    return Table(
        [
            {head: method}
            | {names[name]: percent(row[kind][name], 1) for name in names if name in row[kind]}
            for method, row in numbers["methods"].items()
        ]
    )


def _streams_table(numbers: Report) -> Table:
    found = numbers["streams"]["by_scene"]
    return Table(
        [
            {
                "whole recordings as streams": words,
                "recordings": found[name]["recordings"],
                "with an alarm": found[name]["with_alarm"],
            }
            for name, words in SCENES.items()
            if name in found
        ]
    )


def _streams_text(numbers: Report) -> str:
    found = numbers["streams"]
    return (
        "Each whole recording through `StreamingDetector`, by the machine of the fold that left "
        f"its object out: a decision every {found['hop_ms']:g} ms, an alarm when {found['k']} of "
        f"{found['n']} decisions say slip (`onset=debounced`). Nothing was set on alarms, and no "
        "rate of false alarms is stated; when slip begins nobody knows, so there are no delays. "
        f"The picture is what `detect` leaves of one of them, `{found['shown']}`."
    )


def _differences_table(numbers: Report) -> Table:
    def words(found: Mapping[str, float]) -> str:
        value, low, high = (100 * found[name] for name in ("value", "low", "high"))
        return f"{value:+.2f} ({low:+.2f} to {high:+.2f})"

    head = f"{numbers['ours']} minus"
    return Table(
        [
            {
                head: name,
                "balanced accuracy, points": words(found["balanced_accuracy"]),
                "above in": f"{percent(found['balanced_accuracy']['share'], 1)} % of draws",
                "AUC, points": words(found["auc"]),
            }
            for name, found in numbers["differences"].items()
        ]
    )


def _differences_text(numbers: Report) -> str:
    gaps = {name: of["balanced_accuracy"] for name, of in numbers["differences"].items()}
    unsettled = [name for name, gap in gaps.items() if gap["low"] <= 0 <= gap["high"]]
    told = f"**Nothing is settled beside:** {'; '.join(unsettled)}." if unsettled else ""
    return (
        "Recordings are drawn anew within slip and within stable touch, "
        f"{numbers['settings']['draws']:,} times with a fixed seed, the same for both methods; "
        f"brackets hold {100 * COVERAGE:g} % of the differences. Where they hold 0, nothing is "
        "settled. Scores are held, so this says nothing of other training recordings or other "
        f"objects. {told}"
    )


def _times_table(numbers: Report) -> Table:
    cells = []
    for name, row in numbers["methods"].items():
        found = row["time"]
        times: dict[str, object] = {"batch": found and found["batch"]}
        for how in ("batched", "alone"):
            faster = f"{number(found[f'{how}_times_faster']['median'])} x" if found else None
            times[f"us a window, {how}"] = number(1e6 * found[f"{how}_s"]) if found else None
            times[f"faster, {how}"] = faster
        cells.append({"method": name, "fit of a fold, s": number(row["fit_s"])} | times)
    note = f"Faster: than {numbers['rockets'][0]}, round by round; below 1 is slower."
    return Table(cells, note)


def _choices_table(numbers: Report) -> Table:
    cells = []
    for name, row in numbers["methods"].items():
        counts = Counter(
            ", ".join(
                f"{key} {value if isinstance(value, str) else format(value, '.3g')}".strip()
                for key, value in chosen.items()
            )
            for chosen in row["chosen"]
        )
        text = "; ".join(f"{choice} ({times}x)" for choice, times in counts.most_common())
        cells.append({"method": name, "chosen inside the folds": text})
    return Table(cells)


def _draw_objects(axes: Axes, rows: Mapping[str, Any], colors: Mapping[str, str]) -> None:
    """A line for each method: a dot for each object, the worst named, a bar at all windows."""
    for place, (name, row) in enumerate(rows.items()):
        color = colors.get(name, GREY)
        values = [100 * value for value in row["objects"].values()]
        axes.plot(values, [place] * len(values), "o", color=color, ms=5, alpha=0.55, mew=0)
        axes.plot(100 * row["balanced_accuracy"], place, "|", color=color, ms=20, mew=2)
        worst = row["worst"]
        axes.annotate(
            worst["object"],
            (100 * worst["balanced_accuracy"], place),
            (0, -9),
            textcoords="offset points",
            ha="center",
            va="center",
            size=7,
            color="#555555",
        )
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlabel("balanced accuracy, %: dots objects, bar all windows")
    axes.set_title("objects that were left out")


if __name__ == "__main__":
    raise SystemExit(Real().run())
