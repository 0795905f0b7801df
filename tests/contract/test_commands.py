"""The main use of every command, on a small set of text files or a few simulated seconds."""

import csv
import json
import os
import runpy
import signal
import time

import numpy as np
import pytest
import torch

from . import names
from .names import SlipDetector, StreamingDetector, settings
from .recordings import (
    CHANNELS,
    SEEN,
    SLIDE_S,
    TRIALS,
    bins_of,
    of_set,
    samples_of,
    split_of_set,
)
from .running import ROOT

NUM_RECORDINGS = 4 * len(TRIALS)
BINS = np.array([20, 28])
"""Of a recording: a second without slip before the onset, and the slide, in bins of 50 ms."""


def read(path):
    return json.loads(path.read_text())


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def probe(detector):
    """Scores of some raw bins, to tell two detectors apart."""
    return detector.score_raw(bins_of(detector, samples_of("D", 3)))


# Train, evaluate, detect -------------------------------------------------------------------------


def test_train_leaves_its_files_and_counts_every_bin(trained):
    assert set(names.RUN_FILES) <= {path.name for path in trained.folder.iterdir()}
    splits = trained.metrics[names.SPLITS]
    assert list(splits) == [names.TRAIN, names.TEST, names.HELD_OUT]
    for name, num_recordings in ((names.TRAIN, 6), (names.TEST, 3), (names.HELD_OUT, 3)):
        confusion = np.array(splits[name][names.CONFUSION])
        assert np.array_equal(confusion.sum(1), num_recordings * BINS), name
        recall = confusion.diagonal() / confusion.sum(1)
        accuracy = confusion.trace() / confusion.sum()
        assert splits[name]["accuracy"] == pytest.approx(accuracy)
        assert splits[name]["balanced_accuracy"] == pytest.approx(recall.mean())
        assert recall.min() > 0.6, name
    assert trained.metrics["simulated"] is False
    assert trained.metrics["trained_on"]["materials"] == list(SEEN)


def test_evaluate_gives_what_training_gave(command, trained_or_slow, recordings, cache, tmp_path):
    trained = trained_or_slow
    data = [*of_set(recordings), "split=unseen4", *split_of_set()]
    told = settings(model=trained.file, workers=0, cache=cache, folder="run")
    command.well(tmp_path, "evaluate", *data, *told)
    splits = read(tmp_path / "run" / names.METRICS)[names.SPLITS]
    for name, scores in trained.metrics[names.SPLITS].items():
        assert splits[name][names.CONFUSION] == scores[names.CONFUSION], name


def test_evaluate_refuses_recordings_of_another_unit(command, paper, recordings, tmp_path):
    told = [*of_set(recordings), *settings(model=paper.file, workers=0), "data.units=N"]
    ran = command(tmp_path, "evaluate", *told)
    assert (ran.status, ran.err.count("\n")) == (2, 1)
    assert "the recordings are in N, the detector was trained on V" in ran.err


def test_detect_decides_as_a_stream(command, trained_or_slow, recordings, tmp_path):
    """And finds the slip of every recording."""
    trained = trained_or_slow
    told = settings(model=trained.file, input=recordings, folder="run")
    command.well(tmp_path, "detect", *told, *settings(every_decision=True, figure="none"))
    found = read(tmp_path / "run" / names.ONSETS[0])
    assert len(found["recordings"]) == NUM_RECORDINGS
    rows = table(tmp_path / "run" / names.ONSETS[1])
    for material in (*SEEN, "D"):
        for trial in TRIALS:
            mine = [row for row in rows if row["file"] == f"{material}_{trial}.csv"]
            assert any(abs(float(row["onset_s"]) - SLIDE_S[0]) < 0.2 for row in mine), mine
    decided = table(tmp_path / "run" / names.DECISIONS.format("D_2"))
    expected = StreamingDetector(trained.detector, dtype=torch.float64).push(samples_of("D", 2))
    scores = np.array([float(row["score"]) for row in decided])[: len(expected.score)]
    np.testing.assert_allclose(scores, expected.score.numpy(), rtol=1e-4, atol=1e-4)
    alarms = [row["is_alarm"] == "True" for row in decided][: len(scores)]
    assert alarms == expected.is_alarm.tolist()


def test_stream_decides_as_detect_and_ends_whole_by_a_signal(
    command, trained_or_slow, recordings, tmp_path
):
    """Of a file, as fast as it goes; then over and over, until it is stopped."""
    model = settings(model=trained_or_slow.file)
    told = settings(input=recordings / "D_2.csv", folder="run", every_decision=True, figure="none")
    command.well(tmp_path, "detect", *model, *told)
    decided = table(tmp_path / "run" / names.DECISIONS.format("D_2"))
    told = settings(source_of_stream=recordings / "D_2.csv", every_decision=True, speed=None)
    out = command.well(tmp_path, "stream", *model, *told)
    *rows, last = [json.loads(line) for line in out.splitlines()]
    rows = [row for row in rows if "event" not in row]
    for name, word in names.STREAM_OUTPUTS.items():
        of_stream, of_detect = [row[name] for row in rows], [row[word] for row in decided]
        if isinstance(of_stream[-1], float):
            found, wanted = (
                np.array(["nan" if x in (None, "") else x for x in each], float)
                for each in (of_stream, of_detect)
            )
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-12, err_msg=name)
        else:
            assert [str(x) for x in of_stream] == of_detect, name
    counts = {"decisions": len(rows), "alarms": sum(row["alarm"] for row in rows)}
    assert last == {**counts, "seconds": len(samples_of("D", 2)) / 2000}

    pid = command.start(tmp_path, "stream", *model, *told, *settings(repeat=True))
    end = time.monotonic() + 60
    while (tmp_path / ".stdout").read_text().count("\n") < 500:
        assert time.monotonic() < end
        time.sleep(0.01)
    os.kill(pid, signal.SIGTERM)
    ran = command.wait()
    assert ran.status == 128 + signal.SIGTERM, ran.err
    *rows, last = [json.loads(line) for line in ran.out.splitlines()]
    assert last["decisions"] == sum("event" not in row for row in rows)
    assert "all decisions are written" in ran.err.splitlines()[-1]


def test_detect_does_without_masked_channels(command, paper, recordings, tmp_path):
    told = settings(model=paper.file, input=recordings / "D_1.csv")
    masked = settings(masked_channels=["SG1", "PVDF2"], folder="run")
    command.well(tmp_path, "detect", *told, *masked)
    (one,) = read(tmp_path / "run" / names.ONSETS[0])["recordings"]
    assert list((tmp_path / "run").glob("*.png"))
    assert [event["text"] for event in one["events"]] == ["channels lost: SG1, PVDF2"]
    assert one["decisions"]["number"] > 100
    assert one["decisions"]["invalid"] == 0  # the others are enough


# Data, generate ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_converted_recordings_are_the_same_set(command, paper, recordings, tmp_path):
    told = settings(root_of_data=recordings, channels=CHANNELS, workers=0)
    command.well(tmp_path, "data", *settings(action=names.CONVERT, format="h5", output="to"), *told)
    data = [*settings(data="files", root="to"), "split=unseen4", *split_of_set()]
    words = settings(model=paper.file, workers=0, cache="off", folder="run")
    command.well(tmp_path, "evaluate", *data, *words)
    splits = read(tmp_path / "run" / names.METRICS)[names.SPLITS]
    for name, scores in paper.metrics[names.SPLITS].items():
        assert splits[name][names.CONFUSION] == scores[names.CONFUSION], name


# A simulated set, and statistics in shards -------------------------------------------------------


@pytest.fixture(scope="module")
def quick(command, tmp_path_factory):
    """The folder of the quick experiment on the simulated hand."""
    folder = tmp_path_factory.mktemp("quick")
    words = settings(experiment="quick", workers=0, cache=folder / "cache", folder="run")
    command.well(folder, "train", *words)
    return folder


@pytest.mark.slow
def test_the_quick_experiment_trains_exports_and_says_it_is_simulated(quick):
    metrics = read(quick / "run" / names.METRICS)
    assert metrics["simulated"] is True
    described = 14 * 8 + 10 * 8 * (9 + 10 + 1)  # of slow channels, and of branches of fast ones
    assert metrics["num_features_pool"] == described + 78  # with the simple statistics
    non_slip = {name: sum(s[names.CONFUSION][0]) for name, s in metrics[names.SPLITS].items()}
    assert non_slip == {names.TRAIN: 6 * 60, names.TEST: 6 * 60, names.HELD_OUT: 2 * 60}
    assert metrics["onnx"]["bin"]["error"] < 1e-3
    assert metrics["baselines"]


@pytest.mark.slow
def test_workers_change_nothing(command, quick, tmp_path):
    told = settings(experiment="quick", export=False, baselines=False, folder="run")
    command.well(tmp_path, "train", *told, *settings(workers=2, cache="off"))
    metrics, again = (read(folder / "run" / names.METRICS) for folder in (quick, tmp_path))
    assert again["selected"] == metrics["selected"]
    for name, scores in metrics[names.SPLITS].items():
        assert again[names.SPLITS][name][names.CONFUSION] == scores[names.CONFUSION]


@pytest.mark.slow
def test_sums_in_shards_give_the_detector_of_one_process(paper, tmp_path):
    """By the example script; it weighs the classes, where ``paper`` draws as many of each."""
    example, run, found = runpy.run_path(str(ROOT / names.BATCH_FIT)), paper.file.parent, []
    for parts in (1, 2):
        sums = [tmp_path / f"{part}-of-{parts}.stats" for part in range(1, parts + 1)]
        for part, path in enumerate(sums, 1):
            example["collect"](run, f"{part}/{parts}", path, [])
        example["solve"](run, tmp_path / "detector.pt", sums[::-1])
        found.append(SlipDetector.load(tmp_path / "detector.pt"))
    assert found[0].selected_names == paper.detector.selected_names
    torch.testing.assert_close(probe(found[1]), probe(found[0]), rtol=1e-9, atol=1e-9)
