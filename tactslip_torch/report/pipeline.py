"""The figure of the pipeline: steps of the package with the tensor's shape after each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from tactslip_torch.report.style import GREEN, GREY, ORANGE, PURPLE, SKY, TEXT, save

_PARTS = {
    "data | simulation": ORANGE,
    "signals": SKY,
    "features": GREEN,
    "model": PURPLE,
    "report": "#888888",
}
_STEPS: tuple[tuple[str, str, str, str], ...] = (
    # part of the package, what it does, how, shape of its output
    ("signals", "clean and cut", "Savitzky-Golay\nbins of 50 ms", "[N, 24, 100]"),
    ("signals", "branch", "wavelet A1-A4, D1-D4\nand their spectra", "[N, 10, 8, 100]"),
    ("features", "describe", "17 descriptors\npool of 2582", "[N, 2582]"),
    ("features", "select", "ranked by t-test\nbest 120", "[N, 120]"),
    ("model", "predict", "scaling, kernel ELM\nfolded to z'Qz + l'z + a", "[N]"),
    ("report", "report", "slip score \N{GREATER-THAN OR EQUAL TO} 0: slip\nmetrics, figures", ""),
)
_WIDTH, _PITCH, _BOTTOM, _TOP = 1.8, 2.16, 0.72, 1.82  # of boxes, in inches
_CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}


def pipeline_figure(path: str | Path) -> None:
    """Write the steps of the pipeline, with the tensor's shape after each.

    Args:
        path: the PNG to write, replaced as a whole if it exists.
    """
    lefts = [_PITCH * step for step in range(len(_STEPS) + 1)]
    parts = ["data | simulation", *(step[0] for step in _STEPS)]
    figure = Figure(figsize=(lefts[-1] + _WIDTH + 0.2, 2.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.1, lefts[-1] + _WIDTH + 0.1), ylim=(0.0, 2.4))
    axes.set_axis_off()
    colour = _PARTS["data | simulation"]
    _box(axes, 0.0, _TOP - 0.51, 0.51, colour, "data", "recorded cycles")
    _box(axes, 0.0, _BOTTOM, 0.51, colour, "simulation", "scene to recording")
    for left, (part, what, how, _) in zip(lefts[1:], _STEPS, strict=True):
        _box(axes, left, _BOTTOM, _TOP - _BOTTOM, _PARTS[part], what, how)
        start, end = ((left - away, (_BOTTOM + _TOP) / 2) for away in (0.34, 0.02))
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": GREY})
    for left, shape in zip(lefts, ["[C, T]", *(step[3] for step in _STEPS)], strict=True):
        axes.text(left + _WIDTH / 2, 0.45, shape, fontsize=10, family="monospace", **_CENTRED)
    for part, colour in _PARTS.items():
        own = [left for left, name in zip(lefts, parts, strict=True) if name == part]
        axes.plot([own[0], own[-1] + _WIDTH], [2.0, 2.0], color=colour, linewidth=2.5)
        centre = (own[0] + own[-1] + _WIDTH) / 2
        axes.text(centre, 2.2, part, fontsize=11, fontweight="bold", **_CENTRED)
    axes.text(lefts[0], 0.15, "C channels, T samples, N bins", fontsize=TEXT, color=GREY)
    save(figure, path, dpi=180)


def _box(
    axes: Axes, left: float, bottom: float, height: float, colour: str, what: str, how: str
) -> None:
    """A rounded box with a bold line above one or two plain ones."""
    outline = FancyBboxPatch((left, bottom), _WIDTH, height, "round,pad=0,rounding_size=0.07")
    axes.add_patch(outline).set(linewidth=1.3, ec=colour, fc=to_rgba(colour, 0.13))
    centre, middle = left + _WIDTH / 2, bottom + height / 2
    rise = 0.085 * (1 + how.count("\n"))
    axes.text(centre, middle + rise, what, fontsize=10, fontweight="bold", **_CENTRED)
    axes.text(centre, middle - 0.1, how, fontsize=9, linespacing=1.25, **_CENTRED)
