"""Deadline in, model out: ``python -m tactslip_torch pareto deadline_ms=80 compute_us=500``.

Measures what groups of features and pooling cost on this machine; searches features, of channels
and pooled over them, channels, components, filter, head, precision and hop for the front of
worst-case latency and compute against accuracy; times those on the front and close to the limits,
and names three: the most accurate, a cheap one that is hardly worse, and one of few numbers. Those
that meet both limits by that timing are timed again in a fresh process, in order of accuracy, the
last try kept for the one with most head-room; the first that meets both there is written. Leaves
``pareto.json``, ``pareto.png``, the resolved configuration and, last of all, ``detector.pt``. Exit
status 1 if no detector meets the limits; all but the detector is written then.

Only training recordings are searched on. The test cycles of the seen materials evaluate the
detector once it is chosen; of unseen materials nothing is read.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.analysis.latency import (
    DEFINITION,
    CostModel,
    Latency,
    Limits,
    Timing,
    check_hops,
    time_in_fresh_process,
)
from tactslip_torch.analysis.pareto import (
    Candidate,
    Search,
    Searcher,
    Timed,
    Workshop,
    distinct,
    landmarks,
    nondominated,
    worth_naming,
    worth_timing,
)
from tactslip_torch.commands.entry import entry_point
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.report.pareto import none_meets, pareto_figure, pareto_table
from tactslip_torch.runtime import bar, check_number, write_json
from tactslip_torch.signals.filtering import Align
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import (
    common_facts,
    feature_cache,
    feature_parts,
    save_config,
)
from tactslip_torch.training.recipe import Recipe

_EXIT_NONE_MEETS = 1
_EXIT_INTERRUPTED = 130
_VALIDATION = (
    "a material left out at a time, training recordings only; of pooled columns, compression, "
    "ranking and scaling are learned without it; of channel features, ranking and scaling saw the "
    "material left out, the machine alone is refitted; it chose"
)


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
        for name in ("pareto.json", "pareto.png", "detector.pt"):
            (folder / name).unlink(missing_ok=True)  # of an earlier run
        save_config(config, folder)
        shop.look()
        costs = shop.costs()
        recipe, filters = shop.recipe, {a: m.channel_filter for a, m in shop.makers.items()}
        searcher = Searcher(shop.search, recipe, shop.pool, costs, shop.surveys, filters)
        candidates = searcher.candidates()
        if shop.search.drop_fingers:
            keeping = [each for each in candidates if not limits.misses(each.latency)]
            of_channels = [each for each in keeping or candidates if each.columns == "channel"]
            best = max(of_channels or candidates, key=lambda each: each.balanced_accuracy)
            candidates += searcher.without_fingers(best)
        candidates = distinct(candidates)
        worth = worth_timing(candidates, shop.search.most_timed, limits)
        timed = shop.timed(distinct([*worth, *worth_naming(candidates)]))
        trial = folder / "trial.pt"
        try:
            found = _chosen(config, limits, shop, timed, trial)
            found = _facts(config, limits, shop, costs, candidates, timed) | found
            found["seconds"] = time.perf_counter() - started
            write_json(folder / "pareto.json", found)
            pareto_figure(found, folder / "pareto.png")
            if found["chosen"]:
                trial.replace(folder / "detector.pt")
        finally:
            trial.unlink(missing_ok=True)
    print("\n" + pareto_table(found))
    print(f"\nresults in {folder}")
    return found


def _facts(
    config: DictConfig,
    limits: Limits,
    shop: Workshop,
    costs: CostModel,
    candidates: Sequence[Candidate],
    timed: Sequence[Timed],
) -> dict[str, Any]:
    """What was searched and timed, JSON-able."""
    front = [timed[place] for place in nondominated([each.point for each in timed])]
    named = landmarks(sorted(timed, key=_preferred))
    scale = median(each.timing.p99_us / each.candidate.latency.compute_us for each in timed)
    source = next(iter(shop.makers.values())).source
    return common_facts(source, shop.pool, config) | {
        "definition": DEFINITION,
        "limits": {"deadline_ms": limits.deadline_ms, "compute_us": limits.compute_us},
        "headroom": config.headroom,
        "validation": _VALIDATION,
        "backend": next(iter(shop.makers.values())).extractor.backend,
        "front": [row_of(shop, each, limits, each.latency, each.timing) for each in front],
        "named": {
            name: each and row_of(shop, each, limits, each.latency, each.timing)
            for name, each in named.items()
        },
        "timed": len(timed),
        "searched": len(candidates),
        "measured_over_modelled": scale,
        "modelled": [_modelled(each, scale, limits) for each in candidates],
        "costs": costs.to_dict(),
    }


def _prepared(config: DictConfig, cache: FeatureCache) -> tuple[Limits, Workshop]:
    """The parts of the configuration; refuses limits that nothing can keep."""
    search: Search = instantiate(config.search, _convert_="all")
    limits = Limits(config.deadline_ms, config.compute_us, search.hops_ms)
    check_number("headroom", config.headroom, least=1)
    for name in ("retime_calls", "tries"):
        check_number(name, config[name], whole=True)
    check_number("most_summed", config.most_summed, least=0, whole=True)
    rule: LabelRule = instantiate(config.labels)
    recipe: Recipe = instantiate(config.recipe, _convert_="all")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    if len(folds) > 1:
        raise ValueError(f"pareto makes one detector, split has {len(folds)} folds; take another")
    check_hops(search.hops_ms, source.sample_rate_hz)
    makers: dict[Align, FeatureMaker] = {}
    for align in search.aligns:
        features = {**config.features, "align": align}
        pool, channel_filter, dtype, backend = feature_parts(source, rule.bin_ms, **features)
        makers[align] = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, backend)
    search.groups(pool)  # refuses an empty selection before any work
    _check_physics(limits, rule.bin_ms, makers)
    shop = Workshop(makers, folds[0], search, recipe, config.most_summed, config.num_workers)
    return limits, shop


def _check_physics(limits: Limits, bin_ms: float, makers: dict[Align, FeatureMaker]) -> None:
    """Refuse a deadline that passes before the last sample has come."""
    ahead = min(after for maker in makers.values() for _, after in maker.channel_filter.reaches)
    rate = next(iter(makers.values())).source.sample_rate_hz / 1000
    least = Latency(ahead / rate, bin_ms, min(limits.hops_ms), 0.0).worst_ms
    if limits.deadline_ms <= least:
        raise ValueError(
            f"deadline_ms={limits.deadline_ms:g} cannot be met: bin {bin_ms:g} ms, shortest hop "
            f"{min(limits.hops_ms):g} ms and least look-ahead {ahead / rate:g} ms are {least:g} ms "
            "before any compute; give more, or a shorter labels.bin_ms or search.hops_ms"
        )


def _chosen(
    config: DictConfig, limits: Limits, shop: Workshop, timed: Sequence[Timed], trial: Path
) -> dict[str, Any]:
    """The first that meets the limits in a fresh process too, or none; and all tries.

    Each is tried as fitted to the sample, which takes as long as what is then fitted to all bins
    and timed again. Only that one is chosen; it is what ``trial`` then holds.
    """
    able = [
        each
        for each in timed
        if not limits.misses(limits.latency(each.latency, each.timing.p99_us))
    ]
    tries: list[dict[str, Any]] = []
    chosen, tried = None, 0
    for each in bar(_in_turn(able, limits, config.tries), "again, in a fresh process", "detector"):
        tried += 1
        for from_all in (False, True):
            detector = shop.make(each.candidate, each.arithmetic, from_all=from_all)
            detector.info |= {"experiment": config.name, "seed": config.seed}
            detector.save(trial)
            backend = detector.extractor.backend
            timing = time_in_fresh_process(trial, config.retime_calls, backend)
            latency = limits.latency(each.latency, timing.p99_us, config.headroom)
            about = {"fitted_to": detector.info["fitted_to"], "backend": backend}
            tries.append(row_of(shop, each, limits, latency, timing) | about)
            if tries[-1]["misses"]:
                break
        else:
            chosen = tries[-1] | {"test": shop.evaluated(detector)}
            break
    return {"chosen": chosen, "tries": tries, "tried": tried, "not_tried": len(able) - tried}


def _in_turn(able: Sequence[Timed], limits: Limits, tries: int) -> list[Timed]:
    """Those to try: by accuracy, the last of several the one with most head-room of those left."""
    ordered = sorted(able, key=_preferred)
    first = ordered[: tries - 1 if tries > 1 else 1]
    left = ordered[len(first) :]
    if tries > 1 and left:
        first.append(max(left, key=lambda each: limits.headroom(each.latency)))
    return first


def _modelled(candidate: Candidate, scale: float, limits: Limits) -> list[float]:
    """Latency, compute and accuracy as modelled, brought to what was measured."""
    latency = replace(candidate.latency, compute_us=scale * candidate.latency.compute_us)
    latency = latency.with_shortest_hop(limits.hops_ms)
    return [latency.worst_ms, latency.compute_us, candidate.balanced_accuracy]


def _preferred(timed: Timed) -> tuple[float, bool, float]:
    """The most accurate first; float32 only where it is needed; then the fastest."""
    accuracy = timed.candidate.balanced_accuracy
    return -accuracy, timed.arithmetic != "double", timed.timing.p99_us


def row_of(
    shop: Workshop, timed: Timed, limits: Limits, latency: Latency, timing: Timing
) -> dict[str, Any]:
    """A detector as JSON-able facts."""
    candidate, names = timed.candidate, shop.pool.names
    read, layer = [names[index] for index in candidate.selected], candidate.selection.pooling
    return {
        "num_features": candidate.selection.size,
        "features_read": len(read),
        "align": candidate.align,
        "channels": candidate.channels,
        "channels_read": sorted({name.channel for name in read}, key=shop.pool.hand.names.index),
        "components": candidate.components,
        "columns": candidate.columns,
        "ranking": candidate.ranking,
        "degree": candidate.degree,
        "penalty": candidate.penalty,
        "arithmetic": timed.arithmetic,
        "latency": latency.to_dict(),
        "misses": limits.misses(latency),
        "p50_us": timing.p50_us,
        "p99_us": timing.p99_us,
        "graph_p50_us": timed.graph_us,
        "p99_all_us": timing.p99_all_us,
        "interrupted": timing.interrupted,
        "modelled_us": candidate.latency.compute_us,
        "validation": candidate.balanced_accuracy,
        "validation_by_group": dict(candidate.by_group),
        "selected": [str(name) for name in (read if layer is None else layer.names)],
    }


def _pareto_or_exit(config: DictConfig, folder: Path) -> None:
    """As a command: exit status 1 if no detector meets the limits, 130 if interrupted."""
    try:
        found = pareto(config, folder)
    except KeyboardInterrupt:
        print("interrupted: no detector is written", file=sys.stderr)
        raise SystemExit(_EXIT_INTERRUPTED) from None
    if found["chosen"] is None:
        print(none_meets(found), file=sys.stderr)
        raise SystemExit(_EXIT_NONE_MEETS)


main = entry_point("pareto", _pareto_or_exit)

if __name__ == "__main__":
    main()
