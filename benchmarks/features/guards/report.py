"""What follows from what guards cost: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from benchmarks.arithmetic import NATIVE, WIDE
from benchmarks.clocks import paired_ratio
from benchmarks.machine import threads_text
from benchmarks.tables import Table

MOST_OVER_OFF = 1.10  # what the guards may cost, as the project has set itself
_TITLES = {"extract": "features", "score": "scores with validity", "solve": "solve with report"}
_KINDS = ("off", "textbook")  # what seconds with guards are compared with


# ------------------------------------------------------------------------------------- numbers
def ratios(sections: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds with guards over seconds without, of calls timed in the same rounds.

    Args:
        sections: name to numbers; any of ``guards.measure.SECTIONS``.

    Returns:
        By section one row per measured row, with ``over_off`` and ``over_textbook``: medians and
        quartiles of the ratios within rounds. Under ``"wide_over_native"``, by threads, what it
        costs to compute float32 bins in float64.
    """
    found: dict[str, Any] = {
        name: [_over(row) for row in of["rows"]] for name, of in sections.items()
    }
    rows = sections.get("extract", {}).get("rows", ())
    seconds = {(row["arithmetic"], row["threads"]): row["guards_s"] for row in rows}
    found["wide_over_native"] = {
        str(threads): paired_ratio(taken, seconds[NATIVE, threads])._asdict()
        for (name, threads), taken in seconds.items()
        if name == WIDE and (NATIVE, threads) in seconds
    }
    return found


def _over(row: Mapping[str, Any]) -> dict[str, Any]:
    facts = {name: row[name] for name in ("arithmetic", "threads", "bins")}
    return facts | {
        f"over_{kind}": paired_ratio(row["guards_s"], row[f"{kind}_s"])._asdict()
        for kind in _KINDS
        if f"{kind}_s" in row
    }


def limit_rows(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every limit beside what was measured, and whether it holds.

    Args:
        sections: name to numbers; limits of absent ones are left out.
    """
    of = ratios(sections)
    return [
        {
            "what": f"{_TITLES[name]}, guards / off, {_about(row)}",
            "measured": _spread(row["over_off"]),
            "limit": f"<= {MOST_OVER_OFF:.2f}",
            "ok": row["over_off"]["median"] <= MOST_OVER_OFF,
        }
        for name in sections
        for row in of[name]
    ]


# -------------------------------------------------------------------------------------- tables
def tables(sections: Mapping[str, Any], ratios: Mapping[str, Any]) -> list[Table]:
    """One of each section.

    Args:
        sections: name to numbers; any of ``SECTIONS``.
        ratios: of ``ratios``.
    """
    return [_table(name, of, ratios) for name, of in sections.items()]


def _table(name: str, numbers: Mapping[str, Any], of: Mapping[str, Any]) -> Table:
    kinds = [kind for kind in _KINDS if f"{kind}_s" in numbers["rows"][0]]
    header = [_TITLES[name], "threads", "bins at once", "guards, us/bin"]
    header += [f"{kind}, us/bin" for kind in kinds] + [f"guards / {kind}" for kind in kinds]
    rows = []
    for row, ratio in zip(numbers["rows"], of[name], strict=True):
        cells = [row["arithmetic"], str(row["threads"]), str(row["bins"])]
        cells += [_per_bin(row[f"{kind}_s"], row["bins"]) for kind in ("guards", *kinds)]
        rows.append(cells + [f"{ratio[f'over_{kind}']['median']:.3f}" for kind in kinds])
    is_features = "textbook" in kinds
    notes = ["textbook: neither guards nor shifted and scaled sums"] if is_features else []
    notes += [_wide_line(of["wide_over_native"])] if is_features else []
    return Table(header, rows, ". ".join(filter(None, notes)))


def _wide_line(of: Mapping[str, Any]) -> str:
    on = [f"{_spread(ratio)} on {threads_text(threads)}" for threads, ratio in of.items()]
    return f"{WIDE} / {NATIVE}: {', '.join(on)} (a choice, not a guard)" if on else ""


def _about(row: Mapping[str, Any]) -> str:
    return f"{row['arithmetic']}, {row['bins']} at once, {threads_text(row['threads'])}"


def _spread(ratio: Mapping[str, float]) -> str:
    return f"{ratio['median']:.3f} ({ratio['low']:.3f} to {ratio['high']:.3f})"


def _per_bin(seconds: Sequence[float], bins: int) -> str:
    return f"{1e6 * median(seconds) / bins:.0f}"
