"""Files made to do harm: bombs, huge claims, code, ways out of the folder; each with its format."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

GIBI = 2**30
SPARSE_BYTES = 10 * GIBI
Trap = Callable[[Path, Path], None]
"""Writes a file, given a canary: a file that code inside would make, or one that is none of its."""


class Runs:
    """Makes the canary when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = str(canary)

    def __reduce__(self) -> tuple[object, tuple[str, int]]:
        return os.mkdir, (self.canary, 0o700)


def sparse(path: Path, start: bytes = b"") -> None:
    """A file of 10 GiB that takes no room."""
    path.write_bytes(start)
    os.truncate(path, SPARSE_BYTES)


# NumPy ---------------------------------------------------------------------------------------


def npy_head(text: str, version: tuple[int, int] = (1, 0)) -> bytes:
    """The head of an array with this description."""
    head = text.encode() + b"\n"
    size = struct.pack("<H" if version == (1, 0) else "<I", len(head))
    return b"\x93NUMPY" + bytes(version) + size + head


def claims(shape: str, dtype: str = "'<f8'") -> bytes:
    return npy_head(f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}")


def zipped(path: Path, members: dict[str, bytes], how: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w", how) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def zeros(head: bytes, num_bytes: int) -> tuple[bytes, int, int]:
    """A deflate stream of a head and zeros, its sum, its length; made without making the zeros."""
    block = bytes(2**20)
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = pack.compress(head) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(block) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(block) + pack.flush(zlib.Z_FULL_FLUSH)
    times = num_bytes // len(block)
    total = zlib.crc32(head)
    for _ in range(min(times, 8)):  # nobody comes to the sum of a large one
        total = zlib.crc32(block, total)
    return start + again * times + pack.flush(), total, len(head) + times * len(block)


def bomb(path: Path, head: bytes, num_bytes: int, name: str, beside: dict[str, bytes]) -> None:
    """An archive with a member that unpacks to gigabytes, as it says itself."""
    packed, total, size = zeros(head, num_bytes)
    zipped(path, {name: b"", **beside})
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        own = archive.getinfo(name)
        following = [info.header_offset for info in archive.infolist()[1:]]
        end = min(following, default=archive.start_dir)
    data = own.header_offset + 30 + len(name)
    grown = len(packed) - (end - data)
    content[data:end] = packed
    struct.pack_into("<III", content, own.header_offset + 14, total, len(packed), size)
    directory = archive.start_dir + grown
    struct.pack_into("<III", content, directory + 16, total, len(packed), size)
    at = directory
    for info in archive.infolist()[1:]:
        at = content.index(b"PK\1\2", at + 4)
        struct.pack_into("<I", content, at + 42, info.header_offset + grown)
    struct.pack_into("<I", content, content.rindex(b"PK\5\6") + 16, directory)
    path.write_bytes(content)


def object_array(canary: Path) -> bytes:
    held = io.BytesIO()
    np.save(held, np.array([[Runs(canary)]], dtype=object), allow_pickle=True)
    return held.getvalue()


FORM = np.array("tactslip_torch recording 1")


def saved(array: np.ndarray) -> bytes:
    held = io.BytesIO()
    np.save(held, array)
    return held.getvalue()


NPZ: dict[str, Trap] = {
    "sparse.npy": lambda path, canary: sparse(path),
    "sparse_claims.npy": lambda path, canary: sparse(path, claims(f"({2**40}, 24)")),
    "huge.npy": lambda path, canary: path.write_bytes(claims(f"({2**60}, {2**60})")),
    "negative.npy": lambda path, canary: path.write_bytes(claims("(-8, -8)") + bytes(512)),
    "wrapped.npy": lambda path, canary: path.write_bytes(claims(f"({2**63}, 2)") + bytes(512)),
    "deep.npy": lambda path, canary: path.write_bytes(npy_head("(" * 9000)),
    "code.npy": lambda path, canary: path.write_bytes(
        npy_head(f"__import__('os').mkdir({str(canary)!r})")
    ),
    "long.npy": lambda path, canary: path.write_bytes(npy_head(" " * 2**20, (2, 0)) + bytes(64)),
    "wide.npy": lambda path, canary: path.write_bytes(claims("()", "'<U500000000'") + bytes(64)),
    "objects.npy": lambda path, canary: path.write_bytes(object_array(canary)),
    "pickle.npy": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
    "pickle.npz": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
    "objects.npz": lambda path, canary: zipped(path, {"samples.npy": object_array(canary)}),
    "our_objects.npz": lambda path, canary: zipped(
        path,
        dict.fromkeys(("samples.npy", "key.npy"), object_array(canary))
        | {"format.npy": saved(FORM)},
    ),
    "format_object.npz": lambda path, canary: zipped(path, {"format.npy": object_array(canary)}),
    "huge.npz": lambda path, canary: zipped(path, {"samples.npy": claims(f"({2**50}, 24)")}),
    "our_huge.npz": lambda path, canary: zipped(
        path,
        dict.fromkeys(("samples.npy", "key.npy"), claims(f"({2**50}, 24)"))
        | {"format.npy": saved(FORM)},
    ),
    "bomb.npz": lambda path, canary: bomb(
        path, claims(f"(8, {GIBI // 16})"), 4 * GIBI - 2**21, "samples.npy", {}
    ),
    "our_bomb.npz": lambda path, canary: bomb(
        path,
        claims(f"(8, {GIBI // 64})"),
        GIBI,
        "samples.npy",
        {"format.npy": saved(FORM), "key.npy": saved(np.array("{}"))},
    ),
    "key_bomb.npz": lambda path, canary: bomb(
        path,
        claims("()", f"'<U{GIBI // 4}'"),
        GIBI,
        "key.npy",
        {"format.npy": saved(FORM), "samples.npy": saved(np.zeros((2, 9)))},
    ),
    "format_bomb.npz": lambda path, canary: bomb(
        path, claims("()", f"'<U{GIBI // 4}'"), GIBI, "format.npy", {}
    ),
    "other_packing.npz": lambda path, canary: zipped(
        path, {"samples.npy": saved(np.zeros((2, 9)))}, zipfile.ZIP_LZMA
    ),
    "ways_out.npz": lambda path, canary: zipped(
        path, {f"../{canary.name}/samples.npy": b"", f"{canary}.npy": b"", "../x.npy": b""}
    ),
    "sparse.npz": lambda path, canary: sparse(path, b"PK\3\4"),
}


# Text ----------------------------------------------------------------------------------------


def many_channels(path: Path, canary: Path) -> None:
    """A header that is whole, with channels that nobody has compared in pairs."""
    rows = [{"name": str(i), "kind": "SG", "finger": "", "segment": ""} for i in range(50_000)]
    facts = {"format": str(FORM), "dtype": "float64", "shape": [len(rows), 1], "channels": rows}
    facts |= dict.fromkeys(("sample_rate_hz", "units", "material"), 1)
    facts |= dict.fromkeys(("speeds_mm_s", "onsets_s", "annotated_onsets_s", "sliding_s"), ())
    facts |= {"non_slip_s": [], "slip_s": [], "provenance": {}, "key": {}}
    path.write_text(f"# {FORM} {json.dumps(facts)}\ntime_s,a\n0,1\n")


TEXT: dict[str, Trap] = {
    "sparse.csv": lambda path, canary: sparse(path),
    "sparse_rows.csv": lambda path, canary: sparse(path, b"t,a\n" + b"0,1\n" * 99),
    "sparse_head.csv": lambda path, canary: sparse(path, b"# tactslip_torch recording 1 {"),
    "sparse_utf16.txt": lambda path, canary: sparse(path, "t\ta\n0\t1\n".encode("utf-16")),
    "claims.csv": lambda path, canary: path.write_text(
        '# tactslip_torch recording 1 {"format": "tactslip_torch recording 1", "dtype": "float64",'
        f' "shape": [24, {2**50}]}}\ntime_s,a\n0,1\n'
    ),
    "many_channels.csv": many_channels,
    "deep.csv": lambda path, canary: path.write_text(
        "# tactslip_torch recording 1 {" + '"a":[' * 200_000 + "\ntime_s,a\n0,1\n"
    ),
    "digits.csv": lambda path, canary: path.write_text(
        '# tactslip_torch recording 1 {"format": "tactslip_torch recording 1", "shape": '
        "[" + "9" * 100_000 + ", 1]}\ntime_s,a\n0,1\n"
    ),
    "one_line.txt": lambda path, canary: path.write_bytes(b"0 " * 2**21),
    "long_cell.csv": lambda path, canary: path.write_bytes(b'0,"' + b"9" * 900_000 + b'"\n'),
    "many_columns.csv": lambda path, canary: path.write_bytes(b"0," * 400_000 + b"0\n1,2\n"),
    "many_names.csv": lambda path, canary: path.write_bytes(b"a," * 300_000 + b"a\n0,1\n"),
    "formula.csv": lambda path, canary: path.write_text(f"t,a\n0,=mkdir('{canary}')\n"),
    "pickle.csv": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary), 0)),
    "pickle.txt": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
}


# Arrays --------------------------------------------------------------------------------------


def hdf5(build: Callable[[object, Path], None]) -> Trap:
    def write(path: Path, canary: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            build(file, canary)

    return write


def elsewhere(canary: Path) -> Path:
    """A file that is none of its: numbers that must not be read."""
    import h5py

    other = canary.with_name("other.h5")
    with h5py.File(other, "w") as file:
        file["samples"] = np.ones((3, 99))
    return other


def zlib_of_zeros(num_bytes: int) -> bytes:
    return b"\x78\xda" + zeros(b"", num_bytes)[0] + bytes(4)


def external_link(file, canary):
    import h5py

    file["samples"] = h5py.ExternalLink(str(elsewhere(canary)), "/samples")


def virtual(file, canary):
    import h5py

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


def huge_words(file, canary):
    file["volts"] = np.ones((3, 99))
    file.create_dataset("channel_name", (2**33,), "S100", chunks=(2**10,))


def opaque(file, canary):
    file.attrs["header"] = np.void(pickle.dumps(Runs(canary)))
    file["samples"] = np.void(pickle.dumps(Runs(canary)))


def circle(file, canary):
    file["a/b"] = file["/"]
    file["a/c"] = file["a"]


HDF5: dict[str, Trap] = {
    "external_link.h5": hdf5(external_link),
    "virtual.h5": hdf5(virtual),
    "external_storage.h5": hdf5(external_storage),
    "huge.h5": hdf5(huge),
    "huge_chunk.h5": hdf5(huge_chunk),
    "opaque.h5": hdf5(opaque),
    "circle.h5": hdf5(circle),
    "sparse.h5": lambda path, canary: sparse(path, b"\x89HDF\r\n\x1a\n"),
    "pickle.h5": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
}


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def mat5(content: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + content


def matrix(kind: int, rows: int, columns: int, data: bytes) -> bytes:
    flags = element(6, struct.pack("<II", kind, 0))
    return flags + element(5, struct.pack("<ii", rows, columns)) + element(1, b"samples") + data


def mat_bomb(path: Path, canary: Path) -> None:
    head = struct.pack("<II", 14, GIBI) + matrix(6, 8, GIBI // 64, struct.pack("<II", 9, GIBI))
    pack = zlib.compressobj(9)
    packed = pack.compress(head) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(bytes(2**20)) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(bytes(2**20)) + pack.flush(zlib.Z_FULL_FLUSH)
    packed += again * 1024 + pack.flush()
    path.write_bytes(mat5(struct.pack("<II", 15, len(packed)) + packed))


def mat_objects(path: Path, canary: Path) -> None:
    held = pickle.dumps(Runs(canary))
    path.write_bytes(mat5(element(14, matrix(17, 1, len(held), element(2, held)))))


def mat_nested(path: Path, canary: Path) -> None:
    cell = element(14, matrix(1, 1, 1, b""))
    for _ in range(2000):
        cell = element(14, matrix(1, 1, 1, cell))
    path.write_bytes(mat5(cell))


MAT: dict[str, Trap] = {
    "bomb.mat": mat_bomb,
    "objects.mat": mat_objects,
    "nested.mat": mat_nested,
    "huge.mat": lambda path, canary: path.write_bytes(
        mat5(element(14, matrix(6, 2**31 - 1, 2**31 - 1, struct.pack("<II", 9, 2**32 - 8))))
    ),
    "function.mat": lambda path, canary: path.write_bytes(mat5(element(14, matrix(16, 1, 1, b"")))),
    "sparse.mat": lambda path, canary: sparse(path, mat5(b"")),
    "pickle.mat": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
}


# Tables and messages -------------------------------------------------------------------------


def parquet_objects(path: Path, canary: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    held = pa.array([pickle.dumps(Runs(canary))] * 9, pa.binary())
    pq.write_table(pa.table({"time_s": np.arange(9.0), "a": held}), path)


def parquet_zeros(path: Path, canary: Path) -> None:
    """Runs of one value, which cost a few bytes however long they are."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    nulls = pa.nulls(2**22, pa.float64())
    columns = {f"c{i}": nulls for i in range(48)}
    pq.write_table(pa.table(columns), path, compression="zstd", row_group_size=2**22)


PARQUET: dict[str, Trap] = {
    "objects.parquet": parquet_objects,
    "nulls.parquet": parquet_zeros,
    "sparse.parquet": lambda path, canary: sparse(path, b"PAR1"),
    "pickle.parquet": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
}


def mcap_record(kind: int, content: bytes, size: int | None = None) -> bytes:
    return struct.pack("<BQ", kind, len(content) if size is None else size) + content


MCAP_START = b"\x89MCAP0\r\n" + mcap_record(1, bytes(8))


def mcap_chunk(size: int, packing: bytes, packed: bytes) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(packing)) + packing
    return MCAP_START + mcap_record(6, head + struct.pack("<Q", len(packed)) + packed)


def mcap_bomb(path: Path, canary: Path) -> None:
    import zstandard

    path.write_bytes(mcap_chunk(GIBI, b"zstd", zstandard.compress(bytes(GIBI // 4)) * 4))


MCAP: dict[str, Trap] = {
    "bomb.mcap": mcap_bomb,
    "claims.mcap": lambda path, canary: path.write_bytes(mcap_chunk(2**62, b"", b"")),
    "record.mcap": lambda path, canary: path.write_bytes(MCAP_START + mcap_record(5, b"", 2**62)),
    "sparse.mcap": lambda path, canary: sparse(path, MCAP_START),
    "pickle.mcap": lambda path, canary: path.write_bytes(pickle.dumps(Runs(canary))),
}


def bag(text: str, files: Callable[[Path, Path], None] | None = None) -> Trap:
    def write(path: Path, canary: Path) -> None:
        path.mkdir()
        outside = elsewhere(canary)
        (path / "metadata.yaml").write_text(
            text.replace("CANARY", str(canary)).replace("OUTSIDE", str(outside))
        )
        if files is not None:
            files(path, canary)

    return write


def bag_text(file: str, more: str = "") -> str:
    return (
        "rosbag2_bagfile_information:\n  version: 8\n  storage_identifier: sqlite3\n"
        f"  relative_file_paths: [{file}]\n{more}"
    )


def link_out(path: Path, canary: Path) -> None:
    (path / "a.db3").symlink_to(elsewhere(canary))


ROSBAG2: dict[str, Trap] = {
    "absolute": bag(bag_text("OUTSIDE")),
    "parent": bag(bag_text("../other.h5")),
    "link": bag(bag_text("a.db3"), link_out),
    "object": bag("a: !!python/object/apply:os.mkdir [CANARY]\n"),
    "laughs": bag(
        "a0: &a0 [x, x]\n"
        + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
    ),
    "nested": bag("[" * 100_000),
    "sparse": bag(bag_text("a.db3"), lambda path, canary: sparse(path / "a.db3")),
    "sparse_sqlite": bag(
        bag_text("a.db3"), lambda path, canary: sparse(path / "a.db3", b"SQLite format 3\0")
    ),
    "sparse_metadata": bag("", lambda path, canary: sparse(path / "metadata.yaml")),
}

TRAPS: dict[str, dict[str, Trap]] = {
    "npz": NPZ,
    "text": TEXT,
    "hdf5": HDF5,
    "mat": MAT,
    "parquet": PARQUET,
    "mcap": MCAP,
    "rosbag2": ROSBAG2,
}


# Manifests -----------------------------------------------------------------------------------

_HEAD = b"file,material\n"
MANIFEST_TRAPS: dict[str, tuple[str, bytes]] = {
    **{
        file: ("manifest.csv", _HEAD + f"{file},M1\n".encode())
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
    "twice": ("manifest.csv", _HEAD + b"a.csv,M1\na.csv,M1\n" * 2000),
    "long line": ("manifest.csv", _HEAD + b"a" * 2**22 + b",M1\n"),
    "open quote": ("manifest.csv", _HEAD + b'"a.csv,M1\n' * 50_000),
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
    "other ending": ("manifest.txt", _HEAD + b"a.csv,M1\n"),
}
