"""What ``calibrate`` found: every point tried as a table, and accuracy along the line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_LINE, _TARGET, _KEPT, _FAILS = "#0072B2", "#666666", "#009E73", "#D55E00"


def calibration_table(found: Mapping[str, Any]) -> str:
    """Every point tried by difficulty, then what was kept and the facts there.

    Args:
        found: the content of ``calibration.json``.
    """
    target = found["target"]
    seeds = [f"seed {seed}" for seed in found["seeds"]]
    header = ["d", *(name.rsplit("_", 1)[0] for name in found["values"])]
    header += ["accuracy %", *seeds, "facts"]
    rows = [
        [
            f"{point['difficulty']:+.2f}",
            *map(_knob, point["knobs"].values()),
            f"{100 * point['accuracy']:.2f}",
            *(f"{100 * accuracy:.2f}" for accuracy in point["accuracy_by_seed"]),
            "hold" if point["holds"] else "fail: " + ", ".join(_failing(point)),
        ]
        for point in sorted(found["points"], key=lambda point: float(point["difficulty"]))
    ]
    facts = [
        [fact["says"], _range(fact), " ".join(f"{value:.3g}" for value in fact["values"].values())]
        for fact in found["facts"]
    ]
    parts = [
        f"{SIMULATED_LINE}\ntest accuracy on seen materials; d: prior standard deviations harder "
        f"than the starting values\npublished: {100 * target['accuracy']:.2f} % "
        f"({target['row']}; {target['source']})",
        aligned(header, rows),
    ]
    if facts:
        parts.append(aligned(["fact", "range", "values at the point kept"], facts, num_left=3))
    parts.append(f"kept: {_kept(found)}\n{found['verdict']}")
    return "\n\n".join(parts)


def point_line(point: Mapping[str, Any]) -> str:
    """A point in one line, as soon as it is tried."""
    facts = "facts hold" if point["holds"] else f"facts fail: {', '.join(_failing(point))}"
    by_seed = " ".join(f"{100 * accuracy:.2f}" for accuracy in point["accuracy_by_seed"])
    return f"d {point['difficulty']:+.2f}: {100 * point['accuracy']:.2f} % ({by_seed}), {facts}"


def calibration_figure(found: Mapping[str, Any], path: str | Path) -> None:
    """Write accuracy against difficulty, with the target and the point kept, as a PNG.

    Args:
        found: the content of ``calibration.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    axes = figure.subplots()
    points = sorted(found["points"], key=lambda point: float(point["difficulty"]))
    target = 100 * found["target"]["accuracy"]
    tolerance = 100 * found["protocol"]["tolerance"]
    axes.axhspan(target - tolerance, target + tolerance, color=_TARGET, alpha=0.15, linewidth=0)
    axes.axhline(target, color=_TARGET, linestyle="--", label=f"published, {target:.2f} %")
    place = [point["difficulty"] for point in points]
    axes.plot(place, [100 * point["accuracy"] for point in points], color=_LINE, linewidth=1.5)
    for holds, face, label in (
        (True, _LINE, "mean over seeds"),
        (False, "white", "the same, facts fail"),
    ):
        some = [point for point in points if point["holds"] == holds]
        if some:
            axes.plot(
                [point["difficulty"] for point in some],
                [100 * point["accuracy"] for point in some],
                "o",
                color=_LINE if holds else _FAILS,
                markerfacecolor=face,
                label=label,
            )
    for number in range(len(found["seeds"])):
        axes.plot(
            place,
            [100 * point["accuracy_by_seed"][number] for point in points],
            ".",
            color=_LINE,
            alpha=0.45,
            label="one seed" if number == 0 else None,
        )
    axes.plot(
        found["difficulty"],
        100 * found["accuracy"],
        "o",
        color=_KEPT,
        markersize=13,
        fillstyle="none",
        markeredgewidth=2,
        label="kept",
    )
    axes.set_xlabel("d, prior standard deviations harder than the starting values")
    axes.set_ylabel("test accuracy on seen materials, %")
    axes.set_title(f"SIMULATED hand\nkept: {_kept(found)}", fontsize=9)
    axes.grid(color="#DDDDDD")
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _failing(point: Mapping[str, Any]) -> list[str]:
    return [fact["name"] for fact in point["facts"] if not fact["holds"]]


def _kept(found: Mapping[str, Any]) -> str:
    values = ", ".join(f"{name} {_knob(value)}" for name, value in found["values"].items())
    return f"d {found['difficulty']:+.2f}, {values}"


def _knob(value: float | Sequence[float]) -> str:
    return f"{value[0]:g} to {value[1]:g}" if isinstance(value, Sequence) else f"{value:g}"


def _range(fact: Mapping[str, Any]) -> str:
    low, high = fact["low"], fact["high"]
    return f"above {low:g}" if high is None else f"{low:g} to {high:g}"
