"""Recipes on every choice of held-out materials: ``python -m benchmarks.crossval [key=value ...]``.

Runs ``tactslip crossval`` with each seed and puts its tables into docs/recipes.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from benchmarks.harness import Benchmark, Job, code_digest, result_of
from benchmarks.tables import Report, Table, percent
from tactslip_torch.report.crossval import material_rows, split_rows


@dataclass(frozen=True)
class Crossval(Benchmark):
    """Every choice of four held-out materials.

    Overrides of ``tactslip crossval``, before those of the command line, and its seeds.
    """

    title = "Every choice of held-out materials"
    about = "balanced accuracy, %, on every choice of held-out materials"
    page, has_headings = "docs/recipes.md", False
    quick = (
        'overrides=[data.cycles=4,"materials=[M1,M2,iron]",num_unseen=1,train_bins=20,'
        'scored_bins=20,"~recipes.general",recipes.paper.num_features=10,'
        '"recipes.paper.penalties=[0.001]"]'
    )
    drawn: ClassVar = {"crossval.png": ""}
    overrides: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)

    def measure(self, job: Job) -> dict[str, Any]:
        """What the command leaves with each seed; with ``seed=...`` given, with that one alone."""
        given = [each for each in job.overrides if each.startswith("seed=")]
        runs = []
        for seed in given[-1:] or [f"seed={seed}" for seed in self.seeds]:
            overrides = [*self.overrides, *job.overrides, *([] if given else [seed])]
            folder = job.folder / seed.replace("=", "-")
            found = result_of("crossval", overrides, folder, "crossval.json")
            runs.append(found | {"code": code_digest(), "folder": str(folder)})
        return {"runs": runs, "simulated": runs[0]["simulated"], "folder": runs[0]["folder"]}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """By choice and by material with each seed, and the worst of both where seeds are many."""
        runs, found = numbers["runs"], {}
        for run in runs:
            seed = f", seed {run['seed']}" if len(runs) > 1 else ""
            note = (
                f"Balanced accuracy, %, seed {run['seed']}; machines fitted on "
                f"{run['train_bins']} bins of each material and class; code {run['code']}."
            )
            found[f"By choice{seed}"] = Table(split_rows(run), note)
            found[f"By material{seed}"] = Table(material_rows(run), f"Seed {run['seed']}.")
        if len(runs) > 1:
            found["By seed"] = Table([row for run in runs for row in _worst_rows(run)])
        return found


def _worst_rows(run: Report) -> list[dict[str, object]]:
    """Mean over choices, the worst choice and the worst single material, of each recipe."""
    rows: list[dict[str, object]] = []
    for recipe, splits in run["splits"].items():
        known = [split for split in splits if split["unseen"] is not None]
        if not known:
            continue
        worst = min(known, key=lambda split: float(split["unseen"]))
        material, score, beside = min(
            (
                (material, score, split["materials"])
                for split in known
                for material, score in split["per_material"].items()
                if score is not None
            ),
            key=lambda of: float(of[1]),
        )
        rows.append(
            {
                "held-out materials": f"{recipe}, seed {run['seed']}",
                "mean %": percent(sum(split["unseen"] for split in known) / len(known)),
                "worst choice %": percent(worst["unseen"]),
                "which": ", ".join(worst["materials"]),
                "worst single material %": percent(score),
                "which of which choice": f"{material} of {', '.join(beside)}",
            }
        )
    return rows


if __name__ == "__main__":
    raise SystemExit(Crossval().run())
