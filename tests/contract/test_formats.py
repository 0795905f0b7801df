"""Files: ours there and back, other people's as they meant them, by stretches; or one line."""

import importlib.util
import json
import shutil
from itertools import pairwise

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import torch
from foreign_files import LVM, made_73, made_hdf5, stored
from mcap.reader import make_reader
from message_bags import (
    START_NS,
    STEP_NS,
    WRENCH,
    Sent,
    array,
    json_message,
    noise,
    stamped,
    times,
    wrench,
    wrenches,
    write_bag,
    write_mcap,
)
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.clock import even_clock
from tactslip_torch.data.formats import endings, find_format, format_of, pieces

from .names import FORMATS, Reading, named_format, open_file

ENDINGS = ("npz", "csv", "txt", "h5", "mat", "mcap", "parquet")
ALIKE = ("npy", "tsv", "dat", "lvm", "hdf5", "he5")
KEY = {"scene": {"seed": 3}, "list": [1, None]}
FLOATS = "std_msgs/msg/Float64MultiArray"


def hand_of(names):
    return HandLayout.from_rows(
        {"name": name, "kind": "SG", "finger": f"f{i}", "segment": "tip", "adapting": "slow"}
        for i, name in enumerate(names)
    )


def recording(samples=None, **changes):
    values = {
        "samples": torch.from_numpy(noise(2, 1234, seed=3)) if samples is None else samples,
        "sample_rate_hz": 2000.0,
        "material": "Stahl ü 'x: y' #",
        "speeds_mm_s": (20.0, 40.0),
        "onsets_s": (1 / 3, 0.1 + 1e-9),
        "sliding_s": ((0.1, 0.2), (0.3, 0.4)),
        "annotated_onsets_s": (0.06, 1 / 3),
        "non_slip_s": ((0.01, 0.02),),
        "slip_s": ((0.25, 0.3),),
        "released_s": ((0.3, 1 / 3), (0.1, 0.2)),
        "provenance": {"simulated": True, "note": 'a\nb: [c, {d}] & *e \\ "f" \''},
        "units": "mV",
    }
    return Recording(**(values | changes))


def bits(samples):
    """Bytes in which one NaN is as good as another: text keeps only that it is one."""
    values = samples.numpy().copy()
    values[np.isnan(values)] = np.nan
    return values.tobytes()


def odd_numbers(dtype):
    """Every pattern of bits that is easily lost: NaN, infinity, -0.0, the least number."""
    whole, real = (np.uint32, np.float32) if dtype == torch.float32 else (np.uint64, np.float64)
    top = np.finfo(real).bits - 1
    patterns = [0, 1 << top, 1, (1 << top) - 1, (1 << top) - 2, 3 << (top - 1)]
    return torch.from_numpy(np.array(patterns, whole).view(real)).reshape(2, 3)


def assert_truth(found, wanted, hand):
    assert {**vars(found.recording), "samples": None} == {**vars(wanted), "samples": None}
    assert (found.hand, found.key) == (hand, KEY)


def read(path, how=None):
    """All that a file of somebody gives: samples, names, times, rate; by stretches as whole."""
    with open_file(path, how or Reading()) as opened:
        assert opened.archived is None
        samples = opened.samples
        size = samples.num_samples
        whole = samples.read(0, size)
        assert whole.dtype == samples.dtype
        assert whole.shape == (samples.num_channels, size)
        assert bits(torch.cat(list(pieces(samples, 7)), 1)) == bits(whole)
        assert bits(samples.read(size // 3, size // 2)) == bits(whole[:, size // 3 : size // 2])
        assert samples.read(size, size + 5).shape == (samples.num_channels, 0)
        return whole, opened.names, opened.times(), opened.sample_rate_hz


def refused(path, how=None, error=ValueError):
    """The one line that a file gets; it names the file."""
    with pytest.raises(error) as caught:
        read(path, how)
    said = str(caught.value)
    assert "\n" not in said
    assert str(path) in said
    assert len(said) < 1000 + len(str(path))
    return said


# Ours ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("ending", ENDINGS)
def test_what_goes_in_comes_out(tmp_path, ending, dtype):
    form, path = named_format(ending), tmp_path / f"a.{ending}"
    for samples in (
        torch.from_numpy(noise(3, 2001)).to(dtype),
        torch.from_numpy(noise(1, 1)).to(dtype),
        torch.arange(24.0).reshape(12, 2).to(dtype).T,  # not contiguous
        odd_numbers(dtype),
        torch.empty(2, 0, dtype=dtype),
    ):
        changes = {} if samples.shape[1] else {"released_s": ()}
        wanted = recording(samples, sample_rate_hz=1e6 / 3, **changes)
        hand = hand_of(["SG1", "Kraft ü", 'a "b", c'][: len(samples)])
        form.save(path, wanted, hand, KEY)
        found = form.load(path)
        assert found.recording.samples.dtype == dtype
        assert found.recording.samples.shape == samples.shape
        assert bits(found.recording.samples) == bits(samples.contiguous())
        assert_truth(found, wanted, hand)
        assert form.is_native(path)
        with open_file(path) as opened:
            assert_truth(opened.archived, wanted, hand)
            assert opened.archived.recording.samples.shape == (len(hand), 0)
            assert (opened.names, opened.sample_rate_hz) == (hand.names, 1e6 / 3)
            parts = [samples[:, :0], *pieces(opened.samples, 333)]
            assert bits(torch.cat(parts, 1)) == bits(samples.contiguous())
            part = opened.samples.read(1500, 1600)
            assert bits(part) == bits(samples[:, 1500:1600].contiguous())


@pytest.mark.parametrize("ending", ENDINGS)
def test_equal_recordings_are_equal_bytes_whenever_written(tmp_path, ending, monkeypatch):
    form = named_format(ending)
    for folder in ("a", "b"):
        form.save(tmp_path / folder / f"x.{ending}", recording(), hand_of("ab"), KEY)
        monkeypatch.setattr("time.time", lambda: 2e9)
        monkeypatch.setattr("time.asctime", lambda *_: "another day")
    files = [sorted(p for p in (tmp_path / f).rglob("*") if p.is_file()) for f in ("a", "b")]
    assert [p.read_bytes() for p in files[0]] == [p.read_bytes() for p in files[1]]


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_cannot_be_kept_is_refused_and_nothing_is_lost(tmp_path, ending):
    form, path = named_format(ending), tmp_path / f"a.{ending}"
    form.save(path, recording(), hand_of("ab"), KEY)
    for names, changes, key, said in (
        ("abc", {}, {}, "the hand has 3 channels, the recording 2"),
        ("ab", {"provenance": {"by": object()}}, {}, "provenance must be plain JSON"),
        ("ab", {}, {"rate": float("nan")}, "key must be plain JSON"),
        ("ab", {"samples": torch.zeros(2, 9, dtype=torch.int32)}, {}, "float32 or float64"),
    ):
        with pytest.raises(ValueError, match=said):
            form.save(path, recording(**changes), hand_of(names), key)
    assert_truth(form.load(path), recording(), hand_of("ab"))
    assert list(tmp_path.iterdir()) == [path]


def test_libraries_alone_read_ours(tmp_path):
    wanted, hand = recording(), hand_of(["a", "Fö"])
    samples = wanted.samples.numpy()
    for form in FORMATS.values():
        form.save(tmp_path / f"a.{form.endings[0]}", wanted, hand, KEY)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as content:
        np.testing.assert_array_equal(content["samples"], samples)
        assert (content["sample_rate_hz"], content["units"]) == (2000.0, "mV")
        assert content["channel_name"].tolist() == ["a", "Fö"]
        assert json.loads(str(content["key"])) == KEY
    numbers = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=2)
    np.testing.assert_array_equal(numbers[:, 1:].T, samples)
    np.testing.assert_allclose(numbers[:, 0], np.arange(1234) / 2000)
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["samples"][()], samples)
        assert file["samples"].attrs["sample_rate_hz"] == 2000.0
        assert [name.decode() for name in file["samples"].attrs["channel_name"]] == ["a", "Fö"]
    found = scipy.io.loadmat(tmp_path / "a.mat")
    np.testing.assert_array_equal(found["samples"], samples)
    assert [name.item() for name in found["channel_name"].flat] == ["a", "Fö"]
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.schema.names == ["time_s", "a", "Fö"]
    np.testing.assert_array_equal([table.column(n).to_numpy() for n in ("a", "Fö")], samples)
    with (tmp_path / "a.mcap").open("rb") as file:
        kinds = {(s.name, c.topic) for s, c, _ in make_reader(file, True).iter_messages()}
    assert kinds == {(FLOATS, "/tactile")}
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        sent = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    assert [axis.label for axis in sent[0].layout.dim] == ["samples", "channels"]
    joined = np.concatenate([message.data.reshape(-1, 2) for message in sent])
    np.testing.assert_array_equal(joined.T, samples)


def test_ours_saved_again_by_others_are_ours(tmp_path):
    wanted, hand = recording(), hand_of("ab")
    named_format("npz").save(tmp_path / "a.npz", wanted, hand, KEY)
    with np.load(tmp_path / "a.npz") as content:
        np.savez_compressed(tmp_path / "b.npz", **content)
    named_format("mat").save(tmp_path / "a.mat", wanted, hand, KEY)
    found = {n: v for n, v in scipy.io.loadmat(tmp_path / "a.mat").items() if n[0] != "_"}
    scipy.io.savemat(tmp_path / "b.mat", found, do_compression=True)
    made_73(tmp_path / "c.mat", header=found["header"].item(), samples=found["samples"])
    for name in ("b.npz", "b.mat", "c.mat"):
        archived = format_of(tmp_path / name).load(tmp_path / name)
        assert torch.equal(archived.recording.samples, wanted.samples)
        assert_truth(archived, wanted, hand)


# Which files there are -------------------------------------------------------------------------


def test_formats_are_known_by_their_ending(tmp_path):
    wanted = {*ENDINGS, *ALIKE}
    assert wanted == {*endings()}
    for ending in wanted:
        assert find_format(tmp_path / f"A.{ending.upper()}") is named_format(ending)
    assert find_format(tmp_path / "a.png") is find_format(tmp_path / ".csv") is None
    assert refused(tmp_path / "a.csv", error=FileNotFoundError).startswith("no file")
    (tmp_path / "a.png").touch()
    assert "must end in .npz or " in refused(tmp_path / "a.png")
    with pytest.raises(
        ValueError, match=r"must be one of npz, csv, h5, mat, parquet, mcap, got 'png'"
    ):
        named_format("png")


def test_another_version_of_ours_and_what_lacks_an_array_are_named(tmp_path):
    later = {"format": np.array("tactslip_torch recording 2"), "samples": np.zeros((2, 9))}
    np.savez(tmp_path / "later.npz", **later)
    with pytest.raises(ValueError, match="must be of format 'tactslip_torch recording 1', got"):
        format_of(tmp_path / "later.npz").load(tmp_path / "later.npz")
    np.savez(tmp_path / "cut.npz", format=np.array("tactslip_torch recording 1"))
    with pytest.raises(ValueError, match=r"cut.npz .*no array samples, sample_rate_hz, units"):
        format_of(tmp_path / "cut.npz").load(tmp_path / "cut.npz")


# Text ------------------------------------------------------------------------------------------

ROWS = np.array([[0.0, 1.5, -2.0], [0.5, 2.5, 4e-3], [1.0, np.nan, 5.0]])
TABLES = {
    "t,a,b\n0,1.5,-2\n0.5,2.5,4e-3\n1,nan,5\n": True,
    "t,a,b\r\n0,1.5,-2\r\n0.5,2.5,4e-3\r\n1,NaN,5": True,
    "Time (s), a , b\n0, 1.5, -2\n0.5, 2.5, 4E-3\n1, , +5.\n": True,
    "t\ta\tb\n0\t1.5\t-2\n.5\t2.5\t.004\n1\t\t5\n": True,
    "0\t1.5\t-2\n0.5\t2.5\t4e-3\n1\tnan\t5\n": False,
    "0.0\t1.5\t-2\t\n0.5\t2.5\t4e-3\t\n1\tnan\t5\t\n": False,
    "t;a;b;\n0;1.5;-2;\n0.5;2.5;4e-3;\n1;;5;\n": True,
    "t;a;b\n0;1,5;-2\n0,5;2,5;4e-3\n1;;5\n": True,
    "0\t1,5\t-2\t\n0,5\t2,5\t,004\t\n1\tnan\t5\t\n": False,
    "  0   1.5  -2\n  0.5 2.5  4e-3\n  1 nan 5\n": False,
    ' t "a" b\n 0 1.5 -2\n\n0.5 2.5 4e-3\n   \n1 nan 5\n': True,
    '"t","a","b"\n"0","1.5","-2"\n"0.5","2.5","4e-3"\n"1","","5"\n': True,
    "# t a b\n0 1.5 -2\n0.5 2.5 4e-3 # here\n# and\n1 nan 5\n": True,
    "# 3 rows\n0 1.5 -2\n0.5 2.5 4e-3\n1 nan 5\n": False,
    "A title\n\nt,a,b\ns,V,(V)\n0,1.5,-2\n0.5,2.5,4e-3\n1,nan,5\n": True,
    "rate,2000,Hz\nt,a,b\n0,1.5,-2\n0.5,2.5,4e-3\n1,nan,5\n": True,
    "t_ms,a,b\n0,1.5,-2\n500,2.5,4e-3\n1000,nan,5\n": True,
    "t,a,b\n7,1.5,-2\n7.5,2.5,4e-3\n8,nan,5\n": True,
}


def assert_rows(found, names):
    samples, columns, since, rate = found
    np.testing.assert_array_equal(samples, ROWS[:, 1:].T)
    assert (columns, rate) == (names, None)
    assert since.tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("content", TABLES)
def test_a_text_table_is_found_out(tmp_path, content):
    (tmp_path / "a.txt").write_bytes(content.encode())
    assert_rows(read(tmp_path / "a.txt"), ("a", "b") if TABLES[content] else None)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_encodings(tmp_path, encoding):
    content = "t;Kraft °;b\n0;1,5;-2\n0,5;2,5;4e-3\n1;;5\n"
    (tmp_path / "a.txt").write_text(content, encoding)
    assert_rows(read(tmp_path / "a.txt"), ("Kraft °", "b"))


@pytest.mark.parametrize("point", [".", ","])
@pytest.mark.parametrize("x", ["One", "No"])
def test_labview_measurements(tmp_path, x, point):
    rows = ["0.0\t1.5\t-2.0", "0.5\t2.5\t4E-3", "1.0\tNaN\t5.0"]
    rows = [row if x == "One" else row[row.index("\t") :] for row in rows]
    content = LVM.format(x=x, point=point) + "\n".join(rows).replace(".", point) + "\n"
    (tmp_path / "a.lvm").write_text(content)
    samples, names, since, rate = read(tmp_path / "a.lvm")
    np.testing.assert_array_equal(samples, ROWS[:, 1:].T)
    assert (names, rate) == (("Untitled", "Untitled 1"), 2.0)
    assert since is None if x == "No" else since.tolist() == [0.0, 0.5, 1.0]


def test_columns_of_text_are_chosen(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("n,u,v,w\n5,1,2,3\n6,4,5,6\n")
    assert read(path)[1:3] == (("n", "u", "v", "w"), None)
    samples, names, since, _ = read(path, Reading(time="n", channels=("w", 1)))
    assert (samples.tolist(), names) == ([[3.0, 6.0], [1.0, 4.0]], ("w", "u"))
    assert since.tolist() == [0.0, 1.0]
    assert read(path, Reading(time=0, time_unit="ms"))[2].tolist() == [0.0, 1e-3]
    assert "'x'" in refused(path, Reading(time="x"))
    assert "4" in refused(path, Reading(channels=(4,)))
    path.write_text("1 2\n3 4\n")  # no names: times come first, unless the rate is said
    assert read(path)[0].tolist() == [[2.0, 4.0]]
    assert read(path, Reading(sample_rate_hz=9.0))[0].tolist() == [[1.0, 3.0], [2.0, 4.0]]
    assert read(path, Reading(time=None))[0].shape == (2, 2)
    path.write_text("1|2\n3|4\n")
    assert read(path, Reading(delimiter="|"))[0].tolist() == [[2.0, 4.0]]
    rows = [f"{i},{i / 100},{i * 10**7},{i % 3},{i}" for i in range(50)]
    path.write_text("\n".join([",time,timestamp_ns,g1,g2", *rows]) + "\n")
    assert read(path)[1] == ("g1", "g2")  # neither the number of the row nor other times


def test_a_large_table_is_read_by_stretches(tmp_path):
    values = noise(60_000, 3)
    rows = [f"{a!r},{b!r},{c!r}" for a, b, c in values.tolist()]
    (tmp_path / "a.csv").write_text("a,b,c\n" + "\n".join(rows) + "\n")
    with open_file(tmp_path / "a.csv", Reading(sample_rate_hz=2000.0)) as opened:
        assert opened.samples.num_samples == 60_000
        np.testing.assert_array_equal(opened.samples.read(33_000, 33_100), values[33_000:33_100].T)
        found = torch.cat(list(pieces(opened.samples, 7777)), 1)
    np.testing.assert_array_equal(found, values.T)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("t,a\n0,1\n1,2,3\n2,3\n", "line 3"),
        ("t,a\n0,1\n1\n", "line 3"),
        ("t,a\n0,1\n\n# b\n1,two\n", "line 5: 'two' is no number"),
        ("t,a\n0,x\n1,2\n", "line 2: 'x' is no number"),
        ("t,a\n0,1\n1,0x10\n", "line 3: '0x10' is no number"),
        ("t,a\n0,1\n1,1_0\n", "line 3: '1_0' is no number"),
        ("t,a,b\n0,1\n1,2\n", "3 columns are named"),
        ("t,a,a\n0,1,2\n", "two columns are called 'a'"),
        ("0;1,234\n1;5,678\n", "decimals or thousands"),
        ("t,a,b\n", "no row of numbers"),
        ("t,a\n0,1\n1\0,2\n", "NUL"),
        ("0,1\n" + "9" * 2_100_000, "line 2"),
        (("0," + "0" * 40 + "\n") * 30_000 + "0,1,2", "line 30001"),
        (LVM.format(x="Multi", point=".") + "0.0\t1.5\t-2.0\n", "line 4: times for each column"),
    ],
)
def test_what_is_wrong_in_text_has_its_line(tmp_path, content, said):
    (tmp_path / "a.csv").write_text(content)
    assert said in refused(tmp_path / "a.csv")


# What people's programs write ------------------------------------------------------------------

HUNDRED = {"sample_rate_hz": 100.0}
TIMELESS = HUNDRED | {"time": None}
NAN, INF = float("nan"), float("inf")
COUNTS = ["frame", "Frame Index", "episode_index", "seq", "label", "Slip [0/1]", "time (min)"]
STAMP = 1_700_000_000  # seconds since 1970
FOREIGN = [  # head, the i-th of 40 lines, how it is read, names, the last sample, rate by its times
    ("time,a,b\n", "{s},-1.#IND,1.#INF", {}, "ab", [NAN, INF], 100),  # as Microsoft writes them
    # a line of units below names, or in their place; units in names; units that are said
    ("Time,Ch A\n(ms),(mV)\n", "{half},{i}", {}, ["Ch A"], [39], 2000),
    ("ms,mV\n", "{half},{i}", {}, None, [39], 2000),
    ("Time (sec),a\n", "{s},{i}", {}, "a", [39], 100),
    ("Timestamp (\N{MICRO SIGN}s),a\n", "{i}00,{i}", {}, "a", [39], 1e4),
    ("millis,a\n", "{i}0,{i}", {}, "a", [39], 100),
    ("time (ms),a\n", "{i},{i}", {"time_unit": "us"}, "a", [39], 1e6),
    # stamps since 1970 in s, ms, us and ns, and without names
    ("t,a\n", f"{STAMP}.{{ii}},{{i}}", {}, "a", [39], 100),
    ("timestamp,a\n", f"{STAMP}{{ii}}0,{{i}}", {}, "a", [39], 100),
    ("timestamp,a\n", f"{STAMP}{{ii}}0000,{{i}}", {}, "a", [39], 100),
    ("timestamp,a\n", f"{STAMP}{{ii}}0000000,{{i}}", {}, "a", [39], 100),
    ("", f"{STAMP}{{ii}}0,{{i}}", {}, None, [39], 100),
    # no channels by their names, as rostopic echo and others have them
    (
        "%time,field.header.seq,field.header.frame_id,field.data\n",
        *(f"{STAMP}{{ii}}0000000,1,b,{{i}}", {}, ["field.data"], [39], 100),
    ),
    (f"time,a,{','.join(COUNTS)}\n", f"{{s}},{{i}}{',1' * len(COUNTS)}", {}, "a", [39], 100),
    ("time,thumb,index\n", "{s},1,{i}", {}, ["thumb", "index"], [1, 39], 100),
    ("time,b,seq\n", "{s},1,{i}", {"channels": ["seq", "b"]}, ["seq", "b"], [39, 1], 100),
    ("time,a\n", "{i}7,{i}", TIMELESS, "a", [39], None),
    # words in a column that is not read
    ("time,a,note\n", "{s},{i},slip", {"channels": ["a"]}, "a", [39], 100),
    ("time,a,label\n", "{s},{i},slip", {}, "a", [39], 100),
    # columns that are counted, also with decimal commas and of whole numbers; a row alike
    ("0,1\n", "{half},{i}.25", TIMELESS, "01", [19.5, 39.25], None),
    ("0;1\n", "0,{ii};1,{ii}", HUNDRED, "01", [0.39, 1.39], None),
    ("0,1\n", "5{ii},4{ii}", HUNDRED, "01", [539, 439], None),
    ("", "{s:g},1{ii}", {}, None, [139], 100),
    ("a\tb\n", "{tab}", HUNDRED, "ab", [NAN, NAN], None),  # tabs alone are a row
]


def lines(line):
    """The 40 lines of a table at 100 Hz."""
    tabs = ["1\t2"] * 39 + ["\t"]
    return "".join(
        line.format(i=i, ii=f"{i:02d}", s=i / 100, half=i * 0.5, tab=tabs[i]) + "\n"
        for i in range(40)
    )


@pytest.mark.parametrize(("head", "line", "how", "names", "last", "rate"), FOREIGN)
def test_nothing_that_people_write_is_read_silently_wrong(
    tmp_path, head, line, how, names, last, rate
):
    (tmp_path / "a.csv").write_text(head + lines(line), encoding="utf-8")
    samples, found, since, _ = read(tmp_path / "a.csv", Reading.of(how))
    assert found == (names and tuple(names))
    assert samples.shape[1] == 40
    np.testing.assert_array_equal(samples[:, -1], last)
    assert (since is None) == (rate is None)
    if rate is not None:
        assert even_clock(since).sample_rate_hz == pytest.approx(rate, rel=1e-6)


def parquet(**columns):
    return lambda path: pq.write_table(pa.table(columns), path)


def joints(names, stamps):
    """Messages of joints with a position each, which may come in another order."""
    kind, none = "sensor_msgs/msg/JointState", np.array([])
    messages = []
    for number, (order, stamp) in enumerate(zip(names, stamps, strict=True)):
        values = np.array(["lr".index(name) + 1.0 for name in order])
        message = stamped(kind, stamp, list(order), values, none, none)
        messages.append((START_NS + number * 10**7, message))
    return lambda path: write_mcap(path, [Sent("/j", kind, messages)])


LATE = [0, 0, 0, *(START_NS + n * 10**7 for n in range(3, 40))]
FILES = {  # file, what writes it, and what is said; or names, and numbers of the last sample
    "windows.npz": (
        lambda path: np.savez(path, X=np.zeros((40, 3, 100)), y=np.arange(40) % 2),
        "'X', which has 3 dimensions",
    ),
    "labels.npz": (
        lambda path: np.savez(path, a=np.arange(40), label=np.zeros(40), frame=np.zeros(40)),
        *(("a",), [39.0]),
    ),
    "lists.parquet": (
        parquet(tactile=[[1.0, 2.0]] * 9, timestamp=np.arange(9) / 10, frame_index=np.arange(9)),
        "'tactile' holds 'list<element: double>'",
    ),
    "frames.parquet": (
        parquet(index=np.arange(9), task_index=np.arange(9)),
        "no column of samples: 'index', 'task_index' is taken for times, a label or book-keeping",
    ),
    "pandas.parquet": (
        parquet(a=np.arange(9.0), __index_level_0__=np.arange(9)),
        *(("a",), [8.0]),
    ),
    "swapped.mcap": (
        joints([*["lr"] * 9, "rl"], [START_NS + n * 10**7 for n in range(10)]),
        *(("position[l]", "position[r]"), [1.0, 2.0]),
    ),
    "other.mcap": (joints(["l", "r"], [1, 2]), "with other channels than the first"),
    "stamps.mcap": (joints(["l"] * 40, LATE), "no stamp in message 1 on /j"),
    "words.csv": (
        lambda path: path.write_text("time,a,note\n0,1,slip\n1,2,\n2,3,\n"),
        "line 2: 'slip' is no number, in column 'note'",
    ),
    "dates.csv": (
        lambda path: path.write_text("timestamp,a\n" + lines("2024-05-01T12:{i},{i}")),
        "line 2: '2024-05-01T12:0' is no number, in column 'timestamp'",
    ),
    "label.csv": (
        lambda path: path.write_text("time,label\n0,1\n1,2\n"),
        "list it as reading.channels",
    ),
    **{
        f"pointer.{ending}": (
            lambda path: path.write_text(
                "version https://git-lfs.github.com/spec/v1\noid sha256:0"
            ),
            "is a Git LFS pointer, not the file itself; run: git lfs pull",
        )
        for ending in ("parquet", "npy", "csv")
    },
    "empty.csv": (lambda path: path.touch(), "is empty"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_all_formats_are_read_as_meant_or_refused_in_a_line(tmp_path, name):
    write, *wanted = FILES[name]
    write(tmp_path / name)
    if len(wanted) == 1:
        assert wanted[0] in refused(tmp_path / name)
        return
    samples, names, *_ = read(tmp_path / name)
    assert (names, samples[:, -1].tolist()) == tuple(wanted)


# Arrays: NumPy, HDF5, MAT, Parquet -------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["f4", ">f8", "u2", "i4"])
def test_numpy_arrays(tmp_path, dtype):
    volts = np.random.default_rng(0).integers(0, 99, (60, 3)).astype(dtype)
    np.save(tmp_path / "a.npy", volts)
    np.save(tmp_path / "b.npy", np.asfortranarray(volts))
    np.savez(tmp_path / "a.npz", samples=volts.T)
    np.savez_compressed(tmp_path / "b.npz", samples=np.asfortranarray(volts.T))
    is_small = np.dtype(dtype).itemsize <= (4 if np.dtype(dtype).kind == "f" else 2)
    for path in sorted(tmp_path.iterdir()):
        samples, names, since, rate = read(path)
        np.testing.assert_array_equal(samples, volts.T)
        assert samples.dtype == (torch.float32 if is_small else torch.float64)
        assert (names, since, rate) == (None, None, None)


def of_arrays(*names):
    return pytest.mark.parametrize("name", names)


@of_arrays("a.npz", "a.h5", "a.mat", "packed.mat", "73.mat")
def test_matrices_and_their_rate(tmp_path, name):
    volts = noise(60, 3).astype(np.float32)
    for values in (volts, volts.T):
        path = stored(tmp_path / name, volts=values, Fs=250.0, note="hello")
        samples, names, since, rate = read(path)
        np.testing.assert_array_equal(samples, volts.T)
        assert (names, since, rate, samples.dtype) == (None, None, 250.0, torch.float32)
    assert read(path, Reading(time_first=False))[0].shape == (3, 60)
    assert "volts'" in refused(path, Reading(samples="clock"))
    assert "'clock'" in refused(path, Reading(time="clock"))
    square = stored(tmp_path / name, volts=np.zeros((3, 3)))
    assert "reading.time_first" in refused(square)


@of_arrays("a.npz", "a.h5", "a.mat", "73.mat")
def test_columns_and_their_times(tmp_path, name):
    columns = {"x": np.arange(9.0), "y": np.arange(9, dtype="i2")}
    columns |= {"Timestamp": 10**15 + 2000 * np.arange(9.0)}
    samples, names, since, rate = read(
        stored(tmp_path / name, **columns, Rate=500.0), Reading(time_unit="us")
    )
    assert (names, rate, samples.tolist()) == (("x", "y"), 500.0, [list(range(9))] * 2)
    assert since.tolist() == [2000 * i * 1e-6 for i in range(9)]
    path = tmp_path / name
    samples, names, since, _ = read(path, Reading(channels=("y",), time=None))
    assert (names, since, samples.dtype) == (("y",), None, torch.float32)
    assert "say reading.channels" in refused(stored(path, x=np.zeros(9), y=np.zeros(8)))
    assert read(path, Reading(channels=("y",)))[0].shape == (1, 8)


@of_arrays("a.h5", "a.mat", "73.mat")
def test_groups_of_arrays_and_words(tmp_path, name):
    mark = "/" if name == "a.h5" else "."
    groups = {"a/volts": np.zeros((60, 3)), "b/volts": np.ones((50, 2)), "b/Rate": 500.0}
    path = stored(tmp_path / name, **groups, t=np.zeros(7), rate=1.0)
    said = refused(path)
    assert f"a{mark}volts" in said
    assert "say reading.samples" in said
    for one in ("b", f"b{mark}volts"):  # a group may be named as well
        samples, _, _, rate = read(path, Reading(samples=one))
        assert (samples.shape, rate) == ((2, 50), 500.0)  # what is said nearest
    assert "'c'" in refused(path, Reading(samples="c"))
    assert "7" in refused(path, Reading(samples=f"a{mark}volts", time="t"))
    assert "3" in refused(path, Reading(samples=f"a{mark}volts", channels=(0, 3)))
    words = ["left", "right", "time_ms"]  # the third column is times by its name
    path = stored(tmp_path / name, **{"in/volts": noise(60, 3)}, labels=words)
    assert read(path)[1] == ("left", "right")
    found, names, *_ = read(path, Reading(channels=("right", 0), time=None))
    np.testing.assert_array_equal(found, noise(60, 3).T[[1, 0]])
    assert names == ("right", "left")


def test_hdf5_says_more_in_attributes(tmp_path):
    path = made_hdf5(tmp_path / "a.h5", **{"imu/x": np.arange(9.0), "imu/y": np.arange(9)})
    with h5py.File(path, "a") as file:  # nanoseconds since 1970: no float64 holds them
        file["imu/Timestamp"] = 10**18 + 2_000_000 * np.arange(9)
        file["imu"].attrs["Rate"] = 500.0
        file.attrs["rate"] = 1.0
    _, names, since, rate = read(path, Reading(time_unit="ns"))
    assert (names, rate) == (("x", "y"), 500.0)
    assert since.tolist() == [2_000_000 * i * 1e-9 for i in range(9)]
    with h5py.File(path, "w") as file:
        packed = {"chunks": (500, 3), "compression": "gzip"}
        file.create_dataset("volts", data=noise(9000, 3), **packed)
        file["volts"].attrs["channel_name"] = ["q", "r", "s"]
    np.testing.assert_array_equal(read(path)[0], noise(9000, 3).T)
    assert read(path, Reading(channels=("s", 0)))[1] == ("s", "q")


def test_mat_files_hold_more_than_numbers(tmp_path):
    trial = {"x": np.arange(50.0), "deep": {"z": np.ones((50, 1))}}
    other = {"when": "today", "parts": np.array([1, "a"], dtype=object)}
    scipy.io.savemat(tmp_path / "a.mat", {"trial": trial, "other": other})
    assert read(tmp_path / "a.mat", Reading(time=None))[1] == ("x", "z")
    assert read(tmp_path / "a.mat", Reading(samples="trial.deep.z", time=None))[1] == ("z",)
    assert "cell" in refused(tmp_path / "a.mat", Reading(samples="other.parts"))
    words = np.array(["left", "right", "Mitte"])  # characters, where others have cells
    scipy.io.savemat(tmp_path / "a.mat", {"volts": np.zeros((60, 3)), "channels": words})
    assert read(tmp_path / "a.mat")[1] == ("left", "right", "Mitte")
    path = made_73(tmp_path / "b.mat", x=np.arange(9.0), word="hello", is_on=np.ones(9, "?"))
    assert read(path)[1] == ("x",)


@pytest.mark.parametrize("rows", [4, 1000])
def test_parquet_tables(tmp_path, rows):
    path = tmp_path / "a.parquet"
    stamps = np.datetime64("2026-01-02T03:04:05", "us") + np.arange(9) * 500
    columns = {"note": ["a"] * 9, "when": stamps, "x": np.arange(9.0), "y": np.ones(9, "i2")}
    pq.write_table(pa.table(columns), path, row_group_size=rows)
    samples, names, since, _ = read(path)
    assert (names, samples.tolist()) == (("x", "y"), [list(range(9)), [1.0] * 9])
    assert since.tolist() == [500 * i * 1e-6 for i in range(9)]
    assert read(path, Reading(channels=("y", 2)))[1] == ("y", "x")  # numbers count every column
    assert "'note'" in refused(path, Reading(channels=("note",)))
    assert "'q'" in refused(path, Reading(channels=("q",)))
    assert "9" in refused(path, Reading(time=9))
    table = pa.table({"x": pa.array([1, None, 3], pa.int16()), "time_ms": [0.0, 5.0, 10.0]})
    pq.write_table(table.replace_schema_metadata({"Fs": "250", "by": "me"}), path)
    samples, names, since, rate = read(path)
    np.testing.assert_array_equal(samples, [[1, np.nan, 3]])
    assert (names, since.tolist(), rate) == (("x",), [0.0, 0.005, 0.01], 250.0)


# Messages: MCAP and rosbag2 --------------------------------------------------------------------


def in_mcap(*how):
    return lambda folder, topics: write_mcap(folder / "a.mcap", topics, *how)


def in_bag(*how):
    return lambda folder, topics: write_bag(folder / "bag", topics, *how)


@pytest.mark.parametrize(
    "written",
    [
        *(in_mcap("none", False, False), in_mcap("none"), in_mcap("lz4", True, False), in_mcap()),
        *(in_bag(), in_bag("sqlite3", "message"), in_bag("mcap"), in_bag("mcap", "storage")),
    ],
)
def test_stamped_messages(tmp_path, written):
    sent, values = wrenches(500)
    path = written(tmp_path, [Sent("/rosout", WRENCH, sent.messages[:3]), sent])
    samples, names, since, _ = read(path)
    np.testing.assert_array_equal(samples, values)
    assert names[:2] == ("wrench.force.x", "wrench.force.y")
    stamps_s = np.arange(500) * STEP_NS / 1e9  # though those of the file are of 2023
    np.testing.assert_array_equal(since, stamps_s)
    chosen = Reading(channels=("wrench.torque.z", 0))
    np.testing.assert_array_equal(read(path, chosen)[0], values[[5, 0]])
    assert "'nope'" in refused(path, Reading(channels=("nope",)))


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_bag_in_several_files_is_one_recording(tmp_path, storage):
    sent, values = wrenches(300)
    ending = {"sqlite3": "db3", "mcap": "mcap"}[storage]
    for number in (0, 1):
        part = Sent(sent.topic, sent.kind, sent.messages[150 * number : 150 * number + 150])
        write_bag(tmp_path / f"part{number}", [part], storage)
    bag = tmp_path / "part0"
    shutil.copy(tmp_path / "part1" / f"part1.{ending}", bag)
    text = (bag / "metadata.yaml").read_text()
    line = next(line for line in text.splitlines() if f"- part0.{ending}" in line)
    second = line.replace("part0", "part1")
    text = text.replace(line, f"{line}\n{second}", 1)
    (bag / "metadata.yaml").write_text(text)
    assert "holds 300 messages, where its metadata say 150" in refused(bag)
    (bag / "metadata.yaml").write_text(text.replace("message_count: 150", "message_count: 300"))
    np.testing.assert_array_equal(read(bag)[0], values)


@pytest.mark.parametrize("field", ["timestamp", "header", "t", "time_us", "clock"])
def test_json_messages_and_their_times(tmp_path, field):
    values, messages = noise(50, 3), []
    for row, time in zip(values, times(50), strict=True):
        stamp = dict(zip(("sec", "nsec"), divmod(time, 10**9), strict=True))
        since = time - START_NS
        own = {
            "timestamp": {"timestamp": stamp},
            "header": {"header": {"stamp": stamp, "frame_id": "hand"}},
            "t": {"t": since * 1e-9},
            "time_us": {"time_us": since * 1e-3},
            "clock": {"clock": since},
        }[field]
        content = own | {"v": list(row[:2]), "deep": {"x": row[2], "text": "1.5"}}
        messages.append((7, json_message(content)))
    sent = Sent("/t", "thing", messages, "json", "jsonschema", "{}")
    how = Reading(time="clock", time_unit="ns") if field == "clock" else None
    samples, names, since, _ = read(write_mcap(tmp_path / "a.mcap", [sent]), how)
    assert names == ("v[0]", "v[1]", "deep.x")
    np.testing.assert_array_equal(samples, values.T)
    np.testing.assert_allclose(since, np.arange(50) * STEP_NS / 1e9, rtol=0, atol=1e-12)


def test_log_times_and_stamps_of_zero(tmp_path):
    values = noise(20, 6)
    messages = [(time, wrench(row, 0)) for time, row in zip(times(20), values, strict=True)]
    path = write_mcap(tmp_path / "a.mcap", [Sent("/ft", WRENCH, messages)])
    assert read(path)[2].tolist() == [n * STEP_NS / 1e9 for n in range(20)]
    messages = [(5 * t, wrench(row, t)) for t, row in zip(times(20), values, strict=True)]
    path = write_mcap(tmp_path / "b.mcap", [Sent("/ft", WRENCH, messages)])
    since = read(path, Reading(time="log_time"))[2]
    assert since.tolist() == [n * 5 * STEP_NS / 1e9 for n in range(20)]
    assert read(path, Reading(time=None))[2] is None


def blocks_of(values, lengths):
    """Blocks of samples ``[n, C]`` of these lengths, each logged at its first sample."""
    edges = np.cumsum([0, *lengths])
    return [
        (
            START_NS + int(first) * STEP_NS,
            array(values[first:stop].reshape(-1), ("samples", "ch"), (stop - first, 3)),
        )
        for first, stop in pairwise(edges)
    ]


def test_blocks_of_samples(tmp_path):
    lengths = np.random.default_rng(2).permutation(np.arange(1, 61))
    values = noise(int(lengths.sum()), 3)
    path = write_mcap(tmp_path / "a.mcap", [Sent("/b", FLOATS, blocks_of(values, lengths))])
    samples, names, since, _ = read(path)
    assert names is None
    np.testing.assert_array_equal(samples, values.T)
    np.testing.assert_allclose(since, np.arange(len(values)) * STEP_NS / 1e9, rtol=0, atol=1e-12)
    messages = blocks_of(values, [20] * 50)
    del messages[17]
    with open_file(write_mcap(path, [Sent("/b", FLOATS, messages)])) as opened:
        clock = even_clock(opened.times())
    assert [(gap.start, gap.missing) for gap in clock.gaps] == [(340, 20)]
    single = write_mcap(path, [Sent("/b", FLOATS, blocks_of(values, [9]))])
    assert read(single)[2] is None
    since = read(single, Reading(sample_rate_hz=100.0))[2]
    np.testing.assert_allclose(since, np.arange(9) / 100)


TAXELS = "hand_msgs/msg/Taxels"


OWN = "std_msgs/Header header\nfloat32[4] volts\nint16 number\n"


def taxels(count, text=OWN, **how):
    """Messages of a type that ROS does not bring, and that only their file defines."""
    store, messages = get_typestore(Stores.ROS2_JAZZY), []
    store.register(get_types_from_msg(OWN, TAXELS))
    for number in range(count):
        fields = np.arange(4, dtype="f4") + number, number
        messages.append((7, stamped(TAXELS, number * STEP_NS, *fields, store=store)))
    return Sent("/taxels", TAXELS, messages, schema=text, **how)


def test_types_that_a_file_defines(tmp_path):
    samples, names, since, _ = read(write_mcap(tmp_path / "a.mcap", [taxels(9)]))
    assert names == ("volts[0]", "volts[1]", "volts[2]", "volts[3]", "number")
    assert samples.tolist() == [[n + k for n in range(9)] for k in range(4)] + [list(range(9))]
    assert since.tolist() == [n * STEP_NS / 1e9 for n in range(9)]


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (taxels(3, "float32 __class__\n"), "a definition of hand_msgs/msg/Taxels"),
        (taxels(3, "float32 import\n"), "with unusual names or sizes"),
        (taxels(3, "float32[100000] volts\n"), "with unusual names or sizes"),
        (taxels(3, "no { definition"), "that is no ros2msg"),
        (taxels(3, schema_encoding=""), "no definition of hand_msgs/msg/Taxels as ros2msg"),
        (
            Sent("/b", FLOATS, [(1, array(np.ones(6), ("samples", "ch"), (7, 7)))]),
            "6 numbers in a layout of [7, 7]",
        ),
        (
            Sent("/b", FLOATS, [(n, array(np.ones(n))) for n in (3, 4)]),
            "other channels than the first: 4 numbers",
        ),
        (
            Sent("/j", "x", [(1, json_message({"a.b": 1, "a": {"b": 2}}))], "json", "", ""),
            "two numbers of one name",
        ),
        (
            Sent("/j", "x", [(1, json_message({"a": [0] * 5000}))], "json", "", ""),
            "numbers an instant, 1 to 4096 are read",
        ),
    ],
)
def test_messages_that_are_no_samples_are_named(tmp_path, sent, said):
    assert said in refused(write_mcap(tmp_path / "a.mcap", [sent]))


def test_messages_go_by_their_times(tmp_path):
    sent, values = wrenches(400)
    sent.messages = [sent.messages[n] for n in np.random.default_rng(0).permutation(400)]
    for path in (write_mcap(tmp_path / "a.mcap", [sent]), write_bag(tmp_path / "bag", [sent])):
        samples, _, since, _ = read(path)
        np.testing.assert_array_equal(samples, values)
        assert (np.diff(since) > 0).all()


def test_the_topic_is_the_one_named_or_the_only_one(tmp_path):
    (left, values), (right, others) = wrenches(30, "/left"), wrenches(30, "/right", seed=1)
    log = Sent("/rosout", WRENCH, left.messages)
    text = Sent("/text", "std_msgs/msg/String", [(1, b"\0\1\0\0\2\0\0\0a\0")])
    unread = Sent("/proto", "x.Y", [(1, b"abc")], "protobuf", "protobuf", "")
    two = (
        write_mcap(tmp_path / "a.mcap", [log, text, unread, left, right]),
        write_bag(tmp_path / "bag", [log, text, left, right]),
    )
    for path in two:
        said = refused(path)
        assert "/left, /right" in said
        assert "reading.samples" in said
        for topic, wanted in (("/left", values), ("/right", others)):
            np.testing.assert_array_equal(read(path, Reading(samples=topic))[0], wanted)
        assert "/left" in refused(path, Reading(samples="/no"))
    assert "protobuf" in refused(two[0], Reading(samples="/proto"))
    alone = write_mcap(tmp_path / "b.mcap", [log, text, left])
    np.testing.assert_array_equal(read(alone)[0], values)
    assert "no topic with samples" in refused(write_mcap(tmp_path / "c.mcap", [text]))


# Libraries that are not there ------------------------------------------------------------------

NEEDED = {"a.h5": "h5py", "a.mcap": "mcap", "a.parquet": "pyarrow"}


@pytest.mark.parametrize("name", NEEDED)
def test_an_absent_library_is_one_line_with_its_remedy(tmp_path, monkeypatch, name):
    find_spec, library = importlib.util.find_spec, NEEDED[name]

    def hidden(module, *rest):
        return None if module.partition(".")[0] == library else find_spec(module, *rest)

    monkeypatch.setattr("importlib.util.find_spec", hidden)
    with pytest.raises(ValueError, match=f"needs {library}, which is not installed") as caught:
        named_format(name[2:]).save(tmp_path / name, recording(), hand_of("ab"), KEY)
    assert f"pip install {library}" in str(caught.value)
