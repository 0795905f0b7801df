"""Sets whose paths say what each file is: a pattern instead of a manifest."""

import re

import numpy as np
import pytest

from tactslip_torch.data.public_sets import listed, named_recordings
from tactslip_torch.data.recording import RecordingId

PATTERN = r"(?P<scene>[nt])/(?P<material>[a-z]+)(?P<trial>\d+)\.csv"
LABELS = {"n": "slip", "t": "non-slip"}
READING = {"sample_rate_hz": 100.0, "time": None}


def table(path, value, rows=150):
    path.parent.mkdir(parents=True, exist_ok=True)
    samples = np.full((rows, 2), value) + np.arange(rows)[:, None]
    np.savetxt(path, samples, delimiter=",", header="e1,e2", comments="", fmt="%d")


@pytest.fixture
def folder(tmp_path):
    for value, name in enumerate(("n/pen0", "n/pen7", "n/caze1", "t/pen0", "t/case1")):
        table(tmp_path / f"{name}.csv", 1000 * value)
    (tmp_path / "README.md").write_text("not one of them")
    table(tmp_path / ".old" / "n" / "pen3.csv", 0)
    return tmp_path


def source(folder, **options):
    parts = {"pattern": PATTERN, "labels": LABELS, "rename": {"caze": "case"}, "reading": READING}
    return named_recordings(folder, **(parts | {"adapting": "fast", "skip_s": 0.5} | options))


def test_paths_say_what_recordings_are(folder):
    found = source(folder, tare_s=[0.0, 0.5])
    assert set(found.ids) == {
        RecordingId("case", 1, "n"),
        RecordingId("case", 1, "t"),
        RecordingId("pen", 0, "n"),
        RecordingId("pen", 0, "t"),
        RecordingId("pen", 7, "n"),
    }
    assert (found.sample_rate_hz, found.hand.names) == (100.0, ("e1", "e2"))
    slip, touch = (found.timeline(RecordingId("pen", 0, scene)) for scene in "nt")
    assert (slip.slip_s, slip.non_slip_s) == (((0.5, 1.5),), ())
    assert (touch.slip_s, touch.non_slip_s) == ((), ((0.5, 1.5),))
    tared = found.load(RecordingId("pen", 7, "n")).samples
    assert tared[:, 0].tolist() == [-24.5, -24.5]
    assert found.entry(RecordingId("case", 1, "n")).file == "n/caze1.csv"


def test_labels_stand_in_names_themselves(tmp_path):
    for name in ("slip/pen", "non-slip/pen", "unsure/pen"):
        table(tmp_path / f"{name}_a.csv", 0)
        table(tmp_path / f"{name}_b.csv", 0)
    pattern = re.compile(r"(?P<label>[^/]+)/(?P<material>[a-z]+)_.\.csv")
    found = listed(tmp_path, pattern, None, {})
    assert not found.problems
    assert [(e.file, e.recording.cycle, e.truth and e.truth.label) for e in found.entries] == [
        ("non-slip/pen_a.csv", 0, "non-slip"),
        ("non-slip/pen_b.csv", 1, "non-slip"),
        ("slip/pen_a.csv", 2, "slip"),
        ("slip/pen_b.csv", 3, "slip"),
        ("unsure/pen_a.csv", 4, None),
        ("unsure/pen_b.csv", 5, None),
    ]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"pattern": "("}, r"data.pattern='\(' is no regular expression"),
        ({"pattern": "(?P<object>.*)"}, r"must have a group \(\?P<material>...\)"),
        ({"pattern": "(?P<material>x+)"}, "no file in .* has a path that matches"),
        ({"labels": {"n": "slips"}}, "data.labels must be of slip and non-slip, got 'slips'"),
        ({"labels": {"n": "slip"}}, r"2 problems in .*t/case1.csv: scene 't' is none of data.labe"),
        (
            {"pattern": r"(?P<scene>[nt])/(?P<material>pe)(?P<trial>.+)\.csv"},
            "trial 'n0' is no num",
        ),
        (
            {"pattern": r"[nt]/(?P<material>[a-z]+)(?P<trial>\d+)\.csv", "labels": None},
            "is pen/0, as n/pen0.csv is",
        ),
    ],
)
def test_what_names_do_not_say_is_said_in_a_line(folder, options, said):
    with pytest.raises(ValueError, match=said) as caught:
        source(folder, **options)
    assert "\n" not in str(caught.value)


def test_no_folder_and_links_out_of_it(folder, tmp_path_factory):
    with pytest.raises(FileNotFoundError, match="no folder at"):
        source(folder / "nowhere")
    outside = tmp_path_factory.mktemp("outside") / "pen9.csv"
    table(outside, 0)
    (folder / "n" / "pen9.csv").symlink_to(outside)
    with pytest.raises(ValueError, match=r"n/pen9.csv: is a link out of the folder"):
        source(folder)


def test_a_manifest_tells_what_names_do_not(folder):
    lines = ["file,material,trial,onsets_s", "n/pen0.csv,pen,0,0.75"]
    (folder / "onsets.csv").write_text("\n".join(lines))
    found = source(folder, manifest="onsets.csv", slide_s=0.5)
    told, other = (found.timeline(RecordingId("pen", trial, "n")) for trial in (0, 7))
    assert (told.onsets_s, told.slip_s) == ((0.75,), ())
    assert (other.onsets_s, other.slip_s) == ((), ((0.5, 1.5),))
