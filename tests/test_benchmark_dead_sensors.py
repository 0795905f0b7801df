"""The benchmark of dead sensors: its losses, its ways, and how they are told."""

import json

import pytest
import torch
from small_detector import HAND
from test_missing import with_gaussians

from benchmarks.dead_sensors.figure import figure
from benchmarks.dead_sensors.measure import MEAN, OURS, REFIT, losses, masks
from benchmarks.dead_sensors.report import WAYS, limit_rows, report_text
from benchmarks.dead_sensors.sizes import Sizes
from benchmarks.dead_sensors.subject import Bins, Subject, class_weights
from tactslip_torch.model.calibration import Platt

SIZES = Sizes(halves=3, draws=20)


def made_bins(detector, seed, num=240):
    """Bins of the detector's own Gaussians, twelve to a recording."""
    generator = torch.Generator().manual_seed(seed)
    is_slip = torch.arange(num) % 12 < 5
    factor = torch.linalg.cholesky(detector.gaussians.covariance)[is_slip.long()]
    noise = torch.randn(num, 12, 1, generator=generator, dtype=torch.float64)
    z = detector.gaussians.mean[is_slip.long()] + (factor @ noise).squeeze(-1)
    recording = torch.arange(num) // 12
    return Bins(z.clamp(-1, 1), is_slip, recording, recording % 3)


@pytest.fixture(scope="module")
def rows():
    detector = with_gaussians()
    bins = {
        role: made_bins(detector, seed) for seed, role in enumerate(("train", "test", "unseen"))
    }
    return losses(Subject(detector, Platt(0.3, 0.0), bins, 1.0, True), SIZES)


def test_every_loss_is_judged_in_every_way_and_role(rows):
    named = masks(HAND, SIZES)
    assert {group: len(of) for group, of in named.items()} == {
        "channel": 4,
        "finger": 2,
        "kind": 2,
        "half": 3,
    }
    assert all(len(channels) == 2 for channels in named["half"].values())
    told = {(row["group"], row["dead"], row["role"], row["way"]) for row in rows}
    assert len(told) == len(rows) == 11 * 2 * len(WAYS)
    assert {row["way"] for row in rows} == set(WAYS)
    assert all(0 <= row["ece"] <= 1 and 0 <= row["balanced_accuracy"] <= 1 for row in rows)


def test_where_the_gaussians_are_true_the_closed_form_is_better_than_the_mean(rows):
    own = {way: [r["balanced_accuracy"] for r in rows if r["way"] == way] for way in (OURS, MEAN)}
    assert sum(own[OURS]) > sum(own[MEAN])
    assert all(row["ours_gap_se"] == 0 for row in rows if row["way"] == OURS)
    assert any(row["ours_gap_se"] > 0 for row in rows if row["way"] == REFIT)


def test_limits_are_missed_where_ours_is_worse(rows):
    assert len(limit_rows(rows)) == 5
    turned = [
        {**row, "balanced_accuracy": 0.5, "ece": 0.2} if row["way"] == OURS else row
        for row in ({**row, "balanced_accuracy": 0.9, "ours_gap_se": 0.01} for row in rows)
    ]
    assert not any(row["ok"] for row in limit_rows(turned))


def test_classes_weigh_alike():
    is_slip = torch.tensor([True, True, True, False])
    weights = class_weights(is_slip)
    assert float(weights[is_slip].sum()) == pytest.approx(float(weights[~is_slip].sum()))
    assert float(weights.mean()) == pytest.approx(1.0)


def test_the_report_is_told_and_drawn(rows, tmp_path):
    report = {
        "simulated": True,
        "quick": False,
        "machine": {"processor": "any"},
        "versions": {"torch": "any"},
        "settings": {"halves": 3},
        "num_features": 12,
        "sections": {"losses": rows},
        "limits": limit_rows(rows),
    }
    text = report_text(json.loads(json.dumps(report)))
    for word in ("simulated", "index", "thumb", *WAYS):
        assert word in text
    figure(report, tmp_path / "dead.png")
    assert (tmp_path / "dead.png").stat().st_size > 10_000
