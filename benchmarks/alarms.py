"""One false alarm an hour, kept or not: ``python -m benchmarks.alarms``.

Runs ``python -m tactslip_torch.train +exp=onset`` unless a run is given or this code has made it,
keeps its numbers and figures in ``benchmarks/results``, and puts the tables between the markers in
README.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.crossval import markdown
from benchmarks.outcome import RESULTS, ROOT, between_markers
from tactslip_torch.features.cache import source_digest
from tactslip_torch.report.results import (
    alarm_figure,
    events_figure,
    kept_rows,
    promise_line,
    reliability_figure,
    scene_rows,
)
from tactslip_torch.runtime import whole_file

COMMAND = "python -m benchmarks.alarms"
MARKER = "onset"
_KEPT = ("simulated", "experiment", "seed", "versions", "events", "alarm")


def text_of(metrics: Mapping[str, Any]) -> str:
    """What README says of a run.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    kind = "Simulated" if metrics["simulated"] else "Recorded"
    settings = metrics["alarm"]["settings"]
    hop_ms = 1e3 * settings["hop_samples"] / metrics["alarm"]["sample_rate_hz"]
    lines = [
        f"{kind}, seed {metrics['seed']}, a decision every {hop_ms:g} ms (`{COMMAND}`); "
        f"{promise_line(metrics)}:",
        markdown(kept_rows(metrics)),
        "Scenes that fool, by the same threshold; the methods to the right by theirs:",
        markdown(scene_rows(metrics)),
    ]
    return "\n\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--run", type=Path, help="folder of a run of +exp=onset that is there")
    parser.add_argument("overrides", nargs="*", help="passed on, such as onset.hours=1")
    options = parser.parse_args(arguments)
    run = options.run or ROOT / "outputs" / "onset" / "benchmark"
    if options.run is None:
        made_by = run / "code.txt"
        code = " ".join([source_digest(ROOT / "tactslip_torch"), *options.overrides])
        if not made_by.exists() or made_by.read_text() != code:
            command = [sys.executable, "-m", "tactslip_torch.train", "+exp=onset"]
            command += [*options.overrides, f"hydra.run.dir={run}"]
            done = subprocess.run(command, check=False)
            if done.returncode:
                raise SystemExit(done.returncode)
            made_by.write_text(code)
    found = json.loads((run / "metrics.json").read_text())
    metrics = {key: found[key] for key in _KEPT}
    with whole_file(RESULTS / "alarms.json") as temporary:
        temporary.write_text(json.dumps(metrics) + "\n")
    alarm_figure(metrics, RESULTS / "alarms.png")
    streams = {role: own for role, own in metrics["events"].items() if role.endswith("stream")}
    events_figure({**metrics, "events": streams}, RESULTS / "alarms_delay.png")
    reliability = metrics["alarm"]["reliability"]
    reliability_figure(
        reliability, RESULTS / "alarms_reliability.png", simulated=metrics["simulated"]
    )
    readme = ROOT / "README.md"
    with whole_file(readme) as temporary:
        temporary.write_text(between_markers(readme.read_text(), MARKER, text_of(metrics)))


if __name__ == "__main__":
    main()
