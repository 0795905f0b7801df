"""The harness of all benchmarks: arguments, machine, trainings, JSON, figure, page section.

A subject is a class derived from ``Benchmark`` in a file of its own, whose fields set how much is
measured; ``python -m benchmarks.NAME`` measures it, prints its tables, and writes ``NAME.json``,
``NAME.png`` and its section of docs/benchmarks.md between ``<!-- NAME -->`` and ``<!-- /NAME -->``.
``--quick`` measures very little, to see that it runs, and touches no tracked file; ``--render``
writes the same from the kept JSON. ``sizes.FIELD=value`` changes how much is measured.
"""

from __future__ import annotations

import argparse
import inspect
import json
import os
import platform
import re
import shlex
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from threadpoolctl import threadpool_info  # type: ignore[import-untyped]

from benchmarks import RESULTS, ROOT
from benchmarks.sources import digest
from benchmarks.tables import Report, Table, by_unit, chart, is_barred, lines
from benchmarks.trainings import say as say
from benchmarks.trainings import write_text
from tactslip_torch import __version__
from tactslip_torch.commands.stopping import errors_in_one_line, stopping
from tactslip_torch.report import style
from tactslip_torch.runtime import whole_file

QUICK_LINE = "QUICK: too few rounds to mean anything, whatever stands under limits"


# ------------------------------------------------------------------------------------ machine
def machine_description() -> dict[str, str]:
    """Processor, cores this process may use, and how busy the machine is already."""
    every = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else every
    found = {"processor": _processor_name(), "cores": f"{usable} of {every} cores"}
    if hasattr(os, "getloadavg"):
        found["load"] = f"load {os.getloadavg()[0]:.1f} before the runs"
    return found


def _processor_name() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), platform.processor() or platform.machine())


def versions(more: Sequence[str] = ()) -> dict[str, str]:
    """Of the libraries that do the work, of more of them, and of the BLAS in them."""
    names = ("torch", "numpy", "scipy", "scikit-learn", *more)
    found = {"python": platform.python_version()} | {name: metadata.version(name) for name in names}
    found["tactslip_torch"] = __version__  # the sources that run, whatever was installed
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
    machine = ", ".join(report["machine"].values())
    parts = (machine and f"on {machine}", used, f"code {report['code']}")
    return "; ".join(filter(None, parts))


# ------------------------------------------------------------------------------ files and figures
def keep_numbers(report: Report, path: Path) -> None:
    """Write a report as JSON, whole or not at all, and say where."""
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_text(path, text.replace(f"{ROOT}/", "./"))  # no paths of this machine
    print(f"\nnumbers in {path}")


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


def put_between(page: Path, name: str, content: str) -> None:
    """Replace what stands between the markers of that name in a page."""
    write_text(page, between_markers(page.read_text(encoding="utf-8"), name, content))


# --------------------------------------------------------------------------------- benchmarks
@dataclass(frozen=True)
class Job:
    """What a benchmark is asked to measure.

    Attributes:
        folder: of trainings, kept between runs.
        overrides: ``key=value`` of the command line, for the commands that it runs.
        is_quick: whether the sizes are too small to mean anything.
    """

    folder: Path
    overrides: tuple[str, ...] = ()
    is_quick: bool = False


@dataclass(frozen=True)
class Benchmark(ABC):
    """A subject: how much it measures, in its fields, what, and how that is shown.

    Attributes:
        name: of its module, files and markers.
        title: heads its section.
        about: what was measured, in a line.
        quick: fields of a run that only shows that it runs, ``FIELD=value ...``.
        libraries: whose versions matter besides those of all benchmarks.
        markers: between which its section stands, by default its name.
        page: that holds them.
        is_page: whether the section is a page of its own, with the page's title above it.
        has_headings: whether the section has its own; else the page says the rest.
        is_simulated: whether its data are.
        charts: by the ending of a figure's file name, of each panel the title of a table, and how
            the names of the columns begin that it shows; or one column, and that which it is
            drawn over.
        drawn: patterns of figures that a command leaves in the folder ``numbers["folder"]``, and
            what their names end in here.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    about: ClassVar[str]
    quick: ClassVar[str]
    libraries: ClassVar[tuple[str, ...]] = ()
    page: ClassVar[str] = "docs/benchmarks.md"
    markers: ClassVar[str] = ""
    is_page: ClassVar[bool] = False
    has_headings: ClassVar[bool] = True
    is_simulated: ClassVar[bool] = True
    charts: ClassVar[Mapping[str, Sequence[tuple[Any, ...]]]] = {}
    drawn: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls) -> None:
        cls.name = Path(inspect.getfile(cls)).stem

    @abstractmethod
    def measure(self, job: Job) -> dict[str, Any]:
        """The numbers, JSON-able: ``"tables"`` by title, or what ``tables`` makes them of."""

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Tables by title."""
        return {title: Table(*of) for title, of in numbers["tables"].items()}

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Fill the figure of that ending: ``charts``, unless a subject draws something else."""
        tables = self.tables(numbers)
        panels = [
            (title, x, names, unit, columns)
            for title, starts, *x in self.charts[ending]
            if title in tables
            for names, every in [tables[title].columns(starts)]
            for unit, columns in by_unit(every).items()
        ]
        heights = [
            14 if x else 3 + len(names) * max(1, 0.7 * len(columns) * is_barred(names, columns))
            for _, x, names, _, columns in panels
        ]
        drawing.set_size_inches(9.2, max(4.8, 0.22 * sum(heights)))
        places = drawing.subplots(len(panels), squeeze=False, height_ratios=heights)[:, 0]
        for axes, (title, over, names, unit, columns) in zip(places, panels, strict=True):
            only = next(iter(columns)) if len(columns) == 1 else ""
            first = next(iter(tables[title].rows[0]))  # of many columns it may name their unit
            of = only or (first if "%" in first else unit)
            about = f"{title}: {of}" if of else title
            for x in over:
                lines(axes, tables[title].curves(only, x), x, about)
            if not over:
                chart(axes, names, columns, about)

    @style.styled
    def figures(self, report: Report, path: Path) -> None:
        """Write the figures, and take those of a command."""
        numbers = report["numbers"]
        for pattern, ending in self.drawn.items():
            for left in Path(numbers.get("folder", path / "none")).glob(pattern):
                with whole_file(path.with_stem(f"{path.stem}{ending}")) as temporary:
                    shutil.copy(left, temporary)
        says_so = "simulated" in self.title.lower()
        simulated = ", simulated" if report["simulated"] and not says_so else ""
        quick = "; QUICK, means nothing" if report["quick"] else ""
        titles = self.tables(numbers)
        for ending, panels in self.charts.items():
            if panels and not any(title in titles for title, *_ in panels):
                continue
            drawing = Figure(figsize=(9.2, 4.8), layout="constrained")
            self.draw(numbers, drawing, ending)
            drawing.suptitle(f"{self.title}{simulated}{quick}")
            style.save(drawing, path.with_stem(f"{path.stem}{ending}"))

    def section(self, report: Report) -> str:
        """What stands between the markers of the page, in Markdown."""
        tables = self.tables(report["numbers"])
        command = f"python -m benchmarks.{self.name} {shlex.join(report['overrides'])}".strip()
        if not self.has_headings:
            is_simulated = report["numbers"].get("simulated", report["simulated"])
            kind = "Simulated" if is_simulated else "Recorded"
            parts = [f"{kind} (`{command}`, code {report['code']}):"]
            return "\n\n".join([*parts, *(table.markdown() for table in tables.values())])
        parts = [
            *([] if self.is_page else [f"## {self.title}"]),
            f"`{command}`, {ran_on(report)}.",
            *([f"**{QUICK_LINE}.**"] if report["quick"] else []),
            f"{self.about[:1].upper()}{self.about[1:]}.",
            f"![{self.title}](../benchmarks/results/{self.name}.png)",
        ]
        for title, table in tables.items():
            parts += [f"{'##' if self.is_page else '###'} {title}", table.markdown()]
        return "\n\n".join(parts)

    def publish(self, report: Report, folder: Path) -> None:
        """Print and write the section and the figures; a quick run's and ``--out``'s elsewhere."""
        section = self.section(report)
        print(section)
        self.figures(report, folder / f"{self.name}.png")
        if report["quick"] or folder != RESULTS:
            page = folder / f"{self.name}.md"
            write_text(page, section + "\n")
        else:
            page = ROOT / self.page
            put_between(page, self.markers or self.name, section)
            self.publish_more(report)
        print(f"section in {page}")

    def publish_more(self, report: Report) -> None:  # noqa: B027
        """Write what else in the pages comes from these numbers: nothing."""

    def run(self, arguments: Sequence[str] | None = None) -> int:
        """Entry point; the exit status, 0.

        Raises:
            SystemExit: with status 2 for bad input, reported in one line; 130 or 143 when stopped.
        """
        parser = argparse.ArgumentParser(
            prog=f"python -m benchmarks.{self.name}", description=f"{self.title}: {self.about}."
        )
        text = "very little, to see that it runs; no tracked file is touched"
        parser.add_argument("--quick", action="store_true", help=text)
        parser.add_argument("--render", action="store_true", help="show the kept numbers again")
        text = "of numbers, figure and section; no tracked file is touched"
        parser.add_argument("--out", type=Path, metavar="FOLDER", help=text)
        names = ", ".join(field.name for field in fields(self))
        text = f"passed on to the commands that are run; sizes.NAME=value, of {names}: how much"
        parser.add_argument("overrides", nargs="*", metavar="key=value", help=text)
        given = parser.parse_intermixed_args(arguments)
        outputs = ROOT / "outputs" / "benchmarks"
        folder = (given.out or (outputs / "quick" if given.quick else RESULTS)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.json"
        if given.render:
            report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
            if "numbers" not in report:
                text = f"--render needs {path}, made by present code; leave it out, which measures"
                parser.error(text)
            self.publish(report, folder)
            return 0
        runs = (folder / "runs" if given.quick else outputs) / self.name
        resized = [text for text in given.overrides if text.startswith("sizes.")]
        overrides = tuple(text for text in given.overrides if text not in resized)
        with stopping(), errors_in_one_line():
            asked = self._with(self.quick.split()) if given.quick else self
            asked = asked._with([text.removeprefix("sizes.") for text in resized])
            machine = machine_description()  # before the load of the measurement
            numbers = asked.measure(Job(runs, overrides, given.quick))
        report = {
            "code": digest(self.name),
            "simulated": self.is_simulated,
            "quick": given.quick,
            "machine": machine,
            "versions": versions(self.libraries),
            "settings": asdict(asked),
            "overrides": [
                re.sub(r"root=.*", "root=FOLDER", text) if "=" in text else "FOLDER"
                for text in given.overrides
            ],
            "numbers": numbers,
        }
        keep_numbers(report, path)
        self.publish(report, folder)
        return 0

    def _with(self, sizes: Sequence[str]) -> Self:
        """The same of other sizes, ``FIELD=value`` each.

        Raises:
            ValueError: if there is no such field.
        """
        given: Any = OmegaConf.to_container(OmegaConf.from_dotlist(list(sizes)))
        names = [field.name for field in fields(self)]
        if unknown := [name for name in given if name not in names]:
            raise ValueError(f"no size is called {unknown[0]!r}; there are {', '.join(names)}")
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
        return replace(self, **values)
