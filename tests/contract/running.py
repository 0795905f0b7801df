"""Runs commands to their end, each in a process forked from one that has imported the libraries."""

from __future__ import annotations

import json
import multiprocessing
import os
import runpy
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .names import DETECTOR, METRICS, PACKAGE, SlipDetector, settings

ROOT = Path(__file__).parents[2]
SERVER = multiprocessing.get_context("forkserver")
"""Starts processes in which the libraries are imported."""
SERVER.set_forkserver_preload(
    [__name__, "hydra", "lightning", "matplotlib.pyplot", "onnx", "onnxruntime", "scipy.signal"]
)


class Ran(NamedTuple):
    """What a command left: exit status, and its output."""

    status: int
    out: str
    err: str


def arguments_of(command: str, *overrides: str) -> list[str]:
    """The arguments of ``python`` for a command."""
    return ["-m", PACKAGE, command, *overrides]


def environment(**more: str) -> dict[str, str]:
    """This process's, with one thread, without what would change messages."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("TACTSLIP_", "PYTEST_"))}
    return kept | {"OMP_NUM_THREADS": "1", "PYTHONPATH": f"{ROOT / 'tests'}:{ROOT}"} | more


class Runner:
    """Runs commands, one at a time."""

    def start(self, folder: Path, command: str, *overrides: str) -> int:
        """Start a command in a folder; the id of its process. ``wait`` must follow."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, given = folder, (folder, arguments_of(command, *overrides))
        self._process = SERVER.Process(target=_become, args=given)
        self._process.start()
        assert self._process.pid is not None
        return self._process.pid

    def wait(self) -> Ran:
        """Wait for the command that was started."""
        self._process.join()
        status = self._process.exitcode
        assert status is not None
        return Ran(status, *((self._folder / name).read_text() for name in (".stdout", ".stderr")))

    def __call__(self, folder: Path, command: str, *overrides: str) -> Ran:
        """Run a command in a folder, whatever comes of it."""
        self.start(folder, command, *overrides)
        return self.wait()

    def well(self, folder: Path, command: str, *overrides: str) -> str:
        """Run a command that must succeed; what it printed."""
        ran = self(folder, command, *overrides)
        assert ran.status == 0, ran.err
        return ran.out


class Trained(NamedTuple):
    """A detector, the folder of its run, its metrics and how the command was called."""

    detector: SlipDetector
    folder: Path
    metrics: dict[str, Any]
    overrides: list[str]

    @property
    def file(self) -> Path:
        return self.folder / DETECTOR


def train(command: Runner, folder: Path, overrides: Sequence[str], **words: object) -> Trained:
    """Run the training in a folder, and read what it left."""
    given = [*overrides, *settings(**words)]
    command.well(folder, "train", *given, *settings(folder="run"))
    return trained_in(folder, given)


def trained_in(folder: Path, overrides: list[str]) -> Trained:
    """What such a run left in its folder."""
    run = folder / "run"
    metrics = json.loads((run / METRICS).read_text())
    return Trained(SlipDetector.load(run / DETECTOR), run, metrics, overrides)


def _become(folder: Path, arguments: Sequence[str]) -> None:
    """Become ``python -m module ...``, and end."""
    import torch

    torch.set_num_threads(1)
    os.chdir(folder)
    here = environment()
    os.environ.clear()
    os.environ.update(here)
    for name, descriptor in ((".stdout", 1), (".stderr", 2)):
        opened = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(opened, descriptor)
    assert arguments[0] == "-m"
    sys.argv = list(arguments[1:])
    warnings.filterwarnings("ignore", module="runpy")  # the module was imported before
    status = 0
    try:
        runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)
