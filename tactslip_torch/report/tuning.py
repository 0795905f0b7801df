"""What tuning by gradient found, beside the grid it started from: tables and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.files import whole_file
from tactslip_torch.report.tables import SIMULATED_LINE, aligned

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_WAYS = {
    "recipe": "grid, by balanced accuracy",
    "grid": "grid, by loss",
    "tuned": "tuned by gradient",
}


def held_mean(found: Mapping[str, Any], way: str, name: str = "loss") -> float:
    """Mean over held-out groups of what one way of choosing gets there."""
    return mean(float(group[way][name]) for group in found["held"])


def tuning_table(metrics: Mapping[str, Any]) -> str:
    """Loss and accuracy of groups that the choice never met, and accuracy of the detectors.

    Args:
        metrics: the content of ``metrics.json``, of a run with tuning.
    """
    found, splits = metrics["tuning"], metrics["splits"]
    roles = [role for role in splits if splits[role]["balanced_accuracy"] is not None]
    judged = {"recipe": found["splits"], "tuned": splits}
    rows = []
    for way, label in _WAYS.items():
        row = [label, f"{held_mean(found, way):.4f}"]
        row.append(f"{100 * held_mean(found, way, 'balanced_accuracy'):.2f}")
        for role in roles:
            scores = judged.get(way, {}).get(role)
            row.append("" if scores is None else f"{100 * scores['balanced_accuracy']:.2f}")
        rows.append(row)
    header = ["settings", "held-out loss", "held-out %", *(f"{role} %" for role in roles)]
    head = [SIMULATED_LINE] if metrics["simulated"] else []
    return "\n".join([*head, aligned(header, rows), *_notes(found)])


def tuning_figure(found: Mapping[str, Any], path: str | Path, *, simulated: bool) -> None:
    """Write the descents of every held-out group, the one on all, and the learned scales.

    Args:
        found: ``metrics["tuning"]``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.
    """
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    losses, scales = figure.subplots(1, 2, width_ratios=(1.25, 1))
    _descents(losses, found)
    _scales(scales, found["scales"])
    figure.suptitle("Tuning through the fit" + (" (simulated data)" if simulated else ""))
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _notes(found: Mapping[str, Any]) -> Sequence[str]:
    start = found["start"]
    return [
        "held-out: mean log loss (nats) and balanced accuracy of each training group, by settings "
        "chosen without it; ranking and scaling met it",
        f"{found['steps']} steps from C={start['penalty']:g}, c={start['offset']:g} to "
        f"C={found['penalty']:.3g}, c={found['offset']:.3g}; learned: "
        f"{', '.join(found['learned'])}; {found['bins']} bins; tuning took "
        f"{found['seconds']:.0f} s, the first fit with its grid {found['fit_s']:.0f} s",
    ]


def _descents(axes: Axes, found: Mapping[str, Any]) -> None:
    """Losses over steps: dashed of the groups learned on, solid of the one held out."""
    for place, group in enumerate(found["held"]):
        colour = _COLOURS[place % len(_COLOURS)]
        history = group["history"]
        axes.plot([row["held_loss"] for row in history], color=colour, label=group["held"])
        steps = group["tuned"]["steps"]
        axes.plot(steps, history[steps]["held_loss"], "o", color=colour, markersize=5)
    axes.plot(
        [row["loss"] for row in found["history"]], "k--", lw=2, label="all groups, held-out loss"
    )
    axes.axvline(found["steps"], color="#999999", lw=1)
    axes.annotate(
        " steps taken", (found["steps"], 0.99), xycoords=("data", "axes fraction"), va="top",
        fontsize=8, color="#666666",
    )  # fmt: skip
    axes.set_yscale("log")
    axes.set_xlabel("steps")
    axes.set_ylabel("held-out log loss, nats")
    axes.set_title("groups held out; dots: steps that the other groups tell to take", fontsize=10)
    axes.grid(color="#DDDDDD")
    axes.legend(frameon=False, fontsize=8, ncols=2)


def _scales(axes: Axes, scales: Mapping[str, float]) -> None:
    """Learned scales, the largest first; the first and last few are named."""
    ordered = sorted(scales.items(), key=lambda item: -item[1])
    values = [value for _, value in ordered]
    axes.bar(range(len(values)), values, color="#0072B2", width=0.8)
    for place in (*range(min(3, len(ordered))), *range(max(len(ordered) - 3, 3), len(ordered))):
        name, value = ordered[place]
        axes.annotate(
            name, (place, value), rotation=90, fontsize=7, ha="center", va="bottom",
            xytext=(0, 3), textcoords="offset points",
        )  # fmt: skip
    axes.set_ylim(0, 1.7 * max(values))
    axes.axhline(1, color="#999999", lw=1)
    axes.set_xlabel("features, by scale")
    axes.set_ylabel("scale in the kernel")
    axes.set_title("learned scales: soft selection", fontsize=10)
