"""``sensors`` as a command: what it leaves, what it draws, and what it says of bad input."""

import csv
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from PIL import Image
from test_commands import TINY
from test_commands import composed as composed_train

from tactslip_torch.analysis.importance import draw_raw_bins
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.commands.importance import _trained, main, sensors
from tactslip_torch.commands.train import train
from tactslip_torch.hand import HandLayout
from tactslip_torch.report.importance import (
    _fingers,
    best_table,
    sensors_csv,
    sensors_figure,
    sensors_table,
)
from tactslip_torch.report.style import kind_colours

SMALL = ("bins=20", "scored_bins=30", "gradient_bins=8", "draws=20", "num_workers=0")
CHANNELS = ["SG1", "SG2", "PVDF1", "PVDF2"]


def composed(*overrides):
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        return compose("importance", [*SMALL, *overrides])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    train(composed_train(*TINY, "recipe=robust", "cache=off"), folder)
    return folder


@pytest.fixture(scope="module")
def found(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sensors")
    content = sensors(composed(f"model={run / 'detector.pt'}", "cache=off"), folder)
    assert json.loads((folder / "sensors.json").read_text()) == content
    return folder, content


# What it leaves ----------------------------------------------------------------------------------


def test_the_files_of_a_run(found):
    folder, _ = found
    names = {path.name for path in folder.iterdir()}
    assert names == {"config.yaml", "sensors.json", "sensors.csv", "sensors.png"}
    with Image.open(folder / "sensors.png") as image:
        assert image.size[0] > 1000


def test_every_channel_finger_and_kind_has_its_row(found):
    _, content = found
    named = [(row["unit"], row["name"]) for row in content["units"]]
    assert named == [
        *(("channel", name) for name in CHANNELS),
        *(("finger", name) for name in ("index", "thumb")),
        *(("kind", name) for name in ("SG", "PVDF")),
    ]
    roles = ["held_out", "test", "unseen"]
    in_use = {row["name"]: row["features_in_use"] for row in content["units"]}
    assert sum(in_use[name] for name in CHANNELS) == content["detector"]["features"] == 10
    for row in content["units"]:
        assert list(row["lost"]) == list(row["lost_reselected"]) == list(row["alone"]) == roles
        if row["unit"] == "channel":
            assert (row["gradient"]["slip"] > 0) is (row["features_in_use"] > 0)
        if not row["features_in_use"]:
            assert row["lost"]["unseen"] == {"lost": 0.0, "low": 0.0, "high": 0.0}
    assert content["groups"] == {"held_out": ["A", "B"], "test": ["A", "B"], "unseen": ["C"]}
    assert content["num_bins"]["held_out"] == 2 * 2 * 20
    assert content["simulated"] is False


def test_what_is_lost_is_the_difference_of_accuracies(found):
    _, content = found
    whole = content["with_all"]["reselected"]["balanced_accuracy"]
    for steps in content["best"].values():
        for step in steps:
            for role, accuracy in step["balanced_accuracy"].items():
                assert step["lost"][role]["lost"] == pytest.approx(whole[role] - accuracy)
        assert steps[-1]["lost"]["unseen"]["lost"] == 0  # all of them are the whole hand
    fingers = {row["name"]: row["alone"] for row in content["units"] if row["unit"] == "finger"}
    first = content["best"]["finger"][0]
    assert fingers[first["joins"]] == first["balanced_accuracy"]
    assert first["balanced_accuracy"]["held_out"] == max(f["held_out"] for f in fingers.values())
    # two fingers: what is left without one is the other
    other = next(name for name in fingers if name != first["joins"])
    row = next(row for row in content["units"] if row["name"] == other)
    assert row["lost_reselected"]["test"]["lost"] == pytest.approx(
        whole["test"] - first["balanced_accuracy"]["test"]
    )


def test_csv_has_the_numbers_of_json(found):
    folder, content = found
    with (folder / "sensors.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row, of_json in zip(rows, content["units"], strict=True):
        assert row["name"] == of_json["name"]
        assert (
            float(row["lost_reselected_unseen_high"])
            == of_json["lost_reselected"]["unseen"]["high"]
        )
        assert float(row["alone_test"]) == of_json["alone"]["test"]
    joins = {row["name"]: row["joins_as"] for row in rows if row["unit"] == "channel"}
    assert joins[content["best"]["channel"][0]["joins"]] == "1"


def test_simulated_numbers_say_so(found, tmp_path):
    _, content = found
    for simulated in (True, False):
        content = content | {"simulated": simulated}
        assert ("SIMULATED" in sensors_table(content)) is simulated
        sensors_csv(content, tmp_path / "sensors.csv")
        assert (tmp_path / "sensors.csv").read_text().endswith(f"{simulated}\n")


def test_tables_name_every_unit_and_number_of_sensors(found):
    _, content = found
    table = sensors_table(content)
    assert all(f"\n{name} " in table for name in [*CHANNELS, "index", "thumb"])
    lines = best_table(content).splitlines()
    assert [line.split()[1] for line in lines if line[:1].isdigit()][:4] == [
        step["joins"] for step in content["best"]["channel"]
    ]


# Bins that are differentiated at -----------------------------------------------------------------


def test_raw_bins_are_training_bins_of_both_classes_with_their_context(run):
    trained = _trained(run / "detector.pt", None)
    raw, is_slip = draw_raw_bins(trained.maker, trained.fold, 24)
    assert raw.shape == (len(is_slip), 4, trained.detector.context_before + 125)
    assert int(is_slip.sum()) == len(is_slip) // 2 >= 12
    of_train = torch.cat(
        [trained.source.load(recording).samples for recording in trained.fold.having("train")], 1
    )
    starts = set(of_train[0].tolist())
    assert all(float(bin_[0, 0]) in starts for bin_ in raw)
    again, _ = draw_raw_bins(trained.maker, trained.fold, 24)
    assert torch.equal(raw, again)
    filtered = trained.detector.channel_filter.valid(raw.double())
    score = trained.detector(filtered)
    torch.testing.assert_close(trained.detector.score_raw(raw.double()), score)


# The figure --------------------------------------------------------------------------------------


def content_of(hand):
    generator = torch.Generator().manual_seed(0)

    def some():
        return float(torch.rand(1, generator=generator))

    def lost():
        middle = some() - 0.5
        return {"lost": middle, "low": middle - 0.1, "high": middle + 0.1}

    roles = ("held_out", "unseen")
    units = [
        {
            "unit": "channel",
            "name": name,
            "features_in_use": 2,
            "gradient": {"non_slip": some(), "slip": some()},
            "lost": {role: lost() for role in roles},
            "alone": {role: 0.5 + some() / 2 for role in roles},
        }
        for name in hand.names
    ]
    steps = [
        {
            "joins": name,
            "lost": {role: lost() for role in roles},
            "balanced_accuracy": {role: 0.5 + some() / 2 for role in roles},
        }
        for name in hand.names[:5]
    ]
    return {
        "simulated": True,
        "settings": {"reselect": "ranked"},
        "num_bins": dict.fromkeys(roles, 10),
        "channels": hand.to_rows(),
        "units": units,
        "with_all": {"reselected": {"balanced_accuracy": dict.fromkeys(roles, 0.9)}},
        "best": {"channel": steps},
    }


def biotac_like():
    return HandLayout.from_rows(
        [
            {"name": f"{f}{i}", "kind": kind, "finger": f, "segment": "pad", "adapting": adapting}
            for f in ("left", "right")
            for i, (kind, adapting) in enumerate(
                [("electrode", "slow")] * 19 + [("pressure", "slow"), ("vibration", "fast")]
            )
        ]
    )


@pytest.mark.parametrize("hand", [HandLayout.paper24(), biotac_like()])
def test_any_hand_can_be_drawn(hand, tmp_path):
    sensors_figure(content_of(hand), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        grey = torch.frombuffer(bytearray(image.convert("L").tobytes()), dtype=torch.uint8)
    assert 0.01 < float((grey < 250).double().mean()) < 0.6  # something is drawn on white


def test_fingers_stand_in_order_with_tips_up_and_the_thumb_leaning_out():
    rows = HandLayout.paper24().to_rows()
    fingers = _fingers(rows)
    assert [finger.name for finger in fingers] == ["little", "ring", "middle", "index", "thumb"]
    assert [finger.degrees < 0 for finger in fingers] == [False] * 4 + [True]
    names = [[row["name"] for row in segment] for segment in fingers[3].segments]
    assert names == [["SG10", "PVDF7"], ["SG11", "PVDF8"], ["SG12"]]
    assert len(set(kind_colours(row["kind"] for row in rows).values())) == 2


# The command -------------------------------------------------------------------------------------


def refused(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["importance", *SMALL, "cache=off", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    errors = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error")]
    assert len(errors) == 1
    return errors[0]


def test_bad_input_is_one_line(monkeypatch, capsys, run, tmp_path):
    here = f"hydra.run.dir={tmp_path / 'out'}"
    model = f"model={run / 'detector.pt'}"
    assert "no value for model" in refused(monkeypatch, capsys, here)
    assert "nothing.pt" in refused(monkeypatch, capsys, here, "model=nothing.pt")
    wrong = refused(monkeypatch, capsys, here, model, "bins=1")
    assert "bins must be a whole number of at least 2, got 1" in wrong
    wrong = refused(monkeypatch, capsys, here, model, "num_features=0")
    assert "num_features must be a positive whole number, got 0" in wrong
    wrong = refused(monkeypatch, capsys, here, model, "reselect=equal")
    assert "reselect must be ranked or shared, got 'equal'" in wrong


def moved(run, folder, *, change=None):
    """The detector of a run with its configuration beside it, changed; or none."""
    folder.mkdir(parents=True)
    shutil.copy(run / "detector.pt", folder)
    if change is not None:
        text = (run / "config.yaml").read_text()
        assert change[0] in text
        (folder / "config.yaml").write_text(text.replace(*change))
    return f"model={folder / 'detector.pt'}"


def test_a_detector_without_its_run_is_refused(monkeypatch, capsys, run, tmp_path):
    here = f"hydra.run.dir={tmp_path / 'out'}"
    alone = moved(run, tmp_path / "far" / "away")
    assert "no config.yaml beside" in refused(monkeypatch, capsys, here, alone)
    other = moved(run, tmp_path / "other", change=("seed: 0", "seed: 1"))
    wrong = refused(monkeypatch, capsys, here, other)
    assert "are not those that detector.pt was trained on" in wrong
    bare = moved(run, tmp_path / "bare", change=("recipe:", "recept:"))
    assert "has no recipe; give the config.yaml of a training" in refused(
        monkeypatch, capsys, here, bare
    )
    assert not Path(tmp_path / "out" / "sensors.json").exists()
