"""Which sensors matter: ``python -m benchmarks.sensors [key=value ...]``.

Trains ``+exp=unseen4`` and runs ``tactslip importance`` on it with features selected
anew in both ways, by the recipe's ranking and as many of each channel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from benchmarks.harness import Benchmark, Job, result_of, trained
from benchmarks.tables import Table
from tactslip_torch.report.importance import (
    RESELECT_WORDS,
    best_rows,
    lines_about,
    unit_rows,
    with_all_line,
)


@dataclass(frozen=True)
class Sensors(Benchmark):
    """Both ways of selection.

    Overrides of the training and of ``tactslip importance``.
    """

    title = "Which sensors matter"
    about = (
        "what a detector loses without a sensor, one by one, and the best few, with features "
        "selected anew in two ways"
    )
    quick = (
        'training=[+exp=quick,recipe=paper,recipe.num_features=12,"recipe.penalties=[0.001]",'
        '"data.materials=[M1,M4,iron]","split.seen=[M1,M4]",baselines=false,num_workers=0] '
        "overrides=[bins=10,scored_bins=20,gradient_bins=20,most_channels=3,draws=20,num_workers=0]"
    )
    drawn: ClassVar = {"sensors.png": ""}
    training: tuple[str, ...] = ("+exp=unseen4", "recipe=paper")
    overrides: tuple[str, ...] = ()

    def measure(self, job: Job) -> dict[str, Any]:
        """One by one and the best few, by way of selection and by unit."""
        detector = job.folder / "detector"
        trained(self.training, detector, job.folder / "cache")
        found = {}
        for way, selected in RESELECT_WORDS.items():
            overrides = [f"model={detector / 'detector.pt'}", f"reselect={way}"]
            overrides += [f"cache={job.folder / 'cache'}", *self.overrides, *job.overrides]
            content = result_of("importance", overrides, job.folder / way, "sensors.json")
            for unit in content["best"]:
                words, is_first = f"{unit}, features {selected}", unit == "kind"
                about = "; ".join(lines_about(content)) if is_first else ""
                found[f"Without one {words}"] = Table(unit_rows(content, unit), about)
                about = with_all_line(content) if is_first else ""
                found[f"The best few by {words}"] = Table(best_rows(content, unit), about)
        return {"tables": found, "folder": str(job.folder / next(iter(RESELECT_WORDS)))}


if __name__ == "__main__":
    raise SystemExit(Sensors().run())
