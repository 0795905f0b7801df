"""What a file holds, as one number that stands for it."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of all files of a folder with their names.

    A file is read once by a process, as long as its size and the time of its last change stay.

    Raises:
        FileNotFoundError: if there is none.
    """
    if not path.is_dir():
        return _of_file(path)
    whole = hashlib.sha256()
    for inner in sorted(inner for inner in path.rglob("*") if inner.is_file()):
        whole.update(f"{inner.relative_to(path).as_posix()}\0{_of_file(inner)}\n".encode())
    return whole.hexdigest()


def _of_file(path: Path) -> str:
    found = path.stat()
    return _read(str(path.absolute()), found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=100_000)
def _read(path: str, changed_ns: int, size: int) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
