"""Damaged and malicious recordings and manifests: one line with the name, and nothing runs."""

import itertools
import json
import os
import pickle
import random
import struct
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io
import torch
from extremes import SEED
from message_bags import Sent, json_message, write_mcap

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.formats import endings, format_of, pieces
from tactslip_torch.data.manifest import read_manifest

from .names import named_format
from .recordings import CHANNELS

LONGEST = 1000  # characters of a line for people, beside the path
NUM = int(os.environ.get("TACTSLIP_HOSTILE_FILES", "40"))
SAMPLES = np.random.default_rng(3).standard_normal((40, 3))
TIMES = np.arange(40) / 100
WORDS = [
    b"\0",
    b"\xff",
    b"\xff\xff\xff\x7f",
    b"nan",
    b"1e999",
    b"",
    b"1_0",
    b'"',
    b"#",
    b",",
    b"\n",
]
WORDS += [b"\xb0", b"\xef\xbb\xbf", b"\xff\xfe", "\u0663".encode(), b"9" * 400, b"{", b"[", b"../"]


NATIVE = ("npz", "csv", "h5", "mcap", "parquet")


def is_read(path):
    """Whether a file is read to its end; else one line is said, with its name."""
    said = ""
    try:
        with format_of(path).open(path) as opened:
            for piece in itertools.islice(pieces(opened.samples, 999), 40):
                assert len(piece) == opened.samples.num_channels
            opened.times()
    except ValueError as error:
        said = str(error)
    assert not said or (path.name in said and "\n" not in said)
    assert len(said) < LONGEST + len(str(path))
    return not said


def damaged(content, draw):
    """The bytes with up to three of the things that befall files."""
    for _ in range(draw.randint(1, 3)):
        size = len(content)
        where = draw.choice([draw.randint(0, min(size, 600)), draw.randint(0, size)])
        head, tail = content[:where], content[where:]
        word, length = draw.choice(WORDS), draw.randint(1, max(size // 2, 1))
        ways = head, head + word + tail[len(word) :], head + word + tail, head + tail[length:]
        content = draw.choice([*ways, head + tail[:length] + tail])
    return content


def table(delimiter, header=""):
    rows = np.column_stack([TIMES, SAMPLES]).tolist()
    return (header + "".join(delimiter.join(map(repr, row)) + "\n" for row in rows)).encode()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Files as they should be, native and foreign, by name."""
    folder = tmp_path_factory.mktemp("whole")
    recording = Recording(torch.from_numpy(SAMPLES.T.copy()), 100.0, "M1", (), (), ())
    for ending in NATIVE:
        path = folder / f"native.{ending}"
        named_format(ending).save(path, recording, HandLayout.from_rows(CHANNELS[:3]), {"k": 1})
    np.save(folder / "a.npy", SAMPLES)
    np.savez_compressed(folder / "b.npz", samples=SAMPLES.T, time=TIMES)
    (folder / "c.csv").write_bytes(table(",", 'time_s,"a, b",c,d\n'))
    (folder / "d.txt").write_bytes(table("\t").replace(b".", b","))
    messages = [(n * 10**7, json_message({"x": row})) for n, row in enumerate(SAMPLES.tolist())]
    sent = Sent("/force", "Force", messages, "json", "jsonschema", "{}")
    write_mcap(folder / "e.mcap", [sent])
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    "name",
    [
        *(f"native.{ending}" for ending in NATIVE),
        "a.npy",
        "b.npz",
        "c.csv",
        "d.txt",
        "e.mcap",
    ],
)
def test_damage_is_one_line_and_never_other_samples_where_there_are_check_sums(
    whole, name, tmp_path
):
    counts = [0, 0]
    for number in range(NUM):
        path = tmp_path / name
        path.write_bytes(damaged(whole[name], random.Random(f"{SEED} {name} {number}")))
        counts[found := is_read(path)] += 1
        if found and name.endswith(("npz", "mcap", "parquet")):
            with format_of(path).open(path) as opened:
                np.testing.assert_array_equal(opened.samples.read(0, 99).T, SAMPLES)
    assert counts[False]


# Files made to do harm: what writes them, by their path and a folder that code in them would make


class Runs:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def huge_npy(path, canary):
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**50}, 24)}}".ljust(117) + "\n"
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode())


def packed_zeros(path, canary):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("samples.npy", bytes(2**28))


def link_out(path, canary):
    with h5py.File(path.with_name("other.h5"), "w") as file:
        file["samples"] = SAMPLES
    with h5py.File(path, "w") as file:
        file["samples"] = h5py.ExternalLink("other.h5", "/samples")
        layout = h5py.VirtualLayout((40, 3), "f8")
        layout[:] = h5py.VirtualSource("other.h5", "samples", (40, 3))
        file.create_virtual_dataset("virtual", layout)


def huge_hdf5(path, canary):
    with h5py.File(path, "w") as file:
        file.create_dataset("samples", (24, 2**40), "f8", chunks=(24, 2**10))


def long_variable(path, canary):
    scipy.io.savemat(path, {"x": np.zeros((2, 2**24))}, do_compression=True)


def claims_chunk(path, canary):
    content = struct.pack("<QQQIIQ", 0, 0, 2**62, 0, 0, 0)
    start = b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, 8) + bytes(8)
    path.write_bytes(start + struct.pack("<BQ", 6, len(content)) + content)


def runs_in_yaml(path, canary):
    path.mkdir()
    (path / "metadata.yaml").write_text(f"a: !!python/object/apply:os.mkdir [{canary}]\n")


def out_of_the_bag(path, canary):
    path.mkdir()
    lines = "version: 8", "storage_identifier: sqlite3", "relative_file_paths: [a.db3]"
    text = "rosbag2_bagfile_information:\n" + "".join(f"  {line}\n" for line in lines)
    (path / "metadata.yaml").write_text(text)
    (path.parent.parent / "b.db3").touch()
    (path / "a.db3").symlink_to(path.parent.parent / "b.db3")


FORM = "tactslip_torch recording 1"
TRAPS = {
    "code.npy": lambda path, canary: np.save(path, np.array([Runs(canary)]), allow_pickle=True),
    "code.npz": lambda path, canary: np.savez(path, format=FORM, samples=np.array([Runs(canary)])),
    **{
        f"pickle.{ending}": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary)))
        for ending in endings()
    },
    "huge.npy": huge_npy,
    "packed.npz": packed_zeros,
    "link.h5": link_out,
    "huge.h5": huge_hdf5,
    "packed.mat": long_variable,
    "claims.mcap": claims_chunk,
    "yaml": runs_in_yaml,
    "linked": out_of_the_bag,
    "deep.csv": lambda path, canary: path.write_text(f'# {FORM} {{"a":' + '[{"a":' * 100_000),
    "one_line.txt": lambda path, canary: path.write_bytes(b"0 " * 2**21),
}


@pytest.mark.parametrize("ending", endings())
def test_what_is_no_such_file_is_one_line(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    for content in (b"", bytes(5000), b"to be or not to be\n" * 50, b"PK\x05\x06" + bytes(18)):
        path.write_bytes(content)
        assert not is_read(path)
        assert not named_format(ending).is_native(path)
    path.unlink()
    path.mkdir()
    assert not is_read(path)
    path.rmdir()
    os.mkfifo(path)  # reading it would wait for ever
    assert not is_read(path)


@pytest.mark.parametrize("name", TRAPS)
def test_nothing_in_a_file_runs_and_no_claim_is_believed(name, tmp_path):
    path, canary = tmp_path / "inside" / name, tmp_path / "canary"
    path.parent.mkdir()
    TRAPS[name](path, canary)
    before = sorted(tmp_path.rglob("*"))
    assert not is_read(path)
    assert sorted(tmp_path.rglob("*")) == before


def test_the_code_in_the_traps_would_be_seen(tmp_path):
    pickle.loads(pickle.dumps(Runs(tmp_path / "canary")))
    assert (tmp_path / "canary").exists()


MANIFEST = (
    "file;material;trial;scene;onsets_s;sliding_s;label;sample_rate_hz\n"
    'a.csv;M1;0;paper;"2.0; 9.0";"2-7; 9-11.5";;2000\nsub/b.csv;wood;;;[2.0];[[2.0, 7.0]];;\n'
)


def test_a_damaged_manifest_lists_nothing_outside_its_folder(tmp_path):
    root = tmp_path / "set"
    for file in ("a.csv", "sub/b.csv", "../a.csv"):
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text("t,a\n0,1\n1,2\n")
    path, counts = root / "manifest.csv", [0, 0]
    texts = [b"file,material\na.csv\0,M1\n", b"file,material\n../a.csv,M1\n", MANIFEST.encode()]
    draws = [random.Random(f"{SEED} manifest {number}") for number in range(NUM)]
    for content in (*texts, *(damaged(MANIFEST.encode(), draw) for draw in draws)):
        path.write_bytes(content)
        try:
            listing = read_manifest(path, root)
        except ValueError:  # no text
            continue
        for entry in listing.entries:
            assert (root / entry.file).resolve().is_relative_to(root)
        for problem in (*listing.problems, *listing.warnings):
            assert "\n" not in str(problem)
            assert len(str(problem)) < LONGEST
        counts[not listing.problems] += 1
    assert all(counts)


def test_a_header_that_lacks_a_part_is_damaged(tmp_path):
    recording = Recording(torch.from_numpy(SAMPLES.T.copy()), 100.0, "M1", (), (), ())
    path = tmp_path / "a.csv"
    named_format("csv").save(path, recording, HandLayout.from_rows(CHANNELS[:3]), {})
    first, _, rest = path.read_text().partition("\n")
    header = json.loads(first.removeprefix(f"# {FORM} "))
    later = {"slip_s", "released_s"}  # what the first files did not have
    for name in set(header) - {"format"}:
        changed = json.dumps({key: value for key, value in header.items() if key != name})
        path.write_text(f"# {FORM} {changed}\n{rest}")
        assert is_read(path) == (name in later), name


# How people call and write times: header, the time at sample n, and the rate

MS = 1_700_000_000_000  # since 1970
STAMPS = {
    "time [s],a": (lambda n: f"{n * 0.01:.2f}", 100.0),
    "Timestamp (\N{GREEK SMALL LETTER MU}s),a": (lambda n: f"{n * 500}", 2000.0),
    "t_us,a": (lambda n: f"{n * 1000}", 1000.0),
    "Datum,a": (lambda n: f"2024-05-01T12:00:{n // 100:02d}.{n % 100:02d}", 100.0),
    "zeit;a": (lambda n: f"2024-05-01 12:00:00,{n * 10:03d}+02:00", 100.0),
    "utc,a": (lambda n: f"2024/12/31 23:59:{50 + n // 10}.{n % 10}00000Z", 10.0),
    "secs,nsecs,a": (lambda n: f"{MS // 1000 + n // 8},{n % 8 * 125_000_000}", 8.0),
    "stamp.sec,stamp.nanosec,a": (lambda n: f"{n // 8},{n % 8 * 125_000_000}", 8.0),
    "header.stamp.sec,header.stamp.nanosec,a": (lambda n: f"{n // 8},{n % 8 * 125_000_000}", 8.0),
}


@pytest.mark.parametrize("header", STAMPS)
def test_times_are_found_as_people_call_and_write_them(header, tmp_path):
    at, rate_hz = STAMPS[header]
    mark = ";" if ";" in header else ","
    lines = [header, *(f"{at(n)}{mark}{n}" for n in range(40))]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with format_of(path).open(path) as opened:
        assert opened.names == ("a",)
        assert opened.samples.read(0, 40)[0].tolist() == list(range(40))
        since = np.arange(40) / rate_hz
        np.testing.assert_allclose(opened.times(), since, rtol=0, atol=2e-6)


def test_a_stamp_beside_times_is_no_channel_and_a_day_that_is_none_no_stamp(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{n / 100},{n},2024-02-01 00:00:{n}" for n in range(10, 50)]
    path.write_text("\n".join(["time,a,when", *rows]) + "\n")
    with format_of(path).open(path) as opened:
        assert opened.names == ("a",)
        np.testing.assert_allclose(opened.times(), np.arange(40) / 100, atol=1e-12)
    path.write_text(
        path.read_text().replace("time,a,when", "b,a,timestamp").replace("-01 ", "-31 ")
    )
    with (
        pytest.raises(
            ValueError, match=r"in line 2: '2024-02-31 00:00:10' is no number, in column"
        ),
        format_of(path).open(path),
    ):
        pass


def test_an_array_or_a_message_may_have_its_time_in_two_numbers(tmp_path):
    seconds, rest = np.arange(40) // 8 + 1_700_000_000, np.arange(40) % 8 * 125_000_000
    values = [
        {"stamp": {"sec": int(s), "nanosec": int(n)}, "x": 1.0}
        for s, n in zip(seconds, rest, strict=True)
    ]
    messages = [(n * 10**9, json_message(value)) for n, value in enumerate(values)]
    write_mcap(tmp_path / "a.mcap", [Sent("/f", "F", messages, "json", "jsonschema", "{}")])
    np.savez(tmp_path / "a.npz", secs=seconds, nsecs=rest, x=np.ones(40))
    for name in ("a.mcap", "a.npz"):
        with format_of(tmp_path / name).open(tmp_path / name) as opened:
            assert opened.names == ("x",), name
            np.testing.assert_allclose(opened.times(), np.arange(40) / 8, atol=1e-9)
