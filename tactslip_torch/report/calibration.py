"""Calibration of the simulator: every point tried as a table, and accuracy along the line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactslip_torch.report import style


def calibration_table(content: Mapping[str, Any]) -> str:
    """Every point tried by difficulty, then what was kept and the signal checks there.

    Args:
        content: of ``calibration.json``.
    """
    target = content["target"]
    rows = []
    for point in _by_difficulty(content):
        row = {"d": f"{point['difficulty']:+.2f}"}
        row |= {name.rsplit("_", 1)[0]: _value(v) for name, v in point["parameters"].items()}
        row |= {"accuracy %": style.percent(point["accuracy"])}
        by_seed = zip(content["seeds"], point["accuracy_by_seed"], strict=True)
        row |= {f"seed {seed}": style.percent(accuracy) for seed, accuracy in by_seed}
        rows.append(row | {"signal checks": _checks(point)})
    blocks = [
        style.marked(
            True,
            "test accuracy on seen materials; d: prior standard deviations harder than the "
            "starting values",
            f"published: {100 * target['accuracy']:.2f} % ({target['row']}; {target['source']})",
        ),
        style.table(rows),
    ]
    if content["signal_checks"]:
        checks = []
        for check in content["signal_checks"]:
            low, high = f"{check['low']:g}", check["high"]
            span = f"above {low}" if high is None else f"{low} to {high:g}"
            values = " ".join(f"{value:.3g}" for value in check["values"].values())
            row = {"signal check": check["says"], "range": span}
            checks.append(row | {"values at the point kept": values})
        blocks.append(style.table(checks, num_left=3))
    return "\n\n".join([*blocks, f"kept: {_kept(content)}\n{content['outcome']}"])


def point_line(point: Mapping[str, Any]) -> str:
    """A point in one line, as soon as it is tried."""
    by_seed = " ".join(map(style.percent, point["accuracy_by_seed"]))
    accuracy = style.percent(point["accuracy"])
    return f"d {point['difficulty']:+.2f}: {accuracy} % ({by_seed}), signal checks {_checks(point)}"


@style.styled
def calibration_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write accuracy against difficulty, with the target and the point kept, as a PNG.

    Args:
        content: of ``calibration.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = style.new_figure(7.5, 4.6)
    axes = figure.subplots()
    points = _by_difficulty(content)
    target = 100 * content["target"]["accuracy"]
    tolerance = 100 * content["protocol"]["tolerance"]
    axes.axhspan(target - tolerance, target + tolerance, color=style.GREY, alpha=0.15, linewidth=0)
    axes.axhline(target, color=style.GREY, linestyle="--", label=f"published, {target:.2f} %")
    place = [point["difficulty"] for point in points]
    means = [100 * point["accuracy"] for point in points]
    axes.plot(place, means, color=style.BLUE, linewidth=1.5)
    for holds, colour, label in (
        (True, style.BLUE, "mean over seeds"),
        (False, style.VERMILION, "the same, signal checks fail"),
    ):
        shown = [at for at, point in enumerate(points) if point["holds"] == holds]
        if shown:
            x, y = [place[at] for at in shown], [means[at] for at in shown]
            axes.plot(x, y, "o", color=colour, mfc=colour if holds else "white", label=label)
    for number in range(len(content["seeds"])):
        by_seed = [100 * point["accuracy_by_seed"][number] for point in points]
        label = "" if number else "one seed"
        axes.plot(place, by_seed, ".", color=style.BLUE, alpha=0.45, label=label)
    look: dict[str, Any] = {"color": style.GREEN, "ms": 13, "fillstyle": "none", "mew": 2}
    axes.plot(content["difficulty"], 100 * content["accuracy"], "o", label="kept", **look)
    axes.set_xlabel("d, prior standard deviations harder than the starting values")
    axes.set_ylabel("test accuracy on seen materials, %")
    axes.set_title(f"SIMULATED hand\nkept: {_kept(content)}")
    axes.legend(loc="upper right")
    style.save(figure, path)


def _by_difficulty(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return sorted(content["points"], key=lambda point: float(point["difficulty"]))


def _checks(point: Mapping[str, Any]) -> str:
    failing = ", ".join(check["name"] for check in point["signal_checks"] if not check["holds"])
    return "hold" if point["holds"] else f"fail: {failing}"


def _kept(content: Mapping[str, Any]) -> str:
    values = ", ".join(f"{name} {_value(value)}" for name, value in content["values"].items())
    return f"d {content['difficulty']:+.2f}, {values}"


def _value(value: float | Sequence[float]) -> str:
    return f"{value[0]:g} to {value[1]:g}" if isinstance(value, Sequence) else f"{value:g}"
