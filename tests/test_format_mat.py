"""Recordings as MAT files: ours to the bit, the variables people have, SciPy as the oracle."""

import h5py
import numpy as np
import pytest
import scipy.io
import torch
from format_cases import (
    KEY,
    assert_comes_back,
    assert_equal_bytes,
    hand_of,
    kept,
    read,
    recording,
    refused,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch.data.formats import mat
from tactslip_torch.data.formats.reading import Reading

# Ours ----------------------------------------------------------------------------------------


@given(kept())
@settings(max_examples=40)
def test_what_goes_in_comes_out(tmp_path_factory, drawn):
    assert_comes_back(mat, tmp_path_factory.mktemp("kept") / "a.mat", *drawn)


def test_equal_recordings_are_equal_bytes(tmp_path, monkeypatch):
    assert_equal_bytes(mat, tmp_path, "mat", monkeypatch)


def test_scipy_alone_reads_it(tmp_path):
    wanted = recording()
    mat.save(tmp_path / "a.mat", wanted, hand_of(["a", "Fö"]), KEY)
    found = scipy.io.loadmat(tmp_path / "a.mat")
    np.testing.assert_array_equal(found["samples"], wanted.samples.numpy())
    assert found["sample_rate_hz"].item() == 2000.0
    assert found["units"].item() == "V"
    assert [name.item() for name in found["channel_name"].flat] == ["a", "Fö"]


def test_ours_compressed_by_another_program_is_ours(tmp_path):
    wanted, path = recording(), tmp_path / "a.mat"
    mat.save(path, wanted, hand_of("ab"), KEY)
    content = {name: of for name, of in scipy.io.loadmat(path).items() if name[0] != "_"}
    scipy.io.savemat(path, content, do_compression=True)
    found = mat.load(path)
    assert torch.equal(found.recording.samples, wanted.samples)
    assert (found.hand, found.key) == (hand_of("ab"), KEY)


def test_more_than_the_format_holds_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mat, "_MOST_BYTES", 100)
    with pytest.raises(ValueError, match=r"a MAT file of version 5 holds 100; save as \.h5"):
        mat.save(tmp_path / "a.mat", recording(), hand_of("ab"), KEY)
    assert not list(tmp_path.iterdir())


# Other people's, version 5 -------------------------------------------------------------------


def numbers(dtype, shape):
    return np.random.default_rng(1).integers(0, 100, shape).astype(dtype)


@given(
    dtype=st.sampled_from(["f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]),
    is_compressed=st.booleans(),
    is_time_first=st.booleans(),
    num_channels=st.integers(2, 4),
    num_samples=st.integers(5, 40),
    stretch=st.tuples(st.integers(0, 45), st.integers(0, 45)),
)
def test_any_stretch_is_what_scipy_reads(
    tmp_path_factory, dtype, is_compressed, is_time_first, num_channels, num_samples, stretch
):
    path = tmp_path_factory.mktemp("theirs") / "a.mat"
    values = numbers(dtype, (num_channels, num_samples))
    content = {"volts": values.T if is_time_first else values, "Fs": 250.0, "note": "hello"}
    scipy.io.savemat(path, content, do_compression=is_compressed)
    theirs = scipy.io.loadmat(path)["volts"]
    samples, names, times, rate = read(mat, path)
    np.testing.assert_array_equal(samples.numpy(), theirs.T if is_time_first else theirs)
    assert (names, times, rate) == (None, None, 250.0)
    is_small = np.dtype(dtype).itemsize <= (4 if dtype[0] == "f" else 2)
    assert samples.dtype == (torch.float32 if is_small else torch.float64)
    with mat.open(path) as opened:
        assert torch.equal(opened.samples.read(*stretch), samples[:, slice(*stretch)])


@pytest.mark.parametrize("is_compressed", [False, True])
def test_structs_vectors_and_cells_are_entered(tmp_path, is_compressed):
    trial = {
        "x": np.arange(50.0),
        "y": np.arange(50, dtype="i2")[:, None],
        "time_ms": np.arange(50.0) * 2,
        "sampling_rate": 500.0,
        "deep": {"z": np.arange(50.0)},
    }
    other = {"when": "today", "parts": np.array([1, "a"], dtype=object)}
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"trial": trial, "other": other}, do_compression=is_compressed)
    samples, names, times, rate = read(mat, path)
    assert names == ("x", "y", "z")
    assert samples.tolist() == [list(range(50))] * 3
    assert times.tolist() == [2 * i * 1e-3 for i in range(50)]
    assert rate == 500.0
    assert read(mat, path, Reading(samples="trial.deep.z"))[1] == ("z",)
    assert read(mat, path, Reading(channels=("trial.y",)))[0].dtype == torch.float32
    assert "cell" in refused(mat, path, Reading(samples="other.parts"))


@pytest.mark.parametrize("is_cell", [False, True])
def test_names_of_channels_are_characters_or_cells(tmp_path, is_cell):
    names = np.array(["left", "right", "Mitte"], dtype=object if is_cell else None)
    content = {"volts": np.zeros((60, 3)), "channels": names}
    scipy.io.savemat(tmp_path / "a.mat", content)
    assert read(mat, tmp_path / "a.mat")[1] == ("left", "right", "Mitte")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.zeros((9, 2), dtype=complex), "complex"),
        (np.zeros((9, 2), dtype=bool), "true or false"),
        (np.zeros((2, 3, 4)), "3 dimensions"),
        (np.array([[1], ["a"]], dtype=object), "cell"),
        (np.zeros(3, dtype=[("x", "f8")]), "struct array"),
        (scipy.sparse.eye_array(9).tocsc(), "sparse"),
    ],
)
def test_what_is_no_samples_is_named(tmp_path, values, said):
    scipy.io.savemat(tmp_path / "a.mat", {"it": values})
    assert said in refused(mat, tmp_path / "a.mat")


def test_what_is_not_clear_is_said_with_what_could_be_meant(tmp_path):
    content = {"volts": np.zeros((60, 3)), "speeds": np.zeros((2, 5)), "square": np.zeros((4, 4))}
    scipy.io.savemat(tmp_path / "a.mat", content)
    line = refused(mat, tmp_path / "a.mat")
    assert "'volts' 60 by 3, 'speeds' 2 by 5, 'square' 4 by 4; say reading.samples" in line
    assert read(mat, tmp_path / "a.mat", Reading(samples="speeds"))[0].shape == (2, 5)
    assert "reading.time_first" in refused(mat, tmp_path / "a.mat", Reading(samples="square"))
    samples, _, times, _ = read(mat, tmp_path / "a.mat", Reading(samples="volts", time=0))
    assert samples.shape == (2, 60)  # the first column is the times
    assert times.shape == (60,)


# Version 7.3 ---------------------------------------------------------------------------------


def made_73(path, **variables):
    """As MATLAB writes it: rows and columns turned, classes marked, characters as numbers."""
    kinds = {"f8": "double", "f4": "single", "i2": "int16", "b1": "logical"}
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, values):
            if isinstance(values, list):
                references = [put(f"#refs#/{name}{i}", one).ref for i, one in enumerate(values)]
                kept = file.create_dataset(name, data=[references], dtype=h5py.ref_dtype)
                kind = "cell"
            elif isinstance(values, str):
                kept = file.create_dataset(name, data=[[ord(c)] for c in values], dtype="u2")
                kind = "char"
            else:
                kept = file.create_dataset(name, data=np.atleast_2d(values).T)
                kind = kinds[np.atleast_2d(values).dtype.str[1:]]
            kept.attrs["MATLAB_class"] = np.bytes_(kind)
            return kept

        for name, values in variables.items():
            put(name, values)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def test_version_73_is_read_as_matlab_shows_it(tmp_path):
    volts = np.random.default_rng(2).standard_normal((60, 3)).astype("f4")
    variables = {"data/volts": volts, "data/t": np.arange(60.0)[:, None], "data/fs": np.float64(9)}
    path = made_73(tmp_path / "a.mat", labels=["a", "bc", "d"], is_on=np.ones(3, "?"), **variables)
    samples, names, times, rate = read(mat, path)
    np.testing.assert_array_equal(samples.numpy(), volts.T)
    assert names == ("a", "bc", "d")
    assert times.tolist() == list(range(60))
    assert rate == 9.0
    named = Reading(samples="data.volts", channels=("d", 0))
    np.testing.assert_array_equal(read(mat, path, named)[0].numpy(), volts.T[[2, 0]])
    assert "true or false" in refused(mat, path, Reading(samples="is_on"))
    with mat.open(path) as opened:
        assert np.array_equal(opened.samples.read(50, 70).numpy(), volts.T[:, 50:])


def test_vectors_and_characters_of_version_73(tmp_path):
    path = made_73(tmp_path / "a.mat", x=np.arange(9.0), y=np.arange(9, dtype="i2"), word="hello")
    samples, names, _, _ = read(mat, path)
    assert names == ("x", "y")
    assert samples.tolist() == [list(range(9))] * 2


def test_ours_saved_again_as_version_73_is_ours(tmp_path):
    wanted = recording()
    mat.save(tmp_path / "a.mat", wanted, hand_of("ab"), KEY)
    found = scipy.io.loadmat(tmp_path / "a.mat")
    header = found["header"].item()
    path = made_73(tmp_path / "b.mat", header=header, samples=found["samples"])
    again = mat.load(path)
    assert torch.equal(again.recording.samples, wanted.samples)
    assert (again.hand, mat.key(path)) == (hand_of("ab"), KEY)
