import json
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics import balanced_accuracy_score

from benchmarks import outcome
from benchmarks.arithmetic import FLOAT64, NATIVE, WIDE
from benchmarks.precision import __main__ as bench
from benchmarks.precision import measure, report
from benchmarks.precision.data import ROLES, Experiment, load_experiment
from benchmarks.precision.figure import figure
from benchmarks.precision.sizes import QUICK, Sizes

TINY = replace(QUICK, every=12, timed_bins=2, scored_bins=8, rounds=3)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment(TINY)


@pytest.fixture(scope="module")
def measured(experiment: Experiment) -> dict[str, Any]:
    return measure.measure_variants(experiment, TINY)


def by_name(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in rows}


# --------------------------------------------------------------------------------------- data
def test_bins_come_in_every_precision_and_role(experiment: Experiment) -> None:
    assert set(experiment.train.features) == {FLOAT64, NATIVE}
    for role in ROLES:
        part = experiment.judged[role]
        exact = part.features[FLOAT64]
        assert exact.shape == (len(part.is_slip), 2582)
        assert 0 < part.is_slip.sum() < len(part.is_slip)
        assert part.features[WIDE].dtype == torch.float64  # as the detector takes them
        assert part.features[NATIVE].dtype == torch.float32
        worst = {
            name: (part.features[name] - exact).abs() / exact.abs().median(0).values.clamp(min=1e-9)
            for name in (WIDE, NATIVE)
        }
        assert 0 < worst[WIDE].median() < worst[NATIVE].median() < 1e-3
    assert experiment.facts["simulated"] is True
    assert experiment.facts["num_bins"]["train"] == len(experiment.train.is_slip)


def test_what_is_judged_was_not_trained_on(experiment: Experiment) -> None:
    seen = {tuple(row) for row in experiment.train.features[FLOAT64][:, :50].tolist()}
    judged = experiment.all_judged(FLOAT64)[:, :50].tolist()
    assert not seen & {tuple(row) for row in judged}


# ------------------------------------------------------------------------------------- scores
def test_the_reference_is_kernel_ridge_of_scikit_learn(experiment: Experiment) -> None:
    plan = experiment.plan
    ridge = KernelRidge(
        alpha=1 / plan.penalty, kernel="poly", degree=2, gamma=1, coef0=plan.kernel.offset
    )
    z = plan.frame(experiment.train.features[FLOAT64]).numpy()
    targets = np.where(experiment.train.is_slip.numpy(), 1.0, -1.0)
    ridge.fit(z, targets, sample_weight=experiment.weights.numpy())
    test = plan.frame(experiment.all_judged(FLOAT64)).numpy()
    fitted = measure.SOLVES[FLOAT64](experiment)
    scores = measure.judge(experiment, FLOAT64, fitted, torch.float64)
    np.testing.assert_allclose(scores, ridge.predict(test), atol=1e-9)
    accuracy = measure.accuracy(experiment, scores)
    truth = torch.cat([experiment.judged[role].is_slip for role in ROLES]).numpy()
    start = 0
    for role in ROLES:
        mine = slice(start, start := start + len(experiment.judged[role].is_slip))
        wanted = balanced_accuracy_score(truth[mine], ridge.predict(test)[mine] >= 0)
        assert accuracy[role] == pytest.approx(wanted)


def test_fewer_digits_make_larger_errors(measured: dict[str, Any]) -> None:
    rows = by_name(measured["variants"])
    assert list(rows) == list(measure.VARIANTS)
    assert rows["float64"]["worst_error"] == rows["float64"]["flipped"] == 0
    names = ("float64", "float32", "float16 head", "bfloat16 head")  # 53, 24, 11 and 8 bits
    errors = [rows[name]["median_error"] for name in names]
    assert errors == sorted(errors)
    assert len(set(errors)) == len(errors)
    assert rows["float32"]["worst_error"] < rows["float32 throughout"]["worst_error"]
    solves = by_name(measured["solves"])
    assert solves[measure.OF_FLOAT32]["worst_error"] == 0
    for name in (measure.IN_FLOAT32, "bare float32 Cholesky"):
        assert 0 < solves[name]["worst_error"] < 1e-3
    assert solves[FLOAT64]["worst_error"] is None  # of other features


def test_a_detector_of_few_bits_leaves_the_machine_as_it_was(experiment: Experiment) -> None:
    head = measure.SOLVES[FLOAT64](experiment).head
    assert head is not None
    whole = measure.detector(experiment, head, torch.bfloat16)
    assert whole.head.linear.dtype == torch.bfloat16
    assert head.linear.dtype == torch.float64
    assert experiment.plan.frame.scaler.minimum.dtype == torch.float64


def test_errors_are_in_standard_deviations(rng: np.random.Generator) -> None:
    truth = rng.standard_normal(40)
    scores = truth + rng.uniform(-0.5, 0.5, 40)
    found = measure.errors(torch.from_numpy(scores), torch.from_numpy(truth))
    error = np.sort(np.abs(scores - truth) / truth.std(ddof=1))
    assert found["worst_error"] == pytest.approx(error[-1])
    assert found["median_error"] == pytest.approx(error[19])
    assert found["flipped"] == np.sum(np.signbit(scores) != np.signbit(truth)) > 0
    scores[3] = np.inf
    for nothing in (None, torch.from_numpy(scores)):
        assert set(measure.errors(nothing, torch.from_numpy(truth)).values()) == {None}


def test_a_float32_matrix_is_refused_with_its_figure(
    experiment: Experiment, tmp_path: Path
) -> None:
    train = experiment.train  # every bin twice: singular but for the ridge
    twice = replace(
        train,
        features={name: torch.cat([of, of]) for name, of in train.features.items()},
        is_slip=torch.cat([train.is_slip] * 2),
    )
    plan, weights = replace(experiment.plan, penalty=1e8), torch.cat([experiment.weights] * 2)
    harsh = replace(experiment, train=twice, plan=plan, weights=weights)
    found = measure.measure_variants(harsh, TINY)
    row = by_name(found["variants"])["refitted, float32 solve"]
    assert row["worst_error"] is row["flipped"] is None
    assert set(row["balanced_accuracy"].values()) == {None}
    assert "condition" in row["refused"]
    assert "float32" in row["refused"]
    made = report_of(harsh, found)
    assert row["refused"] in report.report_text(made)
    figure(made, tmp_path / "front.png")
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")


# ---------------------------------------------------------------------------- seconds and bytes
def test_bytes_are_counted(experiment: Experiment, measured: dict[str, Any]) -> None:
    num = experiment.facts["num_features"]
    rows = by_name(measured["variants"])
    for name, of_bin, of_features, of_head in [
        ("float64", 8, 8, 8),
        ("float32", 4, 8, 4),
        ("float32 throughout", 4, 4, 4),
        ("bfloat16 head", 4, 8, 2),
    ]:
        wanted = {"bin": 2400 * of_bin, "features": 2582 * of_features}
        wanted["head"] = (num * num + num + 1) * of_head + 3 * num * 8  # the scaler is in float64
        assert rows[name]["bytes"] == wanted | {"all": sum(wanted.values())}


def test_ratios_are_of_rounds(measured: dict[str, Any]) -> None:
    found = report.ratios(measured["variants"])
    first = measured["variants"][0]
    assert found["float64"]["head"]["median"] == found["float64"]["bytes"] == 1
    for row in measured["variants"]:
        for part in ("features", "head"):
            pairs = zip(row[f"{part}_s"], first[f"{part}_s"], strict=True)
            wanted = median(a / b for a, b in pairs)
            assert len(row[f"{part}_s"]) == TINY.rounds
            assert found[row["name"]][part]["median"] == pytest.approx(wanted)


@pytest.mark.parametrize(("error", "is_ok"), [(9e-4, True), (1.1e-3, False), (None, False)])
def test_limit_is_on_the_worst_error_of_float32(error: float | None, is_ok: bool) -> None:
    rows = [{"name": name, "worst_error": error} for name in measure.VARIANTS]
    (limit,) = report.limit_rows(rows)
    assert limit["ok"] is is_ok
    assert limit["what"].startswith("float32, worst")


def test_the_pool_refuses_half_precision_in_words(measured: dict[str, Any]) -> None:
    for name in ("bfloat16", "float16"):
        assert measured["pool_refuses"][name].endswith(f"got torch.{name}")


# --------------------------------------------------------------------------------------- main
def report_of(experiment: Experiment, measured: dict[str, Any]) -> dict[str, Any]:
    return {
        "quick": True,
        "machine": {"processor": "abacus"},
        "threads": 1,
        "versions": {"torch": "2.13.0"},
        "experiment": experiment.facts,
        **measured,
        "ratios": report.ratios(measured["variants"]),
        "limits": report.limit_rows(measured["variants"]),
    }


def test_quick_run_writes_numbers_and_figure(
    experiment: Experiment,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    monkeypatch.setattr(outcome, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(bench, "load_experiment", lambda sizes: experiment)
    paths = [tmp_path / "numbers.json", tmp_path / "figure.png"]
    arguments = ["--quick", "--threads", "1", "--json", str(paths[0]), "--figure", str(paths[1])]
    assert bench.main(arguments) == 0
    made = json.loads(paths[0].read_text())
    assert made["quick"] is made["simulated"] is True
    assert made["settings"]["rounds"] == TINY.rounds
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    shown = capsys.readouterr().out
    assert shown.count(report.QUICK_LINE) == 2
    assert report.SIMULATED_LINE in shown
    assert bench.main(["--quick", "--threads", "1"]) == 0
    assert not (tmp_path / "results").exists()


def test_a_full_run_keeps_its_results(
    experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "Sizes", lambda: TINY)
    monkeypatch.setattr(outcome, "RESULTS", tmp_path)
    monkeypatch.setattr(bench, "load_experiment", lambda sizes: experiment)
    assert bench.main(["--threads", "1"]) == 0
    assert json.loads((tmp_path / "precision.json").read_text())["quick"] is False
    assert (tmp_path / "precision.png").exists()


def test_full_sizes_are_of_the_main_experiment() -> None:
    assert not any("materials" in override or "seen" in override for override in Sizes().overrides)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--threads", "0"], "--threads must be at least 1, got 0"),
        (["--json", "."], "--json needs a file, . is a folder"),
    ],
)
def test_bad_arguments_are_named(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as error:
        bench.main(arguments)
    assert error.value.code == 2
    assert complaint in capsys.readouterr().err
