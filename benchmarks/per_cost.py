"""Columns chosen by gain and by gain for their cost: ``python -m benchmarks.per_cost``.

Detectors of few columns are trained on the simulated hand, scored on held-out materials, and run on
a Cortex-M7 that QEMU emulates. Needs what ``.ci/boards`` installs.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product
from statistics import mean
from typing import Any, ClassVar

from benchmarks.costs import RUNS
from benchmarks.harness import Benchmark, Job
from benchmarks.native_c import BOARD_TOOLS, missing_tools
from benchmarks.subjects import loaded
from benchmarks.tables import Report, Table, by, mean_sd
from benchmarks.trainings import trained
from tactslip_torch.pareto import decision_cost

WAYS = {
    "null": "gain",
    "m7": "gain for M7 instructions",
    "x86": "gain for x86-64 time",
}


@dataclass(frozen=True)
class PerCost(Benchmark):
    """Detectors of few columns, chosen in several ways.

    Args:
        seeds: of simulated sets.
        columns: of the view ``pooled``, the only one.
        ways: values of ``recipe.per_cost``.
    """

    title = "Columns by gain for their cost"
    about = (
        "`+exp=unseen4` with pooled columns, by `recipe.per_cost`; a decision in float32 on "
        "a Cortex-M7 that QEMU emulates, and in float64 on this machine, on one thread; computed: "
        "from the table of costs"
    )
    page, has_headings = "docs/speed.md", False
    quick = (
        "seeds=[0] columns=[4] ways=['null',m7] "
        "overrides=[data.cycles=2,recipe.sample_bins=20,num_workers=0]"
    )
    charts: ClassVar = {"": (("Means", "held-out"), ("Means", "M7"))}
    seeds: tuple[int, ...] = (0, 1)
    columns: tuple[int, ...] = (20, 120)
    ways: tuple[str, ...] = ("null", "m7")
    overrides: tuple[str, ...] = ()

    def measure(self, job: Job) -> dict[str, Any]:
        """Each number of columns, way and seed."""
        if missing := missing_tools(BOARD_TOOLS):
            raise ValueError(f"not installed: {', '.join(missing)}; run .ci/boards")
        rows, detectors = list[dict[str, Any]](), []
        for num, way, seed in product(self.columns, self.ways, self.seeds):
            folder = job.folder / f"{num}-{way}-{seed}"
            words = [f"recipe.num_features={num}", f"recipe.per_cost={way}", f"seed={seed}"]
            words += [
                "+exp=unseen4",
                "baselines=false",
                "recipe.views=[pooled]",
                *self.overrides,
                *job.overrides,
            ]
            metrics = trained(words, folder, job.folder / "cache")
            detectors.append(loaded(folder / "detector.pt"))
            found = {"num": num, "way": way, "seed": seed}
            for role in ("test", "unseen"):
                found[role] = 100 * metrics["splits"][role]["balanced_accuracy"]
            rows.append(found)
        for machine, run in RUNS.items():
            for row, detector, cost in zip(rows, detectors, run(detectors), strict=True):
                row |= {machine: cost, f"{machine} computed": decision_cost(detector, machine)}
        return {"rows": rows}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Means over seeds, and how far the table of costs is off."""
        shown = []
        for (num, way), own in by(numbers["rows"], "num", "way").items():
            of = {key: [row[key] for row in own] for key in own[0]}
            shown.append(
                {
                    "columns by": f"{WAYS[way]}, {num} columns",
                    "test %": mean_sd(of["test"]),
                    "held-out materials %": mean_sd(of["unseen"]),
                    "M7, M instructions": f"{mean(of['m7']) / 1e6:.2f}",
                    "computed, M instructions": f"{mean(of['m7 computed']) / 1e6:.2f}",
                    "x86-64, us": f"{mean(of['x86']):.1f}",
                    "computed, us": f"{mean(of['x86 computed']):.1f}",
                }
            )
        seeds = list(dict.fromkeys(str(row["seed"]) for row in numbers["rows"]))
        of_seeds = f"Mean and standard deviation over seeds {', '.join(seeds)}."
        return {"Means": Table(shown, of_seeds if len(seeds) > 1 else f"Seed {seeds[0]}.")}


if __name__ == "__main__":
    sys.exit(PerCost().run())
