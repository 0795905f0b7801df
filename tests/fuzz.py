"""Files that are damaged or made to do harm, and a process that reads them and may die of it.

Run as a script this is that process: a request is a line of JSON, and so is its answer: for
everything that was tried, ``read``, ``refused`` with the line that a person would see, or
``raised`` with what must not happen.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import pickle
import resource
import select
import struct
import subprocess
import sys
import traceback
import warnings
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io
import torch
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.formats import FORMATS, pieces
from tactslip_torch.data.manifest import read_manifest

FORM = "tactslip_torch recording 1"
GIBI = 2**30
MOST_BYTES = 512 * 2**20
"""Of address space beyond what the libraries themselves take."""
MOST_TAKEN = 200 * 2**20
"""Of memory really touched; less, so that what fails for want of the other is not all there is."""
PATIENCE_S = 120  # a file that takes longer hangs
LONGEST = 1000  # characters of a line for people, beside the path
MOST_PIECES = 40

# Whole files, ours and other people's: what damage begins from ---------------------------------

SAMPLES = np.random.default_rng(3).standard_normal((40, 3))
TIMES = np.arange(40) / 100


def recording(dtype=torch.float32):
    samples = torch.from_numpy(SAMPLES.T.copy()).to(dtype)
    return Recording(samples, 100.0, "M1", (20.0,), (0.1,), ((0.1, 0.2),), provenance={"a": [1]})


def hand():
    return HandLayout.from_rows(
        {"name": f"SG{i}", "kind": "SG", "finger": "index", "segment": "distal"} for i in range(3)
    )


def table(delimiter, header=""):
    rows = np.column_stack([TIMES, SAMPLES]).tolist()
    return header + "".join(delimiter.join(map(repr, row)) + "\n" for row in rows)


def write_hdf5(path, **how):
    with h5py.File(path, "w", **how) as file:
        group = file.create_group("run")
        stored = group.create_dataset(
            "volts", data=SAMPLES, chunks=(16, 3), compression="gzip", shuffle=True
        )
        stored.attrs["fs"] = 100.0
        group["time"] = TIMES
        group["names"] = ["a", "b", "c"]


def write_mat5(path):
    trial = {"volts": SAMPLES, "time": TIMES, "fs": 100.0, "labels": np.array(["a"], dtype=object)}
    scipy.io.savemat(path, {"trial": trial}, do_compression=True)


def write_mat73(path):
    write_hdf5(path, userblock_size=512)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_parquet(path):
    columns = {"time": TIMES, "a": SAMPLES[:, 0], "b": SAMPLES[:, 1].astype(np.float32)}
    pq.write_table(pa.table(columns), path, compression="zstd", row_group_size=16)


def write_mcap(path):
    with path.open("wb") as file:
        output = Writer(file, compression=CompressionType.ZSTD, chunk_size=1000)
        output.start()
        schema = output.register_schema("Force", "jsonschema", b'{"type": "object"}')
        channel = output.register_channel("/force", "json", schema)
        for number, row in enumerate(SAMPLES.tolist()):
            message = json.dumps({"x": row[0], "y": row[1:]}).encode()
            output.add_message(channel, number * 10_000_000, message, number * 10_000_000)
        output.finish()


LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\tOne\n***End_of_Header***\t\n\t\n"
    "Channels\t3\nDelta_X\t0.01\t0.01\t0.01\n***End_of_Header***\nX_Value\ta\tb\tc\tComment\n"
)

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
        "d.lvm": lambda path: path.write_text(LVM + table("\t")),
        "e.tsv": lambda path: path.write_text(table("\t", "t\ta\tb\tc\n"), encoding="utf-16"),
    },
    "hdf5": {"a.h5": write_hdf5},
    "mat": {"a.mat": write_mat5, "b.mat": write_mat73},
    "parquet": {"a.parquet": write_parquet},
    "mcap": {"a.mcap": write_mcap},
}


def write_seeds(folder):
    """Files of every format that is known, ours first."""
    found = {}
    for name, form in FORMATS.items():
        place = folder / name
        place.mkdir()
        ending = "" if form.is_folder else f".{form.endings[0]}"
        for dtype in (torch.float32, torch.float64):
            form.save(place / f"ours{dtype.itemsize}{ending}", recording(dtype), hand(), {"k": 1})
        for file, write in THEIRS.get(name, {}).items():
            write(place / file)
        found[name] = sorted(place.iterdir(), key=lambda path: not path.name.startswith("ours"))
    return found


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


def sparse(start=b"", inner=""):
    """A file of 10 GiB that takes no room."""

    def write(path, canary):
        path = path / inner if inner else path
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(start)
        os.truncate(path, 10 * GIBI)

    return write


def zeros(head, num_bytes):
    """A deflate stream of a head and zeros, and its length; made without making the zeros."""
    block = bytes(2**20)
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = pack.compress(head) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(block) + pack.flush(zlib.Z_FULL_FLUSH)  # it may be repeated: it is full
    times = num_bytes // len(block)
    return start + again * times + pack.flush(), len(head) + times * len(block)


def elsewhere(canary):
    """A file that is none of its: numbers that must not be read."""
    other = canary.with_name("other.h5")
    with h5py.File(other, "w") as file:
        file["samples"] = np.ones((3, 99))
    return other


def npy_head(text: str, version: tuple[int, int] = (1, 0)) -> bytes:
    """The head of an array with this description."""
    head = text.encode() + b"\n"
    size = struct.pack("<H" if version == (1, 0) else "<I", len(head))
    return b"\x93NUMPY" + bytes(version) + size + head


def claims(shape, dtype="'<f8'"):
    return npy_head(f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}")


def zipped(path, members, how=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", how) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def bomb(path, head, num_bytes, name, beside):
    """An archive with a member that unpacks to gigabytes, as it says itself."""
    packed, size = zeros(head, num_bytes)
    zipped(path, {name: b"", **beside})
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        own = archive.getinfo(name)
        following = [info.header_offset for info in archive.infolist()[1:]]
        end = min(following, default=archive.start_dir)
    data = own.header_offset + 30 + len(name)
    grown = len(packed) - (end - data)
    content[data:end] = packed
    struct.pack_into("<III", content, own.header_offset + 14, 0, len(packed), size)
    directory = archive.start_dir + grown
    struct.pack_into("<III", content, directory + 16, 0, len(packed), size)
    at = directory
    for info in archive.infolist()[1:]:
        at = content.index(b"PK\1\2", at + 4)
        struct.pack_into("<I", content, at + 42, info.header_offset + grown)
    struct.pack_into("<I", content, content.rindex(b"PK\5\6") + 16, directory)
    path.write_bytes(content)


def object_array(canary):
    held = io.BytesIO()
    np.save(held, np.array([[Runs(canary)]], dtype=object), allow_pickle=True)
    return held.getvalue()


def saved(array):
    held = io.BytesIO()
    np.save(held, array)
    return held.getvalue()


BOMB = 3 * GIBI // 8  # so that a process allowed half a GiB would read it all


def archive(**members):
    """An archive with these members: bytes, or what makes them of the canary."""

    def write(path, canary):
        zipped(path, {f"{n}.npy": m(canary) if callable(m) else m for n, m in members.items()})

    return write


def bombed(head, num_bytes, name, **beside):
    beside = {f"{other}.npy": content for other, content in beside.items()}
    return lambda path, canary: bomb(path, head, num_bytes, f"{name}.npy", beside)


OURS = {"format": saved(np.array(FORM))}
WIDE = claims("()", f"'<U{BOMB // 4}'")
NPZ = {
    "sparse.npy": sparse(),
    "sparse_claims.npy": sparse(claims(f"({2**40}, 24)")),
    "huge.npy": claims(f"({2**60}, {2**60})"),
    "negative.npy": claims("(-8, -8)") + bytes(512),
    "wrapped.npy": claims(f"({2**63}, 2)") + bytes(512),
    "deep.npy": npy_head("(" * 9000),
    "code.npy": lambda path, canary: path.write_bytes(
        npy_head(f"__import__('os').mkdir({str(canary)!r})")
    ),
    "long.npy": npy_head(" " * 2**20, (2, 0)) + bytes(64),
    "wide.npy": claims("()", "'<U500000000'") + bytes(64),
    "objects.npy": lambda path, canary: path.write_bytes(object_array(canary)),
    "pickle.npy": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
    "objects.npz": archive(samples=object_array),
    "our_objects.npz": archive(samples=object_array, key=object_array, **OURS),
    "format_object.npz": archive(format=object_array),
    "huge.npz": archive(samples=claims(f"({2**50}, 24)")),
    "our_huge.npz": archive(samples=claims(f"({2**50}, 24)"), key=claims(f"({2**50}, 24)"), **OURS),
    "bomb.npz": bombed(claims(f"(8, {GIBI // 16})"), 4 * GIBI - 2**21, "samples"),
    "our_bomb.npz": bombed(
        claims(f"(8, {BOMB // 64})"), BOMB, "samples", key=saved(np.array("{}")), **OURS
    ),
    "key_bomb.npz": bombed(WIDE, BOMB, "key", samples=saved(np.zeros((2, 9))), **OURS),
    "format_bomb.npz": bombed(WIDE, BOMB, "format"),
    "other_packing.npz": lambda path, canary: zipped(
        path, {"samples.npy": saved(np.zeros((2, 9)))}, zipfile.ZIP_LZMA
    ),
    "ways_out.npz": lambda path, canary: zipped(
        path, {f"../{canary.name}/samples.npy": b"", f"{canary}.npy": b"", "../x.npy": b""}
    ),
    "sparse.npz": sparse(b"PK\3\4"),
}


def many_channels():
    """A header that is whole, with channels that nobody has compared in pairs."""
    rows = [{"name": str(i), "kind": "SG", "finger": "", "segment": ""} for i in range(50_000)]
    facts = {"format": str(FORM), "dtype": "float64", "shape": [len(rows), 1], "channels": rows}
    facts |= dict.fromkeys(("sample_rate_hz", "units", "material"), 1)
    facts |= dict.fromkeys(("speeds_mm_s", "onsets_s", "annotated_onsets_s", "sliding_s"), ())
    facts |= {"non_slip_s": [], "slip_s": [], "provenance": {}, "key": {}}
    return f"# {FORM} {json.dumps(facts)}\ntime_s,a\n0,1\n".encode()


HEAD = f'# {FORM} {{"format": "{FORM}", '.encode()
TEXT = {
    "sparse.csv": sparse(),
    "sparse_rows.csv": sparse(b"t,a\n" + b"0,1\n" * 99),
    "sparse_head.csv": sparse(b"# tactslip_torch recording 1 {"),
    "sparse_utf16.txt": sparse("t\ta\n0\t1\n".encode("utf-16")),
    "claims.csv": HEAD + b'"dtype": "float64", "shape": [24, %d]}\ntime_s,a\n0,1\n' % 2**50,
    "many_channels.csv": many_channels(),
    "deep.csv": b"# tactslip_torch recording 1 {" + b'"a":[' * 200_000 + b"\ntime_s,a\n0,1\n",
    "digits.csv": HEAD + b'"shape": [' + b"9" * 100_000 + b", 1]}\ntime_s,a\n0,1\n",
    "one_line.txt": b"0 " * 2**21,
    "long_cell.csv": b'0,"' + b"9" * 900_000 + b'"\n',
    "many_columns.csv": b"0," * 400_000 + b"0\n1,2\n",
    "many_names.csv": b"a," * 300_000 + b"a\n0,1\n",
    "formula.csv": b"t,a\n0,=mkdir('CANARY')\n",
    "pickle.txt": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary), 0)),
}


def hdf5(build):
    def write(path, canary):
        with h5py.File(path, "w") as file:
            build(file, canary)

    return write


def zlib_of_zeros(num_bytes):
    return b"\x78\xda" + zeros(b"", num_bytes)[0] + bytes(4)


def external_link(file, canary):
    file["samples"] = h5py.ExternalLink(str(elsewhere(canary)), "/samples")


def virtual(file, canary):
    layout = h5py.VirtualLayout((3, 99), "f8")
    layout[:] = h5py.VirtualSource(str(elsewhere(canary)), "samples", (3, 99))
    file.create_virtual_dataset("samples", layout)


def external_storage(file, canary):
    other = canary.with_name("other.raw")
    other.write_bytes(np.ones((3, 99)).tobytes())
    file.create_dataset("samples", (3, 99), "f8", external=[(str(other), 0, 3 * 99 * 8)])


def huge(file, canary):
    file.create_dataset("samples", (24, 2**40), "f8", chunks=(24, 2**10))


def huge_chunk(file, canary):
    stored = file.create_dataset(
        "samples", (24, 2**24), "f4", chunks=(1, 2**24), compression="gzip"
    )
    for row in range(24):  # each chunk unpacks to eight times what it should
        stored.id.write_direct_chunk((row, 0), zlib_of_zeros(GIBI // 2))


def opaque(file, canary):
    file.attrs["header"] = np.void(pickle.dumps(Runs(canary)))
    file["samples"] = np.void(pickle.dumps(Runs(canary)))


def circle(file, canary):
    file["a/b"] = file["/"]
    file["a/c"] = file["a"]


HDF5 = {
    f"{build.__name__}.h5": hdf5(build)
    for build in (external_link, virtual, external_storage, huge, huge_chunk, opaque, circle)
}
HDF5["sparse.h5"] = sparse(b"\x89HDF\r\n\x1a\n")


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def mat5(content):
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + content


def matrix(kind, rows, columns, data):
    flags = element(6, struct.pack("<II", kind, 0))
    return flags + element(5, struct.pack("<ii", rows, columns)) + element(1, b"samples") + data


def mat_bomb(path, canary):
    head = struct.pack("<II", 14, GIBI) + matrix(6, 8, GIBI // 64, struct.pack("<II", 9, GIBI))
    pack = zlib.compressobj(9)
    packed = pack.compress(head) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(bytes(2**20)) + pack.flush(zlib.Z_FULL_FLUSH)
    packed += again * 1024 + pack.flush()
    path.write_bytes(mat5(struct.pack("<II", 15, len(packed)) + packed))


def mat_objects(path, canary):
    held = pickle.dumps(Runs(canary))
    path.write_bytes(mat5(element(14, matrix(17, 1, len(held), element(2, held)))))


def mat_nested(path, canary):
    cell = element(14, matrix(1, 1, 1, b""))
    for _ in range(2000):
        cell = element(14, matrix(1, 1, 1, cell))
    path.write_bytes(mat5(cell))


MAT = {
    "bomb.mat": mat_bomb,
    "objects.mat": mat_objects,
    "nested.mat": mat_nested,
    "huge.mat": mat5(
        element(14, matrix(6, 2**31 - 1, 2**31 - 1, struct.pack("<II", 9, 2**32 - 8)))
    ),
    "function.mat": mat5(element(14, matrix(16, 1, 1, b""))),
    "sparse.mat": sparse(mat5(b"")),
}


def parquet_objects(path, canary):
    held = pa.array([pickle.dumps(Runs(canary))] * 9, pa.binary())
    pq.write_table(pa.table({"time_s": np.arange(9.0), "a": held}), path)


def parquet_zeros(path, canary):
    """Runs of one value, which cost a few bytes however long they are."""
    columns = dict.fromkeys([f"c{i}" for i in range(48)], pa.nulls(2**22, pa.float64()))
    pq.write_table(pa.table(columns), path, compression="zstd", row_group_size=2**22)


PARQUET = {
    "objects.parquet": parquet_objects,
    "nulls.parquet": parquet_zeros,
    "sparse.parquet": sparse(b"PAR1"),
}


def mcap_record(kind, content, size=None):
    return struct.pack("<BQ", kind, len(content) if size is None else size) + content


MCAP_START = b"\x89MCAP0\r\n" + mcap_record(1, bytes(8))


def mcap_chunk(size, packing, packed):
    head = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(packing)) + packing
    return MCAP_START + mcap_record(6, head + struct.pack("<Q", len(packed)) + packed)


MCAP = {
    "claims.mcap": mcap_chunk(2**62, b"", b""),
    "record.mcap": MCAP_START + mcap_record(5, b"", 2**62),
    "sparse.mcap": sparse(MCAP_START),
}


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


ROSBAG2 = {
    "absolute": bag("OUTSIDE"),
    "parent": bag("../other.h5"),
    "link": bag(fill=lambda path, canary: (path / "a.db3").symlink_to(elsewhere(canary))),
    "object": bag(text="a: !!python/object/apply:os.mkdir [CANARY]\n"),
    "laughs": bag(
        text="a0: &a0 [x, x]\n"
        + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
    ),
    "nested": bag(text="[" * 900),
    "sparse": bag(fill=sparse(inner="a.db3")),
    "sparse_sqlite": bag(fill=sparse(b"SQLite format 3\0", "a.db3")),
    "sparse_metadata": bag(fill=sparse(inner="metadata.yaml")),
}
TRAPS = {"npz": NPZ, "text": TEXT, "hdf5": HDF5, "mat": MAT, "parquet": PARQUET, "mcap": MCAP}
for name in TRAPS:  # what is executed when it is unpickled
    TRAPS[name] |= {
        f"pickle.{FORMATS[name].endings[0]}": lambda path, canary: path.write_bytes(
            pickle.dumps(Runs(canary))
        )
    }
TRAPS["rosbag2"] = ROSBAG2


def write_trap(path, canary, trap):
    if callable(trap):
        trap(path, canary)
    else:
        path.write_bytes(trap.replace(b"CANARY", os.fsencode(canary)))


TABLE = b"file,material\n"
MANIFEST_TRAPS = {
    **{
        file: ("manifest.csv", TABLE + f"{file},M1\n".encode())
        for file in (
            "../outside.csv",
            "sub/../../outside.csv",
            "..\\outside.csv",
            "/etc/passwd",
            "C:\\outside.csv",
            "\\\\host\\share\\a.csv",
            "//host/a.csv",
            "link.csv",
            "circle.csv",
            "a.csv\0",
            "~/a.csv",
            "$HOME/a.csv",
            "file:///etc/passwd",
            "a" * 5000,
            "/".join("a" * 3000),
            "",
        )
    },
    "twice": ("manifest.csv", TABLE + b"a.csv,M1\na.csv,M1\n" * 2000),
    "long line": ("manifest.csv", TABLE + b"a" * 2**22 + b",M1\n"),
    "open quote": ("manifest.csv", TABLE + b'"a.csv,M1\n' * 50_000),
    "many columns": ("manifest.csv", b"file,material" + b",x" * 2000 + b"\na.csv,M1\n"),
    "many stretches": (
        "manifest.csv",
        b"file;material;sliding_s\na.csv;M1;" + b"3-1, " * 20_000 + b"\n",
    ),
    "deep cell": ("manifest.csv", b"file;material;onsets_s\na.csv;M1;" + b"[" * 100_000 + b"\n"),
    "long number": ("manifest.csv", b"file;material;onsets_s\na.csv;M1;" + b"9" * 100_000 + b"\n"),
    "long integer": ("manifest.csv", b"file,material,trial\na.csv,M1," + b"9" * 100_000 + b"\n"),
    "NULs": ("manifest.csv", bytes(100_000)),
    "binary": ("manifest.csv", bytes(range(256)) * 100),
    "UTF-16": ("manifest.csv", "file,material\na.csv,M1\n".encode("utf-16")),
    "object": ("manifest.yaml", b"- !!python/object/apply:os.mkdir [CANARY]\n"),
    "object in a cell": (
        "manifest.yaml",
        b"- file: !!python/object/apply:os.mkdir [CANARY]\n  material: a\n",
    ),
    "object for a key": ("manifest.yaml", b"- ? !!python/name:os.mkdir\n  : a\n"),
    "laughs": (
        "manifest.yaml",
        b"- &a0 [x, x]\n"
        + b"".join(b"- &a%d [*a%d, *a%d]\n" % (i, i - 1, i - 1) for i in range(1, 60)),
    ),
    "merge": ("manifest.yaml", b"- &a {file: a.csv}\n- {<<: *a, material: M1}\n"),
    "nested lists": ("manifest.yaml", b"[" * 50_000),
    "nested mappings": ("manifest.yaml", b"{a: " * 50_000),
    "nested blocks": ("manifest.yaml", b"- " * 50_000),
    "nested cell": (
        "manifest.yaml",
        b"- {file: a.csv, material: M1, onsets_s: " + b"[" * 400 + b"]" * 400 + b"}",
    ),
    "documents": ("manifest.yaml", b"--- 1\n" * 5000),
    "mapping in a cell": ("manifest.yaml", b"- {file: {a: b}, material: M1}\n"),
    "link in YAML": ("manifest.yaml", b"- {file: link.csv, material: M1}\n"),
    "YAML NUL": ("manifest.yaml", b'- {file: "a.csv\\0", material: M1}\n'),
    "large YAML": ("manifest.yaml", b"- {file: a.csv, material: M1}\n" * 2**20),
    "other ending": ("manifest.txt", TABLE + b"a.csv,M1\n"),
}


# Damage ---------------------------------------------------------------------------------------

_NUMBERS = [b"\0", b"\xff", b"\x7f", b"\x80", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"]
_NUMBERS += [b"\0\0\0\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0\0\0\0\1\0\0\0", b"\1\0\0\0"]
_WORDS = [b"nan", b"NaN", b"-inf", b"1e999", b"", b"0x1p3", b"1_0", b"N/A", b'"', b"#", b",", b"\t"]
_WORDS += [b"\r", b"\n", b"\r\n", b"\0", b"\xb0", b"\xef\xbb\xbf", b"\xff\xfe", "\u0663".encode()]
_WORDS += [b"9" * 400, b"{", b"}", b"[", b"../", b"%n", b"!!python/object:os.system", b"&a", b"*a"]


@st.composite
def damage(draw, content, others):
    """The bytes with up to three of the things that befall files."""
    for _ in range(draw(st.integers(1, 3))):
        size = len(content)
        where = draw(
            st.integers(0, min(size, 600))
            | st.integers(max(size - 600, 0), size)
            | st.integers(0, size)
        )
        length = draw(st.integers(1, 64) | st.integers(1, max(size // 2, 1)))
        head, part, tail = content[:where], content[where : where + length], content[where:]
        kind = draw(st.sampled_from(["cut", "flip", "number", "word", "drop", "twice", "other"]))
        if kind == "cut":
            content = head
        elif kind == "flip":
            bits = draw(st.integers(1, 255))
            content = head + bytes(byte ^ bits for byte in tail[:1]) + tail[1:]
        elif kind == "number":
            new = draw(st.sampled_from(_NUMBERS))
            content = head + new + tail[len(new) :]
        elif kind == "word":
            new = draw(st.sampled_from(_WORDS) | st.binary(max_size=20))
            content = head + new + tail[draw(st.integers(0, 8)) :]
        elif kind == "drop":
            content = head + tail[length:]
        elif kind == "twice":
            content = head + part + tail
        else:
            other = draw(st.sampled_from(others))
            content = head + other[draw(st.integers(0, len(other))) :]
    return content


def content_of(path):
    """A file, or the files of a folder, by name."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file.is_file()}


def write(path, content):
    """What ``content_of`` gave, somewhere else."""
    for name, part in content.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(part)
    return path


# The process ----------------------------------------------------------------------------------


def look(form, path):
    """Open a file and walk through its samples and times, as far as a large one allows."""
    with form.open(path) as opened:
        samples, size = opened.samples, opened.samples.num_samples
        held = [samples.read(0, 3), samples.read(max(size - 3, 0), size), samples.read(size, size)]
        held += itertools.islice(pieces(samples, 999), MOST_PIECES)
        for piece in held:
            assert (len(piece), piece.dtype) == (samples.num_channels, samples.dtype)
        assert [piece.shape[1] for piece in held[:3]] == [min(size, 3), min(size, 3), 0]
        assert opened.names is None or len(opened.names) == samples.num_channels
        if opened.times is not None:
            times = opened.times.read(0, min(size, 999))
            assert (times.shape, times.dtype) == ((min(size, 999),), torch.float64)


def summed(archived):
    """A sum of all that was loaded."""
    return zlib.crc32(archived.recording.samples.numpy().tobytes() + repr(archived).encode())


def listed(path, root):
    """Read a manifest; what it lists must lie in the root, what is wrong must be single lines."""
    listing = read_manifest(path, root)
    for entry in listing.entries:
        assert (root / entry.file).resolve().is_relative_to(root.resolve())
    for problem in (*listing.problems, *listing.warnings):
        assert "\n" not in str(problem), str(problem)
        assert len(str(problem)) < 1000, str(problem)[:2000]
    if listing.problems:
        raise ValueError(f"{path}: {len(listing.problems)} problems")


def outcome(what):
    """What comes of a call: ``[kind, text]``."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = ["read", str(what())]
        except (ValueError, FileNotFoundError) as error:
            found = ["refused", str(error)]
        except BaseException:
            found = ["raised", traceback.format_exc(limit=-6)[-3000:]]
    return ["raised", f"warned: {said[0].message}"] if said else found


def answer(request):
    """One request, of a file of some format or of a manifest."""
    path = Path(request["path"])
    if request["format"] == "manifest":
        return {"read": outcome(lambda: listed(path, path.parent))}
    form = FORMATS[request["format"]]
    return {
        "load": outcome(lambda: summed(form.load(path))),
        "key": outcome(lambda: form.key(path)),
        "open": outcome(lambda: look(form, path)),
    }


def allow(num_bytes):
    """Of address space, no more than this beyond what is in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + num_bytes
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def main():
    torch.set_num_threads(1)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints is no answer
    for line in sys.stdin:
        request = json.loads(line)
        if "allow" in request:
            allow(request["allow"])
        reply = {} if "allow" in request else answer(request)
        reply["peak"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(json.dumps(reply), file=answers, flush=True)


class Prober:
    """A process that reads files; if one ends it, another takes its place."""

    def __init__(self, folder, seeds):
        self.seeds, self.process, self.before = seeds, None, 0
        self.errors = (folder / "stderr").open("w+b")

    def start(self):
        """Every library is loaded by a whole file before memory is limited."""
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env=os.environ
            | {"PYTHONPATH": str(Path(__file__).parents[1])}
            | {"OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
            | {"ARROW_DEFAULT_MEMORY_POOL": "system", "OPENBLAS_NUM_THREADS": "1"},
        )
        for form, path in self.seeds:
            for what, (kind, said) in self.ask(form, path).items():
                assert kind == "read" or what != "open", said
        self.before = self._send({"allow": MOST_BYTES})["peak"]

    def ask(self, form, path):
        """What came of a file, by what was tried."""
        if self.process is None:
            self.start()
        answer = self._send({"format": form, "path": str(path)})
        taken = answer.pop("peak") - self.before
        if self.before and taken > MOST_TAKEN:
            self.end()
            raise AssertionError(f"{path} took {taken >> 20} MiB")
        return {what: (kind, said) for what, (kind, said) in answer.items()}

    def said(self):
        """What libraries wrote beside the answers."""
        self.errors.flush()
        return Path(self.errors.name).read_text(errors="replace")

    def stop(self):
        self.errors.close()
        if self.process is not None:
            self.end()

    def end(self):
        """The next file gets another process."""
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait()
        self.process, self.before = None, 0

    def _send(self, request):
        process = self.process
        process.stdin.write(json.dumps(request).encode() + b"\n")
        process.stdin.flush()
        if not select.select([process.stdout], [], [], PATIENCE_S)[0]:
            process.kill()
        line = process.stdout.readline()
        if not line:
            self.end()
            raise AssertionError(f"{request} ended the process with {process.returncode}")
        return json.loads(line)


def assert_read_or_refused(prober, form, path):
    """The answer for a file; refused is one line that names it."""
    answer = prober.ask(form, path)
    for what, (kind, said) in answer.items():
        assert kind in ("read", "refused"), f"{what} of {path}: {said}"
        if kind == "refused":
            assert "\n" not in said, f"{what} of {path}: {said}"
            assert path.name in said, f"{what} of {path}: {said}"
            assert len(said) < LONGEST + len(str(path)), f"{what} of {path}: {said}"
    return answer


def assert_refused(prober, form, path):
    """Nothing in such a file is taken for a recording; a key may stand before what is wrong."""
    for what, (kind, said) in assert_read_or_refused(prober, form, path).items():
        assert kind == "refused" or what == "key", f"{what} of {path}: {kind} {said}"


if __name__ == "__main__":
    main()
