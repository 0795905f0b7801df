"""Folders that come with the package: configuration and host programs."""

from __future__ import annotations

import shutil
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
_SHARED = {"web": ("web", "node"), "native": ("native", "c")}
"""Hosts of several folders: the page shares the reader and the stream of ``node``, the C library
the command line of ``c``."""
_LEFT_OUT = shutil.ignore_patterns("node_modules", "__pycache__", "build", "*.o")


def packaged_folder(name: str, hint: str) -> Path:
    """A folder inside the package (wheel) or beside it (checkout); ``hint`` is a file in it."""
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if (folder / hint).is_file():
            return folder
    raise FileNotFoundError(f"no {name} folder with {hint} in or beside {_PACKAGE}; reinstall")


def hosts_dir() -> Path:
    """The folder ``export``."""
    return packaged_folder("export", "README.md")


def host_names() -> list[str]:
    """The hosts there are."""
    return sorted(path.name for path in hosts_dir().iterdir() if (path / "README.md").is_file())


def copy_host(name: str, folder: Path) -> Path:
    """Copy a host program, with what it shares with others, into a folder; returns its own.

    Raises:
        ValueError: if there is no such host.
        FileExistsError: if there is something in its place.
    """
    if name not in host_names():
        raise ValueError(f"no host {name!r}; there are {', '.join(host_names())}")
    parts = _SHARED.get(name, (name,))
    for part in parts:
        if (folder / part).exists():
            raise FileExistsError(f"{folder / part} is there already; give another folder")
    for part in parts:
        shutil.copytree(hosts_dir() / part, folder / part, ignore=_LEFT_OUT)
    if name == "native":
        sources = folder / name / "src"
        sources.mkdir()
        for path in (_PACKAGE / "native").iterdir():
            if path.suffix in (".cpp", ".h"):
                shutil.copy(path, sources)
    return folder / name
