"""What training costs, cold and warm: ``python -m benchmarks.train [+exp=...]``.

Runs ``python -m tactslip_torch.train`` as a user would, in a process of its own, twice a repeat:
*cold*, with an empty feature cache, and *warm*, with the cache that the cold run left. Seconds of
every stage, and the peak memory of the process and its workers together, sampled every 0.1 s: on
Linux the proportional set size (PSS), elsewhere the unique or the resident one.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import psutil

from benchmarks.harness import Benchmark, Job, say
from benchmarks.tables import Table, by, limits

SOURCES = ("tactslip_torch/commands/train.py",)
KINDS = ("cold", "warm")
LIMITS = {"cold": 300.0, "warm": 90.0}
"""Seconds of the whole process, agreed for 2 cores and ``+exp=unseen4``."""
MOST_GB = 6.0


@dataclass(frozen=True)
class Train(Benchmark):
    """Cold and warm runs of the main job.

    Args:
        overrides: of ``tactslip_torch.train``, before those of the command line.
        repeats: of cold and warm.
        sample_s: between two looks at the memory.
    """

    title = "Training"
    about = "the main job, `python -m tactslip_torch.train`, with an empty and a full feature cache"
    quick = (
        'overrides=[+exp=quick,recipe=paper,recipe.num_features=12,"data.materials=[M1,iron]","split.seen=[M1]",'
        "num_workers=0,baselines=false,export=false] repeats=1 sample_s=1.0"
    )
    charts: ClassVar = {"": [("Stages", ("cold, s", "warm, s"))]}
    overrides: tuple[str, ...] = ("+exp=unseen4",)
    repeats: int = 3
    sample_s: float = 0.1

    def measure(self, job: Job) -> dict[str, Any]:
        """Runs in turns, each pair from an empty cache."""
        overrides = [*self.overrides, *job.overrides]
        runs = []
        for repeat in range(self.repeats):
            with TemporaryDirectory(prefix="tactslip-bench-") as folder:
                for kind in KINDS:
                    say(f"train: repeat {repeat + 1} of {self.repeats}, {kind}")
                    run = _training(overrides, Path(folder), kind, self.sample_s)
                    runs.append({"kind": kind} | run)
        by_kind = {kind: of for (kind,), of in by(runs, "kind").items()}
        walls = {kind: [run["wall_s"] for run in of] for kind, of in by_kind.items()}
        rows = []
        for stage in dict.fromkeys(stage for run in runs for stage in run["stages"]):
            row = {"stage": stage}
            for kind, of in by_kind.items():
                seconds = median(run["stages"].get(stage, 0.0) for run in of)
                row[f"{kind}, s"] = f"{seconds:.2f}"
                row[f"{kind}, %"] = f"{100 * seconds / median(walls[kind]):.1f}"
            rows.append(row)
        totals = [
            {"whole runs": name}
            | {kind: factor * median(run[key] for run in of) for kind, of in by_kind.items()}
            for name, (key, factor) in _TOTALS.items()
        ]
        note = (
            f"`train {' '.join(overrides)}`, medians, repeats: {self.repeats}; "
            f"{runs[0]['num_bins']} bins. *Start-up*: imports, configuration and figures. *Other* "
            "includes the features of training bins, *test* those of test bins. "
            f"Memory is {runs[0]['memory'].upper()}."
        )
        found = {"Stages": Table(rows, note), "Whole runs": Table(totals)}
        if overrides == ["+exp=unseen4"]:
            goals = [(f"{kind}, s, worst", max(walls[kind]), LIMITS[kind], "") for kind in KINDS]
            most = max(run["peak_bytes"] for run in by_kind["cold"]) / 1e9
            goals.append(("cold, peak memory, GB, worst", most, MOST_GB, ""))
            found = {"Limits": limits(goals), **found}
        return {"tables": found, "runs": runs}


_TOTALS = {
    "whole process, s": ("wall_s", 1.0),
    "peak memory, GB": ("peak_bytes", 1e-9),
    "making or reading features, s": ("features_s", 1.0),
    "bins a second of it": ("bins_a_second", 1.0),
}


def _training(overrides: list[str], folder: Path, kind: str, sample_s: float) -> dict[str, Any]:
    """One run in a process of its own, watched from outside.

    Raises:
        RuntimeError: if it fails.
    """
    results, log = folder / kind, folder / f"{kind}.log"
    command = [sys.executable, "-m", "tactslip_torch.train", *overrides]
    command += [f"cache='{folder / 'cache'}'", f"hydra.run.dir='{results}'"]
    peak_bytes, memory = 0, "pss"
    started = time.perf_counter()
    with log.open("wb") as out, subprocess.Popen(command, stdout=out, stderr=out) as process:
        try:
            while process.poll() is None:
                now_bytes, memory = _memory(process.pid, memory)
                peak_bytes = max(peak_bytes, now_bytes)
                time.sleep(sample_s)
        finally:
            process.terminate()
    wall_s = time.perf_counter() - started
    if process.returncode:
        last = log.read_text(errors="replace").splitlines()[-12:]
        raise RuntimeError("\n".join([f"{' '.join(command[1:])} failed; it wrote last:", *last]))
    metrics = json.loads((results / "metrics.json").read_text(encoding="utf-8"))
    timing_s = metrics["timing_s"]
    features_s = timing_s.pop("features")  # which other stages contain
    stages = {name: seconds for name, seconds in timing_s.items() if name != "total"}
    num_bins = sum(scores["num_bins"] for scores in metrics["splits"].values())
    other_s = timing_s["total"] - sum(stages.values())
    return {
        "wall_s": wall_s,
        "peak_bytes": peak_bytes,
        "memory": memory,
        "stages": {"start-up": wall_s - timing_s["total"], **stages, "other": other_s},
        "num_bins": num_bins,
        "features_s": features_s,
        "bins_a_second": num_bins / max(features_s, 1e-9),
    }


def _memory(pid: int, before: str) -> tuple[int, str]:
    """Bytes of a process and all below it, and by which measure; of none that has just ended."""
    found: list[Any] = []
    try:
        process = psutil.Process(pid)
        for one in (process, *process.children(recursive=True)):
            try:
                found.append(one.memory_full_info())
            except psutil.AccessDenied:
                found.append(one.memory_info())
    except psutil.NoSuchProcess:
        return 0, before
    measure = next(n for n in ("pss", "uss", "rss") if all(hasattr(of, n) for of in found))
    return sum(getattr(of, measure) for of in found), measure


if __name__ == "__main__":
    raise SystemExit(Train().run())
