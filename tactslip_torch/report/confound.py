"""Does it feel slip, or hear the arm? Scores by kind of scene, detectors side by side.

In the paper's protocol the hand slides whenever the arm moves, so a detector of motors scores well
there. Scenes in which one happens without the other tell them apart: a table and a figure of any
results that hold several kinds of scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_INK, _GREY, _GRID = "#222222", "#666666", "#DDDDDD"
_JUDGED = {"test": "test cycles of seen materials", "unseen": "unseen materials"}
_HEADER = ["judged on", "scene", "detector", "trained on it", "bins"]
_HEADER += ["non-slip %", "slip %", "balanced %"]


class _Scored(NamedTuple):
    """Scores of one detector on one kind of scene."""

    role: str
    scene: str
    detector: str
    is_trained: bool | None
    scores: Mapping[str, Any]


def by_detector(metrics: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The splits of each fold, or of the one detector, if some held out are of several scenes.

    Empty otherwise, so that it also says whether there is anything to compare.

    Args:
        metrics: the content of ``metrics.json``.
    """
    folds = {name: fold["splits"] for name, fold in metrics.get("folds", {}).items()}
    found = folds or {"detector": metrics["splits"]}
    several = any(
        len(split.get("per_scene", {})) > 1
        for splits in found.values()
        for role, split in splits.items()
        if role != "train"
    )
    return found if several else {}


def confound_table(metrics: Mapping[str, Any]) -> str:
    """Bins, recalls and balanced accuracy of each detector on each kind of scene, held out.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows = confound_rows(metrics)
    head = [SIMULATED_LINE] if metrics["simulated"] else []
    return "\n".join([*head, aligned(rows[0], rows[1:], num_left=4)])


def confound_rows(metrics: Mapping[str, Any]) -> list[list[str]]:
    """A header and one row per split, scene and detector; detectors on the same bins are beside.

    ``trained on it`` says whether other cycles of that scene were trained on, ``-`` where the
    results do not tell. A class without bins has the recall ``-``.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows = [_HEADER]
    for role, scene, detector, is_trained, scores in _scored(metrics):
        trained = "-" if is_trained is None else ("no", "yes")[is_trained]
        keys = ("non_slip_recall", "slip_recall", "balanced_accuracy")
        cells = [_percent(scores[key]) for key in keys]
        rows.append([role, scene, detector, trained, str(scores["num_bins"]), *cells])
    return rows


def confound_figure(metrics: Mapping[str, Any], path: str | Path) -> None:
    """Write false slips and slips found on each kind of scene as a PNG, a dot for each detector.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.

    Raises:
        ValueError: if there are no several kinds of scenes.
    """
    scored = list(_scored(metrics))
    if not scored:
        raise ValueError("metrics has no split with several kinds of scenes to draw")
    roles = list(dict.fromkeys(one.role for one in scored))
    scenes = list(dict.fromkeys(one.scene for one in scored))[::-1]  # the first one on top
    detectors = list(dict.fromkeys(one.detector for one in scored))
    colours = {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(detectors)}
    height = 1.7 + len(roles) * (0.8 + 0.28 * len(scenes))
    figure = Figure(figsize=(10.5, height), layout="constrained")
    kind = " (SIMULATED hand)" if metrics["simulated"] else ""
    figure.suptitle(f"Does it feel slip, or hear the arm?{kind}", fontsize=13)
    panels = figure.subplots(len(roles), 2, sharex="col", sharey=True, squeeze=False)
    for row, role in enumerate(roles):
        own = [one for one in scored if one.role == role]
        _dots(panels[row][0], own, scenes, colours, "non_slip_recall", is_error=True)
        _dots(panels[row][1], own, scenes, colours, "slip_recall", is_error=False)
        panels[row][0].set_title(_JUDGED.get(role, role), loc="left", fontsize=10.5)
    panels[-1][0].set_xlim(left=0)
    panels[-1][1].set_xlim(right=100)
    panels[-1][0].set_xlabel("false slips, % of non-slip bins: fewer is better", fontsize=9.5)
    panels[-1][1].set_xlabel("slips found, % of slip bins: more is better", fontsize=9.5)
    _legend(figure, colours, scored)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _scored(metrics: Mapping[str, Any]) -> Iterator[_Scored]:
    """Scores by role, then scene, then detector: the paper's scene first, then those trained on."""
    found = by_detector(metrics)
    is_fit = "detector" not in metrics  # evaluate's training role is not what was trained on
    trained = {
        name: set(splits.get("train", {}).get("per_scene", {})) for name, splits in found.items()
    }
    of_any = set().union(*trained.values()) if is_fit else set()
    roles = dict.fromkeys(role for splits in found.values() for role in splits if role != "train")
    for role in roles:
        having = {name: splits[role] for name, splits in found.items() if role in splits}
        scenes = dict.fromkeys(scene for split in having.values() for scene in split["per_scene"])
        for scene in sorted(scenes, key=lambda scene: (scene != "paper", scene not in of_any)):
            for name, split in having.items():
                if scene in split["per_scene"]:
                    is_trained = scene in trained[name] if is_fit else None
                    yield _Scored(role, scene, name, is_trained, split["per_scene"][scene])


def _dots(
    axes: Axes,
    scored: Sequence[_Scored],
    scenes: Sequence[str],
    colours: Mapping[str, str],
    key: str,
    *,
    is_error: bool,
) -> None:
    """A line per scene with a dot for each detector: the recall in percent, or what it lacks.

    Dots of a scene stand a little below each other, so that equal ones are seen.
    """
    for place, scene in enumerate(scenes):
        own = [one for one in scored if one.scene == scene and one.scores[key] is not None]
        if not own:
            words = "nothing but slip" if is_error else "no slip in this scene"
            style: dict[str, Any] = {
                "fontsize": 8.5,
                "color": _GREY,
                "ha": "center",
                "va": "center",
            }
            style["bbox"] = {"fc": "white", "ec": "none", "pad": 2.0}
            axes.annotate(words, (0.5, place), xycoords=axes.get_yaxis_transform(), **style)
            continue
        values = [100 * (1 - one.scores[key] if is_error else one.scores[key]) for one in own]
        below = [0.13 * (len(own) - 1 - 2 * number) for number in range(len(own))]
        heights = [place + step / max(1, len(own) - 1) for step in below]
        axes.plot(values, heights, color="#BBBBBB", lw=2, zorder=1)
        for one, value, height in zip(own, values, heights, strict=True):
            colour = colours[one.detector]
            fill = "white" if one.is_trained is False else colour
            style = {"color": colour, "mfc": fill, "mew": 1.8, "ms": 7.5, "clip_on": False}
            axes.plot(value, height, "o", zorder=2, **style)
    names = ["paper's protocol" if name == "paper" else name.replace("_", " ") for name in scenes]
    axes.set_yticks(range(len(scenes)), names, fontsize=9.5)
    axes.set_ylim(-0.6, len(scenes) - 0.4)
    axes.grid(color=_GRID)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelcolor=_INK)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _legend(figure: Figure, colours: Mapping[str, str], scored: Sequence[_Scored]) -> None:
    style: dict[str, Any] = {"marker": "o", "ls": "", "ms": 7.5, "mew": 1.8}
    handles = [
        Line2D([], [], color=colour, label=name, **style) for name, colour in colours.items()
    ]
    if any(one.is_trained is False for one in scored):
        words = {_GREY: "trained on other cycles of that scene", "white": "never met that scene"}
        for fill, label in words.items():
            handles.append(Line2D([], [], color=_GREY, mfc=fill, label=label, **style))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{100 * fraction:.2f}"
