"""The latency of a detector: waiting, which is exact, and computing, which is measured.

The worst case is an onset just behind the start of a bin: the next bin, a hop later, is the first
that lies wholly in slip, and decides after the look-ahead of the filter. A call is timed as a live
loop makes it: one bin on one thread, from raw samples to the decision, in a fresh process.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from tactslip_torch.features.cost import WorkCosts
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report import style
from tactslip_torch.runtime import one_thread

_RUNS = 5


class Timing(NamedTuple):
    """Microseconds of a call: of several runs, the median of their medians and of their p99."""

    p50_us: float
    p99_us: float


def _time_detector(detector: SlipDetector, calls: int) -> Timing:
    """Time ``predict_raw`` of one ordinary bin in float32, one call after the other.

    Args:
        detector: of any hand.
        calls: of each of five runs.
    """
    pool, channel_filter = detector.pool, detector.channel_filter
    context = channel_filter.context_before + channel_filter.context_after
    shape = (32, 1, len(pool.hand), pool.bin_samples + context)
    inputs = 0.1 * torch.randn(shape, generator=torch.Generator().manual_seed(0)) + 1
    runs = np.empty((_RUNS, calls))
    with torch.inference_mode(), one_thread():
        for one in inputs:
            detector.predict_raw(one)
        for place in np.ndindex(runs.shape):
            one = inputs[place[1] % len(inputs)]
            started = time.perf_counter_ns()
            detector.predict_raw(one)
            runs[place] = (time.perf_counter_ns() - started) / 1000
    return Timing(*np.median(np.percentile(runs, (50, 99), axis=1), axis=1).tolist())


def time_in_fresh_process(path: str | os.PathLike[str], calls: int) -> Timing:
    """``_time_detector`` of a saved detector in a process that has done nothing else.

    Raises:
        ValueError: if that process ends without a result.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        try:
            return process.submit(_time_saved, path, calls).result()
        except BrokenProcessPool:
            raise ValueError(
                f"the process that was to time {os.fspath(path)} ended; is there memory for it, "
                'and does the program call this behind if __name__ == "__main__":?'
            ) from None


def _time_saved(path: str | os.PathLike[str], calls: int) -> Timing:
    return _time_detector(SlipDetector.load(path), calls)


def decision_cost(detector: SlipDetector, machine: str) -> float:
    """What a decision costs on one of ``features.cost.MACHINES``, computed by its table."""
    costs, num_scaled = WorkCosts.measured(detector.pool, machine), len(detector.scaler.minimum)
    products = detector.head.cost.multiply_adds
    return costs.cost([costs.decision(detector.selected_names, num_scaled, products)])


@dataclass(frozen=True)
class Candidate:
    """A trained and timed detector with one distance of its decisions.

    Attributes:
        recipe: its name.
        size: number of columns that the machine takes.
        precision: in which features are computed.
        hop_ms: between decisions.
        accuracy: balanced, of training materials left out: what chose it, a little too good.
        look_ahead_ms: of the filter.
        bin_ms: length of a bin.
        timing: of one decision.
        m7_instructions: of one decision on a Cortex-M7, in float32, computed from the table of
            costs (``features.cost``), not run.
        folder: of its training.
    """

    recipe: str
    size: int
    precision: str
    hop_ms: float
    accuracy: float
    look_ahead_ms: float
    bin_ms: float
    timing: Timing
    m7_instructions: float
    folder: str

    @property
    def worst_ms(self) -> float:
        """From the onset of slip to the decision, in the worst case."""
        return self.look_ahead_ms + self.bin_ms + self.hop_ms + self.timing.p99_us / 1000

    def misses(self, deadline_us: float, latency_ms: float | None) -> list[str]:
        """Which limits are not kept, in words; none if all are."""
        p99_us, found = self.timing.p99_us, []
        if p99_us > deadline_us:
            found.append(f"compute {p99_us:.0f} us above deadline_us={deadline_us:g}")
        if latency_ms is not None and self.worst_ms > latency_ms:
            found.append(f"latency {self.worst_ms:.2f} ms above latency_ms={latency_ms:g}")
        if p99_us >= 1000 * self.hop_ms:
            found.append(f"compute {p99_us:.0f} us not below the hop {self.hop_ms:g} ms")
        return found

    def row(self) -> dict[str, Any]:
        """Its numbers, JSON-able."""
        names = "recipe", "size", "precision", "hop_ms", "accuracy", "worst_ms", "m7_instructions"
        return {name: getattr(self, name) for name in names} | self.timing._asdict()


def nondominated(points: Sequence[Sequence[float]]) -> list[int]:
    """Places of the points that no other beats, smaller being better; of equal ones the first.

    Example:
        >>> nondominated([(1, 5), (2, 2), (3, 2), (4, 1), (2, 2)])
        [0, 1, 3]
    """
    kept: list[int] = []
    for index in sorted(range(len(points)), key=lambda index: (tuple(points[index]), index)):
        own = points[index]
        if not any(all(a <= b for a, b in zip(points[k], own, strict=True)) for k in kept):
            kept.append(index)
    return sorted(kept)


def choose(
    candidates: Sequence[Candidate], deadline_us: float, latency_ms: float | None
) -> Candidate | None:
    """The most accurate that keeps the limits; of equal ones the longest hop, then the fastest."""
    able = [each for each in candidates if not each.misses(deadline_us, latency_ms)]
    return max(able, key=lambda c: (c.accuracy, c.hop_ms, -c.timing.p99_us), default=None)


def pareto_table(content: Mapping[str, Any]) -> str:
    """All candidates, the most accurate first; those on the front and the chosen one are marked."""
    rows = [
        {
            "recipe": row["recipe"],
            "precision": row["precision"],
            "K": row["size"],
            "hop ms": f"{row['hop_ms']:g}",
            "valid. %": style.percent(row["accuracy"]),
            "p50 us": f"{row['p50_us']:.0f}",
            "p99 us": f"{row['p99_us']:.0f}",
            "latency ms": f"{row['worst_ms']:.2f}",
            "M7 M instr.": f"{row['m7_instructions'] / 1e6:.2f}",
            "front": place in content["front"],
            "M7 front": place in content["m7_front"],
            "chosen": row == content["chosen"],
        }
        for place, row in enumerate(content["candidates"])
    ]
    rows.sort(key=lambda row: (-float(row["valid. %"]), float(row["p99 us"])))
    return style.marked(content["simulated"], style.table(rows, num_left=2))


@style.styled
def pareto_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write accuracy against latency and against compute as a PNG, the chosen detector marked."""
    title = f"Accuracy by latency and compute, {len(content['candidates'])} candidates"
    figure = style.new_figure(11, 4.8, title, simulated=content["simulated"])
    panels = figure.subplots(1, 2, sharey=True)
    colours = style.colours_of(row["recipe"] for row in content["candidates"])
    labels = ("worst-case latency, onset to decision, ms", "compute of one decision, p99, us")
    limits = (content["latency_ms"], content["deadline_us"])
    for axes, key, label, limit in zip(panels, ("worst_ms", "p99_us"), labels, limits, strict=True):
        for name, colour in colours.items():
            rows = [row for row in content["candidates"] if row["recipe"] == name]
            accuracies = [100 * row["accuracy"] for row in rows]
            axes.plot([row[key] for row in rows], accuracies, "o", color=colour, label=name)
        if chosen := content["chosen"]:
            at = (chosen[key], 100 * chosen["accuracy"])
            axes.plot(*at, "*", color="black", ms=14, label="chosen")
        if limit is not None:
            axes.axvline(limit, color="black", linestyle=":", linewidth=1)
        axes.set_xlabel(label)
    panels[0].set_ylabel("balanced accuracy, %, a material left out")
    panels[1].legend(**style.UPPER_LEFT_OUTSIDE)
    style.save(figure, path)
