"""Recordings as Parquet tables: ours to the bit, the columns people have, by groups of rows."""

import numpy as np
import pyarrow as pa
import pytest
import torch
from format_cases import (
    KEY,
    assert_comes_back,
    assert_equal_bytes,
    assert_hint,
    hand_of,
    hide,
    kept,
    read,
    read_all,
    recording,
    refused,
    survived,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pyarrow import parquet as pq

from tactslip_torch.data.formats import parquet
from tactslip_torch.data.formats.parquet_table import Table
from tactslip_torch.data.formats.reading import Reading

NUM_DAMAGED = 400

# Ours ----------------------------------------------------------------------------------------


@given(kept())
@settings(max_examples=40)
def test_what_goes_in_comes_out(tmp_path_factory, drawn):
    assume(parquet.TIME not in drawn[1].names)
    assert_comes_back(parquet, tmp_path_factory.mktemp("kept") / "a.parquet", *drawn)


@pytest.mark.parametrize("names", [["a", "a.b", "a.b.c"], ["", ".", ".."], ["header", "x\0", "Ö"]])
def test_names_that_look_nested_are_names(tmp_path, names):
    assert_comes_back(parquet, tmp_path / "a.parquet", recording(3), hand_of(names), KEY)


def test_a_recording_of_many_groups_comes_out(tmp_path, monkeypatch):
    monkeypatch.setattr(parquet, "_GROUP_BYTES", 800)
    path = tmp_path / "a.parquet"
    assert_comes_back(parquet, path, recording(2, 1050), hand_of("ab"), KEY)
    assert pq.ParquetFile(path).num_row_groups == 11


def test_equal_recordings_are_equal_bytes(tmp_path, monkeypatch):
    assert_equal_bytes(parquet, tmp_path, "parquet", monkeypatch)


def test_pyarrow_alone_reads_it(tmp_path):
    wanted = recording()
    parquet.save(tmp_path / "a.parquet", wanted, hand_of(["a", "Fö"]), KEY)
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.schema.names == ["time_s", "a", "Fö"]
    np.testing.assert_array_equal(table["Fö"].to_numpy(), wanted.samples[1].numpy())
    np.testing.assert_array_equal(table["time_s"].to_numpy(), np.arange(400) / 2000)
    assert table.schema.metadata[b"sample_rate_hz"] == b"2000.0"
    assert table.schema.metadata[b"units"] == b"V"


def test_a_channel_called_as_the_times_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a channel must not be called 'time_s'"):
        parquet.save(tmp_path / "a.parquet", recording(), hand_of(["a", "time_s"]), KEY)
    assert not list(tmp_path.iterdir())


def test_a_damaged_sample_is_noticed(tmp_path):
    path = tmp_path / "a.parquet"
    parquet.save(path, recording(), hand_of("ab"), KEY)
    content = bytearray(path.read_bytes())
    content[content.index(recording().samples[1].numpy().tobytes()) + 700] ^= 1
    path.write_bytes(content)
    for way in (parquet.load, lambda path: read_all(parquet, path)):
        with pytest.raises(ValueError, match=r"a\.parquet is damaged"):
            way(path)


# Other people's ------------------------------------------------------------------------------


def made(path, rows=20, **columns):
    pq.write_table(pa.table(columns), path, row_group_size=rows)
    return path


@given(
    num_samples=st.integers(2, 50),
    rows=st.integers(1, 60),
    dtype=st.sampled_from(["f2", "f4", "f8", "i2", "u4", "i8"]),
    stretch=st.tuples(st.integers(0, 60), st.integers(0, 60)),
)
def test_any_stretch_of_any_groups_is_the_columns(
    tmp_path_factory, num_samples, rows, dtype, stretch
):
    values = np.random.default_rng(3).integers(0, 99, (2, num_samples)).astype(dtype)
    path = tmp_path_factory.mktemp("theirs") / "a.parquet"
    made(path, rows, left=values[0], note=["x"] * num_samples, right=values[1])
    samples, names, times, rate = read(parquet, path)
    np.testing.assert_array_equal(samples.numpy(), values)
    assert (names, times, rate) == (("left", "right"), None, None)
    with parquet.open(path) as opened:
        assert torch.equal(opened.samples.read(*stretch), samples[:, slice(*stretch)])


def test_no_more_groups_are_read_than_asked_for(tmp_path, monkeypatch):
    path = made(tmp_path / "a.parquet", 10, x=np.arange(100.0), y=np.arange(100.0))
    asked = []
    values = Table.values

    def counted(table, group, name):
        asked.append((group, name))
        return values(table, group, name)

    monkeypatch.setattr(Table, "values", counted)
    with parquet.open(path) as opened:
        for first in (31, 35, 39):
            assert opened.samples.read(first, first + 2)[0].tolist() == [first, first + 1]
    assert asked == [(3, "x"), (3, "y"), (4, "x"), (4, "y")]


def test_times_are_found_by_name_or_by_being_stamps(tmp_path):
    stamps = np.datetime64("2026-01-02T03:04:05", "us") + np.arange(9) * 500
    path = made(tmp_path / "a.parquet", 4, when=stamps, x=np.arange(9.0))
    _samples, names, times, _ = read(parquet, path)
    assert names == ("x",)
    assert times.tolist() == [500 * i * 1e-6 for i in range(9)]
    path = made(tmp_path / "b.parquet", 4, Time=np.arange(9) * 2, x=np.arange(9.0))
    assert read(parquet, path, Reading(time_unit="ms"))[2].tolist() == [
        2 * i * 1e-3 for i in range(9)
    ]
    assert read(parquet, path, Reading(time=None))[1] == ("Time", "x")


def test_columns_are_chosen_by_name_or_number(tmp_path):
    columns = {"note": ["a"] * 9, "x": np.arange(9.0), "y": np.ones(9), "z": np.zeros(9)}
    path = made(tmp_path / "a.parquet", **columns)
    assert read(parquet, path, Reading(channels=("z", 1)))[1] == ("z", "x")
    _samples, names, times, _ = read(parquet, path, Reading(time=1))
    assert (names, times.tolist()) == (("y", "z"), list(range(9)))
    assert "'note': it holds 'string'" in refused(parquet, path, Reading(channels=("note",)))
    assert "has no 'q'" in refused(parquet, path, Reading(channels=("q",)))
    assert "has no column 4" in refused(parquet, path, Reading(channels=(4,)))
    assert "has no column 4 of times" in refused(parquet, path, Reading(time=4))


def test_nulls_are_nan_and_the_rate_is_in_the_metadata(tmp_path):
    table = pa.table({"x": pa.array([1, None, 3], pa.int16()), "y": [0.5, 1.5, None]})
    pq.write_table(table.replace_schema_metadata({"Fs": "250", "by": "me"}), tmp_path / "a.parquet")
    samples, _, _, rate = read(parquet, tmp_path / "a.parquet")
    np.testing.assert_array_equal(samples.numpy(), [[1, np.nan, 3], [0.5, 1.5, np.nan]])
    assert rate == 250.0


# Traps ---------------------------------------------------------------------------------------


def test_a_small_file_of_many_rows_is_not_believed(tmp_path):
    path = made(tmp_path / "a.parquet", 10**7, x=np.zeros(10**7), y=np.zeros(10**7))
    assert path.stat().st_size < 100_000
    line = refused(parquet, path)
    assert "claims 160000000 bytes" in line
    assert "smaller groups of rows" in line


def test_a_group_that_is_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tactslip_torch.data.formats.parquet_table.MOST_GROUP_BYTES", 1000)
    path = made(tmp_path / "a.parquet", 126, x=np.random.default_rng(0).standard_normal(500))
    assert "has groups of 126 rows, more than 1000 bytes" in refused(parquet, path)
    made(path, 125, x=np.random.default_rng(0).standard_normal(500))
    assert read(parquet, path)[0].shape == (1, 500)


def test_columns_of_one_name_are_refused(tmp_path):
    pq.write_table(pa.table([[1.0, 2.0], [3.0, 4.0]], names=["x", "x"]), tmp_path / "a.parquet")
    assert "several columns of one name" in refused(parquet, tmp_path / "a.parquet")


def test_a_table_of_no_numbers_is_refused(tmp_path):
    path = made(tmp_path / "a.parquet", note=["a", "b"], is_on=[True, False])
    assert "holds no samples ('note' holds 'string'; 'is_on' holds 'bool')" in refused(
        parquet, path
    )


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    parquet.save(tmp_path / "ours.parquet", recording(), hand_of("ab"), KEY)
    columns = {
        "t": np.arange(500.0),
        "x": np.random.default_rng(0).integers(0, 5, 500),
        "note": ["a"] * 500,
        "y": pa.array([None] * 10 + [1.5] * 490),
    }
    made(tmp_path / "theirs.parquet", 100, **columns)
    contents = [(tmp_path / name).read_bytes() for name in ("ours.parquet", "theirs.parquet")]
    ends = survived(parquet, tmp_path / "damaged.parquet", contents, NUM_DAMAGED)
    assert ends.total() == 3 * NUM_DAMAGED
    assert min(ends["read"], ends["refused"]) > NUM_DAMAGED // 4  # neither all nor nothing


@pytest.mark.parametrize("content", [b"", b"time,volts\n0,1\n", b"PAR1" + bytes(99) + b"PAR1"])
def test_what_is_no_parquet_is_refused(tmp_path, content):
    (tmp_path / "a.parquet").write_bytes(content)
    for way in (parquet.load, parquet.key, lambda path: read(parquet, path)):
        with pytest.raises(ValueError, match="is damaged or no recording of ours"):
            way(tmp_path / "a.parquet")


def test_theirs_is_not_loaded_as_ours(tmp_path):
    path = made(tmp_path / "a.parquet", time_s=np.arange(9.0), x=np.zeros(9))
    for way in (parquet.load, parquet.key):
        with pytest.raises(ValueError, match="no recording of ours"):
            way(path)


def test_without_pyarrow_a_line_says_what_to_install(tmp_path, monkeypatch):
    path = made(tmp_path / "a.parquet", x=np.zeros(9))
    hide(monkeypatch, "pyarrow")
    save = lambda: parquet.save(path, recording(), hand_of("ab"), KEY)  # noqa: E731
    calls = (save, lambda: parquet.load(path), lambda: parquet.key(path))
    assert_hint("pyarrow", "parquet", *calls, lambda: read(parquet, path))
