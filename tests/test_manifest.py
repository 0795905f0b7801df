"""Manifests that people write: what they may look like, and that every mistake is named."""

import re

import pytest

from tactslip_torch.data.file_recordings import on_time
from tactslip_torch.data.manifest import manifest_of, read_manifest, truth_of
from tactslip_torch.data.recording import RecordingId, Timeline

FILES = ("a.csv", "b.csv", "c.csv")


@pytest.fixture
def root(tmp_path):
    """A folder with three files and one in a folder of its own."""
    folder = tmp_path / "set"
    (folder / "day 2").mkdir(parents=True)
    for name in (*FILES, "day 2/d.csv"):
        (folder / name).write_text("1\n")
    return folder


def listed(root, text, name="manifest.csv"):
    path = root / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_manifest(path, root)


def problems(root, text, name="manifest.csv"):
    return [str(problem) for problem in listed(root, text, name).problems]


# What is read --------------------------------------------------------------------------------


def test_a_table_of_files_materials_and_labels(root):
    found = listed(
        root,
        "file,material,trial,onsets_s,sliding_s,non_slip_s,speeds_mm_s,label,sample_rate_hz\n"
        "a.csv,wood,3,2.0; 9.0,2-7; 9-11.5,0-1.5,20; 40,,\n"
        "\n"
        "b.csv,wood,4,,,,,slip,1000\n"
        "day 2/d.csv,iron,1,,,,,,\n",
    )
    assert found.problems == found.warnings == ()
    first, second, third = found.entries
    assert first.recording == RecordingId("wood", 3)
    assert first.truth == Timeline(
        onsets_s=(2.0, 9.0),
        sliding_s=((2.0, 7.0), (9.0, 11.5)),
        non_slip_s=((0.0, 1.5),),
        speeds_mm_s=(20.0, 40.0),
    )
    assert (first.sample_rate_hz, second.sample_rate_hz) == (None, 1000.0)
    assert (second.place, second.truth) == ("manifest.csv:4", Timeline(label="slip"))
    assert (third.file, third.truth) == ("day 2/d.csv", None)


def test_trials_that_nobody_numbered_are_numbered_in_order(root):
    found = listed(
        root, "file,material,trial\na.csv,wood,\nb.csv,wood,0\nc.csv,wood,\nday 2/d.csv,iron,\n"
    )
    assert [str(e.recording) for e in found.entries] == ["wood/1", "wood/0", "wood/2", "iron/0"]
    columns = "file,material,trial,scene,session\n"  # each session and scene counts its own
    found = listed(root, columns + "a.csv,wood,0,,\nb.csv,wood,,,monday\nc.csv,wood,0,taps,\n")
    names = [str(entry.recording) for entry in found.entries]
    assert (names, found.problems) == (["wood/0", "wood/0@monday", "wood/0/taps"], ())
    same = problems(root, columns + "a.csv,wood,3,,two\nb.csv,wood,3,,two\n")
    listed_in = "scene paper, session two, was listed in manifest.csv:2"
    assert same == [f"manifest.csv:3: trial 3 of wood, {listed_in}"]


def test_the_manifest_is_found_or_asked_for(root):
    with pytest.raises(FileNotFoundError, match=r"no manifest\.csv in .*action=label_template"):
        manifest_of(root)
    (root / "manifest.csv").touch()
    assert manifest_of(root) == manifest_of(root, "manifest.csv") == root / "manifest.csv"
    with pytest.raises(FileNotFoundError, match="no folder at"):
        manifest_of(root / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"no manifest at .*other\.csv"):
        read_manifest(manifest_of(root, "other.csv"), root)


# What is wrong -------------------------------------------------------------------------------


def test_every_problem_of_every_line_is_listed_at_once(root):
    found = problems(
        root,
        "file,material,trial,onsets,onset_s,label,non_slip_s\n"
        "a.csv,wood,0,,,,\n"
        "aa.csv,,x,,,maybe,5-2\n"
        "b.csv,wood,0,,,slip,1-2\n"
        "a.csv,iron,1,,,\n"
        "a.csv,iron,2,,,,\n",
    )
    assert found == [
        "manifest.csv:5: has 6 cells, the header 7; put in quotes what holds a ','",
        "manifest.csv:1: unknown column 'onsets'; did you mean 'onsets_s'?",
        "manifest.csv:1: unknown column 'onset_s'; did you mean 'onsets_s'?",
        "manifest.csv:3: no file 'aa.csv' in the folder; did you mean 'a.csv'?",
        "manifest.csv:3: no material",
        "manifest.csv:3: trial must be a whole number from 0, got 'x'; empty ones are numbered in "
        "their order",
        "manifest.csv:3: label: must be slip, non-slip or empty, got 'maybe'",
        "manifest.csv:4: label slip says all of it, and onsets or stretches are given as well; "
        "give one of both",
        "manifest.csv:6: file 'a.csv' was listed in manifest.csv:2",
    ]


def test_other_columns_are_said_not_to_be_read_and_likely_twins_are_named(root):
    found = listed(root, "file,material,weather\na.csv,wood,fine\nb.csv,Wood,fine\n")
    assert found.problems == ()
    assert [str(doubt) for doubt in found.warnings] == [
        "manifest.csv:1: column 'weather' is not read",
        "manifest.csv:3: material 'Wood' is not the 'wood' of manifest.csv:2",
    ]


@pytest.mark.parametrize(
    ("cells", "line"),
    [
        ({"onsets_s": "2,5"}, "'2,5' is no number; write decimals with a point"),
        ({"onsets_s": "9; 2"}, "onsets_s must ascend, got 9; 2"),
        ({"onsets_s": "[2.0, NaN]"}, "'NaN' is no number"),
        ({"onsets_s": "[2.0"}, r"'\[2.0' is no list; write \[2.0, 9.0\] or 2.0; 9.0"),
        ({"onsets_s": "[" * 100_000}, "is no list"),
        ({"onsets_s": "-1"}, "must not lie before the start"),
        ({"speeds_mm_s": "-20", "onsets_s": "2"}, "speeds_mm_s must not be negative"),
        ({"sliding_s": "7-2"}, "7-2 must end behind its start"),
        ({"sliding_s": "2-7; 5-9"}, "sliding_s: 2-7 and 5-9 overlap or stand in the wrong order"),
        ({"sliding_s": "2 7"}, "'2 7' is no stretch; write 2-7; 9-11.5"),
        ({"sliding_s": "2-7", "non_slip_s": "6.5-9"}, "slip and non-slip overlap: 2-7 and 6.5-9"),
        ({"slip_s": "0-3", "sliding_s": "2-4"}, "sliding_s and slip_s overlap: 2-4 and 0-3"),
        ({"onsets_s": "2; 9", "sliding_s": "2-7"}, "1 sliding_s for 2 onsets"),
        ({"onsets_s": "2; 9", "released_s": "1.9-2.1"}, "1 released_s for 2 onsets"),
        ({"onsets_s": "2", "released_s": "2.1-2.2"}, "2 s is not within its released_s, 2.1-2.2"),
        ({"onsets_s": "8", "sliding_s": "2-7"}, "the onset at 8 s is not before the end"),
        ({"label": "maybe"}, "must be slip, non-slip or empty"),
    ],
)
def test_a_truth_that_cannot_be_is_named(cells, line):
    _, (wrong,) = truth_of(cells)
    assert re.search(line, wrong)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "manifest.csv: is empty"),
        ("file,trial\na.csv,1\n", "manifest.csv:1: no column material"),
        ("file,material\n", "manifest.csv: lists no recording"),
        ("file,material,file\na.csv,wood,b\n", "manifest.csv:1: column 'file' is there twice"),
        ('file,material\n"a.csv,wood\n', "manifest.csv:2: cannot be read as CSV"),
        ("file,material\n" + "x" * 200_000 + ",wood\n", "manifest.csv:2: cannot be read as CSV"),
        ("file,material,sample_rate_hz\na.csv,wood,-5\n", "must be a positive number, got '-5'"),
        ("file,material,trial\na.csv,wood,\N{SUPERSCRIPT TWO}\n", "must be a whole number from 0"),
    ],
)
def test_what_cannot_be_read_is_named(root, text, line):
    assert any(line in problem for problem in problems(root, text))


def test_what_is_no_text_is_refused(root):
    with pytest.raises(ValueError, match=r"manifest\.csv:2: no UTF-8 text; save it as UTF-8"):
        listed(root, "file,material\na.csv,caf\xe9\n".encode("latin-1"))
    with pytest.raises(ValueError, match=r"must end in \.csv"):
        listed(root, "file,material\n", "manifest.txt")
    with (root / "manifest.csv").open("wb") as file:
        file.truncate(10 * 2**30)  # sparse
    with pytest.raises(ValueError, match=r"is no manifest: it has 10737418240 bytes"):
        read_manifest(root / "manifest.csv", root)


PATHS = {
    "must lie inside the folder": (
        *("../outside.csv", "day 2/../../outside.csv", "/etc/passwd", r"..\outside.csv"),
        *(r"C:\data\a.csv", r"\\server\share\a.csv"),
    ),
    "is a link out of the folder": ("link.csv", "linked/outside.csv"),
    "no file|cannot be opened": ("loop.csv", "x" * 5000, ""),
    "no file 'day 2/e.csv' in the folder; did you mean 'd.csv'": ("day 2/e.csv",),
}


@pytest.mark.parametrize("line", PATHS)
def test_a_path_out_of_the_folder_is_refused(root, line):
    (root.parent / "outside.csv").write_text("1\n")
    (root / "link.csv").symlink_to(root.parent / "outside.csv")
    (root / "linked").symlink_to(root.parent)
    (root / "loop.csv").symlink_to(root / "loop.csv")
    for file in PATHS[line]:
        (found,) = problems(root, f'file,material\n"{file}",wood\n')
        assert re.search(line, found)


# On the time of the recording ------------------------------------------------------------------


def test_a_label_stands_for_all_but_the_start():
    for label in ("slip", "non-slip"):
        times, wrong = on_time(Timeline(label=label), 3.0, skip_s=0.5)
        assert not wrong
        rest = ((0.5, 3.0),)
        assert (times.slip_s, times.non_slip_s) == ((rest, ()) if label == "slip" else ((), rest))
    _, wrong = on_time(Timeline(label="slip"), 0.4, skip_s=0.5)
    assert wrong == ["label: of 0.4 s nothing is left behind the first 0.5 s; lower skip_s"]


def test_a_slide_of_which_only_the_onset_is_known_ends_with_what_comes_first():
    truth, _ = truth_of({"onsets_s": "2.0; 2.25; 5.0; 9.75", "non_slip_s": "5.1-6"})
    times, wrong = on_time(truth, 10.0, slide_s=0.5)
    assert not wrong
    assert times.sliding_s == ((2.0, 2.25), (2.25, 2.75), (5.0, 5.1), (9.75, 10.0))
    assert times.speeds_mm_s == (0.0,) * 4
    assert times.annotated_onsets_s == times.onsets_s


def test_what_leaves_the_recording_is_named_and_what_is_off_by_a_sample_is_cut():
    truth = Timeline(
        onsets_s=(2.0, 9.0), sliding_s=((2.0, 7.0), (9.0, 11.5)), non_slip_s=((0.0, 1.0),)
    )
    _, wrong = on_time(truth, 8.0)
    assert wrong == [
        "sliding_s: 9-11.5 s leaves the recording of 8 s",
        "onsets_s: 9 s is behind the end, 8 s",
    ]
    assert on_time(truth, 11.4995)[1] == ["sliding_s: 9-11.5 s leaves the recording of 11.5 s"]
    times, wrong = on_time(truth, 11.4995, slack_s=0.0005, missing_s=[(4.0, 4.1)])
    assert not wrong
    assert times == Timeline(
        (2.0, 9.0),
        (2.0, 9.0),
        (0.0, 0.0),
        ((2.0, 7.0), (9.0, 11.4995)),
        non_slip_s=((0.0, 1.0),),
        missing_s=((4.0, 4.1),),
        duration_s=11.4995,
    )
