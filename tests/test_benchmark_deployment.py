import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import helper

from benchmarks import exported
from benchmarks import report as whole_report
from benchmarks.bins import WINDOW_LENGTHS, raw_bins
from benchmarks.deployment import __main__ as bench
from benchmarks.deployment import files, measure, report, start, ways
from benchmarks.deployment.definitions import described
from benchmarks.deployment.figure import Mark, clusters, label_heights
from benchmarks.deployment.naive import NaivePipeline, export_naive
from benchmarks.deployment.sizes import QUICK, Sizes
from benchmarks.deployment.subject import Subject, held_out_bins, subject_of
from benchmarks.detectors import timed_detector
from benchmarks.engines import ENGINES, FLOAT32, FLOAT64, pool_of
from benchmarks.outcome import QUICK_LINE
from benchmarks.peers import loop
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import PAPER_KERNEL
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation.source import SimulatedRecordings

TINY: Sizes = replace(QUICK, threads=(1,), held_out=16, streamed_s=1.0)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector of five features, which is exported in a second."""
    path = tmp_path_factory.mktemp("small") / "detector.pt"
    given = timed_detector(1)
    scaler, unit = given.scaler, torch.eye(5, dtype=torch.float64)
    assert scaler.knee is not None
    SlipDetector(
        pool_of(FLOAT64),
        ChannelFilter(WINDOW_LENGTHS),
        given.selected[:5],
        FeatureScaler(scaler.minimum[:5], scaler.maximum[:5], scaler.knee[:5]),
        QuadraticForm(unit, unit[0], unit[0, 0]),
        given.selection["trained"] | {"seed": 7},
    ).save(path)
    return path


@pytest.fixture(scope="module")
def subject(path: Path) -> Subject:
    return subject_of(1, path)


# ---------------------------------------------------------------------------------------- naive
@pytest.mark.parametrize("name", [name for name in TIME_DESCRIPTORS if name != "correlation"])
def test_definitions_are_those_of_scipy(name: str, rng: np.random.Generator) -> None:
    x = np.concatenate([rng.normal(size=(3, 100)), rng.integers(0, 9, (3, 100)).astype(float)])
    scale = np.abs(x).max(-1)
    found = described(torch.from_numpy(x), torch.from_numpy(scale))[name]
    expected = [loop.describe(row, name, of) for row, of in zip(x, scale, strict=True)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-10)


def test_naive_pipeline_is_the_pool_scaled_and_summed(rng: np.random.Generator) -> None:
    """Of all features but those that are rounding: means of details, which are zero."""
    pool, channel_filter = pool_of(FLOAT64), ChannelFilter(WINDOW_LENGTHS)
    chosen = [
        index
        for index, name in enumerate(pool.names)
        if not (
            name.component[0] == "D" and name.domain == "time" and name.descriptor in ("mean", "cv")
        )
    ]
    samples = raw_bins(12).double()
    features = pool(channel_filter.valid(samples))[:, chosen]
    support = torch.from_numpy(rng.uniform(-1, 1, (4, len(chosen))))
    machine = KernelSum(support, torch.from_numpy(rng.normal(size=4)), PAPER_KERNEL)
    for scaler in (FeatureScaler.fit(features), FeatureScaler.fit(features, compress=True)):
        expected = machine(scaler(features))
        close = {"rtol": 0, "atol": 1e-9 * float(expected.std())}
        for is_whole in (True, False):
            naive = NaivePipeline(pool, channel_filter, chosen, scaler, machine, is_whole)
            torch.testing.assert_close(naive(samples), expected, **close)


def test_naive_pipeline_makes_only_what_is_needed() -> None:
    pool = pool_of(FLOAT64)
    chosen = [
        index
        for index, name in enumerate(pool.names)
        if name.channel in ("SG3", "PVDF2", "PVDF7")
        and name.component in ("raw", "A2", "D4")
        and name.descriptor in ("range", *SPECTRUM_DESCRIPTORS[-1:], "band_energy_ratio")
    ]
    samples = raw_bins(12).double()
    channel_filter = ChannelFilter(WINDOW_LENGTHS)
    features = pool(channel_filter.valid(samples))[:, chosen]
    scaler = FeatureScaler.fit(features)
    machine = KernelSum(
        torch.eye(len(chosen)).double(), torch.ones(len(chosen)).double(), PAPER_KERNEL
    )
    naive = NaivePipeline(pool, channel_filter, chosen, scaler, machine, is_whole=False)
    expected = machine(scaler(features))
    assert len(chosen) < 20
    torch.testing.assert_close(naive(samples), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.onnx
@pytest.mark.slow
def test_naive_export_scores_any_number_of_bins(subject: Subject, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    path, samples = tmp_path / "naive.onnx", raw_bins(12)
    export_naive(files.naive_of(subject, is_whole=False), samples[:3], path)
    assert {node.op_type for node in onnx.load(path).graph.node} >= {"Conv", "ConvTranspose", "DFT"}
    expected = subject.detector("reference", FLOAT64).score_raw(samples.double()).numpy()
    session = exported.session_of(path, 1)
    for num in (1, 7, 12):
        found = session.run(["score"], {"samples": samples[:num].numpy()})[0]
        assert found.shape == (num,)
        np.testing.assert_allclose(found, expected[:num], rtol=0, atol=0.2 * expected.std())


# -------------------------------------------------------------------------------------- subject
def test_the_source_is_named_by_its_bytes(subject: Subject, path: Path) -> None:
    assert subject.source["seed"] == 7
    assert subject.source["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert len(subject.timed.selected) == 5


def test_the_machine_is_one_as_a_sum_and_folded(subject: Subject) -> None:
    z = subject.timed.z
    folded = subject.timed.head(z)
    torch.testing.assert_close(subject.machine(z), folded, rtol=0, atol=1e-9 * float(folded.std()))
    assert len(subject.machine.support) == len(z)


def test_held_out_bins_are_of_other_materials_and_seeds() -> None:
    bins = held_out_bins(700)
    assert bins.shape == (700, 24, 150)
    source = SimulatedRecordings(seed=1, cycles=1, materials=["cloth"])
    first = source.load(source.ids[0]).samples.float()
    torch.testing.assert_close(bins[0], first[:, :150], rtol=0, atol=0)
    torch.testing.assert_close(bins[2], first[:, 200:350], rtol=0, atol=0)


# ---------------------------------------------------------------------------------------- ways
@pytest.mark.onnx
def test_an_exported_session_scores_as_the_detector(subject: Subject) -> None:
    samples = raw_bins(5)
    detector = subject.timed.detector("reference", FLOAT64)
    expected = detector.score_raw(samples.double()).numpy()
    judge = exported.session(subject.timed, 1, "bulk")
    found = judge.run(judge.cut(samples))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * expected.std())


def test_errors_are_in_deviations_of_all_scores() -> None:
    exact = np.array([-3.0, 1.0, -1.0, 3.0])  # of standard deviation sqrt(5)
    found = measure.error_of(np.array([-3.0, -1.0, -1.5]), exact)
    assert (found["bins"], found["flips"]) == (3, 1)
    assert found["worst"] == pytest.approx(2 / 5**0.5)
    assert found["p99"] == pytest.approx(np.percentile([0, 2, 0.5], 99) / 5**0.5)


def test_a_process_tells_its_first_score(tmp_path: Path) -> None:
    info = [helper.make_tensor_value_info(name, 1, ["n"]) for name in ("samples", "score")]
    node = helper.make_node("Neg", ["samples"], ["score"])
    model = helper.make_model(
        helper.make_graph([node], "negation", info[:1], info[1:]),
        opset_imports=[helper.make_opsetid("", 20)],
        ir_version=10,
    )
    onnx.save(model, tmp_path / "model.onnx")
    np.save(tmp_path / "bin.npy", np.array([3.5], np.float32))
    job = (start.ONNXRUNTIME, tmp_path / "model.onnx", tmp_path / "bin.npy")
    told: list[str] = []
    [row] = start.starts({"negation": job}, 1, told.append)
    assert row["score"] == [-3.5]
    assert 0 < row["import_s"][0] + row["load_s"][0] + row["first_s"][0] < row["seconds"][0]
    assert len(told) == 1
    with pytest.raises(start.StartFailedError, match="ended without a score"):
        start.started(start.ONNXRUNTIME, tmp_path / "none.onnx", tmp_path / "bin.npy")


# --------------------------------------------------------------------------------------- report
def single(way: str, *rounds: float, threads: int = 1) -> dict[str, Any]:
    row = dict.fromkeys(("p25_s", "p50_s", "p75_s", "p99_s"), rounds[0])
    return row | {
        "way": way,
        "threads": threads,
        "features": 120,
        "round_medians_s": list(rounds),
    }


def bulk(way: str, chunk: int, a_second: float, threads: int = 2) -> dict[str, Any]:
    seconds = [chunk / a_second]
    return {"way": way, "chunk": chunk, "bins": chunk, "threads": threads, "seconds": seconds}


def wrong(way: str, worst: float, flips: int = 0) -> dict[str, Any]:
    return {"way": way, "bins": 10_000, "worst": worst, "p99": worst / 2, "flips": flips}


def sections(
    naive_s: float = 4.1e-4,
    loop_s: float = 0.031,
    a_second: float = 81_000.0,
    kb: float = 699.0,
    error32: float = 9e-4,
    error64: float = 9e-10,
    flips: int = 0,
) -> dict[str, Any]:
    """Of one way by each layout and precision, at these places of the limits."""
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in report.SECTIONS}
    rows["single"] = [
        single(report.DEPLOYED, 1e-4, 1e-4, 2e-4),
        single(report.DEPLOYED, 8e-5, threads=2),
        single(files.NAIVE[True], naive_s, naive_s, 2 * naive_s),
        single(ways.LOOP, loop_s, loop_s, 2 * loop_s),
    ]
    for precision, layout in (("float32", "bulk"), ("float32", "latency"), ("float64", "bulk")):
        way = files.exported(precision, layout)
        rate = a_second if layout == "bulk" else 0.5 * a_second
        rows["bulk"] += [bulk(way, 64, 0.9 * rate), bulk(way, 256, rate)]
        rows["errors"].append(wrong(way, error32 if precision == "float32" else error64, flips))
        file = files.of_way(way, files.BIN)
        rows["files"].append({"file": file, "bytes": round(1000 * kb), "seconds": 2.0})
    return {name: {"rows": of} for name, of in rows.items()}


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, ""),
        ({"naive_s": 3.9e-4}, "p50"),
        ({"loop_s": 0.029}, "p50"),
        ({"a_second": 79_000.0}, "bins/s"),
        ({"kb": 700.0}, "size"),
        ({"error32": 1.1e-3}, "largest"),
        ({"error64": 1.1e-9}, "largest"),
        ({"flips": 1}, "largest"),
    ],
)
def test_limits(changes: dict[str, float], missed: str) -> None:
    rows = report.limit_rows(sections(**changes))
    assert sum(row["ok"] is not None for row in rows) == 8
    wrong_ones = {row["what"].split()[0].strip(",") for row in rows if row["ok"] is False}
    assert wrong_ones == {missed} - {""}


def test_what_was_not_measured_meets_nothing() -> None:
    rows = report.limit_rows({name: {"rows": []} for name in report.SECTIONS})
    assert {row["ok"] for row in rows} == {None}


def test_ratios_are_of_rounds_and_rates_of_the_best_chunk() -> None:
    rows = [single("a", 1.0, 2.0, 4.0), single("b", 3.0, 4.0, 4.0)]
    ratio = report.times(rows, "b", "a")
    assert ratio == pytest.approx((2, 1.5, 2.5))
    assert report.times(rows, "b", "c") is None
    rows = [bulk("a", 1, 10.0), bulk("a", 16, 30.0), bulk("a", 64, 20.0), bulk("b", 4, 90.0)]
    best = report.best_chunk(rows, "a", 2)
    assert best is not None
    assert best["chunk"] == 16
    assert report.best_chunk(rows, "a", 1) is None


def made(**changes: Any) -> dict[str, Any]:
    found = sections(flips=3)
    return {
        "quick": False,
        "machine": {"processor": "abacus"},
        "versions": {"torch": "2.13.0"},
        "training_bins": 8000,
        "selection": {
            "names": ["a", "b"],
            "trained": {"experiment": "onset", "recipe": "robust", "seed": 0, "sha256": 64 * "e"},
        },
        "sections": found,
        "limits": report.limit_rows(found),
    } | changes


def test_tables_show_what_was_measured() -> None:
    page = whole_report.markdown({"deployment": made()}, "results")
    assert "selected by +exp=onset recipe=robust seed=0 (SHA-256 eeeeeeeeeeee)" in page
    assert "fitted again to 8,000 simulated bins" in page
    line = "| 120 | 100 | 100 to 100 | 100 | 80 | 80 | 1 | 0.0009 | 0.00045 | 3 | 10,000 |"
    assert f"| {report.DEPLOYED} {line}" in page
    assert "| export, float32, bulk | 81,000 (81,000 to 81,000) | 256 |" in page
    assert "| export, float32, bulk, bin | 699 | 2 |" in page
    text = report.report_text(made())
    assert "81,000 (81,000 to 81,000), export, float32, bulk, chunks of 256" in text


# --------------------------------------------------------------------------------------- figure
def test_labels_of_marks_above_one_another_keep_apart() -> None:
    marks = [
        Mark("c", 1e-3, 100.0),
        Mark("a", 1e-3, 99.0),
        Mark("b", 1e-3, 99.5),
        Mark("d", 1, 1e4),
    ]
    heights = label_heights(marks)
    assert heights["a"] == pytest.approx(99.0)
    assert heights["d"] == pytest.approx(1e4)
    in_order = np.log10([heights[way] for way in "abcd"])
    assert (np.diff(in_order) > 0.1).all()


def test_marks_of_like_error_are_together() -> None:
    marks = [Mark("b", 3e-14, 1.0), Mark("c", 1e-3, 1.0), Mark("a", 1e-14, 1.0)]
    assert [[mark.way for mark in of] for of in clusters(marks)] == [["a", "b"], ["c"]]


# ---------------------------------------------------------------------------------- measurements
@pytest.mark.onnx
def test_quick_run_measures_every_way(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxscript")
    monkeypatch.setattr(bench, "QUICK", TINY)
    for way in ("export, float32, bulk", "export, float64, latency"):  # a second each
        monkeypatch.delitem(files.EXPORTS, way)
    kept, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    given = ["--detector", str(path), "--json", str(kept), "--figure", str(drawing)]
    assert bench.main(["--quick", *given]) == 0
    found = json.loads(kept.read_text())
    assert found["quick"] is found["simulated"] is True
    rows = {name: of["rows"] for name, of in found["sections"].items()}
    ours = set(files.EXPORTS)
    engines = {ways.engine_way(e, dtype) for e in ENGINES for dtype in (FLOAT32, FLOAT64)}
    assert {row["way"] for row in rows["single"]} == ours | engines | {ways.REFERENCE}
    assert {row["way"] for row in rows["errors"]} == ours | engines
    assert {(row["way"], row["push"]) for row in rows["stream"]} == {
        (way, push) for way in ours | engines for push in (200, 1)
    }
    for row in rows["errors"]:
        if "float64" in row["way"]:
            assert row["worst"] < 1e-9, row["way"]
    for row in rows["stream"]:
        assert 0 < row["p50_s"] <= row["p99_s"]
        assert row["decisions"] == row["push"] // 20
        if "float64" in row["way"]:
            assert row["score_worst"] < 1e-9, row["way"]
    sizes = {row["file"]: row["bytes"] for row in rows["files"]}
    assert {f"{way}, {graph}" for way in ours for graph in ("bin", "stream")} < set(sizes)
    assert min(sizes.values()) > 1000
    shown = capsys.readouterr().out
    assert QUICK_LINE in shown
    assert report.report_text(found) in shown
    assert drawing.stat().st_size > 0


def test_the_loop_and_a_kernel_sum_are_among_the_ways(subject: Subject) -> None:
    """The naive pipeline in torch and the loop, whose files need no export."""
    sizes = replace(TINY, has_loop=True)
    nothing = files.Files({}, {})
    samples = raw_bins(2)
    expected = subject.detector("reference", FLOAT64).score_raw(samples.double()).numpy()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ways, "_exports", lambda *_: {})
        found = ways.ways_of(subject, nothing, sizes, threads=1)
        assert ways.LOOP not in ways.ways_of(subject, nothing, sizes, threads=2)
    way = found[ways.PRUNED_LOOP]
    assert (way.most, way.features) == (1, len(subject.timed.selected))
    np.testing.assert_allclose(way.run(way.cut(samples)), expected, atol=1e-6 * expected.std())
    assert found[ways.LOOP].features == 2582


def test_a_missing_detector_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["--quick", "--detector", str(tmp_path / "none.pt")]) == 2
    assert "error: " in capsys.readouterr().err
