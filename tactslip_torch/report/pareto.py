"""Table and figure of ``pareto``: the front of latency, compute and accuracy, and who is chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_ALIGN_COLOURS = {"centred": "#0072B2", "causal": "#D55E00", "trailing": "#009E73"}
_CHOSEN = "#009E73"
_BUSY = 0.05  # share of interrupted calls from which it is said
_NAMED = {  # B takes a third in onnxruntime; the axes are of the detector here
    "most_accurate": ("A", "most accurate"),
    "cheap": ("B", "at most 1 point worse, at most 1/3 of its compute"),
    "few": ("C", "at most 20 numbers"),
}
"""The detectors that are named: a letter for the figure, and what they are."""


def pareto_table(found: Mapping[str, Any]) -> str:
    """The front by latency, the chosen detector with its parts, and what was promised.

    Args:
        found: the content of ``pareto.json``.
    """
    head = [SIMULATED_LINE] if found["simulated"] else []
    limits = found["limits"]
    head.append(
        f"front of {found['searched']} candidates, {found['timed']} timed (engine "
        f"{found['engine']}, one bin, one thread); limits: deadline "
        f"{limits['deadline_ms']:g} ms, compute {limits['compute_us']:g} us"
    )
    head.append(found["definition"])
    head.append(f"validation: {found['validation']}")
    interrupted = max(row["interrupted"] for row in found["front"])
    head.append(f"{_busy(interrupted)} (the most of any detector on the front)")
    header = ["latency ms", "look-ahead", "bin", "hop", "compute us", "p50 us"]
    header += ["valid. %", "K", "deg.", "numbers", "filter", "channels", "components"]
    header += ["columns", "ranking"]
    rows = [
        _cells(row) for row in sorted(found["front"], key=lambda row: row["latency"]["worst_ms"])
    ]
    table = aligned(header, rows, num_left=0)
    return "\n".join([*head, "", table, "", *_named(found), "", *_verdict(found)])


def _named(found: Mapping[str, Any]) -> list[str]:
    """A line on each detector that is named; medians, which a busy machine moves less."""
    lines = ["compute of A, B and C: onnxruntime, raw samples to score, one bin, one thread, p50"]
    most = found["named"]["most_accurate"]["graph_p50_us"]
    for name, (letter, what) in _NAMED.items():
        row = found["named"][name]
        if row is None:
            lines.append(f"{letter} {what}: none of those timed")
            continue
        lines.append(
            f"{letter} {what}: {_percent(row['validation'])} %, {row['graph_p50_us']:.0f} us "
            f"({row['graph_p50_us'] / most:.2f} of A; without ONNX {row['p50_us']:.0f} us), "
            f"{row['num_features']} numbers ({row['columns']}, {row['components']}, "
            f"{row['channels']}) of {row['features_read']} features, degree {row['degree']}, "
            f"{row['align']}, {row['arithmetic']}"
        )
    return lines


def none_meets(found: Mapping[str, Any]) -> str:
    """One line on what no detector meets, and what the closest misses."""
    limits = found["limits"]
    line = (
        f"no detector meets deadline_ms={limits['deadline_ms']:g} and "
        f"compute_us={limits['compute_us']:g}"
    )
    failed = [row for row in found["tries"] if row["misses"]]
    if failed:
        line += (
            f" in a fresh process ({found['tried']} tried, {found['not_tried']} that met both when "
            "timed not tried)"
        )
    closest = min(failed or found["front"], key=lambda row: _excess(row, limits))
    return f"{line}: the closest has {' and '.join(closest['misses'])}"


def _excess(row: Mapping[str, Any], limits: Mapping[str, float]) -> float:
    """How many times the limit that is missed most is reached."""
    latency = row["latency"]
    return max(
        float(latency["worst_ms"]) / limits["deadline_ms"],
        float(latency["compute_us"]) / limits["compute_us"],
        float(latency["load"]),
    )


def _busy(interrupted: float) -> str:
    """What share of calls does not count."""
    percent = f"{100 * interrupted:.1f} %"
    if interrupted > _BUSY:
        return f"machine busy: {percent} of calls interrupted, which do not count; time again"
    return f"{percent} of calls interrupted by the system, which do not count"


def pareto_figure(found: Mapping[str, Any], path: str | Path) -> None:
    """Write accuracy against latency and against compute as a PNG, the chosen detector marked.

    Args:
        found: the content of ``pareto.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    kind = "SIMULATED hand" if found["simulated"] else "recorded"
    figure.suptitle(
        f"What latency and compute buy ({kind}), {found['searched']} candidates", fontsize=13
    )
    left, right = figure.subplots(1, 2, sharey=True)
    limits = found["limits"]
    _panel(left, found, lambda row: row["latency"]["worst_ms"], 0)
    left.axvline(limits["deadline_ms"], color="black", linestyle=":", linewidth=1)
    left.set_xlabel("worst-case latency, onset to decision, ms")
    left.set_ylabel("balanced accuracy, %, a material left out")
    title = "front: shortest hop; chosen: longest that keeps the deadline (dotted)"
    left.set_title(title, fontsize=10)
    _panel(right, found, lambda row: row["p99_us"], 1)
    right.plot([], [], "s", color="white", markeredgecolor="black", label="pooled over channels")
    for letter, what in _NAMED.values():
        right.plot([], [], marker=f"${letter}$", color="black", linestyle="", label=what)
    right.axvline(limits["compute_us"], color="black", linestyle=":", linewidth=1)
    right.set_xscale("log")
    _plain_ticks(right)
    right.set_xlabel("compute, raw samples to decision, p99, us")
    right.set_title("one bin, one thread; dotted: the limit", fontsize=10)
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=150)


def _plain_ticks(axes: Axes) -> None:
    """Whole numbers along a logarithmic axis: 1, 2, 5 and so on, or even steps below a decade."""
    low, high = axes.get_xlim()
    steps = MaxNLocator(6, integer=True) if high < 10 * low else LogLocator(subs=(1, 2, 5))
    axes.xaxis.set_major_locator(steps)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")


def _panel(axes: Axes, found: Mapping[str, Any], x: Callable[[Any], float], place: int) -> None:
    """Modelled candidates in grey, the front by alignment, steps along what nothing beats."""
    modelled = found["modelled"]
    axes.plot(
        [point[place] for point in modelled],
        [100 * point[2] for point in modelled],
        ".",
        color="#CCCCCC",
        markersize=3,
        label="searched (compute modelled)",
    )
    for align, colour in _ALIGN_COLOURS.items():
        rows = [row for row in found["front"] if row["align"] == align]
        label = f"front, {align}"
        for marker, is_pooled in (("o", False), ("s", True)):
            own = [row for row in rows if (row["columns"] != "channel") == is_pooled]
            ys = [100 * row["validation"] for row in own]
            axes.plot([x(row) for row in own], ys, marker, color=colour, label=label if own else "")
            label = "" if own else label
    best = -1.0
    steps: list[tuple[float, float]] = []
    for row in sorted(found["front"], key=lambda row: (x(row), -row["validation"])):
        if row["validation"] > best:
            best = row["validation"]
            steps.append((x(row), 100 * best))
    axes.step(*zip(*steps, strict=True), where="post", color="#555555", linewidth=1)
    for name, (letter, _) in _NAMED.items():
        if row := found["named"][name]:
            at = x(row), 100 * row["validation"]
            axes.plot(*at, "o", color="none", markeredgecolor="black", markersize=9)
            axes.annotate(letter, at, (4, -13), textcoords="offset points", weight="bold")
    chosen = found["chosen"]
    if chosen:
        axes.plot(
            x(chosen),
            100 * chosen["validation"],
            "*",
            color=_CHOSEN,
            markersize=17,
            markeredgecolor="black",
            label="chosen",
        )
    axes.grid(color="#DDDDDD")


def _verdict(found: Mapping[str, Any]) -> list[str]:
    chosen = found["chosen"]
    if chosen is None:
        return [none_meets(found)]
    latency = chosen["latency"]
    return [
        f"chosen: {latency['worst_ms']:.2f} ms = look-ahead {latency['look_ahead_ms']:g} + bin "
        f"{latency['bin_ms']:g} + hop {latency['hop_ms']:g} + compute "
        f"{latency['compute_us'] / 1000:.3f} (p99 in a fresh process, engine "
        f"{chosen['engine']}; p50 {chosen['p50_us']:.0f} us, p99 of all calls "
        f"{chosen['p99_all_us']:.0f} us, {100 * latency['load']:.1f} % of a core, "
        f"{found['limits']['compute_us'] / latency['compute_us']:.2f} times faster than asked)",
        f"  {chosen['num_features']} numbers ({chosen['columns']}) of "
        f"{chosen['features_read']} features of {len(chosen['channels_read'])} channels, degree "
        f"{chosen['degree']}, {chosen['align']}, {chosen['arithmetic']}; fitted to "
        f"{chosen['fitted_to']}",
        f"  of those that met both when timed {found['tried']} tried there, {found['not_tried']} "
        "not tried; " + _busy(chosen["interrupted"]),
        f"  balanced accuracy {_percent(chosen['validation'])} % in validation, which chose it: a "
        "little too good; "
        f"{_percent(chosen['test']['balanced_accuracy'])} % on "
        f"{chosen['test']['num_bins']} bins of the test cycles of seen materials",
    ]


def _cells(row: Mapping[str, Any]) -> list[str]:
    latency = row["latency"]
    cells = [f"{latency['worst_ms']:.2f}"]
    cells += [f"{latency[part]:g}" for part in ("look_ahead_ms", "bin_ms", "hop_ms")]
    cells += [f"{row['p99_us']:.0f}", f"{row['p50_us']:.0f}", _percent(row["validation"])]
    cells += [str(row["num_features"]), str(row["degree"])]
    names = ("arithmetic", "align", "channels", "components", "columns", "ranking")
    return cells + [str(row[name]) for name in names]


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{100 * fraction:.2f}"
