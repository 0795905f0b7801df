"""Build hook of hatchling: compiles the native engine (``native/``) into the wheel."""

from __future__ import annotations

import importlib.util
import os
import sysconfig
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class NativeEngine(BuildHookInterface):
    """A wheel for this platform; pure for an editable install, or if ``TACTSLIP_NATIVE=0``."""

    def dependencies(self) -> list[str]:
        """A compiler from the package index, where the system has none that works."""
        build = self._build()
        return [] if build.is_off() or build.find_compiler() else ["ziglang"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and tag the wheel."""
        build = self._build()
        if version == "editable" or build.is_off():
            return
        library: Path = build.build_library(Path(self.root, "tactslip_torch", "native"))
        build_data["artifacts"].append(library.relative_to(self.root).as_posix())
        build_data["pure_python"] = False
        platform = os.environ.get("_PYTHON_HOST_PLATFORM", sysconfig.get_platform())
        build_data["tag"] = f"py3-none-{platform.replace('-', '_').replace('.', '_')}"

    def _build(self) -> ModuleType:
        path = Path(self.root, "tactslip_torch", "native", "build.py")
        spec = importlib.util.spec_from_file_location("tactslip_build", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
