"""``certify`` as a command: the files, the exit status, and which bins it draws."""

import hashlib
import json
import sys

import pytest
from hydra import compose, initialize_config_dir
from small_detector import raw_bins, small_detector
from test_commands import TinyRecordings

from tactslip_torch.analysis.certificate import certify as measure
from tactslip_torch.commands.certify import _plain, certify, main
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.features.cache import cache_key
from tactslip_torch.report.certificate import certificate_figure, number, verdict
from tactslip_torch.simulation.extremes import EXTREMES

TINY = (
    "data._target_=test_commands.TinyRecordings",
    "data.materials=[A,B,C]",
    "data.cycles=4",
    "split.seen=[A,B]",
    "split.unseen=[C]",
    "split.train_share=0.5",
    "bins=60",
    "judged_bins=40",
    "extremes=3",
)


def composed(*overrides):
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        return compose("certify", [*TINY, *overrides])


def source():
    return TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])


def saved(folder, **options):
    path = folder / "detector.pt"
    detector = small_detector(**options)
    recordings = [r for r in source().ids if str(r) in ("A/0", "B/1", "C/2")]
    known = {str(r): cache_key(source().key(r)) for r in recordings}
    detector.info["train_recordings"] = known
    detector.save(path)
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = saved(tmp_path_factory.mktemp("certified"))
    returned, folder = certify(composed(f"model={path}"))
    content = json.loads((folder / "certificate.json").read_text())
    assert returned == content
    return folder, content


# What it leaves ----------------------------------------------------------------------------------


def test_the_files_stand_beside_the_detector(written):
    folder, content = written
    assert sorted(path.name for path in folder.iterdir()) == [
        "certificate.json",
        "certificate.png",
        "detector.pt",
    ]
    assert content["format"] == "tactslip_torch certificate 1"
    assert content["holds"] is True
    assert content["simulated"] is False
    digest = hashlib.sha256((folder / "detector.pt").read_bytes()).hexdigest()
    assert content["detector"]["sha256"] == digest
    assert list(content["sets"]) == ["calibration", "test", "unseen"]
    assert [row["bins"] for row in content["sets"].values()] == [60, 40, 40]
    assert list(content["extremes"]) == list(EXTREMES)
    assert {row["bins"] for row in content["extremes"].values()} == {3}
    drawn = content["data"]["drawn"]
    assert drawn["calibration"]["role"] == "train"
    assert drawn["calibration"]["materials"] == ["A", "B"]
    assert drawn["unseen"] == {
        "role": "unseen",
        "recordings": 1,
        "recordings_of_training": drawn["unseen"]["recordings_of_training"],
        "materials": ["C"],
    }


def test_a_second_run_replaces_the_first_and_finds_the_same(tmp_path):
    path = saved(tmp_path)
    _, folder = certify(composed(f"model={path}", f"out={tmp_path / 'out'}"))
    before = (folder / "certificate.json").read_text()
    certify(composed(f"model={path}", f"out={tmp_path / 'out'}"))
    assert (folder / "certificate.json").read_text() == before
    assert sorted(p.name for p in folder.iterdir()) == ["certificate.json", "certificate.png"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "Holds: float32 decides as float64 does where |score| exceeds"),
        ({"head": "sum"}, "as measured: this head has no bound"),
        (
            {"gain": 1e39},
            "Does not hold: error of the head, worst seen is not finite, wanted <= inf, its bound",
        ),
    ],
)
def test_every_outcome_has_a_verdict_and_a_figure(options, words, written):
    detector = small_detector(**options)
    found = measure(detector, raw_bins(30), simulated=True, extremes=2)
    rest = {k: v for k, v in written[1].items() if k in ("detector", "data", "versions")}
    content = _plain(found.facts() | rest)
    assert words in verdict(content)
    points = {
        name: (c.exact.abs().tolist(), c.error.tolist(), c.flips.tolist())
        for name, c in found.sets.items()
    }
    assert certificate_figure(content, points).axes
    recorded = content | {"simulated": False}
    assert ["(simulated data)" in verdict(of) for of in (content, recorded)] == [True, False]
    json.dumps(content, allow_nan=False)


def test_numbers_are_short():
    shown = [number(v) for v in (1.23456e-7, 0.0, 0.25, 12345.6, 7, None, "words")]
    assert shown == ["1.2e-07", "0", "0.25", "1.2e+04", "7", "-", "words"]


# The command -------------------------------------------------------------------------------------


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["certify", *TINY, *arguments])
    status = 0
    try:
        main()
    except SystemExit as stop:
        status = stop.code
    done = capsys.readouterr()
    lines = [x for x in done.err.splitlines() if x.startswith(("error", "Does not hold"))]
    return status, done.out, lines


def test_the_exit_status_is_0_if_it_holds_and_1_if_not(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    model = f"model={saved(tmp_path)}"
    status, out, lines = run(monkeypatch, capsys, model)
    assert (status, lines) == (0, [])
    assert out.startswith("Holds: ")
    assert "no held-out" not in out
    assert str(tmp_path / "certificate.json") in out
    (tmp_path / "b").mkdir()
    model = f"model={saved(tmp_path / 'b', gain=1e39)}"
    status, out, lines = run(monkeypatch, capsys, model)
    assert status == 1
    assert out == ""
    (line,) = lines
    assert line.startswith("Does not hold: error of the head")
    assert line.endswith("certificate.json")
    assert json.loads((tmp_path / "b" / "certificate.json").read_text())["holds"] is False
    assert (tmp_path / "b" / "certificate.png").is_file()


def test_nothing_judged_is_told(tmp_path, monkeypatch, capsys):
    model = f"model={saved(tmp_path)}"
    status, out, lines = run(monkeypatch, capsys, model, "judge=[]")
    assert (status, lines) == (0, [])
    assert "; no held-out bins were evaluated" in out


def test_one_judged_role_may_be_named_alone(tmp_path):
    path = saved(tmp_path)
    _, folder = certify(composed(f"model={path}", "judge=unseen"))
    content = json.loads((folder / "certificate.json").read_text())
    assert list(content["sets"]) == ["calibration", "unseen"]
