"""Files that are damaged on purpose, given to a process that may die of them, and counted."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import zlib
from pathlib import Path

from hypothesis import strategies as st

WORKER = Path(__file__).with_name("fuzz_worker.py")
MOST_BYTES = 512 * 2**20
"""Of address space beyond what the libraries themselves take."""
MOST_TAKEN = 200 * 2**20
"""Of memory really touched; less, so that what fails for want of the other is not all there is."""
PATIENCE_S = 120  # a file that takes longer hangs
LONGEST = 1000  # characters of a line for people, beside the path
_tried: dict[str, set[int]] = {}


# How many ------------------------------------------------------------------------------------


def count(form: str, content: dict[str, bytes]) -> None:
    """One file that was tried; the same bytes count once."""
    _tried.setdefault(form, set()).add(zlib.crc32(repr(sorted(content.items())).encode()))


def told() -> dict[str, list[int]]:
    """What ``hear`` takes in another process."""
    return {form: sorted(sums) for form, sums in _tried.items()}


def hear(others: dict[str, list[int]]) -> None:
    for form, sums in others.items():
        _tried.setdefault(form, set()).update(sums)


def summary() -> str:
    """How many files there were, and of which formats; "" if none."""
    each = ", ".join(f"{form} {len(sums)}" for form, sums in sorted(_tried.items()))
    return f"fuzzed files: {sum(map(len, _tried.values()))} ({each})" if _tried else ""


# The process ---------------------------------------------------------------------------------


class Prober:
    """A process that reads files; if one ends it, another takes its place."""

    def __init__(self, folder: Path, seeds: list[tuple[str, Path]]) -> None:
        self.seeds, self.process, self.before = seeds, None, 0
        self.errors = (folder / "stderr").open("w+b")

    def start(self) -> None:
        """Every library is loaded by a whole file before memory is limited."""
        self.process = subprocess.Popen(
            [sys.executable, WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            env=os.environ
            | {"OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
            | {"ARROW_DEFAULT_MEMORY_POOL": "system", "OPENBLAS_NUM_THREADS": "1"},
        )
        for form, path in self.seeds:
            for what, (kind, said) in self.ask(form, path).items():
                assert kind == "read" or what != "open", said
        self.before = self._send({"allow": MOST_BYTES})["peak"]

    def ask(self, form: str, path: Path) -> dict[str, tuple[str, str]]:
        """What came of a file, by what was tried."""
        if self.process is None:
            self.start()
        answer = self._send({"format": form, "path": str(path)})
        taken = answer.pop("peak") - self.before
        if self.before and taken > MOST_TAKEN:
            self.end()
            raise AssertionError(f"{path} took {taken >> 20} MiB")
        return {what: (kind, said) for what, (kind, said) in answer.items()}

    def said(self) -> str:
        """What libraries wrote beside the answers."""
        self.errors.flush()
        return Path(self.errors.name).read_text(errors="replace")

    def stop(self) -> None:
        self.errors.close()
        if self.process is not None:
            self.end()

    def end(self) -> None:
        """The next file gets another process."""
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait()
        self.process, self.before = None, 0

    def _send(self, request: dict[str, object]) -> dict[str, object]:
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


def assert_read_or_refused(prober: Prober, form: str, path: Path) -> dict[str, tuple[str, str]]:
    """The answer for a file; refused is one line that names it."""
    answer = prober.ask(form, path)
    for what, (kind, said) in answer.items():
        assert kind in ("read", "refused"), f"{what} of {path}: {said}"
        if kind == "refused":
            assert "\n" not in said, f"{what} of {path}: {said}"
            assert path.name in said, f"{what} of {path}: {said}"
            assert len(said) < LONGEST + len(str(path)), f"{what} of {path}: {said}"
    return answer


def assert_refused(prober: Prober, form: str, path: Path) -> None:
    """Nothing in such a file is taken for a recording; a key may stand before what is wrong."""
    for what, (kind, said) in assert_read_or_refused(prober, form, path).items():
        assert kind == "refused" or what == "key", f"{what} of {path}: {kind} {said}"


# Files ---------------------------------------------------------------------------------------


def content_of(path: Path) -> dict[str, bytes]:
    """A file, or the files of a folder, by name."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file.is_file()}


def write(path: Path, content: dict[str, bytes]) -> Path:
    """What ``content_of`` gave, somewhere else."""
    for name, part in content.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(part)
    return path


# Damage --------------------------------------------------------------------------------------

_NUMBERS = [b"\0", b"\xff", b"\x7f", b"\x80", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"]
_NUMBERS += [b"\0\0\0\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0\0\0\0\1\0\0\0", b"\1\0\0\0"]
_WORDS = [b"nan", b"NaN", b"-inf", b"1e999", b"", b"0x1p3", b"1_0", b"N/A", b'"', b"#", b",", b"\t"]
_WORDS += [b"\r", b"\n", b"\r\n", b"\0", b"\xb0", b"\xef\xbb\xbf", b"\xff\xfe", "\u0663".encode()]
_WORDS += [b"9" * 400, b"{", b"}", b"[", b"../", b"%n", b"!!python/object:os.system", b"&a", b"*a"]


@st.composite
def damage(draw: st.DrawFn, content: bytes, others: list[bytes]) -> bytes:
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
