"""Recipes on every choice of held-out materials: ``python -m benchmarks.crossval [key=value ...]``.

Runs ``tactslip crossval`` and puts its tables into docs/recipes.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Job, Report, Table, result_of, take_figures
from tactslip_torch.report.crossval import material_rows, split_rows


@dataclass(frozen=True)
class Sizes:
    """Overrides of ``tactslip crossval``, before those of the command line."""

    overrides: tuple[str, ...] = ()


class Crossval(Benchmark[Sizes]):
    """Every choice of four held-out materials."""

    name = "crossval"
    title = "Every choice of held-out materials"
    about = "balanced accuracy, %, on every choice of held-out materials"
    page = "docs/recipes.md"
    sizes = Sizes()
    quick = Sizes(
        (
            "data.cycles=4",
            "materials=[M1,M2,iron]",
            "num_unseen=1",
            "train_bins=20",
            "scored_bins=20",
            "~recipes.paper",
            "~recipes.general",
            "recipes.robust.num_features=10",
            "recipes.robust.penalties=[0.001]",
        )
    )

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """What the command leaves, and where."""
        overrides = [*job.sizes.overrides, *job.overrides]
        found = result_of("crossval", overrides, job.folder, "crossval.json")
        return found | {"folder": str(job.folder), "overrides": overrides}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """By choice and by material."""
        note = (
            f"Balanced accuracy, %, seed {numbers['seed']}; machines fitted on "
            f"{numbers['train_bins']} bins of each material and class."
        )
        return {
            "By choice": Table.of(split_rows(numbers), note),
            "By material": Table.of(material_rows(numbers)),
        }

    def section(self, report: Report) -> str:
        """The tables alone: docs/recipes.md says the rest."""
        shown = [f"'{each}'" for each in report["overrides"]]
        command = f"`{' '.join([f'python -m benchmarks.{self.name}', *shown])}`"
        tables = [table.markdown() for table in self.tables(report["numbers"]).values()]
        kind = "Simulated" if report["simulated"] else "Recorded"
        return "\n\n".join([f"{kind} ({command}, code {report['code']}):", *tables])

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """The command has drawn it."""

    def figures(self, report: Report, path: Path) -> None:
        """That of the command."""
        take_figures(Path(report["numbers"]["folder"]), {"crossval.png": path})


if __name__ == "__main__":
    raise SystemExit(Crossval().run())
