"""Deadline in, model out: ``python -m tactslip_torch.pareto deadline_ms=80 compute_us=500``.

Measures what groups of features cost on this machine; searches features, channels, components,
filter, head, precision and hop for the front of worst-case latency and compute against accuracy;
times those on the front; and writes the most accurate detector that meets both limits, timed once
more in a fresh process. Leaves ``pareto.json``, ``pareto.png``, ``detector.pt`` and the resolved
configuration. Exit status 1 if no detector meets the limits; all but the detector is written then.

Only training recordings are searched on. The test cycles of the seen materials judge the detector
once it is chosen; of unseen materials nothing is read.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.config import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.deadline.front import Candidate, nondominated, worth_timing
from tactslip_torch.deadline.latency import (
    DEFINITION,
    Latency,
    least_latency_ms,
    longest_hop,
    shortest_hop,
)
from tactslip_torch.deadline.search import Search, Searcher
from tactslip_torch.deadline.timing import Timing, time_in_fresh_process
from tactslip_torch.deadline.workshop import Timed, Workshop
from tactslip_torch.experiment import common_facts, feature_cache, feature_parts, save_config
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.files import whole_file
from tactslip_torch.progress import bar
from tactslip_torch.recipe import Recipe
from tactslip_torch.report.pareto import none_meets, pareto_figure, pareto_table
from tactslip_torch.signals.filtering import Align

EXIT_NONE_MEETS = 1


@dataclass(frozen=True)
class Limits:
    """What a detector has to keep.

    Args:
        deadline_ms: from the onset of slip to the decision, at worst.
        compute_us: from the last sample to the decision, p99.
        hops_ms: between bins, to choose from.

    Raises:
        ValueError: for limits that are not positive.
    """

    deadline_ms: float
    compute_us: float
    hops_ms: Sequence[float]

    def __post_init__(self) -> None:
        for name in ("deadline_ms", "compute_us"):
            value = getattr(self, name)
            if isinstance(value, str) or not value > 0:
                raise ValueError(f"{name} must be a positive number, got {value!r}")

    def latency(self, parts: Latency, compute_us: float) -> Latency:
        """The same parts with another compute, and the longest hop that keeps the limits."""
        given = replace(parts, compute_us=compute_us)
        return longest_hop(given, self.hops_ms, self.deadline_ms, self.compute_us)

    def misses(self, latency: Latency) -> list[str]:
        """Which limits are not kept, in words."""
        return latency.misses(self.deadline_ms, self.compute_us)


def pareto(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Search, choose, and write the results.

    Args:
        config: composed from ``conf/pareto.yaml``.
        folder: where results go.

    Returns:
        The content of ``pareto.json``; ``chosen`` is ``None`` if no detector meets the limits.

    Raises:
        ValueError: for bad input, in one line.
    """
    started = time.perf_counter()
    with feature_cache(config.cache) as cache:
        limits, shop = _prepared(config, cache)
        save_config(config, folder)
        shop.look()
        costs = shop.costs()
        recipe, filters = shop.recipe, {a: m.channel_filter for a, m in shop.makers.items()}
        searcher = Searcher(shop.search, recipe, shop.pool, costs, shop.surveys, filters)
        candidates = searcher.candidates(bar)
        if shop.search.drop_fingers:
            keeping = [each for each in candidates if not limits.misses(each.latency)]
            best = max(keeping or candidates, key=lambda each: each.balanced_accuracy)
            candidates += searcher.without_fingers(best, bar)
        timed = shop.timed(worth_timing(candidates, shop.search.most_timed))
        front = [timed[place] for place in nondominated([each.point for each in timed])]
        scale = median(each.timing.p99_us / each.candidate.latency.compute_us for each in timed)
        chosen, tries = _chosen(config, limits, shop, timed, folder)
    source = next(iter(shop.makers.values())).source
    found = common_facts(source, shop.pool, config) | {
        "definition": DEFINITION,
        "limits": {"deadline_ms": limits.deadline_ms, "compute_us": limits.compute_us},
        "headroom": config.headroom,
        "validation": "a material left out at a time, training recordings only; it chose",
        "engine": next(iter(shop.makers.values())).extractor.engine,
        "chosen": chosen,
        "tries": tries,
        "front": [row_of(shop, each, each.latency, each.timing) for each in front],
        "timed": len(timed),
        "searched": len(candidates),
        "measured_over_modelled": scale,
        "modelled": [_modelled(each, scale, limits) for each in candidates],
        "costs": costs.facts(),
        "seconds": time.perf_counter() - started,
    }
    with whole_file(folder / "pareto.json") as temporary:
        temporary.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    pareto_figure(found, folder / "pareto.png")
    print("\n" + pareto_table(found))
    print(f"\nresults in {folder}")
    return found


def _prepared(config: DictConfig, cache: FeatureCache) -> tuple[Limits, Workshop]:
    """The parts of the configuration; refuses limits that nothing can keep."""
    search: Search = instantiate(config.search, _convert_="all")
    limits = Limits(config.deadline_ms, config.compute_us, search.hops_ms)
    rule: LabelRule = instantiate(config.labels)
    recipe: Recipe = instantiate(config.recipe, _convert_="all")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    if len(folds) > 1:
        raise ValueError(f"pareto makes one detector, split has {len(folds)} folds; take another")
    if not config.headroom >= 1:
        raise ValueError(f"headroom must be at least 1, got {config.headroom}")
    makers: dict[Align, FeatureMaker] = {}
    for align in search.aligns:
        features = {**config.features, "align": align}
        pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **features)
        makers[align] = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, engine)
    search.groups(pool)  # refuses an empty selection before any work
    _check_physics(limits, rule.bin_ms, makers)
    shop = Workshop(makers, folds[0], search, recipe, config.most_summed, config.num_workers)
    return limits, shop


def _check_physics(limits: Limits, bin_ms: float, makers: dict[Align, FeatureMaker]) -> None:
    """Refuse a deadline that passes before the last sample has come."""
    ahead = min(after for maker in makers.values() for _, after in maker.channel_filter.reaches)
    rate = next(iter(makers.values())).source.sample_rate_hz / 1000
    least = least_latency_ms(bin_ms, limits.hops_ms, ahead / rate)
    if limits.deadline_ms <= least:
        raise ValueError(
            f"deadline_ms={limits.deadline_ms:g} cannot be met: bin {bin_ms:g} ms, shortest hop "
            f"{min(limits.hops_ms):g} ms and least look-ahead {ahead / rate:g} ms are {least:g} ms "
            "before any compute; give more, or a shorter labels.bin_ms or search.hops_ms"
        )


def _chosen(
    config: DictConfig, limits: Limits, shop: Workshop, timed: Sequence[Timed], folder: Path
) -> tuple[dict[str, Any] | None, list[dict[str, Any]]]:
    """The most accurate detector that meets the limits in a fresh process, or none; and the tries.

    Those that meet them with head-room are tried first, then those that just meet them; each as
    fitted to the sample, which takes as long as what is then fitted to all bins and timed again.
    Only that one is kept.
    """
    able: list[tuple[Timed, Latency]] = []
    for headroom in (config.headroom, 1.0):
        tried = [each for each, _ in able]
        for each in sorted((each for each in timed if each not in tried), key=_preferred):
            latency = limits.latency(each.latency, headroom * each.timing.p99_us)
            if not limits.misses(latency):
                able.append((each, latency))
    tries: list[dict[str, Any]] = []
    trial = folder / "trial.pt"
    try:
        for each, wanted in bar(able[: config.tries], "again, in a fresh process", "detector"):
            for from_all in (False, True):
                detector = shop.make(each.candidate, each.arithmetic, from_all=from_all)
                detector.info |= {"experiment": config.name, "seed": config.seed}
                detector.save(trial)
                engine = detector.extractor.engine
                timing = time_in_fresh_process(trial, config.retime_calls, engine)
                latency = replace(wanted, compute_us=timing.p99_us)
                misses = limits.misses(latency)
                fitted = {"fitted_to": detector.info["fitted_to"], "misses": misses}
                tries.append(row_of(shop, each, latency, timing) | fitted)
                if misses:
                    break
            else:
                trial.replace(folder / "detector.pt")
                return tries[-1] | {"test": shop.judged(detector)}, tries
    finally:
        trial.unlink(missing_ok=True)
    return None, tries


def _modelled(candidate: Candidate, scale: float, limits: Limits) -> list[float]:
    """Latency, compute and accuracy as modelled, brought to what was measured."""
    latency = replace(candidate.latency, compute_us=scale * candidate.latency.compute_us)
    latency = shortest_hop(latency, limits.hops_ms)
    return [latency.worst_ms, latency.compute_us, candidate.balanced_accuracy]


def _preferred(timed: Timed) -> tuple[float, bool, float]:
    """The most accurate first; float32 only where it is needed; then the fastest."""
    accuracy = timed.candidate.balanced_accuracy
    return -accuracy, timed.arithmetic != "double", timed.timing.p99_us


def row_of(shop: Workshop, timed: Timed, latency: Latency, timing: Timing) -> dict[str, Any]:
    """A detector of the front as JSON-able facts."""
    candidate, names = timed.candidate, shop.pool.names
    selected = [names[index] for index in candidate.selected]
    return {
        "num_features": len(selected),
        "align": candidate.align,
        "channels": candidate.channels,
        "channels_read": sorted(
            {name.channel for name in selected}, key=shop.pool.hand.names.index
        ),
        "components": candidate.components,
        "ranking": candidate.ranking,
        "degree": candidate.degree,
        "penalty": candidate.penalty,
        "arithmetic": timed.arithmetic,
        "latency": latency.facts(),
        "p50_us": timing.p50_us,
        "p99_us": timing.p99_us,
        "interrupted": timing.interrupted,
        "modelled_us": candidate.latency.compute_us,
        "validation": candidate.balanced_accuracy,
        "validation_by_group": dict(candidate.by_group),
        "selected": [str(name) for name in selected],
    }


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="pareto")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        found = pareto(config, Path(HydraConfig.get().runtime.output_dir))
        if found["chosen"] is None:
            print(none_meets(found), file=sys.stderr)
            raise SystemExit(EXIT_NONE_MEETS)


if __name__ == "__main__":
    run_entry_point(main)
