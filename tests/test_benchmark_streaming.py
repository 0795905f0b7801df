import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import report as whole_report
from benchmarks.detectors import Timed, timed_detector
from benchmarks.engines import ENGINES, FLOAT64
from benchmarks.outcome import QUICK_LINE
from benchmarks.streaming import __main__ as bench
from benchmarks.streaming import figure, measure, report, worker
from benchmarks.streaming.sizes import CHUNK, HOP, QUICK, Sizes
from benchmarks.streaming.ways import Endless, Naive, ours, settings_of, stream_samples

TINY: Sizes = replace(QUICK, rounds=2, stretch_s=0.2, short_s=0.01, chunks=(20, 200), hops=(20,))


@pytest.fixture(scope="module")
def timed() -> Timed:
    return timed_detector(1)


# ----------------------------------------------------------------------------------------- ways
@pytest.mark.parametrize("hop", [10, 20, 50, 100])
def test_the_naive_stream_scores_the_same_bins(timed: Timed, hop: int) -> None:
    """Behind the first, which have no context, in a stretch that has slip."""
    detector = timed.detector(ENGINES[0], FLOAT64)
    samples = stream_samples(1)[3000:6000]
    naive, stream = Naive(detector, settings_of(hop)), ours(detector, hop)
    late = -(-125 // hop)  # hops from a bin's start until its context is there
    scores = torch.cat([naive.push(part).score for part in np.split(samples, len(samples) // hop)])
    expected = stream.push(samples).score
    first = -(-25 // hop)
    found = scores[late - 1 :][first : len(expected)]
    expected = expected[first : first + len(found)]
    assert len(found) > 0.9 * (2900 // hop) - 5
    close = 1e-4 * float(expected.std())
    torch.testing.assert_close(found, expected, rtol=0, atol=close)


def test_an_endless_stream_goes_round() -> None:
    samples = np.arange(10.0)[:, None]
    stream = Endless(samples)
    seen = [stream.next(4)[:, 0].tolist() for _ in range(4)]
    assert seen == [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 2, 3], [4, 5, 6, 7]]


def test_the_stream_is_of_simulated_recordings() -> None:
    samples = stream_samples(1)
    assert samples.dtype == np.float32
    assert samples.flags.c_contiguous
    assert samples.shape[1] == 24
    assert len(samples) > 10_000


# --------------------------------------------------------------------------------------- report
def row(kind: str, engine: str, hop: int, chunk: int, *seconds: float) -> dict[str, Any]:
    """Of rounds of one second of stream each."""
    return {
        "kind": kind,
        "engine": engine,
        "hop": hop,
        "chunk": chunk,
        "pushes": 30,
        "seconds": list(seconds),
        "core_s": [taken / 2 for taken in seconds],
        "stream_s": [1.0] * len(seconds),
        "p50_s": 1e-3,
        "p99_s": 2e-3,
    }


def memory(*mib: float, settled_s: float = 300.0) -> dict[str, Any]:
    """A look every five minutes."""
    return {
        "at_s": [300.0 * place for place in range(len(mib))],
        "resident_bytes": [round(of * 2**20) for of in mib],
        "state_bytes": 20480,
        "seconds": 60.0,
        "decisions": 360_000,
        "engine": "compiled",
        "settled_s": settled_s,
    }


ROWS = [
    row(measure.STREAM, "eager", HOP, CHUNK, 0.01, 0.0125, 0.02),
    row(measure.NAIVE, "eager", HOP, HOP, 0.05, 0.125, 0.12),
    row(measure.STREAM, "eager", HOP, 20, 0.1, 0.1, 0.1),
]


def test_factors_are_of_each_round() -> None:
    assert report.real_time_factor(ROWS[0]) == pytest.approx((80, 65, 90))
    assert report.real_time_factor(ROWS[0], "core_s") == pytest.approx((160, 130, 180))
    assert report.over_naive(ROWS, ROWS[0]) == pytest.approx((6, 5.5, 8))
    assert report.over_naive(ROWS[:1], ROWS[0]) is None


def test_memory_counts_from_where_it_is_settled() -> None:
    found = report.growth(memory(100, 400, 400.5, 401, 401.5))
    assert found == pytest.approx({"mib": 1.5, "mib_an_hour": 6.0})
    assert report.growth(memory(100, 400)) is None
    assert report.growth(memory()) is None


@pytest.mark.parametrize(
    ("seconds", "mib", "is_ok"),
    [(0.0199, (300, 400, 400.9), [True, True]), (0.0201, (300, 400, 401.1), [False, False])],
)
def test_limits(seconds: float, mib: tuple[float, ...], is_ok: list[bool]) -> None:
    rows = [row(measure.STREAM, "eager", HOP, CHUNK, seconds)]
    found = report.limit_rows({"speed": {"rows": rows}, "memory": memory(*mib)})
    assert [of["ok"] for of in found if of["limit"] != "-"] == is_ok
    assert "hop 10 ms, pushes of 100 ms" in found[0]["what"]
    assert "over 0.167 h" in found[2]["what"]
    nothing = report.limit_rows({"speed": {"rows": []}, "memory": memory()})
    assert [of["ok"] for of in nothing] == [None, None]


def made(**changes: Any) -> dict[str, Any]:
    sections = {"speed": {"rows": ROWS}, "memory": memory(300, 400, 400.25)}
    return {
        "quick": False,
        "machine": {"processor": "abacus"},
        "versions": {"torch": "2.13.0"},
        "selection": {"names": ["a"], "trained": {"experiment": "unseen4"}},
        "sections": sections,
        "limits": report.limit_rows(sections),
    } | changes


def test_tables_show_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "source_text", lambda _: "120 features")
    text = report.report_text(made())
    assert "80 (65 to 90)" in text
    assert "6 (5.5 to 8)" in text
    assert "360,000" in text
    page = whole_report.markdown({"streaming": made()}, "results")
    assert "## Streams" in page
    assert "| eager | 10 | 200 | 80 (65 to 90) | 1,000 | 2,000 | 30 | 6 (5.5 to 8) |" in page
    assert "| stream, compiled | 300 | 400 | 400.2 | 20 | 360,000 |" in page
    assert "![Streams](results/streaming.png)" in page


def test_the_figure_can_do_without_memory(tmp_path: Path) -> None:
    for at, section in enumerate((memory(), memory(300, 400))):
        path = tmp_path / f"{at}.png"
        figure.figure(made(sections={"speed": {"rows": ROWS}, "memory": section}), path)
        assert path.stat().st_size > 0


# ---------------------------------------------------------------------------------- measurements
def test_a_watched_stream_tells_its_memory(timed: Timed, monkeypatch: pytest.MonkeyPatch) -> None:
    job = {"engine": "eager", "hop": 20, "chunk": 200, "streamed": 1}
    names = timed.selection["names"]
    looks = iter(range(1000, 2000))
    monkeypatch.setattr(worker, "resident_bytes", lambda: next(looks))
    found = worker.watch(names, **job, watched_s=1.0, sample_s=0.2)
    assert found["at_s"] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert found["resident_bytes"] == [1000, 1001, 1002, 1003, 1004, 1005]
    assert found["decisions"] == (2200 - 105) // 20 + 1  # films alone: 5 samples ahead
    assert 24 * 8 * 11 <= found["state_bytes"] < 100_000
    monkeypatch.setattr(worker, "resident_bytes", lambda: None)
    assert worker.watch(names, **job, watched_s=0.2, sample_s=0.1)["at_s"] == []


def test_quick_run_measures_every_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    jobs: list[dict[str, Any]] = []

    def watched(**job: Any) -> dict[str, Any]:
        jobs.append(job)
        return memory(300, 400, 400)

    monkeypatch.setattr(measure, "watched", watched)
    path, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    assert bench.main(["--quick", "--json", str(path), "--figure", str(drawing)]) == 0
    found = json.loads(path.read_text())
    assert found["quick"] is found["simulated"] is True
    rows = found["sections"]["speed"]["rows"]
    ways = {(of["kind"], of["engine"], of["hop"], of["chunk"]) for of in rows}
    wanted = {("stream", engine, 20, chunk) for engine in ENGINES for chunk in (20, 200)}
    assert ways == wanted | {("naive", engine, 20, 20) for engine in ENGINES}
    for of in rows:
        assert of["stream_s"] == [pytest.approx(0.2)] * 2
        assert 0 < of["p50_s"] <= of["p99_s"] <= max(of["seconds"])
    assert (jobs[0]["hop"], jobs[0]["chunk"], len(jobs[0]["names"])) == (20, 200, 120)
    shown = capsys.readouterr().out
    assert QUICK_LINE in shown
    assert report.report_text(found) in shown
    assert drawing.stat().st_size > 0


def test_a_missing_detector_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--quick", "--model", str(tmp_path / "none.pt")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
def test_a_worker_that_fails_is_told(timed: Timed) -> None:
    with pytest.raises(worker.WorkerFailedError, match="ended without an answer"):
        worker.watched(names=["none"], engine="eager")
