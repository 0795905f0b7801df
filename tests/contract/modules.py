"""Prints which modules of the package a short training executes, and which one push of a stream.

    PYTHONPATH=tests python -m contract.modules

A module is executed if code of one of its functions runs; importing it is not enough.
"""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from .names import PACKAGE, REPLACED_NEXT, SlipDetector, StreamingDetector, settings
from .recordings import samples_of
from .running import ROOT, environment

FOLDER = ROOT / PACKAGE


def executed_by(action: Callable[[], Any]) -> list[str]:
    """Paths in the package of modules whose functions run meanwhile, outside of imports."""
    found: set[str] = set()
    importing = threading.local()

    def watch(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event not in ("call", "return") or not code.co_filename.startswith(str(FOLDER)):
            return
        if code.co_name == "<module>":
            if frame.f_globals["__name__"] != "__main__":
                step = 1 if event == "call" else -1
                importing.depth = getattr(importing, "depth", 0) + step
        elif event == "call" and not getattr(importing, "depth", 0):
            found.add(code.co_filename)

    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        action()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return sorted(Path(path).relative_to(FOLDER).as_posix() for path in found)


def counted(modules: list[str]) -> list[str]:
    """Without those that another issue replaces."""
    return [name for name in modules if not name.startswith(REPLACED_NEXT)]


def of_training(folder: Path) -> list[str]:
    """Modules that ``train +exp=quick`` executes, in a process of its own."""
    words = settings(experiment="quick", workers=0, cache=folder / "cache", folder=folder / "run")
    command = [f"{PACKAGE}.train", *words]
    program = f"from contract import modules; modules.print_of({command!r})"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    modules: list[str] = json.loads(done.stdout.splitlines()[-1])
    return modules


def print_of(command: list[str]) -> None:
    """Become a command, and print what it executed as the last line."""
    sys.argv = command
    modules = executed_by(lambda: runpy.run_module(command[0], run_name="__main__", alter_sys=True))
    print(json.dumps(modules))


def of_push(detector: SlipDetector) -> list[str]:
    """Modules that one push of a stream executes which makes decisions."""
    stream = StreamingDetector(detector)
    samples = samples_of("D", 1)
    stream.push(samples[:1000])
    decisions = []
    modules = executed_by(lambda: decisions.append(stream.push(samples[1000:1200])))
    assert len(decisions[0].score) > 0
    return modules


def main() -> None:
    """Print both lists."""
    from .conftest import RECIPES, train
    from .recordings import of_set, split_of_set, write_set
    from .running import Runner

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lists = {"train +exp=quick": of_training(folder)}
        overrides = [*of_set(write_set(folder / "set")), *split_of_set(), *RECIPES["selected"]]
        overrides += settings(onset="debounced", workers=0, cache="off", export=False)
        runner = Runner()
        trained = train(runner, folder / "trained", overrides)
        runner.close()
        lists["one push of a stream"] = of_push(trained.detector)
    for title, modules in lists.items():
        print(f"{title}: {len(modules)} modules, {len(counted(modules))} of them counted")
        for module in modules:
            print(f"  {module}" if module in counted(modules) else f"  ({module})")


if __name__ == "__main__":
    main()
