"""What closed-form validation on held-out groups found for every choice: a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tactslip_torch.files import whole_file
from tactslip_torch.report.tables import SIMULATED_LINE, aligned

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def validation_table(rows: Sequence[Mapping[str, Any]], *, simulated: bool) -> str:
    """The mean balanced accuracy of every choice of K, kernel and C, and of its worst group.

    Args:
        rows: of ``metrics["validation"]``.
        simulated: whether the data is.
    """
    best = max(row["mean"] for row in rows)
    first = next(place for place, row in enumerate(rows) if row["mean"] == best)
    cells = []
    for place, row in enumerate(rows):
        scores = {k: v for k, v in row["balanced_accuracy"].items() if v is not None}
        worst = min(scores, key=lambda name: scores[name])
        cells.append(
            [
                "*" if place == first else "",
                str(row["num_features"]),
                _kernel(row["kernel"]),
                f"{row['penalty']:g}",
                f"{100 * row['mean']:.2f}",
                f"{100 * scores[worst]:.2f}",
                worst,
            ]
        )
    header = ["chosen", "K", "kernel", "C", "validation %", "worst %", "group"]
    head = [SIMULATED_LINE] if simulated else []
    return "\n".join([*head, aligned(header, cells)])


def validation_figure(
    rows: Sequence[Mapping[str, Any]], path: str | Path, *, simulated: bool
) -> None:
    """Write the held-out balanced accuracy over C: a line per K and kernel, thin ones by group.

    Args:
        rows: of ``metrics["validation"]``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.
    """
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    choices = list(dict.fromkeys((row["num_features"], _kernel(row["kernel"])) for row in rows))
    best = max(row["mean"] for row in rows)
    for place, choice in enumerate(choices):
        own = [r for r in rows if (r["num_features"], _kernel(r["kernel"])) == choice]
        own.sort(key=lambda row: float(row["penalty"]))
        penalties = [row["penalty"] for row in own]
        colour = _COLOURS[place % len(_COLOURS)]
        label = f"K = {choice[0]}, {choice[1]}: mean"
        axes.plot(penalties, [100 * r["mean"] for r in own], "o-", color=colour, label=label, lw=2)
        for group in own[0]["balanced_accuracy"]:
            scores = [100 * (r["balanced_accuracy"][group] or float("nan")) for r in own]
            axes.plot(penalties, scores, color=colour, lw=0.7, alpha=0.5)
            if place == len(choices) - 1:
                axes.annotate(
                    f"  {group}", (penalties[-1], scores[-1]), fontsize=8, color="#666666"
                )
    chosen = next(row for row in rows if row["mean"] == best)
    axes.plot(chosen["penalty"], 100 * best, "*", color="black", markersize=14, label="chosen")
    axes.set_xscale("log")
    axes.set_xlabel("C")
    axes.set_ylabel("balanced accuracy, group left out, ranking held, %")
    kind = " (simulated data)" if simulated else ""
    axes.set_title(f"Choice on training groups left out one at a time{kind}", fontsize=11)
    axes.grid(color="#DDDDDD")
    axes.legend(frameon=False, fontsize=8, loc="lower left")
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _kernel(facts: Mapping[str, Any]) -> str:
    if facts["kind"] == "polynomial":
        return f"degree {facts['degree']}, c {facts['offset']:g}"
    return f"rbf, gamma {facts['gamma']:g}"
