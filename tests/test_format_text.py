"""Recordings as text: ours to the bit, what people have, or one line that says what is wrong."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.formats import text, text_table
from tactslip_torch.data.formats.reading import AS_IT_SAYS, Reading, pieces

KEY = {"scene": {"seed": 3}, "code": "abc"}
names_of_channels = st.lists(st.text(max_size=6), min_size=1, max_size=4, unique=True)


def hand_of(names):
    return HandLayout.from_rows(
        {"name": name, "kind": "SG", "finger": "index", "segment": "distal"} for name in names
    )


def recording(samples, rate=2000.0):
    return Recording(
        samples,
        rate,
        "M1",
        (20.0,),
        (0.1 + 1e-9,),
        ((0.05, 1 / 3),),
        (),
        ((0.01, 0.02),),
        {"simulated": True},
    )


def bits(samples):
    """Bytes in which one NaN is as good as another."""
    array = samples.numpy().copy()
    array[np.isnan(array)] = np.nan
    return array.tobytes()


def read(path, how=AS_IT_SAYS):
    """All that a file of somebody gives: samples, names, times, rate."""
    with text.open(path, how) as opened:
        samples = opened.samples
        times = opened.times and opened.times.read(0, samples.num_samples)
        assert opened.archived is None
        assert samples.dtype == torch.float64
        return samples.read(0, samples.num_samples), opened.names, times, opened.sample_rate_hz


def table(path, content, how=AS_IT_SAYS):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read(path, how)


def refused(path, content, how=AS_IT_SAYS):
    """The one line that a file gets."""
    with pytest.raises(ValueError, match=r".") as caught:
        table(path, content, how)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    return str(caught.value).removeprefix(str(path))


# Ours ----------------------------------------------------------------------------------------


@given(data=st.data())
@settings(max_examples=60)
def test_what_goes_in_comes_out(tmp_path_factory, data):
    names = data.draw(names_of_channels)
    dtype = data.draw(st.sampled_from([np.float32, np.float64]))
    num_samples = data.draw(st.integers(0, 9))
    size = len(names) * num_samples * np.dtype(dtype).itemsize
    raw = data.draw(st.binary(min_size=size, max_size=size))  # every NaN and subnormal as well
    samples = torch.from_numpy(np.frombuffer(raw, dtype).reshape(len(names), num_samples).copy())
    ending = data.draw(st.sampled_from(["csv", "CSV", "tsv", "txt", "dat"]))
    path = tmp_path_factory.mktemp("text") / f"a.{ending}"
    wanted = recording(samples, data.draw(st.floats(0.1, 1e6)))
    text.save(path, wanted, hand_of(names), KEY)
    found = text.load(path)
    assert bits(found.recording.samples) == bits(samples)
    for name in ("sample_rate_hz", "onsets_s", "sliding_s", "non_slip_s", "provenance"):
        assert getattr(found.recording, name) == getattr(wanted, name), name
    assert (found.hand, found.key, text.key(path)) == (hand_of(names), KEY, KEY)
    with text.open(path) as opened:
        assert opened.archived.recording.samples.shape == (len(names), 0)
        assert (opened.archived.hand, opened.archived.key) == (found.hand, KEY)
        assert (opened.names, opened.sample_rate_hz) == (tuple(names), wanted.sample_rate_hz)
        first, stop = sorted(data.draw(st.tuples(st.integers(0, 12), st.integers(0, 12))))
        assert bits(opened.samples.read(first, stop)) == bits(samples[:, first:stop])


def test_a_float32_whose_shortest_text_rounds_twice(tmp_path):
    value = np.nextafter(np.float32(7.038531e-26), np.float32(0))
    assert str(value) == "7.038531e-26"
    assert np.float32(float(str(value))) != value  # a float64 in between ends at its neighbour
    samples = torch.full((1, 3), float(value))
    text.save(tmp_path / "a.csv", recording(samples), hand_of("a"), {})
    assert bits(text.load(tmp_path / "a.csv").recording.samples) == bits(samples)


def test_our_file_as_others_see_it(tmp_path):
    samples = torch.tensor([[0.1, float("nan"), -0.0], [1e-7, 2.5, -3.0]])
    text.save(tmp_path / "a.csv", recording(samples), hand_of(["SG1", 'a "b", c']), KEY)
    head, names, *rows = (tmp_path / "a.csv").read_text().splitlines()
    form, _, header = head.partition(" {")
    assert form == "# tactslip_torch recording 1"
    assert json.loads("{" + header)["shape"] == [2, 3]
    assert names == 'time_s,SG1,"a ""b"", c"'
    assert rows == ["0.0,0.1,1e-07", "0.0005,nan,2.5", "0.001,-0.0,-3.0"]
    numbers = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=2)
    np.testing.assert_array_equal(numbers[:, 1:].T.astype(np.float32), samples)
    found, columns, times, _ = table(tmp_path / "b.csv", "\n".join([names, *rows]))
    np.testing.assert_array_equal(found.float(), samples)
    assert columns == ("SG1", 'a "b", c')
    assert times.tolist() == [0.0, 0.0005, 0.001]


def test_equal_recordings_are_equal_bytes(tmp_path):
    for name in "ab":
        text.save(tmp_path / f"{name}.tsv", recording(torch.eye(2)), hand_of("xy"), KEY)
    assert (tmp_path / "a.tsv").read_bytes() == (tmp_path / "b.tsv").read_bytes()
    assert "0.0\t1.0\t0.0\n" in (tmp_path / "a.tsv").read_text()


@pytest.mark.parametrize(
    "change", ["row", "row twice", "header", "names", "name", "shape", "bytes"]
)
def test_a_damaged_file_of_ours_is_refused(tmp_path, change):
    path = tmp_path / "a.csv"
    text.save(path, recording(torch.randn(2, 9)), hand_of("ab"), KEY)
    header, names, *rows = path.read_bytes().splitlines(keepends=True)
    lines = {
        "row": [header, names, *rows[:-1]],
        "row twice": [header, names, *rows, rows[-1]],
        "header": [header.replace(b'"key"', b'"kez"'), names, *rows],
        "names": [header, *rows],
        "name": [header.replace(b'"name": "b"', b'"name": "a"'), names, *rows],
        "shape": [header.replace(b'"shape": [2, 9]', b'"shape": [2, 1000000000000]'), names, *rows],
        "bytes": [header.replace(b"M1", b"\xff1"), names, *rows],
    }[change]
    path.write_bytes(b"".join(lines))
    for reader in (text.load, lambda path: text.open(path).__enter__()):
        with pytest.raises(ValueError, match=r"a\.csv is damaged or no recording of ours"):
            reader(path)


def test_what_is_not_ours_is_not_loaded(tmp_path):
    (tmp_path / "a.csv").write_text("t,a\n0,1\n")
    (tmp_path / "b.csv").write_text("# tactslip_torch recording 2 {}\n")
    for reader in (text.load, text.key):
        with pytest.raises(ValueError, match=r"a\.csv is damaged or no recording of ours"):
            reader(tmp_path / "a.csv")
        with pytest.raises(ValueError, match="must be of format 'tactslip_torch recording 1', got"):
            reader(tmp_path / "b.csv")
        with pytest.raises(FileNotFoundError, match=r"no file at .*c\.csv"):
            reader(tmp_path / "c.csv")
    with pytest.raises(FileNotFoundError, match="no file at"), text.open(tmp_path / "c.csv"):
        pass


# What people have ----------------------------------------------------------------------------

ROWS = [[0.0, 1.5, -2.0], [0.5, 2.5, 4e-3], [1.0, float("nan"), 5.0]]


def assert_rows(found, names=("a", "b")):
    samples, columns, times, rate = found
    np.testing.assert_array_equal(samples, np.array(ROWS)[:, 1:].T)
    assert columns == names
    assert times.tolist() == [0.0, 0.5, 1.0]
    assert rate is None


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("t,a,b\n0,1.5,-2\n0.5,2.5,4e-3\n1,nan,5\n", ("a", "b")),
        ("t,a,b\r\n0,1.5,-2\r\n0.5,2.5,4e-3\r\n1,NaN,5", ("a", "b")),
        ("Time (s), a , b\n0, 1.5, -2\n0.5, 2.5, 4E-3\n1, , +5.\n", ("a", "b")),
        ("t\ta\tb\n0\t1.5\t-2\n.5\t2.5\t.004\n1\t\t5\n", ("a", "b")),
        ("0\t1.5\t-2\n0.5\t2.5\t4e-3\n1\tnan\t5\n", None),
        ("0.0\t1.5\t-2\t\n0.5\t2.5\t4e-3\t\n1\tnan\t5\t\n", None),
        ("t;a;b;\n0;1.5;-2;\n0.5;2.5;4e-3;\n1;;5;\n", ("a", "b")),
        ("t;a;b\n0;1,5;-2\n0,5;2,5;4e-3\n1;;5\n", ("a", "b")),
        ("0\t1,5\t-2\t\n0,5\t2,5\t,004\t\n1\tnan\t5\t\n", None),
        ("  0   1.5  -2\n  0.5 2.5  4e-3\n  1 nan 5\n", None),
        (' t "a" b\n 0 1.5 -2\n\n0.5 2.5 4e-3\n   \n1 nan 5\n', ("a", "b")),
        ('"t","a","b"\n"0","1.5","-2"\n"0.5","2.5","4e-3"\n"1","","5"\n', ("a", "b")),
        ("# t a b\n0 1.5 -2\n0.5 2.5 4e-3 # here\n# and\n1 nan 5\n", ("a", "b")),
        ("# 3 rows\n0 1.5 -2\n0.5 2.5 4e-3\n1 nan 5\n", None),
        ("A title\n\nt,a,b\ns,V,(V)\n0,1.5,-2\n0.5,2.5,4e-3\n1,nan,5\n", ("a", "b")),
        ("rate,2000,Hz\nt,a,b\n0,1.5,-2\n0.5,2.5,4e-3\n1,nan,5\n", ("a", "b")),
        ("t_ms,a,b\n0,1.5,-2\n500,2.5,4e-3\n1000,nan,5\n", ("a", "b")),
        ("t,a,b\n7,1.5,-2\n7.5,2.5,4e-3\n8,nan,5\n", ("a", "b")),
    ],
)
def test_a_table_is_found_out(tmp_path, content, names):
    assert_rows(table(tmp_path / "a.txt", content), names)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-16-be"])
def test_encodings(tmp_path, encoding):
    content = "t;Kraft °;b\n0;1,5;-2\n0,5;2,5;4e-3\n1;;5\n"
    mark = b"\xfe\xff" if encoding == "utf-16-be" else b""
    found = table(tmp_path / "a.txt", mark + content.encode(encoding))
    assert_rows(found, ("Kraft °", "b"))


def test_columns_are_chosen(tmp_path):
    path = tmp_path / "a.csv"
    content = "n,u,v,w\n5,1,2,3\n6,4,5,6\n"
    samples, names, times, _ = table(path, content)
    assert (samples.shape, names, times) == ((4, 2), ("n", "u", "v", "w"), None)
    samples, names, times, _ = table(path, content, Reading(time="n", channels=("w", 1)))
    assert (samples.tolist(), names) == ([[3.0, 6.0], [1.0, 4.0]], ("w", "u"))
    assert times.tolist() == [0.0, 1.0]
    assert read(path, Reading(time=0, time_unit="ms"))[2].tolist() == [0.0, 1e-3]
    bare = "1 2\n3 4\n"
    assert table(path, bare)[0].tolist() == [[2.0, 4.0]]
    assert table(path, bare, Reading(sample_rate_hz=9.0))[0].tolist() == [[1.0, 3.0], [2.0, 4.0]]
    assert table(path, bare, Reading(time=None))[0].shape == (2, 2)
    assert table(path, "1\n2\n")[0].tolist() == [[1.0, 2.0]]
    assert table(path, "1|2\n3|4\n", Reading(delimiter="|"))[0].tolist() == [[2.0, 4.0]]
    assert table(path, ",0,1\n0,1.5,2\n1,2.5,3\n")[1] == ("column 0", "0", "1")
    for wanted, said in [
        ({"time": "x"}, " has no column 'x' that reading.time names; it has 'n', 'u', 'v', 'w'"),
        ({"channels": (4,)}, " has no column 4 that reading.channels names; it has 4 columns"),
    ]:
        assert refused(path, content, Reading(**wanted)).startswith(said)
    assert "without names" in refused(path, bare, Reading(time="x"))
    assert "taken for times" in refused(path, "t\n1\n2\n")


LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t{point}\nX_Columns\t{x}\n"
    "***End_of_Header***\t\n\t\nChannels\t2\t\nSamples\t3\t3\t\nDate\t2012/06/01\t2012/06/01\t\n"
    "X_Dimension\tTime\tTime\t\nDelta_X\t0{point}500000\t0{point}500000\t\n"
    "***End_of_Header***\t\t\t\nX_Value\tUntitled\tUntitled 1\tComment\n"
)


@pytest.mark.parametrize("point", [".", ","])
@pytest.mark.parametrize("x", ["One", "No"])
def test_labview_measurements(tmp_path, x, point):
    rows = ["0.0\t1.5\t-2.0", "0.5\t2.5\t4E-3", "1.0\tNaN\t5.0"]
    rows = [row if x == "One" else row[row.index("\t") :] for row in rows]
    content = LVM.format(x=x, point=point) + "\n".join(rows).replace(".", point) + "\n"
    samples, names, times, rate = table(tmp_path / "a.lvm", content)
    np.testing.assert_array_equal(samples, np.array(ROWS)[:, 1:].T)
    assert (names, rate) == (("Untitled", "Untitled 1"), 2.0)
    assert times is None if x == "No" else times.tolist() == [0.0, 0.5, 1.0]


def test_labview_with_times_for_each_column(tmp_path):
    content = LVM.format(x="Multi", point=".") + "0.0\t1.5\t-2.0\n"
    assert refused(tmp_path / "a.lvm", content).startswith(", line 4: times for each column")


# What is wrong -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("t,a\n0,1\n1,2,3\n2,3\n", ", line 3: 3 cells, the row at line 2 has 2"),
        ("t,a\n0,1\n1\n", ", line 3: 1 cell, the row at line 2 has 2"),
        ("t,a\n0,1\n\n# b\n1,two\n", ", line 5: 'two' is no number"),
        ("t,a\n0,x\n1,2\n", ", line 2: 'x' is no number"),
        ("0.5,x\n1,2\n", ", line 1: 'x' is no number"),
        ("t,a\n0,1\n1,0x10\n", ", line 3: '0x10' is no number"),
        ("t,a\n0,1\n1,1_0\n", ", line 3: '1_0' is no number"),
        ("t,a\n0,1\n1,\u0663\n", ", line 3: "),
        ("t,a\n0,1\n1,N/A\n", ", line 3: 'N/A' is no number; leave empty what is missing"),
        ("t,a\n0,1\n1," + "y" * 99 + "\n", ", line 3: '" + "y" * 37 + "...' is no number"),
        ("t,a,b\n0,1\n1,2\n", ", line 1: 3 columns are named, the row at line 2 has 2"),
        ("t,a\n0,1,5\n1,2,5\n", ", line 1: 2 columns are named, the row at line 2 has 3"),
        ("t,a,a\n0,1,2\n", ", line 1: two columns are called 'a'"),
        ("0;1,234\n1;5,678\n", ": commas in its numbers may stand before decimals or thousands"),
        ("0;1,5\n1;2.5\n", ", line 1: '1,5' is no number"),
        ("0;1,5\n1;1.234,5\n", ", line 1: '1,5' is no number"),
        ("0,5 1,5\n1,5 2,5\n", " holds no row of numbers in its first 1 MiB"),
        ("", " holds no row of numbers"),
        ("t,a,b\n", " holds no row of numbers"),
        ("# t,a,b\n#\n", " holds no row of numbers"),
        ("to be or not to be\n", " holds no row of numbers"),
        ("t,a\n0,1\n1\0,2\n", " holds NUL bytes"),
        (b"\xff\xfe0\0,\x001\0\n", " is no whole UTF-16 text"),
        (b"\xff\xfe0\0\0\0", " is damaged or no recording of ours"),
        ("9" * 2_100_000, " holds no row of numbers"),
        ("0,1\n" + "9" * 2_100_000, ", line 2: has more than 1048576 bytes"),
        (("0," + "0" * 40 + "\n") * 30_000 + "\0" * 9, ", line 30001: holds NUL bytes"),
        (("0," + "0" * 40 + "\n") * 30_000 + "0,1,2", ", line 30001: 3 cells"),
    ],
)
def test_what_is_wrong_has_a_line(tmp_path, content, said):
    assert refused(tmp_path / "a.csv", content).startswith(said)


# In pieces -----------------------------------------------------------------------------------


@given(
    num_rows=st.integers(1, 60),
    chunk=st.integers(64, 400),
    kept=st.sampled_from([0, 500, 1 << 20]),
    size=st.integers(1, 70),
    stretch=st.tuples(st.integers(0, 70), st.integers(0, 70)),
    ending=st.sampled_from(["\n", "\r\n", "\n\n# no row\n"]),
    is_ended=st.booleans(),
)
@settings(max_examples=80)
def test_pieces_are_the_rows(
    tmp_path_factory, num_rows, chunk, kept, size, stretch, ending, is_ended
):
    values = np.random.default_rng(num_rows).standard_normal((num_rows, 2))
    rows = [f"{a!r},{b!r}" for a, b in values.tolist()]
    path = tmp_path_factory.mktemp("pieces") / "a.csv"
    path.write_bytes((ending.join(rows) + (ending if is_ended else "")).encode())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text_table, "HEAD", chunk)
        patch.setattr(text_table, "MOST_KEPT", kept)
        with text.open(path, Reading(time=None)) as opened:
            assert opened.samples.num_samples == num_rows
            found = torch.cat(list(pieces(opened.samples, size)), 1)
            part = opened.samples.read(*stretch)
    np.testing.assert_array_equal(found, values.T)
    np.testing.assert_array_equal(part, values.T[:, slice(*stretch)])


def test_what_was_read_is_not_the_files_to_change(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("0,1\n1,2\n")
    with text.open(path) as opened:
        opened.samples.read(0, 2).zero_()
        opened.times.read(0, 2).zero_()
        assert opened.samples.read(0, 2).tolist() == [[1.0, 2.0]]
        assert opened.times.read(0, 2).tolist() == [0.0, 1.0]


def test_a_file_that_changes_while_it_is_open_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(text_table, "MOST_KEPT", 0)
    path = tmp_path / "a.csv"
    path.write_text("0,1\n" * 1000)
    with text.open(path) as opened:
        with path.open("r+b") as file:
            file.truncate(400)
        with pytest.raises(ValueError, match=r"a\.csv changed while it was read"):
            opened.samples.read(0, 10)


def test_a_table_beyond_the_memory(tmp_path):
    """5 MB of text is walked through in less memory than its numbers would take."""
    path = tmp_path / "a.csv"
    path.write_text("0.125,0.5,1.5,2.5,3.5,4.5,5.5,6.5,7.5,8.5\n" * 120_000)
    program = (
        "import resource, sys\n"
        "from tactslip_torch.data.formats import reading, text, text_table\n"
        "text_table.MOST_KEPT, text_table.HEAD = 0, 2**16\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "with text.open(sys.argv[1]) as opened:\n"
        "    total = sum(float(p[0].sum()) for p in reading.pieces(opened.samples, 2000))\n"
        "after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(total, (after - before) // 1024)\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", program, path], capture_output=True, text=True, check=True
    )
    total, mebibytes = found.stdout.split()
    assert float(total) == 60_000.0
    assert int(mebibytes) < 6  # the numbers are 10


@pytest.mark.parametrize("start", [0, 7])
def test_the_number_of_a_row_and_further_times_are_no_channels(tmp_path, start):
    path = tmp_path / "a.csv"
    rows = [f"{start + i},{i / 100},{i * 10**7},{i % 3},{i}" for i in range(50)]
    path.write_text("\n".join([",time,timestamp_ns,g1,g2", *rows]) + "\n")
    with text.open(path) as opened:
        assert opened.names == ("g1", "g2")  # a ramp that has a name is a channel
        assert opened.samples.read(0, 50)[1].tolist() == list(range(50))
        assert opened.times.read(0, 50)[49] == pytest.approx(0.49)
    with text.open(path, Reading(time="timestamp_ns", time_unit="ns")) as opened:
        assert opened.names == ("g1", "g2")
    with text.open(path, Reading(channels=[0, "g1"])) as opened:
        assert opened.samples.num_channels == 2


def test_a_column_without_a_name_that_does_not_count_is_a_channel(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(",time,g1\n" + "".join(f"{i * 2},{i / 100},{i % 3}\n" for i in range(50)))
    with text.open(path) as opened:
        assert opened.names == ("column 0", "g1")
