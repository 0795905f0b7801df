"""What a detector loses without each of its sensors."""

import json
import shutil
from dataclasses import replace
from statistics import fmean

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from tactslip_torch import SlipDetector
from tactslip_torch.commands.configuration import compose_config
from tactslip_torch.commands.importance import importance
from tactslip_torch.training.experiment import features_of


def sensors_of(model, folder, **words):
    given = [f"model={model}", "num_workers=0", *(f"{key}={value}" for key, value in words.items())]
    return importance(compose_config("importance", given), folder)


def test_every_sensor_has_a_row_and_a_masked_kind_costs_accuracy(trained_or_slow, tmp_path, capsys):
    trained = trained_or_slow
    found = sensors_of(trained.file, tmp_path)
    assert json.loads((tmp_path / "sensors.json").read_text()) == found
    assert (tmp_path / "sensors.png").stat().st_size > 2000
    whole, *rows = found["rows"]
    for role in ("test", "unseen"):  # every bin was counted
        scores = trained.metrics["splits"][role]
        assert whole[role] == pytest.approx(scores["balanced_accuracy"], abs=1e-12)
    hand = trained.detector.pool.hand
    assert [row["name"] for row in rows if row["unit"] == "channel"] == list(hand.names)
    of_kinds = [row["test"] for row in rows if row["unit"] == "kind"]
    assert min(0.0 if of is None else of for of in of_kinds) < whole["test"] - 0.1
    assert "channel PVDF1" in capsys.readouterr().out


def test_a_masked_channel_is_one_that_predict_leaves_out(paper, tmp_path):
    rows = {row["name"]: row for row in sensors_of(paper.file, tmp_path)["rows"]}
    training, detector = OmegaConf.load(paper.file.with_name("config.yaml")), paper.detector
    source = instantiate(training.data, _convert_="all")
    (fold,) = instantiate(training.split, _convert_="all")(source.ids)
    maker = features_of(detector, source, instantiate(training.labels), None)
    (used, *_) = dict.fromkeys(name.channel for name in detector.selected_names)
    for masked in (None, used):
        recalls = {True: [], False: []}
        for recording in fold.having("unseen"):
            bins, labels = maker.filtered_bins(recording)
            found = detector.predict(bins, masked_channels=[masked] if masked else None)
            is_right = ((found.score >= 0) & found.is_valid) == labels.is_slip
            for value, rights in recalls.items():
                rights += is_right[labels.is_slip == value].tolist()
        wanted = fmean(map(fmean, recalls.values()))
        assert rows[masked or ""]["unseen"] == pytest.approx(wanted, abs=1e-12)


def test_a_detector_needs_the_configuration_of_its_training(paper, tmp_path):
    shutil.copy(paper.file, tmp_path / "alone.pt")
    with pytest.raises(FileNotFoundError, match=r"config\.yaml"):
        sensors_of(tmp_path / "alone.pt", tmp_path)


def test_a_run_keeps_its_configuration_and_needs_that_of_a_training(paper, tmp_path):
    run = paper.file.parent
    before = (run / "config.yaml").read_bytes()
    with pytest.raises(ValueError, match=r"config\.yaml would be lost; give another folder"):
        sensors_of(paper.file, run)
    assert (run / "config.yaml").read_bytes() == before
    shutil.copy(paper.file, tmp_path)
    (tmp_path / "config.yaml").write_text("per_hour: 5\n")  # as calibrate leaves it
    with pytest.raises(ValueError, match=r"config\.yaml is of no training; give model=RUN"):
        sensors_of(tmp_path / paper.file.name, tmp_path / "out")


def test_a_detector_is_not_evaluated_on_what_it_was_trained_on(paper, tmp_path):
    shutil.copy(paper.file, tmp_path / "detector.pt")
    training = OmegaConf.load(paper.file.with_name("config.yaml"))
    training.split.seen, training.split.unseen = training.split.unseen, training.split.seen
    OmegaConf.save(training, tmp_path / "config.yaml")
    with pytest.raises(ValueError, match="holds out now: the recordings have changed since"):
        sensors_of(tmp_path / "detector.pt", tmp_path / "out")


def test_nothing_is_said_of_a_sensor_without_which_no_decision_is_valid(paper, tmp_path, capsys):
    detector = SlipDetector.load(paper.file)
    needs_all = replace(detector.sensing, min_alive=int(detector.counted.sum()))
    detector.sensing = needs_all
    detector.save(tmp_path / "detector.pt")
    shutil.copy(paper.file.with_name("config.yaml"), tmp_path)
    found = sensors_of(tmp_path / "detector.pt", tmp_path / "out")
    used = {name.channel for name in detector.extractor.names}
    channels = {row["name"]: row["test"] for row in found["rows"] if row["unit"] == "channel"}
    assert {name for name, of in channels.items() if of is None} == used
    printed = capsys.readouterr().out.splitlines()
    for name in channels:
        (line,) = (line for line in printed if f"channel {name} " in line)
        assert (" - " in line) == (name in used)
