"""Setup: what is proposed for recordings of a hand that nobody knows, and what is asked."""

import re
import zlib
from itertools import pairwise

import numpy as np
import own_gripper
import pytest
import yaml

from tactslip_torch.commands import setup
from tactslip_torch.data.file_names import name_pattern
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.labels import LabelColumn
from tactslip_torch.data.manifest import Entry, Listing
from tactslip_torch.data.proposal import Answers, _filter_frame, bin_samples, look, propose
from tactslip_torch.data.recording import RecordingId

# Names ---------------------------------------------------------------------------------------


def names(form, **values):
    """Names of files, one of each combination of the values."""
    rows = [{}]
    for key, each in values.items():
        rows = [{**row, key: value} for row in rows for value in each]
    return [form.format(**row) for row in rows]


OBJECTS = ("cup", "big_box", "tea_can")
NAMES = [
    (names("{a}_{n}.csv", a=OBJECTS, n=range(3)), (), "{material}_{trial}"),
    (names("{a}{n}.csv", a=("cup", "box"), n=range(3)), (), "{material}{trial}"),
    (
        names("{a}_{s}_3_{n}.csv", a=OBJECTS, s="CD", n=(7, 8)),
        (),
        "{material}_{scene:C|D}_3_{trial}",
    ),
    (
        names("{a}_{s}_{m}_{n}.csv", a=OBJECTS, s="CD", m=(3, 8), n=(1, 2)),  # n repeats
        (),
        "{material}_{scene:C|D}_*",
    ),
    (
        names("csvs/{w}/{a}{n}.csv", w="tn", a=("cup", "box"), n=range(3)),  # n repeats
        ("t", "n"),
        "{label}/{material:box|cup}*",
    ),
    (
        names("{d}/{a}_{n}.csv", d=("2026-11-10", "2026-11-12"), a=OBJECTS, n=range(3)),
        (),
        "{session}/{material}_{trial}",
    ),
    (
        names("{a}_session{s}_{n}.csv", a=OBJECTS, s=(1, 2), n=range(3)),
        (),
        "{material}_session{session}_{trial}",
    ),
    (
        names("{a}_{w}_{n}.csv", a=OBJECTS, w=("slip", "no_slip"), n=(1, 2)),
        ("slip", "no_slip"),
        "{material:big_box|cup|tea_can}_{label:no_slip|slip}_*",
    ),
    (names("obj{a}_trial{n}.csv", a=range(4), n=range(3)), (), "obj{material}_trial{trial}"),
    (names("rec{n}.csv", n=range(9)), (), "{material}{trial}"),
    (["morning.csv", "noon.csv"], (), "{material}"),
]


@pytest.mark.parametrize(("files", "words", "pattern"), NAMES)
def test_a_pattern_for_names_is_found(files, words, pattern):
    found = name_pattern(files, words)
    assert found.pattern == pattern
    assert len(found.fields) == len(files)
    for file, fields in zip(files, found.fields, strict=True):
        assert fields["material"] in file
        assert fields.get("label", "") in file.split("/")[-2:][0]
    assert found.is_simple == (pattern == "{material}")


# Bins and filters ----------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [10.0, 24.0, 92.31, 100.0, 640.0, 1000.0, 1024.0, 2000.0, 5e4])
def test_bins_and_frames_fit_the_rate(rate_hz):
    num = bin_samples(rate_hz)
    assert num % 2 == 0  # so that half of it is a hop
    assert num == pytest.approx(np.clip(0.05 * rate_hz, 32, 1024), rel=0.25)
    for adapting, seconds in (("slow", 0.0255), ("fast", 0.0055)):
        frame = _filter_frame(adapting, rate_hz)
        if frame is None:
            assert seconds * rate_hz < 5
        else:
            assert frame % 2 == 1
            assert abs(frame - seconds * rate_hz) <= 1


# Proposals -----------------------------------------------------------------------------------


def write(path, columns, step=0.01, **others):
    """A table of 400 rows: columns of noise and those that are given; no times for step 0."""
    rng = np.random.default_rng(zlib.crc32(path.name.encode()))
    table = {"time": np.arange(400) * step} if step else {}
    table |= {name: rng.standard_normal(400) for name in columns} | others
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        ",".join(table),
        *(",".join(map(str, row)) for row in zip(*table.values(), strict=True)),
    ]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def gripper(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gripper")
    own_gripper.write_recordings(folder, trials=2, seconds=2.0)
    return folder


def test_a_grippers_recordings_need_no_answer(gripper):
    proposal = propose(look(gripper))
    assert not proposal.questions
    data = proposal.settings["data"]
    assert data["pattern"] == "{material}_{trial}"
    assert data["reading"] == {
        "delimiter": ";",
        "time": "t_ms",
        "time_unit": "ms",
        "sample_rate_hz": 1000.0,
        "channels": list(own_gripper.CHANNELS),
        "gaps": "missing",
    }
    kinds = {(row["kind"], row["adapting"]) for row in data["channels"]}
    assert kinds == {("force", "slow"), ("acc", "fast")}
    assert [row["name"] for row in data["channels"]] == list(own_gripper.CHANNELS)
    labels = {"column": "state", "bin_ms": 50.0, "hop_ms": 25.0, "assign": "majority"}
    assert proposal.settings["labels"] == labels
    assert proposal.settings["features"] == {"frames": {"force": 25, "acc": 5}, "level": None}
    assert proposal.settings["split"]["by"] == "material"


@pytest.fixture
def touches(tmp_path):
    """Folders of classes, without times."""
    for word in "nst":
        for name in ("pen", "cup", "hd"):
            for number in range(2):
                write(tmp_path / word / f"{name}{number}.csv", ["e1", "e2"], step=0)
    return tmp_path


def test_folders_of_classes_ask_for_the_rate_and_the_word_of_non_slip(touches):
    found, answers = look(touches), Answers()
    asked = [question.name for question in propose(found, answers).questions]
    assert asked == ["rate_hz", "non_slip"]
    done = propose(found, Answers(rate_hz=100.0, words={"t": False}))
    assert not done.questions
    data = done.settings["data"]
    assert data["labels"] == {"n": "slip", "s": "slip", "t": "non-slip"}
    assert data["pattern"] == "{label}/{material:cup|hd|pen}*"
    assert data["reading"]["time"] is None
    assert data["reading"]["sample_rate_hz"] == 100.0
    assert done.settings["labels"]["bin_ms"] == 320.0
    assert done.settings["split"]["by"] == "material"
    with pytest.raises(ValueError, match=r"no part of all names holds the words x; .*n\|s\|t"):
        propose(found, Answers(rate_hz=100.0, words={"x": False}))


def test_files_of_several_rates_and_a_column_of_several_values(tmp_path):
    for name in ("cup", "box", "can"):
        for number, step in enumerate((0.1, 0.025)):
            states = np.repeat([0.0, 0.25, 1.0, np.nan], 100).tolist()
            cells = ["" if np.isnan(one) else one for one in states]
            write(tmp_path / f"{name}_{number}.csv", ["lx", "ly"], step=step, slip_over=cells)
    (question,) = propose(look(tmp_path)).questions
    assert (question.name, question.default) == ("over", "0.125")
    done = propose(look(tmp_path), Answers(over=0.9))
    assert not done.questions
    reading = done.settings["data"]["reading"]
    assert reading["resample_hz"] == 40.0
    assert "sample_rate_hz" not in reading
    assert done.settings["labels"]["column"] == "slip_over"
    assert done.settings["labels"]["over"] == 0.9
    assert {row["adapting"] for row in done.settings["data"]["channels"]} == {"slow"}  # < 50 Hz


def test_uneven_times_ask_for_the_rate_and_are_left_out(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("cup_1", "cup_2"):
        times = np.cumsum(0.01 * rng.exponential(1, 400) + 0.005)
        write(tmp_path / f"{name}.csv", ["a", "b"], time=times, slip=[0] * 200 + [1] * 200)
    question, *_ = propose(look(tmp_path)).questions
    assert question.name == "rate_hz"
    assert question.default == ""  # the median step is a fifth shorter than the mean
    assert "Hz in the mean" in question.text
    reading = propose(look(tmp_path), Answers(rate_hz=80.0)).settings["data"]["reading"]
    assert (reading["time"], reading["sample_rate_hz"]) == (None, 80.0)


def slips(tmp_path, **labels):
    """Two files of 400 rows, each with these cells in its columns."""
    for name in ("cup_1", "cup_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"], **labels)
    return look(tmp_path)


@pytest.mark.parametrize("jitter_s", [6e-4, 0.0])
def test_a_set_that_setup_reads_is_read_by_train(jitter_s, tmp_path):
    """Times with jitter, and rates that are one, but not within 1 % of the rate they are called."""
    rates = (500.0, 500.0) if jitter_s else (98.6, 99.2, 100.1)
    files = [f"cup_{number}.csv" for number in range(len(rates))]
    for seed, (name, rate) in enumerate(zip(files, rates, strict=True)):
        late = np.random.default_rng(2 * seed).uniform(-jitter_s, jitter_s, 400)
        times = np.arange(400) / rate + late
        write(tmp_path / name, ["a", "b"], time=times, slip=[0] * 200 + [1] * 200)
    reading = propose(look(tmp_path)).settings["data"]["reading"]
    key, rate_hz = ("sample_rate_hz", 500.0) if jitter_s else ("resample_hz", 100.0)
    assert reading[key] == rate_hz
    listing = Listing(tuple(Entry(name, name, RecordingId(name, 0), None) for name in files))
    how = {"time": "time", key: rate_hz}
    source = FileRecordings(tmp_path, manifest=listing, reading=how)
    for name in source.ids:
        assert source.load(name).samples.shape[1] == pytest.approx(400, abs=6)


def test_times_without_a_unit_that_step_by_tens_are_milliseconds(tmp_path):
    found = slips(tmp_path, time=10 * np.arange(400), slip=[0] * 200 + [1] * 200)
    reading = propose(found).settings["data"]["reading"]
    assert (reading["time_unit"], reading["sample_rate_hz"]) == ("ms", 100.0)


def test_a_known_word_keeps_its_meaning_when_another_is_stated(tmp_path):
    found = slips(tmp_path, state=["slip"] * 100 + ["free"] * 100 + ["stick"] * 200)
    (question,) = propose(found).questions
    assert question.flag == "--label WORD=slip or --label WORD=non-slip for each"
    assert question.text.endswith("not known: free")
    for says_slip, wanted in ((False, ["slip"]), (True, ["free", "slip"])):
        words = {"free": says_slip}
        assert propose(found, Answers(words=words)).settings["labels"]["slip"] == wanted
    with pytest.raises(ValueError, match="column state has no word foo; it holds free, slip, st"):
        propose(found, Answers(words={"foo": True}))


def test_labels_of_minus_one_and_one_are_not_all_slip(tmp_path):
    labels = propose(slips(tmp_path, slip=[-1] * 200 + [1] * 200)).settings["labels"]
    column = LabelColumn("slip", slip=labels["slip"])
    assert column.states(np.array([-1.0, 1.0])).tolist() == [0, 1]


@pytest.mark.parametrize("name", ["no_slip", "stable"])
@pytest.mark.parametrize(("least", "most"), [(0, 1), (-1, 1)])
def test_a_column_of_non_slip_is_read_the_other_way_round(name, least, most, tmp_path):
    found = slips(tmp_path, **{name: [least] * 200 + [most] * 200})
    labels = propose(found, Answers(column=name)).settings["labels"]
    column = LabelColumn(name, slip=labels["slip"])
    assert column.states(np.array([least, most], dtype=float)).tolist() == [1, 0]


@pytest.mark.parametrize(
    ("labels", "answers", "said"),
    [
        ([0, 1], {"over": 5.0}, "--over 5: the magnitudes .* are 0 to 1, so all of it is non-slip"),
        ([-2, 1], {"over": 0.0}, "the magnitudes .* are 1 to 2, so all of it is slip"),
        ([-1, 1], {"over": 0.0}, "are 1 to 1, so all of it is slip; leave --over out"),
        ([0, 0], {"column": "slip"}, "column slip holds only 0; give --column"),
        (["", ""], {"column": "slip", "over": 0.5}, "column slip is empty"),
        ([0, 1], {"words": {"foo": True}}, "holds numbers, 0 to 1, no words; give --over"),
        (["free", "stick"], {"words": {"free": False}}, "free, stick, would all mean non-slip"),
    ],
)
def test_labels_of_one_side_are_refused(labels, answers, said, tmp_path):
    found = slips(tmp_path, slip=[labels[0]] * 200 + [labels[1]] * 200)
    with pytest.raises(ValueError, match=said):
        propose(found, Answers(**answers))


def test_the_limit_of_a_speed_is_asked(tmp_path):
    speeds = np.linspace(0, 40, 400)
    (question,) = propose(slips(tmp_path, slip_mm_s=speeds)).questions
    assert (question.name, question.default) == ("over", "")
    labels = propose(look(tmp_path), Answers(over=5.0)).settings["labels"]
    assert (labels["over"], labels["unit"]) == (5.0, "mm/s")


def test_words_of_names_that_are_one_side_are_refused(tmp_path):
    for name in ("grasp/cup_1", "grasp/box_1", "stable/cup_1", "stable/box_1"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    with pytest.raises(ValueError, match="grasp, stable, would all mean non-slip; give --label"):
        propose(look(tmp_path), Answers(words={"grasp": False}))


def test_of_three_numbers_the_two_lowest_magnitudes_are_parted(tmp_path):
    (question,) = propose(slips(tmp_path, slip=[-1] * 100 + [0] * 200 + [1] * 100)).questions
    assert question.default == "0.5"


def test_a_column_of_slip_that_never_changes_is_told(tmp_path):
    (question,) = propose(slips(tmp_path, slip=[0] * 400)).questions
    assert "column slip holds only 0" in question.text


@pytest.mark.parametrize("last_is_first", [True, False])
def test_times_that_go_back_are_asked_for_with_their_step(last_is_first, tmp_path):
    times = 0.002 * np.arange(400)
    times = (
        np.where(np.arange(400) == 399, 0.0, times) if last_is_first else np.tile(times[:200], 2)
    )
    question, *_ = propose(slips(tmp_path, time=times, slip=[0] * 200 + [1] * 200)).questions
    assert (question.name, question.default) == ("rate_hz", "500")


def test_a_time_that_counts_the_rows_asks_for_the_rate(tmp_path):
    found = slips(tmp_path, time=np.arange(400), slip=[0] * 200 + [1] * 200)
    question, *_ = propose(found).questions
    assert (question.name, question.flag, question.default) == ("rate_hz", "--rate HZ", "")
    assert "column time counts rows, by 1; if in seconds, add --time-unit s" in question.text
    data = propose(found, Answers(rate_hz=100.0)).settings["data"]
    assert (data["reading"]["time"], data["reading"]["sample_rate_hz"]) == (None, 100.0)
    assert [row["name"] for row in data["channels"]] == ["a", "b"]
    told = Answers(time_unit="s")
    reading = propose(look(tmp_path, told), told).settings["data"]["reading"]
    assert (reading["time"], reading["sample_rate_hz"]) == ("time", 1.0)


def test_a_column_that_is_taken_for_labels_can_be_left_out(tmp_path):
    for name in ("slip/cup_1", "slip/box_1", "hold/cup_1", "hold/box_1"):
        write(tmp_path / f"{name}.csv", ["a", "b"], slip_sensor=[0] * 200 + [1] * 200)
    assert propose(look(tmp_path)).settings["labels"]["column"] == "slip_sensor"
    done = propose(look(tmp_path), Answers(column="none"))
    assert not done.questions
    assert "column" not in done.settings["labels"]
    assert done.settings["data"]["labels"] == {"hold": "non-slip", "slip": "slip"}
    slips(tmp_path / "flat", slip_sensor=[0] * 200 + [1] * 200)
    question, *_ = propose(look(tmp_path / "flat"), Answers(column="none")).questions
    assert question.text.startswith("Nothing tells where slip is: no column, no table")


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("cup_1.csv,3,2", "line 2: the end, 2 s, is not after the start, 3 s"),
        ("cup_1.csv,1,2\ncup_1.csv,1.5,3", "lines 2 and 3 overlap, of cup_1.csv"),
    ],
)
def test_intervals_that_cannot_be_are_refused(rows, said, tmp_path):
    slips(tmp_path)
    (tmp_path / "labels.csv").write_text(f"file,start,end\n{rows}\n")
    with pytest.raises(ValueError, match=said):
        propose(look(tmp_path))
    slips(tmp_path, slip=[0] * 200 + [1] * 200)  # the table is then of no use
    assert propose(look(tmp_path)).settings["labels"]["column"] == "slip"


def test_a_pattern_that_lacks_what_is_needed_is_refused(tmp_path):
    for name in ("slip/cup_1", "slip/box_1", "hold/cup_1", "hold/box_1"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    for pattern, lacks in (("{label}/*_{trial}", "material"), ("*/{material}_{trial}", "label")):
        with pytest.raises(ValueError, match=f"has no {{{lacks}}}, which tells"):
            propose(look(tmp_path), Answers(pattern=pattern))


def test_a_table_of_intervals_becomes_a_manifest(tmp_path):
    for name in ("cup_1", "cup_2", "box_1", "box_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    (tmp_path / "slips.csv").write_text(
        "recording;start_ms;end_ms\ncup_1;1000;2500,5\ncup_1;3000;3500\nbox_2.csv;0;500\n"
    )
    proposal = propose(look(tmp_path))
    assert not proposal.questions
    assert "pattern" not in proposal.settings["data"]
    rows = {row["file"]: row for row in proposal.manifest}
    assert set(rows) == {"cup_1.csv", "cup_2.csv", "box_1.csv", "box_2.csv"}
    assert rows["cup_1.csv"]["sliding_s"] == "1-2.5005; 3-3.5"  # so onsets are known
    assert rows["cup_1.csv"]["slip_s"] == rows["box_2.csv"]["sliding_s"] == ""
    assert rows["box_2.csv"]["slip_s"] == "0-0.5"  # begun before the recording
    assert rows["cup_1.csv"]["non_slip_s"] == "0-1; 2.5005-3; 3.5-end"
    assert rows["box_2.csv"]["non_slip_s"] == "0.5-end"
    assert not any(row["unlabelled_s"] for row in rows.values())
    assert rows["cup_2.csv"]["slip_s"] == rows["cup_2.csv"]["non_slip_s"] == ""  # nobody says
    assert (rows["box_2.csv"]["material"], rows["box_2.csv"]["trial"]) == ("box", "2")
    (tmp_path / "manifest.csv").write_text("file,material,slip_s\ncup_1.csv,cup,0-1\n")
    again = propose(look(tmp_path))
    assert not again.manifest  # one that is there is kept
    told = {finding.value for finding in again.findings}
    assert "slips.csv is not read, as manifest.csv is there" in told


def test_a_table_that_is_not_understood_is_named(tmp_path):
    for name in ("cup_1", "cup_2", "box_1", "box_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    (tmp_path / "slips.csv").write_text("Datei;Beginn;Ende\ncup_1;1;2\n")
    question, *_ = propose(look(tmp_path)).questions
    assert "slips.csv is none" in question.text


WRONG_TIMES = [
    ("start;end\n\ncup_1;1;2 s", r"line 3: end '2 s' is no number; give seconds, or .*start_ms"),
    ("start;end\ncup_1;0;1\ncup_1;nan;2", "line 3: start 'nan' is no number"),
    ("start;end\ncup_1;1;1.#INF", "line 2: end '1.#INF' is no number"),
    ("start_ms;end_s\ncup_1;1;2", "times are in ms and s; give all in one unit"),
]


@pytest.mark.parametrize(("rows", "said"), WRONG_TIMES)
def test_times_that_cannot_be_are_named_with_line_and_remedy(tmp_path, rows, said):
    write(tmp_path / "cup_1.csv", ["a", "b"])
    (tmp_path / "slips.csv").write_text(f"file;{rows}\n")
    with pytest.raises(ValueError, match=rf"slips\.csv: {said}"):
        look(tmp_path)


def test_a_unit_at_one_of_both_columns_is_that_of_both(tmp_path):
    write(tmp_path / "cup_1.csv", ["a", "b"])
    (tmp_path / "slips.csv").write_text("file,start,end_time_ms\ncup_1,500,2000\n")
    (row,) = look(tmp_path).intervals
    assert (row["start"], row["end"]) == ("0.5", "2")


def test_a_slip_that_begins_where_non_slip_ends_has_an_onset(tmp_path):
    for name in ("cup_1", "cup_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    (tmp_path / "slips.csv").write_text(
        "file,start,end,state\ncup_1,0.7,1,hold\ncup_1,1,2,slip\ncup_1,2.5,3,slip\n"
    )
    row, _ = propose(look(tmp_path)).manifest
    assert (row["sliding_s"], row["slip_s"], row["non_slip_s"]) == ("1-2", "2.5-3", "0.7-1")
    assert row["unlabelled_s"] == "0-0.7; 2-2.5; 3-end"  # not non-slip from 0 s on


def test_what_is_called_a_table_and_is_none_is_told_where_it_is_read(tmp_path):
    for name in ("cup_1", "cup_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    (tmp_path / "away.csv").symlink_to(tmp_path / "nowhere.csv")
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "slips.csv").write_text("file,start,end\ncup_1,1,2\n")
    found = look(tmp_path)
    assert found.table_of_intervals == "slips.csv"
    assert found.files == ("cup_1.csv", "cup_2.csv")
    assert set(found.problems) == {"away.csv"}  # a folder is looked into


def test_files_that_are_no_recordings_are_told_and_do_not_change_how_names_are_read(tmp_path):
    for name in ("cup_1", "cup_2", "box_1", "box_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"], slip=[0] * 200 + [1] * 200)
    (tmp_path / "notes.csv").write_text("who,what\nme,nothing\n")
    write(tmp_path / "temperature_of_the_day.csv", ["t1"])
    proposal = propose(look(tmp_path))
    assert proposal.settings["data"]["pattern"] == "{material}_{trial}"
    told = [finding.value for finding in proposal.findings if finding.what == "look"]
    assert [text.split()[0] for text in told] == ["notes.csv", "temperature_of_the_day.csv"]


def four_trials(folder):
    """Of two objects, with a column of labels."""
    for name in ("cup_1", "cup_2", "box_1", "box_2"):
        write(folder / f"{name}.csv", ["a", "b"], slip=[0] * 200 + [1] * 200)


def test_a_word_among_numbers_is_told_and_changes_nothing_else(tmp_path):
    four_trials(tmp_path)
    whole = propose(look(tmp_path)).settings
    path = tmp_path / "box_1.csv"
    rows = path.read_text().splitlines()
    cells = rows[7].split(",")
    path.write_text("\n".join([*rows[:7], ",".join([cells[0], "ERR", *cells[2:]]), *rows[8:], ""]))
    found = look(tmp_path)
    assert found.problems == {"box_1.csv": "has 'ERR' in column a; mend it"}
    settings = propose(found).settings
    assert (settings["data"]["pattern"], settings["split"]) == (
        whole["data"]["pattern"],
        whole["split"],
    )


def test_a_file_of_one_row_leaves_the_times_of_the_others(tmp_path):
    four_trials(tmp_path)
    head, first, *_ = (tmp_path / "cup_1.csv").read_text().splitlines()
    (tmp_path / "cup_3.csv").write_text(f"{head}\n{first}\n")
    found = look(tmp_path)
    assert found.problems == {"cup_3.csv": "has fewer than 3 rows"}
    with pytest.raises(ValueError, match=r"cup_3\.csv is a file; give the folder"):
        look(tmp_path / "cup_3.csv")
    assert propose(found).settings["data"]["reading"]["time"] == "time"


def test_a_manifest_may_list_some_of_the_files_with_labels_of_their_own(tmp_path):
    four_trials(tmp_path)
    (tmp_path / "manifest.csv").write_text("file,material\ncup_1.csv,cup\nbox_1.csv,box\n")
    proposal = propose(look(tmp_path))
    assert proposal.example in ("cup_1.csv", "box_1.csv")
    (tmp_path / "manifest.csv").write_text("file,material\n")
    with pytest.raises(ValueError, match=r"manifest\.csv lists no recording"):
        propose(look(tmp_path))


def test_a_setup_that_fails_can_be_started_again(tmp_path):
    for name in ("cup_1", "cup_2", "box_1", "box_2"):
        write(tmp_path / f"{name}.csv", ["a", "b"])
    table = tmp_path / "slips.csv"
    table.write_text("file,start,end\ncup_1.csv,1,99\nbox_1.csv,1,2\n")
    with pytest.raises(ValueError, match="leaves the recording"):
        setup.setup(tmp_path, Answers(), setup._ask(True))
    table.write_text("file,start,end\ncup_1.csv,1,3\nbox_1.csv,1,2\n")
    setup.setup(tmp_path, Answers(), setup._ask(True))
    assert "1-3" in (tmp_path / "manifest.csv").read_text()


def test_columns_that_are_no_channels_are_told_with_the_reason(tmp_path):
    words = np.repeat(["no slip", "slip"], 200).tolist()
    counts = range(400)
    for name in ("cup_1", "cup_2"):
        more = {"nr": counts, "temperature": [20.5] * 400, "state": words, "note": ["x"] * 400}
        write(tmp_path / f"{name}.csv", ["p (kPa)", "q (kPa)"], seq=counts, **more)
    proposal = propose(look(tmp_path))
    channels = [row["name"] for row in proposal.settings["data"]["channels"]]
    assert channels == ["p (kPa)", "q (kPa)"]
    assert proposal.settings["data"]["units"] == "kPa"
    told = {f.value: f.reason for f in proposal.findings if f.what == "no channel"}
    assert told == {
        "column nr": "counts the rows",
        "column seq": "by its name",
        "column temperature": "never changes",
        "column note": "holds words",
    }
    assert proposal.settings["labels"]["column"] == "state"


KINDS = [
    (["force_1", "force_2", "acc_x", "acc_y"], ["force", "force", "acc", "acc"]),
    (["t1_x", "t1_y", "t2_x", "t2_y"], ["t"] * 4),
    (["Fx", "Fy", "Ax", "Ay"], ["F", "F", "A", "A"]),
    (["left_a", "left_b", "right_a", "right_b"], ["left", "left", "right", "right"]),
    (["alpha", "beta"], ["fast", "fast"]),  # white noise at 100 Hz
]


@pytest.mark.parametrize(("channels", "kinds"), KINDS)
def test_kinds_are_the_stems_of_names_or_fast_and_slow(tmp_path, channels, kinds):
    for name in ("cup_1", "cup_2"):
        write(tmp_path / f"{name}.csv", channels, slip=[0] * 200 + [1] * 200)
    rows = propose(look(tmp_path)).settings["data"]["channels"]
    assert [row["kind"] for row in rows] == kinds
    assert {row["adapting"] for row in rows} == {"fast"}


def test_channels_of_one_name_that_disagree_are_two_kinds(tmp_path):
    for name in ("cup_1", "cup_2"):
        drift = np.sin(np.arange(400) / 100)
        write(tmp_path / f"{name}.csv", ["ch1"], ch2=drift, slip=[0] * 200 + [1] * 200)
    rows = propose(look(tmp_path)).settings["data"]["channels"]
    found = {row["name"]: (row["kind"], row["adapting"]) for row in rows}
    assert found == {"ch1": ("ch_fast", "fast"), "ch2": ("ch_slow", "slow")}


# The command ---------------------------------------------------------------------------------


def test_hand_yaml_says_what_was_proposed_and_why(typed, gripper, drawn):
    status, out, err = typed(setup, gripper, "--yes")
    assert status == 0, err
    assert f"next: tactslip train {gripper}" in out
    text = (gripper / "hand.yaml").read_text()
    settings = propose(look(gripper)).settings
    assert yaml.safe_load(text) == settings
    lines = text.splitlines()
    for before, line in pairwise(lines):  # a reason on each line of a value, or above it
        if re.match(r"\s+\w+: \S", line):
            assert "#" in line or before.strip().startswith("#"), line
    (figure,) = drawn
    assert "6 channels at 1000 Hz" in figure.get_suptitle()
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "force: 3 channels, slow",
        "acc: 3 channels, fast",
    ]
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"slip", "non-slip"} < legend
    status, _, err = typed(setup, gripper, "--yes")
    assert status == 2
    assert "hand.yaml is there already; --force replaces it" in err
    assert typed(setup, gripper, "--yes", "--force")[0] == 0


def test_what_cannot_be_guessed_names_its_flag(typed, touches, monkeypatch):
    status, _, err = typed(setup, touches, "--yes")
    assert status == 2
    assert len(err.strip().splitlines()) == 1
    assert "--rate HZ" in err
    status, _, err = typed(setup, touches, "--yes", "--rate", "100")
    assert status == 2
    assert "--non-slip WORD" in err
    assert not (touches / "hand.yaml").exists()
    given = iter(["100", "t"])
    monkeypatch.setattr("builtins.input", lambda text: next(given))
    status, _, err = typed(setup, touches)
    assert status == 0, err
    assert yaml.safe_load((touches / "hand.yaml").read_text())["data"]["labels"]["n"] == "slip"
    with pytest.raises(StopIteration):  # two questions and no more
        next(given)
