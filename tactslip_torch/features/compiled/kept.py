"""Where compiled code is kept on disk: in a folder for each state of the sources and machine.

numba looks at the file of a cached function alone, and would not notice a change in another file
that it calls into; so the folder carries a digest of all of them. Where numba may not write to the
folder it is told to use, it silently takes another, without digest; so one is found beforehand.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
from functools import lru_cache
from pathlib import Path

import numba
from llvmlite import binding  # type: ignore[import-untyped]

_STEM = "tactslip_torch-"
_OLD_S = 30 * 24 * 3600.0


@lru_cache(maxsize=4)
def folder(chosen: str) -> Path | None:
    """Where to keep compiled code; folders of other digests go once unused for 30 days.

    Args:
        chosen: ``NUMBA_CACHE_DIR``, tried first if not empty; else beside the sources. Next comes
            the user's cache.

    Returns:
        The folder, made and tried, or None where none may be written to.
    """
    here = Path(__file__).parent
    sources = sorted(here.glob("*.py"))
    if not sources:  # in an archive: what cannot be read cannot be told apart
        return None
    name = _STEM + _digest(sources)
    for root in (Path(chosen) if chosen else here / "__pycache__", *_user_cache()):
        if _is_writable(root / name):
            _remove_old(root, name)
            return root / name
    return None


def _digest(sources: list[Path]) -> str:
    machine = (numba.__version__, sys.implementation.cache_tag, binding.get_host_cpu_name())
    digest = hashlib.sha256("\n".join(map(str, machine)).encode())
    digest.update(binding.get_host_cpu_features().flatten().encode())
    for source in sources:
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _user_cache() -> list[Path]:
    """The user's cache, if there is a home; no shared folder, as code in it is run."""
    chosen = os.environ.get("XDG_CACHE_HOME")
    try:
        base = Path(chosen) if chosen else Path.home() / ".cache"
    except RuntimeError:
        return []
    return [base / "tactslip_torch" / "numba"]


def _is_writable(path: Path) -> bool:
    """Make the folder and try it; a name that comes and goes also dates it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path):
            return True
    except OSError:
        return False


def _remove_old(root: Path, name: str) -> None:
    for other in root.glob(f"{_STEM}*"):
        try:
            is_old = time.time() - other.stat().st_mtime > _OLD_S
        except OSError:  # another process was faster
            continue
        if other.name != name and is_old:
            shutil.rmtree(other, ignore_errors=True)


def is_noted(name: str) -> bool:
    """Whether ``note`` was called with that name, in this state of sources and machine."""
    path = folder(numba.config.CACHE_DIR)
    return path is not None and (path / name).exists()


def note(name: str) -> None:
    """Remember a name beside the compiled code; nothing happens where none can be kept."""
    path = folder(numba.config.CACHE_DIR)
    try:
        if path is not None:
            (path / name).touch()
    except OSError:
        return
