import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import clocks, engines, selection
from benchmarks.bins import raw_bins
from benchmarks.detectors import Timed, timed_detector
from benchmarks.engines import ENGINES, FLOAT32, FLOAT64
from benchmarks.latency import __main__ as bench
from benchmarks.latency import measure, report, ways
from benchmarks.latency.sizes import QUICK, Sizes
from benchmarks.outcome import QUICK_LINE
from tactslip_torch import SlipDetector
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler

TINY: Sizes = replace(QUICK, bins=3, judged=3, rounds=2, most_calls=2)


@pytest.fixture(scope="module")
def timed() -> Timed:
    return timed_detector(1)


# ---------------------------------------------------------------------------------- detectors
def test_the_kept_selection_is_of_the_main_job() -> None:
    kept = selection.kept_selection()
    assert kept["trained"]["experiment"] == "unseen4"
    assert len(kept["names"]) == len(set(kept["names"])) == 120
    assert "120 features, selected by +exp=unseen4" in selection.source_text(kept)


def test_a_timed_detector_has_the_selection(timed: Timed) -> None:
    detector = timed.detector(ENGINES[0], FLOAT32)
    assert [str(name) for name in detector.selected_names] == timed.selection["names"]
    assert detector.extractor.engine == ENGINES[0]
    assert {buffer.dtype for buffer in detector.head.buffers()} == {torch.float32}
    assert timed.detector("reference", FLOAT64).head is not timed.head  # each is its own


def test_every_head_is_of_the_same_machine(timed: Timed) -> None:
    wanted = timed.head(timed.z)
    torch.testing.assert_close(timed.kernel_sum()(timed.z), wanted, rtol=1e-8, atol=1e-8)


def test_a_trained_detector_lends_its_selection(timed: Timed, tmp_path: Path) -> None:
    path = tmp_path / "detector.pt"
    given = timed.detector("reference", FLOAT64)
    facts = timed.selection["trained"] | {"seed": 7}
    chosen = given.selected[:5]
    small = SlipDetector(
        given.pool,
        given.channel_filter,
        chosen,
        type(given.scaler)(*(of[:5] for of in (given.scaler.minimum, given.scaler.maximum))),
        QuadraticForm(torch.eye(5).double(), torch.zeros(5).double(), torch.ones(()).double()),
        facts,
    )
    small.save(path)
    made = timed_detector(1, path)
    assert made.selected == chosen
    assert made.selection["trained"]["seed"] == 7
    assert torch.equal(made.scaler.minimum, small.scaler.minimum)
    kept = tmp_path / "kept.json"
    assert selection.main([str(path), "--json", str(kept)]) == 0
    assert json.loads(kept.read_text())["names"] == made.selection["names"]


@pytest.mark.parametrize("main", [bench.main, lambda a: selection.main(a[-1:])])
def test_a_missing_detector_is_one_line(
    main: Callable[[list[str]], int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--quick", "--model", str(tmp_path / "none.pt")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# --------------------------------------------------------------------------------------- clocks
def test_single_calls_are_counted_and_timed_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(clocks.time, "perf_counter", lambda: now[0])
    seen: list[int] = []

    def quick(number: int) -> None:
        seen.append(number)
        now[0] += 1.0 if number != 2 else 5.0

    def slow(number: int) -> None:
        now[0] += 10.0

    found = clocks.shuffled_singles({"quick": quick, "slow": slow}, 2, 0, block_s=4, most_calls=3)
    assert found == {"quick": [[1.0, 5.0, 1.0], [1.0, 1.0, 1.0]], "slow": [[10.0], [10.0]]}
    assert seen == [0, 0, 0, 0, 1, 2, 3, 3, 4, 5, 6]  # tried, then one of each round not timed


# --------------------------------------------------------------------------------------- scores
def test_what_is_summed_up_is_every_call(rng: np.random.Generator) -> None:
    rounds = [rng.uniform(1, 2, 5).tolist(), rng.uniform(3, 4, 5).tolist()]
    found = measure.summary(rounds)
    every = np.sort(np.concatenate(rounds))
    assert found["calls"] == 10
    assert found["most_s"] == every[-1]
    assert found["p50_s"] == pytest.approx(every[4:6].mean())
    assert found["p25_s"] < found["p50_s"] < found["p75_s"] < found["p99_s"]
    assert found["round_medians_s"] == [pytest.approx(np.median(r)) for r in rounds]


@pytest.mark.parametrize("has_knee", [True, False])
@pytest.mark.parametrize("name", [ways.LOOP, ways.PRUNED_LOOP])
def test_the_loop_gives_the_detectors_score(timed: Timed, name: str, has_knee: bool) -> None:
    sizes = TINY
    if not has_knee:
        plain = FeatureScaler(timed.scaler.minimum, timed.scaler.maximum)
        timed = replace(timed, scaler=plain)
    wanted = timed.detector("reference", FLOAT64).score_raw(raw_bins(sizes.bins).double())
    every = range(2582) if name == ways.LOOP else list(timed.selected)
    score = ways._looped(timed, raw_bins(sizes.bins).numpy(), every)
    spread = float(wanted.std())
    assert score(1) == pytest.approx(float(wanted[1]), abs=1e-6 * spread)
    assert score(1 + sizes.bins) == score(1)


def test_the_pruned_loop_filters_only_what_is_wanted(
    timed: Timed, monkeypatch: pytest.MonkeyPatch
) -> None:
    savgol, seen = ways.loop.savgol, []

    def counted(samples: Any, *rest: Any) -> Any:
        seen.append(len(samples))
        return savgol(samples, *rest)

    monkeypatch.setattr(ways.loop, "savgol", counted)
    few = replace(timed, selected=timed.selected[:2], scaler=FeatureScaler.fit(torch.eye(2)))
    few = replace(few, z=timed.z[:, :2].contiguous(), head=lambda z: z[:, 0])
    ways._looped(few, raw_bins(1).numpy(), few.selected)(0)
    names = engines.pool_of(FLOAT64).names
    assert seen == [len({names[index].channel for index in few.selected})]
    assert seen[0] < 24


# --------------------------------------------------------------------------------------- report
def row(way: str, seconds: float, **changes: Any) -> dict[str, Any]:
    found = {"way": way, "is_whole": True, "features": 120, "error": 0.0}
    return found | measure.summary([[seconds], [seconds], [2 * seconds]]) | changes


@pytest.mark.parametrize(("seconds", "is_ok"), [(0.99e-3, True), (1.01e-3, False)])
def test_limit_is_on_the_eager_engine_beside_the_loop(seconds: float, is_ok: bool) -> None:
    rows = [
        row(ways.LOOP, 0.2, features=2582),
        row(f"eager, {FLOAT32}", seconds),
        row(ways.PRUNED_LOOP, 7 * seconds),
    ]
    limit, alike = report.limit_rows(rows)
    assert limit["ok"] is is_ok
    assert "(all 2582 features)" in limit["what"]
    assert "(its 120)" in limit["what"]
    assert alike["measured"].startswith("7 (")
    assert alike["ok"] is None
    assert [of["measured"] for of in report.limit_rows(rows[1:2])] == ["not measured"] * 2
    assert [of["ok"] for of in report.limit_rows([])] == [None, None]


def test_quick_run_measures_every_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("aeon")
    monkeypatch.setattr(bench, "QUICK", TINY)
    path, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    assert bench.main(["--quick", "--json", str(path), "--figure", str(drawing)]) == 0
    made = json.loads(path.read_text())
    assert made["quick"] is made["simulated"] is True
    rows = {of["way"]: of for of in made["sections"]["latency"]["rows"]}
    whole = {name for name, of in rows.items() if of["is_whole"]}
    for dtype in (FLOAT32, FLOAT64):
        assert {f"{engine}, {dtype}" for engine in (*ENGINES, "reference")} <= whole
    assert rows[ways.LOOP]["features"] == 2582
    for name, of in rows.items():
        assert of["p50_s"] <= of["p99_s"] <= of["most_s"]
        if FLOAT64 in name and of["error"] is not None:
            assert of["error"] < 1e-6
    assert rows[ways.LOOP]["error"] < 1e-6
    shown = capsys.readouterr().out
    assert QUICK_LINE in shown
    assert report.report_text(made) in shown
    assert drawing.stat().st_size > 0
