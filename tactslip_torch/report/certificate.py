"""A certificate in one line and in one figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Points = Mapping[str, tuple[Sequence[float], Sequence[float], Sequence[bool]]]
"""By set or kind: ``|score|``, size of its error and whether the decision flips, for each bin."""

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
_BAD, _INK, _GREY, _GRID = "#B84300", "#222222", "#666666", "#DDDDDD"
_SMALL = 9  # points


def verdict(content: Mapping[str, Any]) -> str:
    """The certificate in one line."""
    kind = " (simulated data)" if content["simulated"] else ""
    failed = [row for row in content["conditions"] if row["holds"] is False]
    if failed:
        row = failed[0]
        others = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        found = f"{row['name']} is {found_in(row)}, wanted {row['wanted']}"
        return f"Does not hold: {found}{others}{kind}"
    margin = content["margin"]
    measured = ", as measured: this head has no bound" if content["head"]["bound"] is None else ""
    judged = "" if len(content["sets"]) > 1 else "; no held-out bins were judged"
    return (
        f"Holds: float32 decides as float64 does where |score| exceeds {margin['score']:.1e}, "
        f"{100 * margin['sd']:.2g} % of its standard deviation{measured}{judged}{kind}"
    )


def number(value: object) -> str:
    """A value as people read it: few digits, a dash for what is not there.

    Example:
        >>> number(1.23456e-7), number(0.25), number(1200), number(None), number("Cholesky")
        ('1.2e-07', '0.25', '1200', '-', 'Cholesky')
    """
    if value is None:
        return "-"
    if isinstance(value, float) and value != 0:
        return f"{value:.3g}" if 1e-2 <= abs(value) < 1e4 else f"{value:.1e}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def found_in(condition: Mapping[str, Any]) -> str:
    """What was found for a condition, in words where it is no number."""
    if condition["found"] is None and condition["holds"] is False:
        return "not finite"
    return number(condition["found"])


def certificate_figure(content: Mapping[str, Any], points: Points) -> Figure:
    """Error against ``|score|`` with margin and bound, and the errors of each kind of extremes.

    Args:
        content: of ``certificate.json``.
        points: of every set and kind.
    """
    figure = Figure(figsize=(11.0, 4.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.15, 1])
    _scatter(left, content, {name: points[name] for name in content["sets"]})
    _bars(right, content["extremes"])
    kind = "simulated recordings" if content["simulated"] else "recordings"
    _titled(left, f"(a) every bin of {kind}", "both")
    _titled(right, "(b) generated extremes (grey: flagged)", "x")
    return figure


def _titled(axes: Axes, title: str, gridded: Literal["both", "x"]) -> None:
    axes.set_title(title, loc="left", fontsize=11)
    axes.grid(axis=gridded, color=_GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=_SMALL, labelcolor=_GREY)
    axes.spines[["top", "right"]].set_visible(False)


def _scatter(axes: Axes, content: Mapping[str, Any], points: Points) -> None:
    """Above the diagonal an error is larger than its score: only there a decision can flip."""
    scores, errors = (np.concatenate([np.asarray(p[i]) for p in points.values()]) for i in (0, 1))
    margin, bound = content["margin"]["score"], content["head"]["bound"]
    known = [value for value in (margin, bound) if value]
    floor = _floor([*errors.tolist(), *known])
    low, high = _floor([*scores.tolist(), *known]) / 2, 2 * max(scores.max(), *known, 1e-300)
    top = 5 * max(np.max(errors, where=np.isfinite(errors), initial=floor), *known, floor)
    for place, (name, (score, error, flips)) in enumerate(points.items()):
        x, y = np.maximum(score, low), np.clip(error, floor, top / 1.5)
        flipped = np.asarray(flips, dtype=bool)
        colour = _COLOURS[place % len(_COLOURS)]
        axes.scatter(x, y, s=5, color=colour, alpha=0.45, linewidths=0, label=name)
        axes.scatter(x[flipped], y[flipped], s=34, marker="x", color=_BAD, zorder=4)
    axes.set(xscale="log", yscale="log", xlim=(low, high))
    axes.set_ylim(floor / 2, top)
    axes.plot([low, high], [low, high], color=_GREY, linewidth=0.9, linestyle=":")
    if margin:
        axes.axvspan(low, margin, color="#F3E3D3", zorder=0)
        axes.axvline(margin, color=_BAD, linewidth=1.2)
        side = "right" if margin * margin > low * high else "left"
        words = "  margin: to its left  \n  a decision may turn  "
        axes.text(margin, 3 * floor, words, color=_BAD, ha=side, multialignment=side)
    if bound:
        axes.axhline(bound, color=_INK, linewidth=1.0, linestyle="--")
        axes.text(high, bound / 1.15, "bound of the head ", color=_INK, ha="right", va="top")
    axes.set_xlabel("|score| in float64; dotted: as large as its error", color=_GREY)
    axes.set_ylabel("error of the float32 score", color=_GREY)
    axes.legend(
        frameon=False,
        fontsize=_SMALL,
        markerscale=2.5,
        loc="upper left",
        bbox_to_anchor=(0.08, 0.88),
    )


def _bars(axes: Axes, extremes: Mapping[str, Mapping[str, Any]]) -> None:
    """Worst and median error by kind; what was flagged, and what flipped, beside."""
    worst = [facts["error"]["worst"] for facts in extremes.values()]
    floor = _floor([*worst, *(facts["error"]["median"] for facts in extremes.values())]) / 2
    at = np.arange(len(worst))
    ends = [value or floor for value in worst]  # none if not finite: the note says so
    flagged = [facts["invalid"] / facts["bins"] for facts in extremes.values()]
    axes.barh(at, ends, 0.62, left=0, color=[_shade(share) for share in flagged])
    medians = [facts["error"]["median"] or floor for facts in extremes.values()]
    axes.plot(medians, at, "|", color=_INK, markersize=11, label="median")
    axes.set_xscale("log")
    axes.set_xlim(floor, 60 * max(*ends, floor))
    for place, facts in enumerate(extremes.values()):
        flips = sum(facts["flips"][part] for part in ("inside_margin", "outside_margin"))
        notes = [f"{facts['invalid']} of {facts['bins']} flagged"] if facts["invalid"] else []
        notes += [f"{flips} flipped"] if flips else []
        notes += ["not finite"] if facts["not_finite"] else []
        ink = _BAD if flips or facts["not_finite"] else _GREY
        axes.text(1.25 * ends[place], place, ", ".join(notes), va="center", color=ink, fontsize=8)
    axes.set_yticks(at, list(extremes))
    axes.set_ylim(len(worst) - 0.4, -0.6)
    axes.set_xlabel("error of the float32 score: bar worst, tick median", color=_GREY)


def _shade(flagged: float) -> tuple[float, float, float]:
    """Blue where all bins are valid, grey where all are flagged."""
    blue, grey = np.array([0.34, 0.62, 0.80]), np.array([0.78, 0.78, 0.78])
    red, green, other = (blue + flagged * (grey - blue)).tolist()
    return red, green, other


def _floor(values: Sequence[float | None]) -> float:
    """The least positive value, on a log axis the place of those that are 0."""
    return min((v for v in values if v is not None and 0 < v < math.inf), default=1e-12)
