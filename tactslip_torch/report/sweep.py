"""The runs of ``-m`` beside each other: a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, pstdev

import numpy as np

from tactslip_torch.report import style

Run = tuple[str, Mapping[str, float]]
"""What was set, and the scores by role, such as ``unseen/accuracy``, from 0 to 1."""


def sweep_table(runs: Sequence[Run], *, simulated: bool) -> str:
    """One row a run, and their mean and standard deviation below, in percent."""
    names = _scores(runs)
    rows: list[dict[str, object]] = []
    for given, scores in runs:
        rows.append(
            {"run": given, **{f"{name} %": style.percent(scores.get(name)) for name in names}}
        )
    for what, reduced in (("mean", mean), ("standard deviation", pstdev)):
        own = {name: [scores[name] for _, scores in runs if name in scores] for name in names}
        rows.append({"run": what, **{f"{n} %": style.percent(reduced(v)) for n, v in own.items()}})
    return style.marked(simulated, style.table(rows))


@style.styled
def write_sweep(runs: Sequence[Run], folder: Path, *, simulated: bool) -> None:
    """Write ``runs.csv`` and ``runs.png``: a lane for each run, a dot for each score."""
    names = _scores(runs)
    with style.csv_writer(folder / "runs.csv", ["run", *names]) as write:
        write([given, *(scores.get(name) for name in names)] for given, scores in runs)
    shown = [name for name in names if name.endswith("balanced_accuracy")] or names
    figure = style.new_figure(8.4, 1.5 + 0.35 * len(runs), "Runs of the sweep", simulated=simulated)
    axes = figure.subplots()
    for name, colour in style.colours_of(shown).items():
        values = [100 * scores.get(name, np.nan) for _, scores in runs]
        axes.plot(values, range(len(runs)), "o", color=colour, label=style.words(name))
    style.lanes(axes, [given for given, _ in runs])
    axes.set_xlabel("%")
    axes.legend(**style.UPPER_LEFT_OUTSIDE)
    style.save(figure, folder / "runs.png")


def _scores(runs: Sequence[Run]) -> list[str]:
    return list(dict.fromkeys(name for _, scores in runs for name in scores))
