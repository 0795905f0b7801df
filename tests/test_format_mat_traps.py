"""MAT files that are traps or damaged: nothing is entered deeply, nothing grows, one line."""

import struct
import zlib
from io import BytesIO

import h5py
import numpy as np
import pytest
import scipy.io
from format_cases import (
    KEY,
    assert_hint,
    hand_of,
    hide,
    read,
    recording,
    refused,
    survived,
)
from test_format_mat import made_73, numbers

from tactslip_torch.data.formats import mat
from tactslip_torch.data.formats.mat5 import MOST_DEPTH

NUM_DAMAGED = 600
MATRIX, COMPRESSED, DOUBLE = 14, 15, 9
CELL, DOUBLES = 1, 6


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
