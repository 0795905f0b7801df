import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.kernel_ridge import KernelRidge

from benchmarks import clocks, outcome
from benchmarks.model import __main__ as bench
from benchmarks.model import measure, worker
from benchmarks.model import report as reports
from benchmarks.model.sizes import QUICK, Sizes
from benchmarks.model.synthetic import SyntheticBins, num_batches
from tactslip_torch.model.fit import TrainingBins

SETTINGS = {"num_features": 120, "penalty": 0.1, "offset": 0.5, "repeats": 3}
TINY = replace(
    QUICK,
    num_features=5,
    repeats=1,
    rounds=2,
    latency_bins=(30, 60),
    latency_batch=8,
    svc_bins=60,
    update_bins=(20,),
    fit_bins=60,
    test_bins=40,
    fold_bins=(18, 60),
    any_bins=90,
    any_batch=40,
    worker_bins=90,
    worker_batch=20,
    processes=(1, 2),
    shards=3,
)


def sections(**changes: Any) -> dict[str, Any]:
    """Measurements that meet every limit."""
    same = {"statistics": True, "detector": True}
    found: dict[str, Any] = {
        "size": {
            "rows": [
                size_row(1_000, head_s=1.00e-5, sum_s=4e-5),
                size_row(100_000, head_s=1.05e-5, sum_s=42e-5),
            ],
            "svc": {"training_bins": 8_000, "support": 6_000, "seconds": {"1": 42e-5, "256": 0.1}},
        },
        "accumulation": {
            "rows": [{"batch_bins": 243, "update_s": [0.5], "dsyrk_s": [0.4], "gemm_s": [0.7]}]
        },
        "fit": {
            "num_bins": 8_000,
            "test_bins": 4_000,
            "rows": [
                {"name": "fit_machine", "seconds": [4.0], "accuracy": 0.75, "difference": 1e-12},
                {"name": "KernelRidge", "seconds": [16.0], "accuracy": 0.75, "difference": 0.0},
                {"name": "SVC", "seconds": [2.0], "accuracy": 0.5, "difference": None},
            ],
        },
        "folds": {
            "num_folds": 6,
            "rows": [
                {
                    "num_bins": 6_000,
                    "difference": 1e-12,
                    "fit_s": [2.0],
                    "closed_s": [4.0],
                    "refits_s": [8.0],
                }
            ],
        },
        "any_size": {
            "num_bins": 20_000,
            "generate_s": 1.0,
            "accumulate_s": 9.0,
            "solve_s": 3.0,
            "peak_bytes": 900_000_000,
            "resident_bytes": 300_000_000,
            "accuracy": 0.9,
        },
        "workers": {
            "num_bins": 20_000,
            "batch_bins": 243,
            "rows": [worker_row(1, 1, same), worker_row(4, 7, same)],
        },
    }
    for path, value in changes.items():
        *parents, last = path.split("__")
        inner: Any = found
        for key in parents:
            inner = inner[int(key)] if isinstance(inner, list) else inner[key]
        inner[last] = value
    return found


def size_row(training_bins: int, head_s: float, sum_s: float) -> dict[str, Any]:
    return {
        "training_bins": training_bins,
        "head_s": {"1": head_s, "256": 10 * head_s},
        "sum_s": {"1": sum_s, "256": 100 * sum_s},
        "head_bytes": 58_084,
        "sum_bytes": 484 * training_bins,
    }


def worker_row(processes: int, shards: int, same: dict[str, bool]) -> dict[str, Any]:
    row = {"processes": processes, "shards": shards, "collect_s": 2.5, "merge_s": 0.5}
    return row | {"identical": same}


def report_of(measured: dict[str, Any], *, quick: bool = False) -> dict[str, Any]:
    return {
        "quick": quick,
        "machine": {"processor": "abacus"},
        "threads": 2,
        "versions": {"torch": "2.13.0"},
        "settings": SETTINGS,
        "sections": measured,
        "ratios": reports.ratios(measured),
        "limits": reports.limit_rows(measured, SETTINGS),
    }


# ------------------------------------------------------------------------------------- numbers
def test_ratios_compare_what_was_measured_together() -> None:
    of = reports.ratios(sections())
    assert of["latency_spread"]["1"] == pytest.approx(1.05)
    assert of["svc_over_head"]["1"] == pytest.approx(40)  # of the slowest head
    assert of["sum_over_head"]["256"] == pytest.approx(400)  # of the largest sum
    assert of["update"]["243"] == pytest.approx({"of_dsyrk": 0.8, "of_gemm": 1.4})
    assert of["over_kernel_ridge"] == {"fit_machine": 0.25, "KernelRidge": 1.0, "SVC": 0.125}
    assert of["folds"]["6000"] == {"over_fit": 2.0, "over_refits": 0.4}


def test_ratios_are_taken_within_each_repeat() -> None:
    busy = {  # the machine was three times slower in the second repeat, and the last call slowest
        "folds__rows__0__fit_s": [1.0, 3.0, 1.0],
        "folds__rows__0__closed_s": [2.0, 6.6, 9.0],
        "folds__rows__0__refits_s": [5.0, 17.0, 5.0],
    }
    of = reports.ratios(sections(**busy))["folds"]["6000"]
    assert of["over_fit"] == pytest.approx(2.2)
    assert of["over_refits"] == pytest.approx(1 / 3)


def test_every_limit_can_be_met() -> None:
    rows = reports.limit_rows(sections(), SETTINGS)
    assert [row["what"] for row in rows if not row["ok"]] == []
    assert len(rows) == 12


@pytest.mark.parametrize(
    ("what", "path", "value"),
    [
        ("head of 120 features", "size__rows__0__head_bytes", 60_000),
        ("latency over training bins, most / least, one", "size__rows__1__head_s__1", 1.101e-5),
        ("latency over training bins, most / least, 256", "size__rows__0__head_s__256", 0.94e-4),
        ("latency, SVC / head", "size__svc__seconds__1", 20 * 1.05e-5),
        ("seconds, fit_machine / KernelRidge", "fit__rows__0__seconds", [16.1]),
        ("scores of fit_machine - KernelRidge", "fit__rows__0__difference", 1e-7),
        ("fit and folds / fit, 6000", "folds__rows__0__fit_s", [1.6]),
        ("fit and folds / refits, 6000", "folds__rows__0__refits_s", [6.0]),
        ("scores of folds - refits, 6000", "folds__rows__0__difference", 1e-7),
        ("peak memory, 20000", "any_size__peak_bytes", 1_500_000_000),
        ("runs of workers", "workers__rows__1__identical", {"statistics": True, "detector": False}),
    ],
)
def test_limit_is_missed_when_passed(what: str, path: str, value: object) -> None:
    rows = reports.limit_rows(sections(**{path: value}), SETTINGS)
    (missed,) = [row["what"] for row in rows if not row["ok"]]
    assert missed.startswith(what)


@pytest.mark.parametrize(
    ("update_s", "gemm_s", "is_ok"),
    [(0.4 / 0.61, 0.1, True), (0.4 / 0.59, 0.1, False), (1.0, 0.91, True), (1.0, 0.89, False)],
)
def test_accumulation_may_meet_either_limit(update_s: float, gemm_s: float, is_ok: bool) -> None:
    taken = {"update": update_s, "gemm": gemm_s}
    changes = {f"accumulation__rows__0__{name}_s": [value] for name, value in taken.items()}
    rows = reports.limit_rows(sections(**changes), SETTINGS)
    (row,) = [row for row in rows if row["what"].startswith("accumulation")]
    assert row["ok"] is is_ok


def test_only_what_was_measured_has_limits_and_tables() -> None:
    part = {"any_size": sections()["any_size"]}
    assert reports.ratios(part) == {}
    (row,) = reports.limit_rows(part, SETTINGS)
    assert row["measured"] == "0.90 GB"
    assert "KernelRidge" not in reports.report_text(report_of(part))


# -------------------------------------------------------------------------------------- tables
def lines_of(text: str, first_word: str) -> list[list[str]]:
    part = next(part for part in text.split("\n\n") if part.startswith(first_word))
    return [line.split() for line in part.splitlines()]


def test_tables_show_the_measurements() -> None:
    text = reports.report_text(report_of(sections()))
    assert lines_of(text, "size")[1] == ["head", "1000", "58.1", "10.0", "us", "100.0", "us"]
    assert lines_of(text, "size")[4][-4:] == ["420.0", "us", "42.00", "ms"]
    assert lines_of(text, "accumulation")[1][3:] == ["2.058", "1.646", "2.881", "0.80", "1.40"]
    assert lines_of(text, "fit of 8000")[1] == ["fit_machine", "4.00", "0.250", "75.00", "1.0e-12"]
    assert lines_of(text, "6 folds")[1][2:] == ["2.00", "4.00", "8.00", "2.00", "0.40", "1.0e-12"]
    assert lines_of(text, "any size")[1][2:] == ["1.00", "9.00", "3.00", "0.90", "0.30", "90.00"]
    assert lines_of(text, "processes")[2] == ["4", "7", "2.50", "0.50", *["same", "bits"] * 2]
    assert reports.SYNTHETIC_LINE in text
    assert "MISSED" not in text
    assert "QUICK" not in text


def test_tables_name_what_is_missed() -> None:
    other = {"statistics": False, "detector": True}
    measured = sections(any_size__peak_bytes=2_000_000_000, workers__rows__1__identical=other)
    text = reports.report_text(report_of(measured, quick=True))
    missed = [line for line in text.splitlines() if line.endswith("MISSED")]
    assert [line.split()[0] for line in missed] == ["peak", "runs"]
    assert "OTHER BITS" in text
    assert text.count(reports.QUICK_LINE) == 2


# ---------------------------------------------------------------------------------------- data
@given(
    num_bins=st.integers(1, 60),
    batch_bins=st.integers(1, 25),
    parts=st.integers(1, 9),
    data=st.data(),
)
def test_any_sharding_makes_the_same_bins(
    num_bins: int, batch_bins: int, parts: int, data: st.DataObject
) -> None:
    whole = {batch.name: batch for batch in SyntheticBins(4, 1).batches(num_bins, batch_bins)}
    order = data.draw(st.permutations(range(parts)))
    shards = [list(SyntheticBins(4, 1).batches(num_bins, batch_bins, k, parts)) for k in order]
    found = {batch.name: batch for shard in shards for batch in shard}
    assert sum(map(len, shards)) == len(found) == num_batches(num_bins, batch_bins)
    assert found.keys() == whole.keys()
    assert sum(len(batch.z) for batch in whole.values()) == num_bins
    for name, batch in found.items():
        assert torch.equal(batch.z, whole[name].z)
        assert torch.equal(batch.is_slip, whole[name].is_slip)


def test_batches_differ_and_so_do_seeds_and_held_out_bins() -> None:
    source = SyntheticBins(4)
    first, *rest = (batch.z for batch in source.batches(60, 20))
    others = [*rest, source.held_out(20)[0], next(SyntheticBins(4, 1).batches(40, 20)).z]
    for other in others:
        assert not torch.isclose(first, other).any()


def test_bins_are_bounded_correlated_and_of_both_classes() -> None:
    z, is_slip = SyntheticBins(12).training(4_000)
    assert z.dtype == torch.float64
    assert is_slip.dtype == torch.bool
    assert z.abs().max() <= 1
    assert 0.4 < is_slip.double().mean() < 0.6
    correlations = torch.corrcoef(z.mT) - torch.eye(12)
    assert correlations.abs().max() > 0.3


def test_labels_follow_a_rule_that_is_not_linear() -> None:
    z, is_slip = SyntheticBins(6).training(600)
    signs = np.where(is_slip.numpy(), 1.0, -1.0)
    accuracy = []
    for degree in (1, 2):
        ridge = KernelRidge(alpha=1.0, kernel="poly", degree=degree, gamma=1, coef0=0.5)
        ridge.fit(z[:400].numpy(), signs[:400])
        accuracy.append(np.mean(np.sign(ridge.predict(z[400:].numpy())) == signs[400:]))
    assert 0.97 > accuracy[1] > accuracy[0] + 0.05  # noise keeps it from 1


# ------------------------------------------------------------------------------------- clocks
class Clock:
    """Time that passes only when told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.calls: list[str] = []
        monkeypatch.setattr(clocks.time, "perf_counter", lambda: self.now)

    def takes(self, name: str, *seconds: float) -> Callable[[], str]:
        left = list(seconds)

        def call() -> str:
            self.calls.append(name)
            self.now += left.pop(0) if len(left) > 1 else left[0]
            return f"{name} {self.now:g}"

        return call


def test_long_calls_take_turns_and_all_their_seconds_come_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    calls = {"a": clock.takes("a", 1.0, 9.0, 2.0), "b": clock.takes("b", 5.0)}
    found = clocks.in_turns(calls, 3, "test")
    assert clock.calls == ["a", "b"] * 3
    assert found == {"a": ([1.0, 9.0, 2.0], "a 22"), "b": ([5.0] * 3, "b 27")}


def test_short_calls_are_timed_in_blocks_that_leave_the_first_call_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    calls = {"a": clock.takes("a", 5e-4), "b": clock.takes("b", *[0.25] * 5, 9.0, 0.25)}
    found = clocks.in_shuffled_turns(calls, 5, seed=0)
    assert found == pytest.approx({"a": 5e-4, "b": 0.25})
    assert clock.calls.count("b") == 4 + 5 * (1 + 1)  # one call lasts longer than a block
    assert clock.calls.count("a") == 4 + 5 * (1 + 4)


# ------------------------------------------------------------------------------- measurements
def test_bare_dsyrk_adds_one_triangle_in_place(rng: np.random.Generator) -> None:
    rows = torch.from_numpy(rng.normal(size=(7, 4)))
    total = torch.zeros(4, 4, dtype=torch.float64)
    for _ in range(2):
        measure._dsyrk(rows, total)
    wanted = 2 * rows.numpy().T @ rows.numpy()
    np.testing.assert_allclose(total.tril(), np.tril(wanted))
    np.testing.assert_array_equal(total.triu(1), 0)


def test_refits_are_those_of_kernel_ridge_without_each_group() -> None:
    z, is_slip = SyntheticBins(3).training(40)
    groups = torch.arange(40) % 4
    found = measure._refits(TrainingBins(z, is_slip), groups, Sizes(num_features=3))
    signs = np.where(is_slip.numpy(), 1.0, -1.0)
    for group in range(4):
        own = (groups == group).numpy()
        ridge = KernelRidge(alpha=10.0, kernel="poly", degree=2, gamma=1, coef0=0.5)
        ridge.fit(z.numpy()[~own], signs[~own])
        np.testing.assert_allclose(found.numpy()[own], ridge.predict(z.numpy()[own]), atol=1e-9)


def test_folds_refit_once_for_every_group(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    true_fit = measure.fit_machine

    def fit(bins: TrainingBins, *others: Any) -> Any:
        sizes.append(len(bins.features))
        return true_fit(bins, *others)

    monkeypatch.setattr(measure, "fit_machine", fit)
    found = measure.folds(replace(TINY, fold_bins=(17,), num_folds=3))
    assert sizes == [17, 11, 11, 12]
    assert found["num_folds"] == 3


def test_job_of_any_size_scores_as_kernel_ridge_on_all_bins_at_once() -> None:
    job = {"num_bins": 90, "batch_bins": 40, "penalty": 0.1, "offset": 0.5, "test_bins": 50}
    answer = worker.any_size({"num_features": 4, "seed": 2}, **job)
    source = SyntheticBins(4, 2)
    batches = list(source.batches(90, 40))
    z, is_slip = (np.concatenate([batch[i].numpy() for batch in batches]) for i in (1, 2))
    ridge = KernelRidge(alpha=10.0, kernel="poly", degree=2, gamma=1, coef0=0.5)
    ridge.fit(z, np.where(is_slip, 1.0, -1.0))
    test_z, test_is_slip = (of.numpy() for of in source.held_out(50))
    assert answer["accuracy"] == np.mean((ridge.predict(test_z) >= 0) == test_is_slip)
    assert answer["num_bins"] == 90
    assert answer["peak_bytes"] <= worker.peak_bytes()


def test_peak_memory_remembers_what_is_gone() -> None:
    room = worker.peak_bytes() // 8  # float64 of as much as ever was: must raise the peak
    before = worker.peak_bytes()
    held = np.ones(room)
    del held
    assert worker.peak_bytes() > before


def test_worker_that_fails_is_no_answer(capfd: pytest.CaptureFixture[str]) -> None:
    before = threading.active_count()
    with worker.Worker() as one:
        one.start("dance")
        with pytest.raises(worker.WorkerFailedError, match="ended without an answer"):
            one.answer()
    assert "KeyError: 'dance'" in capfd.readouterr().err
    assert threading.active_count() == before


# ---------------------------------------------------------------------------------------- main
def test_quick_run_measures_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    paths = [tmp_path / "numbers.json", tmp_path / "figure.png"]
    arguments = ["--quick", "--json", str(paths[0]), "--figure", str(paths[1])]
    before = torch.get_num_threads()
    assert bench.main([*arguments, "--bins", "70"]) == 0
    assert torch.get_num_threads() == before
    report = json.loads(paths[0].read_text())
    assert list(report["sections"]) == list(measure.SECTIONS)
    assert report["quick"] is report["synthetic"] is True
    assert report["sections"]["any_size"]["num_bins"] == 70
    assert report["settings"]["num_features"] == 5
    for row in report["sections"]["fit"]["rows"]:
        assert row["difference"] is None or row["difference"] < 1e-9
    assert all(row["difference"] < 1e-9 for row in report["sections"]["folds"]["rows"])
    runs = report["sections"]["workers"]["rows"]
    assert [(run["processes"], run["shards"]) for run in runs] == [(1, 1), (2, 2), (2, 3)]
    assert all(same for run in runs for same in run["identical"].values())
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    shown = capsys.readouterr()
    assert reports.QUICK_LINE in shown.out
    assert "accumulation of 20, 1 of" in shown.err


def test_runs_in_part_or_in_brief_leave_the_results_alone() -> None:
    assert bench._arguments([]).json == outcome.RESULTS / "model.json"
    assert bench._arguments([]).figure == outcome.RESULTS / "model.png"
    for arguments in (["--quick"], ["--only", "size"]):
        parsed = bench._arguments(arguments)
        assert parsed.json is parsed.figure is None


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--bins", "0"], "--bins must be at least 1, got 0"),
        (["--repeat", "-1"], "--repeat must be at least 1, got -1"),
        (["--only", "weather"], "invalid choice: 'weather'"),
        (["--json", "."], "--json needs a file, . is a folder"),
        (["--only", "workers", "--figure", "f.png"], "--figure shows size, accumulation"),
    ],
)
def test_bad_arguments_are_named(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as error:
        bench.main(arguments)
    assert error.value.code == 2
    assert complaint in capsys.readouterr().err
