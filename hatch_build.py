"""Build hooks of hatchling: the native engine in the wheel, and the repository's address in README.

``TACTSLIP_WHEEL`` asks for a wheel to publish, ``x86_64`` or ``aarch64``: the engine is compiled by
the ``ziglang`` wheel for Linux with glibc 2.17 or newer. Without it the engine is that of this
machine, and ``TACTSLIP_NATIVE=0`` makes the wheel without one, for every other platform.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import sysconfig
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

PAPER = "https://arxiv.org/abs/2603.18370"
_LINK = re.compile(r"(!?)(\[[^\]]*\]\()(?!\w+:|#)([^)\s]+)")


class Readme(MetadataHookInterface):
    """README as the package index shows it: links lead to the repository, if it has an address."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set ``readme`` and ``urls``."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        project = tomllib.loads(Path(self.root, "pyproject.toml").read_text(encoding="utf-8"))
        address = project["tool"]["tactslip_torch"]["repository"].rstrip("/")
        metadata["readme"] = {"content-type": "text/markdown", "text": absolute(text, address)}
        metadata["urls"] = {"Paper": PAPER} | ({"Repository": address} if address else {})


def absolute(text: str, address: str) -> str:
    """Relative links of a Markdown text as those into a repository; as they are without address."""
    if not address:
        return text
    return _LINK.sub(
        lambda m: f"{m[1]}{m[2]}{address}/{'raw' if m[1] else 'blob'}/HEAD/{m[3]}", text
    )


class NativeEngine(BuildHookInterface):
    """A wheel for one platform; pure for an editable install, or if ``TACTSLIP_NATIVE=0``."""

    def dependencies(self) -> list[str]:
        """A compiler from the package index, where it is wanted or the system has none."""
        build = self._build()
        needs_zig = "TACTSLIP_WHEEL" in os.environ or not (build.is_off() or build.find_compiler())
        return ["ziglang"] if needs_zig else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and tag the wheel."""
        build = self._build()
        if version == "editable" or build.is_off():
            return
        platform = os.environ.get("_PYTHON_HOST_PLATFORM", sysconfig.get_platform())
        if machine := os.environ.get("TACTSLIP_WHEEL"):
            os.environ["CXX"] = f"{sys.executable} -m ziglang c++"
            build.platform = SimpleNamespace(machine=lambda: machine)  # it compiles for this one
            platform = f"manylinux_2_17_{machine}.manylinux2014_{machine}"
        library: Path = build.build_library(Path(self.root, "tactslip_torch", "native"))
        build_data["artifacts"].append(library.relative_to(self.root).as_posix())
        build_data["pure_python"] = False
        tags = [re.sub(r"[-.]", "_", tag) for tag in platform.split(".many")]
        build_data["tag"] = f"py3-none-{'.many'.join(tags)}"

    def _build(self) -> ModuleType:
        path = Path(self.root, "tactslip_torch", "native", "build.py")
        spec = importlib.util.spec_from_file_location("tactslip_build", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
