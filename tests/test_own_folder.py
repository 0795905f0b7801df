"""A folder of one's own as the first argument: what is read, left out, trained on and kept."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from contract.recordings import CHANNELS, HELD_OUT, SEEN, TRIALS
from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate

from tactslip_torch import HandLayout, SlipDetector
from tactslip_torch.commands.configuration import checked
from tactslip_torch.data.file_recordings import hand_file
from tactslip_torch.data.formats import Reading
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import everything, leave_groups_out
from tactslip_torch.training.datamodule import _grouping

HAND = {
    "data": {"channels": CHANNELS, "reading": {"time": "time", "gaps": "missing"}},
    "features": {"level": 3},
    "split": {"by": "material", "folds": 2},
}


@pytest.fixture
def folder(recordings, tmp_path):
    own = shutil.copytree(recordings, tmp_path / "my hand")
    (own / "hand.yaml").write_text(yaml.safe_dump(HAND))
    return own


def test_keys_of_the_command_line_win_over_the_file_of_the_hand(folder):
    config = checked("train", [str(folder), "features.level=2"]).config
    assert config.data.root == str(folder)
    assert config.data.reading.gaps == "missing"
    assert config.features.level == 2
    assert (config.split.by, config.train_on_all, config.name) == ("material", True, "my_hand")


@pytest.mark.parametrize("command", ["evaluate", "data"])
def test_other_commands_read_as_the_file_of_the_hand_says(folder, command):
    model = ["model=x.pt"] if command == "evaluate" else []
    config = checked(command, [str(folder), *model]).config
    assert config.data.reading.time == "time"
    assert config.data.root == str(folder)
    assert config.get("action", "check") == "check"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("data: {reding: {time: 0}}", "hand.yaml data.reding data.reading"),
        ("recipe: {name: x}", "hand.yaml sections recipe"),
        ("data: [1, 2]", "hand.yaml data KEY"),
        ("data: {_target_: os.system}", "hand.yaml _target_"),
        ("a: [", "hand.yaml YAML"),
    ],
)
def test_a_wrong_file_of_the_hand_is_named_with_its_key(folder, text, words):
    (folder / "hand.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"hand\.yaml") as raised:
        checked("train", [str(folder)])
    assert not [word for word in words.split() if word not in str(raised.value)], raised.value


def test_a_folder_of_which_nothing_is_known_asks_for_setup(folder):
    for name in ("hand.yaml", "manifest.csv"):
        (folder / name).unlink()
    with pytest.raises(ValueError, match=r"tactslip setup '.*my hand'"):
        checked("train", [str(folder)])
    with pytest.raises(ValueError, match="no folder at"):
        checked("train", [str(folder / "none")])


def test_a_detector_of_a_manifest_reads_a_folder_without_one(folder, monkeypatch):
    for name in ("hand.yaml", "manifest.csv"):
        (folder / name).unlink()
    (folder / "slips.csv").write_text("\nfile,start,end\nA_1,1,2\n")  # is no recording
    model = folder / "detector.pt"
    model.touch()
    known = SimpleNamespace(info={"data": {"channels": CHANNELS}})
    monkeypatch.setattr(SlipDetector, "load", lambda path: known)
    config = checked("calibrate", [str(folder), f"model={model}", "slip_free=true"]).config
    source = instantiate(config.data, _convert_="all")
    assert len(source.ids) == len(TRIALS) * len({*SEEN, *HELD_OUT})
    assert {one.material for one in source.ids} == {*SEEN, *HELD_OUT}
    assert not any(source.timeline(one).has_stretches for one in source.ids)


def test_a_second_folder_or_file_is_refused(folder):
    with pytest.raises(ValueError, match=r"detect takes one folder or file, and .*my hand"):
        checked("detect", [str(folder / "A_1.csv"), str(folder), "model=x.pt"])


def test_evaluate_takes_no_simulated_hand_by_itself(command, general, tmp_path):
    ran = command(tmp_path, "evaluate", f"model={general.file}")
    assert ran.status == 2
    assert "data.root" in ran.err


def test_an_alarm_of_simulated_recordings_is_no_alarm_of_a_folder(command, folder, tmp_path):
    ran = command(tmp_path, "train", str(folder), "onset=alarms", "cache=off")
    assert ran.status == 2
    assert "tactslip calibrate" in ran.err
    assert not list(tmp_path.rglob("metrics.json"))


def test_the_detector_of_a_folder_is_trained_on_all_and_reads_as_in_training(
    command, folder, tmp_path
):
    quick = ["cache=off", "num_workers=0", "baselines=false", "export=false", "recipe=paper"]
    recipe = ["recipe.num_features=12", "recipe.penalties=[0.01,0.1]", "hydra.run.dir=run"]
    out = command.well(tmp_path, "train", str(folder), *quick, *recipe)
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    number = len(TRIALS) * len({*SEEN, *HELD_OUT})
    bins = sum(map(sum, metrics["splits"]["unseen"]["confusion"]))
    of_folds = [f["splits"]["unseen"]["num_bins"] for f in metrics["folds"].values()]
    assert bins == sum(of_folds) > 0
    assert metrics["num_recordings"] == number
    detector = SlipDetector.load(tmp_path / "run/detector.pt")
    assert len(detector.info["train_recordings"]) == number
    assert detector.info["reading"]["time"] == "time"
    assert "trained on all 12 recordings" in out
    # A new folder of which only the detector knows how it is read
    new = tmp_path / "new"
    new.mkdir()
    text = (folder / "A_1.csv").read_text().replace("time,", "seconds,")
    (new / "A_1.csv").write_text(text)
    ran = command(tmp_path, "detect", str(new), "model=run/detector.pt", "threshold=0")
    assert ran.status == 2  # its column of times is called otherwise than in training
    assert "time" in ran.err
    words = ["reading.time=seconds", "threshold=0", "figure=none"]
    ran = command(tmp_path, "detect", str(new), "model=run/detector.pt", *words)
    assert "note: reading.time=seconds; in training it was time" in ran.err


# Splits ------------------------------------------------------------------------------------------


def recordings_of(numbers):
    return [RecordingId(name, cycle) for name, number in numbers.items() for cycle in range(number)]


def test_each_recording_is_left_out_once_with_all_of_its_group():
    ids = recordings_of({"cup": 5, "box": 3, "ball": 4, "pen": 1, "can": 2})
    folds = leave_groups_out(ids, folds=3)
    away = [set(fold.having("unseen")) for fold in folds]
    assert sorted(r for fold in away for r in fold) == sorted(ids)
    for fold, left_out in zip(folds, away, strict=True):
        assert set(fold.having("train")) == set(ids) - left_out
        materials = {r.material for r in left_out}
        assert materials.isdisjoint(r.material for r in fold.having("train"))
    assert sorted(map(len, away)) == [5, 5, 5]


def test_of_two_objects_recordings_are_left_out():
    folds = leave_groups_out(recordings_of({"cup": 6, "box": 6}), folds=3)
    for fold in folds:
        left_out = fold.having("test")
        assert sorted(r.material for r in left_out) == ["box", "box", "cup", "cup"]


def test_a_group_for_each_of_few_folds_gives_its_name():
    names = [fold.name for fold in leave_groups_out(recordings_of({"a": 2, "b": 2, "c": 2}))]
    assert names == ["without_a", "without_b", "without_c"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"by": "object"}, "split.by must be one of material"),
        ({"by": "session"}, "split.by=session leaves groups out and needs two"),
        ({"folds": 1}, "split.folds must be a whole number of at least 2"),
    ],
)
def test_groups_that_cannot_be_left_out_are_refused_by_the_key(options, words):
    with pytest.raises(ValueError, match=words):
        leave_groups_out(recordings_of({"a": 3, "b": 3}), **options)


def test_everything_has_one_role():
    ids = recordings_of({"a": 3})
    (fold,) = everything(ids)
    assert fold.having("test") == ids
    with pytest.raises(ValueError, match=r"split\.role"):
        everything(ids, role="held")


def teardown_module():
    ConfigStore.instance().repo.pop("own", None)


@pytest.mark.parametrize(
    ("sessions", "expected"),
    [(["", ""], {"cup/0", "cup/1"}), (["", "2"], {"session 1", "session 2"})],
)
def test_of_one_object_validation_leaves_out_sessions_or_recordings(sessions, expected):
    ids = [RecordingId("cup", cycle, session=session) for cycle, session in enumerate(sessions)]
    (fold,) = everything([r for r in ids if not r.session] + ids[1:], role="train")
    group = _grouping(fold.having("train"))
    assert {group(r).replace("@2", "") for r in ids} == expected
    assert _grouping([*ids, RecordingId("box", 0)])(ids[0]) == "cup"


def test_a_file_of_another_rate_is_resampled_as_in_training_or_refused_by_the_key(tmp_path):
    hand, rate_hz = HandLayout.from_rows([{"name": "a", "kind": "SG"}]), 24.0
    time_s = np.arange(96) / rate_hz
    table = np.column_stack([time_s, np.sin(2 * np.pi * time_s)])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="time,a", comments="")
    with hand_file(tmp_path / "a.csv", hand, 48.0, Reading(resample_hz=48.0), "V") as opened:
        found = opened.samples.read(0, opened.samples.num_samples)[0].numpy()
    assert len(found) == 192
    wanted = np.sin(2 * np.pi * np.arange(192) / 48)
    assert np.abs(found - wanted)[24:-24].max() < 0.01
    refused = pytest.raises(ValueError, match=r"24 Hz, .* of 48 Hz; set .*reading\.resample_hz=48")
    with refused, hand_file(tmp_path / "a.csv", hand, 48.0, Reading(), "V"):
        pass
