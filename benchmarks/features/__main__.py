"""What features and scores cost: ``python -m benchmarks.features [--quick] [--json FILE]``.

``pool``: the whole pool by every engine beside SciPy, NumPy, TSFEL and MiniRocket, with errors.
``roofline``: the ceilings of the machine, and how near the engines come. ``extract``, ``score`` and
``solve``: what the guards cost that keep extremes from becoming silent numbers; ordinary bins are
timed with them and, in the same rounds, with plain formulas in their place (``guards``). Prints
tables and the limits the project has set itself, and keeps numbers and figure in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.features.figure import figure
from benchmarks.features.guards import measure as guards
from benchmarks.features.guards.off import replaced
from benchmarks.features.pool import full_pool
from benchmarks.features.report import following, report_text
from benchmarks.features.roofline import roofline
from benchmarks.features.sizes import QUICK, Sizes
from benchmarks.machine import PEERS, machine_facts, versions
from benchmarks.outcome import EXIT_INTERRUPTED, add_paths, keep_by_default, refuse_paths, told

SECTIONS: dict[str, Callable[[Sizes], dict[str, Any]]] = {
    "pool": full_pool,
    "roofline": roofline,
    **guards.SECTIONS,
}


def measure(sizes: Sizes, names: Sequence[str], quick: bool) -> dict[str, Any]:
    """The report: facts, the sections named, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        names: of ``SECTIONS``.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    sections = {name: SECTIONS[name](sizes) for name in names}
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "versions": versions(PEERS),
        "settings": asdict(sizes),
        "replaced": replaced(),
        "sections": sections,
        **following(sections),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.features",
        description="Time features of simulated bins beside other tools, and what guards cost.",
    )
    parser.add_argument("--quick", action="store_true", help="a few rounds, to see that it runs")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="of %(choices)s"
    )
    add_paths(parser, "if all is measured in full")
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if parsed.figure and parsed.only and "pool" not in parsed.only:
        parser.error("--figure shows the section pool; measure it, with roofline if you like")
    if not (parsed.quick or parsed.only):
        keep_by_default(parsed, "features")
    names = [name for name in SECTIONS if parsed.only is None or name in parsed.only]
    try:
        report = measure(QUICK if parsed.quick else Sizes(), names, parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, report_text, figure, parsed)


if __name__ == "__main__":
    raise SystemExit(main())
