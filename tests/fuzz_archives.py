"""Harmful ``.npy`` and ``.npz`` files: bombs, claims, objects."""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
from fuzz_harm import FORM, GIBI, Runs, Trap, sparse, zeros


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


def bomb(path: Path, head: bytes, num_bytes: int, name: str, beside: dict[str, bytes]) -> None:
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


def object_array(canary: Path) -> bytes:
    held = io.BytesIO()
    np.save(held, np.array([[Runs(canary)]], dtype=object), allow_pickle=True)
    return held.getvalue()


def saved(array: np.ndarray) -> bytes:
    held = io.BytesIO()
    np.save(held, array)
    return held.getvalue()


BOMB = 3 * GIBI // 8  # so that a process allowed half a GiB would read it all


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
        | {"format.npy": saved(np.array(FORM))},
    ),
    "format_object.npz": lambda path, canary: zipped(path, {"format.npy": object_array(canary)}),
    "huge.npz": lambda path, canary: zipped(path, {"samples.npy": claims(f"({2**50}, 24)")}),
    "our_huge.npz": lambda path, canary: zipped(
        path,
        dict.fromkeys(("samples.npy", "key.npy"), claims(f"({2**50}, 24)"))
        | {"format.npy": saved(np.array(FORM))},
    ),
    "bomb.npz": lambda path, canary: bomb(
        path, claims(f"(8, {GIBI // 16})"), 4 * GIBI - 2**21, "samples.npy", {}
    ),
    "our_bomb.npz": lambda path, canary: bomb(
        path,
        claims(f"(8, {BOMB // 64})"),
        BOMB,
        "samples.npy",
        {"format.npy": saved(np.array(FORM)), "key.npy": saved(np.array("{}"))},
    ),
    "key_bomb.npz": lambda path, canary: bomb(
        path,
        claims("()", f"'<U{BOMB // 4}'"),
        BOMB,
        "key.npy",
        {"format.npy": saved(np.array(FORM)), "samples.npy": saved(np.zeros((2, 9)))},
    ),
    "format_bomb.npz": lambda path, canary: bomb(
        path, claims("()", f"'<U{BOMB // 4}'"), BOMB, "format.npy", {}
    ),
    "other_packing.npz": lambda path, canary: zipped(
        path, {"samples.npy": saved(np.zeros((2, 9)))}, zipfile.ZIP_LZMA
    ),
    "ways_out.npz": lambda path, canary: zipped(
        path, {f"../{canary.name}/samples.npy": b"", f"{canary}.npy": b"", "../x.npy": b""}
    ),
    "sparse.npz": lambda path, canary: sparse(path, b"PK\3\4"),
}
