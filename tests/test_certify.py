"""``certify`` as a command: the files, the exit status, which bins it draws, what it refuses."""

import hashlib
import json
import sys

import pytest
import torch
from drawing import assert_png
from hydra.utils import instantiate
from small_detector import small_detector
from test_commands import BAD_INPUT, TinyRecordings, composed

from tactslip_torch.analysis.raw_bins import draw_bins
from tactslip_torch.commands.certify import certify, main
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.labels import LabelRule, label_bins
from tactslip_torch.deploy.check import EXTREMES
from tactslip_torch.features.cache import cache_key
from tactslip_torch.training.datamodule import FeatureMaker

TINY = (
    "data._target_=test_commands.TinyRecordings",
    "data.materials=[A,B,C]",
    "data.cycles=4",
    "split.seen=[A,B]",
    "split.unseen=[C]",
    "split.train_fraction=0.5",
    "bins=60",
    "scored_bins=40",
    "extremes=3",
)


def source():
    return TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])


def saved(folder, **options):
    detector = small_detector(**options)
    known = {str(r): cache_key(source().key(r)) for r in source().ids if r.cycle == 0}
    detector.info["train_recordings"] = known
    folder.mkdir(exist_ok=True)
    detector.save(folder / "detector.pt")
    return folder / "detector.pt"


def written(path, *overrides):
    content = certify(composed(*TINY, f"model={path}", *overrides, name="certify"))
    kept = json.loads((path.parent / "certificate.json").read_text())
    assert content == kept
    return content


def test_the_files_stand_beside_the_detector_and_repeat(tmp_path):
    path = saved(tmp_path)
    content = written(path)
    assert_png(tmp_path / "certificate.png")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"certificate.json", "certificate.png", "detector.pt"}
    assert content["format"] == "tactslip_torch certificate 1"
    assert (content["holds"], content["simulated"]) == (True, False)
    assert content["detector"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    num_bins = {name: row["bins"] for name, row in content["sets"].items()}
    assert num_bins == {"calibration": 60, "test": 40, "unseen": 40}
    assert {name: row["bins"] for name, row in content["extremes"].items()} == dict.fromkeys(
        EXTREMES, 3
    )
    drawn = content["data"]["drawn"]
    assert (drawn["calibration"]["role"], drawn["calibration"]["materials"]) == (
        "train",
        ["A", "B"],
    )
    assert (drawn["unseen"]["recordings"], drawn["unseen"]["materials"]) == (1, ["C"])


# The bins it draws -----------------------------------------------------------------------------


def drawn(number, role="train", seed=0, fold=None):
    config = composed(*TINY, "model=x", name="certify")
    fold = fold or instantiate(config.split, _convert_="all")(source().ids)[0]
    detector = small_detector()
    maker = FeatureMaker(source(), detector.pool, detector.channel_filter, LabelRule())
    bins, _, recordings = draw_bins(maker, fold, role, number, seed)
    return bins, recordings, fold


def keys_of(bins):
    return [one.float().contiguous().numpy().tobytes() for one in bins]


@pytest.mark.parametrize(("number", "num_recordings"), [(5, 1), (81, 3), (250, 4)])
def test_drawn_bins_are_those_of_the_role_with_their_context(number, num_recordings):
    bins, recordings, fold = drawn(number)
    assert len(recordings) == num_recordings
    known = {}
    for recording in fold.having("train"):
        times = source().timeline(recording)
        own = label_bins(LabelRule(), times.onsets_s, times.sliding_s, times.duration_s, 2000.0)
        samples = source().load(recording).samples
        cut = [samples[:, start - 25 : start + 125] for start in own.starts.tolist()]
        known |= dict.fromkeys(keys_of(cut), recording)
    assert {known[key] for key in keys_of(bins)} == set(recordings)
    assert len(set(keys_of(bins))) == len(bins) == number  # none twice
    assert {recording.material for recording in recordings} <= {"A", "B"}
    assert torch.equal(bins, drawn(number)[0])
    assert not torch.equal(bins, drawn(number, seed=4)[0])


# The command -----------------------------------------------------------------------------------


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Exit status, output and the lines on standard error that say how it went."""
    monkeypatch.chdir(tmp_path)

    def running(*arguments):
        monkeypatch.setattr(sys, "argv", ["certify", *TINY, *map(str, arguments)])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = stop.code
        done = capsys.readouterr()
        lines = [x for x in done.err.splitlines() if x.startswith(("error", "Does not hold"))]
        return status, done.out, lines

    return running


def test_the_exit_status_is_0_if_it_holds_and_1_if_not(run, tmp_path):
    status, out, lines = run(f"model={saved(tmp_path)}", "evaluate=[]")
    assert (status, lines) == (0, [])
    assert out.startswith("Holds: ")
    assert "; no held-out bins were evaluated" in out
    assert str(tmp_path / "certificate.json") in out
    model = saved(tmp_path / "b", gain=1e39)
    status, out, (line,) = run(f"model={model}", "evaluate=unseen", "extremes=1")
    assert (status, out) == (1, "")
    assert line.startswith("Does not hold: error of the head")
    assert line.endswith("certificate.json")
    content = json.loads((tmp_path / "b" / "certificate.json").read_text())
    assert (content["holds"], list(content["sets"])) == (False, ["calibration", "unseen"])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("calibrate=all", "calibrate and evaluate must be different roles of train, test, unseen"),
        ("fold=other", "fold must be one of unseen4, got other"),
        ("+data.broken=A/0", "repair or leave out A/0"),
        ("out=taken", "taken is a file, out= must be a folder; give another"),
        ("out=foreign", "certificate.json is no certificate of ours; move it, or give another"),
        ("data.channels=3", "the features expect 4 channels SG1..PVDF2, the recordings have 3"),
        ("scored_bins=1.5", "scored_bins must be a positive whole number, got 1.5"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(override, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("mine")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "certificate.json").write_text("mine")
    more = ["bins=200"] if "broken" in override else []
    with pytest.raises(BAD_INPUT) as caught:
        certify(composed(*TINY, f"model={saved(tmp_path)}", *more, override, name="certify"))
    assert words in one_line(caught.value)
    assert (tmp_path / "foreign" / "certificate.json").read_text() == "mine"
    assert not list(tmp_path.glob("certificate*"))
