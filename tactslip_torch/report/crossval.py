"""What ``crossval`` found over all choices of unseen materials: a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

PAPERS_UNSEEN = frozenset({"iron", "cloth", "copper", "wood"})
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def crossval_table(found: Mapping[str, Any]) -> str:
    """Balanced accuracy in percent over all splits, of each recipe; then of each unseen material.

    Args:
        found: the content of ``crossval.json``.
    """
    head = [SIMULATED_LINE] if found["simulated"] else []
    head.append(
        f"balanced accuracy %, every choice of {found['num_unseen']} unseen materials of "
        f"{len(found['materials'])}; fitted on {found['train_bins']} bins of each material and "
        "class"
    )
    splits, materials = split_rows(found), material_rows(found)
    parts = [aligned(splits[0], splits[1:], num_left=2), aligned(materials[0], materials[1:])]
    return "\n".join(head) + "\n\n" + "\n\n".join(parts)


def split_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """A header and one row per recipe and role: how the scores of all splits lie."""
    rows = [["recipe", "judged on", "mean", "sd", "least", "5 %", "median", "most"]]
    rows[0] += ["the paper's four", "splits"]
    for name, splits in found["splits"].items():
        for role in ("test", "unseen"):
            scores = sorted(_scores(splits, role))
            if not scores:
                rows.append([name, role, *["-"] * 7, "0"])
                continue
            of_all = [mean(scores), _spread(scores), scores[0], _quantile(scores, 0.05)]
            of_all += [median(scores), scores[-1]]
            cells = _percents(*of_all, _of_paper(splits, role))
            rows.append([name, role, *cells, str(len(scores))])
    return rows


def material_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """A header and one row per material: its scores in the splits where it is unseen."""
    header = ["unseen material"]
    for name in found["splits"]:
        header += [f"{name} mean", "sd"]
    rows = [header]
    for material in found["materials"]:
        cells = []
        for splits in found["splits"].values():
            scores = material_scores(splits, material)
            cells += _percents(mean(scores) if scores else None, _spread(scores))
        rows.append([material, *cells])
    return rows


def crossval_figure(found: Mapping[str, Any], path: str | Path) -> None:
    """Write the distribution over splits, and the scores of each unseen material, as a PNG.

    Args:
        found: the content of ``crossval.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    kind = "SIMULATED hand" if found["simulated"] else "recorded"
    figure.suptitle(
        f"Every choice of {found['num_unseen']} unseen materials of {len(found['materials'])} "
        f"({kind})",
        fontsize=13,
    )
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.25))
    _distribution(left, found)
    _by_material(right, found)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=150)


def material_scores(splits: Sequence[Mapping[str, Any]], material: str) -> list[float]:
    """Balanced accuracies of a material in the splits where it is unseen."""
    scores = [split["per_material"].get(material) for split in splits]
    return [score for score in scores if score is not None]


def _distribution(axes: Axes, found: Mapping[str, Any]) -> None:
    """Splits in the order of their scores; the paper's own choice is marked."""
    for number, (name, splits) in enumerate(found["splits"].items()):
        colour = _COLOURS[number % len(_COLOURS)]
        known = [split for split in splits if split["unseen"] is not None]
        ordered = sorted(known, key=lambda split: float(split["unseen"]))
        scores = [100 * float(split["unseen"]) for split in ordered]
        share = [(place + 0.5) / len(scores) for place in range(len(scores))]
        label = f"{name}: mean {mean(scores):.1f}"
        axes.plot(scores, share, color=colour, linewidth=2, label=label)
        for place, split in enumerate(ordered):
            if frozenset(split["materials"]) == PAPERS_UNSEEN:
                axes.plot(scores[place], share[place], "o", color=colour, markersize=8)
    axes.set_xlabel("balanced accuracy on the unseen materials, %")
    axes.set_ylabel("share of splits at or below")
    axes.set_ylim(0, 1)
    axes.grid(color="#DDDDDD")
    axes.set_title("over all splits; dot: the paper's four", fontsize=10)
    axes.legend(frameon=False, loc="upper left")


def _by_material(axes: Axes, found: Mapping[str, Any]) -> None:
    """Mean and spread of each material over the splits where it is unseen."""
    count = len(found["splits"])
    for number, splits in enumerate(found["splits"].values()):
        for place, material in enumerate(found["materials"]):
            scores = material_scores(splits, material)
            if not scores:
                continue
            x = place + (number - (count - 1) / 2) * 0.25
            colour = _COLOURS[number % len(_COLOURS)]
            axes.errorbar(
                x,
                100 * mean(scores),
                yerr=100 * _spread(scores),
                fmt="o",
                color=colour,
                capsize=3,
            )
    axes.set_xticks(range(len(found["materials"])), found["materials"], rotation=30)
    axes.set_ylabel("balanced accuracy, %")
    axes.grid(axis="y", color="#DDDDDD")
    axes.set_title("each material where it is unseen: mean and sd over splits", fontsize=10)


def _scores(splits: Sequence[Mapping[str, Any]], role: str) -> list[float]:
    return [split[role] for split in splits if split[role] is not None]


def _of_paper(splits: Sequence[Mapping[str, Any]], role: str) -> float | None:
    """The split that leaves out the materials that the paper does."""
    return next(
        (split[role] for split in splits if frozenset(split["materials"]) == PAPERS_UNSEEN), None
    )


def _spread(scores: Sequence[float]) -> float:
    return stdev(scores) if len(scores) > 1 else 0.0


def _quantile(ordered: Sequence[float], share: float) -> float:
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def _percents(*fractions: float | None) -> list[str]:
    return ["-" if fraction is None else f"{100 * fraction:.2f}" for fraction in fractions]
