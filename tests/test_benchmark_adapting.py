import json
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.adapting import __main__ as bench
from benchmarks.adapting import report
from benchmarks.adapting.measure import AUTO, CEILING, ONE, SHIFT, SLIP_FREE, best_shift
from benchmarks.adapting.subject import divided, drawn
from benchmarks.outcome import QUICK_LINE
from tactslip_torch.data.recording import RecordingId


def row(way: str, count: int, draw: int, new: float, old: float) -> dict[str, Any]:
    return {"material": "x", "way": way, "count": count, "draw": draw, "new": new, "old": old}


def found(new: float, olds: tuple[float, ...] = (0.9,)) -> dict[str, Any]:
    rows = [row(AUTO, 5, draw, new, old) for draw, old in enumerate(olds)]
    ceiling = row(CEILING, 20, 0, 0.9, 0.9)
    return {"rows": [*rows, ceiling], "before": {"new": {"x": 0.7}, "old": 0.9}}


STEP = {
    "seconds": {"read": 1.0, "add": 2.0, "undo": 0.1},
    "recordings": 5,
    "features": 60,
    "restores": True,
}


@pytest.mark.parametrize(("new", "is_ok"), [(0.801, True), (0.799, False)])
def test_the_limit_lies_halfway_to_the_ceiling(new: float, is_ok: bool) -> None:
    assert report.limit_rows(found(new), STEP, 5)[0]["ok"] is is_ok


@pytest.mark.parametrize(("olds", "is_ok"), [((0.91, 0.896), True), ((0.91, 0.894), False)])
def test_old_materials_are_judged_by_their_worst_draw(olds: Any, is_ok: bool) -> None:
    assert report.limit_rows(found(0.8, olds), STEP, 5)[1]["ok"] is is_ok


def test_an_undo_that_restores_something_else_is_missed() -> None:
    rows = report.limit_rows(found(0.8), STEP | {"restores": False}, 5)
    assert [one["ok"] for one in rows if one["what"].startswith("undo")] == [False]


def test_the_threshold_goes_where_both_classes_are_told_best(rng: Any) -> None:
    scores = torch.from_numpy(rng.standard_normal(60))
    is_slip = scores + 0.8 * torch.from_numpy(rng.standard_normal(60)) > 0.4

    def balanced(shift: float) -> float:
        says = scores + shift >= 0
        return float(says[is_slip].double().mean() + (~says)[~is_slip].double().mean())

    shift = best_shift(lambda z: z[:, 0], scores[:, None], is_slip)
    best = max(balanced(-float(at) + nudge) for at in scores for nudge in (1e-9, -1e-9))
    assert balanced(shift) == pytest.approx(best)


def test_judged_recordings_are_never_added() -> None:
    recordings = [RecordingId("x", cycle) for cycle in range(10)]
    pool, judged = divided(recordings, 0.8, seed=3)
    assert sorted(pool + judged) == recordings
    assert len(pool) == 8
    few, more = (drawn(pool, count, seed=1) for count in (2, 5))
    assert more[:2] == few
    assert not set(more) & set(judged)


@pytest.mark.slow
def test_the_quick_run_measures_every_way(tmp_path: Path, capsys: Any) -> None:
    numbers, drawn_to = tmp_path / "a.json", tmp_path / "a.png"
    options = ["--quick", "--run", str(tmp_path / "run")]
    assert bench.main([*options, "--json", str(numbers), "--figure", str(drawn_to)]) == 0
    made = json.loads(numbers.read_text())
    rows = made["sections"]["adapted"]["rows"]
    assert {one["way"] for one in rows} == {AUTO, ONE, SHIFT, SLIP_FREE, CEILING}
    assert made["simulated"] is True
    assert made["sections"]["step"]["restores"] is True
    assert all(0 < one["new"] <= 1 and 0 < one["old"] <= 1 for one in rows)
    assert drawn_to.stat().st_size > 10_000
    assert QUICK_LINE in capsys.readouterr().out
