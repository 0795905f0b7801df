"""The example program gives the scores that the package gives."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_detector import random_detector

from tactslip_torch import Scene, simulate
from tactslip_torch.export import export_onnx

PROGRAM = Path(__file__).parents[1] / "export" / "python" / "score.py"


@pytest.mark.onnx
@pytest.mark.slow
def test_the_program_prints_the_scores_of_the_package(tmp_path):
    detector = random_detector()
    recording = simulate(Scene("M1"), windows=[(1.0, 3.0)]).samples[:, 2000:6000]
    starts = range(25, 4000 - 125 + 1, 100)
    filtered = detector.channel_filter(recording.double())
    bins = torch.stack([filtered[:, s : s + 100] for s in starts])
    export_onnx(detector, tmp_path / "model.onnx")
    np.save(tmp_path / "recording.npy", recording.numpy())

    arguments = [tmp_path / "model.onnx", tmp_path / "recording.npy"]
    done = subprocess.run(
        [sys.executable, PROGRAM, *arguments], capture_output=True, text=True, check=True
    )
    rows = [line.split() for line in done.stdout.splitlines()]
    assert [float(row[0]) for row in rows] == pytest.approx([s / 2000 for s in starts])
    expected = detector(bins)
    shown = torch.tensor([float(row[2]) for row in rows], dtype=torch.float64)
    torch.testing.assert_close(shown, expected, rtol=0, atol=1e-3 * float(expected.std()) + 1e-4)
    assert [row[3:] == ["slip"] for row in rows] == (shown >= 0).tolist()
    assert "not valid" not in done.stdout

    broken = recording.numpy().copy()
    broken[detector.pool.hand.names.index(detector.selected_names[0].channel), 1234] = np.nan
    np.save(tmp_path / "recording.npy", broken)
    done = subprocess.run(
        [sys.executable, PROGRAM, *arguments], capture_output=True, text=True, check=True
    )
    marked = [s for s, line in zip(starts, done.stdout.splitlines(), strict=True) if "not" in line]
    assert marked
    assert all(s - 25 <= 1234 < s + 125 for s in marked)
    assert "nan" not in done.stdout

    np.save(tmp_path / "recording.npy", recording.numpy()[:7])
    failed = subprocess.run(
        [sys.executable, PROGRAM, *arguments], capture_output=True, text=True, check=False
    )
    assert failed.returncode != 0
    assert failed.stderr.strip() == "error: expected [24, samples], got (7, 4000)"
