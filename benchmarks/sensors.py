"""Which sensors matter: ``python -m benchmarks.sensors [key=value ...]``.

Trains ``+exp=unseen4`` and runs ``tactslip importance`` on it with features selected
anew in both ways, by the recipe's ranking and as many of each channel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Job, Report, Table, result_of, take_figures, trained
from tactslip_torch.report.importance import (
    RESELECT_WORDS,
    best_rows,
    lines_about,
    unit_rows,
    with_all_line,
)


@dataclass(frozen=True)
class Sizes:
    """Overrides of the training and of ``tactslip importance``."""

    training: tuple[str, ...] = ("+exp=unseen4", "recipe=robust")
    overrides: tuple[str, ...] = ()


class Sensors(Benchmark[Sizes]):
    """Both ways of selection."""

    name = "sensors"
    title = "Which sensors matter"
    about = (
        "what a detector loses without a sensor, one by one, and the best few, with features "
        "selected anew in two ways"
    )
    sizes = Sizes()
    quick = Sizes(
        ("+exp=quick", "recipe=robust", "recipe.num_features=12", "recipe.penalties=[0.001]"),
        ("bins=20", "cache=off", "num_workers=0"),
    )

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """What the command leaves, by way of selection."""
        detector = job.folder / "detector"
        trained("detector for sensors", job.sizes.training, detector, job.folder / "cache")
        found = {}
        for way in RESELECT_WORDS:
            overrides = [f"model={detector / 'detector.pt'}", f"reselect={way}"]
            overrides += [*job.sizes.overrides, *job.overrides]
            found[way] = result_of("importance", overrides, job.folder / way, "sensors.json")
        return {"ways": found, "folder": str(job.folder / next(iter(RESELECT_WORDS)))}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """One by one and the best few, by way of selection and by unit."""
        found = {}
        for way, content in numbers["ways"].items():
            words = RESELECT_WORDS[way]
            for unit in content["best"]:
                is_first = unit == "kind"
                found[f"Without one {unit}, features {words}"] = Table.of(
                    unit_rows(content, unit), "; ".join(lines_about(content)) if is_first else ""
                )
                found[f"The best few by {unit}, features {words}"] = Table.of(
                    best_rows(content, unit), with_all_line(content) if is_first else ""
                )
        return found

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """The command has drawn it."""

    def figures(self, report: Report, path: Path) -> None:
        """That of the command, features by the recipe's ranking."""
        take_figures(Path(report["numbers"]["folder"]), {"sensors.png": path})


if __name__ == "__main__":
    raise SystemExit(Sensors().run())
