"""Harmful HDF5 and MAT files: links out, bombs, claims, objects."""

from __future__ import annotations

import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_harm import GIBI, Runs, Trap, elsewhere, sparse, zeros


def hdf5(build: Callable[[object, Path], None]) -> Trap:
    def write(path: Path, canary: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            build(file, canary)

    return write


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
