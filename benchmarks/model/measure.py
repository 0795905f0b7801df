"""The six measurements of ``benchmarks.model``: seconds, bytes and differences, no judgement.

What is compared is measured in turns in one process. Data is synthetic (``synthetic``).
"""

from __future__ import annotations

import hashlib
import random
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.linalg import blas
from sklearn.kernel_ridge import KernelRidge
from sklearn.svm import SVC
from torch import Tensor

from benchmarks.clocks import in_shuffled_turns, in_turns, on_threads, say
from benchmarks.model.sizes import Sizes
from benchmarks.model.worker import Worker
from tactslip_torch.ledger import content_digest
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import KernelSum, Polynomial, QuadraticForm
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.model.moments import SufficientStats


def size(sizes: Sizes) -> dict[str, Any]:
    """Bytes of the head, and latency over the number of training bins, beside kernel sums."""
    say("size: fitting")
    svc = _svc(sizes).fit(*_numpy(*sizes.source.training(sizes.svc_bins)))
    heads: dict[int, QuadraticForm | KernelSum] = {}
    sums: dict[int, KernelSum] = {}
    for num_bins in sizes.latency_bins:
        z, is_slip = sizes.source.training(num_bins)
        bins = TrainingBins(z, is_slip)
        head = fit_machine(bins, sizes.penalty, sizes.kernel)
        beta = sizes.penalty * (bins.targets - head(z))  # the dual weights, by either route
        sums[num_bins] = KernelSum(z.float(), beta.float(), sizes.kernel)
        heads[num_bins] = head.float()
    latency: dict[str, dict[str, float]] = {}
    for num_scored in (1, sizes.latency_batch):
        say(f"size: latency of {num_scored} at a time")
        z, _ = sizes.source.held_out(num_scored)
        calls: dict[str, Callable[[], object]] = {"svc": partial(svc.decision_function, z.numpy())}
        for num_bins in sizes.latency_bins:
            calls[f"head {num_bins}"] = partial(heads[num_bins], z.float())
            calls[f"sum {num_bins}"] = partial(sums[num_bins], z.float())
        with torch.inference_mode(), on_threads(1):
            latency[str(num_scored)] = in_shuffled_turns(calls, sizes.rounds, sizes.seed)
    rows = [
        {
            "training_bins": num_bins,
            "head_s": {of: seconds[f"head {num_bins}"] for of, seconds in latency.items()},
            "sum_s": {of: seconds[f"sum {num_bins}"] for of, seconds in latency.items()},
            "head_bytes": heads[num_bins].cost.num_bytes,
            "sum_bytes": sums[num_bins].cost.num_bytes,
        }
        for num_bins in sizes.latency_bins
    ]
    svc_row = {
        "training_bins": sizes.svc_bins,
        "support": len(svc.support_),
        "seconds": {of: seconds["svc"] for of, seconds in latency.items()},
    }
    return {"rows": rows, "svc": svc_row}


def accumulation(sizes: Sizes) -> dict[str, Any]:
    """Seconds to add a batch to the statistics, beside bare products of monomials that exist."""
    rows = []
    for num_bins in sizes.update_bins:
        z, is_slip = sizes.source.training(num_bins)
        stats = SufficientStats(sizes.num_features)
        monomials = Polynomial(2, sizes.offset).monomials(z)
        square = torch.zeros(monomials.shape[1], monomials.shape[1], dtype=torch.float64)
        calls: dict[str, Callable[[], Any]] = {
            "update": partial(_update, stats, z, is_slip),
            "dsyrk": partial(_dsyrk, monomials, torch.zeros_like(square)),
            "gemm": partial(square.addmm_, monomials.mT, monomials),
        }
        found = in_turns(calls, sizes.repeats, f"accumulation of {num_bins}")
        rows.append(
            {"batch_bins": num_bins} | {f"{name}_s": taken for name, (taken, _) in found.items()}
        )
    return {"rows": rows}


def fit(sizes: Sizes) -> dict[str, Any]:
    """Seconds of fits to the same bins, and how the machines do on the same held-out bins."""
    z, is_slip = sizes.source.training(sizes.fit_bins)
    test_z, test_is_slip = sizes.source.held_out(sizes.test_bins)
    bins = TrainingBins(z, is_slip)
    ridge = KernelRidge(
        alpha=1 / sizes.penalty, kernel="poly", degree=2, gamma=1, coef0=sizes.offset
    )

    def additive() -> Any:
        stats = SufficientStats(sizes.num_features)
        for part in zip(z.split(sizes.any_batch), is_slip.split(sizes.any_batch), strict=True):
            _update(stats, *part)
        return stats.solve(sizes.penalty, sizes.offset, balance="none")

    calls: dict[str, Callable[[], Any]] = {
        "fit_machine": lambda: fit_machine(bins, sizes.penalty, sizes.kernel),
        "fit_machine, primal": lambda: fit_machine(
            bins, sizes.penalty, sizes.kernel, route="primal"
        ),
        "SufficientStats": additive,
        "KernelRidge": lambda: ridge.fit(z.numpy(), bins.targets.numpy()),
        "SVC": lambda: _svc(sizes).fit(*_numpy(z, is_slip)),
    }
    found = in_turns(calls, sizes.repeats, "fit")
    scores = {
        "KernelRidge": torch.from_numpy(ridge.predict(test_z.numpy())),
        "SVC": torch.from_numpy(found["SVC"][1].decision_function(test_z.numpy())),
    }
    scores |= {name: found[name][1](test_z) for name in calls if name not in scores}
    rows = [
        {
            "name": name,
            "seconds": found[name][0],
            "accuracy": float(((scores[name] >= 0) == test_is_slip).double().mean()),
            "difference": None
            if name == "SVC"
            else float((scores[name] - scores["KernelRidge"]).abs().max()),
        }
        for name in calls
    ]
    return {"num_bins": sizes.fit_bins, "test_bins": sizes.test_bins, "rows": rows}


def folds(sizes: Sizes) -> dict[str, Any]:
    """Seconds of one fit, of fit and folds in closed form, and of refitting every fold."""
    rows = []
    for num_bins in sizes.fold_bins:
        z, is_slip = sizes.source.training(num_bins)
        bins = TrainingBins(z, is_slip)
        groups = torch.arange(num_bins) % sizes.num_folds
        calls: dict[str, Callable[[], Any]] = {
            "fit": partial(fit_machine, bins, sizes.penalty, sizes.kernel),
            "closed": partial(_closed, bins, groups, sizes),
            "refits": partial(_refits, bins, groups, sizes),
        }
        found = in_turns(calls, sizes.repeats, f"folds of {num_bins}")
        difference = (found["closed"][1] - found["refits"][1]).abs().max()
        rows.append(
            {"num_bins": num_bins, "difference": float(difference)}
            | {f"{name}_s": taken for name, (taken, _) in found.items()}
        )
    return {"num_folds": sizes.num_folds, "rows": rows}


def any_size(sizes: Sizes) -> dict[str, Any]:
    """Seconds and peak memory of a process that accumulates bins and solves."""
    say(f"any size: {sizes.any_bins} bins")
    with Worker() as worker:
        worker.start("ready", threads=torch.get_num_threads())
        ready = worker.answer()
        worker.start(
            "any_size",
            bins=sizes.bins,
            num_bins=sizes.any_bins,
            batch_bins=sizes.any_batch,
            penalty=sizes.penalty,
            offset=sizes.offset,
            test_bins=sizes.test_bins,
        )
        return ready | worker.answer()


def workers(sizes: Sizes) -> dict[str, Any]:
    """Seconds of several processes that share bins, and whether they end with the same bits."""
    plans = [(number, number) for number in sizes.processes]
    plans.append((max(sizes.processes), sizes.shards))
    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactslip-bench-")))
        crew = [stack.enter_context(Worker()) for _ in range(max(sizes.processes))]
        for processes, shards in plans:
            say(f"workers: {shards} shards in {processes} processes")
            rows.append(_shared(sizes, crew[:processes], shards, folder))
    bits = [row.pop("bits") for row in rows]
    for row, own in zip(rows, bits, strict=True):
        row["identical"] = {name: own[name] == bits[0][name] for name in own}
    return {"num_bins": sizes.worker_bins, "batch_bins": sizes.worker_batch, "rows": rows}


SECTIONS: dict[str, Callable[[Sizes], dict[str, Any]]] = {
    "size": size,
    "accumulation": accumulation,
    "fit": fit,
    "folds": folds,
    "any_size": any_size,
    "workers": workers,
}


# -------------------------------------------------------------------------------------- parts
def _svc(sizes: Sizes) -> Any:
    return SVC(C=sizes.penalty, kernel="poly", degree=2, gamma=1, coef0=sizes.offset)


def _numpy(z: Tensor, is_slip: Tensor) -> tuple[Any, Any]:
    return z.numpy(), is_slip.numpy()


def _dsyrk(rows: Tensor, total: Tensor) -> None:
    """``total += rows' rows`` in one triangle, in place, by the bare routine of BLAS."""
    seen = total.numpy().T  # column-major without a copy, as are the rows
    after = blas.dsyrk(1.0, rows.numpy().T, beta=1.0, c=seen, overwrite_c=1)
    if not np.shares_memory(after, seen):
        raise RuntimeError("dsyrk copied its matrix; its seconds would count that")


def _update(stats: SufficientStats, z: Tensor, is_slip: Tensor) -> None:
    """Add a batch under a name of its own."""
    stats.update(f"batch {len(stats.ledger)}", z, is_slip)


def _closed(bins: TrainingBins, groups: Tensor, sizes: Sizes) -> Tensor:
    """Held-out scores in closed form, with the fit of all bins on the way."""
    return HeldOut(bins, groups, sizes.kernel).at(sizes.penalty).scores


def _refits(bins: TrainingBins, groups: Tensor, sizes: Sizes) -> Tensor:
    """Held-out scores by brute force."""
    scores = torch.empty_like(bins.targets)
    for group in groups.unique():
        rest = groups != group
        part = TrainingBins(bins.features[rest], bins.is_slip[rest])
        scores[~rest] = fit_machine(part, sizes.penalty, sizes.kernel)(bins.features[~rest])
    return scores


def _shared(sizes: Sizes, crew: Sequence[Worker], shards: int, folder: Path) -> dict[str, Any]:
    """One run of several processes, with the bits of what came out."""
    for worker in crew:
        worker.start("ready", threads=max(1, torch.get_num_threads() // len(crew)))
    for worker in crew:
        worker.answer()
    paths = [folder / f"{shards}-{part}.stats" for part in range(shards)]
    started = time.perf_counter()
    job = {"bins": sizes.bins, "num_bins": sizes.worker_bins, "batch_bins": sizes.worker_batch}
    for part, path in enumerate(paths):  # in turns, as a worker takes its jobs in order
        crew[part % len(crew)].start("shard", **job, part=part, parts=shards, path=str(path))
    for part in range(shards):
        crew[part % len(crew)].answer()
    collected = time.perf_counter()
    random.Random(sizes.seed).shuffle(paths)
    stats = SufficientStats.load(paths[0])
    for path in paths[1:]:
        stats.merge(SufficientStats.load(path))
    merged = time.perf_counter()
    whole = folder / f"{shards}.stats"
    stats.save(whole)
    head = stats.solve(sizes.penalty, sizes.offset, balance="none")
    return {
        "processes": len(crew),
        "shards": shards,
        "collect_s": collected - started,
        "merge_s": merged - collected,
        "bits": {
            "statistics": hashlib.sha256(whole.read_bytes()).hexdigest(),
            "detector": content_digest(head.quadratic, head.linear, head.constant),
        },
    }
