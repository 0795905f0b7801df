"""Incremental learning: before and after as a table and a figure, and a detector's journal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactslip_torch.report import style

_BEFORE = "#999999"


def adaptation_table(content: Mapping[str, Any]) -> str:
    """Balanced accuracy of every old material and of the new recordings, before and after.

    Args:
        content: of ``adaptation.json``.
    """
    rows = []
    for name, before, after in _scores(content):
        row: dict[str, object] = {
            "balanced accuracy %": name,
            "before": style.percent(before),
            "after": style.percent(after),
        }
        rows.append(row | {"points": None if after is None else f"{100 * (after - before):+.2f}"})
    blocks = [style.marked(content["simulated"], _action(content)), style.table(rows)]
    if len(content["tried"]) > 1:
        names = ("weight, in average old materials", "old lose, points")
        tried = [(f"{factor:g}", style.percent(loss)) for factor, loss in content["tried"]]
        blocks.append(style.table([dict(zip(names, row, strict=True)) for row in tried]))
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in content["seconds"].items())
    return "\n\n".join([*blocks, f"took {seconds}"])


def journal_table(steps: Sequence[Mapping[str, Any]]) -> str:
    """Every step of a detector since it was trained, first to last."""
    if not steps:
        return "no step since training"
    rows = []
    for number, step in enumerate(steps, 1):
        row = {"step": number, "when (UTC)": step["when"], "action": step["action"]}
        row |= {"material": ", ".join(step["materials"]), "recordings": len(step["recordings"])}
        row |= {"weight": None if step["weight"] is None else f"{step['weight']:.3g}"}
        rows.append(row | {"slip-free": bool(step["slip_free"]), "forced": bool(step["forced"])})
    return style.table(rows, num_left=4)


@style.styled
def adaptation_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write before and after of every material as a line between two dots.

    Args:
        content: of ``adaptation.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    rows = _scores(content)
    figure = style.new_figure(7.2, 1.7 + 0.36 * len(rows))
    axes = figure.subplots()
    for place, (name, before, after) in enumerate(rows):
        is_new = bool(content["new"]) and place == len(rows) - 1 and name.endswith("(new)")
        colour = style.VERMILION if is_new else style.BLUE
        if after is not None:
            between = [100 * before, 100 * after]
            axes.plot(between, [place] * 2, color=colour, lw=2, alpha=0.5, zorder=1)
            axes.scatter(100 * after, place, color=colour, s=42, zorder=3)
        axes.scatter(100 * before, place, color=_BEFORE, s=42, zorder=2)
    labels = {_BEFORE: "before", style.BLUE: "after, old"}
    for colour, label in (
        labels | ({style.VERMILION: "after, new"} if content["new"] else {})
    ).items():
        axes.scatter([], [], color=colour, s=42, label=label)
    style.lanes(axes, [name for name, _, _ in rows])
    axes.set_xlabel("balanced accuracy by the machine without the recording, %")
    result = "accepted" if content["accepted"] else "refused"
    kind = ", SIMULATED data" if content["simulated"] else ""
    axes.set_title(f"{_action(content)}: {result}{kind}")
    axes.legend(**style.UPPER_LEFT_OUTSIDE)
    style.save(figure, path)


def _action(content: Mapping[str, Any]) -> str:
    """What was done, in words."""
    count = len(content["recordings"])
    recordings = "1 recording" if count == 1 else f"{count} recordings"
    kind = " (non-slip bins alone)" if content["slip_free"] else ""
    weight = content["weight"]
    weighted = "" if weight is None else f", each bin with weight {weight:.3g}"
    materials = ", ".join(content["materials"])
    return f"{content['action']} {recordings} of {materials}{kind}{weighted}"


def _scores(content: Mapping[str, Any]) -> list[tuple[str, float, float | None]]:
    """Name, before and after: old materials, their mean, and the new one."""
    before, after = content["old"]["before"], content["old"]["after"]
    rows: list[tuple[str, float, float | None]] = [(n, before[n], after[n]) for n in sorted(before)]
    if len(rows) > 1:
        means = [sum(of.values()) / len(of) for of in (before, after)]
        rows.append(("mean of old materials", means[0], means[1]))
    if new := content["new"]:
        rows.append((f"{', '.join(content['materials'])} (new)", new["before"], new["after"]))
    return rows
