"""Where the native engine comes from: built, found again, and done without in words."""

import os
import stat
import subprocess
import sys

import pytest
import torch

from tactslip_torch import FeaturePool, HandLayout, native
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.native import build


@pytest.fixture
def anew(monkeypatch):
    """The library is looked for again, here and afterwards."""
    native._loaded.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    native._loaded.cache_clear()


def script(path, text):
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_switched_off_torch_carries_on_and_says_so(anew, caplog):
    anew.setenv(build.SWITCH, "0")
    pool = FeaturePool(HandLayout.paper24())
    extractor = FeatureExtractor(pool, [7])
    assert extractor.backend == "torch"
    assert extractor(torch.ones(2, 24, 100)).shape == (2, 1)
    assert caplog.messages == [
        "features and simulation are made by torch, which is slower: "
        "the native engine is switched off by TACTSLIP_NATIVE=0"
    ]
    with pytest.raises(ValueError, match=r'backend "native" cannot be used: .* TACTSLIP_NATIVE=0'):
        FeatureExtractor(pool, [7], "native")


def test_without_a_compiler_the_remedy_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setitem(sys.modules, "ziglang", None)
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(OSError, match=r"no C\+\+ compiler .*; install g\+\+ .* TACTSLIP_NATIVE=0"):
        build.build_library(tmp_path)


def test_a_compiler_that_fails_is_passed_over_or_quoted(monkeypatch, tmp_path):
    broken = script(tmp_path / "broken", "exit 1")
    monkeypatch.setenv("CXX", str(broken))
    found = build.find_compiler()
    assert found is None or found[0] != str(broken)
    small = script(tmp_path / "small", 'case "$*" in *line.cpp*) exit 0;; esac\n'
                   'echo "engine.cpp:1: error: out of ideas" >&2; exit 1')  # fmt: skip
    monkeypatch.setenv("CXX", str(small))
    with pytest.raises(OSError, match=r"error: out of ideas; .* set TACTSLIP_NATIVE=0"):
        build.build_library(tmp_path / "to")
    assert not list((tmp_path / "to").glob("library.*"))


@pytest.mark.slow
@pytest.mark.skipif(build.find_compiler() is None, reason="no C++ compiler")
def test_a_first_use_builds_into_the_users_cache_once(tmp_path):
    """Where the package's folder has no library and may not be written to."""
    code = (
        "import logging, sys; logging.basicConfig(); from pathlib import Path\n"
        "from tactslip_torch import native\n"
        "native.__file__ = sys.argv[1]\n"
        "print(native.why_not() or native.instruction_set())"
    )
    taken = tmp_path / "file"
    taken.touch()
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), build.SWITCH: ""}
    said = []
    for _ in range(2):
        command = [sys.executable, "-c", code, str(taken / "__init__.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip().startswith("v"), done.stdout
        said.append(done.stderr)
    assert "building the native engine" in said[0]
    assert "building" not in said[1]
    kept = list((tmp_path / "tactslip_torch" / "native").iterdir())
    assert [path.name for path in kept] == [build.library_name()]
