"""The front of latency, compute and accuracy: table and figure of ``pareto.json``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from tactslip_torch.report import style

_ALIGN_COLOURS = {"centred": style.BLUE, "causal": style.VERMILION, "trailing": style.GREEN}
_BUSY = 0.05  # fraction of interrupted calls from which it is said
_NAMED = {  # B takes a third in onnxruntime; the axes are of the detector here
    "most_accurate": ("A", "most accurate"),
    "cheap": ("B", "at most 1 point worse, at most 1/3 of its compute"),
    "few": ("C", "at most 20 numbers"),
}
"""The detectors that are named: a letter for the figure, and what they are."""
_LATENCY, _COMPUTE = "worst_ms", "p99_us"


def pareto_table(content: Mapping[str, Any]) -> str:
    """The front by latency, the chosen detector with its parts, and the limits.

    Args:
        content: of ``pareto.json``.
    """
    limits = content["limits"]
    interrupted = max(row["interrupted"] for row in content["front"])
    head = [
        f"front of {content['searched']} candidates, {content['timed']} timed (backend "
        f"{content['backend']}, one bin, one thread); limits: deadline "
        f"{limits['deadline_ms']:g} ms, compute {limits['compute_us']:g} us",
        content["definition"],
        f"validation: {content['validation']}",
        f"{_busy(interrupted)} (the most of any detector on the front)",
    ]
    front = sorted(content["front"], key=lambda row: float(row["latency"]["worst_ms"]))
    rows = style.table(list(map(_front_row, front)), num_left=0)
    named, chosen = _named_lines(content), _chosen_lines(content)
    return style.marked(content["simulated"], *head, "", rows, "", *named, "", *chosen)


_FRONT = {
    "K": "num_features",
    "deg.": "degree",
    "numbers": "arithmetic",
    "filter": "align",
    **{name: name for name in ("channels", "components", "columns", "ranking")},
}


def _front_row(row: Mapping[str, Any]) -> dict[str, object]:
    latency = row["latency"]
    cells: dict[str, object] = {"latency ms": f"{latency['worst_ms']:.2f}"}
    for title in ("look-ahead", "bin", "hop"):
        cells[title] = f"{latency[title.replace('-', '_') + '_ms']:g}"
    cells |= {"compute us": f"{row['p99_us']:.0f}", "p50 us": f"{row['p50_us']:.0f}"}
    cells |= {"valid. %": style.percent(row["validation"])}
    return cells | {title: row[key] for title, key in _FRONT.items()}


def _named_lines(content: Mapping[str, Any]) -> list[str]:
    """A line on each detector that is named; medians, which a busy machine moves less."""
    lines = ["compute of A, B and C: onnxruntime, raw samples to score, one bin, one thread, p50"]
    most = content["named"]["most_accurate"]["graph_p50_us"]
    for name, (letter, what) in _NAMED.items():
        row = content["named"][name]
        if row is None:
            lines.append(f"{letter} {what}: none of those timed")
            continue
        lines.append(
            f"{letter} {what}: {style.percent(row['validation'])} %, {row['graph_p50_us']:.0f} us "
            f"({row['graph_p50_us'] / most:.2f} of A; without ONNX {row['p50_us']:.0f} us), "
            f"{row['num_features']} numbers ({row['columns']}, {row['components']}, "
            f"{row['channels']}) of {row['features_read']} features, degree {row['degree']}, "
            f"{row['align']}, {row['arithmetic']}"
        )
    return lines


def _chosen_lines(content: Mapping[str, Any]) -> list[str]:
    """The chosen detector: its latency part by part, what it reads, how accurate it is."""
    chosen = content["chosen"]
    if chosen is None:
        return [none_meets(content)]
    latency, test = chosen["latency"], chosen["test"]
    margin = content["limits"]["compute_us"] / latency["compute_us"]
    return [
        f"chosen: {latency['worst_ms']:.2f} ms = look-ahead {latency['look_ahead_ms']:g} + bin "
        f"{latency['bin_ms']:g} + hop {latency['hop_ms']:g} + compute "
        f"{latency['compute_us'] / 1000:.3f} (p99 in a fresh process, backend "
        f"{chosen['backend']}; p50 {chosen['p50_us']:.0f} us, p99 of all calls "
        f"{chosen['p99_all_us']:.0f} us, {100 * latency['load']:.1f} % of a core, "
        f"{margin:.2f} times faster than asked)",
        f"  {chosen['num_features']} numbers ({chosen['columns']}) of "
        f"{chosen['features_read']} features of {len(chosen['channels_read'])} channels, degree "
        f"{chosen['degree']}, {chosen['align']}, {chosen['arithmetic']}; fitted to "
        f"{chosen['fitted_to']}",
        f"  of those that kept both limits when timed {content['tried']} tried there, "
        f"{content['not_tried']} not tried; {_busy(chosen['interrupted'])}",
        f"  balanced accuracy {style.percent(chosen['validation'])} % in validation, which chose "
        f"it: a little too good; {style.percent(test['balanced_accuracy'])} % on "
        f"{test['num_bins']} bins of the test cycles of seen materials",
    ]


def none_meets(content: Mapping[str, Any]) -> str:
    """One line: that no detector keeps the limits, and which of them the closest exceeds."""
    limits = content["limits"]
    line = (
        f"no detector meets deadline_ms={limits['deadline_ms']:g} and "
        f"compute_us={limits['compute_us']:g}"
    )

    def excess(row: Mapping[str, Any]) -> float:
        """How many times the limit that is exceeded most is reached."""
        latency = row["latency"]
        in_time = latency["worst_ms"] / limits["deadline_ms"]
        in_compute = latency["compute_us"] / limits["compute_us"]
        return float(max(in_time, in_compute, latency["load"]))

    failed = [row for row in content["tries"] if row["misses"]]
    if failed:
        line += (
            f" in a fresh process ({content['tried']} tried, {content['not_tried']} that kept both "
            "when timed not tried)"
        )
    closest = min(failed or content["front"], key=excess)
    return f"{line}: the closest has {' and '.join(closest['misses'])}"


def _busy(interrupted: float) -> str:
    """Which fraction of calls does not count."""
    calls = f"{style.percent(interrupted, 1)} % of calls interrupted"
    if interrupted > _BUSY:
        return f"machine busy: {calls}, which do not count; time again"
    return f"{calls} by the system, which do not count"


@style.styled
def pareto_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write accuracy against latency and against compute as a PNG, the chosen detector marked.

    Args:
        content: of ``pareto.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    title = f"Accuracy by latency and compute, {content['searched']} candidates"
    figure = style.new_figure(11, 4.8, title, simulated=content["simulated"])
    left, right = figure.subplots(1, 2, sharey=True)
    limits = content["limits"]
    for axes, key, limit in (
        (left, _LATENCY, limits["deadline_ms"]),
        (right, _COMPUTE, limits["compute_us"]),
    ):
        _candidates(axes, content, key)
        _front(axes, content, key)
        axes.axvline(limit, color="black", linestyle=":", linewidth=1)
    left.set_xlabel("worst-case latency, onset to decision, ms")
    left.set_ylabel("balanced accuracy, %, a material left out")
    left.set_title("front: shortest hop; chosen: longest by the deadline (dotted)")
    right.plot([], [], "s", color="white", mec="black", label="pooled over channels")
    for letter, what in _NAMED.values():
        right.plot([], [], marker=f"${letter}$", color="black", linestyle="", label=what)
    right.set_xscale("log")
    _plain_ticks(right)
    right.set_xlabel("compute, raw samples to decision, p99, us")
    right.set_title("one bin, one thread; dotted: the limit")
    handles, _ = right.get_legend_handles_labels()
    style.legend_below(figure, handles, 3)
    style.save(figure, path)


def _plain_ticks(axes: Axes) -> None:
    """Whole numbers along a logarithmic axis: 1, 2, 5 and so on, or even steps below a decade."""
    low, high = axes.get_xlim()
    steps = MaxNLocator(6, integer=True) if high < 10 * low else LogLocator(subs=(1, 2, 5))
    axes.xaxis.set_major_locator(steps)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")


def _candidates(axes: Axes, content: Mapping[str, Any], key: str) -> None:
    """Modelled candidates in grey, those of the front in the colour of their alignment."""
    x = [point[0 if key == _LATENCY else 1] for point in content["modelled"]]
    y = [100 * point[2] for point in content["modelled"]]
    axes.plot(x, y, ".", color="#CCCCCC", markersize=3, label="searched (compute modelled)")
    for align, colour in _ALIGN_COLOURS.items():
        rows = [row for row in content["front"] if row["align"] == align]
        for row in rows:
            marker = "o" if row["columns"] == "channel" else "s"
            axes.plot(*_point(row, key), marker, color=colour)
        if rows:
            axes.plot([], [], "o", color=colour, label=f"front, {align}")


def _front(axes: Axes, content: Mapping[str, Any], key: str) -> None:
    """Steps along what nothing beats, the named detectors and the chosen one."""
    points = sorted((_point(row, key) for row in content["front"]), key=lambda at: (at[0], -at[1]))
    steps = [at for place, at in enumerate(points) if all(at[1] > y for _, y in points[:place])]
    axes.step(*zip(*steps, strict=True), where="post", color="#555555", linewidth=1)
    for name, (letter, _) in _NAMED.items():
        if row := content["named"][name]:
            at = _point(row, key)
            axes.plot(*at, "o", color="none", mec="black", markersize=9)
            axes.annotate(letter, at, (4, -13), textcoords="offset points", weight="bold")
    if chosen := content["chosen"]:
        at = _point(chosen, key)
        axes.plot(*at, "*", color=style.GREEN, markersize=17, mec="black", label="chosen")


def _point(row: Mapping[str, Any], key: str) -> tuple[float, float]:
    """Where a candidate stands: its latency or compute, and its accuracy in percent."""
    return row["latency"][key] if key == _LATENCY else row[key], 100 * row["validation"]
