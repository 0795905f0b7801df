"""Recordings as HDF5: ours to the bit, the datasets people have, by slices."""

import h5py
import numpy as np
import pytest
import torch
from format_cases import (
    KEY,
    assert_comes_back,
    assert_equal_bytes,
    assert_same,
    hand_of,
    kept,
    read,
    read_all,
    recording,
    refused,
)
from hypothesis import given, settings

from tactslip_torch.data.formats import hdf5
from tactslip_torch.data.formats.reading import Reading

# Ours ----------------------------------------------------------------------------------------


@given(kept())
@settings(max_examples=40)
def test_what_goes_in_comes_out(tmp_path_factory, drawn):
    assert_comes_back(hdf5, tmp_path_factory.mktemp("kept") / "a.h5", *drawn)


def test_a_recording_of_many_chunks_comes_out(tmp_path):
    wanted, hand = recording(24, 7000), hand_of(f"c{i}" for i in range(24))
    assert_comes_back(hdf5, tmp_path / "a.h5", wanted, hand, KEY)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["samples"].id.get_num_chunks() == 3


def test_thousands_of_channels_and_a_long_header_fit(tmp_path):
    names = [f"channel {i}" for i in range(5000)]
    assert_comes_back(hdf5, tmp_path / "a.h5", recording(5000, 3), hand_of(names), KEY)


def test_no_more_chunks_are_touched_than_asked_for(tmp_path):
    path = tmp_path / "a.h5"
    hdf5.save(path, recording(24, 100_000), hand_of(f"c{i}" for i in range(24)), KEY)
    content = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        content[file["samples"].id.get_chunk_info_by_coord((0, 0)).byte_offset] ^= 1
    path.write_bytes(content)
    with hdf5.open(path) as opened:  # of the first chunk, which is damaged, nothing is seen
        wanted = recording(24, 100_000).samples[:, 60_000:60_200]
        assert torch.equal(opened.samples.read(60_000, 60_200), wanted)
        with pytest.raises(ValueError, match="is damaged"):
            opened.samples.read(0, 200)


def test_equal_recordings_are_equal_bytes(tmp_path, monkeypatch):
    assert_equal_bytes(hdf5, tmp_path, "h5", monkeypatch)


def test_h5py_alone_reads_it(tmp_path):
    wanted = recording()
    hdf5.save(tmp_path / "a.h5", wanted, hand_of(["a", "Fö"]), KEY)
    with h5py.File(tmp_path / "a.h5") as file:
        samples = file["samples"]
        np.testing.assert_array_equal(samples[()], wanted.samples.numpy())
        assert samples.attrs["sample_rate_hz"] == 2000.0
        assert samples.attrs["units"].decode() == "V"
        assert [name.decode() for name in samples.attrs["channel_name"]] == ["a", "Fö"]


def test_what_cannot_be_kept_is_refused_and_nothing_is_lost(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(b"before")
    for names, changes, said in (
        ("abc", {}, "the hand has 3 channels, the recording 2"),
        (["a", "b\0"], {}, "must not hold a NUL"),
        ("ab", {"provenance": {"by": object()}}, "provenance must be plain JSON"),
        ("ab", {"samples": torch.zeros(2, 9, dtype=torch.int32)}, "float32 or float64"),
    ):
        with pytest.raises(ValueError, match=said):
            hdf5.save(path, recording(**changes), hand_of(names), KEY)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_damaged_sample_is_noticed(tmp_path):
    path = tmp_path / "a.h5"
    hdf5.save(path, recording(), hand_of("ab"), KEY)
    whole = path.read_bytes()
    start = whole.index(recording().samples.numpy().tobytes())
    for offset in (0, 1000, 3199):
        content = bytearray(whole)
        content[start + offset] ^= 1
        path.write_bytes(content)
        for way in (hdf5.load, lambda path: read_all(hdf5, path)):
            with pytest.raises(ValueError, match="is damaged or no recording of ours"):
                way(path)
    path.write_bytes(whole)
    assert_same(hdf5.load(path), recording(), hand_of("ab"))


# Other people's ------------------------------------------------------------------------------


def made(path, **datasets):
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file[name] = values
    return path


def test_the_only_matrix_is_the_samples_whichever_way_it_lies(tmp_path):
    volts = np.random.default_rng(0).standard_normal((60, 3)).astype(np.float32)
    for values in (volts, volts.T):
        path = made(tmp_path / "a.h5", **{"trial/volts": values, "fs": 250, "note": "hello"})
        samples, names, times, rate = read(hdf5, path)
        np.testing.assert_array_equal(samples.numpy(), volts.T)
        assert (names, times, rate) == (None, None, 250.0)


def test_datasets_of_one_length_are_channels_by_name(tmp_path):
    path = made(tmp_path / "a.h5", **{"imu/x": np.arange(9.0), "imu/y": np.arange(9, dtype="i2")})
    stamps = 10**18 + 2_000_000 * np.arange(9)  # nanoseconds since 1970: no float64 holds them
    with h5py.File(path, "a") as file:
        file["imu/Timestamp"] = stamps
        file["imu"].attrs["Rate"] = 500.0
        file.attrs["rate"] = 1.0
    samples, names, times, rate = read(hdf5, path, Reading(time_unit="ns"))
    assert names == ("x", "y")
    assert samples.tolist() == [list(range(9))] * 2
    assert times.tolist() == [2_000_000 * i * 1e-9 for i in range(9)]
    assert rate == 500.0  # what is said nearest
    assert read(hdf5, path, Reading(channels=("y",), time=None))[0].dtype == torch.float32


def test_names_of_channels_are_read_where_they_stand(tmp_path):
    volts = np.zeros((60, 3))
    path = made(tmp_path / "a.h5", volts=volts, labels=["a", "b", "time_ms"])
    samples, names, times, _ = read(hdf5, path)
    assert names == ("a", "b")  # the third column is times by its name
    assert samples.shape == (2, 60)
    assert times.tolist() == [0.0] * 60
    with h5py.File(path, "a") as file:
        file["volts"].attrs["channel_name"] = ["q", "r", "s"]
    assert read(hdf5, path)[1] == ("q", "r", "s")
    assert read(hdf5, path, Reading(channels=("s", 0)))[1] == ("s", "q")


def test_what_is_not_clear_is_said_with_what_could_be_meant(tmp_path):
    both = {"a/volts": np.zeros((60, 3)), "b/volts": np.ones((50, 2))}
    path = made(tmp_path / "a.h5", **both, square=np.zeros((4, 4)), t=np.zeros(7))
    assert "'/a/volts' 60 by 3, '/b/volts' 50 by 2" in refused(hdf5, path)
    assert refused(hdf5, path).endswith("say reading.samples")
    assert read(hdf5, path, Reading(samples="/b/volts"))[0].shape == (2, 50)
    assert read(hdf5, path, Reading(samples="b"))[0].shape == (2, 50)
    assert "has no 'c'" in refused(hdf5, path, Reading(samples="c"))
    assert "reading.time_first" in refused(hdf5, path, Reading(samples="square"))
    assert "'/t' 7 for 60" in refused(hdf5, path, Reading(samples="a", time="t"))
    line = refused(hdf5, path, Reading(samples="a", channels=(0, 3)))
    assert "has no column 3" in line
    assert "columns 0 to 2" in line
    lengths = made(tmp_path / "b.h5", x=np.zeros(9), y=np.zeros(8))
    assert "'/x' 9, '/y' 8; say reading.channels" in refused(hdf5, lengths)
    assert read(hdf5, lengths, Reading(channels=("y",)))[0].shape == (1, 8)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.zeros(9, dtype=[("x", "f8"), ("y", "f8")]), "compound"),
        (np.zeros((9, 2), dtype=complex), "complex"),
        (np.array([b"a", b"b"]), "text"),
        (["a", "b"], "objects or text"),
        (np.zeros((9, 2), dtype=bool), "true or false"),
        (np.zeros((2, 3, 4)), "3 dimensions"),
        (3.0, "no samples"),
    ],
)
def test_what_is_no_samples_is_named(tmp_path, values, said):
    line = refused(hdf5, made(tmp_path / "a.h5", it=values))
    assert said in line
