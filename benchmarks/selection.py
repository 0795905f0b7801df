"""Which features the main job selects: ``python -m benchmarks.selection detector.pt``.

Training takes minutes, so single bins and streams are timed with the selection of a training that
was kept: this program writes names, kernel and penalty to ``benchmarks/results/selection.json``,
from a detector that ``python -m tactslip_torch.train +exp=unseen4`` has left.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from benchmarks import RESULTS
from benchmarks.harness import keep_numbers, versions
from tactslip_torch import SlipDetector

KEPT = RESULTS / "selection.json"
_KEYS = ("experiment", "seed", "recipe", "simulated", "penalty", "kernel")


def kept_selection() -> dict[str, Any]:
    """``trained``, what it comes from, and ``names`` of the features, best first."""
    selection: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8"))
    return selection


if __name__ == "__main__":
    detector = SlipDetector.load(sys.argv[1])
    trained = {name: detector.info.get(name) for name in _KEYS}
    names = [str(name) for name in detector.selected_names]
    keep_numbers({"trained": trained, "versions": versions(), "names": names}, KEPT)
