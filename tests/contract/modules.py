"""Prints which modules of the package a short training executes, and which one push of a stream.

    PYTHONPATH=tests python -m contract.modules

A module is executed if code of one of its functions runs; importing it is not enough.
"""

from __future__ import annotations

import runpy
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from .names import (
    PACKAGE,
    REPLACED_NEXT,
    SlipDetector,
    StreamingDetector,
    sample_recording,
    settings,
)
from .running import ROOT, SERVER

FOLDER = ROOT / PACKAGE


def executed_by(action: Callable[[], Any]) -> list[str]:
    """Paths in the package of modules whose functions run meanwhile, outside of imports."""
    found: set[str] = set()

    def watch(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        is_new = code.co_filename.startswith(str(FOLDER)) and code.co_filename not in found
        if is_new and code.co_name != "<module>" and not _is_importing(frame):
            found.add(code.co_filename)

    before = sys.gettrace()
    threading.settrace(watch)
    sys.settrace(watch)
    try:
        action()
    finally:
        sys.settrace(before)
        threading.settrace(before)
    return sorted(Path(path).relative_to(FOLDER).as_posix() for path in found)


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module of the package is being imported, from which this is called or not."""
    while frame is not None:
        is_module = frame.f_code.co_name == "<module>"
        if is_module and frame.f_globals["__name__"].startswith(PACKAGE):
            return True
        frame = frame.f_back
    return False


def counted(modules: list[str]) -> list[str]:
    """Without those that another issue replaces."""
    return [name for name in modules if not name.startswith(REPLACED_NEXT)]


def of_training(folder: Path) -> list[str]:
    """Modules that ``train +exp=quick`` executes, in a process of its own; it leaves its run."""
    words = settings(experiment="quick", workers=0, cache=folder / "cache", folder=folder / "run")
    with ProcessPoolExecutor(1, SERVER) as pool:
        return pool.submit(_of_command, [f"{PACKAGE}.train", *words]).result()


def _of_command(arguments: list[str]) -> list[str]:
    sys.argv = arguments
    command = partial(runpy.run_module, arguments[0], run_name="__main__", alter_sys=True)
    return executed_by(command)


def of_push(detector: SlipDetector, samples: np.ndarray) -> list[str]:
    """Modules that one push of a stream ``[T, C]`` executes which makes decisions."""
    stream = StreamingDetector(detector)
    stream.push(samples[:1000])
    decisions = []
    modules = executed_by(lambda: decisions.append(stream.push(samples[1000:1200])))
    assert len(decisions[0].score) > 0
    return modules


def main() -> None:
    """Print both lists."""
    samples = sample_recording().samples.T.numpy()
    with tempfile.TemporaryDirectory() as folder:
        lists = {
            "train +exp=quick": of_training(Path(folder)),
            "one push of a stream": of_push(SlipDetector.pretrained(), samples),
        }
    for title, modules in lists.items():
        print(f"{title}: {len(modules)} modules, {len(counted(modules))} of them counted")
        for module in modules:
            print(f"  {module}" if module in counted(modules) else f"  ({module})")


if __name__ == "__main__":
    main()
