"""Where candidates of a search become detectors: surveyed, timed, fitted and judged."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.data.labels import needed_windows
from tactslip_torch.data.splits import Split
from tactslip_torch.datamodule import SlipDataModule
from tactslip_torch.deadline.cost import CostModel, measure_costs
from tactslip_torch.deadline.front import Candidate
from tactslip_torch.deadline.latency import Latency, shortest_hop
from tactslip_torch.deadline.search import Search, offset_of
from tactslip_torch.deadline.timing import (
    Timing,
    one_thread,
    single_bins,
    time_calls,
    time_detector,
)
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.pool import Arithmetic, FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.fitting import TrainingPass, solve_facts
from tactslip_torch.graph.bins import bin_graph
from tactslip_torch.graph.form import Form
from tactslip_torch.graph.runs import session_of
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.planning import adds_up, plan_detector
from tactslip_torch.progress import bar
from tactslip_torch.recipe import Recipe, recalls_mean, stand_for
from tactslip_torch.signals.binning import bins_at
from tactslip_torch.signals.filtering import Align


@dataclass(frozen=True)
class Timed:
    """A candidate by the clock.

    Args:
        candidate: what it is.
        arithmetic: of its pool.
        timing: of ``judge_raw``.
        latency: with the shortest hop that compute at p99 fits into.
        graph_us: median of its ONNX graph in onnxruntime, of samples in float32; of the pool in
            float64.
    """

    candidate: Candidate
    arithmetic: Arithmetic
    timing: Timing
    latency: Latency
    graph_us: float

    @property
    def point(self) -> tuple[float, float, float]:
        """What is traded, smaller is better: latency, compute, errors."""
        return self.latency.worst_ms, self.timing.p99_us, -self.candidate.balanced_accuracy


class Workshop:
    """Makes, times and judges detectors of candidates.

    Args:
        makers: of features, by alignment of the filter; one source, pool and engine.
        fold: who is trained on.
        search: what is searched.
        recipe: how features are scaled and classes balanced.
        most_summed: features up to which a quadratic head is fitted to all training bins.
        num_workers: processes that make features.

    Raises:
        ValueError: if the recipe restricts its features, as the search does in its own way.

    Attributes:
        surveys: of the training recordings, by alignment, once ``look`` has been called.
    """

    def __init__(
        self,
        makers: Mapping[Align, FeatureMaker],
        fold: Split,
        search: Search,
        recipe: Recipe,
        most_summed: int = 120,
        num_workers: int | None = None,
    ) -> None:
        if recipe.among is not None:
            raise ValueError(
                "recipe.among is not for a search; use search.channels and search.components"
            )
        self.makers, self.fold, self.search = makers, fold, search
        self.recipe = replace(recipe, sample_bins=search.bins)
        self.most_summed = most_summed
        self.surveys: dict[Align, Survey] = {}
        self._data = {
            align: SlipDataModule(maker, fold, num_workers) for align, maker in makers.items()
        }

    @property
    def pool(self) -> FeaturePool:
        """What features there are."""
        return next(iter(self.makers.values())).pool

    def look(self) -> None:
        """One pass over the training recordings for each alignment."""
        for align, data in self._data.items():
            survey = Survey(len(self.pool.names), self.search.bins)
            with one_thread():  # the processors belong to those who make features
                for batch in bar(data.loader(["train"]), f"features, {align}", "recording"):
                    mask, group = batch.roles["train"], self.recipe.group(batch.recording)
                    name = str(batch.recording)
                    survey.update(name, group, batch.features[mask], batch.is_slip[mask])
            self.surveys[align] = survey

    def costs(self) -> CostModel:
        """Of groups of features, on this machine."""
        maker = next(iter(self.makers.values()))
        sizes = [size for size in self.search.sizes if size <= len(self.pool.names)]
        calls = max(self.search.calls // 4, 10)
        return measure_costs(
            self.pool,
            maker.channel_filter,
            sizes,
            maker.extractor.engine,
            max(self.search.statistics, key=len, default=()),
            calls=calls,
            watch=bar,
        )

    def timed(self, candidates: Sequence[Candidate]) -> list[Timed]:
        """Detectors of the candidates, fitted to the sample, in every arithmetic, by the clock."""
        found = []
        for candidate in bar(candidates, "timing the front", "detector"):
            graph_us = time_graph(self.make(candidate, "double"), self.search.calls).p50_us
            for arithmetic in self.search.arithmetics:
                with one_thread():
                    timing = time_detector(self.make(candidate, arithmetic), self.search.calls)
                latency = replace(candidate.latency, compute_us=timing.p99_us)
                latency = shortest_hop(latency, self.search.hops_ms)
                found.append(Timed(candidate, arithmetic, timing, latency, graph_us))
        return found

    def make(
        self, candidate: Candidate, arithmetic: Arithmetic, *, from_all: bool = False
    ) -> SlipDetector:
        """The detector of a candidate, fitted to the sample or to all training bins."""
        survey, data = self.surveys[candidate.align], self._data[candidate.align]
        recipe = replace(
            self.recipe,
            num_features=candidate.frame.size,
            kernel="polynomial",
            degree=candidate.degree,
            offsets=offset_of(self.recipe),
            penalties=candidate.penalty,
        )
        plan = plan_detector(recipe, survey, _quietly, candidate.frame)
        is_bounded = adds_up(plan.kernel) and plan.frame.size > self.most_summed
        if from_all and not is_bounded:
            gathered = TrainingPass(plan)
            with one_thread():
                for batch in bar(data.loader(["train"]), "the machine, all bins", "recording"):
                    mask, name = batch.roles["train"], str(batch.recording)
                    gathered.update(name, batch.features[mask], batch.is_slip[mask])
            head, bins = gathered.solve(), "all training bins"
        else:
            sample = survey.sample.bins()
            weights = stand_for(sample, recipe, survey.moments.count.tolist())
            training = TrainingBins(plan.frame(sample.features), sample.is_slip, weights)
            head = fit_machine(training, plan.penalty, plan.kernel)
            bins = f"{self.search.bins} training bins of each material and class"
        facts = plan.facts()
        info = {name: facts[name] for name in ("kernel", "penalty", "balance", "num_bins")}
        trained, source = self.fold.having("train"), data.maker.source
        info |= {
            "recipe": recipe.name,
            "fitted_to": bins,
            "solve": solve_facts(head),
            "simulated": source.is_simulated,
            "split": self.fold.name,
            "features_dtype": "float32" if arithmetic == "native" else "float64",
            "train_materials": sorted({recording.material for recording in trained}),
            "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
        }
        pool = FeaturePool(self.pool.hand, **self.pool.facts() | {"arithmetic": arithmetic})
        return SlipDetector(
            pool,
            data.maker.channel_filter,
            plan.frame.selected,
            plan.frame.scaler,
            head,
            info,
            plan.typical,
            plan.gaussians,
            plan.frame.pooling,
            engine=data.maker.extractor.engine,
        )

    def judged(self, detector: SlipDetector) -> dict[str, Any]:
        """Balanced accuracy on raw bins of the test cycles, as a live loop would judge them."""
        maker = self.makers[detector.channel_filter.align]
        source, channel_filter = maker.source, detector.channel_filter
        before, after = channel_filter.context_before, channel_filter.context_after
        says, truth = [], []
        for recording in bar(self.fold.having("test"), "the chosen one, test", "recording"):
            times = source.timeline(recording)
            bins = maker.lay_bins(times)
            windows = needed_windows(bins, before, times.duration_s, source.sample_rate_hz)
            samples = source.load(recording, windows).samples
            is_inside = bins.starts >= before
            is_inside &= bins.starts + bins.bin_samples + after <= samples.shape[-1]
            kept = is_inside & self.fold.bin_roles(recording, len(is_inside))["test"]
            raw = bins_at(samples, bins.starts[kept] - before, before + bins.bin_samples + after)
            with torch.inference_mode():
                says.append(detector.judge_raw(raw.float()).score >= 0)
            truth.append(bins.is_slip[kept])
        is_slip = torch.cat(truth)
        return {
            "balanced_accuracy": recalls_mean(torch.cat(says), is_slip),
            "num_bins": len(is_slip),
        }


def time_graph(detector: SlipDetector, calls: int) -> Timing:
    """Time the ONNX graph of a detector in onnxruntime, one ordinary bin and one thread."""
    session = session_of(bin_graph(detector, Form()).model({}))
    samples = next(each for each in session.get_inputs() if each.name == "samples")
    bins = single_bins(detector.pool, samples.shape[-1])

    def call(given: Tensor) -> object:
        return session.run(None, {"samples": given.numpy()})

    return time_calls(call, bins, calls)


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items
