"""What the detectors are that come with the package: ``python -m benchmarks.model_card``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import torch

from benchmarks.harness import Benchmark, Job
from benchmarks.tables import ROLES, Table, listed
from benchmarks.timing import interleaved, on_threads
from tactslip_torch import SlipDetector
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.pretrained import NAME, REAL_NAME

SOURCES = ("tactslip_torch/pretrained/*.pt",)


@dataclass(frozen=True)
class ModelCard(Benchmark):
    """Metadata, size and speed.

    Args:
        rounds: of timed calls.
    """

    title = "The detectors that come with the package"
    about = "read from the files of the detectors; times are of one bin, raw to score, on 1 thread"
    page, is_simulated = "docs/model_card.md", False
    quick = "rounds=2"
    charts: ClassVar = {"": [("Size and speed", ("one bin", "size"))]}
    rounds: int = 40

    @torch.inference_mode()
    def measure(self, job: Job) -> dict[str, Any]:
        """A table for each detector, and one of size and speed."""
        with on_threads(1):
            cards = {name: self._card(name) for name in (NAME, REAL_NAME)}
        tables = {f"`{name}`": table for name, (table, _) in cards.items()}
        costs = [{"detector": name} | cost for name, (_, cost) in cards.items()]
        return {"tables": tables | {"Size and speed": Table(costs)}}

    def _card(self, name: str) -> tuple[Table, dict[str, float]]:
        detector = SlipDetector.pretrained(name)
        info, pool = detector.info, detector.pool
        length = detector.context_before + pool.bin_samples + detector.context_after
        one = torch.randn(1, len(pool.hand.channels), length, dtype=torch.float64)
        timing = interleaved({name: lambda: detector.score_raw(one)}, self.rounds)[name]
        with TemporaryDirectory(prefix="tactslip-bench-") as folder:
            graphs = export_detector(detector, Path(folder), ("bin", "stream"), "float32")
            sizes = {path.name: path.stat().st_size for path in graphs}
            detector.save(Path(folder) / "detector.pt")
            sizes["detector.pt"] = (Path(folder) / "detector.pt").stat().st_size
        known = info.get("balanced_accuracy") or {}
        fast = sum(channel.adapting == "fast" for channel in pool.hand.channels)
        cost = {"one bin, us": 1e6 * timing["p50_s"]}
        cost |= {f"size of {file}, kB": size / 1e3 for file, size in sizes.items()}
        table = listed(
            "what",
            {
                "made by": f"`{info['made_by']}`",
                "trained on": f"{'simulated' if info['simulated'] else 'real'}: "
                + ", ".join(info.get("trained_on", info["train_materials"])),
                "bins of training": f"{info['num_bins']:,}",
                "channels": f"{len(pool.hand.channels)}, {fast} of them fast",
                "sample rate": f"{pool.sample_rate_hz:g} Hz",
                "bin; look-ahead": f"{1e3 * pool.bin_samples / pool.sample_rate_hz:.0f} ms; "
                f"{1e3 * detector.look_ahead / pool.sample_rate_hz:.1f} ms",
                **{
                    f"balanced accuracy, {ROLES.get(role, role)}": f"{100 * of:.2f} %"
                    for role, of in known.items()
                },
                "alarm": repr(info["alarm"]["rule"]["name"]) + ", no rate of false alarms is set",
            },
        )
        return table, cost


if __name__ == "__main__":
    raise SystemExit(ModelCard().run())
