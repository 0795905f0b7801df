"""No file makes reading crash, run code, take memory or say more than a line, whatever is in it."""

import io
import itertools
import os
import pickle
import random
import resource
import shutil
import struct
import time
import warnings
import zipfile
import zlib
from collections import Counter
from functools import partial
from pathlib import Path

import generated
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import torch
from foreign_files import LVM, stored
from message_bags import Sent, json_message, wrenches, write_bag, write_mcap

from tactslip_torch import Recording
from tactslip_torch.commands.stopping import BAD_INPUT as ONE_LINE
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.formats import pieces
from tactslip_torch.data.manifest import read_manifest

from .names import FORMATS, HandLayout
from .recordings import CHANNELS

FORM = "tactslip_torch recording 1"
MOST_BYTES = 2**33
"""Of address space beyond what is in use; libraries reserve gigabytes that they never touch."""
MOST_TAKEN = 300 * 2**20
"""Of memory really touched by one file."""
LONGEST_S = 5
LONGEST = 1000  # characters of a line for people, beside the path
SAMPLES = np.random.default_rng(3).standard_normal((40, 3))
TIMES = np.arange(40) / 100
HAND = HandLayout.from_rows(CHANNELS[:3])


@pytest.fixture(autouse=True)
def _limited(seeds):
    """Memory, once the whole files are there."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    most = pages * resource.getpagesize() + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def looked(form, path):
    """Open a file and walk through its samples and times."""
    with form.open(path) as opened:
        samples, size = opened.samples, opened.samples.num_samples
        held = [samples.read(0, 3), samples.read(max(size - 3, 0), size), samples.read(size, size)]
        held += itertools.islice(pieces(samples, 999), 40)
        for piece in held:
            assert (len(piece), piece.dtype) == (samples.num_channels, samples.dtype)
        assert [piece.shape[1] for piece in held[:3]] == [min(size, 3), min(size, 3), 0]
        assert opened.names is None or len(opened.names) == samples.num_channels
        times = opened.times()
        assert times is None or (times.shape, times.dtype) == ((size,), np.float64)


CHECKED = ("ours.npz", "b.npz", "ours.h5", "ours.mcap", "a.mcap", "ours.parquet", "packed.mat")
CHECKED += ("ours",)  # a bag
"""Files with check sums: what is damaged in them is not read as other samples."""


def samples_of(form, path):
    with form.open(path) as opened:
        return opened.samples.read(0, opened.samples.num_samples).double()


def listed(path):
    """Read a manifest; what it lists must lie in its folder, what is wrong must be single lines."""
    listing = read_manifest(path, path.parent)
    for entry in listing.entries:
        assert (path.parent / entry.file).resolve().is_relative_to(path.parent.resolve())
    for problem in (*listing.problems, *listing.warnings):
        assert "\n" not in str(problem)
        assert len(str(problem)) < LONGEST
    if listing.problems:
        raise ValueError(f"{path}: {len(listing.problems)} problems")


def is_read(use, path, is_format=True):
    """Whether a file is read; else what is said must be one line, of a format with its name."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.thread_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error" if is_format else "ignore")
        try:
            use(path)
            return True
        except ONE_LINE as error:
            said = str(error) if is_format else one_line(error)
        finally:
            taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
            assert taken * 1024 < MOST_TAKEN, f"{path} took {taken >> 10} MiB"
            assert time.thread_time() - began < LONGEST_S
    assert "\n" not in said
    assert path.name in said or not is_format
    assert len(said) < LONGEST + len(str(path))
    return False


# Whole files, ours and other people's: what damage begins from ---------------------------------


def table(delimiter, header="", num=3):
    rows = np.column_stack([TIMES, SAMPLES[:, :num]]).tolist()
    return header + "".join(delimiter.join(map(repr, row)) + "\n" for row in rows)


def write_arrays(path):
    labels = ["a", "b", "c"]
    content = {"volts": SAMPLES, "time": TIMES, "fs": 100.0, "labels": labels}
    stored(path, **{f"run/{name}": values for name, values in content.items()})


def write_parquet(path):
    columns = {"time": TIMES, "a": SAMPLES[:, 0], "b": SAMPLES[:, 1].astype(np.float32)}
    pq.write_table(pa.table(columns), path, compression="zstd", row_group_size=16)


def write_json(path):
    rows = enumerate(SAMPLES.tolist())
    messages = [(n * 10_000_000, json_message({"x": row[0], "y": row[1:]})) for n, row in rows]
    write_mcap(path, [Sent("/force", "Force", messages, "json", "jsonschema", "{}")])


THEIRS = {
    "npz": {
        "a.npy": lambda path: np.save(path, SAMPLES),
        "b.npz": lambda path: np.savez_compressed(path, samples=SAMPLES.T),
        "c.npy": lambda path: np.save(path, np.asfortranarray(SAMPLES.astype(">i2"))),
    },
    "text": {
        "a.csv": lambda path: path.write_text(table(",", 'time_s,"a, b",c,d\n')),
        "b.txt": lambda path: path.write_text(table("\t").replace(".", ",")),
        "c.dat": lambda path: path.write_text(table("  ", "# t a b c\n")),
        "d.lvm": lambda path: path.write_text(LVM.format(x="One", point=".") + table("\t", num=2)),
        "e.tsv": lambda path: path.write_text(table("\t", "t\ta\tb\tc\n"), encoding="utf-16"),
    },
    "hdf5": {"a.h5": write_arrays},
    "mat": {"packed.mat": write_arrays, "73.mat": write_arrays},
    "parquet": {"a.parquet": write_parquet},
    "mcap": {"a.mcap": write_json},
    "rosbag2": {"bag": lambda path: write_bag(path, [wrenches(10)[0]])},
}


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """Files of every format that is known, ours first."""
    folder, found = tmp_path_factory.mktemp("seeds"), {}
    samples = torch.from_numpy(SAMPLES.T.copy()).float()
    truth = (100.0, "M1", (20.0,), (0.1,), ((0.1, 0.2),))
    for name, form in FORMATS.items():
        (folder / name).mkdir()
        ending = "" if form.is_folder else f".{form.endings[0]}"
        paths = [folder / name / f"ours{ending}"]
        form.save(paths[0], Recording(samples, *truth, provenance={"a": [1]}), HAND, {"k": 1})
        for file, write in THEIRS.get(name, {}).items():
            paths.append(folder / name / file)
            write(paths[-1])
        assert all(is_read(partial(looked, form), path) for path in paths)
        assert [form.is_ours(path) for path in paths] == [True] + [False] * (len(paths) - 1)
        for path in paths[1:]:
            with pytest.raises(ValueError, match=f"{path.name}.*no recording of ours"):
                form.load(path)
        found[name] = paths
    return found


# Damage ---------------------------------------------------------------------------------------

_NUMBERS = [b"\0", b"\xff", b"\x7f", b"\x80", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"]
_NUMBERS += [b"\0\0\0\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0\0\0\0\1\0\0\0", b"\1\0\0\0"]
_WORDS = [b"nan", b"-inf", b"1e999", b"", b"0x1p3", b"1_0", b"N/A", b'"', b"#", b",", b"\t", b"\n"]
_WORDS += [b"\r", b"\0", b"\xb0", b"\xef\xbb\xbf", b"\xff\xfe", "\u0663".encode(), b"9" * 400]
_WORDS += [b"{", b"}", b"[", b"../", b"%n", b"!!python/object:os.system", b"&a", b"*a"]


def damaged(content, draw):
    """The bytes with up to three of the things that befall files."""
    for _ in range(draw.randint(1, 3)):
        size = len(content)
        end = draw.randint(max(size - 600, 0), size)
        where = draw.choice([draw.randint(0, min(size, 600)), end, draw.randint(0, size)])
        length = draw.choice([draw.randint(1, 64), draw.randint(1, max(size // 2, 1))])
        head, tail = content[:where], content[where:]
        word = draw.choice([*_NUMBERS, *_WORDS, draw.randbytes(draw.randint(0, 20))])
        content = {
            "cut": head,
            "over": head + word + tail[len(word) :],
            "in": head + word + tail,
            "drop": head + tail[length:],
            "twice": head + tail[:length] + tail,
        }[draw.choice(["cut", "over", "in", "drop", "twice"])]
    return content


def one_byte(content, draw):
    """The bytes with one that is another."""
    place = draw.randrange(draw.choice([len(content), min(len(content), 600)]))
    value = draw.choice([0, 255, content[place] ^ (1 << draw.randrange(8))])
    return content[:place] + bytes([value]) + content[place + 1 :]


@pytest.fixture
def place(tmp_path_factory):
    """Where the next file goes; of the last one nothing is left there."""
    folder = tmp_path_factory.mktemp("fuzzed")
    numbers = itertools.count()

    def empty():
        for path in folder.iterdir():
            shutil.rmtree(path)
        path = folder / str(next(numbers))
        path.mkdir()
        return path

    return empty


MANIFESTS = {
    "manifest.csv": (
        "file;material;trial;scene;onsets_s;sliding_s;label;sample_rate_hz\n"
        'a.csv;M1;0;paper;"2.0; 9.0";"2-7; 9-11.5";;2000\nsub/b.csv;wood;;;[2.0];[[2.0, 7.0]];;\n'
        "c.csv;cloth;3;;;;slip;100\n"
    ),
    "manifest.yaml": (
        "recordings:\n- {file: a.csv, material: M1, onsets_s: [2.0, 9.0],\n"
        "   sliding_s: [[2, 7], [9, 11]]}\n"
        "- file: sub/b.csv\n  object: wood\n  label: non-slip\n  trial: 4\n"
    ),
}


def set_of_files(folder, name, content):
    """A manifest in a folder with the files that it names, and one outside."""
    for file in ("a.csv", "sub/b.csv", "c.csv", "../outside.csv"):
        (folder / "set" / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / "set" / file).write_text("t,a\n0,1\n1,2\n")
    (folder / "set" / name).write_bytes(content)
    return folder / "set" / name


NUM = int(os.environ.get("TACTSLIP_HOSTILE_FILES", "40"))
"""Cases of a kind; as many as you like, each draws by its own number."""


def content_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", [*MANIFESTS, *FORMATS])
def test_damaged_files(name, seeds, place):
    counts = Counter()
    for number in range(NUM):
        draw, folder = random.Random(f"{generated.SEED} {name} {number}"), place()
        if name in FORMATS:
            seed = draw.choice(seeds[name])
            path = folder / seed.name
            (shutil.copytree if seed.is_dir() else shutil.copy)(seed, path)
            file = draw.choice(sorted(path.iterdir()) if path.is_dir() else [path])
            uses = [partial(looked, FORMATS[name]), FORMATS[name].load]
        else:
            file = path = set_of_files(folder, name, MANIFESTS[name].encode())
            uses = [listed]
        change = damaged if number % 4 < 2 else one_byte
        file.write_bytes(change(file.read_bytes(), draw))
        before = content_of(folder)
        for use in uses:
            counts[is_read(use, path, is_format=name in FORMATS)] += 1
        if path.name in CHECKED and is_read(uses[0], path):
            form = FORMATS[name]
            assert torch.equal(samples_of(form, path), samples_of(form, seed)), f"{number}: others"
        assert content_of(folder) == before, f"{number}: what was there is lost"
    assert counts[False]


# Files made to do harm -------------------------------------------------------------------------
#
# By name what a file holds, or what writes it, given its path and a canary: a file that code inside
# would make. CANARY in bytes stands for its path.


class Runs:
    """Makes the canary when it is unpickled."""

    def __init__(self, canary):
        self.canary = str(canary)

    def __reduce__(self):
        return os.mkdir, (self.canary, 0o700)


def pickled(path, canary):
    path.write_bytes(pickle.dumps(Runs(canary)))


def sparse(start=b"", inner=""):
    """A file of 10 GiB that takes no room."""

    def write(path, canary):
        path = path / inner if inner else path
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(start)
        os.truncate(path, 10 * 2**30)

    return write


def elsewhere(canary):
    """A file that is none of its: numbers that must not be read."""
    other = canary.with_name("other.h5")
    with h5py.File(other, "w") as file:
        file["samples"] = np.ones((3, 99))
    return other


def npy_head(text: str) -> bytes:
    """The head of an array with this description."""
    head = text.encode() + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head


def claims(shape, dtype="'<f8'"):
    return npy_head(f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}")


def saved(array):
    held = io.BytesIO()
    np.save(held, array, allow_pickle=True)
    return held.getvalue()


def objects(canary):
    return saved(np.array([[Runs(canary)]], dtype=object))


def archive(how=zipfile.ZIP_DEFLATED, **members):
    """An archive with these members: bytes, or what makes them of the canary."""

    def write(path, canary):
        with zipfile.ZipFile(path, "w", how) as file:
            for name, content in members.items():
                file.writestr(f"{name}.npy", content(canary) if callable(content) else content)

    return write


OURS = {"format": saved(np.array(FORM))}
ZEROS = 2**27
"""Bytes that pack into few."""
HEAD = f'# {FORM} {{"format": "{FORM}", '.encode()
TRAPS = {
    "sparse.npy": sparse(),
    "huge.npy": claims(f"({2**60}, {2**60})"),
    "code.npy": lambda path, canary: path.write_bytes(
        npy_head(f"__import__('os').mkdir({str(canary)!r})")
    ),
    "objects.npy": lambda path, canary: path.write_bytes(objects(canary)),
    "our_objects.npz": archive(samples=objects, key=objects, **OURS),
    "our_huge.npz": archive(samples=claims(f"({2**50}, 24)"), key=claims(f"({2**50}, 24)"), **OURS),
    "bomb.npz": archive(samples=lambda _: claims(f"(8, {ZEROS // 64})") + bytes(ZEROS)),
    "other_packing.npz": archive(zipfile.ZIP_LZMA, samples=saved(np.zeros((2, 9)))),
    "ways_out.npz": archive(**{"../canary/samples": b"", "/tmp/canary": b"", "../x": b""}),
    "sparse_rows.csv": sparse(b"t,a\n" + b"0,1\n" * 99),
    "claims.csv": HEAD + b'"dtype": "float64", "shape": [24, %d]}\ntime_s,a\n0,1\n' % 2**50,
    "deep.csv": b"# tactslip_torch recording 1 {" + b'"a":[' * 200_000 + b"\ntime_s,a\n0,1\n",
    "one_line.txt": b"0 " * 2**21,
}


def in_hdf5(build):
    def write(path, canary):
        with h5py.File(path, "w") as file:
            build(file, canary)

    TRAPS[f"{build.__name__}.h5"] = write


@in_hdf5
def external_link(file, canary):
    file["samples"] = h5py.ExternalLink(str(elsewhere(canary)), "/samples")
    file["soft"] = h5py.SoftLink("/samples")


@in_hdf5
def virtual(file, canary):
    layout = h5py.VirtualLayout((3, 99), "f8")
    layout[:] = h5py.VirtualSource(str(elsewhere(canary)), "samples", (3, 99))
    file.create_virtual_dataset("samples", layout)


@in_hdf5
def external_storage(file, canary):
    other = canary.with_name("other.raw")
    other.write_bytes(np.ones((3, 99)).tobytes())
    file.create_dataset("samples", (3, 99), "f8", external=[(str(other), 0, 3 * 99 * 8)])


@in_hdf5
def huge(file, canary):
    file.create_dataset("samples", (24, 2**40), "f8", chunks=(24, 2**10))


@in_hdf5
def huge_chunk(file, canary):
    how = {"chunks": (1, 2**22), "compression": "gzip"}
    stored = file.create_dataset("samples", (24, 2**22), "f4", **how)
    packed = zlib.compress(bytes(ZEROS))  # each chunk unpacks to eight times what it should
    for row in range(24):
        stored.id.write_direct_chunk((row, 0), packed)


@in_hdf5
def circle(file, canary):
    file["a/b"] = file["/"]
    file["a/c"] = file["a"]


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def mat5(kind, rows, columns, data):
    flags = element(6, struct.pack("<II", kind, 0))
    sizes = element(5, struct.pack("<ii", rows, columns))
    whole = element(14, flags + sizes + element(1, b"samples") + data)
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + whole


def mat_bomb(path, canary):
    scipy.io.savemat(path, {"x": np.zeros((2, ZEROS // 16))}, do_compression=True)


def mat_nested(path, canary):
    cell = mat5(1, 1, 1, b"")
    for _ in range(2000):
        cell = mat5(1, 1, 1, cell[128:])
    path.write_bytes(cell)


def parquet_nulls(path, canary):
    """Runs of one value, which cost a few bytes however long they are."""
    columns = dict.fromkeys([f"c{i}" for i in range(48)], pa.nulls(2**20, pa.float64()))
    pq.write_table(pa.table(columns), path, compression="zstd", row_group_size=2**20)


def mcap_record(kind, content, size=None):
    return struct.pack("<BQ", kind, len(content) if size is None else size) + content


MCAP_START = b"\x89MCAP0\r\n" + mcap_record(1, bytes(8))


def bag(file="a.db3", text=None, fill=None):
    text = text or (
        "rosbag2_bagfile_information:\n  version: 8\n  storage_identifier: sqlite3\n"
        f"  relative_file_paths: [{file}]\n"
    )

    def write(path, canary):
        path.mkdir()
        outside = elsewhere(canary)
        text_here = text.replace("CANARY", str(canary)).replace("OUTSIDE", str(outside))
        (path / "metadata.yaml").write_text(text_here)
        if fill is not None:
            fill(path, canary)

    return write


TRAPS |= {f"pickle.{ending}": pickled for ending in ("npz", "csv", "mat", "mcap")}
TRAPS |= {
    "bomb.mat": mat_bomb,
    "nested.mat": mat_nested,
    "huge.mat": mat5(6, 2**31 - 1, 2**31 - 1, struct.pack("<II", 9, 2**32 - 8)),
    "nulls.parquet": parquet_nulls,
    "claims.mcap": MCAP_START + mcap_record(6, struct.pack("<QQQIIQ", 0, 0, 2**62, 0, 0, 0)),
    "absolute.bag2": bag("OUTSIDE"),
    "link.bag2": bag(fill=lambda path, canary: (path / "a.db3").symlink_to(elsewhere(canary))),
    "object.bag2": bag(text="a: !!python/object/apply:os.mkdir [CANARY]\n"),
    "laughs.bag2": bag(
        text="a0: &a0 [x, x]\n"
        + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
    ),
    "sparse_sqlite.bag2": bag(fill=sparse(b"SQLite format 3\0", "a.db3")),
}


def test_the_canary_sings(tmp_path):
    """The code in the traps would be seen if it ran."""
    pickle.loads(pickle.dumps(Runs(tmp_path / "canary")))
    assert (tmp_path / "canary").exists()


MANIFEST_TRAPS = {  # beside what tests/test_manifest.py names
    "NUL in a name.csv": b"file,material\na.csv\0,M1\n",
    "variable.csv": b"file,material\n$HOME/a.csv,M1\n",
    "object in a cell.yaml": b"- file: !!python/object/apply:os.mkdir [CANARY]\n  material: a\n",
    "documents.yaml": b"--- 1\n" * 5000,
    "large.yaml": b"- {file: a.csv, material: M1}\n" * 2**20,
}


@pytest.mark.parametrize("trap", [*TRAPS, *MANIFEST_TRAPS])
def test_traps(trap, tmp_path, capfd):
    canary = tmp_path / "canary"
    path = tmp_path / "inside" / trap
    path.parent.mkdir()
    content = (TRAPS | MANIFEST_TRAPS)[trap]
    if callable(content):
        content(path, canary)
    else:
        path.write_bytes(content.replace(b"CANARY", os.fsencode(canary)))
    if trap in TRAPS:
        form = next(form for form in FORMATS.values() if path.suffix[1:] in form.endings)
        uses = [partial(looked, form), form.load]
    else:
        path, uses = set_of_files(tmp_path / "inside", trap, path.read_bytes()), [listed]
    before = sorted(tmp_path.iterdir())
    for use in uses:
        assert not is_read(use, path)
    assert sorted(tmp_path.iterdir()) == before  # nothing ran, nothing was put anywhere
    assert canary not in before
    assert capfd.readouterr() == ("", "")
