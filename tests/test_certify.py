"""``certify`` as a command: the files, the exit status, which bins it draws, what it refuses."""

import hashlib
import json
import re

import pytest
import torch
from drawing import assert_png
from hydra.utils import instantiate
from small_detector import small_detector
from test_commands import BAD_INPUT, TINY_DATA, TINY_SPLIT, TinyRecordings, composed

from tactslip_torch.analysis.raw_bins import draw_bins
from tactslip_torch.commands import certify as command
from tactslip_torch.commands.certify import certify
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.labels import LabelRule, label_bins
from tactslip_torch.deploy.check import EXTREMES
from tactslip_torch.features.cache import cache_key
from tactslip_torch.training.datamodule import FeatureMaker

TOLD = (*TINY_DATA, *TINY_SPLIT, "bins=60", "scored_bins=40", "extremes=3")


SOURCE = TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])


def saved(folder, **options):
    detector = small_detector(**options)
    known = {str(r): cache_key(SOURCE.key(r)) for r in SOURCE.ids if r.cycle == 0}
    detector.info["train_recordings"] = known
    folder.mkdir(exist_ok=True)
    detector.save(folder / "detector.pt")
    return folder / "detector.pt"


def test_the_files_stand_beside_the_detector_and_repeat(tmp_path):
    path = saved(tmp_path)
    content = certify(composed(*TOLD, f"model={path}", name="certify"))
    assert json.loads((tmp_path / "certificate.json").read_text()) == content
    assert_png(tmp_path / "certificate.png")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"certificate.json", "certificate.png", "detector.pt"}
    assert content["format"] == "tactslip_torch certificate 1"
    assert (content["holds"], content["simulated"]) == (True, False)
    assert content["detector"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    num_bins = {name: row["bins"] for name, row in content["sets"].items()}
    assert num_bins == {"calibration": 60, "test": 40, "unseen": 40}
    extremes = {name: row["bins"] for name, row in content["extremes"].items()}
    assert extremes == dict.fromkeys(EXTREMES, 3)
    known, unseen = (content["data"]["drawn"][name] for name in ("calibration", "unseen"))
    assert (known["role"], known["materials"]) == ("train", ["A", "B"])
    assert (unseen["recordings"], unseen["materials"]) == (1, ["C"])


# The bins it draws -----------------------------------------------------------------------------


def drawn(number, seed=0):
    config = composed(*TOLD, "model=x", name="certify")
    (fold,) = instantiate(config.split, _convert_="all")(SOURCE.ids)
    detector = small_detector()
    maker = FeatureMaker(SOURCE, detector.pool, detector.channel_filter, LabelRule())
    bins, _, recordings = draw_bins(maker, fold, "train", number, seed)
    return bins, recordings, fold


def keys_of(bins):
    return [one.float().contiguous().numpy().tobytes() for one in bins]


@pytest.mark.parametrize(("number", "num_recordings"), [(5, 1), (81, 3), (250, 4)])
def test_drawn_bins_are_those_of_the_role_with_their_context(number, num_recordings):
    bins, recordings, fold = drawn(number)
    assert len(recordings) == num_recordings
    known = {}
    for recording in fold.having("train"):
        times = SOURCE.timeline(recording)
        own = label_bins(LabelRule(), times.onsets_s, times.sliding_s, times.duration_s, 2000.0)
        samples = SOURCE.load(recording).samples
        cut = [samples[:, start - 25 : start + 125] for start in own.starts.tolist()]
        known |= dict.fromkeys(keys_of(cut), recording)
    assert {known[key] for key in keys_of(bins)} == set(recordings)
    assert len(set(keys_of(bins))) == len(bins) == number  # none twice
    assert {recording.material for recording in recordings} <= {"A", "B"}
    assert torch.equal(bins, drawn(number)[0])
    assert not torch.equal(bins, drawn(number, seed=4)[0])


# The command -----------------------------------------------------------------------------------


def test_the_exit_status_is_0_if_it_holds_and_1_if_not(typed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, _ = typed(command, *TOLD, f"model={saved(tmp_path)}", "evaluate=[]")
    assert status == 0
    assert out.startswith("Holds: ")
    assert "; no held-out bins were evaluated" in out
    assert str(tmp_path / "certificate.json") in out
    told = f"model={saved(tmp_path / 'b', gain=1e39)}", "evaluate=unseen", "extremes=1"
    status, out, err = typed(command, *TOLD, *told)
    assert (status, out) == (1, "")
    assert re.search(r"^Does not hold: error of the head.*certificate\.json$", err, re.MULTILINE)
    content = json.loads((tmp_path / "b" / "certificate.json").read_text())
    assert (content["holds"], list(content["sets"])) == (False, ["calibration", "unseen"])


REFUSED = [
    ("calibrate=all", "calibrate and evaluate must be different roles of train, test, unseen"),
    ("fold=other", "fold must be one of unseen4, got other"),
    ("+data.broken=A/0", "repair or leave out A/0"),
    ("out=taken", "taken is a file, out= must be a folder; give another"),
    ("out=foreign", "certificate.json is no certificate of ours; move it, or give another"),
    ("data.channels=3", "the features expect 4 channels SG1..PVDF2, the recordings have 3"),
    ("scored_bins=1.5", "scored_bins must be a positive whole number, got 1.5"),
]


@pytest.mark.parametrize(("override", "words"), REFUSED)
def test_bad_input_is_one_line_and_nothing_is_written(override, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("mine")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "certificate.json").write_text("mine")
    more = ["bins=200"] if "broken" in override else []
    with pytest.raises(BAD_INPUT) as caught:
        certify(composed(*TOLD, f"model={saved(tmp_path)}", *more, override, name="certify"))
    assert words in one_line(caught.value)
    assert (tmp_path / "foreign" / "certificate.json").read_text() == "mine"
    assert not list(tmp_path.glob("certificate*"))
