"""``certify`` as a command: what it refuses, in one line and before it works for minutes."""

import pytest
from test_certify import composed, run, saved

from tactslip_torch.commands.certify import certify


@pytest.mark.parametrize("name", ["certificate.json"])
def test_a_foreign_file_is_left_alone(name, tmp_path):
    path = saved(tmp_path)
    (tmp_path / name).write_text("mine")
    with pytest.raises(ValueError, match=f"{name} is no certificate of ours; move it, or give"):
        certify(composed(f"model={path}"))
    assert (tmp_path / name).read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("model=missing.pt", "no detector at missing.pt"),
        ("calibrate=all", "calibrate and judge must be different roles of train, test, unseen"),
        ("judge=[train]", "got calibrate=train judge=[train]"),
        ("bins=0", "bins must be a whole number from 1 on, below 2^63, got 0"),
        ("judged_bins=-1", "judged_bins must be a whole number from 1 on, below 2^63, got -1"),
        ("extremes=0", "extremes must be a whole number from 1 on, below 2^63, got 0"),
        ("fold=other", "fold must be one of unseen4, got other"),
        ("data.channels=3", "the features expect 4 channels SG1..PVDF2, the recordings have 3"),
        ("+scene.broken=A/0", "repair or leave out A/0"),
    ],
)
def test_bad_input_is_one_line(override, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    more = ["bins=200"] if "broken" in override else []
    arguments = [f"model={saved(tmp_path)}", *more, override]
    status, out, lines = run(monkeypatch, capsys, *arguments)
    assert (status, out) == (2, "")
    assert len(lines) == 1
    assert line in lines[0]
    assert not list(tmp_path.glob("certificate*"))


def unread(*_):
    raise AssertionError("work has begun")


@pytest.mark.parametrize("value", ["abc", "1.5", "true", "null", "[2]", str(2**63)])
@pytest.mark.parametrize("name", ["bins", "judged_bins", "extremes", "seed"])
def test_what_is_no_number_is_refused_before_any_work(name, value, monkeypatch, capsys):
    monkeypatch.setattr("tactslip_torch.commands.certify.SlipDetector.load", unread)
    status, out, lines = run(monkeypatch, capsys, "model=any.pt", f"{name}={value}")
    assert (status, out) == (2, "")
    (line,) = lines
    assert line.startswith(f"error: {name} must be a whole number from ")


def test_a_negative_seed_is_refused(monkeypatch, capsys):
    status, _, lines = run(monkeypatch, capsys, "model=any.pt", "seed=-1")
    assert (status, lines) == (
        2,
        ["error: seed must be a whole number from 0 on, below 2^63, got -1"],
    )


@pytest.mark.parametrize("below", ["", "deeper"])
def test_a_file_in_the_place_of_the_folder_is_refused_at_once(below, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tactslip_torch.commands.certify.measure", unread)
    model, taken = saved(tmp_path), tmp_path / "taken"
    taken.write_text("mine")
    arguments = (f"model={model}", f"out={taken / below}")
    status, out, lines = run(monkeypatch, capsys, *arguments)
    assert (status, out) == (2, "")
    assert lines == [f"error: {taken} is a file, out= must be a folder; give another"]
    assert taken.read_text() == "mine"
