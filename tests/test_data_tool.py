"""The command for sets of files: what it lists, prints, draws and writes."""

import csv
import re

import pytest
import torch
from contract.names import settings
from PIL import Image
from test_commands import composed
from test_datasets import HAND, broken, manifest, ours, samples, table

from tactslip_torch.commands import data
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.folder import guessed, write_template
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.report import style
from tactslip_torch.signals.filtering import ChannelFilter, frame_lengths
from tactslip_torch.training.datamodule import FeatureMaker


def run(action, root, *overrides):
    """What an action returns."""
    if action == "check" and not any(one.startswith("output=") for one in overrides):
        overrides = (*overrides, f"output={root / 'check.png'}")
    config = composed(f"action={action}", f"root={root}", "num_workers=0", *overrides, name="data")
    return data.ACTIONS[action](config)


@pytest.fixture
def root(tmp_path):
    """Four recordings: two of ours, two tables."""
    folder, names = tmp_path / "set", ("t", *HAND.names)
    folder.mkdir()
    ours(folder / "a.npz")
    ours(folder / "b.csv", samples(1, dtype=torch.float32))
    table(folder / "c.csv", samples(2), names=names)
    table(folder / "day 2" / "d.csv", samples(3), names=names)
    told = "a.npz,wood,0,,,", "b.csv,wood,1,1.5,1.5-2.0,", "c.csv,iron,0,,,slip"
    manifest(folder, *told, "day 2/d.csv,iron,1,,,non-slip")
    return folder


(ROWS,) = settings(channels=HAND.to_rows())


# check ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "said"), [(100.0, "are 5 samples at 100 Hz"), (200.0, "")])
def test_check_says_where_a_bin_has_few_samples(tmp_path, capsys, rate, said):
    table(tmp_path / "a.csv", samples(0), rate)
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    assert run("check", tmp_path) == 0
    out = capsys.readouterr().out
    assert said in out
    assert ("train with labels.bin_ms=80 or more" in out) == bool(said)


def test_check_lists_every_problem_and_warning(tmp_path, capsys):
    expected = broken(tmp_path)
    flat = samples(0)
    flat[1] = 2.5
    table(tmp_path / "0.csv", flat)
    assert run("check", tmp_path) == len(expected)
    lines = capsys.readouterr().out.splitlines()
    for line, (place, what) in zip(lines, expected, strict=False):
        assert line.startswith(f"problem: {place}: ")
        assert what in line
    said = "warning: manifest.csv:2: 0.csv: b never changes, it is 2.5 throughout"
    assert lines[len(expected) : len(expected) + 2] == [said, "channels: a, b, c"]
    counts = "6 problems, 1 warning"
    assert lines[-1] == f"3 recordings of 2 materials, 9.0 s, 3 channels at 200 Hz in V: {counts}"


@pytest.mark.parametrize("gaps", ["refuse", "missing"])
def test_check_and_train_say_the_same_of_samples_that_are_not_finite(tmp_path, capsys, gaps):
    content = samples(0)
    content[2, 330:340] = torch.nan
    table(tmp_path / "a.csv", content)
    manifest(tmp_path, "a.csv,wood,0,1.5,1.5-2.5,")
    assert run("check", tmp_path, f"data.reading.gaps={gaps}") == (gaps == "refuse")
    line = capsys.readouterr().out.splitlines()[0]
    assert "manifest.csv:2: a.csv: c is not finite in 10 samples, first at 1.6500 s" in line
    if gaps == "refuse":
        with pytest.raises(ValueError, match=r"data\.reading\.gaps=missing") as said:
            FileRecordings(tmp_path)  # as train makes it
        assert line.removeprefix("problem: ") in str(said.value)


USES = "file,material,slip_s,non_slip_s,missing_s"


def colours(path):
    """How many pixels of a picture have each of the colours of stretches."""
    with Image.open(path) as image:
        counts = {colour: num for num, colour in image.convert("RGB").getcolors(1 << 24)}
    drawn = [style.VERMILION, style.BLUE, "#D9D9D9", style.INK]
    return [counts.get(tuple(bytes.fromhex(one[1:])), 0) for one in drawn]


def test_check_tells_and_draws_what_training_would_use_of_each_file(tmp_path, capsys):
    """Bins of 10 samples; 2.00 to 2.01 s is slip in a bin that needs missing samples."""
    for place in range(3):
        table(tmp_path / f"{place}.csv", samples(place))
    lines = "0.csv,wood,1.5-2.5,0-1.02,2.01-2.1", "1.csv,wood,0-end,,", "2.csv,wood,,,"
    manifest(tmp_path, *lines, columns=USES)
    assert run("check", tmp_path) == 0
    out = capsys.readouterr().out
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines() if line}
    assert rows["0.csv"] == ["3.00", "18", "20", "0.98", "0.09", "0.01", "0.02"]
    assert rows["1.csv"] == ["3.00", "60", "0", "-", "-", "-", "-"]
    assert rows["2.csv"] == ["3.00", "0", "0", "3.00", "-", "-", "-"]
    assert rows["all"] == ["3", "9.00", "78", "20", "3.98", "0.09", "0.01", "0.02"]
    slip, rest, no_label, missing = colours(tmp_path / "check.png")
    assert slip > 3 * rest > 0  # 3.9 s and 1 s
    assert no_label > 3 * rest
    assert 0 < missing < rest


def test_check_lays_the_bins_that_training_lays(tmp_path, capsys):
    """By the same labels and filters: a frame of 21 samples needs 10 more on either side."""
    names = ("t", *HAND.names)
    table(tmp_path / "a.csv", samples(0), names=names)
    manifest(tmp_path, "a.csv,wood,,0-end,1-1.05", columns=USES)
    frames = "features.frames={SG: 21, PVDF: null}"
    assert run("check", tmp_path, ROWS, frames, "labels.bin_ms=100", "labels.hop_ms=50") == 0
    source = FileRecordings(tmp_path, channels=HAND.to_rows())
    smooth = ChannelFilter(frame_lengths(HAND, {"SG": 21, "PVDF": None}), 1, "centred")
    rule = LabelRule(bin_ms=100.0, hop_ms=50.0)
    pool = FeaturePool(HAND, sample_rate_hz=200.0, bin_samples=20, level=1)
    bins = FeatureMaker(source, pool, smooth, rule).lay_bins(source.timeline(source.ids[0]))
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("a.csv"))
    assert row.split()[2:4] == ["0", str(len(bins.starts))]
    assert 50 < len(bins.starts) < 59


def test_a_table_and_a_picture_of_many_files_show_the_first(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(data, "_MOST_ROWS", 2)
    for place in range(4):
        table(tmp_path / f"{place}.csv", samples(place))
    whole = [f"{place}.csv,wood,0-end,," for place in (0, 1)]
    manifest(tmp_path, *whole, "2.csv,wood,,0-end,", "3.csv,wood,,0-end,", columns=USES)
    assert run("check", tmp_path) == 0
    out = capsys.readouterr().out
    assert "all 4, 2 of them not shown" in out
    assert "1.csv" in out
    assert "2.csv" not in out
    assert colours(tmp_path / "check.png")[1] == 0  # no file of non-slip is drawn


def test_bins_that_cannot_be_are_told_by_check(tmp_path, capsys):
    table(tmp_path / "a.csv", samples(0))
    manifest(tmp_path, "a.csv,wood,0,,,slip")
    assert run("check", tmp_path, "labels.bin_ms=51") == 0
    assert "bins: labels.bin_ms=51 is 10.2 samples at 200 Hz; choose" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("output={root}/c.csv", r"output of action=check must be a picture, FILE\.png, got"),
        ("features.frames=null", "features.frames must be of kinds, such as"),
        ("samples=no", "samples must be true or false, got 'no'"),
    ],
)
def test_what_check_cannot_do_is_refused_and_replaces_nothing(root, override, said):
    before = (root / "c.csv").read_bytes()
    with pytest.raises(ValueError, match=said):
        run("check", root, ROWS, override.format(root=root))
    assert (root / "c.csv").read_bytes() == before


def test_a_file_that_is_damaged_in_its_samples_is_a_problem(root, capsys, monkeypatch):
    assert run("check", root, ROWS) == 0
    assert "4 recordings of 2 materials, 12.0 s, 3 channels at 200" in capsys.readouterr().out

    def fails(source, recording, windows=None):
        raise ValueError("the block at byte 7 is damaged")

    monkeypatch.setattr(FileRecordings, "load", fails)
    assert run("check", root, ROWS) == 4
    assert "problem: manifest.csv:5: day 2/d.csv: the block" in capsys.readouterr().out
    assert run("check", root, ROWS, "samples=false") == 0


# convert -------------------------------------------------------------------------------------


def converted(root, out, *overrides):
    return [one.made for one in run("convert", root, ROWS, "to=npz", f"output={out}", *overrides)]


def test_what_was_finished_is_kept_and_what_changed_is_made_again(root, tmp_path):
    out = tmp_path / "out"
    assert converted(root, out) == [True] * 4
    stamps = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    (root / "a.npz").touch()  # the same content
    assert converted(root, out) == [False] * 4
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    (out / "c.npz").unlink()
    table(root / "day 2" / "d.csv", samples(9), names=("t", *HAND.names))
    text = (root / "manifest.csv").read_text()
    (root / "manifest.csv").write_text(text.replace("1.5-2.0", "1.5-1.75"))
    assert converted(root, out) == [False, True, True, True]
    assert converted(root, out, "data.reading.tare_s=[0,1]") == [True] * 4


def test_the_first_that_fails_stops_it_or_is_left_out_on_request(
    root, tmp_path, monkeypatch, capsys
):
    out, whole = tmp_path / "out", FileRecordings.load

    def fails(self, recording, windows=None):
        if str(recording) == "iron/0":
            raise ValueError("it is damaged at byte 7")
        return whole(self, recording, windows)

    monkeypatch.setattr(FileRecordings, "load", fails)
    with pytest.raises(ValueError, match=r"manifest\.csv:4: c\.csv: it is damaged .* are kept in"):
        converted(root, out)
    assert sorted(path.name for path in out.rglob("*.*")) == ["a.npz", "b.npz"]
    content = (root / "b.csv").read_bytes()
    (root / "b.csv").write_text("no table\n")
    assert converted(root, out, "skip_failed=true") == [False, True]
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("left out")]
    assert said[0].startswith("left out: manifest.csv:3: b.csv: ")
    assert said[1:] == ["left out: manifest.csv:4: c.csv: it is damaged at byte 7"]
    assert files_in(out / "manifest.csv") == ["a.npz", "day 2/d.npz"]
    (root / "b.csv").write_bytes(content)
    monkeypatch.setattr(FileRecordings, "load", whole)
    assert converted(root, out) == [False, False, True, False]


def files_in(path):
    with path.open(newline="") as file:
        return [line["file"] for line in csv.DictReader(file)]


NO_CONVERSIONS = [
    (["to=npz"], "no value for output; give to=FORMAT and output=FOLDER"),
    (["to=doc", "output=out"], "format must be one of .* got 'doc'"),
    (["to=npz", "output={root}/../set"], "output must be another folder than root"),
    (["to=npz", "output={root}/out"], "output must not lie in root"),
    (["to=npz", "output={there}/a.npz"], "output must be a folder, and .* is a file"),
    (["to=npz", "output={labelled}"], r"manifest\.csv is of recordings of your own"),
    (["to=npz", "output=out", "skip_failed=no"], "skip_failed must be true or false, got 'no'"),
    (["to=npz", "output={there}"], r"a\.npz .*; move it away, or give another output"),
    (
        ["data=simulated", "to=npz", "output=out"],
        "data must be a set of files, such as",
    ),
]


@pytest.mark.parametrize(("overrides", "line"), NO_CONVERSIONS)
def test_a_conversion_that_cannot_be_is_refused_before_any_work(root, tmp_path, overrides, line):
    there, labelled = tmp_path / "there", tmp_path / "labelled"
    there.mkdir()
    labelled.mkdir()
    (there / "a.npz").write_text("a letter")
    (labelled / "manifest.csv").write_text("file,material,onsets_s\n")
    given = [one.format(root=root, there=there, labelled=labelled) for one in overrides]
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=line):
        run("convert", root, ROWS, *given)
    assert sorted(tmp_path.rglob("*")) == before
    assert (there / "a.npz").read_text() == "a letter"


def test_two_files_that_would_become_one_are_refused(root, tmp_path):
    ours(root / "c.npz")
    with (root / "manifest.csv").open("a") as file:
        file.write("c.npz,wood,5,,,\n")
    with pytest.raises(ValueError, match=r"would both become c\.h5"):
        run("convert", root, ROWS, "to=h5", f"output={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()


# label_template ------------------------------------------------------------------------------


def test_a_template_lists_every_recording_with_what_names_tell(tmp_path, capsys):
    for name in ("wood_1.csv", "oil paper-slip_07.csv", "day 2/x.csv"):
        table(tmp_path / name, samples(1))
    for name in ("notes.doc", ".hidden.csv", "x1.yaml"):
        (tmp_path / name).write_text("1\n")
    path = run("label_template", tmp_path)
    assert path == tmp_path / "manifest.csv"
    assert files_in(path) == ["day 2/x.csv", "oil paper-slip_07.csv", "wood_1.csv"]
    out = capsys.readouterr().out
    named = "oil paper-slip_07.csv: material=oil paper-slip, trial=07"
    assert f"  day 2/x.csv: nothing\n  {named}" in out
    assert "lists 3 recordings, 2 of them with what" in out
    with pytest.raises(ValueError, match=r"manifest\.csv is there already; move it away"):
        run("label_template", tmp_path)
    text = path.read_text().replace("x.csv,,,,,,,,,", "x.csv,iron,,,,1.5; 2,,,0-1,")
    path.write_text(text.replace(",,,,,,\n", ",,,,,,slip\n"))  # filled in it is a manifest
    filled = FileRecordings(tmp_path)
    assert [str(r) for r in filled.ids] == ["iron/0", "oil paper-slip/7", "wood/1"]
    assert filled.warnings == ()
    assert [filled.timeline(r).onsets_s for r in filled.ids] == [(1.5, 2.0), (), ()]


PATTERNS = [
    ("{material}{trial}", "sub/wood - 12.csv", "material=wood, trial=12"),
    ("{scene}/{material}{trial}", "taps/iron_4.h5", "scene=taps, material=iron, trial=4"),
    ("{label}/{material}_*", "slip/iron_x.h5", "label=slip, material=iron"),
    ("*_{material}.v1", "run7_oil paper.v1.csv", "material=oil paper"),
    ("{material:cup|big cup}{trial}*", "big cup12b.csv", "material=big cup, trial=12"),
    ("{session}/{material}_{trial}", "day 2/oil_7.csv", "session=day 2, material=oil, trial=7"),
]


@pytest.mark.parametrize(("pattern", "file", "found"), PATTERNS)
def test_a_pattern_tells_what_names_mean(pattern, file, found):
    assert guessed(file, pattern) == dict(part.split("=") for part in found.split(", "))


AMBIGUOUS = [
    (
        "{material}_{scene}_*",
        "plastic_cup_C_1.csv",
        "material='plastic', scene='cup' or material='plastic_cup', scene='C'; list the texts "
        "that can stand there, as {material:plastic|plastic_cup}, or rename the file",
    ),
    ("{material}_*", "day 2/oil_paper_1.csv", "material='oil' or material='oil_paper';"),
]


@pytest.mark.parametrize(("pattern", "file", "readings"), AMBIGUOUS)
def test_a_name_that_can_be_read_in_two_ways_is_refused(pattern, file, readings, tmp_path):
    table(tmp_path / file, samples(1))
    with pytest.raises(ValueError, match=re.escape(f"{pattern!r} can mean {readings}")) as raised:
        write_template(tmp_path, pattern)
    assert str(raised.value).startswith(f"{file}: pattern=")
    assert not (tmp_path / "manifest.csv").exists()


@pytest.mark.parametrize("pattern", ["", "wood", "{thing}", "{material}{material}", "{}"])
def test_a_pattern_that_means_nothing_is_refused(pattern):
    with pytest.raises(ValueError, match=r"pattern must name each of \{material\}, \{trial\}"):
        guessed("a.csv", pattern)


def test_an_empty_folder_has_no_template(tmp_path):
    with pytest.raises(ValueError, match=r"no recording in .*; give a folder of .npz or"):
        write_template(tmp_path, "{material}{trial}")
    with pytest.raises(FileNotFoundError, match="no folder at"):
        write_template(tmp_path / "nowhere", "{material}{trial}")


def test_a_set_that_names_no_scenes_is_counted_by_its_objects(tmp_path, capsys):
    own = tmp_path / "own"
    for name in ("cup", "box"):
        table(own / f"{name}_1.csv", samples(1), names=("t", *HAND.names))
    words = ["data=named", "data.pattern='{material}_{trial}'"]
    converted(own, tmp_path / "out", *words)
    printed = capsys.readouterr().out
    assert "object  recordings" in printed
    assert "paper" not in printed


def test_a_manifest_that_is_not_read_is_told(tmp_path, capsys):
    table(tmp_path / "wood_1.csv", samples(0))
    manifest(tmp_path, "wood_1.csv,wood,0,,,slip")
    words = ["data=named", "data.pattern='{material}_{trial}'"]
    for more, is_told in (([], True), (["data.manifest=manifest.csv"], False)):
        run("check", tmp_path, *words, *more)
        assert ("warning: manifest.csv is not read" in capsys.readouterr().out) == is_told


def test_warnings_that_many_recordings_have_are_shown_a_few_times_and_counted(tmp_path, capsys):
    own = tmp_path / "own"
    for number in range(9):
        made = samples(number)
        made[0, 100 + number] = torch.nan
        table(own / f"cup_{number}.csv", made, names=("t", *HAND.names))
    words = ["data=named", "data.pattern='{material}_{trial}'", "data.reading.gaps=missing"]
    assert run("check", own, *words) == 0
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if "is not finite in" in line]
    assert len(lines) == 5
    assert "warning: the same in 4 more recordings" in printed
