"""Programs that run an exported detector without Python: ``tactslip hosts NAME FOLDER``."""

from __future__ import annotations

import argparse
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from tactslip_torch.commands import packaged_folder

_SHARED = {"web": ("web", "node"), "native": ("native", "c")}
"""Hosts of several folders: the page shares the reader and the stream of ``node``, the C library
the command line of ``c``."""
_LINKS = {"../README.md": "options.md", "../../tactslip_torch/native/tactslip.h": "src/tactslip.h"}
"""Of their pages: where a link of the checkout leads in a copy."""
_LEFT_OUT = shutil.ignore_patterns("node_modules", "__pycache__", "build", "*.o")


def hosts_dir() -> Path:
    """The folder ``export``."""
    return packaged_folder("export", "README.md")


def _host_names() -> list[str]:
    """The hosts there are."""
    return sorted(path.name for path in hosts_dir().iterdir() if (path / "README.md").is_file())


def copy_host(name: str, folder: Path) -> Path:
    """Copy a host program, with what it shares with others, into a folder; returns its own.

    Raises:
        ValueError: if there is no such host.
        FileExistsError: if there is something in its place.
    """
    if name not in _host_names():
        raise ValueError(f"no host {name!r}; there are {', '.join(_host_names())}")
    parts = _SHARED.get(name, (name,))
    for part in parts:
        if (folder / part).exists():
            raise FileExistsError(f"{folder / part} is there already; give another folder")
    for part in parts:
        shutil.copytree(hosts_dir() / part, folder / part, ignore=_LEFT_OUT)
        page = folder / part / "README.md"
        text = page.read_text(encoding="utf-8")
        for link, own in _LINKS.items():
            text = text.replace(f"]({link})", f"]({own})")
        page.write_text(text, encoding="utf-8")
        page.with_name("options.md").write_text(_options(parts), encoding="utf-8")
    if name == "native":
        sources = folder / name / "src"
        sources.mkdir()
        for path in packaged_folder("native", "build.py").iterdir():
            if path.suffix in (".cpp", ".h"):
                shutil.copy(path, sources)
    return folder / name


def _options(parts: Sequence[str]) -> str:
    """The page of all hosts, with links to those that are copied."""

    def linked(link: re.Match[str]) -> str:
        text, part = link.groups()
        return f"[{text}](../{part}/README.md)" if part in parts else str(text)

    text = (hosts_dir() / "README.md").read_text(encoding="utf-8")
    return re.sub(r"\[([^]]*)\]\((\w+)/README\.md\)", linked, text)


def _add_sample(page: Path) -> None:
    """Put the pretrained detector as ``stream.onnx``, and the sample recording, beside the page."""
    from tactslip_torch.deploy.export import export_detector  # of no need for --help
    from tactslip_torch.model.detector import SlipDetector
    from tactslip_torch.pretrained import NAME, RECORDING

    export_detector(SlipDetector.pretrained(NAME), page, graphs=("stream",))
    shutil.copyfile(RECORDING, page / "recording.npz")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="tactslip hosts",
        description="Copy a program that runs an exported detector (model.onnx, stream.onnx).",
        epilog="example: tactslip hosts c slip-in-c",
    )
    parser.add_argument("name", help=f"one of {', '.join(_host_names())}")
    parser.add_argument("folder", type=Path, help="where its folder is put")
    given = parser.parse_args()
    from tactslip_torch.commands.stopping import errors_in_one_line

    with errors_in_one_line():
        copied = copy_host(given.name, given.folder)
        if given.name == "web":
            _add_sample(copied)
        print(f"{copied}\nhow to build and run it: {copied / 'README.md'}")
