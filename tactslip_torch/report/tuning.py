"""What tuning by gradient found, beside the grid it started from: tables and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
HELD_NOTE = (
    "held-out: mean log loss (nats) and balanced accuracy of each training group under C, c "
    "and scales that were chosen without it; ranking, ranges, K and, by way of the other "
    "groups' descents, the number of steps met it. The detectors behind the other columns choose "
    "by all groups, the first on more bins"
)
WAYS = {
    "recipe": "grid, by balanced accuracy",
    "grid": "grid, by loss",
    "tuned": "tuned by gradient",
}


def held_mean(found: Mapping[str, Any], way: str, name: str = "loss") -> float:
    """Mean over held-out groups of what one way of choosing gets there."""
    return mean(float(group[way][name]) for group in found["held"])


def tuning_tables(metrics: Mapping[str, Any]) -> list[str]:
    """A table for each fold that was tuned; none where nothing was.

    Args:
        metrics: the content of ``metrics.json``.
    """
    parts = {"": metrics, **metrics.get("folds", {})}
    found = {name: part for name, part in parts.items() if part.get("tuning")}
    texts = [_table(part["tuning"], part["splits"], name) for name, part in found.items()]
    head = [SIMULATED_LINE] if metrics["simulated"] else []
    return ["\n".join([*head, text]) for text in texts]


def _table(found: Mapping[str, Any], splits: Mapping[str, Any], fold: str) -> str:
    """Loss and accuracy of groups that the choice never met, and accuracy of the detectors."""
    roles = [role for role in splits if splits[role]["balanced_accuracy"] is not None]
    judged = {**found["splits"], "tuned": splits}
    rows = []
    for way, label in WAYS.items():
        accuracy = held_mean(found, way, "balanced_accuracy")
        of_roles = [judged[way][role]["balanced_accuracy"] for role in roles]
        row = [f"{100 * value:.2f}" for value in (accuracy, *of_roles)]
        rows.append([label, f"{held_mean(found, way):.4f}", *row])
    header = [f"tuning {fold}".strip(), "held-out loss", "held-out %", *(f"{r} %" for r in roles)]
    return "\n".join([aligned(header, rows), *_notes(found)])


def tuning_figure(found: Mapping[str, Any], path: str | Path, *, simulated: bool) -> None:
    """Write the descents of every held-out group, the one on all, and the learned scales.

    Args:
        found: ``metrics["tuning"]``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.
    """
    has_scales = "scales" in found["learned"]
    figure = Figure(figsize=(12.5 if has_scales else 7.5, 4.2), layout="constrained")
    losses, *scales = figure.subplots(1, 1 + has_scales, squeeze=False)[0]
    _descents(losses, found)
    if scales:
        _scales(scales[0], found["scales"])
    figure.suptitle("Tuning through the fit" + (" (simulated data)" if simulated else ""))
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _notes(found: Mapping[str, Any]) -> Sequence[str]:
    start = found["start"]
    return [
        HELD_NOTE,
        f"{found['steps']} steps from C={start['penalty']:g}, c={start['offset']:g} to "
        f"C={found['penalty']:.3g}, c={found['offset']:.3g}; learned: "
        f"{', '.join(found['learned'])}; {found['bins']} bins; tuning took "
        f"{found['seconds']:.0f} s, the first fit with its grid {found['fit_s']:.0f} s",
    ]


def _descents(axes: Axes, found: Mapping[str, Any]) -> None:
    """Losses over steps: of each held-out group, their mean, which decides, and of what learns."""
    for place, group in enumerate(found["held"]):
        colour = _COLOURS[place % len(_COLOURS)]
        losses = [row["held_loss"] for row in group["history"]]
        axes.plot(losses, color=colour, lw=1, label=group["held"])
        steps = group["tuned"]["steps"]
        axes.plot(steps, losses[steps], "o", color=colour, markersize=4)
    rows = zip(
        *([row["held_loss"] for row in one["history"]] for one in found["held"]), strict=True
    )
    axes.plot([mean(row) for row in rows], "k-", lw=2.5, label="their mean, which decides")
    learning = [row["loss"] for row in found["history"]]
    axes.plot(learning, "k--", lw=1.5, label="what is learned on")
    axes.axvline(found["steps"], color="#999999", lw=1)
    axes.annotate(
        " steps taken", (found["steps"], 0.99), xycoords=("data", "axes fraction"), va="top",
        fontsize=8, color="#666666",
    )  # fmt: skip
    axes.set_ylim(bottom=0)
    axes.set_xlabel("steps")
    axes.set_ylabel("held-out log loss, nats")
    axes.set_title("groups held out; dots: steps that the others tell to take", fontsize=10)
    axes.grid(color="#DDDDDD")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _scales(axes: Axes, scales: Mapping[str, float]) -> None:
    """Learned scales, the largest first; the first and last few are named."""
    ordered = sorted(scales.items(), key=lambda item: -item[1])
    values = [value for _, value in ordered]
    axes.bar(range(len(values)), values, color="#0072B2", width=0.8)
    axes.axhline(1, color="#999999", lw=1)
    for heading, some in (("largest", ordered[:3]), ("smallest", ordered[-3:][::-1])):
        lines = [f"{heading}:", *(f"{value:.2f}  {name}" for name, value in some)]
        left = heading == "largest"
        axes.text(
            0.02 if left else 0.98, 0.98, "\n".join(lines), transform=axes.transAxes, va="top",
            ha="left" if left else "right", fontsize=7,
        )  # fmt: skip
    axes.set_ylim(0, 1.5 * max(values))
    axes.set_xlabel("features, by scale")
    axes.set_ylabel("scale in the kernel")
    axes.set_title("learned scales: soft selection", fontsize=10)
