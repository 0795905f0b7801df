"""What training costs: ``python -m benchmarks.train [--quick]``.

Runs ``python -m tactslip_torch.train +exp=...`` as a user would, in a process of its own, twice per
repeat: *cold*, with an empty feature cache, and *warm*, with the cache that the cold run left.
Prints the seconds and the share of every stage, the peak memory, and the limits the project has
set itself. Nothing is left behind but the file of ``--json``.

Memory is sampled every 0.1 s over the process and all its workers: on Linux the proportional set
size (PSS), which divides a page among those who share it, so that what forked workers share counts
once; elsewhere the unique set size (USS); where neither may be read, the resident size (RSS).
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from benchmarks.machine import machine_facts
from benchmarks.outcome import refuse_paths
from tactslip_torch.report.style import SIMULATED_LINE
from tactslip_torch.runtime import whole_file

try:
    import psutil
except ImportError:  # main says how to get it
    psutil = None

KINDS = ("cold", "warm")
SAMPLE_S = 0.1
TAIL_LINES = 12
EXIT_FAILED, EXIT_NO_PSUTIL, EXIT_INTERRUPTED = 1, 2, 130
MEMORY_NAMES = {"pss": "PSS", "uss": "USS", "rss": "RSS, shared memory counted repeatedly"}
# as agreed for 2 cores: experiment, kind of run, quantity, most
LIMITS = (
    ("unseen4", "cold", "wall_s", 300.0),
    ("unseen4", "cold", "peak_memory_gb", 6.0),
    ("unseen4", "warm", "wall_s", 90.0),
    ("quick", "cold", "wall_s", 20.0),
)


class RunFailedError(RuntimeError):
    """A training run did not end well; the message holds the last lines it wrote."""


class TrainingRun(NamedTuple):
    """One run of ``tactslip_torch.train``, watched from outside.

    Attributes:
        kind: ``"cold"`` or ``"warm"``.
        wall_s: from starting the process to its end.
        peak_bytes: most memory of the process and its workers together.
        memory: how that was measured: ``"pss"``, ``"uss"`` or ``"rss"``.
        metrics: the content of ``metrics.json``.
        num_recordings: how many the cache holds after it.
    """

    kind: str
    wall_s: float
    peak_bytes: int
    memory: str
    metrics: dict[str, Any]
    num_recordings: int


# ------------------------------------------------------------------------------------- numbers
def stage_seconds(wall_s: float, timing_s: Mapping[str, float]) -> dict[str, float]:
    """Seconds of each stage of a process, which add up to ``wall_s``.

    ``start-up`` is what the process needs before and after its own clock runs: imports,
    configuration, and at the end figures. ``other`` is what no stage claims.

    Args:
        wall_s: of the whole process.
        timing_s: by stage, and their ``total``, from ``metrics.json``.
    """
    stages = {name: seconds for name, seconds in timing_s.items() if name != "total"}
    startup = wall_s - timing_s["total"]
    return {"start-up": startup, **stages, "other": timing_s["total"] - sum(stages.values())}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, least and most of the repeats."""
    return {"median": median(values), "min": min(values), "max": max(values)}


def with_shares(repeats: Sequence[Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Spread of each stage over the repeats, and its share of the sum of medians, in percent.

    A stage that a repeat does not have took no time in it.

    Args:
        repeats: seconds by stage.
    """
    names = dict.fromkeys(name for seconds in repeats for name in seconds)
    spreads = {name: spread([seconds.get(name, 0.0) for seconds in repeats]) for name in names}
    whole = sum(of["median"] for of in spreads.values())
    share = 100 / whole if whole else 0.0
    return {name: {**of, "share_percent": share * of["median"]} for name, of in spreads.items()}


def stage_rows(
    cold: Sequence[Mapping[str, float]], warm: Sequence[Mapping[str, float]]
) -> list[dict[str, Any]]:
    """One row per stage with its cold and warm side; a side that lacks the stage is ``None``.

    Args:
        cold: seconds by stage, one mapping per repeat.
        warm: likewise.
    """
    sides = {"cold": with_shares(cold), "warm": with_shares(warm)}
    names = dict.fromkeys(name for side in sides.values() for name in side)
    return [{"stage": name} | {kind: sides[kind].get(name) for kind in KINDS} for name in names]


def num_bins(metrics: Mapping[str, Any]) -> int:
    """Bins of the whole set; of a leave-one-out run, as one of its folds has them."""
    one = next(iter(metrics["folds"].values())) if metrics.get("folds") else metrics
    return sum(scores["num_bins"] for scores in one["splits"].values())


def rates(run: TrainingRun) -> dict[str, float]:
    """Bins and recordings of the set, each counted once, per second of all passes over it."""
    timing_s = run.metrics["timing_s"]
    seconds = sum(timing_s[name] for name in timing_s if name.endswith("_pass"))
    if not seconds:
        return {}
    found = {"bins/s": num_bins(run.metrics) / seconds}
    if run.num_recordings:
        found["recordings/s"] = run.num_recordings / seconds
    return found


def quantities(runs: Sequence[TrainingRun]) -> dict[str, dict[str, float]]:
    """Spread over the repeats of what is measured of a run as a whole."""
    measured = [
        {
            "wall_s": run.wall_s,
            "peak_memory_gb": run.peak_bytes / 1e9,
            "worker_s": sum(run.metrics["worker_s"].values()),
            **rates(run),
        }
        for run in runs
    ]
    return {name: spread([of[name] for of in measured]) for name in measured[0]}


def limit_rows(
    experiment: str, wholes: Mapping[str, Mapping[str, Mapping[str, float]]]
) -> list[dict[str, Any]]:
    """The limits of an experiment beside the worst of its repeats, and whether they hold.

    Args:
        experiment: its name; most have no limits.
        wholes: kind of run to its ``quantities``.
    """
    rows = []
    for name, kind, quantity, most in LIMITS:
        if name == experiment:
            worst = wholes[kind][quantity]["max"]
            row = {"run": kind, "quantity": quantity, "measured": worst, "limit": most}
            rows.append(row | {"ok": worst < most})
    return rows


def summary(
    experiment: str, runs: Sequence[TrainingRun], machine: Mapping[str, str]
) -> dict[str, Any]:
    """Everything the tables show, JSON-able.

    Args:
        experiment: its name.
        runs: as many cold as warm ones.
        machine: from ``machine_facts``, taken before the runs.
    """
    by_kind = {kind: [run for run in runs if run.kind == kind] for kind in KINDS}
    stages = [
        [stage_seconds(run.wall_s, run.metrics["timing_s"]) for run in by_kind[kind]]
        for kind in KINDS
    ]
    workers = [[run.metrics["worker_s"] for run in by_kind[kind]] for kind in KINDS]
    wholes = {kind: quantities(by_kind[kind]) for kind in KINDS}
    metrics = runs[0].metrics
    return {
        "simulated": metrics["simulated"],
        "experiment": experiment,
        "repeats": len(by_kind["cold"]),
        "machine": dict(machine),
        "versions": {"python": platform.python_version(), **metrics["versions"]},
        "memory": runs[0].memory,
        "num_recordings": runs[0].num_recordings,
        "num_bins": num_bins(metrics),
        "stages": stage_rows(*stages),
        "worker_stages": stage_rows(*workers),
        "wholes": wholes,
        "warm_over_cold": wholes["warm"]["wall_s"]["median"] / wholes["cold"]["wall_s"]["median"],
        "limits": limit_rows(experiment, wholes),
    }


# -------------------------------------------------------------------------------------- tables
def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: from ``summary``.
    """
    parts = [_heading(report), _stage_table(report), _worker_table(report)]
    return "\n\n".join([*parts, _rate_table(report), _limit_table(report)])


def _heading(report: Mapping[str, Any]) -> str:
    repeats = report["repeats"]
    over = "" if repeats == 1 else f", medians of {repeats} repeats"
    versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    lines = [
        f"tactslip_torch.train +exp={report['experiment']}: cold and warm feature cache{over}",
        f"machine   {', '.join(report['machine'].values())}",
        f"versions  {versions}",
    ]
    return "\n".join([*lines, *([SIMULATED_LINE] if report["simulated"] else [])])


def _stage_table(report: Mapping[str, Any]) -> str:
    """Stages of the process, its total, and its memory."""
    ranged = report["repeats"] > 1
    totals = [
        ["process total", *_cells(_whole(report, "wall_s"), ranged, share="100.0")],
        ["peak memory, GB", *_cells(_whole(report, "peak_memory_gb"), ranged, share="")],
    ]
    note = f"memory: {MEMORY_NAMES[report['memory']]} of the process and its workers, every 0.1 s"
    return f"{_cost_table('stage', report['stages'], totals, ranged)}\n{note}"


def _worker_table(report: Mapping[str, Any]) -> str:
    """Stages inside the workers, and a word if a warm run had to do the work of a cold one."""
    rows, ranged = report["worker_stages"], report["repeats"] > 1
    total = ["all workers", *_cells(_whole(report, "worker_s"), ranged, share="100.0")]
    table = _cost_table("in workers", rows, [total], ranged)
    note = "seconds summed over workers, part of the passes above"
    again = [row["stage"] for row in rows if row["warm"] and row["stage"] in ("simulate", "read")]
    if again:
        note += "\nNOT WARM: features were made again; did the code change between the runs?"
    return f"{table}\n{note}"


def _rate_table(report: Mapping[str, Any]) -> str:
    """Throughput and what the cache is worth."""
    cold, warm = (report["wholes"][kind] for kind in KINDS)
    names = [name for name in cold if name.endswith("/s")]
    rows = [[name, *(f"{side[name]['median']:.1f}" for side in (cold, warm))] for name in names]
    ratio = report["warm_over_cold"]
    table = _aligned(["throughput", *KINDS], rows)
    size = f"{report['num_recordings']} recordings, {report['num_bins']} bins"
    note = f"the set ({size}) per second of all passes over it"
    return f"{table}\n{note}\n\nwarm / cold  {ratio:.2f}  (process total)"


def _limit_table(report: Mapping[str, Any]) -> str:
    if not report["limits"]:
        return f"no limits are set for +exp={report['experiment']}"
    units = {"wall_s": ("process total", "s"), "peak_memory_gb": ("peak memory", "GB")}
    rows = []
    for row in report["limits"]:
        name, unit = units[row["quantity"]]
        values = [f"{row[key]:.1f} {unit}" for key in ("measured", "limit")]
        rows.append([f"{row['run']} {name}", *values, "ok" if row["ok"] else "MISSED"])
    worst = "measured" if report["repeats"] == 1 else "worst"
    return _aligned(["set for 2 cores", worst, "limit", ""], rows)


def _cost_table(
    title: str,
    rows: Sequence[Mapping[str, Any]],
    totals: Sequence[Sequence[str]],
    ranged: bool,
) -> str:
    """Cold and warm seconds and shares of stages, then a rule and totals."""
    header = [title]
    for kind in KINDS:
        header += [f"{kind} s", *(["min-max"] if ranged else []), "share %"]
    cells = [[row["stage"], *_cells(row, ranged)] for row in rows]
    lines = _aligned(header, [*cells, *totals]).splitlines()
    lines.insert(-len(totals), "-" * max(map(len, lines)))
    return "\n".join(lines)


def _whole(report: Mapping[str, Any], quantity: str) -> dict[str, Any]:
    """Both sides of what is measured of a run as a whole."""
    return {kind: report["wholes"][kind][quantity] for kind in KINDS}


def _cells(sides: Mapping[str, Any], ranged: bool, share: str | None = None) -> Iterable[str]:
    """Median, min-max if ``ranged``, and share of both sides; ``-`` for a side without values."""
    for kind in KINDS:
        side = sides[kind]
        yield f"{side['median']:.2f}" if side else "-"
        if ranged:
            yield f"{side['min']:.2f}-{side['max']:.2f}" if side else "-"
        if share is None:
            yield f"{side['share_percent']:.1f}" if side else "-"
        else:
            yield share


def _aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns padded to their widest cell, the first flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for row in [header, *rows]:
        first, *others = (
            f"{cell:>{width}}" if position else f"{cell:<{width}}"
            for position, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join([first, *others]).rstrip())
    return "\n".join(lines)


# ---------------------------------------------------------------------------------------- runs
def measure(experiment: str, repeats: int) -> list[TrainingRun]:
    """Run cold and warm, ``repeats`` times, each time from an empty cache.

    Raises:
        RunFailedError: if a run fails.
    """
    runs: list[TrainingRun] = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as folder:
            for kind in KINDS:
                label = f"run {len(runs) + 1} of {repeats * len(KINDS)}, {kind}"
                runs.append(run_training(experiment, kind, Path(folder), label))
    return runs


def run_training(experiment: str, kind: str, folder: Path, label: str) -> TrainingRun:
    """Train in a process of its own and watch it.

    Args:
        experiment: name in ``conf/exp``.
        kind: ``"cold"`` or ``"warm"``, as the cache in ``folder`` is.
        folder: for the cache, and for results and output by kind.
        label: of the progress line.

    Raises:
        RunFailedError: if it fails, or leaves no ``metrics.json``.
    """
    cache, results = folder / "cache", folder / kind
    settings = [f"+exp={experiment}", f"cache='{cache}'", f"hydra.run.dir='{results}'"]
    written = [folder / f"{kind}.out", folder / f"{kind}.err"]
    started = time.perf_counter()
    with written[0].open("wb") as out, written[1].open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "tactslip_torch.train", *settings],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
        )
        try:
            peak_bytes, memory = watch(process, label, started)
        finally:
            _stop(process)
    wall_s = time.perf_counter() - started
    _show(f"{label}: {wall_s:.1f} s, {peak_bytes / 1e9:.2f} GB", is_last=True)
    found = results / "metrics.json"
    if process.returncode or not found.exists():
        raise RunFailedError(
            f"{label} failed with exit status {process.returncode}; it wrote last:\n"
            f"{last_lines(written[1]) or last_lines(written[0])}"
        )
    metrics = json.loads(found.read_text(encoding="utf-8"))
    num_recordings = sum(1 for _ in cache.rglob("*.features"))
    return TrainingRun(kind, wall_s, peak_bytes, memory, metrics, num_recordings)


def watch(process: subprocess.Popen[bytes], label: str, started: float) -> tuple[int, str]:
    """Wait for a process with a progress line; its peak memory in bytes, and how measured."""
    peak_bytes, memory = 0, "pss"
    _show(f"{label}: started")
    while process.poll() is None:
        now_bytes, memory_now = tree_memory(process.pid)
        if now_bytes:
            peak_bytes, memory = max(peak_bytes, now_bytes), memory_now
        if sys.stderr.isatty():
            _show(f"{label}: {time.perf_counter() - started:.0f} s, {now_bytes / 1e9:.2f} GB")
        try:
            process.wait(SAMPLE_S)
        except subprocess.TimeoutExpired:
            continue
    return peak_bytes, memory


def tree_memory(pid: int) -> tuple[int, str]:
    """Bytes of a process and all below it, and the measure: the same one for each of them.

    A process that has just ended counts nothing.
    """
    found: list[Any] = []
    for process in _tree(pid):
        try:
            found.append(process.memory_full_info())
        except psutil.AccessDenied:
            found.append(process.memory_info())
        except psutil.NoSuchProcess:
            continue
    measures = [name for name in MEMORY_NAMES if all(hasattr(of, name) for of in found)]
    return sum(getattr(of, measures[0]) for of in found), measures[0]


def last_lines(path: Path) -> str:
    """The end of what a process wrote; of a progress bar only its last state."""
    text = path.read_bytes().decode(errors="replace")  # read_text would break lines at "\r"
    lines = [line.rstrip().rpartition("\r")[2] for line in text.split("\n")]
    return "\n".join([line for line in lines if line.strip()][-TAIL_LINES:])


def _tree(pid: int) -> list[Any]:
    try:
        root = psutil.Process(pid)
        return [root, *root.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End a process that is still running, with its workers: they would write into the cache."""
    if process.poll() is None:
        for one in reversed(_tree(process.pid)):
            try:
                one.kill()
            except psutil.NoSuchProcess:
                continue
        process.wait()


def _show(text: str, *, is_last: bool = False) -> None:
    """A progress line on standard error, overwritten where that is a terminal."""
    if sys.stderr.isatty():
        print(f"\r{text:<60}", end="\n" if is_last else "", file=sys.stderr, flush=True)
    else:
        print(text, file=sys.stderr, flush=True)


# ---------------------------------------------------------------------------------------- main
def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.train",
        description="Time training with a cold and with a warm feature cache, stage by stage.",
    )
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--exp", default="unseen4", help="experiment of conf/exp (%(default)s)")
    choice.add_argument(
        "--quick", action="store_const", const="quick", dest="exp", help="the same as --exp quick"
    )
    parser.add_argument(
        "--repeat",
        type=int,
        default=1,
        metavar="N",
        help="how often, each from an empty cache (%(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there")
    parsed = parser.parse_args(arguments)
    if parsed.repeat < 1:
        parser.error(f"--repeat must be at least 1, got {parsed.repeat}")
    refuse_paths(parser, parsed, "json")
    return parsed


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parsed = _arguments(arguments)
    if psutil is None:
        print("error: psutil is missing: pip install 'tactslip_torch[bench]'", file=sys.stderr)
        return EXIT_NO_PSUTIL
    machine = machine_facts()
    try:
        runs = measure(parsed.exp, parsed.repeat)
    except RunFailedError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    report = summary(parsed.exp, runs, machine)
    print(f"\n{report_text(report)}")
    if parsed.json:
        with whole_file(parsed.json) as temporary:
            temporary.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
        print(f"\nnumbers in {parsed.json}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
