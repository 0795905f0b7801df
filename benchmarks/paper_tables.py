"""The paper's choices, varied: ``python -m benchmarks.paper_tables [key=value ...]``.

The paper sets bins of 50 ms "after trial-and-error", takes the 120 features of the largest t,
leaves neighbourhood component analysis out as too costly, and shows one trial with its decisions
and the signals of six materials. Here each of these is measured or drawn on the simulated hand,
with the paper's recipe and split by cycle.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from hydra.utils import instantiate
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from omegaconf import DictConfig
from sklearn.neighbors import NeighborhoodComponentsAnalysis
from torch import Tensor

from benchmarks.harness import Benchmark, Job
from benchmarks.tables import Report, Table, number
from benchmarks.trainings import composed, resumed
from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.features.selection import (
    ClassMoments,
    forward_selection,
    rank_features,
    t_scores,
)
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial, QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.report import style
from tactslip_torch.report.metrics import balanced_accuracy
from tactslip_torch.report.recordings import signals_figure
from tactslip_torch.signals.filtering import bins_at
from tactslip_torch.simulation.scene import SEEN_MATERIALS
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.bins import BinSample, SampledBins
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_maker
from tactslip_torch.training.recipe import Paper

WIDTH_MS, NUM_FEATURES, TRIAL_MATERIAL, SIGNALS_MM_S = 50, 120, "M3", 40.0  # the paper's
ROLES = {"test": "test bins", "unseen": "held-out materials"}
RANKINGS = {
    "t-test": "t-test (the paper's)",
    "by material": "by material",
    "forward": "forward selection",
    "NCA": "neighbourhood components",
}
RIDGE = 1e-3  # of forward selection, as a part of the bins: near duplicates are of no use
AS_GOOD = 0.5  # points
PAUSE, SLIP = "#3B6FB6", "#F2C230"  # blue and yellow, as in the paper's figure


class Loaded(SimulatedRecordings):
    """Simulated recordings that are simulated once, for bins of every width."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(**parameters)
        self._loaded: dict[RecordingId, Recording] = {}

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """The whole recording, whatever is asked for."""
        if recording not in self._loaded:
            self._loaded[recording] = super().load(recording)
        return self._loaded[recording]


@dataclass(frozen=True)
class PaperTables(Benchmark):
    """What is varied.

    Args:
        seeds: of recordings and split.
        widths_ms: of bins.
        sizes: numbers of features.
        rows: bins of each material and class, at the paper's width, that machines and all rankings
            but the t-test are fitted to; of shorter bins as many more.
        choice_rows: bins of each material and class that C is chosen by.
        nca_rows: bins of each material and class for neighbourhood component analysis; its ranking
            is of the last.
        nca_dims: dimensions that it maps to.
        nca_steps: of its optimiser, at most.
        overrides: of the sets.
    """

    title = "The paper's choices, varied"
    about = (
        "bin width, number of features, and how they are ranked, on the SIMULATED hand, with the "
        "paper's recipe and split by cycle, half of the paper's cycles"
    )
    page = "docs/reproduction.md"
    drawn: ClassVar = {"trial.png": "_trial", "signals.png": "_signals"}
    charts: ClassVar = {"": [("Width of bins",), ("Number of features, test bins",)]}
    quick = (
        "seeds=[0,1] widths_ms=[20,50] sizes=[5,10] rows=20 choice_rows=20 nca_rows=[5,10] "
        'nca_steps=3 overrides=[data.cycles=2,"data.materials=[M1,M3,iron]","split.seen=[M1,M3]",'
        '"split.unseen=[iron]",split.train_fraction=0.5]'
    )
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    widths_ms: tuple[int, ...] = (10, 20, 30, 50, 100, 200)
    sizes: tuple[int, ...] = (10, 20, 40, 60, 120, 240, 400, 600)
    rows: int = 240
    choice_rows: int = 100
    nca_rows: tuple[int, ...] = (25, 50, 100)
    nca_dims: int = 20
    nca_steps: int = 50
    overrides: tuple[str, ...] = ("data.cycles=14",)

    def measure(self, job: Job) -> dict[str, Any]:
        """Every width, ranking and number on every seed; both figures on the first."""
        given = ["+exp=unseen4", "recipe=paper", *self.overrides, *job.overrides]
        given += ["features.memory_gib=1", f"data._target_={__spec__.name}.{Loaded.__name__}"]
        seeds = list[dict[str, Any]]()
        for seed in self.seeds:
            config = composed("train", [*given, f"seed={seed}"])
            source: Loaded = instantiate(config.data, _convert_="all")
            folder = job.folder if seed == self.seeds[0] else None
            widths, more = list[dict[str, Any]](), dict[str, Any]()
            for width_ms in self.widths_ms:
                make = partial(self._of_width, config, source, width_ms, folder)
                path, made_by = job.folder / f"{seed}-{width_ms}.json", [repr(self), *given]
                widths.append(resumed(path, made_by, make))
                more |= widths[-1].pop("more")
            seeds.append({"widths": widths} | more)
        return {"folder": str(job.folder), "seeds": seeds}

    def _of_width(
        self, config: DictConfig, source: Loaded, width_ms: int, folder: Path | None
    ) -> dict[str, Any]:
        """Bins of a width; at the paper's also numbers of features, and figures into a folder."""
        with _data(config, source, width_ms) as data:
            order, pool = _t_order(data, NUM_FEATURES), data.maker.pool
            bins = _Sampled.of(data, round(self.rows * WIDTH_MS / width_ms), order)
            machine = bins.machine(torch.arange(NUM_FEATURES), self.choice_rows)
            about = {"width": width_ms, "level": pool.level, "pool": len(pool.names)}
            found, more = {"bins": len(bins.z)} | bins.scores(machine), dict[str, Any]()
            if width_ms == WIDTH_MS:
                more = self._numbers(data)
                if folder is not None:
                    decide = partial(machine.says, columns=order)
                    more["trial"] = _trial(data, decide, folder / "trial.png")
                    _draw_signals(data.maker, folder / "signals.png")
        return about | found | {"more": more}

    def _numbers(self, data: SlipDataModule) -> dict[str, Any]:
        """Balanced accuracy by ranking and number of features, and what a ranking costs."""
        bins = _Sampled.of(data, self.rows)
        orders, costs = {}, []

        def timed(name: str, num: int, rank: Callable[[], Tensor]) -> Tensor:
            started = time.process_time()
            order = rank()
            cost = {"ranking": name, "bins": num, "cpu_s": time.process_time() - started}
            costs.append(cost)
            return order

        most = max(self.sizes)
        of_all = partial(_t_order, data, most)
        orders["t-test"] = timed("t-test", bins.num_training, of_all)
        of = partial(_material_order, bins)
        orders["by material"] = timed("by material", len(bins.z), of)
        of = partial(forward_order, bins.z, bins.is_slip, bins.weights, most)
        orders["forward"] = timed("forward", len(bins.z), of)
        for rows in self.nca_rows:
            some = bins.thinned(rows)
            of = partial(_component_order, some.z, some.is_slip, self.nca_dims, self.nca_steps)
            orders["NCA"] = timed("NCA", len(some.z), of)
        scores = [
            {"ranking": name, "size": size}
            | bins.scores(bins.machine(order[:size], self.choice_rows))
            for name, order in orders.items()
            for size in self.sizes
        ]
        return {"scores": scores, "costs": costs}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """By width, by number of features and ranking, what rankings cost, and one trial."""
        seeds = numbers["seeds"]
        return {
            "The paper's choices": _choices(seeds),
            "Width of bins": _widths(seeds),
            "Number of features, test bins": _sizes(seeds, "test"),
            "Number of features, held-out materials": _sizes(seeds, "unseen"),
            "What a ranking costs": _costs(seeds),
            "One trial, not segmented": Table(*seeds[0]["trial"]),
        }

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Balanced accuracy over the width of bins and over the number of features."""
        drawing.set_size_inches(9.2, 6.4)
        panels = drawing.subplots(2, 2, sharey="row")
        for (by_width, by_size), role in zip(panels, ROLES, strict=True):
            curve = _by_value([seed["widths"] for seed in numbers["seeds"]], "width", role)
            _curve(by_width, curve, "paper's recipe", style.BLUE)
            by_width.axvline(WIDTH_MS, color=style.GREY, linestyle=":")
            by_width.set(
                xlabel="width of a bin, ms; dotted: the paper's",
                title=f"{ROLES[role]}, balanced accuracy, %",
            )
            looks = zip(RANKINGS.items(), style.PALETTE, strict=False)
            for (ranking, words), colour in looks:
                _curve(by_size, _of_ranking(numbers["seeds"], ranking, role), words, colour)
            by_size.axvline(NUM_FEATURES, color=style.GREY, linestyle=":")
            by_size.set(xlabel="number of features; dotted: the paper's", title=ROLES[role])
        handles, labels = panels[0, 1].get_legend_handles_labels()
        shade = Patch(color=style.GREY, alpha=0.25)
        panels[0, 1].legend([*handles, shade], [*labels, "least to largest over seeds"])


@contextmanager
def _data(config: DictConfig, source: Loaded, width_ms: float) -> Iterator[SlipDataModule]:
    """The features of all recordings for bins of a width, as many levels as they allow."""
    rule = instantiate(config.labels, bin_ms=float(width_ms))
    fold: Split = instantiate(config.split, _convert_="all")(source.ids)[0]
    recipe: Paper = instantiate(config.recipe, _convert_="all")
    maker = feature_maker(source, rule, **config.features, recipe=recipe, with_baselines=False)
    with feature_cache("off") as maker.cache:
        data = SlipDataModule(maker, [fold], num_workers=0)
        data.setup()
        yield data


# ------------------------------------------------------------------------------------- rankings
class _Machine(NamedTuple):
    """The paper's machine on some columns.

    Attributes:
        columns: that it takes.
        scaler: of them.
        head: that decides.
        penalty: its C.
    """

    columns: Tensor
    scaler: FeatureScaler
    head: QuadraticForm
    penalty: float

    def says(self, features: Tensor, columns: Tensor | None = None) -> Tensor:
        """Whether bins ``[N, F]`` are slip, ``[N]``; of other columns, where these are those."""
        taken = self.columns if columns is None else columns[self.columns]
        scores: Tensor = self.head(self.scaler(features[:, taken].double()))
        return scores >= 0


class _Sampled(NamedTuple):
    """A sample of training bins and all other bins, of some features or of all.

    Attributes:
        sample: the bins.
        z: their features in [-1, 1], ``[N, F]``, float64.
        scaler: that made them, of the ranges of all training bins.
        num_training: how many training bins there are.
        features: of the bins that are not trained on, by role.
        outcomes: whether those are slip.
    """

    sample: SampledBins
    z: Tensor
    scaler: FeatureScaler
    num_training: int
    features: dict[str, Tensor]
    outcomes: dict[str, Tensor]

    @classmethod
    def of(cls, data: SlipDataModule, rows: int, columns: Tensor | None = None) -> _Sampled:
        """With so many bins of each material and class; of these columns, or of all."""
        sample, ranges, num = BinSample(rows), list[Tensor](), 0
        for bins in data.training_bins():
            few = bins if columns is None else replace(bins, features=bins.features[:, columns])
            sample.update(few)
            num += len(few.is_slip)
            ranges.append(torch.stack([few.features.amin(0), -few.features.amax(0)]))
        low, high = torch.stack(ranges).amin(0).double()
        scaler, drawn = FeatureScaler(low, -high), sample.bins()
        features, outcomes = dict[str, Tensor](), dict[str, Tensor]()
        for role in ROLES:
            made = [each.of(each.roles[role]) for each in data.features(role)]
            own = [m.features if columns is None else m.features[:, columns] for m in made]
            features[role], outcomes[role] = torch.cat(own), torch.cat([m.is_slip for m in made])
        return cls(drawn, scaler(drawn.features.double()), scaler, num, features, outcomes)

    @property
    def is_slip(self) -> Tensor:
        """Classes of the sample, ``[N]``."""
        return self.sample.is_slip

    @property
    def weights(self) -> Tensor:
        """For how many undersampled training bins each stands, ``[N]``: the classes balance."""
        weight, is_slip = self.sample.weight, self.is_slip
        totals = torch.stack([weight[~is_slip].sum(), weight[is_slip].sum()])
        return weight * (totals.min() / totals)[is_slip.long()]

    def thinned(self, rows: int) -> _Sampled:
        """With at most so many bins of each material and class."""
        weight, kept = self.sample.weight.clone(), list[Tensor]()
        for one in self.sample.stratum.unique():
            places = (self.sample.stratum == one).nonzero()[:, 0]
            kept.append(places[torch.linspace(0, len(places) - 1, min(rows, len(places))).long()])
            weight[places] *= len(places) / len(kept[-1])
        rest = torch.cat(kept)
        names = ("features", "is_slip", "group", "scene")
        few = {name: getattr(self.sample, name)[rest] for name in names}
        sample = replace(self.sample, weight=weight[rest], **few)
        return self._replace(sample=sample, z=self.z[rest])

    @property
    def num_groups(self) -> int:
        """How many materials it has."""
        return len(self.sample.group_names)

    def machine(self, columns: Tensor, choice_rows: int) -> _Machine:
        """The paper's machine on these columns, its C chosen by materials left out."""
        kernel, few = Polynomial(2, 0.5), self.thinned(choice_rows)
        bins = TrainingBins(few.z[:, columns], few.is_slip, few.weights)
        held_out = HeldOut(bins, few.sample.group, kernel)
        members = [few.sample.group == group for group in range(self.num_groups)]

        def validation(penalty: float) -> float:
            try:
                says = held_out.at(penalty) >= 0
            except ValueError:  # close to singular: no candidate
                return -1.0
            return mean(balanced_accuracy(says[of], few.is_slip[of]) or 0.0 for of in members)

        penalty = max(Paper().penalties_ascending, key=validation)
        whole = TrainingBins(self.z[:, columns], self.is_slip, self.weights)
        scaler = FeatureScaler(self.scaler.minimum[columns], self.scaler.maximum[columns])
        return _Machine(columns, scaler, fit_machine(whole, penalty, kernel), penalty)

    def scores(self, machine: _Machine) -> dict[str, Any]:
        """Balanced accuracy of a machine on the other bins, by role, and its C."""
        found = {
            role: balanced_accuracy(machine.says(of), self.outcomes[role])
            for role, of in self.features.items()
        }
        return {"penalty": machine.penalty, **found}


def _t_order(data: SlipDataModule, num: int) -> Tensor:
    """The best features by the t-test on all training bins."""
    moments = ClassMoments(len(data.maker.pool.names))
    for bins in data.training_bins():
        moments.update(bins.features, bins.is_slip)
    return rank_features(t_scores(moments), num)


def _material_order(bins: _Sampled) -> Tensor:
    """Features by how well they separate the classes in every material, best first.

    ``|mean effect| / sqrt(within-class variance + variance of the effect + of the level)``, the
    last two between materials: a feature whose threshold moves from material to material is worth
    less.
    """
    effects, levels, spreads = [], [], []
    for group in range(bins.num_groups):
        mine = bins.sample.group == group
        quiet, slip = bins.z[mine & ~bins.is_slip], bins.z[mine & bins.is_slip]
        effects.append(slip.mean(0) - quiet.mean(0))
        levels.append((slip.mean(0) + quiet.mean(0)) / 2)
        spreads.append((slip.var(0, correction=0) + quiet.var(0, correction=0)) / 2)
    effect, level = torch.stack(effects), torch.stack(levels)
    square = torch.stack(spreads).mean(0) + effect.var(0) + level.var(0)
    score = torch.where(square > 0, effect.mean(0).abs() / square.sqrt(), 0.0)
    return score.argsort(descending=True, stable=True)


def forward_order(z: Tensor, is_slip: Tensor, weights: Tensor, num: int) -> Tensor:
    """Features in the order in which greedy least squares takes them, ``[num]``.

    Shape:
        - z: ``[N, F]``, float64; is_slip, weights: ``[N]``
    """
    targets = torch.where(is_slip, 1.0, -1.0).double()[:, None]
    return torch.tensor(forward_selection(z, targets, weights / weights.sum(), num, RIDGE))


def _component_order(z: Tensor, is_slip: Tensor, dims: int, steps: int) -> Tensor:
    """Features by the norm of their weights in scikit-learn's neighbourhood components.

    All features are scaled by one number, so that the mean squared distance of two bins is 2: at
    larger ones a bin's nearest neighbour has all the weight, and no step is taken.
    """
    z = z / z.var(0).sum().sqrt()
    analysis = NeighborhoodComponentsAnalysis(n_components=dims, max_iter=steps, random_state=0)
    analysis.fit(z.numpy(), is_slip.numpy())
    norms = torch.from_numpy(analysis.components_).square().sum(0)
    return norms.argsort(descending=True, stable=True)


# --------------------------------------------------------------------------------------- tables
BySeed = Mapping[int, Sequence[float]]
"""Percents of each seed, by what is varied."""


def _by_value(seeds: Sequence[Sequence[Report]], key: str, role: str) -> BySeed:
    """Balanced accuracy in % by a key of the rows, a number a seed."""
    values = [row[key] for row in seeds[0]]
    by_seed = [{row[key]: 100 * row[role] for row in rows} for rows in seeds]
    return {value: [of[value] for of in by_seed] for value in values}


def _of_ranking(seeds: Sequence[Report], ranking: str, role: str) -> BySeed:
    rows = [[row for row in seed["scores"] if row["ranking"] == ranking] for seed in seeds]
    return _by_value(rows, "size", role)


def _spread(values: Sequence[float], sign: str = "") -> str:
    """The mean, and the least and the largest over seeds."""
    return f"{mean(values):{sign}.2f} ({min(values):{sign}.2f} to {max(values):{sign}.2f})"


def _widths(seeds: Sequence[Report]) -> Table:
    found = {role: _by_value([seed["widths"] for seed in seeds], "width", role) for role in ROLES}
    rows = []
    for first in seeds[0]["widths"]:
        row = {"bin, ms": first["width"], "levels": first["level"], "features": first["pool"]}
        row |= {f"{ROLES[role]}, %": _spread(by[first["width"]]) for role, by in found.items()}
        row["bins fitted on"] = f"{first['bins']:,}"
        rows.append(row)
    note = (
        f"SIMULATED; balanced accuracy, mean (lowest to highest) over {len(seeds)} seeds. "
        f"{NUM_FEATURES} features, by the t-test on all training bins; the machine is fitted on a "
        "sample of them. Short bins allow fewer wavelet levels."
    )
    return Table(rows, note)


def _sizes(seeds: Sequence[Report], role: str) -> Table:
    by_ranking = {words: _of_ranking(seeds, name, role) for name, words in RANKINGS.items()}
    sizes = list(next(iter(by_ranking.values())))
    rows = [
        {"features": size} | {f"{words}, %": _spread(of[size]) for words, of in by_ranking.items()}
        for size in sizes
    ]
    note = (
        f"SIMULATED; balanced accuracy, mean (lowest to highest) over {len(seeds)} seeds. Machines "
        f"of degree 2 are fitted on {_bins(seeds, 'forward')} bins, equally many of each material "
        "and class; C is chosen by leaving out materials."
    )
    return Table(rows, note)


def _bins(seeds: Sequence[Report], ranking: str) -> str:
    most = max(row["bins"] for row in seeds[0]["costs"] if row["ranking"] == ranking)
    return f"{most:,}"


def _costs(seeds: Sequence[Report]) -> Table:
    rows = []
    for place, first in enumerate(seeds[0]["costs"]):
        seconds = mean(seed["costs"][place]["cpu_s"] for seed in seeds)
        row = {"ranking": RANKINGS[first["ranking"]], "bins": f"{first['bins']:,}"}
        rows.append(row | {"CPU s": number(seconds), "": "measured"})
    *_, last = rows
    num, most = (seeds[0]["costs"][place]["bins"] for place in (-1, 0))
    grown = float(str(last["CPU s"]).replace(",", "")) * (most / num) ** 2
    gib = 8 * most**2 / 2**30
    why = f"extrapolated, as the square of the bins; one matrix of bins by bins is {gib:.1f} GiB"
    rows.append(last | {"bins": f"{most:,}", "CPU s": number(grown), "": why})
    note = "SIMULATED bins; one thread, mean over seeds, without the time to make the features."
    return Table(rows, note)


def _choices(seeds: Sequence[Report]) -> Table:
    """Each choice of the paper beside the best of those that were measured."""
    rows = []
    for role in ROLES:
        widths = _by_value([seed["widths"] for seed in seeds], "width", role)
        rows.append(_choice("bins of 50 ms", " ms", WIDTH_MS, widths, role))
        by_size = _of_ranking(seeds, "t-test", role)
        rows.append(_choice("120 features", "", NUM_FEATURES, by_size, role))
        ways = {words: _of_ranking(seeds, name, role) for name, words in RANKINGS.items()}
        size = NUM_FEATURES if NUM_FEATURES in by_size else max(by_size)
        at = {words: of[size] for words, of in ways.items()}
        what = f"ranking by t-test ({size} features)"
        rows.append(_choice(what, "", RANKINGS["t-test"], at, role))
    note = (
        "SIMULATED; balanced accuracy, mean (lowest to highest) over seeds. *Confirmed*: *yes* if "
        "the paper's choice has the best mean; *no* if others, which are named, are better in "
        f"every seed; else *open*. *As good*: within {AS_GOOD} points of the best mean."
    )
    return Table(rows, note)


def _choice(
    what: str, unit: str, taken: Any, found: Mapping[Any, Sequence[float]], role: str
) -> dict[str, Any]:
    """A choice, the best value, and in how many seeds that is better."""
    taken = taken if taken in found else next(iter(found))
    means = {value: mean(of) for value, of in found.items()}
    best = max(means, key=means.__getitem__)
    as_good = next(value for value, of in means.items() if of >= means[best] - AS_GOOD)
    gained = {
        value: [a - b for a, b in zip(of, found[taken], strict=True)] for value, of in found.items()
    }
    better = [f"{value}{unit}" for value, of in gained.items() if min(of) > 0]
    num_better = sum(gain > 0 for gain in gained[best])
    verdict = f"open: {best}{unit} is better in {num_better} of {len(gained[best])} seeds"
    if better:
        verdict = f"no: {', '.join(better)}"
    elif best == taken:
        verdict = "yes"
    return {
        "the paper's choice": what,
        "evaluated on": ROLES[role],
        "its accuracy, %": _spread(found[taken]),
        "best": f"{best}{unit}",
        "best - the paper's, points": _spread(gained[best], "+"),
        "first that is as good as the best": f"{as_good}{unit}",
        "confirmed": verdict,
    }


def _curve(axes: Axes, by_value: BySeed, label: str, colour: str) -> None:
    """Means over what is varied, and the range over seeds."""
    places, values = list(by_value), list(by_value.values())
    low, high = list(map(min, values)), list(map(max, values))
    axes.fill_between(places, low, high, color=colour, alpha=0.12)
    axes.plot(places, list(map(mean, values)), "o-", color=colour, label=label, markersize=4)
    axes.set_xscale("log")
    axes.set_xticks(places, [str(place) for place in places])
    axes.minorticks_off()


# ---------------------------------------------------------------------------------------- trial
def _trial(
    data: SlipDataModule, decide: Callable[[Tensor], Tensor], path: Path
) -> tuple[list[dict[str, Any]], str]:
    """Decisions on all of a test recording: the figure, the rows of its table, and a note."""
    maker = data.maker
    name = next(of for of in data.fold.having("test") if of.material == TRIAL_MATERIAL)
    recording, rate = maker.source.load(name), maker.source.sample_rate_hz
    length = maker.pool.bin_samples
    filtered = maker.channel_filter(recording.samples.double())
    starts = torch.arange(0, filtered.shape[-1] - length + 1, length)
    features = maker.extractor(bins_at(filtered, starts, length)).float()
    says = decide(features)
    begins, ends = starts / rate, (starts + length) / rate
    rows, end, row = list[dict[str, Any]](), 0.0, dict[str, Any]()
    slides = zip(recording.speeds_mm_s, recording.sliding_s, strict=True)
    for speed, (start, stop) in slides:
        pause, slide = (begins >= end) & (ends <= start), (begins >= start) & (ends <= stop)
        first = ends[(ends > start) & says].tolist()
        row = {"stroke": f"{speed:g} mm/s", "bins before it": int(pause.sum())}
        row |= {"called slip": int((pause & says).sum()), "bins of slip": int(slide.sum())}
        row |= {"found": int((slide & says).sum())}
        delay = f"{1000 * (first[0] - start):.0f}" if first else "-"
        rows.append(row | {"onset to the end of the first slip bin, ms": delay})
        end = stop
    _draw_trial(maker, recording, filtered, says, str(name), path)
    note = (
        f"SIMULATED; {name}, a test recording of the first seed, from its first sample on; bins "
        "in which a slide begins or ends are not counted."
    )
    return rows, note


@style.styled
def _draw_trial(
    maker: FeatureMaker, recording: Recording, filtered: Tensor, says: Tensor, name: str, path: Path
) -> None:
    """Fast channels below each other on the colour of each bin's decision, and the truth."""
    rate, width_s = (
        maker.source.sample_rate_hz,
        maker.pool.bin_samples / maker.source.sample_rate_hz,
    )
    figure = style.new_figure(9.2, 5.2, f"One trial, {name}: decisions on bins", simulated=True)
    truth, axes = figure.subplots(2, 1, sharex=True, height_ratios=[1, 12])
    for place, is_slip in enumerate(says.tolist()):
        span = place * width_s, (place + 1) * width_s
        axes.axvspan(*span, color=SLIP if is_slip else PAUSE, alpha=0.45, linewidth=0)
    fast = [row for row, of in enumerate(maker.source.hand.channels) if of.kind == "PVDF"]
    step = 1000 * float(np.quantile(filtered[fast].abs().numpy(), 0.998))
    times = torch.arange(filtered.shape[-1]) / rate
    for lane, row in enumerate(fast):
        axes.plot(times, 1000 * filtered[row] / step - lane, color=style.INK, linewidth=0.4)
    names = [maker.source.hand.names[row] for row in fast]
    axes.set_yticks([-lane for lane in range(len(fast))], names)
    axes.set_ylim(-len(fast), 2)
    axes.set(xlabel="time, s", xlim=(0, float(times[-1])), title=f"PVDF, a lane is {step:.3g} mV")
    axes.grid(visible=False)
    truth.axvspan(0, float(times[-1]), color=PAUSE, linewidth=0)
    for speed, (start, stop) in zip(recording.speeds_mm_s, recording.sliding_s, strict=True):
        truth.axvspan(start, stop, color=SLIP, linewidth=0)
        truth.text((start + stop) / 2, 0.5, f"{speed:g} mm/s", ha="center", va="center")
        axes.axvline(start, color=style.VERMILION, linestyle="-.", linewidth=1.2)
    truth.set(yticks=[], ylabel="truth")
    handles: list[Artist] = [Patch(color=PAUSE, label="non-slip"), Patch(color=SLIP, label="slip")]
    handles += [Line2D([], [], color=style.VERMILION, linestyle="-.", label="true onset")]
    style.legend_below(figure, handles, 3)
    style.save(figure, path)


def _draw_signals(maker: FeatureMaker, path: Path) -> None:
    """SGs and PVDF films of every seen material, five seconds around an onset."""
    rows, views = [], []
    for recording in maker.source.ids:
        if recording.material in SEEN_MATERIALS and not recording.cycle:
            content = maker.source.load(recording)
            onset_s = content.onsets_s[content.speeds_mm_s.index(SIGNALS_MM_S)]
            volts = maker.channel_filter(content.samples.double())
            rows.append((recording.material, replace(content, samples=volts)))
            views.append((onset_s - 2, onset_s + 3))
    title = f"SIMULATED, signals at {SIGNALS_MM_S:g} mm/s"
    signals_figure(rows, maker.source.hand.to_rows(), path, title=title, views=views)


if __name__ == "__main__":
    raise SystemExit(PaperTables().run())
