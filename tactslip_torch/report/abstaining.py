"""Coverage and unsure answers: the table and the figure of ``metrics.json``'s answers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.report.answers import CLASSES, covered_shares
from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_WORDS = {"non_slip": "non-slip", "slip": "slip"}
_COLOURS = {"non_slip": "#0072B2", "slip": "#E69F00"}
_OUTCOMES = {"right": "#009E73", "unsure": "#BBBBBB", "wrong": "#C6361B"}
_INK, _GRID = "#222222", "#DDDDDD"


def answers_table(metrics: Mapping[str, Any]) -> str:
    """A row for each role: what is unsure, how right the rest is, and coverage by class.

    ``covered`` is the mean over recordings of the share of bins that are not answered with the
    other class, ``reached`` the share of recordings that have what was asked in the mean. The
    first line says SIMULATED where the data is.

    Args:
        metrics: the content of ``metrics.json``.
    """
    header = ["answers", "unsure %", "of the sure: right %", "balanced %"]
    for name in CLASSES[::-1]:
        header += [f"{_WORDS[name]}: covered %", "reached %", "unsure %"]
    rows = []
    for role, found in metrics["answers"].items():
        row = [role]
        for share in ("unsure", "sure_accuracy", "sure_balanced_accuracy"):
            row.append(_percent(found[share]))
        for name in CLASSES[::-1]:
            row += [_percent(found[name][part]) for part in ("coverage", "reached", "unsure")]
        rows.append([*row, str(len(found["recordings"]))])
    asked = {found["coverage"] for found in metrics["answers"].values()}
    lines = [SIMULATED_LINE] if metrics["simulated"] else []
    lines += [aligned([*header, "recordings"], rows)]
    lines.append(
        f"asked: {', '.join(f'{100 * one:g}' for one in sorted(asked))} % covered, of either class "
        "in the mean over recordings of materials that were trained on; nothing is promised of "
        "others"
    )
    return "\n".join(lines)


def answers_figure(metrics: Mapping[str, Any], path: str | Path) -> None:
    """Write the coverage of every recording, and what became of the bins of each role, as a PNG.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    answers: Mapping[str, Mapping[str, Any]] = metrics["answers"]
    lanes = [(role, name) for role in answers for name in CLASSES[::-1]]
    figure = Figure(figsize=(11.0, 1.7 + 0.55 * len(lanes)), layout="constrained")
    kind = " (SIMULATED hand)" if metrics["simulated"] else ""
    figure.suptitle(f"Answers that may be unsure: what they cover{kind}", fontsize=12)
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": [1.25, 1.0]})
    for place, (role, name) in enumerate(lanes):
        _recordings(left, place, answers[role], name)
        _outcomes(right, place, answers[role], name)
    asked = {found["coverage"] for found in answers.values()}
    for one in asked:
        left.axvline(100 * one, color=_INK, ls="--", lw=1)
        left.annotate(
            "asked of the mean",
            (100 * one, 1),
            xycoords=("data", "axes fraction"),
            xytext=(-4, 3),
            textcoords="offset points",
            ha="right",
            fontsize=8,
        )
    left.set_yticks(range(len(lanes)), [f"{role}, {_WORDS[name]}" for role, name in lanes])
    left.set_ylim(len(lanes) - 0.5, -0.5)
    left.set_xlabel("covered of a recording's bins, %; bar: mean over recordings")
    right.set_xlabel("of the bins of a class, %")
    right.set_xlim(0, 100)
    handles = [right.barh(0, 0, color=colour, label=word) for word, colour in _OUTCOMES.items()]
    figure.legend(handles=handles, loc="outside lower right", ncols=3, frameon=False, fontsize=8)
    for axes in (left, right):
        axes.grid(axis="x", color=_GRID)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=140, facecolor="white")


def _recordings(axes: Axes, lane: int, found: Mapping[str, Any], name: str) -> None:
    """A dot for each recording, spread over the lane, and their mean."""
    table = torch.tensor(list(found["recordings"].values())).view(-1, 2, 3)
    shares = 100 * covered_shares(table, CLASSES.index(name)).numpy()
    if not len(shares):
        return
    spread = np.linspace(-0.28, 0.28, len(shares)) if len(shares) > 1 else np.zeros(1)
    axes.plot(shares, lane + spread, "o", color=_COLOURS[name], ms=3, alpha=0.6, mew=0)
    axes.plot([shares.mean()] * 2, [lane - 0.38, lane + 0.38], color=_INK, lw=2)


def _outcomes(axes: Axes, lane: int, found: Mapping[str, Any], name: str) -> None:
    """Right, unsure and wrong as one bar."""
    truth = CLASSES.index(name)
    unsure, *sure = found["counts"][truth]
    parts = (sure[truth], unsure, sure[1 - truth])
    start, num = 0.0, max(sum(parts), 1)
    for part, colour in zip(parts, _OUTCOMES.values(), strict=True):
        axes.barh(lane, 100 * part / num, left=start, color=colour, height=0.6)
        start += 100 * part / num


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"
