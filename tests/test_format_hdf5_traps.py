"""HDF5 files that are traps or damaged: nothing outside is opened, nothing grows, one line."""

import zlib

import h5py
import numpy as np
import pytest
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
from test_format_hdf5 import made

from tactslip_torch.data.formats import hdf5
from tactslip_torch.data.formats.hdf5_heap import has_sound_heaps
from tactslip_torch.data.formats.reading import Reading

NUM_DAMAGED = 400


def test_nothing_outside_the_file_is_opened(tmp_path):
    outside = made(tmp_path / "outside.h5", secret=np.ones((60, 3)))
    (tmp_path / "raw").write_bytes(np.ones(180).tobytes())
    layout = h5py.VirtualLayout((60, 3), "f8")
    layout[:] = h5py.VirtualSource(outside, "secret", (60, 3))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["link"] = h5py.ExternalLink(str(outside), "/secret")
        file["alias"] = h5py.SoftLink("/alias")
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("raw", (60, 3), "f8", external=[(str(tmp_path / "raw"), 0, 1440)])
    line = refused(hdf5, tmp_path / "a.h5")
    assert "holds no samples" in line
    for name, said in (
        ("link", "is a link"),
        ("alias", "is a link"),
        ("virtual", "is virtual"),
        ("raw", "other files"),
    ):
        assert said in refused(hdf5, tmp_path / "a.h5", Reading(samples=name))


def test_groups_in_a_circle_end(tmp_path):
    path = made(tmp_path / "a.h5", volts=np.zeros((60, 3)))
    with h5py.File(path, "a") as file:
        file["a/b/back"] = file["/"]
        file["again"] = file["volts"]  # one dataset by two names is one
    assert read(hdf5, path)[0].shape == (3, 60)


def test_claims_of_gigabytes_are_not_believed(tmp_path):
    with h5py.File(tmp_path / "sparse.h5", "w") as file:
        file.create_dataset("volts", (10**10 // 8, 3), "f8", chunks=(1000, 3))
    assert (tmp_path / "sparse.h5").stat().st_size < 10_000
    assert "claims 30000000000 bytes" in refused(hdf5, tmp_path / "sparse.h5")
    with h5py.File(tmp_path / "chunk.h5", "w") as file:
        file.create_dataset("volts", (100, 3), "f8", chunks=(10**8, 3), maxshape=(None, 3))
    assert "claims 2400000000 bytes" in refused(hdf5, tmp_path / "chunk.h5")
    with h5py.File(tmp_path / "begun.h5", "w") as file:  # as much as is believed reads as fill
        file.create_dataset("volts", (1000, 3), "f8", chunks=(100, 3), fillvalue=7)[:5] = 1
    assert read(hdf5, tmp_path / "begun.h5")[0].sum() == 15 + 7 * 995 * 3


def test_a_chunk_that_unpacks_to_more_than_it_is_is_refused(tmp_path):
    bomb = zlib.compress(bytes(200 * 2**20), 9)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        volts = file.create_dataset("volts", (1000, 3), "f8", chunks=(1000, 3), compression="gzip")
        volts.id.write_direct_chunk((0, 0), bomb)
    assert "is damaged" in refused(hdf5, tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        values = np.random.default_rng(0).standard_normal((40_000, 3))
        file.create_dataset("volts", data=values, chunks=(20_000, 3), compression="gzip")
    np.testing.assert_array_equal(read(hdf5, tmp_path / "b.h5")[0].numpy(), values.T)


def test_a_chunk_of_no_bytes_is_refused(tmp_path):
    """HDF5 2.0 looks for its check sum before it and ends the process."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        volts = file.create_dataset("volts", (100, 3), "f8", chunks=(100, 3), fletcher32=True)
        volts.id.write_direct_chunk((0, 0), b"1234")
    assert "is damaged" in refused(hdf5, tmp_path / "a.h5")


def test_a_heap_that_never_ends_is_not_walked(tmp_path):
    """HDF5 2.0 never returns from it."""
    path = made(tmp_path / "a.h5", volts=np.zeros((60, 2)), labels=["left", "right"])
    assert read(hdf5, path)[1] == ("left", "right")
    whole = path.read_bytes()
    first = whole.index(b"GCOL") + 16
    path.write_bytes(whole[:first] + bytes(16) + whole[first + 16 :])
    assert not has_sound_heaps(path)
    assert read(hdf5, path)[1] is None
    place = whole.index((4).to_bytes(4, "little") + whole.index(b"GCOL").to_bytes(8, "little"))
    path.write_bytes(whole[:place] + b"\xff\xff\xff\x7f" + whole[place + 4 :])
    assert not has_sound_heaps(path)  # a text of 2 GB
    assert read(hdf5, path)[1] is None


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    hdf5.save(tmp_path / "ours.h5", recording(), hand_of("ab"), KEY)
    with h5py.File(tmp_path / "theirs.h5", "w") as file:
        volts = np.random.default_rng(0).standard_normal((500, 3))
        file.create_dataset("g/volts", data=volts, chunks=(100, 3), compression="gzip")
        file["g/t"] = np.arange(500.0)
        file["labels"] = ["a", "b", "c"]
        file.attrs["fs"] = 100.0
    contents = [(tmp_path / name).read_bytes() for name in ("ours.h5", "theirs.h5")]
    ends = survived(hdf5, tmp_path / "damaged.h5", contents, NUM_DAMAGED)
    assert ends.total() == 3 * NUM_DAMAGED
    assert min(ends["read"], ends["refused"]) > NUM_DAMAGED // 4  # neither all nor nothing


@pytest.mark.parametrize("content", [b"", b"time,volts\n0,1\n", b"\x89HDF\r\n\x1a\n" + bytes(99)])
def test_what_is_no_hdf5_is_refused(tmp_path, content):
    (tmp_path / "a.h5").write_bytes(content)
    assert refused(hdf5, tmp_path / "a.h5") == "is damaged or no recording of ours"
    for way in (hdf5.load, hdf5.key):
        with pytest.raises(ValueError, match="is damaged or no recording of ours"):
            way(tmp_path / "a.h5")


def test_what_is_not_there_is_said_as_such(tmp_path):
    for way in (hdf5.load, hdf5.key, lambda path: read(hdf5, path)):
        with pytest.raises(FileNotFoundError, match=r"no file at .*a\.h5"):
            way(tmp_path / "a.h5")
        with pytest.raises(ValueError, match="must be a file"):
            way(tmp_path)


def test_theirs_is_not_loaded_as_ours(tmp_path):
    path = made(tmp_path / "a.h5", samples=np.zeros((2, 9)))
    for way in (hdf5.load, hdf5.key):
        with pytest.raises(ValueError, match="no recording of ours"):
            way(path)


def test_without_h5py_a_line_says_what_to_install(tmp_path, monkeypatch):
    path = made(tmp_path / "a.h5", volts=np.zeros((60, 2)))
    hide(monkeypatch, "h5py")
    save = lambda: hdf5.save(path, recording(), hand_of("ab"), KEY)  # noqa: E731
    calls = (save, lambda: hdf5.load(path), lambda: hdf5.key(path), lambda: read(hdf5, path))
    assert_hint("h5py", "formats", *calls)
