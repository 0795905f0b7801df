"""What tuning by gradient buys beside a grid: ``python -m benchmarks.tuning``.

Runs ``python -m tactslip_torch.train +exp=tuned`` with more and more to learn, each evaluated on
training materials held out from it and, as a detector, on test and held-out materials.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import mean
from typing import Any, ClassVar

from benchmarks.harness import Benchmark, Job, trained
from benchmarks.tables import Report, Table, percent

LEARNED = {"C and c": "[penalty,offset]", "C, c and scales": "[penalty,offset,scales]"}
GRID = {"recipe": "grid, by balanced accuracy", "grid": "grid, by loss"}


@dataclass(frozen=True)
class Tuning(Benchmark):
    """Tuned by gradient, beside the grid of the recipe.

    Args:
        overrides: of the training.
    """

    title = "Tuned by gradient"
    about = "the kernel machine of the simulated hand tuned by gradient, beside its recipe's grid"
    charts: ClassVar = {"": (("Beside the grid", "held-out loss"),)}
    quick = (
        "overrides=[+exp=quick,tuning=gradient,tuning.bins=6,tuning.steps=2,recipe=robust,"
        "recipe.num_features=8,num_workers=0,"
        'baselines=false,"recipe.penalties=[0.001,0.01]"]'
    )
    overrides: tuple[str, ...] = ("+exp=tuned",)

    def measure(self, job: Job) -> dict[str, Any]:
        """A training for each way."""
        rows: list[dict[str, object]] = []
        for place, (name, learn) in enumerate(LEARNED.items()):
            overrides = [*self.overrides, *job.overrides, f"tuning.learn={learn}"]
            metrics = trained(overrides, job.folder / str(place), job.folder / "cache")
            found = metrics["tuning"]
            if not rows:
                rows = [_row(of, found, way, found["splits"][way]) for way, of in GRID.items()]
                rows[0]["seconds"] = round(found["fit_s"])
            row = _row(f"{name} tuned", found, "tuned", metrics["splits"])
            rows.append(row | {"seconds": round(found["seconds"])})
        note = (
            "Held out: mean log loss (nats) and balanced accuracy of each training material under "
            "settings chosen without it; ranking and ranges met it. Seconds: of tuning, and of the "
            "whole first fit for the grid."
        )
        return {"tables": {"Beside the grid": Table(rows, note)}}


def _row(name: str, found: Report, way: str, splits: Report) -> dict[str, object]:
    def held_mean(measure: str) -> float:
        return mean(float(group[way][measure]) for group in found["held"])

    row: dict[str, object] = {"settings": name, "held-out loss": f"{held_mean('loss'):.4f}"}
    row["held-out %"] = percent(held_mean("balanced_accuracy"))
    row |= {f"{of} %": percent(splits[of]["balanced_accuracy"]) for of in ("test", "unseen")}
    return row | {"seconds": None}


if __name__ == "__main__":
    raise SystemExit(Tuning().run())
