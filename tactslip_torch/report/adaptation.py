"""What adding or taking out recordings did: a table, a figure, and the journal of a detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_BEFORE, _AFTER, _NEW = "#999999", "#0072B2", "#D55E00"


def adaptation_table(found: Mapping[str, Any]) -> str:
    """Balanced accuracy of every old material and of the new recordings, before and after.

    Args:
        found: the content of ``adaptation.json``.
    """
    rows = [[name, _percent(a), _percent(b), _points(a, b)] for name, a, b in _scores(found)]
    header = ["balanced accuracy %", "before", "after", "points"]
    head = [SIMULATED_LINE] if found["simulated"] else []
    head.append(_what(found))
    parts = ["\n".join(head), aligned(header, rows)]
    if len(found["tried"]) > 1:
        tried = [[f"{factor:g}", f"{100 * fall:.2f}"] for factor, fall in found["tried"]]
        parts.append(aligned(["weight, in average old materials", "old lose, points"], tried))
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in found["seconds"].items())
    return "\n\n".join([*parts, f"took {seconds}"])


def journal_table(steps: Sequence[Mapping[str, Any]]) -> str:
    """Every step of a detector since it was trained, first to last."""
    if not steps:
        return "no step since training"
    rows = [
        [
            str(number),
            step["when"],
            step["action"],
            ", ".join(step["materials"]),
            str(len(step["recordings"])),
            "-" if step["weight"] is None else f"{step['weight']:.3g}",
            "yes" if step["slip_free"] else "no",
            "yes" if step["forced"] else "no",
        ]
        for number, step in enumerate(steps, 1)
    ]
    header = ["step", "when (UTC)", "action", "material", "recordings", "weight", "slip-free"]
    return aligned([*header, "forced"], rows, num_left=4)


def adaptation_figure(found: Mapping[str, Any], path: str | Path) -> None:
    """Write before and after of every material as a line between two dots.

    Args:
        found: the content of ``adaptation.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    rows = _scores(found)
    figure = Figure(figsize=(7.2, 1.7 + 0.36 * len(rows)), layout="constrained")
    axes = figure.subplots()
    num_new = 1 if found["new"] else 0
    for place, (name, before, after) in enumerate(reversed(rows)):
        colour = _NEW if place < num_new and name.endswith("(new)") else _AFTER
        known = [100 * value for value in (before, after) if value is not None]
        axes.plot(known, [place] * len(known), color=colour, lw=2, alpha=0.5, zorder=1)
        axes.scatter(100 * before, place, color=_BEFORE, s=42, zorder=2)
        if after is not None:
            axes.scatter(100 * after, place, color=colour, s=42, zorder=3)
    axes.scatter([], [], color=_BEFORE, s=42, label="before")
    axes.scatter([], [], color=_AFTER, s=42, label="after, old")
    if found["new"]:
        axes.scatter([], [], color=_NEW, s=42, label="after, new")
    axes.set_yticks(range(len(rows)), [name for name, _, _ in reversed(rows)])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.set_xlabel("balanced accuracy by the machine without the recording, %")
    axes.grid(axis="x", color="#DDDDDD")
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.tick_params(axis="y", length=0)
    kind = ", simulated data" if found["simulated"] else ""
    verdict = "accepted" if found["accepted"] else "refused"
    axes.set_title(f"{_what(found)}: {verdict}{kind}", fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _what(found: Mapping[str, Any]) -> str:
    count, names = len(found["recordings"]), ", ".join(found["materials"])
    kind = " (non-slip bins alone)" if found["slip_free"] else ""
    weight = "" if found["weight"] is None else f", each bin with weight {found['weight']:.3g}"
    recordings = "recording" if count == 1 else "recordings"
    return f"{found['action']} {count} {recordings} of {names}{kind}{weight}"


def _scores(found: Mapping[str, Any]) -> list[tuple[str, float, float | None]]:
    """Name, before and after: old materials, their mean, and the new one."""
    before, after = found["old"]["before"], found["old"]["after"]
    rows: list[tuple[str, float, float | None]] = [(n, before[n], after[n]) for n in sorted(before)]
    if len(rows) > 1:
        means = [sum(of.values()) / len(of) for of in (before, after)]
        rows.append(("mean of old materials", means[0], means[1]))
    if new := found["new"]:
        rows.append((f"{', '.join(found['materials'])} (new)", new["before"], new["after"]))
    return rows


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}"


def _points(before: float, after: float | None) -> str:
    return "-" if after is None else f"{100 * (after - before):+.2f}"
