"""The harness of all benchmarks: arguments, timing, machine, JSON, tables, figure, page section.

A subject is a class derived from ``Benchmark`` in a file of its own; ``python -m benchmarks.NAME``
measures it, prints its tables, and writes ``NAME.json``, ``NAME.png`` and its section of
docs/benchmarks.md between ``<!-- NAME -->`` and ``<!-- /NAME -->``. ``--quick`` measures very
little, to see that it runs, and touches no tracked file; ``--render`` writes the same from the kept
JSON.
``sizes.NAME=value`` on the command line changes how much is measured.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import random
import re
import shutil
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from importlib import metadata
from pathlib import Path
from statistics import mean, median, quantiles, stdev
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from omegaconf import OmegaConf
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]

from benchmarks import RESULTS, ROOT
from tactslip_torch.features.cache import source_digest
from tactslip_torch.report import style
from tactslip_torch.runtime import whole_file

QUICK_LINE = "QUICK: too few rounds to mean anything, whatever stands under limits"
EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130

Report = Mapping[str, Any]
"""What a benchmark keeps: ``numbers`` that it measured, and what they were measured on."""


# ------------------------------------------------------------------------------------- timing
@dataclass(frozen=True)
class Timing:
    """Seconds of every single call, by round."""

    rounds: list[list[float]]

    @property
    def per_round(self) -> list[float]:
        """Mean seconds of a call, of each round."""
        return [mean(calls) for calls in self.rounds]

    def summary(self) -> dict[str, Any]:
        """``seconds`` by round, and percentiles of single calls; JSON-able."""
        every = [seconds for calls in self.rounds for seconds in calls]
        p50, p99 = np.percentile(every, [50, 99]).tolist()
        return {"seconds": self.per_round, "p50_s": p50, "p99_s": p99, "calls": len(every)}


def interleaved(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    seed: int = 0,
    *,
    block_s: float = 2e-3,
    most_calls: int = 1000,
) -> dict[str, Timing]:
    """Time several calls in turns, so that drift of the machine and of its caches hits all alike.

    Every round makes a block of each call in a new random order, after one that is not timed.

    Args:
        calls: by name.
        rounds: of every call.
        seed: of the orders.
        block_s: a short call is repeated for about so long in a round.
        most_calls: in a round.
    """
    shuffle = random.Random(seed)
    repeats = {}
    for name, call in calls.items():
        least = min(timed(call)[0] for _ in range(3 if block_s else 1))
        repeats[name] = max(1, min(most_calls, round(block_s / max(least, 1e-9))))
    found: dict[str, list[list[float]]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name in shuffle.sample(list(calls), len(calls)):
            if repeats[name] > 1:
                calls[name]()
            found[name].append([timed(calls[name])[0] for _ in range(repeats[name])])
    return {name: Timing(of) for name, of in found.items()}


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it returned."""
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def paired_ratio(seconds: Sequence[float], others: Sequence[float]) -> Spread:
    """What ``seconds`` are of ``others``, round by round: drift between rounds cancels.

    Example:
        >>> paired_ratio([1.0, 6.0, 3.0], [1.0, 3.0, 2.0])
        Spread(median=1.5, low=1.25, high=1.75)
    """
    return Spread.of([a / b for a, b in zip(seconds, others, strict=True)])


@contextmanager
def on_threads(number: int) -> Iterator[None]:
    """So many threads for PyTorch and every BLAS."""
    before = torch.get_num_threads()
    with threadpool_limits(number):
        torch.set_num_threads(number)
        try:
            yield
        finally:
            torch.set_num_threads(before)


def in_fresh_process(function: str, **arguments: Any) -> Any:
    """The result of ``module:function`` in a process of its own; arguments and result as JSON.

    Raises:
        RuntimeError: if the process ends without a result.
    """
    module, _, name = function.partition(":")
    code = f"import json, sys\nfrom {module} import {name} as call\n"
    code += "print(json.dumps(call(**json.load(sys.stdin))))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(arguments),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=ROOT,
    )
    if done.returncode:
        raise RuntimeError(f"{function} failed in a process of its own; see above")
    return json.loads(done.stdout.splitlines()[-1])


def peak_bytes() -> int:
    """Most memory that this process has had resident."""
    path = Path("/proc/self/status")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    for line in lines:
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    import resource  # not on Windows; on Linux it would count the parent before exec

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def say(text: str) -> None:
    """A progress line on standard error."""
    print(text, file=sys.stderr, flush=True)


# ------------------------------------------------------------------------------------ machine
def machine_description() -> dict[str, str]:
    """Processor, cores this process may use, and how busy the machine is already."""
    every = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else every
    facts = {"processor": _processor_name(), "cores": f"{usable} of {every} cores"}
    if hasattr(os, "getloadavg"):
        facts["load"] = f"load {os.getloadavg()[0]:.1f} before the runs"
    return facts


def _processor_name() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), platform.processor() or platform.machine())


def versions(more: Sequence[str] = ()) -> dict[str, str]:
    """Of the libraries that do the work, of more of them, and of the BLAS in them."""
    names = ("torch", "numpy", "scipy", "scikit-learn", "tactslip_torch", *more)
    found = {"python": platform.python_version()} | {name: metadata.version(name) for name in names}
    of_torch = re.search(r"BLAS_INFO=(\w+)", torch.__config__.show())
    blas = {
        f"{info['internal_api']} {info['version']}"
        for info in threadpool_info()
        if info["user_api"] == "blas"
    }
    known = [f"{of_torch[1]} in torch"] if of_torch else []
    return found | {"BLAS": " and ".join([*known, *sorted(blas)])}


def ran_on(report: Report) -> str:
    """Machine, versions and code of a report, in words."""
    used = ", ".join(f"{name} {of}" for name, of in report["versions"].items())
    return f"on {', '.join(report['machine'].values())}; {used}; code {report['code']}"


# ------------------------------------------------------------------------------------- trainings
def trained(name: str, overrides: Sequence[str], folder: Path, cache: Path) -> dict[str, Any]:
    """The metrics of a training, from its folder if this code finished it there, else made now.

    Args:
        name: for messages.
        overrides: of ``tactslip train``.
        folder: of its results.
        cache: of features.

    Raises:
        RuntimeError: if the training fails.
    """
    say(name)
    return result_of(
        "train", [*overrides, "export=false", f"cache={cache}"], folder, "metrics.json"
    )


def code_digest() -> str:
    """Of everything that decides a result: sources, calibrated parameters, configuration."""
    digest = hashlib.sha256(source_digest().encode())
    others = [*(ROOT / "tactslip_torch").rglob("*.json"), *(ROOT / "conf").rglob("*.yaml")]
    for path in sorted(others):
        digest.update(path.relative_to(ROOT).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def result_of(command: str, overrides: Sequence[str], folder: Path, name: str) -> dict[str, Any]:
    """The JSON file ``name`` that ``tactslip COMMAND`` leaves in the folder, made by this code.

    Raises:
        RuntimeError: if the command fails, which has said why.
    """
    made_by, note = " ".join([code_digest(), *overrides]), folder / "made_by.txt"
    if not note.exists() or note.read_text(encoding="utf-8") != made_by:
        note.unlink(missing_ok=True)
        given = ["-m", "tactslip_torch", command, *overrides, f"hydra.run.dir='{folder}'"]
        say(" ".join(given))
        done = subprocess.run([sys.executable, *given], stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            raise RuntimeError(f"tactslip {command} failed; see above")
        write_text(note, made_by)
    found: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
    return found


# ------------------------------------------------------------------------------------- tables
class Spread(NamedTuple):
    """The median of some numbers and their quartiles."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float], factor: float = 1.0) -> Spread:
        """Median and quartiles, in another unit by a factor.

        Example:
            >>> Spread.of([3.0, 1.0, 2.0])
            Spread(median=2.0, low=1.5, high=2.5)
        """
        scaled = [factor * value for value in values]
        if len(scaled) < 2:
            return cls(*scaled * 3)
        low, _, high = quantiles(scaled, n=4, method="inclusive")
        return cls(median(scaled), low, high)

    def text(self, digits: int = 3) -> str:
        """``median (low to high)``."""
        middle, low, high = (number(value, digits) for value in self)
        return f"{middle} ({low} to {high})"


class Table(NamedTuple):
    """A table that a terminal and a Markdown file show alike.

    Attributes:
        rows: cells by column, the same columns in each; the first names the row.
        note: a line below it.
    """

    rows: Sequence[Mapping[str, object]]
    note: str = ""

    def text(self) -> str:
        """Aligned columns."""
        return "\n".join(filter(None, [style.table(self.rows), self.note]))

    def markdown(self) -> str:
        """A table of Markdown, columns of numbers to the right and of words to the left."""
        header, *rows = style.cells(self.rows)
        rule = [
            "---:" if place and all(re.match(r"[+-]?\d|-?$", cell) for cell in column) else "---"
            for place, column in enumerate(zip(*rows, strict=True))
        ]
        lines = [f"| {' | '.join(cells)} |" for cells in (header, rule, *rows)]
        return "\n".join([*lines, *(["", self.note] if self.note else [])])


def by(rows: Iterable[Report], *keys: str) -> dict[tuple[Any, ...], list[Report]]:
    """Rows by the values of these keys, in order of appearance.

    Example:
        >>> by([{"a": 1, "b": 2}, {"a": 1, "b": 3}], "a")
        {(1,): [{'a': 1, 'b': 2}, {'a': 1, 'b': 3}]}
    """
    found: dict[tuple[Any, ...], list[Report]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def listed(about: str, values: Mapping[str, object]) -> Table:
    """Values below each other, a row each."""
    return Table([{about: name, "": value} for name, value in values.items()])


def number(value: float | None, digits: int = 3) -> str:
    """A number to some significant digits, without an exponent where it is short; or ``-``.

    Example:
        >>> [number(value) for value in (0.01234, 12.345, 123456.0, 1.2e-11)]
        ['0.0123', '12.3', '123,456', '1.2e-11']
    """
    if value is None:
        return "-"
    if value and abs(value) < 1e-4:
        return f"{value:.1e}"
    if abs(value) >= 10**digits:
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


percent = style.percent


def mean_sd(values: Iterable[float], digits: int = 2, sign: str = "") -> str:
    """``mean ± sd`` over seeds, the mean alone of one, or ``-`` of nothing.

    Example:
        >>> mean_sd([1.0, 2.0, 3.0])
        '2.00 ± 1.00'
    """
    every = list(values)
    if not every:
        return "-"
    spread = f" ± {stdev(every):.{digits}f}" if len(every) > 1 else ""
    return f"{mean(every):{sign}.{digits}f}{spread}"


def limit(what: str, measured: float, most: float, unit: str = "") -> dict[str, Any]:
    """A row of ``limits``: what was measured, and the most that was set for it."""
    text, bound = (f"{number(value)} {unit}".strip() for value in (measured, most))
    return {"limits": what, "measured": text, "limit": f"<= {bound}", "": measured <= most}


def limits(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Every limit beside what was measured, met or missed.

    Args:
        rows: whose last cell, headed by nothing, says whether the limit is met.
    """
    return Table([{**row, "": "met" if row[""] else "MISSED"} for row in rows])


# ------------------------------------------------------------------------------------ figures
# Okabe and Ito, told apart by the colour-blind
OURS, SECOND, THIRD, PEER, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#888888"
COLORS = (OURS, PEER, THIRD, SECOND, "#cc79a7", "#56b4e9", GREY)
LIGHT = "#dddddd"


def bars(
    axes: Axes,
    names: Sequence[str],
    series: Mapping[str, Sequence[float | None]],
    about: str,
    *,
    is_log: bool = True,
) -> None:
    """Horizontal bars, the first on top, each with its value; a colour and a legend by series.

    Args:
        axes: to draw on.
        names: of the groups of bars.
        series: values by their meaning, one a name; ``None`` leaves a bar out.
        about: labels the axis of values.
        is_log: whether that axis is logarithmic.
    """
    height = 0.8 / len(series)
    for step, (label, values) in enumerate(series.items()):
        places = [place + height * (step - (len(series) - 1) / 2) for place in range(len(names))]
        shown = [(place, of) for place, of in zip(places, values, strict=True) if of is not None]
        color = COLORS[step % len(COLORS)]
        at, widths = [place for place, _ in shown], [value for _, value in shown]
        axes.barh(at, widths, color=color, height=0.9 * height, label=label)
        for place, value in shown:
            axes.annotate(
                number(value), (value, place), (3, 0), textcoords="offset points", va="center",
                size=7,
            )  # fmt: skip
    style.lanes(axes, names)
    if is_log:
        axes.set_xscale("log")
        plain_decades(axes.xaxis)
    axes.margins(x=0.12)
    axes.set_xlabel(about)
    if len(series) > 1:
        axes.legend()


def plain_decades(axis: Axis) -> None:
    """Write decades as numbers, and nothing between them."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_formatter(NullFormatter())


def finish(drawing: Figure, report: Report, about: str, path: Path) -> None:
    """Title, and the file.

    Args:
        drawing: with its axes drawn.
        report: tells whether it was quick, and whether data are simulated.
        about: the title; that data are simulated is added.
        path: of the PNG.
    """
    quick = "; QUICK, means nothing" if report["quick"] else ""
    simulated = ", simulated" if report.get("simulated", True) else ""
    drawing.suptitle(f"{about}{simulated}{quick}")
    with whole_file(path) as temporary:
        drawing.savefig(temporary, dpi=160, format="png", facecolor="white")


# -------------------------------------------------------------------------------------- files
def keep_numbers(report: Report, path: Path) -> None:
    """Write a report as JSON, whole or not at all, and say where."""
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_text(path, text.replace(f"{ROOT}/", "./"))  # no paths of this machine
    print(f"\nnumbers in {path}")


def write_text(path: Path, content: str) -> None:
    """Write a file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def between_markers(text: str, name: str, content: str) -> str:
    """``text`` with what stands between ``<!-- name -->`` and ``<!-- /name -->`` replaced.

    Raises:
        ValueError: if a marker is missing.
    """
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if start not in text or end not in text:
        raise ValueError(f"the markers {start} and {end} are not both there")
    before, rest = text.split(start, 1)
    return f"{before}{start}\n{content}\n{end}{rest.split(end, 1)[1]}"


# --------------------------------------------------------------------------------- benchmarks
S = TypeVar("S")


@dataclass(frozen=True)
class Overrides:
    """Sizes of a subject that runs one command: its overrides, before those of the command line."""

    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job(Generic[S]):
    """What a benchmark is asked to measure.

    Attributes:
        sizes: how much.
        folder: of trainings, kept between runs.
        overrides: ``key=value`` of the command line, for the commands that it runs.
        is_quick: whether the sizes are too small to mean anything.
    """

    sizes: S
    folder: Path
    overrides: tuple[str, ...] = ()
    is_quick: bool = False


class Benchmark(ABC, Generic[S]):
    """A subject: what it measures, and how that is shown.

    Attributes:
        name: of its module, files and markers.
        title: heads its section.
        about: what was measured, in a line.
        sizes: of a measurement.
        quick: sizes that only show that it runs.
        libraries: whose versions matter besides those of all benchmarks.
        markers: between which its section stands.
        page: that holds them.
        has_headings: whether the section has its own; else the page says the rest.
        is_simulated: whether its data are.
        drawn: figures that a command leaves in the folder ``numbers["folder"]``, and what their
            names end in here; they stand for one drawn here.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    about: ClassVar[str]
    sizes: S
    quick: S
    libraries: ClassVar[tuple[str, ...]] = ()
    page: ClassVar[str] = "docs/benchmarks.md"
    markers: ClassVar[str] = ""
    has_headings: ClassVar[bool] = True
    is_simulated: ClassVar[bool] = True
    drawn: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def measure(self, job: Job[S]) -> dict[str, Any]:
        """The numbers, JSON-able."""

    @abstractmethod
    def tables(self, numbers: Report) -> dict[str, Table]:
        """Tables by title."""

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Fill the figure, where no command has drawn it."""

    @style.styled
    def figures(self, report: Report, path: Path) -> None:
        """Write the figure, or take those of a command."""
        for name, ending in self.drawn.items():
            if (drawn := Path(report["numbers"]["folder"], name)).exists():
                with whole_file(path.with_stem(f"{path.stem}{ending}")) as temporary:
                    shutil.copy(drawn, temporary)
        if not self.drawn:
            drawing = Figure(figsize=(8.2, 4.8), layout="constrained")
            self.draw(report["numbers"], drawing)
            finish(drawing, report, self.title, path)

    def section(self, report: Report) -> str:
        """What stands between the markers of the page, in Markdown."""
        tables = self.tables(report["numbers"])
        command = " ".join([f"python -m benchmarks.{self.name}", *map(repr, report["overrides"])])
        if not self.has_headings:
            is_simulated = report["numbers"].get("simulated", report["simulated"])
            kind = "Simulated" if is_simulated else "Recorded"
            parts = [f"{kind} (`{command}`, code {report['code']}):"]
            return "\n\n".join([*parts, *(table.markdown() for table in tables.values())])
        parts = [
            f"## {self.title}",
            f"`python -m benchmarks.{self.name}`, {ran_on(report)}.",
            *([f"**{QUICK_LINE}.**"] if report["quick"] else []),
            f"{self.about[:1].upper()}{self.about[1:]}.",
            f"![{self.title}](../benchmarks/results/{self.name}.png)",
        ]
        for title, table in tables.items():
            parts += [f"### {title}", table.markdown()]
        return "\n\n".join(parts)

    def text(self, report: Report) -> str:
        """What is printed."""
        lines = [
            self.about,
            f"machine   {', '.join(report['machine'].values())}",
            f"versions  {', '.join(f'{name} {of}' for name, of in report['versions'].items())}",
            *(["SIMULATED: nothing about a real hand"] if report["simulated"] else []),
            *([QUICK_LINE] if report["quick"] else []),
        ]
        tables = self.tables(report["numbers"]).items()
        return "\n\n".join(["\n".join(lines), *(f"{of}\n{table.text()}" for of, table in tables)])

    def publish(self, report: Report, folder: Path) -> None:
        """Print tables; write figure and page section, of a quick run a page of its own."""
        print(self.text(report))
        self.figures(report, folder / f"{self.name}.png")
        page = folder / f"{self.name}.md" if report["quick"] else ROOT / self.page
        markers, content = self.markers or self.name, self.section(report)
        if report["quick"]:
            write_text(page, content + "\n")
        else:
            write_text(page, between_markers(page.read_text(encoding="utf-8"), markers, content))
        print(f"section in {page}")

    def run(self, arguments: Sequence[str] | None = None) -> int:
        """Entry point; the exit status."""
        parser = argparse.ArgumentParser(
            prog=f"python -m benchmarks.{self.name}", description=f"{self.title}: {self.about}."
        )
        text = "very little, to see that it runs; no tracked file is touched"
        parser.add_argument("--quick", action="store_true", help=text)
        parser.add_argument("--render", action="store_true", help="show the kept numbers again")
        text = "of numbers, figure and, if quick, the page (benchmarks/results, quick: outputs)"
        parser.add_argument("--out", type=Path, metavar="FOLDER", help=text)
        names = ", ".join(field.name for field in fields(self.sizes))  # type: ignore[arg-type]
        text = f"passed on to the commands that are run; sizes.NAME=value, of {names}: how much"
        parser.add_argument("overrides", nargs="*", metavar="key=value", help=text)
        given = parser.parse_intermixed_args(arguments)
        outputs = ROOT / "outputs" / "benchmarks"
        folder = (given.out or (outputs / "quick" if given.quick else RESULTS)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.json"
        if given.render:
            if not path.exists():
                parser.error(f"--render needs {path}; leave --render out, which measures")
            report = json.loads(path.read_text(encoding="utf-8"))
            if "numbers" not in report:
                parser.error(f"{path} was kept by earlier code; leave --render out, which measures")
            self.publish(report, folder)
            return 0
        runs = (folder / "runs" if given.quick else outputs) / self.name
        sizes = self.quick if given.quick else self.sizes
        try:
            sizes, overrides = _resized(sizes, given.overrides)
            report = self._report(Job(sizes, runs, overrides, given.quick), given.overrides)
        except KeyboardInterrupt:
            return EXIT_INTERRUPTED
        except (FileNotFoundError, ValueError, RuntimeError) as error:
            if os.environ.get("TACTSLIP_TRACEBACK"):
                raise
            print(f"error: {error}", file=sys.stderr)
            return EXIT_FAILED if isinstance(error, RuntimeError) else EXIT_BAD_INPUT
        keep_numbers(report, path)
        self.publish(report, folder)
        return 0

    def _report(self, job: Job[S], overrides: Sequence[str]) -> dict[str, Any]:
        machine = machine_description()  # before the load of the measurement
        numbers = self.measure(job)
        return {
            "code": code_digest(),
            "simulated": self.is_simulated,
            "quick": job.is_quick,
            "machine": machine,
            "versions": versions(self.libraries),
            "settings": asdict(job.sizes),  # type: ignore[call-overload]
            "overrides": list(overrides),
            "numbers": numbers,
        }


def _resized(sizes: S, overrides: Sequence[str]) -> tuple[S, tuple[str, ...]]:
    """Sizes after ``sizes.NAME=value``, and the other overrides.

    Raises:
        ValueError: if there is no such size.
    """
    own = [text.removeprefix("sizes.") for text in overrides if text.startswith("sizes.")]
    given: Any = OmegaConf.to_container(OmegaConf.from_dotlist(own))
    names = [field.name for field in fields(sizes)]  # type: ignore[arg-type]
    if unknown := [name for name in given if name not in names]:
        raise ValueError(f"no size is called {unknown[0]!r}; there are {', '.join(names)}")
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
    others = tuple(text for text in overrides if not text.startswith("sizes."))
    return replace(sizes, **values), others  # type: ignore[type-var]
