"""Harmful text, Parquet, MCAP and rosbag2 files: holes, bombs, claims, ways out."""

from __future__ import annotations

import json
import pickle
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_harm import FORM, GIBI, Runs, Trap, elsewhere, sparse


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
