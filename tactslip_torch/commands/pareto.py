"""Deadline in, model out: ``python -m tactslip_torch pareto deadline_ms=80 compute_us=500``.

Measures what groups of features and pooling cost on this machine; searches features, of channels
and pooled over them, channels, components, filter, head, precision and hop for the front of
worst-case latency and compute against accuracy; times those on the front and close to the limits,
and names three: the most accurate, a cheap one that is hardly worse, and one of few numbers. Those
that meet both limits by that timing are timed again in a fresh process, in order of accuracy, the
last try kept for the one with most headroom; the first that meets both there is written. Leaves
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
    Latency,
    Limits,
    time_in_fresh_process,
)
from tactslip_torch.analysis.old.recipe import of_recipe
from tactslip_torch.analysis.pareto import (
    Candidate,
    ParetoSearch,
    Search,
    distinct,
    landmarks,
    nondominated,
    worth_naming,
    worth_timing,
)
from tactslip_torch.commands.entry import entry_point, leave_results, save_config
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.report.pareto import none_meets, pareto_figure, pareto_table
from tactslip_torch.runtime import bar, check_number
from tactslip_torch.signals.filtering import Align
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import common_metadata, feature_cache, feature_maker

_EXIT_NONE_MEETS = 1
_TIMES = ("p50_us", "p99_us", "p99_all_us", "interrupted")
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
        limits, search = _prepared(config, cache)
        for name in ("pareto.json", "pareto.png", "detector.pt"):
            (folder / name).unlink(missing_ok=True)  # of an earlier run
        save_config(config, folder)
        search.read()
        candidates = search.candidates()
        if search.search.drop_fingers:
            keeping = [each for each in candidates if not limits.misses(each.latency)]
            of_channels = [each for each in keeping or candidates if each.columns == "channel"]
            best = max(of_channels or candidates, key=lambda each: each.balanced_accuracy)
            candidates += search.without_fingers(best)
        candidates = distinct(candidates)
        worth = worth_timing(candidates, search.search.most_timed, limits)
        timed = search.timed(distinct([*worth, *worth_naming(candidates)]))
        timed.sort(key=_preference)
        trial = folder / "trial.pt"
        try:
            found = common_metadata(next(iter(search.makers.values())), config)
            found |= _searched(limits, search, candidates, timed)
            found |= {"headroom": config.headroom} | _chosen(config, limits, search, timed, trial)
            found["seconds"] = time.perf_counter() - started
            leave_results(folder, "pareto", found, pareto_figure, pareto_table(found))
            if found["chosen"]:
                trial.replace(folder / "detector.pt")
        finally:
            trial.unlink(missing_ok=True)
    return found


def _prepared(config: DictConfig, cache: FeatureCache) -> tuple[Limits, ParetoSearch]:
    """What the configuration describes; refuses limits that nothing can keep."""
    settings: Search = instantiate(config.search, _convert_="all")
    limits = Limits(config.deadline_ms, config.compute_us, settings.hops_ms)
    check_number("headroom", config.headroom, least=1)
    for name in ("retime_calls", "tries"):
        check_number(name, config[name], whole=True)
    check_number("most_summed", config.most_summed, least=0, whole=True)
    rule: LabelRule = instantiate(config.labels)
    recipe = of_recipe(instantiate(config.recipe, _convert_="all"))
    source: RecordingSource = instantiate(config.data, _convert_="all")
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    if len(folds) > 1:
        raise ValueError(f"pareto makes one detector, split has {len(folds)} folds; take another")
    limits.check_hops(source.sample_rate_hz)
    makers: dict[Align, FeatureMaker] = {}
    for align in settings.aligns:
        features = {**config.features, "align": align}
        makers[align] = feature_maker(source, rule, **features)
        makers[align].cache = cache
    ahead = min(after for maker in makers.values() for _, after in maker.channel_filter.reaches)
    ahead_ms, hop_ms = 1000 * ahead / source.sample_rate_hz, min(limits.hops_ms)
    least = Latency(ahead_ms, rule.bin_ms, hop_ms, 0.0).worst_ms
    if limits.deadline_ms <= least:
        raise ValueError(
            f"deadline_ms={limits.deadline_ms:g} cannot be met: bin {rule.bin_ms:g} ms, shortest "
            f"hop {hop_ms:g} ms and least look-ahead {ahead_ms:g} ms are {least:g} ms before any "
            "compute; give more, or a shorter labels.bin_ms or search.hops_ms"
        )
    return limits, ParetoSearch(
        makers, folds[0], settings, recipe, config.most_summed, config.num_workers
    )


def _searched(
    limits: Limits,
    search: ParetoSearch,
    candidates: Sequence[Candidate],
    timed: Sequence[Candidate],
) -> dict[str, Any]:
    """What was searched and timed, JSON-able."""
    scale = median(each.latency.compute_us / each.modelled_us for each in timed)
    modelled = []  # brought to what was measured
    for each in candidates:
        latency = replace(each.latency, compute_us=scale * each.latency.compute_us)
        latency = latency.with_shortest_hop(limits.hops_ms)
        modelled.append([latency.worst_ms, latency.compute_us, each.balanced_accuracy])
    return {
        "definition": DEFINITION,
        "limits": {"deadline_ms": limits.deadline_ms, "compute_us": limits.compute_us},
        "validation": _VALIDATION,
        "backend": search.backend,
        "front": [
            _row(search, timed[place], limits)
            for place in nondominated([each.point for each in timed])
        ],
        "named": {
            name: each and _row(search, each, limits) for name, each in landmarks(timed).items()
        },
        "timed": len(timed),
        "searched": len(candidates),
        "measured_over_modelled": scale,
        "modelled": modelled,
        "costs": search.costs.to_dict(),
    }


def _chosen(
    config: DictConfig,
    limits: Limits,
    search: ParetoSearch,
    timed: Sequence[Candidate],
    trial: Path,
) -> dict[str, Any]:
    """The first that meets the limits in a fresh process too, or none; and all tries.

    Each is tried as fitted to the sample, which takes as long as what is then fitted to all bins
    and timed again. Only that one is chosen; it is what ``trial`` then holds.
    """
    able = [
        each
        for each in timed
        if not limits.misses(limits.latency(each.latency, each.latency.compute_us))
    ]
    rows: list[dict[str, Any]] = []
    tries = _tries(able, limits, config.tries)
    for tried, each in enumerate(bar(tries, "again, in a fresh process", "detector"), 1):
        for from_all in (False, True):
            detector = search.make(each, from_all=from_all)
            detector.info |= {"experiment": config.name, "seed": config.seed}
            detector.save(trial)
            backend = detector.extractor.backend
            timing = time_in_fresh_process(trial, config.retime_calls, backend)
            latency = limits.latency(each.latency, timing.p99_us, config.headroom)
            row = _row(search, replace(each, latency=latency, timing=timing), limits)
            rows.append(row | {"fitted_to": detector.info["fitted_to"], "backend": backend})
            if rows[-1]["misses"]:
                break
        else:
            chosen = rows[-1] | {"test": search.evaluated(detector)}
            counts = {"tried": tried, "not_tried": len(able) - tried}
            return {"chosen": chosen, "tries": rows} | counts
    counts = {"tried": len(tries), "not_tried": len(able) - len(tries)}
    return {"chosen": None, "tries": rows} | counts


def _tries(able: Sequence[Candidate], limits: Limits, most: int) -> list[Candidate]:
    """The first of those to try; the last of several is the one with most headroom of the rest."""
    first, left = list(able[: max(most - 1, 1)]), able[max(most - 1, 1) :]
    if most > 1 and left:
        first.append(max(left, key=lambda each: limits.headroom(each.latency)))
    return first


def _preference(timed: Candidate) -> tuple[float, bool, float]:
    """The most accurate first; float32 only where it is needed; then the fastest."""
    return -timed.balanced_accuracy, timed.arithmetic != "double", timed.latency.compute_us


def _row(search: ParetoSearch, timed: Candidate, limits: Limits) -> dict[str, Any]:
    """A detector, JSON-able."""
    names, layer = search.pool.names, timed.selection.pooling
    read = [names[index] for index in timed.selected]
    return {
        "num_features": timed.selection.size,
        "features_read": len(read),
        **{name: getattr(timed.group, name) for name in ("align", "channels", "components")},
        "channels_read": sorted(
            {name.channel for name in read}, key=search.source.hand.names.index
        ),
        **{name: getattr(timed, name) for name in ("columns", "ranking", "degree", "penalty")},
        "arithmetic": timed.arithmetic,
        "latency": timed.latency.to_dict(),
        "misses": limits.misses(timed.latency),
        **{name: getattr(timed.timing, name) for name in _TIMES},
        "graph_p50_us": timed.graph_us,
        "modelled_us": timed.modelled_us,
        "validation": timed.balanced_accuracy,
        "validation_by_group": dict(timed.by_group),
        "selected": [str(name) for name in (read if layer is None else layer.names)],
    }


def _pareto_or_exit(config: DictConfig, folder: Path) -> None:
    """As a command: exit status 1 if no detector meets the limits."""
    found = pareto(config, folder)
    if found["chosen"] is None:
        print(none_meets(found), file=sys.stderr)
        raise SystemExit(_EXIT_NONE_MEETS)


main = entry_point("pareto", _pareto_or_exit)
