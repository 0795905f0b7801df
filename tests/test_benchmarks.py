import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import train as bench
from tactslip_torch.report.tables import SIMULATED_LINE

TIMING_S = {"survey_pass": 4.0, "training_pass": 1.0, "solve": 0.5, "test_pass": 3.0, "total": 9}
COLD_WORKER_S = {"simulate": 6.0, "features": 2.0, "read_cache": 0.5}
MACHINE = {"processor": "abacus", "cores": "2 of 4 cores"}
SECONDS = st.dictionaries(
    st.sampled_from(["a", "b", "c", "d"]), st.floats(1e-3, 1e4), min_size=1, max_size=4
)


def training_run(kind: str, wall_s: float = 12.0, **changes: Any) -> bench.TrainingRun:
    metrics = {
        "simulated": True,
        "versions": {"torch": "2.13.0", "tactslip_torch": "0.1.0"},
        "splits": {"train": {"num_bins": 600}, "unseen": {"num_bins": 200}},
        "timing_s": dict(TIMING_S),
        "worker_s": COLD_WORKER_S if kind == "cold" else {"read_cache": 0.25},
    }
    return bench.TrainingRun(kind, wall_s, 2_500_000_000, "pss", metrics | changes, 8)


def report_of(cold_s: Sequence[float], warm_s: Sequence[float], **changes: Any) -> dict[str, Any]:
    runs = []
    for cold, warm in zip(cold_s, warm_s, strict=True):
        runs += [training_run("cold", cold, **changes), training_run("warm", warm, **changes)]
    return bench.summary("unseen4", runs, MACHINE)


# ------------------------------------------------------------------------------------- numbers
def test_stages_add_up_to_the_process() -> None:
    stages = bench.stage_seconds(12.0, TIMING_S)
    assert sum(stages.values()) == pytest.approx(12.0)
    assert stages["start-up"] == pytest.approx(3.0)
    assert stages["other"] == pytest.approx(0.5)
    assert next(iter(stages)) == "start-up"
    assert "total" not in stages


@given(repeats=st.lists(SECONDS, min_size=1, max_size=4))
def test_shares_sum_to_100(repeats: list[dict[str, float]]) -> None:
    sides = bench.with_shares(repeats)
    assert set(sides) == {name for seconds in repeats for name in seconds}
    if any(side["median"] for side in sides.values()):
        assert sum(side["share_percent"] for side in sides.values()) == pytest.approx(100)


def test_shares_of_no_time_are_zero() -> None:
    assert bench.with_shares([{"a": 0.0}])["a"]["share_percent"] == 0


def test_median_and_spread_over_repeats() -> None:
    side = bench.with_shares([{"a": 9.0, "b": 1.0}, {"a": 2.0, "b": 1.0}, {"a": 3.0, "b": 1.0}])
    assert side["a"] == {"median": 3.0, "min": 2.0, "max": 9.0, "share_percent": 75.0}


def test_stage_that_a_repeat_lacks_took_no_time_in_it() -> None:
    assert bench.with_shares([{"a": 1.0}, {"a": 1.0, "b": 4.0}])["b"]["median"] == 2.0


def test_side_that_lacks_a_stage_is_none() -> None:
    rows = bench.stage_rows([{"simulate": 3.0, "read_cache": 1.0}], [{"read_cache": 2.0}])
    assert [row["stage"] for row in rows] == ["simulate", "read_cache"]
    assert rows[0]["warm"] is None
    assert rows[0]["cold"]["share_percent"] == 75.0
    assert rows[1]["warm"]["median"] == 2.0


def test_throughput_counts_the_set_once_over_all_passes() -> None:
    assert bench.rates(training_run("cold")) == {"bins/s": 100.0, "recordings/s": 1.0}


def test_throughput_without_a_pass_is_left_out() -> None:
    assert bench.rates(training_run("cold", timing_s={"total": 1.0})) == {}


def test_bins_of_folds_are_those_of_one() -> None:
    fold = {"splits": {"train": {"num_bins": 5}, "unseen": {"num_bins": 2}}}
    metrics = {"splits": {"train": {"num_bins": 10}}, "folds": {"M1": fold, "M2": fold}}
    assert bench.num_bins(metrics) == 7


@pytest.mark.parametrize(("cold_s", "is_ok"), [([299.9], True), ([300], False), ([9, 301], False)])
def test_limit_holds_if_the_worst_repeat_stays_below(cold_s: list[float], is_ok: bool) -> None:
    rows = report_of(cold_s, [50.0] * len(cold_s))["limits"]
    assert [(row["run"], row["quantity"]) for row in rows] == [
        ("cold", "wall_s"),
        ("cold", "peak_memory_gb"),
        ("warm", "wall_s"),
    ]
    assert [row["ok"] for row in rows] == [is_ok, True, True]
    assert rows[0]["measured"] == max(cold_s)


def test_summary_is_whole() -> None:
    report = report_of([10.0, 20.0, 30.0], [5.0, 5.0, 8.0])
    assert report["repeats"] == 3
    assert report["warm_over_cold"] == 0.25
    assert report["wholes"]["cold"]["peak_memory_gb"]["median"] == 2.5
    assert report["wholes"]["cold"]["worker_s"]["median"] == 8.5
    for kind in bench.KINDS:
        for rows in (report["stages"], report["worker_stages"]):
            shares = [row[kind]["share_percent"] for row in rows if row[kind]]
            assert sum(shares) == pytest.approx(100)
    assert json.loads(json.dumps(report, allow_nan=False)) == report


# -------------------------------------------------------------------------------------- tables
def block(text: str, first_word: str) -> list[str]:
    """The lines of the part that starts with a word."""
    return next(part for part in text.split("\n\n") if part.startswith(first_word)).splitlines()


def test_stage_table_shows_seconds_shares_and_memory() -> None:
    lines = block(bench.report_text(report_of([12.0], [10.0])), "stage")
    assert lines[0].split() == ["stage", "cold", "s", "share", "%", "warm", "s", "share", "%"]
    assert lines[1].split() == ["start-up", "3.00", "25.0", "1.00", "10.0"]
    assert set(lines[-4]) == {"-"}
    assert lines[-3].split() == ["process", "total", "12.00", "100.0", "10.00", "100.0"]
    assert lines[-2].split() == ["peak", "memory,", "GB", "2.50", "2.50"]
    assert lines[-1].startswith("memory: PSS")
    assert len({len(line) for line in lines[:-2]}) == 1  # columns end together


def test_stage_table_of_repeats_shows_medians_and_ranges() -> None:
    text = bench.report_text(report_of([12.0, 10.0, 11.0], [9.5, 9.5, 10.0]))
    assert "medians of 3 repeats" in text
    total = next(line for line in text.splitlines() if line.startswith("process total"))
    assert total.split()[2:] == ["11.00", "10.00-12.00", "100.0", "9.50", "9.50-10.00", "100.0"]


def test_worker_table_marks_what_a_warm_run_need_not_do() -> None:
    lines = block(bench.report_text(report_of([12.0], [10.0])), "in workers")
    assert lines[1].split() == ["simulate", "6.00", "70.6", "-", "-"]
    assert lines[-2].split() == ["all", "workers", "8.50", "100.0", "0.25", "100.0"]


def test_warm_run_that_simulates_is_named() -> None:
    assert "NOT WARM" not in bench.report_text(report_of([12.0], [10.0]))
    assert "NOT WARM" in bench.report_text(report_of([12.0], [10.0], worker_s=COLD_WORKER_S))


def test_limits_stand_beside_what_was_measured() -> None:
    lines = block(bench.report_text(report_of([400.0], [10.0])), "set for")
    assert lines[1].split() == ["cold", "process", "total", "400.0", "s", "300.0", "s", "MISSED"]
    assert lines[2].split() == ["cold", "peak", "memory", "2.5", "GB", "6.0", "GB", "ok"]


def test_experiment_without_limits_says_so() -> None:
    runs = [training_run("cold"), training_run("warm")]
    text = bench.report_text(bench.summary("seen6", runs, MACHINE))
    assert "no limits are set for +exp=seen6" in text


@pytest.mark.parametrize("is_simulated", [True, False])
def test_simulated_data_is_named_where_it_is(is_simulated: bool) -> None:
    text = bench.report_text(report_of([12.0], [10.0], simulated=is_simulated))
    assert (SIMULATED_LINE in text) == is_simulated
    assert "machine   abacus, 2 of 4 cores" in text
    assert "torch 2.13.0" in text


# ---------------------------------------------------------------------------------------- runs
def test_last_lines_hold_the_end_and_one_state_of_a_bar(tmp_path: Path) -> None:
    path = tmp_path / "err"
    path.write_bytes(b"first\n" * 99 + b"\rbar 1%\rbar 100%\n\nerror: no\r\n")
    lines = bench.last_lines(path).splitlines()
    assert len(lines) == bench.TAIL_LINES
    assert lines[-3:] == ["first", "bar 100%", "error: no"]


def in_child(code: str) -> str:
    return f"import subprocess, sys; subprocess.run([sys.executable, '-c', {code!r}])"


def test_memory_counts_children_and_nothing_of_the_dead() -> None:
    pytest.importorskip("psutil")
    hold = "x = bytearray(b'x' * 40_000_000); print(len(x), flush=True); input()"
    parent = in_child(in_child(hold))
    with subprocess.Popen(
        [sys.executable, "-c", parent], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()  # the innermost holds its memory now
        held, measure = bench.tree_memory(process.pid)
        process.communicate(b"\n")
    assert 40_000_000 < held < 200_000_000
    assert measure in bench.MEMORY_NAMES
    assert bench.tree_memory(process.pid)[0] == 0


def test_without_psutil_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "psutil", None)
    assert bench.main(["--quick"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeat", "0"], "--repeat must be at least 1, got 0"),
        (["--quick", "--exp", "seen6"], "not allowed with"),
        (["--json", "."], "--json needs a file"),
    ],
)
def test_bad_arguments_are_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        bench.main(arguments)
    assert refused.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_failing_run_shows_what_it_wrote_last(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("psutil")
    assert bench.main(["--exp", "nope"]) == 1
    shown = capsys.readouterr()
    assert "run 1 of 2, cold failed with exit status 2" in shown.err
    assert "unknown exp nope; known:" in shown.err
    assert shown.out == ""


@pytest.mark.slow
def test_quick_benchmark_writes_its_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("psutil")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "numbers" / "quick.json"
    assert bench.main(["--quick", "--json", str(path)]) == 0
    shown = capsys.readouterr().out
    report = json.loads(path.read_text())
    assert bench.report_text(report) in shown
    assert SIMULATED_LINE in shown
    assert "NOT WARM" not in shown
    assert report["num_recordings"] == 8  # conf/exp/quick.yaml: 4 materials, 2 cycles
    assert 0.1 < report["wholes"]["cold"]["peak_memory_gb"]["max"] < 6
    for kind in bench.KINDS:
        assert_complete(report["stages"], kind, report["wholes"][kind]["wall_s"]["median"])
    assert {row["stage"] for row in report["worker_stages"] if row["warm"]} == {"read_cache"}
    assert [entry.name for entry in tmp_path.iterdir()] == ["numbers"]


def assert_complete(rows: Sequence[Mapping[str, Any]], kind: str, wall_s: float) -> None:
    """Every second of the process is some stage's, and none is counted twice."""
    seconds = {row["stage"]: row[kind]["median"] for row in rows}
    assert {"start-up", "survey_pass", "solve", "test_pass", "other"} <= set(seconds)
    assert sum(seconds.values()) == pytest.approx(wall_s)
    assert min(seconds.values()) >= 0
