"""The example scripts run, and do what they say."""

import runpy
from pathlib import Path

import pytest
import torch

from tactslip_torch import SlipDetector

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def example():
    """The names of an example script, which is no part of the package."""
    return lambda name: runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_a_filter_is_learned_through_the_fit_and_is_in_the_detector(tmp_path, example):
    learned = example("learned_filter")
    losses = learned["main"](str(tmp_path / "detector.pt"), steps=4)
    assert losses[-1] < losses[0]
    detector = SlipDetector.load(tmp_path / "detector.pt")
    kernel = detector.channel_filter.kernel(0)
    assert float(kernel.sum()) == pytest.approx(1)
    assert float((kernel - 1 / 11).abs().max()) > 1e-3
    raw, is_slip, _ = learned["raw_bins"]()
    right = (detector.score_raw(raw) >= 0) == is_slip
    assert float(right.double().mean()) > 0.6
    assert torch.equal(kernel, kernel.flip(0))
