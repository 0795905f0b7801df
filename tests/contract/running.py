"""Commands run to their end, each in a process of its own that need not import everything anew.

One process imports the libraries and the commands' modules, reads requests from its input and
carries out each in a fork, as ``python`` would: arguments, folder, output and exit status.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from .names import PACKAGE

ROOT = Path(__file__).parents[2]


class Ran(NamedTuple):
    """What a command left: exit status, and what it said."""

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
    """Runs commands. To be closed."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from contract import running; running._serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment(),
            cwd=ROOT,
        )

    def start(self, folder: Path, command: str, *overrides: str) -> int:
        """Start a command in a folder; the id of its process. ``wait`` must follow."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        request = {"folder": str(folder), "arguments": arguments_of(command, *overrides)}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def wait(self) -> Ran:
        """Wait for the command that was started."""
        status = int(self._process.stdout.readline())
        said = [(self._folder / name).read_text() for name in (".stdout", ".stderr")]
        return Ran(status, *said)

    def __call__(self, folder: Path, command: str, *overrides: str) -> Ran:
        """Run a command in a folder, whatever comes of it."""
        self.start(folder, command, *overrides)
        return self.wait()

    def well(self, folder: Path, command: str, *overrides: str) -> str:
        """Run a command that must succeed; what it printed."""
        ran = self(folder, command, *overrides)
        assert ran.status == 0, ran.err
        return ran.out

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait(60)
        self._process.stdout.close()


def _serve() -> None:
    """Carry out requests until there is no input left."""
    import importlib

    import matplotlib
    import torch

    matplotlib.use("agg")
    torch.set_num_threads(1)
    importlib.import_module(PACKAGE).SlipDetector  # noqa: B018  # imports most of the package
    for heavy in ("hydra", "lightning", "matplotlib.pyplot", "onnx", "onnxruntime", "scipy.signal"):
        importlib.import_module(heavy)
    for line in sys.stdin:
        request = json.loads(line)
        pid = os.fork()
        if pid == 0:
            _carry_out(Path(request["folder"]), request["arguments"])
        print(pid, flush=True)
        _, ended = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(ended), flush=True)


def _carry_out(folder: Path, arguments: Sequence[str]) -> None:
    """In the fork: become ``python -m module ...``, and end."""
    import runpy
    import traceback
    import warnings

    os.chdir(folder)
    for name, descriptor in ((".stdout", 1), (".stderr", 2)):
        opened = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(opened, descriptor)
    os.close(0)
    os.open(os.devnull, os.O_RDONLY)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
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


def wait_for(path: Path, timeout_s: float = 600.0) -> None:
    """Wait until a file is there."""
    end = time.monotonic() + timeout_s
    while not path.exists():
        assert time.monotonic() < end, f"{path} did not appear in {timeout_s} s"
        time.sleep(0.002)
