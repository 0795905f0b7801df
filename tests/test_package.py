"""What stands at the top of the package: what importing it loads."""

from __future__ import annotations

import copy
import subprocess
import sys

import pytest
import torch
from contract.recordings import bins_of, samples_of
from contract.running import Trained

import tactslip_torch
from tactslip_torch import (
    AlarmSettings,
    Scene,
    SlipClassifier,
    StreamingDetector,
    SufficientStats,
    simulate,
)

HEAVY = "lightning hydra omegaconf matplotlib onnx onnxruntime sklearn scipy tensorboard pandas"


def test_importing_the_package_loads_little() -> None:
    code = (
        "import sys, tactslip_torch as t; assert 'torch' not in sys.modules; "
        "t.FeaturePool, t.SlipDetector, t.StreamingDetector, t.SufficientStats; "
        f"print(*set('{HEAVY}'.split()) & set(sys.modules))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout, loaded.stderr) == (0, "\n", "")


def test_copying_a_host_loads_no_more_than_paths() -> None:
    code = (
        "import sys; from tactslip_torch.commands import demo, hosts; hosts.hosts_dir(); "
        f"print(*set('torch {HEAVY}'.split()) & set(sys.modules))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout, loaded.stderr) == (0, "\n", "")


def test_a_classifier_loads_neither_training_nor_figures() -> None:
    code = "import sys; from tactslip_torch import SlipClassifier\n"
    code += "print(*{'lightning', 'hydra', 'matplotlib', 'tensorboard'} & set(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (loaded.returncode, loaded.stdout) == (0, "\n"), loaded.stderr


@pytest.mark.parametrize("name", tactslip_torch.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(tactslip_torch, name).__doc__
    assert name in dir(tactslip_torch)


def test_a_repr_says_what_it_is_in_a_line(general: Trained) -> None:
    detector, recording = general.detector, simulate(Scene("M6", tail_s=0.5, strokes=()))
    stats = SufficientStats(3)
    stats.update("a", torch.zeros(5, 3), torch.tensor([1, 1, 0, 0, 0]))
    stream = StreamingDetector(detector)
    stream.push(torch.zeros(400, 4))
    shown = [
        (detector, "4 channels, bins of 100 samples at 2000 Hz"),
        (detector, "trained on real recordings, has an alarm"),
        (detector.pool, "520 features of 4 channels"),
        (detector.pool.hand, "4 channels: 2 SG (slow), 2 PVDF (fast)"),
        (AlarmSettings.of(detector), "a decision every"),
        (stream, "0.200 s of 4 channels so far, look-ahead 12.5 ms"),
        (recording, "24 channels, 0.50 s at 2000 Hz, in V, material M6, no slip marked, simulated"),
        (Scene("M6", cycle=2), "'M6', cycle=2"),
        (stats, "1 batches, 2 slip and 3 non-slip bins of 3 features, degree 2"),
        (SlipClassifier(2000.0, detector.pool.hand), "hand=HandLayout(4 channels"),
    ]
    for thing, words in shown:
        assert words in repr(thing), repr(thing)
        assert repr(thing).startswith(f"{type(thing).__name__}(")
        assert len(repr(thing)) < 300
    found = detector.predict_raw(bins_of(detector, samples_of("D", 1))[:6])
    slip = int((found.score >= 0).sum())
    assert f"6 bins: {slip} slip, {6 - slip} non-slip, 0 not valid; 0 with lost" in repr(found)


def test_a_detector_gives_probabilities_of_raw_and_of_filtered_bins(paper: Trained) -> None:
    detector = copy.deepcopy(paper.detector)
    raw = bins_of(detector, samples_of("D", 1))[:6]
    plain = detector.info["alarm"]["calibration"]
    expected = torch.sigmoid(plain["slope"] * detector.score_raw(raw) + plain["offset"])
    bins = detector.channel_filter.valid(raw)
    for given in (raw, raw.numpy(), bins):
        torch.testing.assert_close(detector.probability(given), expected)
    assert torch.equal(detector.predict_proba(raw).sum(-1), torch.ones_like(expected))
    detector.info = {}
    with pytest.raises(ValueError, match=r"no calibration, .*several recipe.penalties"):
        detector.probability(raw)
