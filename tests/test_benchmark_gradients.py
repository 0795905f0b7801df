import json
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.gradients import __main__ as bench
from benchmarks.gradients import report, worker
from benchmarks.gradients.sizes import Kind, Problem, Sizes
from benchmarks.gradients.ways import BASE, OURS, PEER, Subject, way_of
from benchmarks.model.worker import WorkerFailedError
from benchmarks.outcome import QUICK_LINE

TINY = Sizes(problems=(Problem("left out", 60, 4, has_peer=True),), groups=3, scored=20, rounds=1)
KINDS: tuple[Kind, ...] = ("dual", "primal", "left out")


def subject() -> Subject:
    return Subject.made(60, 4, groups=3, scored=20, penalty=1.0, offset=0.5)


def row(way: str, forward_s: float, backward_s: float = 1.0, mib: float = 100.0) -> dict[str, Any]:
    made = {
        "problem": "dual, 8,000 x 120",
        "num_bins": 8000,
        "way": way,
        "forward_s": [forward_s, forward_s, 3 * forward_s],
        "forward_bytes": [2**20] * 3,
        "whole_bytes": [round(mib * 2**20)] * 3,
        "gradient": None,
    }
    if way == BASE:
        return made
    gradient = [1.0, -2.0, 3.0, 4.0]
    return made | {"backward_s": [backward_s] * 2 + [3 * backward_s], "gradient": gradient}


@pytest.mark.parametrize("kind", KINDS)
def test_every_way_makes_the_same_loss_and_the_same_gradient(kind: Kind) -> None:
    losses = {way: way_of(kind, way)(subject()).item() for way in (BASE, OURS, PEER)}
    assert losses[OURS] == pytest.approx(losses[BASE], rel=1e-10)
    assert losses[PEER] == pytest.approx(losses[BASE], rel=1e-8)
    found = []
    for way in (OURS, PEER):
        learned = subject()
        found.append(torch.autograd.grad(way_of(kind, way)(learned), learned.learned))
    for ours, peer in zip(*found, strict=True):
        torch.testing.assert_close(ours, peer, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("back", "is_ok"), [(1.49, True), (1.51, False)])
def test_the_limit_on_time_is_on_the_ratio_to_the_fit_alone(back: float, is_ok: bool) -> None:
    made = report.limit_rows([row(BASE, 2.0), row(OURS, 9.0, 2.0 * back), row(PEER, 1.0, 0.1)])
    found = {of["what"]: of for of in made}
    assert len(found) == 2
    assert found["dual, 8,000 x 120: the way back / the fit alone"]["ok"] is is_ok


@pytest.mark.parametrize(("mib", "is_ok"), [(199.0, True), (201.0, False)])
def test_the_limit_on_memory_is_on_both_ways(mib: float, is_ok: bool) -> None:
    found = report.limit_rows([row(BASE, 2.0, mib=100.0), row(OURS, 2.0, mib=mib)])
    assert [of["ok"] for of in found] == [True, is_ok]


def test_small_problems_have_no_limit() -> None:
    small = {"num_bins": 2000, "problem": "dual, 2,000 x 120"}
    assert report.limit_rows([row(BASE, 2.0) | small, row(OURS, 2.0) | small]) == []


def test_the_table_compares_with_autograd() -> None:
    peer = row(PEER, 4.0, 12.0) | {"gradient": [1.0, -2.0, 3.03, 4.0]}
    made = {"sections": {"gradients": {"rows": [row(BASE, 2.0), row(OURS, 3.0, 1.0), peer]}}}
    found = report.tables(made | {"limits": []})["Forward and back"][0].rows
    assert found[0][3:6] == ["", "", ""]
    assert found[1][4:] == ["0.5", "1", "1", "100", "0.0099"]
    assert found[2][4:6] == ["6", "4"]


def test_a_worker_that_ends_is_named() -> None:
    with pytest.raises(WorkerFailedError, match="worker of dual of 60 bins, differentiable ended"):
        worker.measured(kind="dual", way=OURS, num_bins=60)


@pytest.mark.slow
def test_quick_run_measures_every_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    path, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    assert bench.main(["--quick", "--json", str(path), "--figure", str(drawing)]) == 0
    made = json.loads(path.read_text())
    assert made["quick"] is made["simulated"] is True
    rows = made["sections"]["gradients"]["rows"]
    assert [of["way"] for of in rows] == [BASE, OURS, PEER]
    for of in rows:
        assert len(of["forward_s"]) == TINY.rounds
        assert ("backward_s" in of) is (of["way"] != BASE)
        assert all(
            low <= high for low, high in zip(of["forward_bytes"], of["whole_bytes"], strict=True)
        )
    assert report.gradient_error(rows[1], rows[2]) < 1e-8
    shown = capsys.readouterr().out
    assert QUICK_LINE in shown
    assert report.report_text(made) in shown
    assert drawing.stat().st_size > 0
