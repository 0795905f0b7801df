"""Recordings as MAT files: ours to the bit, the variables people have, SciPy as the oracle."""

import struct
import zlib
from io import BytesIO

import h5py
import numpy as np
import pytest
import scipy.io
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
    recording,
    refused,
    survived,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch.data.formats import mat
from tactslip_torch.data.formats.mat5 import MOST_DEPTH
from tactslip_torch.data.formats.reading import Reading

NUM_DAMAGED = 600
MATRIX, COMPRESSED, DOUBLE = 14, 15, 9
CELL, DOUBLES = 1, 6

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


# Traps ---------------------------------------------------------------------------------------


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def variable(kind, name, content, shape=(1, 1)):
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack("<ii", *shape))
    return element(MATRIX, head + element(1, name.encode()) + content)


def made_5(path, *variables):
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(variables))
    return path


def packed(content):
    """Compressed; such elements are not filled up to eight bytes."""
    content = zlib.compress(content, 9)
    return struct.pack("<II", COMPRESSED, len(content)) + content


def test_cells_in_cells_do_not_end_the_process(tmp_path):
    """SciPy enters each and runs out of stack; here none is entered."""
    cell = variable(DOUBLES, "", element(DOUBLE, b""), (0, 0))
    for depth in range(10_000, -1, -1):
        cell = variable(CELL, "deep" if depth == 0 else "", cell)
    assert "'deep' is a cell" in refused(mat, made_5(tmp_path / "a.mat", cell))


def test_structs_in_structs_are_entered_to_a_depth(tmp_path):
    trial = {"x": np.arange(9.0)}
    for _ in range(MOST_DEPTH):
        trial = {"trial": trial}
    scipy.io.savemat(tmp_path / "a.mat", {"trial": trial})
    assert "nested more than" in refused(mat, tmp_path / "a.mat")
    scipy.io.savemat(tmp_path / "a.mat", trial)
    assert read(mat, tmp_path / "a.mat")[1] == ("x",)


def test_what_unpacks_to_gigabytes_is_not_unpacked(tmp_path):
    one = variable(DOUBLES, "x", element(DOUBLE, bytes(8)))
    large = struct.pack("<II", MATRIX, 3 * 10**9) + one[8:]
    line = refused(mat, made_5(tmp_path / "claim.mat", packed(large)))
    assert "claims 3000000008 bytes" in line
    assert "-v7.3 or as .h5, read by slices" in line
    more = packed(one + bytes(2**27))  # claims little and unpacks to 128 MiB
    assert "is damaged" in refused(mat, made_5(tmp_path / "more.mat", more))
    less = packed(struct.pack("<II", MATRIX, 2**20) + one[8:])
    assert "is damaged" in refused(mat, made_5(tmp_path / "less.mat", less))


@pytest.mark.parametrize(
    "one",
    [
        variable(DOUBLES, "x", element(DOUBLE, bytes(8)), (2**31 - 1, 2**31 - 1)),
        variable(4, "x", element(16, b"ab"), (2**31 - 1, 1)),
        variable(2, "x", element(5, b"\0\0\0\0") + element(1, b"abc")),
        struct.pack("<II", MATRIX, 2**32 - 1),
        variable(DOUBLES, "x", b""),
    ],
)
def test_what_claims_more_than_there_is_is_refused(tmp_path, one):
    assert "is damaged" in refused(mat, made_5(tmp_path / "a.mat", one))


def test_characters_of_version_73_in_a_chunk_of_no_bytes_are_refused(tmp_path):
    """HDF5 2.0 looks for its check sum before it and ends the process."""
    path = made_73(tmp_path / "a.mat", volts=np.zeros((60, 3)))
    with h5py.File(path, "a") as file:
        labels = file.create_dataset("labels", (1, 3), "u2", chunks=(1, 3), fletcher32=True)
        labels.attrs["MATLAB_class"] = np.bytes_("char")
        labels.id.write_direct_chunk((0, 0), b"1234")
    assert "is damaged" in refused(mat, path)


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    mat.save(tmp_path / "ours.mat", recording(), hand_of("ab"), KEY)
    content = {
        "trial": {"volts": numbers("f8", (50, 3)), "Fs": 100.0, "t": np.arange(50.0)},
        "channels": np.array(["a", "b", "c"], dtype=object),
    }
    contents = [(tmp_path / "ours.mat").read_bytes()]
    for is_compressed in (False, True):
        theirs = BytesIO()
        scipy.io.savemat(theirs, content, do_compression=is_compressed)
        contents.append(theirs.getvalue())
    later = made_73(tmp_path / "later.mat", volts=numbers("f8", (50, 3)), labels=["a", "b", "c"])
    contents.append(later.read_bytes())
    ends = survived(mat, tmp_path / "damaged.mat", contents, NUM_DAMAGED)
    assert ends.total() == 3 * NUM_DAMAGED
    assert min(ends["read"], ends["refused"]) > NUM_DAMAGED // 4  # neither all nor nothing


def test_a_file_that_is_cut_while_it_is_open_is_refused(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"volts": np.zeros((9000, 2))})
    with mat.open(tmp_path / "a.mat") as opened:
        with (tmp_path / "a.mat").open("r+b") as file:
            file.truncate(80_000)
        with pytest.raises(ValueError, match=r"a\.mat was cut while it was read"):
            opened.samples.read(8000, 9000)


@pytest.mark.parametrize("content", [b"", b"time,volts\n0,1\n", bytes(200)])
def test_what_is_no_mat_file_is_refused(tmp_path, content):
    (tmp_path / "a.mat").write_bytes(content)
    for way in (mat.load, mat.key, lambda path: read(mat, path)):
        with pytest.raises(ValueError, match="must be a MAT file of version 5 or 7"):
            way(tmp_path / "a.mat")


def test_theirs_is_not_loaded_as_ours(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"samples": np.zeros((2, 9))})
    for way in (mat.load, mat.key):
        with pytest.raises(ValueError, match="no recording of ours"):
            way(tmp_path / "a.mat")


def test_without_its_library_a_line_says_what_to_install(tmp_path, monkeypatch):
    path = made_73(tmp_path / "a.mat", volts=np.zeros((60, 2)))
    scipy.io.savemat(tmp_path / "b.mat", {"volts": np.zeros((60, 2))})
    hide(monkeypatch, "h5py")
    assert_hint("h5py", "formats", lambda: mat.load(path), lambda: read(mat, path))
    hide(monkeypatch, "scipy")
    save = lambda: mat.save(tmp_path / "c.mat", recording(), hand_of("ab"), KEY)  # noqa: E731
    assert_hint("scipy", "formats", save)
    assert read(mat, tmp_path / "b.mat")[0].shape == (2, 60)  # version 5 needs none to be read
