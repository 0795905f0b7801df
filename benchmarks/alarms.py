"""One false alarm an hour, asked for and kept: ``python -m benchmarks.alarms [key=value ...]``.

Runs ``python -m tactslip_torch.train +exp=onset`` and puts its tables into docs/onset.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Job, Report, Table, result_of, take_figures
from benchmarks.onset import QUICK_STREAMS, QUICK_TRAINING
from tactslip_torch.report.results import rate_rows, scene_rows, target_line

_KEPT = ("simulated", "experiment", "seed", "versions", "events", "alarm")


@dataclass(frozen=True)
class Sizes:
    """Overrides of ``tactslip_torch.train``, before those of the command line."""

    overrides: tuple[str, ...] = ("+exp=onset",)


class Alarms(Benchmark[Sizes]):
    """The alarm of ``+exp=onset``."""

    name = "alarms"
    title = "Alarms"
    about = "false alarms an hour, asked for and kept, and how late slips are found"
    page, markers = "docs/onset.md", "onset"
    sizes = Sizes()
    quick = Sizes(
        ("+exp=onset", *QUICK_TRAINING, *QUICK_STREAMS, "onset.hours=0.002", "onset.hop_ms=50")
    )

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """What the training leaves, and where."""
        overrides = [*job.sizes.overrides, *job.overrides]
        metrics = result_of("train", overrides, job.folder, "metrics.json")
        return {key: metrics[key] for key in _KEPT} | {"folder": str(job.folder)}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """What was kept of the target, and confounders."""
        settings = numbers["alarm"]["settings"]
        hop_ms = 1e3 * settings["hop_samples"] / numbers["alarm"]["sample_rate_hz"]
        about = f"Seed {numbers['seed']}, a decision every {hop_ms:g} ms; {target_line(numbers)}."
        confounders = "By the same threshold; the methods to the right by theirs."
        return {
            "Alarms": Table.of(rate_rows(numbers), about),
            "Confounders": Table.of(scene_rows(numbers), confounders),
        }

    def section(self, report: Report) -> str:
        """The tables alone: docs/onset.md says the rest."""
        tables = [table.markdown() for table in self.tables(report["numbers"]).values()]
        kind = "Simulated" if report["numbers"]["simulated"] else "Recorded"
        command = f"`python -m benchmarks.alarms`, code {report['code']}"
        return "\n\n".join([f"{kind} ({command}):", *tables])

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """The training has drawn it."""

    def figures(self, report: Report, path: Path) -> None:
        """Those of the training: alarms, delays, reliability."""
        names = {"alarm.png": "", "events.png": "_delay", "reliability.png": "_reliability"}
        given = {old: path.with_stem(f"{path.stem}{new}") for old, new in names.items()}
        take_figures(Path(report["numbers"]["folder"]), given)


if __name__ == "__main__":
    raise SystemExit(Alarms().run())
