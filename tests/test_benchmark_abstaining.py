"""The benchmark of unsure answers: its splits, its ways, and how they are told."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch

from benchmarks import report as whole_report
from benchmarks.abstaining.figure import figure
from benchmarks.abstaining.report import OURS, limit_rows, mean_of, report_text, tables
from benchmarks.abstaining.sizes import QUICK, Sizes
from benchmarks.abstaining.splits import ROLES, Scored, SplitScores, choices
from benchmarks.abstaining.ways import (
    WAYS,
    by_bin,
    by_probability,
    by_recording,
    by_sign,
    measure_split,
)
from tactslip_torch.model.calibration import fit_platt, probability

MATERIALS = ("M1", "M2", "M3", "M4", "M5", "M6", "cloth", "copper", "iron", "wood")


def drawn(num: int, seed: int, apart: float = 1.0) -> Scored:
    """Recordings of eight bins of either class, all of a recording shifted alike."""
    generator = torch.Generator().manual_seed(seed)
    recording = torch.arange(num).repeat_interleave(16)
    is_slip = (torch.arange(16 * num) % 16) < 8
    shift = 0.6 * torch.randn(num, generator=generator)[recording]
    noise = 0.3 * torch.randn(16 * num, generator=generator)
    score = torch.where(is_slip, apart, -apart) + shift + noise
    return Scored(score.double(), is_slip, recording)


def made_split(seed: int = 0) -> SplitScores:
    known = drawn(40, seed)
    return SplitScores(
        ("iron",),
        {"bin": known, "recording": known, "material": drawn(40, seed + 50, 0.8)},
        torch.ones(len(known.score)),
        {"test": drawn(20, seed + 100), "unseen": drawn(20, seed + 200, 0.5)},
    )


def made_report() -> dict[str, Any]:
    coverages = (0.8, 0.9, 0.95)
    rows = [row for seed in range(3) for row in measure_split(made_split(seed), coverages)]
    return {
        "simulated": True,
        "quick": False,
        "machine": {"processor": "any"},
        "versions": {"torch": "any"},
        "settings": {"num_unseen": 1, "num_features": 6, "train_bins": 9},
        "sections": {"answers": rows},
        "limits": limit_rows(rows),
    }


def test_the_papers_split_comes_first_and_none_twice() -> None:
    found = choices(MATERIALS, Sizes())
    assert found[0] == ("cloth", "copper", "iron", "wood")
    assert len(found) == len(set(found)) == Sizes().splits
    assert choices(MATERIALS, Sizes()) == found
    assert choices(["M1", "M4", "iron"], QUICK)[0] == ("iron",)


def test_bins_as_units_are_bolder_than_recordings() -> None:
    split = made_split()
    for coverage in (0.9, 0.95):
        low, high = by_recording(split, coverage)
        low_of_bins, high_of_bins = by_bin(split, coverage)
        assert low <= low_of_bins <= 0 <= high_of_bins <= high
        assert (low, high) != (low_of_bins, high_of_bins)


def test_the_threshold_of_probability_is_that_of_the_calibration() -> None:
    split = made_split()
    own = split.held_out["material"]
    platt = fit_platt(own.score, own.is_slip, split.weights)
    ends = torch.tensor(by_probability(split, 0.9), dtype=torch.float64)
    found = probability(platt.llr(ends), 0.5)
    torch.testing.assert_close(found, torch.tensor([0.1, 0.9], dtype=torch.float64))


def test_every_way_is_judged_on_every_role_and_coverage() -> None:
    split = made_split()
    rows = measure_split(split, (0.8, 0.95))
    assert {(r["way"], r["asked"], r["role"]) for r in rows} == {
        (way, asked, role) for way in WAYS for asked in (0.8, 0.95) for role in ROLES
    }
    json.dumps(rows, allow_nan=False)
    never = next(r for r in rows if r["way"] == "never unsure" and r["role"] == "test")
    assert by_sign(split, 0.8) == (0.0, 0.0)
    bins = split.judged["test"]
    right = (bins.score >= 0) == bins.is_slip
    assert never["unsure"] == 0
    assert never["sure_accuracy"] == pytest.approx(float(right.double().mean()))
    assert never["slip"]["coverage"] == pytest.approx(float(right[bins.is_slip].double().mean()))


def test_means_are_over_splits_and_the_worst_is_kept() -> None:
    rows = made_report()["sections"]["answers"]
    own = [r for r in rows if (r["way"], r["asked"], r["role"]) == (OURS, 0.9, "test")]
    assert len(own) == 3
    found = mean_of(rows, OURS, 0.9, "test")
    assert found is not None
    shares = [row["slip"]["coverage"] for row in own]
    assert found["slip_coverage"] == pytest.approx(sum(shares) / 3)
    assert found["slip_worst"] == min(shares)
    assert mean_of(rows, OURS, 0.5, "test") is None


def test_a_promise_that_is_not_kept_is_a_limit_missed() -> None:
    rows = made_report()["sections"]["answers"]
    for row in rows:
        broken = row["way"] == OURS and row["asked"] == 0.95 and row["role"] == "test"
        row["slip"] = {**row["slip"], "coverage": 0.9 if broken else 1.0}
        row["non_slip"] = {**row["non_slip"], "coverage": 1.0}
    verdicts = {row["what"]: row["ok"] for row in limit_rows(rows)}
    assert len(verdicts) == 6
    (missed,) = [what for what, ok in verdicts.items() if not ok]
    assert missed.startswith("slip covered on test where 95 % are asked")


def test_the_report_shows_every_way_and_stands_in_the_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    report = made_report()
    text = report_text(report)
    assert "SIMULATED" in text
    for way in WAYS:
        assert way in text
    by_title = tables(report)
    assert list(by_title) == ["Limits", *(f"{role}: {what}" for role, what in ROLES.items())]
    assert len(by_title["test: held-out cycles of seen materials"][0].rows) == 3 * len(WAYS)
    figure(report, tmp_path / "abstaining.png")
    assert (tmp_path / "abstaining.png").read_bytes().startswith(b"\x89PNG")
    page = whole_report.markdown({"abstaining": report}, "images")
    assert "python -m benchmarks.abstaining" in page
    assert "never unsure" in page
