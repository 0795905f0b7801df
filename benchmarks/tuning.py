"""What tuning by gradient buys beside a grid: ``python -m benchmarks.tuning``.

Runs ``python -m tactslip_torch.train +exp=tuned`` with more and more to learn, each evaluated on
training materials held out from it and, as a detector, on test and held-out materials.
"""

from __future__ import annotations

from statistics import mean
from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Job, Overrides, Report, Table, bars, percent, trained

LEARNED = {
    "C and c": "[penalty,offset]",
    "C, c and scales": "[penalty,offset,scales]",
}
GRID = {"recipe": "grid, by balanced accuracy", "grid": "grid, by loss"}


class Tuning(Benchmark[Overrides]):
    """Tuned by gradient, beside the grid of the recipe."""

    name = "tuning"
    title = "Tuned by gradient"
    about = "the kernel machine of the simulated hand tuned by gradient, beside its recipe's grid"
    sizes = Overrides(("+exp=tuned",))
    quick = Overrides(
        (
            "+exp=quick",
            "tuning=gradient",
            "tuning.bins=6",
            "tuning.steps=2",
            "recipe=robust",
            "recipe.num_features=8",
        )
    )

    def measure(self, job: Job[Overrides]) -> dict[str, Any]:
        """A training for each way."""
        found = {}
        for place, (name, learn) in enumerate(LEARNED.items()):
            overrides = [*job.sizes.overrides, *job.overrides, f"tuning.learn={learn}"]
            folder = job.folder / str(place)
            metrics = trained(f"tuning {name}", overrides, folder, job.folder / "cache")
            found[name] = metrics["tuning"] | {"tuned_splits": metrics["splits"]}
        return {"ways": found}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Losses and accuracies of every way."""
        rows = []
        for place, (name, found) in enumerate(numbers["ways"].items()):
            for way, words in GRID.items() if place == 0 else ():
                seconds = found["fit_s"] if way == "recipe" else None
                rows.append(_row(words, found, way, found["splits"][way], seconds))
            splits = found["tuned_splits"]
            rows.append(_row(f"{name} tuned", found, "tuned", splits, found["seconds"]))
        note = (
            "Held out: mean log loss (nats) and balanced accuracy of each training material under "
            "settings chosen without it; ranking and ranges met it. Seconds: of tuning, and of the "
            "whole first fit for the grid."
        )
        return {"Beside the grid": Table(rows, note)}

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Held-out losses."""
        first = next(iter(numbers["ways"].values()))
        losses = {words: _held_mean(first, way, "loss") for way, words in GRID.items()}
        losses |= {of: _held_mean(found, "tuned", "loss") for of, found in numbers["ways"].items()}
        values = {"loss": list(losses.values())}
        bars(drawing.subplots(), list(losses), values, "held-out loss", is_log=False)


def _row(
    name: str, found: Report, way: str, splits: Report, seconds: float | None
) -> dict[str, object]:
    row: dict[str, object] = {
        "settings": name,
        "held-out loss": f"{_held_mean(found, way, 'loss'):.4f}",
        "held-out %": percent(_held_mean(found, way, "balanced_accuracy")),
    }
    row |= {f"{of} %": percent(splits[of]["balanced_accuracy"]) for of in ("test", "unseen")}
    return row | {"seconds": None if seconds is None else round(seconds)}


def _held_mean(found: Report, way: str, measure: str) -> float:
    return mean(float(group[way][measure]) for group in found["held"])


if __name__ == "__main__":
    raise SystemExit(Tuning().run())
