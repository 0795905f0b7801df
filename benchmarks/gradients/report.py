"""What follows from the measurements of ``benchmarks.gradients``: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.clocks import paired_ratio
from benchmarks.gradients.ways import BASE, OURS, PEER
from benchmarks.outcome import heading
from benchmarks.tables import Spread, Table, limits, limits_last, number

MOST_BACKWARD = 1.5
MOST_MEMORY = 2.0
LIMITED_BINS = 4800  # and more: small ones are here for what autograd makes of them
_MIB = 2**20
Rows = Sequence[Mapping[str, Any]]


def row_of(rows: Rows, problem: str, way: str) -> Mapping[str, Any] | None:
    """The row of a way, if there is one."""
    return next((row for row in rows if (row["problem"], row["way"]) == (problem, way)), None)


def limit_rows(rows: Rows) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold."""
    found = []
    for base in rows:
        if base["way"] != BASE or base["num_bins"] < LIMITED_BINS:
            continue
        ours = row_of(rows, base["problem"], OURS)
        if ours is None:
            raise ValueError(f"{base['problem']} was measured forward alone; measure it again")
        pairs = (
            ("the way back / the fit alone", "backward_s", "forward_s", MOST_BACKWARD),
            ("memory of both ways / of the fit alone", "whole_bytes", "whole_bytes", MOST_MEMORY),
        )
        for what, mine, other, most in pairs:
            ratio = Spread(*paired_ratio(ours[mine], base[other]))
            found.append(
                {
                    "what": f"{base['problem']}: {what}",
                    "measured": ratio.text(),
                    "limit": f"<= {most:g}",
                    "ok": ratio.median <= most,
                }
            )
    return found


def gradient_error(row: Mapping[str, Any], reference: Mapping[str, Any]) -> float:
    """Largest difference along the drawn directions, relative, one for what is learned each."""
    pairs = zip(row["gradient"], reference["gradient"], strict=True)
    return max(abs(float(mine) / float(other) - 1) for mine, other in pairs)


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    rows = report["sections"]["gradients"]["rows"]
    return {
        "Limits": [limits(report["limits"], "median, quartiles")],
        "Forward and back": [_costs(rows)],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report)))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    settings = report["settings"]
    return (
        f"a loss through the closed-form fit and its gradient by features, C, c and weights of "
        f"bins, every time in a process of its own on {report['threads']} threads; bins are "
        f"synthetic, {settings['groups']} groups are left out one at a time"
    )


def _costs(rows: Rows) -> Table:
    header = ["bins x features", "way", "forward, s", "back, s", "back / fit alone"]
    header += ["both / ours", "MiB forward", "MiB both", "gradient beside autograd"]
    note = (
        "The fit alone has no way back. MiB: the most beyond what the process held before. "
        "Autograd goes through the Gram matrix and torch.linalg.cholesky, or through a fit without "
        "each group. Gradients are compared along one drawn direction for features, C, c and "
        "weights each; the largest relative difference is shown."
    )
    return Table(header, [_cells(rows, row) for row in rows], note)


def _cells(rows: Rows, row: Mapping[str, Any]) -> list[str]:
    base, ours, peer = (row_of(rows, row["problem"], way) for way in (BASE, OURS, PEER))
    cells = [row["problem"], row["way"], Spread.of(row["forward_s"]).text()]
    memory = [number(Spread.of(row[of]).median / _MIB) for of in ("forward_bytes", "whole_bytes")]
    if row["way"] == BASE or base is None or ours is None:
        return [*cells, "", "", "", *memory, ""]
    back = number(paired_ratio(row["backward_s"], base["forward_s"]).median)
    cells += [Spread.of(row["backward_s"]).text(), back]
    times = number(paired_ratio(_both(row), _both(ours)).median)
    is_compared = row["way"] == OURS and peer is not None
    error = number(gradient_error(row, peer)) if is_compared and peer is not None else ""
    return [*cells, times, *memory, error]


def _both(row: Mapping[str, Any]) -> list[float]:
    return [sum(pair) for pair in zip(row["forward_s"], row["backward_s"], strict=True)]
