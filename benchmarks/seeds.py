"""The published experiments over several seeds: ``python -m benchmarks.seeds``.

Trains every experiment on every seed (runs in ``--runs`` that this code finished are kept, so it
resumes), writes ``benchmarks/results/seeds.json`` and the pictures beside it, and puts the table of
means and spreads between the markers in README.md. Every number in that table comes from here.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tactslip_torch.features.cache import source_digest
from tactslip_torch.files import whole_file
from tactslip_torch.report import published
from tactslip_torch.report.figures import pipeline_figure

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
EXPERIMENTS: dict[str, tuple[str, ...]] = {
    "unseen4": ("+exp=unseen4", "recipe=paper"),
    "unseen4 robust": ("+exp=unseen4", "recipe=robust"),
    "random_bins": ("+exp=random_bins", "recipe=paper"),
    "half_second": ("+exp=unseen4", "recipe=paper", "labels=half_second"),
    "shuffled": ("+exp=seen6", "recipe=paper", "labels.shuffle_seed=1"),
}
SCORES = ("accuracy", "balanced_accuracy", "non_slip_recall", "slip_recall")
COMMAND = "python -m benchmarks.seeds"


def run(experiment: str, seed: int, folder: Path) -> dict[str, Any]:
    """The metrics of one run, from its folder if this code finished it there, else trained now.

    Raises:
        RuntimeError: if the training fails.
    """
    place = folder / f"{experiment.replace(' ', '-')}-{seed}"
    if not _is_finished(place):
        command = [sys.executable, "-m", "tactslip_torch.train", *EXPERIMENTS[experiment]]
        command += [f"seed={seed}", "export=false", f"hydra.run.dir={place}"]
        print(f"{experiment}, seed {seed}: {' '.join(command[1:])}", flush=True)
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
        if done.returncode:
            raise RuntimeError(f"{experiment} with seed {seed} failed; see above")
    metrics: dict[str, Any] = json.loads((place / "metrics.json").read_text())
    return metrics


def row(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of a run."""
    rivals = metrics["baselines"]["best_single_feature"]["splits"]
    return {
        "simulated": metrics["simulated"],
        "seed": metrics["seed"],
        "splits": {
            role: {name: scores[name] for name in (*SCORES, "num_bins")}
            for role, scores in metrics["splits"].items()
        },
        "best_single_feature": {
            role: scores["balanced_accuracy"] for role, scores in rivals.items()
        },
        "penalty": metrics["penalty"],
        "validation": max((row["mean"] for row in metrics.get("validation", [])), default=None),
        "selected": metrics["selected"],
    }


def table(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """A Markdown table: mean and standard deviation over seeds, the paper's numbers beside.

    Args:
        rows: experiment to the rows of its seeds.
    """
    head = ["experiment", "bins judged", *(name.replace("_", " ") + " %" for name in SCORES)]
    head += ["best single selected feature, balanced %"]
    lines = [head, ["---"] * len(head)]
    for experiment, runs in rows.items():
        for role in runs[0]["splits"]:
            scores = [[run["splits"][role][name] for run in runs] for name in SCORES]
            rival = [run["best_single_feature"][role] for run in runs]
            cells = [f"`{experiment}` {role}, simulated, {len(runs)} seeds"]
            cells += [f"{statistics.mean(run['splits'][role]['num_bins'] for run in runs):.0f}"]
            lines.append(cells + [_spread(values) for values in (*scores, rival)])
            paper = published.SPLITS.get(role)
            if experiment == "random_bins" and role == "test" and paper:
                lines.append(_published("paper, real hand, random bins", paper))
            if experiment == "unseen4" and role == "unseen" and paper:
                lines.append(_published("paper, real hand, unseen", paper))
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def figure(rows: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Balanced accuracy of every seed, by experiment and role, the paper's as a line."""
    names = [(experiment, role) for experiment in rows for role in rows[experiment][0]["splits"]]
    drawing = Figure(figsize=(7.2, 0.42 * len(names) + 1.3), layout="constrained")
    axes = drawing.subplots()
    for place, (experiment, role) in enumerate(names):
        values = [100 * run["splits"][role]["balanced_accuracy"] for run in rows[experiment]]
        rivals = [100 * run["best_single_feature"][role] for run in rows[experiment]]
        labels = (
            ("ours, one dot per seed", "best single selected feature")
            if place == 0
            else (None, None)
        )
        axes.plot(values, [place] * len(values), "o", color="#0072b2", alpha=0.7, label=labels[0])
        axes.plot(rivals, [place] * len(rivals), "|", color="#d55e00", ms=9, label=labels[1])
        paper = published.SPLITS.get(role)
        shown = {("random_bins", "test"), ("unseen4", "unseen")}
        if paper and paper.balanced_accuracy and (experiment, role) in shown:
            x = 100 * paper.balanced_accuracy
            label = "paper, real hand" if (experiment, role) == ("unseen4", "unseen") else None
            axes.plot([x, x], [place - 0.35, place + 0.35], color="black", lw=2, label=label)
    axes.set_yticks(range(len(names)), [f"{experiment}, {role}" for experiment, role in names])
    axes.invert_yaxis()
    axes.set_xlabel("balanced accuracy, %")
    axes.set_title("Simulated hand: bins told apart, by experiment", fontsize=11)
    axes.grid(axis="x", color="#dddddd")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    drawing.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    with whole_file(path) as temporary:
        drawing.savefig(temporary, dpi=160, format="png", facecolor="white")


def between_markers(text: str, name: str, content: str) -> str:
    """``text`` with what stands between ``<!-- name -->`` and ``<!-- /name -->`` replaced.

    Raises:
        ValueError: if a marker is missing.
    """
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if start not in text or end not in text:
        raise ValueError(f"the markers {start} and {end} are not both there")
    before, rest = text.split(start, 1)
    return f"{before}{start}\n{content}\n{end}{rest.split(end, 1)[1]}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="how many, from 0")
    parser.add_argument("--runs", type=Path, default=ROOT / "outputs" / "seeds")
    parser.add_argument("--experiments", nargs="+", default=list(EXPERIMENTS), choices=EXPERIMENTS)
    options = parser.parse_args(arguments)
    rows = {
        experiment: [row(run(experiment, seed, options.runs)) for seed in range(options.seeds)]
        for experiment in options.experiments
    }
    with whole_file(RESULTS / "seeds.json") as temporary:
        temporary.write_text(json.dumps(rows, indent=1) + "\n")
    figure(rows, RESULTS / "seeds.png")
    pipeline_figure(RESULTS / "pipeline.png")
    readme = ROOT / "README.md"
    with whole_file(readme) as temporary:
        temporary.write_text(between_markers(readme.read_text(), "seeds", table(rows)))
    print(table(rows))


def _is_finished(place: Path) -> bool:
    """Whether the folder holds the metrics of a run of this very code."""
    if not (place / "metrics.json").exists():
        return False
    made_by = json.loads((place / "metrics.json").read_text())["versions"]["code"]
    return bool(made_by == source_digest(ROOT / "tactslip_torch"))


def _spread(values: Sequence[float]) -> str:
    percent = [100 * value for value in values]
    spread = f" ± {statistics.stdev(percent):.2f}" if len(percent) > 1 else ""
    return f"{statistics.mean(percent):.2f}{spread}"


def _published(name: str, paper: published.PublishedSplit) -> list[str]:
    cells = [getattr(paper, score) for score in SCORES]
    return [name, "", *("" if cell is None else f"{100 * cell:.2f}" for cell in cells), ""]


if __name__ == "__main__":
    main()
