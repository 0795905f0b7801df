"""Which features the main job selects: ``python -m benchmarks.selection detector.pt``.

Training takes minutes, so latency and throughput are measured with the selection of a training that
was kept: this program writes the names and where they come from into
``benchmarks/results/selection.json``, from a detector that
``python -m tactslip_torch.train +exp=unseen4`` has left.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.machine import versions
from benchmarks.outcome import RESULTS, keep_numbers
from tactslip_torch.model.detector import SlipDetector

KEPT = RESULTS / "selection.json"
_FACTS = ("experiment", "seed", "recipe", "simulated", "penalty", "kernel")


def selection_of(detector: SlipDetector) -> dict[str, Any]:
    """Names of the selected features, best first, and where they come from."""
    return {
        "trained": {name: detector.info.get(name) for name in _FACTS},
        "versions": versions(),
        "names": [str(name) for name in detector.selected_names],
    }


def kept_selection() -> dict[str, Any]:
    """What this program has written."""
    found: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8"))
    return found


def source_text(selection: Mapping[str, Any]) -> str:
    """Where a selection comes from, in words.

    Example:
        >>> source_text({"trained": {"experiment": "unseen4", "recipe": "robust", "seed": 0},
        ...     "names": ["a", "b"]})
        '2 features, selected by +exp=unseen4 recipe=robust seed=0'
    """
    trained = selection["trained"]
    words = [f"{name}={trained[name]}" for name in ("recipe", "seed")]
    return (
        f"{len(selection['names'])} features, selected by +exp={trained['experiment']} "
        f"{' '.join(words)}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.selection",
        description="Keep which features a trained detector uses.",
    )
    parser.add_argument("model", type=Path, help="detector.pt of a training")
    parser.add_argument("--json", type=Path, default=KEPT, metavar="FILE", help="(%(default)s)")
    parsed = parser.parse_args(arguments)
    try:
        detector = SlipDetector.load(parsed.model)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    keep_numbers(selection_of(detector), parsed.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
