"""What harmful files are made of: code that tells when it runs, holes, zeros without end."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

FORM = "tactslip_torch recording 1"
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


def zeros(head: bytes, num_bytes: int) -> tuple[bytes, int]:
    """A deflate stream of a head and zeros, and its length; made without making the zeros."""
    block = bytes(2**20)
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = pack.compress(head) + pack.flush(zlib.Z_FULL_FLUSH)
    again = pack.compress(block) + pack.flush(zlib.Z_FULL_FLUSH)  # it may be repeated: it is full
    times = num_bytes // len(block)
    return start + again * times + pack.flush(), len(head) + times * len(block)


def elsewhere(canary: Path) -> Path:
    """A file that is none of its: numbers that must not be read."""
    import h5py

    other = canary.with_name("other.h5")
    with h5py.File(other, "w") as file:
        file["samples"] = np.ones((3, 99))
    return other
