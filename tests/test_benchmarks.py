"""Each benchmark runs in its smallest form, and writes where it is told."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
BENCHMARKS = {
    "abstaining": "--json --figure",
    "adapting": "--run",
    "dead_sensors": "--json --figure",
    "deployment": "--json --figure",
    "features": "--json --figure",
    "formats": "--json --figure",
    "generalisation": "--runs --cache",
    "gradients": "--json --figure",
    "latency": "--json --figure",
    "model": "--json --figure",
    "onset": "--json --figure --runs",
    "precision": "--json --figure",
    "real": "--runs",
    "reproduction": "--runs",
    "scene_weights": "--cache",
    "simulation": "--json --figure",
    "simulation.realism": "--json",
    "streaming": "--json --figure",
    "throughput": "--json --figure",
    "train": "--json",
    "tuning": "--json --figure",
}
"""Options that take a path: where results of a quick run go."""
ENDS = {"--json": "numbers.json", "--figure": "drawing.png"}


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_runs_in_its_smallest_form(name: str, tmp_path: Path) -> None:
    arguments = ["--quick"]
    for option in BENCHMARKS[name].split():
        arguments += [option, str(tmp_path / ENDS.get(option, option.strip("-")))]
    if name in ("real", "simulation.realism"):
        arguments.append(f"data.root={_real_set(tmp_path / 'set')}")
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    if "--json" in arguments:
        assert json.loads((tmp_path / ENDS["--json"]).read_text())
    if "--figure" in arguments:
        assert (tmp_path / ENDS["--figure"]).stat().st_size > 10_000


def _real_set(root: Path) -> Path:
    """A set of the layout of the BioTac SP one: slip is a vibration, stable touch is not."""
    generator = np.random.default_rng(5)
    header = ",".join(f"ff_e{place + 1}" for place in range(24))
    for scene, pitch in {"n": 0.9, "cw": 1.4, "t": 0.0}.items():
        folder = root / "csvs" / scene
        folder.mkdir(parents=True)
        for number, name in enumerate(("bottle", "brush", "pen") * 2):
            times = np.arange(50 + 64 + 32)
            counts = 2500 + 40 * generator.random((len(times), 24)) + 100 * number
            counts[50:] += 60 * np.sin(pitch * times[50:, None] + np.arange(24)) * (pitch > 0)
            rows = "\n".join(",".join(map(str, row)) for row in counts.round().astype(int))
            (folder / f"{name}{number}.csv").write_text(f"{header}\n{rows}\n")
    return root
