"""A precision certificate in one line and in one figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from tactslip_torch.report import style

_BAD = "#B84300"
_VALID, _FLAGGED = np.array([0.34, 0.62, 0.80]), np.array([0.78, 0.78, 0.78])


def conclusion(content: Mapping[str, Any]) -> str:
    """The certificate in one line."""
    kind = " (simulated data)" if content["simulated"] else ""
    failed = [row for row in content["conditions"] if row["holds"] is False]
    if failed:
        row = failed[0]
        others = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        value = "not finite" if row["found"] is None else f"{row['found']:.4g}"
        return f"Does not hold: {row['name']} is {value}, wanted {row['wanted']}{others}{kind}"
    margin = content["margin"]
    measured = ", as measured: this head has no bound" if content["head"]["bound"] is None else ""
    evaluated = "" if len(content["sets"]) > 1 else "; no held-out bins were evaluated"
    return (
        f"Holds: float32 decides as float64 does where |score| exceeds {margin['score']:.1e}, "
        f"{100 * margin['sd']:.2g} % of its standard deviation{measured}{evaluated}{kind}"
    )


@style.styled
def certificate_figure(
    content: Mapping[str, Any], sets: Mapping[str, Any], path: str | Path
) -> None:
    """Write error against ``|score|`` with margin and bound, and errors of generated extremes.

    Args:
        content: of ``certificate.json``.
        sets: by name its bins: ``exact`` scores, size of the ``error`` and whether it ``flips``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = style.new_figure(11.0, 4.9)
    left, right = figure.subplots(1, 2, width_ratios=[1.15, 1])
    _scatter(left, content, {name: sets[name] for name in content["sets"]})
    _bars(right, content["extremes"])
    kind = "SIMULATED recordings" if content["simulated"] else "recordings"
    left.set_title(f"(a) every bin of {kind}")
    right.set_title("(b) generated extremes (grey: flagged)")
    style.save(figure, path, dpi=170)


def _scatter(axes: Axes, content: Mapping[str, Any], sets: Mapping[str, Any]) -> None:
    """Above the diagonal an error is larger than its score: only there a decision can flip."""
    bins = {
        name: (own.exact.abs().numpy(), own.error.numpy(), own.flips.numpy())
        for name, own in sets.items()
    }
    scores, errors, _ = (np.concatenate(parts) for parts in zip(*bins.values(), strict=True))
    margin, bound = content["margin"]["score"], content["head"]["bound"]
    known = [value for value in (margin, bound) if value]
    floor = _least_positive([*errors.tolist(), *known])
    low = _least_positive([*scores.tolist(), *known]) / 2
    high = 2 * max(scores.max(), *known, 1e-300)
    top = 5 * max(np.max(errors, where=np.isfinite(errors), initial=floor), *known, floor)
    colours = style.colours_of(sets)
    for name, (score, error, flips) in bins.items():
        x, y = np.maximum(score, low), np.clip(error, floor, top / 1.5)
        axes.scatter(x, y, s=5, color=colours[name], alpha=0.45, linewidths=0, label=name)
        axes.scatter(x[flips], y[flips], s=34, marker="x", color=_BAD, zorder=4)
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(floor / 2, top))
    axes.minorticks_off()  # of hundreds of decades they take seconds
    axes.plot([low, high], [low, high], color=style.GREY, linewidth=0.9, linestyle=":")
    if margin:
        axes.axvspan(low, margin, color="#F3E3D3", zorder=0)
        axes.axvline(margin, color=_BAD, linewidth=1.2)
        side = "right" if margin * margin > low * high else "left"
        text = "  margin: to its left  \n  a decision may change  "
        axes.text(margin, 3 * floor, text, color=_BAD, ha=side, multialignment=side)
    if bound:
        axes.axhline(bound, color=style.INK, linewidth=1.0, linestyle="--")
        axes.text(high, bound / 1.15, "bound of the head ", color=style.INK, ha="right", va="top")
    axes.set_xlabel("|score| in float64; dotted: as large as its error")
    axes.set_ylabel("error of the float32 score")
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (0.08, 0.88)}
    axes.legend(markerscale=2.5, **place)


def _bars(axes: Axes, extremes: Mapping[str, Mapping[str, Any]]) -> None:
    """Worst and median error by kind; what was flagged, and what flipped, beside."""
    errors = [kind["error"] for kind in extremes.values()]
    floor = _least_positive(error[key] for error in errors for key in ("worst", "median")) / 2
    ends = [error["worst"] or floor for error in errors]  # none if not finite: the note says so
    medians = [error["median"] or floor for error in errors]
    axes.plot(medians, range(len(errors)), "|", color=style.INK, markersize=11)
    for place, (kind, end) in enumerate(zip(extremes.values(), ends, strict=True)):
        shade = _VALID + kind["invalid"] / kind["bins"] * (_FLAGGED - _VALID)
        axes.barh(place, end, 0.62, left=0, color=shade)
        flips = sum(kind["flips"][part] for part in ("inside_margin", "outside_margin"))
        notes = [f"{kind['invalid']} of {kind['bins']} flagged"] if kind["invalid"] else []
        notes += [f"{flips} flipped"] if flips else []
        notes += ["not finite"] if kind["not_finite"] else []
        colour = _BAD if flips or kind["not_finite"] else style.GREY
        axes.text(1.25 * end, place, ", ".join(notes), va="center", color=colour)
    axes.set(xscale="log", xlim=(floor, 60 * max(*ends, floor)))
    axes.minorticks_off()
    style.lanes(axes, list(extremes))
    axes.set_xlabel("error of the float32 score: bar worst, tick median")


def _least_positive(values: Iterable[float | None]) -> float:
    """The least positive value, on a log axis the place of those that are 0."""
    return min((v for v in values if v is not None and 0 < v < math.inf), default=1e-12)
