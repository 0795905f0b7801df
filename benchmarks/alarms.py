"""One false alarm an hour, asked for and kept: ``python -m benchmarks.alarms [key=value ...]``.

Runs ``python -m tactslip_torch.train +exp=onset`` and puts its tables into docs/onset.md.
"""

from __future__ import annotations

from typing import Any, ClassVar

from benchmarks.harness import Benchmark, Job, Overrides, Report, Table, result_of
from benchmarks.onset import QUICK_STREAMS, QUICK_TRAINING
from tactslip_torch.report.results import rate_rows, scene_rows, target_line

_KEPT = ("simulated", "experiment", "seed", "versions", "events", "alarm")


class Alarms(Benchmark[Overrides]):
    """The alarm of ``+exp=onset``."""

    name = "alarms"
    title = "Alarms"
    about = "false alarms an hour, asked for and kept, and how late slips are found"
    page, markers = "docs/onset.md", "onset"
    sizes = Overrides(("+exp=onset",))
    quick = Overrides(
        ("+exp=onset", *QUICK_TRAINING, *QUICK_STREAMS, "onset.hours=0.002", "onset.hop_ms=50")
    )
    drawn: ClassVar = {"alarm.png": "", "events.png": "_delay", "reliability.png": "_reliability"}

    def measure(self, job: Job[Overrides]) -> dict[str, Any]:
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
            "Alarms": Table(rate_rows(numbers), about),
            "Confounders": Table(scene_rows(numbers), confounders),
        }


if __name__ == "__main__":
    raise SystemExit(Alarms().run())
