"""Compile the native engine: at install, and at the first use of a checkout.

It imports nothing of the package, so that the build hook can load it by its path. A library is
named after a digest of its sources and of this file, so that it is never older than they are.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SWITCH = "TACTSLIP_NATIVE"
"""Environment variable; 0: the engine is neither built nor used."""
REMEDY = (
    f"install g++ or clang++, name a compiler in CXX, or set {SWITCH}=0 to do without it "
    "(features and simulation are then several times slower)"
)
_HERE = Path(__file__).parent
_PARTS = ("engine", "scoring", "bristles", "onset")  # compiled for each instruction set
_ONCE = ("dispatch", "stream")  # and these for the oldest
_HEADERS = ("engine.h", "vectors.h", "file.h", "tactslip.h")
_SOURCES = (*_HEADERS, *(f"{part}.cpp" for part in (*_PARTS, *_ONCE)))
_FLAGS = [
    *(
        "-O3",
        "-funroll-loops",
        "-std=c++17",
        "-fPIC",
        "-fno-exceptions",
        "-fno-rtti",
        "-fno-math-errno",
    ),
    *("-fno-trapping-math", "-fno-strict-aliasing", "-ffp-contract=off", "-fvisibility=hidden"),
    "-Wno-psabi",
]
# never -ffast-math: at link time it makes the whole process flush denormals to zero


def is_off() -> bool:
    """Whether the environment says to do without the engine."""
    return os.environ.get(SWITCH) == "0"


def library_name() -> str:
    """File name of the library that belongs to these sources."""
    digest = hashlib.sha256()
    for name in (*_SOURCES, Path(__file__).name):
        digest.update((_HERE / name).read_bytes())
    return f"library.{digest.hexdigest()[:16]}{'.dll' if os.name == 'nt' else '.so'}"


def find_compiler() -> list[str] | None:
    """The first that compiles a line: ``$CXX``, the system's, ziglang's; None if none does."""
    chosen = os.environ.get("CXX")
    commands = [shlex.split(chosen)] if chosen else []
    commands += [[path] for name in ("c++", "g++", "clang++") if (path := shutil.which(name))]
    if importlib.util.find_spec("ziglang"):
        commands.append([sys.executable, "-m", "ziglang", "c++"])
    return next((command for command in commands if _works(command)), None)


def build_library(folder: Path) -> Path:
    """Compile and link; the file appears in the folder when it is whole.

    Raises:
        OSError: if there is no compiler, it fails, or the folder cannot be written to.
    """
    compiler = find_compiler()
    if compiler is None:
        raise OSError(f"no C++ compiler that works was found; {REMEDY}")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as name:
        there = Path(name)
        jobs = [([f"{part}.cpp", "-O2"], f"{part}.o") for part in _ONCE]
        for level in (2, 3, 4) if _is_x86() else (1,):
            flags = [f"-DLEVEL=v{level}", *_march(compiler, level)]
            for part in _PARTS:
                own = [*flags, "-ffp-contract=fast"] if part == "engine" else flags
                jobs.append(([f"{part}.cpp", *own], f"{part}{level}.o"))
        compile_ = [*compiler, *_FLAGS, *_target(compiler), "-I", str(_HERE), "-c"]
        _run([[*compile_, str(_HERE / source), *rest, "-o", str(there / to)]
              for (source, *rest), to in jobs])  # fmt: skip
        library = there / library_name()
        objects = [str(there / to) for _, to in jobs]
        _run([[*compiler, *_target(compiler), "-shared", "-s", *objects, "-o", str(library)]])
        for old in folder.glob("library.*"):
            old.unlink(missing_ok=True)
        return Path(shutil.move(library, folder / library.name))


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def _march(compiler: list[str], level: int) -> list[str]:
    if level == 1:
        return []
    flag = "-mcpu=x86_64_v" if "ziglang" in compiler else "-march=x86-64-v"
    return [f"{flag}{level}", *(["-mprefer-vector-width=512"] if level == 4 else [])]


def _target(compiler: list[str]) -> list[str]:
    """What ziglang needs beside: no C++ runtime, and a C library that is old enough anywhere."""
    if "ziglang" not in compiler:
        return []
    old = ["-target", f"{platform.machine()}-linux-gnu.2.17"] if sys.platform == "linux" else []
    return ["-nostdlib++", *old]


def _works(compiler: list[str]) -> bool:
    with tempfile.TemporaryDirectory() as name:
        source = Path(name, "line.cpp")
        source.write_text("#include <stdint.h>\nint64_t one() { return 1; }\n")
        try:
            flags = [*_FLAGS, *_march(compiler, 4 if _is_x86() else 1), *_target(compiler)]
            _run([[*compiler, *flags, "-c", str(source), "-o", str(Path(name, "line.o"))]])
        except OSError:
            return False
        return True


def _run(commands: list[list[str]]) -> None:
    """All at once.

    Raises:
        OSError: if one cannot be run or fails, with the first line that says error.
    """
    running = [
        subprocess.Popen(c, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for c in commands
    ]
    for process, said in [(process, process.communicate()[0]) for process in running]:
        if process.returncode:
            lines = [line for line in said.splitlines() if "error" in line] or said.splitlines()
            what = lines[0].strip() if lines else f"status {process.returncode}"
            raise OSError(f"{commands[0][0]} failed: {what}; {REMEDY}")
