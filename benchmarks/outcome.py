"""What every benchmark does with its report: limits as a table, numbers in a file."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import limits
from tactslip_torch.runtime import whole_file

SIMULATED_LINE = "SIMULATED bins: what things cost, nothing about a real hand"
QUICK_LINE = "QUICK: too few rounds to mean anything, whatever stands under limits"
ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
EXIT_INTERRUPTED = 130


def add_paths(parser: argparse.ArgumentParser, when: str = "unless --quick") -> None:
    """The options ``--json`` and ``--figure``.

    Args:
        parser: that gets them.
        when: they go to ``benchmarks/results`` by themselves, for the help.
    """
    for name, what in (("json", "numbers"), ("figure", "figure")):
        text = f"where the {what} go (benchmarks/results, {when})"
        parser.add_argument(f"--{name}", type=Path, metavar="FILE", help=text)


def refuse_paths(parser: argparse.ArgumentParser, parsed: argparse.Namespace, *names: str) -> None:
    """End the program with the parser's error if one of these options names no file to write.

    Before anything is measured: the folder is made, and a file of no name is opened in it.
    """
    for name in names:
        path = getattr(parsed, name)
        if not path:
            continue
        if path.is_dir():
            parser.error(f"--{name} needs a file, {path} is a folder")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=path.parent).close()
        except OSError as error:
            parser.error(f"--{name} cannot be written to {path}: {error.strerror}")


def limits_table(rows: Sequence[Mapping[str, Any]], measured: str = "measured") -> str:
    """Every limit beside what was measured, met or missed.

    Args:
        rows: with ``what``, ``measured``, ``limit`` and ``ok``.
        measured: heads the second column.
    """
    return limits(rows, measured).text()


def heading(report: Mapping[str, Any], about: str, parts: Sequence[str]) -> str:
    """A report as text: what it ran on, its parts, and whether it means anything.

    Args:
        report: with ``quick``, ``machine``, ``versions`` and perhaps ``threads``.
        about: what was measured.
        parts: what is shown.
    """
    lines = [
        about,
        f"machine   {', '.join(report['machine'].values())}",
        f"versions  {', '.join(f'{name} {of}' for name, of in report['versions'].items())}",
        SIMULATED_LINE,
    ]
    quick = [QUICK_LINE] if report["quick"] else []
    return "\n\n".join(["\n".join(lines + quick), *parts, *quick])


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


def keep_numbers(report: Mapping[str, Any], path: Path | None) -> None:
    """Write a report as JSON, whole or not at all, and say where; nothing without a path."""
    if path is None:
        return
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    print(f"\nnumbers in {path}")


def keep_figure(
    draw: Callable[[Mapping[str, Any], Path], None], report: Mapping[str, Any], path: Path | None
) -> None:
    """Draw a report and say where; nothing without a path."""
    if path is None:
        return
    draw(report, path)
    print(f"figure in {path}")


def keep_by_default(parsed: argparse.Namespace, name: str) -> None:
    """Numbers and figure go to ``RESULTS`` by this name, where the options do not say otherwise."""
    parsed.json = parsed.json or RESULTS / f"{name}.json"
    parsed.figure = parsed.figure or RESULTS / f"{name}.png"


def outcome(
    measure: Callable[[], Mapping[str, Any]],
    text: Callable[[Mapping[str, Any]], str],
    draw: Callable[[Mapping[str, Any], Path], None],
    parsed: argparse.Namespace,
    given: Path | None,
    failures: tuple[type[Exception], ...] = (),
) -> int:
    """Measure and tell; the exit status.

    Args:
        measure: makes the report.
        text: of it.
        draw: its figure.
        parsed: with the options of ``add_paths``.
        given: the detector's file that was asked for; what is wrong with it is status 2.
        failures: of processes that were started, status 1.
    """
    try:
        report = measure()
    except failures as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except (FileNotFoundError, ValueError) as error:
        if given is None:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, text, draw, parsed)


def told(
    report: Mapping[str, Any],
    text: Callable[[Mapping[str, Any]], str],
    draw: Callable[[Mapping[str, Any], Path], None],
    parsed: argparse.Namespace,
) -> int:
    """Print a report, and keep its numbers and figure where the options say; exit status 0."""
    print(text(report))
    keep_numbers(report, parsed.json)
    keep_figure(draw, report, parsed.figure)
    return 0
