import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from engine_bins import some_hand

from benchmarks.detectors import timed_detector
from benchmarks.engines import ENGINES, FLOAT32, pool_of
from benchmarks.model.worker import WorkerFailedError
from benchmarks.selection import kept_selection
from benchmarks.throughput import __main__ as bench
from benchmarks.throughput import measure, report, worker
from benchmarks.throughput.sizes import QUICK

TINY = replace(
    QUICK,
    bulk_bins=6,
    reference_bins=2,
    batches=(1, 5),
    many=5,
    bins_ms=(10, 50),
    channels=(1, 3),
    curve_samples=3000,
    threads=(1,),
    held=(5,),
    pieced=3,
    streamed=25,
    streamed_pool=7,
    chunk=10,
)


def bulk_row(way: str, stage: str, rate: float, threads: int = 2) -> dict[str, Any]:
    return {"way": way, "stage": stage, "threads": threads, "bins": 10, "seconds": [10 / rate]}


def measured(limits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [of for of in limits if of["measured"] != "not measured"]


# -------------------------------------------------------------------------------------- limits
@pytest.mark.parametrize(
    ("way", "stage", "rate", "is_ok"),
    [
        ("eager, float32", measure.FILTERED, 25_001.0, True),
        ("eager, float32", measure.FILTERED, 24_999.0, False),
        ("compiled, float32", measure.FILTERED, 60_001.0, True),
        ("compiled, float32", measure.FILTERED, 59_999.0, False),
        (measure.ORT, measure.RAW, 60_001.0, True),
    ],
)
def test_limits_on_bulk(way: str, stage: str, rate: float, is_ok: bool) -> None:
    others = [
        bulk_row(way, stage, 1e9, threads=1),
        bulk_row(way, measure.FEATURES, 1e9),
        bulk_row("reference, float32", stage, 1.0),
    ]
    found = report.limit_rows({"bulk": {"rows": [*others, bulk_row(way, stage, rate)]}})
    (limit,) = measured(found)
    assert limit["ok"] is is_ok
    assert [of["ok"] for of in found if of is not limit] == [None] * 3


def test_the_best_of_compiled_and_onnxruntime_counts() -> None:
    rows = [
        bulk_row("compiled, float32", measure.FILTERED, 70_000.0),
        bulk_row(measure.ORT, measure.RAW, 50_000.0),
    ]
    (limit,) = measured(report.limit_rows({"bulk": {"rows": rows}}))
    assert limit["ok"]
    assert "compiled" in limit["what"]


@pytest.mark.parametrize(("gigabytes", "is_ok"), [(1.49, True), (1.5, False)])
def test_limit_on_streaming_is_on_the_peak(gigabytes: float, is_ok: bool) -> None:
    row = {"bins": 10, "peak_bytes": gigabytes * 1e9, "is_pool": False, "is_finite": not is_ok}
    peak, finite = measured(report.limit_rows({"stream": {"rows": [row]}}))
    assert peak["ok"] is is_ok
    assert finite["ok"] is not is_ok


# ---------------------------------------------------------------------------------------- jobs
def test_streaming_sums_every_bin_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    names = kept_selection()["names"][5:2:-1]
    extractor = worker._extractor(ENGINES[0], names)
    assert [str(name) for name in extractor.names] == names
    whole = extractor.__call__

    class Counting:
        selected = extractor.selected

        def __call__(self, bins: torch.Tensor) -> torch.Tensor:
            return whole(bins)

        def stream(self, batches: Any) -> Any:
            for bins in batches:
                seen.append(len(bins))
                yield self(bins)

    monkeypatch.setattr(worker, "_extractor", lambda engine, names: Counting())
    found = worker.stream(ENGINES[0], 25, 10, names)
    assert (found["bins"], found["is_finite"]) == (25, True)
    assert seen == [10, 10, 5]


def test_a_held_batch_counts_itself_and_its_features() -> None:
    found = worker.hold(ENGINES[0], 3, kept_selection()["names"][:7])
    assert found["own_bytes"] == 3 * 4 * (2400 + 7)
    assert worker.hold(worker.IN_ONE_PIECE, 3, None)["own_bytes"] == 3 * 4 * (2400 + 2582)


@pytest.mark.slow
def test_a_job_in_a_process_of_its_own() -> None:
    names = kept_selection()["names"]
    found = worker.peak(do="hold", engine=ENGINES[0], batch=2000, names=names, threads=1)
    assert found["peak_bytes"] - found["before_bytes"] >= 2000 * 4 * 2400  # the bins at least
    with pytest.raises(WorkerFailedError, match="without an answer"):
        worker.peak(do="nothing", threads=1)


def test_jobs_have_the_names_that_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    timed = timed_detector(1)
    timed = replace(timed, selection=timed.selection | {"names": timed.selection["names"][:3]})
    jobs: list[dict[str, Any]] = []
    monkeypatch.setattr(measure, "peak", lambda **job: jobs.append(job) or {})
    measure.memory(timed, TINY)
    measure.stream(timed, TINY)
    few = timed.selection["names"]
    assert [job["names"] for job in jobs] == [few] * len(ENGINES) + [None, few, None]


# ---------------------------------------------------------------------------------------- hands
@pytest.mark.parametrize(("num", "films"), [(1, 1), (2, 1), (24, 10), (256, 107)])
def test_hands_of_any_size_have_films(num: int, films: int) -> None:
    hand = measure.hand_of(num)
    assert len(hand) == num
    assert len(hand.indices("PVDF")) == films


def test_the_paper_has_as_many_of_each() -> None:
    wanted = pool_of(FLOAT32).hand
    made = measure.hand_of(24)
    for kind in ("SG", "PVDF"):
        assert len(made.indices(kind)) == len(wanted.indices(kind))
    assert len(some_hand("GF")) == len(measure.hand_of(2))


# ----------------------------------------------------------------------------------------- main
@pytest.mark.slow
def test_quick_run_measures_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    path, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    before = torch.get_num_threads()
    assert bench.main(["--quick", "--json", str(path), "--figure", str(drawing)]) == 0
    assert torch.get_num_threads() == before
    made = json.loads(path.read_text())
    assert list(made["sections"]) == list(measure.SECTIONS)
    rows = {name: of["rows"] for name, of in made["sections"].items()}
    assert len(rows["bulk"]) == 3 * 2 * (len(ENGINES) + 1)
    assert [of["bins"] for of in rows["batch"]] == [n for n in TINY.batches for _ in ENGINES]
    short, usual = (of for of in rows["length"] if of["way"] == f"{ENGINES[0]}, {FLOAT32}")
    assert (short["level"], usual["level"]) == (2, 4)
    assert short["features"] < usual["features"] == 2582
    assert [of["films"] for of in rows["channels"]][:: len(ENGINES)] == [1, 1]
    assert [of["bins"] for of in rows["stream"]] == [25, 7]
    assert all(of["is_finite"] for of in rows["stream"])
    assert len(made["limits"]) >= 2
    assert drawing.stat().st_size > 0
    assert report.report_text(made).count("streamed") >= 2


def test_a_missing_detector_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--quick", "--model", str(tmp_path / "none.pt")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_figure_needs_one_of_its_panels(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        bench.main(["--only", "stream", "--figure", "nowhere.png"])
    assert error.value.code == 2
    assert "--figure shows batch" in capsys.readouterr().err
