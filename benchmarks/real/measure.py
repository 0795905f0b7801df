"""Every method on every fold, in one run: scores of windows of objects left out, and times."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from benchmarks.harness import interleaved, on_threads, paired_ratio
from benchmarks.peers.rockets import MINI_ROCKET, MULTI_ROCKET_HYDRA
from benchmarks.real.baselines import same_features, simple_baselines
from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.ours import ours, pool_rows
from benchmarks.real.rocket import rocket
from benchmarks.real.sizes import Sizes
from benchmarks.real.windows import Array, Windows
from tactslip_torch.data.splits import Split
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.runtime import bar
from tactslip_torch.training.recipe import Recipe


@dataclass(eq=False)
class Found:
    """What the folds of one method gave.

    Attributes:
        method: which.
        scores: ``[N]``, of every window by the fold that left its object out.
        fit_s: seconds of each fold's fit, with describing its training windows.
        chosen: by each fold.
        last: what the last fold fitted, for the clock.
    """

    method: Method
    scores: Array
    fit_s: list[float] = field(default_factory=list)
    chosen: list[Mapping[str, Any]] = field(default_factory=list)
    last: Fitted | None = None


def methods_of(windows: Windows, recipes: Sequence[Recipe], sizes: Sizes) -> list[Method]:
    """All methods, ours first, with their rows."""
    pool = pool_rows(windows)
    detectors: dict[tuple[str, ...], SlipDetector] = {}
    first, *others = recipes
    return [
        ours(windows, first, *pool, detectors),
        *(ours(windows, recipe, *pool) for recipe in others),
        same_features(*pool, detectors, sizes),
        *simple_baselines(windows.samples, sizes),
        *(rocket(windows, MINI_ROCKET, seed, sizes) for seed in sizes.rocket_seeds),
        rocket(windows, MULTI_ROCKET_HYDRA, sizes.rocket_seeds[0], sizes),
    ]


def on_folds(
    windows: Windows, folds: Sequence[Split], methods: Sequence[Method]
) -> dict[str, Found]:
    """Fit every method to the training windows of every fold, and score the others.

    Raises:
        ValueError: if a window is left out by no fold or by two, or a score is not finite.
    """
    times_judged = np.sum([windows.of(fold.having("unseen")) for fold in folds], axis=0)
    if (times_judged != 1).any():
        raise ValueError(
            "each window must be left out by one fold; take split=leave_one_material_out"
        )
    found = {m.name: Found(m, np.full(len(windows.is_slip), np.nan)) for m in methods}
    for number in bar(range(len(folds) * len(methods)), "fits, fold by fold", "fit"):
        fold, method = folds[number // len(methods)], methods[number % len(methods)]
        held, train = windows.of(fold.having("unseen")), windows.of(fold.having("train"))
        of = found[method.name]
        every = (method.rows, windows.is_slip, windows.objects, windows.recording)
        started = time.perf_counter()
        fitted = method.fit(Training(*(part[train] for part in every)))
        of.fit_s.append(time.perf_counter() - started + method.rows_s * int(train.sum()))
        of.scores[held] = fitted.decide(method.rows[held])
        of.chosen.append(fitted.chosen)
        of.last = fitted
    for name, of in found.items():
        if not np.isfinite(of.scores).all():
            raise ValueError(f"{name} gave scores that are not finite")
    return found


def clocked(
    windows: Windows, found: Mapping[str, Found], names: Sequence[str], beside: str, sizes: Sizes
) -> dict[str, Any]:
    """From a window to its score on one thread, all methods in turns; by method, JSON-able.

    Args:
        windows: all.
        found: of ``on_folds``.
        names: whom to time.
        beside: whose time the others' is compared with.
        sizes: how many windows and rounds.

    Returns:
        ``batch``, how many windows at once, ``batched_s`` and ``alone_s`` for one window,
        ``batched_times_faster`` and ``alone_times_faster`` than ``beside`` with quartiles of the
        rounds, and ``differs``, how far the timed scores are from those that are judged.
    """
    calls: dict[str, Callable[[], object]] = {}
    counts, differs = {}, {}
    for name in names:
        of = found[name]
        assert of.last is not None  # on_folds
        counts[name] = min(sizes.batch, len(of.scores))
        batch = windows.samples[-counts[name] :].copy()
        wanted = of.last.decide(of.method.rows[-counts[name] :])
        differs[name] = float(np.abs(of.last.judge(batch) - wanted).max())
        calls[f"{name}, batched"] = partial(of.last.judge, batch)
        calls[f"{name}, alone"] = partial(of.last.judge, batch[-1:].copy())
    with on_threads(1):
        timings = interleaved(calls, sizes.rounds)
    rounds = {name: of.per_round for name, of in timings.items()}
    rows: dict[str, Any] = {}
    for name in names:
        rows[name] = {"batch": counts[name], "differs": differs[name]}
        for how in ("batched", "alone"):
            mine, other = (
                [s / (counts[of] if how == "batched" else 1) for s in rounds[f"{of}, {how}"]]
                for of in (name, beside)
            )
            rows[name][f"{how}_s"] = median(mine)
            rows[name][f"{how}_times_faster"] = paired_ratio(other, mine)._asdict()
    return rows
