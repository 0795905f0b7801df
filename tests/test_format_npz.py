"""Recordings in files: what goes in comes out, bit for bit, and nothing else is read as one."""

import io
import json
import time
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.folder import MANIFEST, recording_files
from tactslip_torch.data.formats import npz
from tactslip_torch.data.formats.header import FORM
from tactslip_torch.data.formats.reading import Reading, pieces

TRUTH = ("onsets_s", "annotated_onsets_s", "sliding_s", "non_slip_s", "speeds_mm_s")
times = st.floats(0, 100, allow_nan=False)
stretches = st.tuples(times, times).map(lambda pair: (min(pair), max(pair)))
words = st.text(st.characters(exclude_characters="\0"), max_size=8)
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)
facts = st.dictionaries(words, plain, max_size=4)
KEY = {"scene": {"seed": 3}, "code": "abc"}


def hand_of(names):
    kinds = ("SG", "PVDF")
    return HandLayout.from_rows(
        {"name": name, "kind": kinds[i % 2], "finger": f"f{i}", "segment": name[::-1]}
        for i, name in enumerate(names)
    )


def recording(**changes):
    generator = torch.Generator().manual_seed(5)
    values = {
        "samples": torch.randn(2, 400, generator=generator),
        "sample_rate_hz": 2000.0,
        "material": "M1",
        "speeds_mm_s": (20.0, 40.0),
        "onsets_s": (0.05, 0.1 + 1e-9),
        "sliding_s": ((0.05, 0.1), (0.1, 0.2)),
        "annotated_onsets_s": (0.06, 1 / 3),
        "non_slip_s": ((0.01, 0.02),),
        "provenance": {"simulated": True, "seed": 3, "fidelity": "kinematic"},
    }
    return Recording(**(values | changes))


def assert_same(found, wanted):
    assert found.samples.dtype == wanted.samples.dtype
    assert found.samples.numpy().tobytes() == wanted.samples.numpy().tobytes()
    assert found.samples.shape == wanted.samples.shape
    for name in (*TRUTH, "sample_rate_hz", "material", "provenance"):
        assert getattr(found, name) == getattr(wanted, name), name


@given(data=st.data())
@settings(max_examples=60)
def test_what_goes_in_comes_out(tmp_path_factory, data):
    names = data.draw(st.lists(words, min_size=1, max_size=4, unique=True))
    dtype = data.draw(st.sampled_from([np.float32, np.float64]))
    width = np.dtype(dtype).itemsize
    num_samples = data.draw(st.integers(0, 9))
    size = len(names) * num_samples * width
    raw = data.draw(st.binary(min_size=size, max_size=size))  # every NaN and subnormal as well
    samples = np.frombuffer(raw, dtype).reshape(len(names), num_samples).copy()
    strokes = data.draw(st.integers(0, 3))

    def some(what):
        return tuple(data.draw(st.lists(what, min_size=strokes, max_size=strokes)))

    wanted = Recording(
        torch.from_numpy(samples),
        data.draw(st.floats(0.1, 1e6)),
        data.draw(words),
        some(times),
        some(times),
        some(stretches),
        some(times),
        tuple(data.draw(st.lists(stretches, max_size=3))),
        data.draw(facts),
    )
    key = data.draw(facts)
    path = tmp_path_factory.mktemp("archive") / "a.npz"
    npz.save(path, wanted, hand_of(names), key)
    found = npz.load(path)
    assert_same(found.recording, wanted)
    assert found.hand == hand_of(names)
    assert found.key == key
    assert npz.key(path) == key


def test_numpy_alone_reads_it(tmp_path):
    wanted, hand = recording(), hand_of(["a", "bc"])
    npz.save(tmp_path / "a.npz", wanted, hand, KEY)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as content:
        np.testing.assert_array_equal(content["samples"], wanted.samples.numpy())
        assert content["units"] == "V"
        assert content["channel_name"].tolist() == ["a", "bc"]
        assert content["channel_kind"].tolist() == ["SG", "PVDF"]
        assert content["channel_finger"].tolist() == ["f0", "f1"]
        assert content["channel_segment"].tolist() == ["a", "cb"]
        assert content["sliding_s"].tolist() == [list(pair) for pair in wanted.sliding_s]
        assert json.loads(str(content["provenance"])) == wanted.provenance


def test_equal_recordings_are_equal_bytes_at_any_time(tmp_path, monkeypatch):
    npz.save(tmp_path / "a.npz", recording(), hand_of("ab"), KEY)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    npz.save(tmp_path / "b.npz", recording(), hand_of("ab"), dict(reversed(KEY.items())))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_samples_in_any_layout_are_kept(tmp_path):
    strided = torch.arange(24.0).reshape(12, 2).T
    assert not strided.is_contiguous()
    npz.save(tmp_path / "a.npz", recording(samples=strided), hand_of("ab"), {})
    assert torch.equal(npz.load(tmp_path / "a.npz").recording.samples, strided)


# What cannot be kept -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "names", "key", "said"),
    [
        ({"samples": torch.zeros(2, 9, dtype=torch.float16)}, "ab", {}, "float32 or float64.*16"),
        ({"samples": torch.zeros(2, 9, dtype=torch.int64)}, "ab", {}, "float32 or float64.*int64"),
        ({}, "abc", {}, "the hand has 3 channels, the recording 2"),
        ({"material": "M1\0"}, "ab", {}, "must not hold a NUL"),
        ({}, ["a", "b\0"], {}, "must not hold a NUL"),
        ({"provenance": {"by": object()}}, "ab", {}, "provenance must be plain JSON"),
        ({}, "ab", {"rate": float("nan")}, "key must be plain JSON"),
    ],
)
def test_what_cannot_be_kept_is_refused_and_nothing_is_lost(tmp_path, changes, names, key, said):
    path = tmp_path / "a.npz"
    path.write_bytes(b"before")
    with pytest.raises(ValueError, match=said):
        npz.save(path, recording(**changes), hand_of(names), key)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


# What is no recording ------------------------------------------------------------------------


def assert_refused(path, said="is damaged or no recording of ours"):
    for read in (npz.load, npz.key):
        with pytest.raises(ValueError, match=said) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def test_foreign_files_are_refused(tmp_path):
    np.savez(tmp_path / "theirs.npz", samples=np.zeros((2, 9)))
    np.save(tmp_path / "one.npy", np.zeros(3))
    np.save(tmp_path / "pickled.npy", np.array([{}], dtype=object), allow_pickle=True)
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("time,volts\n0,1\n")
    torch.save({"format": FORM}, tmp_path / "torch.npz")
    for path in sorted(tmp_path.iterdir()):
        assert_refused(path)


def test_nothing_pickled_is_read(tmp_path):
    """A file like ours whose samples are Python objects: loading those would run code."""
    path = tmp_path / "a.npz"
    npz.save(path, recording(), hand_of("ab"), KEY)
    with np.load(path) as content:
        parts = dict(content)
    np.savez(path, **(parts | {"samples": np.array([[print], [print]], dtype=object)}))
    with pytest.raises(ValueError, match="is damaged"):
        npz.load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"samples": np.zeros((2, 9), dtype=np.int32)},
        {"samples": np.zeros(9)},
        {"samples": np.zeros((3, 9))},
        {"samples": np.zeros((2, 9), dtype=np.complex64)},
        {"channel_kind": np.array(["SG", "IMU"])},
        {"channel_name": np.array(["a", "a"])},
        {"channel_name": np.array(["a"])},
        {"onsets_s": np.array([0.1])},
        {"sliding_s": np.zeros((2, 3))},
        {"sample_rate_hz": np.array(-1.0)},
        {"provenance": np.array("{")},
        {"key": np.array("3")},
    ],
)
def test_parts_that_do_not_belong_together_are_refused(tmp_path, changes):
    path = tmp_path / "a.npz"
    npz.save(path, recording(), hand_of("ab"), KEY)
    with np.load(path) as content:
        parts = dict(content)
    np.savez(path, **parts)
    assert_same(npz.load(path).recording, recording())  # rewritten, but whole
    np.savez(path, **(parts | changes))
    with pytest.raises(ValueError, match="is damaged or no recording of ours"):
        npz.load(path)


def test_a_later_format_is_named(tmp_path):
    path = tmp_path / "a.npz"
    npz.save(path, recording(), hand_of("ab"), KEY)
    with np.load(path) as content:
        parts = dict(content)
    np.savez(path, **(parts | {"format": np.array("tactslip_torch recording 2")}))
    assert_refused(path, "must be of format 'tactslip_torch recording 1', got '.* 2'")


def test_a_part_that_is_missing_is_noticed(tmp_path):
    path = tmp_path / "a.npz"
    npz.save(path, recording(), hand_of("ab"), KEY)
    with np.load(path) as content:
        parts = dict(content)
    for name in parts:
        np.savez(path, **{other: parts[other] for other in parts if other != name})
        with pytest.raises(ValueError, match="is damaged"):
            npz.load(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.npz"
    npz.save(path, recording(), hand_of("ab"), KEY)
    return path.read_bytes()


@given(where=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
@example(where=0.5, bits=1)
@settings(max_examples=150)
def test_a_damaged_byte_is_noticed_or_does_not_matter(whole, tmp_path_factory, where, bits):
    content = bytearray(whole)
    content[int(where * len(content))] ^= bits
    path = tmp_path_factory.mktemp("damaged") / "a.npz"
    path.write_bytes(content)
    try:
        found = npz.load(path)
    except ValueError:
        return
    assert_same(found.recording, recording())
    assert (found.hand, found.key) == (hand_of("ab"), KEY)


def test_a_damaged_sample_is_noticed(whole, tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(whole)
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("samples.npy").header_offset
    for offset in (400, 1000, 2000):
        content = bytearray(whole)
        content[start + offset] ^= 1
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is damaged"):
            npz.load(path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_cut_file_is_refused(whole, tmp_path, share):
    path = tmp_path / "a.npz"
    path.write_bytes(whole[: int(share * len(whole))])
    assert_refused(path)


def test_no_file_is_said_as_such(tmp_path):
    for read in (npz.load, npz.key):
        with pytest.raises(FileNotFoundError, match=r"no file at .*a\.npz"):
            read(tmp_path / "a.npz")


# In pieces -----------------------------------------------------------------------------------


def assert_same_truth(archived, wanted, key=KEY):
    """Everything but the samples."""
    assert archived.recording.samples.shape == (len(wanted.samples), 0)
    assert archived.recording.samples.dtype == wanted.samples.dtype
    for name in (*TRUTH, "sample_rate_hz", "material", "provenance"):
        assert getattr(archived.recording, name) == getattr(wanted, name), name
    assert archived.hand == hand_of("ab")
    assert archived.key == key


@given(
    num_samples=st.integers(0, 40),
    dtype=st.sampled_from([np.float32, np.float64, ">f4", ">f8"]),
    size=st.integers(1, 50),
    stretch=st.tuples(st.integers(0, 45), st.integers(0, 45)),
    write=st.sampled_from(["savez", "savez_compressed", "npy"]),
    is_transposed=st.booleans(),
    seed=st.integers(0, 99),
)
def test_pieces_are_the_samples(
    tmp_path_factory, num_samples, dtype, size, stretch, write, is_transposed, seed
):
    samples = np.random.default_rng(seed).standard_normal((3, num_samples)).astype(dtype)
    stored = np.asfortranarray(samples) if is_transposed else samples
    folder = tmp_path_factory.mktemp("pieces")
    if write == "npy":  # one instant a row, in either order of the bytes
        np.save(folder / "a.npy", stored.T)
    else:
        getattr(np, write)(folder / "a.npz", samples=stored)
    (path,) = folder.iterdir()
    with npz.open(path) as (found, rest, *_):
        assert rest is None
        assert (found.num_channels, found.num_samples) == samples.shape
        parts = list(pieces(found, size))
        part = found.read(*stretch)
    native = samples.astype(samples.dtype.newbyteorder("="))
    assert [piece.shape[1] for piece in parts] == [
        len(native[0, first : first + size]) for first in range(0, num_samples, size)
    ]
    whole = torch.cat(parts, 1).numpy() if parts else native
    assert whole.dtype == part.numpy().dtype == native.dtype
    np.testing.assert_array_equal(whole, native)
    np.testing.assert_array_equal(part.numpy(), native[:, slice(*stretch)])


@pytest.mark.parametrize("compressed", [False, True])
def test_a_recording_of_ours_comes_with_its_truth(tmp_path, compressed):
    path = tmp_path / "a.npz"
    npz.save(path, recording(), hand_of("ab"), KEY)
    if compressed:
        with np.load(path) as content:
            np.savez_compressed(path, **content)
    with npz.open(path) as (samples, rest, *_):
        assert torch.equal(samples.read(0, 400), recording().samples)
        assert torch.equal(torch.cat(list(pieces(samples, 7)), 1), recording().samples)
    assert_same_truth(rest, recording())


def test_no_more_of_a_file_is_read_than_was_asked_for(tmp_path, monkeypatch):
    """After the one look for damage, bytes are counted; an archive's members may stand anywhere."""
    path = tmp_path / "a.npz"
    npz.save(path, recording(samples=torch.randn(2, 100_000)), hand_of("ab"), KEY)
    with npz.open(path) as (samples, *_):
        counted = CountedFile(samples.file)
        samples._replace(file=counted).read(60_000, 60_010)
    assert counted.num_bytes == 2 * 10 * 4


class CountedFile:
    """A file that counts what is read of it."""

    def __init__(self, file):
        self.file, self.num_bytes = file, 0
        self.seek = file.seek

    def read(self, size):
        content = self.file.read(size)
        self.num_bytes += len(content)
        return content


def test_a_file_that_is_cut_while_it_is_open_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((90_000, 2)))
    with npz.open(tmp_path / "a.npy") as (samples, *_):
        with (tmp_path / "a.npy").open("r+b") as file:
            file.truncate(500_000)
        assert samples.read(0, 10).shape == (2, 10)
        with pytest.raises(ValueError, match=r"a\.npy was cut while it was read"):
            samples.read(80_000, 90_000)


def test_opened_in_pieces_the_same_files_are_refused(tmp_path, whole):
    torch.save({"format": FORM}, tmp_path / "torch.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npy").write_text("time,volts\n0,1\n")
    np.savez(tmp_path / "flat.npz", samples=np.zeros(9))
    np.savez(tmp_path / "halves.npz", samples=np.zeros((2, 9), dtype=np.float16))
    np.savez(tmp_path / "no_channel.npz", samples=np.zeros((0, 9)))
    np.savez(tmp_path / "pickled.npz", samples=np.array([[print], [print]], dtype=object))
    np.save(tmp_path / "pickled.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    np.save(tmp_path / "deep.npy", np.zeros((2, 3, 4)))
    np.save(tmp_path / "cut.npy", np.zeros((20, 3)))
    with (tmp_path / "cut.npy").open("r+b") as file:
        file.truncate(500)
    with np.load(io.BytesIO(whole)) as content:
        parts = dict(content)
    np.savez(tmp_path / "hand.npz", **(parts | {"channel_name": np.array(["a"])}))
    for path in sorted(tmp_path.iterdir()):
        with (
            pytest.raises(ValueError, match="is damaged or no recording of ours") as caught,
            npz.open(path),
        ):
            pass
        assert str(path) in str(caught.value)
    np.savez(tmp_path / "later.npz", **(parts | {"format": np.array("tactslip_torch recording 2")}))
    with (
        pytest.raises(ValueError, match="must be of format"),
        npz.open(path.parent / "later.npz"),
    ):
        pass
    with pytest.raises(FileNotFoundError, match="no file at"), npz.open(tmp_path / "b.npz"):
        pass


@given(where=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
@settings(max_examples=100)
def test_a_damaged_byte_is_noticed_in_pieces_as_well(whole, tmp_path_factory, where, bits):
    content = bytearray(whole)
    content[int(where * len(content))] ^= bits
    path = tmp_path_factory.mktemp("damaged") / "a.npz"
    path.write_bytes(content)
    try:
        with npz.open(path) as (samples, rest, *_):
            found = samples.read(0, 400)
    except ValueError:
        return
    assert_same_truth(rest, recording())
    assert found.numpy().tobytes() == recording().samples.numpy().tobytes()


def test_what_goes_wrong_with_an_open_recording_is_not_called_damage(tmp_path):
    npz.save(tmp_path / "a.npz", recording(), hand_of("ab"), KEY)
    with pytest.raises(RuntimeError, match="mine"), npz.open(tmp_path / "a.npz") as (file, *_):
        raise RuntimeError("mine")
    assert file.file.closed


def test_a_folder_knows_its_recordings(tmp_path):
    for name in ("b.npz", "a.NPY", ".b.1234.tmp.npz", MANIFEST, "c.png"):
        (tmp_path / name).touch()
    assert [path.name for path in recording_files(tmp_path)] == ["a.NPY", "b.npz"]
    assert recording_files(tmp_path / "b.npz") == [tmp_path / "b.npz"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"no recording in .*empty; give a folder of \.npz or "):
        recording_files(tmp_path / "empty")
    with pytest.raises(ValueError, match=r"c\.png must end in \.npz or "):
        recording_files(tmp_path / "c.png")
    with pytest.raises(FileNotFoundError, match="no file or folder at"):
        recording_files(tmp_path / "nowhere")


def test_arrays_of_others(tmp_path):
    volts = np.arange(18, dtype=np.int16).reshape(9, 2)
    stamps = np.arange(9) * 500_000 + 10**18
    np.savez(tmp_path / "a.npz", volts=volts, stamp=stamps, fs=2000.0)
    with (
        pytest.raises(ValueError, match=r"has no array 'samples', it has volts, stamp, fs; say"),
        npz.open(tmp_path / "a.npz"),
    ):
        pass
    with npz.open(tmp_path / "a.npz", Reading(samples="volts", time_unit="ns")) as opened:
        samples, rest, names, times, rate = opened
        assert (rest, names, rate) == (None, None, 2000.0)
        assert samples.dtype == torch.float32
        assert samples.read(2, 4).tolist() == [[4.0, 6.0], [5.0, 7.0]]
        assert times.read(7, 9).tolist() == pytest.approx([0.0035, 0.004], abs=1e-15)
    for how, said in (
        (Reading(samples="volts", time="clock"), "reading.time='clock' is none of volts, stamp"),
        (Reading(samples="volts", time="volts"), "has 9 samples and 18 times in 'volts'"),
    ):
        with pytest.raises(ValueError, match=said), npz.open(tmp_path / "a.npz", how):
            pass
    np.savez(tmp_path / "square.npz", volts=np.zeros((3, 3)))
    with (
        pytest.raises(ValueError, match="3 by 3, so it does not show which axis is time"),
        npz.open(tmp_path / "square.npz", Reading(samples="volts")),
    ):
        pass
    np.save(tmp_path / "b.npy", volts.T)
    with npz.open(tmp_path / "b.npy", Reading(time_first=False)) as opened:
        assert opened.samples.read(0, 2).tolist() == [[0.0, 2.0], [1.0, 3.0]]
