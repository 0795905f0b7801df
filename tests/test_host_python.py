"""The example host in Python, which knows no torch, says what ``StreamingDetector`` says."""

import sys
from pathlib import Path

import hosts
import numpy as np
import pytest
import torch
from host_cases import (
    CASES,
    SPELLINGS,
    assert_loss_is_told,
    assert_read,
    assert_refused,
    assert_versions_are_read,
    assert_warned,
)
from hosts import assert_same, run_host, saved, truth

pytestmark = pytest.mark.onnx

FOLDER = Path(__file__).parents[1] / "export" / "python"
HOST = [sys.executable, FOLDER / "detect.py"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return hosts.exported(tmp_path_factory) / "stream.onnx"


@pytest.fixture
def recording(tmp_path):
    return saved(tmp_path / "recording.npy", hosts.slipping_stream())


@pytest.mark.parametrize("chunk", [1, 200, 1999])
def test_every_decision_is_that_of_the_package(model, recording, chunk):
    ran = run_host(HOST, model, recording, "--decisions", "--chunk", chunk, "--rate", 2000)
    assert_same(ran, truth(hosts.slipping_stream()))
    assert ran.summary["seconds"] == len(hosts.slipping_stream()) / hosts.RATE
    assert ran.stderr == ""


def test_alarms_alone_are_printed_unless_asked(model, recording):
    ran = run_host(HOST, model, recording)
    expected = [row for row in truth(hosts.slipping_stream()) if row["alarm"]]
    assert len(expected) > 1
    assert [list(line) for line in ran.lines] == [list(hosts.ALARM_KEYS)] * len(expected)
    assert [line["time_s"] for line in ran.lines] == [row["time_s"] for row in expected]


def test_another_threshold_raises_other_alarms(model, recording):
    ran = run_host(HOST, model, recording, "--decisions", "--threshold", 4.5)
    expected = truth(hosts.slipping_stream(), threshold=4.5)
    usual = truth(hosts.slipping_stream())
    assert [row["alarm"] for row in expected] != [row["alarm"] for row in usual]
    assert_same(ran, expected)


def test_a_graph_in_double_precision_is_fed_in_it(tmp_path, tmp_path_factory):
    model = hosts.exported(tmp_path_factory, "float64") / "stream.onnx"
    samples = hosts.slipping_stream()[2000:5000] * (1 + 2.0**-40)  # no float32
    ran = run_host(HOST, model, saved(tmp_path / "recording.npy", samples), "--decisions")
    assert_same(ran, truth(samples), exact=True)


def test_a_broken_sensor_is_flagged_and_survived(model, tmp_path):
    samples = hosts.slipping_stream().copy()
    samples[1000:1010] = np.nan
    ran = run_host(HOST, model, saved(tmp_path / "recording.npy", samples), "--decisions")
    assert_same(ran, truth(samples))
    assert_warned(ran, truth(samples))


def test_a_recording_of_nothing_has_no_decision(model, tmp_path):
    ran = run_host(HOST, model, saved(tmp_path / "nothing.npy", hosts.slipping_stream()[:0]))
    assert ran == ([], {"decisions": 0, "alarms": 0, "seconds": 0}, "", 0)


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_one_line(model, tmp_path, case):
    assert_refused(HOST, case, tmp_path, model)


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_options_are_read_however_they_are_written(model, recording, spelling):
    assert_read(HOST, spelling, model, recording)


def test_later_versions_of_the_file_format_are_read(model, tmp_path):
    assert_versions_are_read(HOST, model, tmp_path)


def test_lines_that_cannot_be_written_are_an_error(model, recording):
    assert_loss_is_told(HOST, model, recording)


def test_it_needs_no_torch(model, recording):
    code = (
        "import runpy, sys; sys.modules |= dict.fromkeys(['torch', 'tactslip_torch']); "
        "sys.argv = sys.argv[1:]; sys.path.insert(0, sys.argv.pop(0)); "
        "runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    without = [sys.executable, "-c", code, FOLDER, HOST[1]]
    assert run_host(without, model, recording) == run_host(HOST, model, recording)


# Bins by themselves ----------------------------------------------------------------------------


def test_bins_are_scored_as_the_package_scores_them(model, tmp_path):
    samples = hosts.slipping_stream().copy()
    samples[3000] = np.nan
    detector = hosts.alarming_detector()
    before, after = detector.context_before, detector.context_after
    path = saved(tmp_path / "recording.npy", samples)
    ran = run_host([sys.executable, FOLDER / "score.py"], model.with_name("model.onnx"), path)
    lines = [*ran.lines, ran.summary]  # there is no line of sums

    starts = [round(line["start_s"] * hosts.RATE) for line in lines]
    assert np.diff(starts).tolist() == [100] * (len(lines) - 1)
    assert starts[0] <= before
    assert len(samples) - 100 < starts[-1] + 100 + after <= len(samples)
    bins = torch.stack(
        [torch.from_numpy(samples[s - before : s + 100 + after].T.copy()) for s in starts[1:-1]]
    )
    judged = detector.predict_raw(bins.double())
    assert [line["valid"] for line in lines[1:-1]] == judged.is_valid.tolist()
    assert not judged.is_valid.all()
    found = torch.tensor([line["score"] for line in lines[1:-1]], dtype=torch.float64)
    torch.testing.assert_close(found, judged.score, rtol=0, atol=1e-3 * hosts.score_std())


@pytest.mark.parametrize("case", ["truncated model", "no recording", "seven channels"])
def test_what_is_wrong_with_bins_is_one_line(model, tmp_path, case):
    stream, path, *_ = CASES[case].arguments(tmp_path, model)
    wrong = case == "truncated model"
    given = stream if wrong else model.with_name("model.onnx")
    ran = run_host([sys.executable, FOLDER / "score.py"], given, path)
    assert (ran.status, ran.lines) == (1, [])
    (line,) = ran.stderr.splitlines()
    assert line.startswith("error: ")


def test_a_stream_graph_is_refused_for_bins(model, recording):
    ran = run_host([sys.executable, FOLDER / "score.py"], model, recording)
    assert ran.status == 1
    assert "give model.onnx" in ran.stderr
