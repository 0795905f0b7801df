"""The kernel machine beside scikit-learn: ``python -m benchmarks.model``.

Fits, scoring and folds in closed form on synthetic features, beside ``KernelRidge``, ``SVC`` and
refitting every fold; and a fit by statistics of any number of bins, in a process of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from sklearn.kernel_ridge import KernelRidge
from sklearn.svm import SVC
from torch import Tensor

from benchmarks.harness import Benchmark, Job, say
from benchmarks.tables import Table, listed, number, percent
from benchmarks.timing import in_fresh_process, interleaved, on_threads, peak_bytes, timed
from tactslip_torch import SufficientStats
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial

PENALTY, OFFSET, BATCH = 1.0, 0.5, 4096
KERNEL = Polynomial(2, OFFSET)


@dataclass(frozen=True)
class Model(Benchmark):
    """Fits, scores, folds and statistics.

    Args:
        num_features: K.
        fitted: training bins of a fit.
        test_bins: whose scores are compared.
        folded: training bins of fits and folds.
        num_folds: of them.
        any_bins: accumulated in a process of its own.
        rounds: of every call.
        threads: of fits; scoring has one.
    """

    title = "Kernel machine at any size"
    about = "the kernel machine of degree 2 on synthetic features, beside scikit-learn"
    charts: ClassVar = {"": (("Fits", "fit, s"), ("Fits", "a score, us"))}
    quick = "num_features=12 fitted=[200] test_bins=100 folded=240 any_bins=10000 rounds=1"
    is_simulated = False
    num_features: int = 120
    fitted: tuple[int, ...] = (2_000, 8_000)
    test_bins: int = 4_000
    folded: int = 4_800
    num_folds: int = 6
    any_bins: int = 200_000
    rounds: int = 3
    threads: int = 2

    def measure(self, job: Job) -> dict[str, Any]:
        """Fits and scores by size, folds, and any number of bins."""
        with on_threads(self.threads):
            fits = [row for num_bins in self.fitted for row in _fits(num_bins, self)]
            folds, off = _folds(self)
        say(f"model: statistics of {self.any_bins:,} bins in a fresh process")
        given = {"num_bins": self.any_bins, "num_features": self.num_features}
        of = in_fresh_process("benchmarks.model:accumulate", threads=self.threads, **given)
        whole = {
            "bins": f"{self.any_bins:,}",
            "bins a second": f"{self.any_bins / of['add_s']:,.0f}",
            "s to solve": of["solve_s"],
            "peak memory, MB": f"{of['peak_bytes'] / 1e6:,.0f}",
        }
        note = (
            "*A score*: of one bin, on 1 thread. *Off KernelRidge*: the largest difference of "
            "scores."
        )
        return {
            "tables": {
                "Fits": Table(fits, note),
                "Folds": Table(
                    folds, f"Largest difference between closed form and refits: {number(off)}."
                ),
                "Any number of bins": listed("statistics in a process of its own", whole),
            }
        }


def synthetic_bins(num_bins: int, num_features: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Bounded, correlated features ``[N, K]`` in float64, and labels ``[N]`` by a quadratic rule.

    They are correlated about as the main job's scaled features are; noise mislabels some bins.
    """
    rule = np.random.default_rng(num_features)
    mix = 0.25 * rule.normal(size=(16, num_features)) * np.arange(1.0, 17)[:, None] ** -0.7
    directions = rule.normal(size=(3, num_features)) / np.sqrt(num_features)
    draws = np.random.default_rng([seed, 1])
    common = draws.normal(size=(num_bins, 16)) @ mix
    z = np.tanh(common + 0.15 * draws.normal(size=(num_bins, num_features)))
    a, b, c = directions @ z.T / (directions @ z.T).std(1, keepdims=True)
    score = a * b + c + 0.3 * draws.normal(size=num_bins)
    return torch.from_numpy(z), torch.from_numpy(score > 0)


def accumulate(num_bins: int, num_features: int, threads: int) -> dict[str, float]:
    """Seconds and memory of statistics of so many bins, and of their solution."""
    torch.set_num_threads(threads)
    stats = SufficientStats(num_features)
    z, is_slip = synthetic_bins(BATCH, num_features)

    def add() -> None:
        for batch in range(-(-num_bins // BATCH)):
            stats.update(f"batch {batch}", z, is_slip)

    add_s, _ = timed(add)
    solve_s, _ = timed(lambda: stats.solve(PENALTY, OFFSET, balance="none"))
    return {"add_s": add_s, "solve_s": solve_s, "peak_bytes": float(peak_bytes())}


def _fits(num_bins: int, sizes: Model) -> list[dict[str, Any]]:
    say(f"model: fits to {num_bins:,} bins")
    z, is_slip = synthetic_bins(num_bins, sizes.num_features)
    new, truth = synthetic_bins(sizes.test_bins, sizes.num_features, seed=1)
    bins = TrainingBins(z, is_slip)
    targets = bins.targets.numpy()
    options = {"kernel": "poly", "degree": 2, "gamma": 1.0, "coef0": OFFSET}
    ridge, svc = KernelRidge(alpha=1 / PENALTY, **options), SVC(C=PENALTY, **options)

    def by_statistics() -> Any:
        stats = SufficientStats(sizes.num_features)
        for place, some in enumerate(torch.arange(num_bins).split(BATCH)):
            stats.update(f"batch {place}", z[some], is_slip[some])
        return stats.solve(PENALTY, OFFSET, balance="none")

    calls: dict[str, Callable[[], Any]] = {
        "fit_machine": partial(fit_machine, bins, PENALTY, KERNEL),
        "SufficientStats": by_statistics,
        "KernelRidge": partial(ridge.fit, z.numpy(), targets),
        "SVC": partial(svc.fit, z.numpy(), targets),
    }
    fits = interleaved(calls, sizes.rounds, block_s=0)
    head = fit_machine(bins, PENALTY, KERNEL)
    beta = PENALTY * (bins.targets - head(z))
    scorers: dict[str, Callable[[Tensor], Any]] = {
        "fit_machine": head,
        "SufficientStats": by_statistics(),
        "KernelRidge": lambda x: ridge.predict(x.numpy()),
        "SVC": lambda x: svc.decision_function(x.numpy()),
        "kernel sum": lambda x: KERNEL(x, z) @ beta,
    }
    one = new[:1].clone()
    with torch.inference_mode(), on_threads(1):
        times = interleaved({n: partial(of, one) for n, of in scorers.items()}, 20 * sizes.rounds)
    exact = np.asarray(scorers["KernelRidge"](new))
    rows = []
    for way, scorer in scorers.items():
        scores = np.asarray(scorer(new))
        rows.append(
            {
                "machine": f"{way}, {num_bins:,} bins",
                "fit, s": fits[way if way in fits else "fit_machine"]["seconds"],
                "a score, us": 1e6 * times[way]["p50_s"],
                "accuracy %": percent(float(((scores >= 0) == truth.numpy()).mean())),
                "off KernelRidge": None if way == "SVC" else float(np.abs(scores - exact).max()),
            }
        )
    return rows


def _folds(sizes: Model) -> tuple[list[dict[str, Any]], float]:
    say(f"model: {sizes.num_folds} folds of {sizes.folded:,} bins")
    z, is_slip = synthetic_bins(sizes.folded, sizes.num_features)
    groups = torch.arange(len(z)) % sizes.num_folds

    def refits() -> Tensor:
        scores = torch.empty(len(z), dtype=torch.float64)
        for group in groups.unique():
            rest = groups != group
            head = fit_machine(TrainingBins(z[rest], is_slip[rest]), PENALTY, KERNEL)
            scores[~rest] = head(z[~rest])
        return scores

    bins = TrainingBins(z, is_slip)
    calls: dict[str, Callable[[], Any]] = {
        "one fit": partial(fit_machine, bins, PENALTY, KERNEL),
        "fit and folds in closed form": lambda: HeldOut(bins, groups, KERNEL).at(PENALTY),
        "refits": refits,
    }
    timings = interleaved(calls, sizes.rounds, block_s=0)
    off = (calls["fit and folds in closed form"]() - refits()).abs().max()
    return [{"folds": way, "s": of["seconds"]} for way, of in timings.items()], float(off)


if __name__ == "__main__":
    raise SystemExit(Model().run())
