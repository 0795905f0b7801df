"""Every command and program of YOUR_HAND.md, in order, in an empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[1] / "YOUR_HAND.md").read_text()
PARTS = re.findall(r"```(python|bash)\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.slow
def test_the_whole_way(tmp_path):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    home = {**os.environ, "PATH": path, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    said = []
    for language, part in PARTS:
        run = [sys.executable, "-c"] if language == "python" else ["bash", "-e", "-c"]
        done = subprocess.run(
            [*run, part], cwd=tmp_path, env=home, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{part}\n{done.stdout}\n{done.stderr}"
        said.append(done.stdout)
    assert len(said) == 9
    assert "SIMULATED" not in said[4]  # plain tables do not say where they come from
    for name in ("detector.pt", "model.onnx", "stream.onnx", "metrics.json"):
        assert (tmp_path / "trained" / name).is_file()
    assert (tmp_path / "summary.png").stat().st_size > 10_000
    assert (tmp_path / "detected" / "onsets.csv").read_text().count("\n") >= 2
    assert "probability" in said[7]
    assert len(list((tmp_path / "converted").glob("*.h5"))) == 15


def test_links_lead_somewhere():
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", TEXT):
        assert (Path(__file__).parents[1] / target).exists(), target
