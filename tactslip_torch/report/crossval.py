"""Scores over all choices of held-out materials: tables and a figure of ``crossval.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

from matplotlib.axes import Axes

from tactslip_torch.report import style

PAPERS_UNSEEN = frozenset({"iron", "cloth", "copper", "wood"})


def crossval_table(content: Mapping[str, Any]) -> str:
    """Balanced accuracy in percent over all splits, of each recipe; then of each unseen material.

    Args:
        content: of ``crossval.json``.
    """
    line = (
        f"balanced accuracy %, every choice of {content['num_unseen']} unseen materials of "
        f"{len(content['materials'])}; fitted on {content['train_bins']} bins of each material and "
        "class"
    )
    tables = (style.table(split_rows(content), num_left=2), style.table(material_rows(content)))
    return style.marked(content["simulated"], line, "", "\n\n".join(tables))


def split_rows(content: Mapping[str, Any]) -> list[dict[str, object]]:
    """One row per recipe and role: the distribution of the scores of all splits."""
    rows: list[dict[str, object]] = []
    for name, splits in content["splits"].items():
        for role in ("test", "unseen"):
            scores = sorted(split[role] for split in splits if split[role] is not None)
            known = scores or [None]
            papers = next((split[role] for split in splits if _is_papers(split)), None)
            numbers = {
                "mean": mean(scores) if scores else None,
                "sd": _spread(scores) if scores else None,
                "least": known[0],
                "5 %": known[int(0.05 * len(known))],
                "median": median(scores) if scores else None,
                "most": known[-1],
                "the paper's four": papers,
            }
            row = {title: style.percent(value) for title, value in numbers.items()}
            rows.append({"recipe": name, "evaluated on": role, **row, "splits": len(scores)})
    return rows


def material_rows(content: Mapping[str, Any]) -> list[dict[str, object]]:
    """One row per material: its scores in the splits where it is unseen."""
    rows: list[dict[str, object]] = []
    for material in content["materials"]:
        row: dict[str, object] = {"unseen material": material}
        for name, splits in content["splits"].items():
            scores = material_scores(splits, material)
            row[f"{name} mean"] = style.percent(mean(scores) if scores else None)
            row[f"{name} sd"] = style.percent(_spread(scores))
        rows.append(row)
    return rows


@style.styled
def crossval_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write the distribution over splits, and the scores of each unseen material, as a PNG.

    Args:
        content: of ``crossval.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    title = (
        f"Every choice of {content['num_unseen']} unseen materials of {len(content['materials'])}"
    )
    figure = style.new_figure(11, 4.6, title, simulated=content["simulated"])
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.25))
    colours = style.colours_of(content["splits"])
    _distribution(left, content, colours)
    _by_material(right, content, colours)
    style.save(figure, path)


def material_scores(splits: Sequence[Mapping[str, Any]], material: str) -> list[float]:
    """Balanced accuracies of a material in the splits where it is unseen."""
    scores = [split["per_material"].get(material) for split in splits]
    return [score for score in scores if score is not None]


def _distribution(axes: Axes, content: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """Splits in the order of their scores; the paper's own choice is marked."""
    for name, splits in content["splits"].items():
        known = [split for split in splits if split["unseen"] is not None]
        known.sort(key=lambda split: float(split["unseen"]))
        scores = [100 * split["unseen"] for split in known]
        fraction = [(place + 0.5) / len(scores) for place in range(len(scores))]
        label = f"{name}: mean {mean(scores):.1f}"
        axes.plot(scores, fraction, color=colours[name], linewidth=2, label=label)
        for place in (place for place, split in enumerate(known) if _is_papers(split)):
            axes.plot(scores[place], fraction[place], "o", color=colours[name], markersize=8)
    axes.set_xlabel("balanced accuracy on the unseen materials, %")
    axes.set(ylabel="fraction of splits at or below", ylim=(0, 1))
    axes.set_title("over all splits; dot: the paper's four")
    axes.legend(loc="upper left")


def _by_material(axes: Axes, content: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """Mean and spread of each material over the splits where it is unseen."""
    for number, (name, splits) in enumerate(content["splits"].items()):
        aside = (number - (len(colours) - 1) / 2) * 0.25
        for place, material in enumerate(content["materials"]):
            if scores := material_scores(splits, material):
                look: dict[str, Any] = {"fmt": "o", "color": colours[name], "capsize": 3}
                spread = 100 * _spread(scores)
                axes.errorbar(place + aside, 100 * mean(scores), yerr=spread, **look)
    axes.set_xticks(range(len(content["materials"])), content["materials"], rotation=30)
    axes.set_ylabel("balanced accuracy, %")
    axes.set_title("each material where it is unseen: mean and sd over splits")


def _is_papers(split: Mapping[str, Any]) -> bool:
    """Whether a split leaves out the materials that the paper does."""
    return frozenset(split["materials"]) == PAPERS_UNSEEN


def _spread(scores: Sequence[float]) -> float:
    return stdev(scores) if len(scores) > 1 else 0.0
