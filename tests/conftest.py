"""Fixtures every test file may ask for, and the seed of everything that is generated."""

import fcntl
import os
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from contract.names import settings as overrides
from contract.recordings import of_set, split_of_set, write_set
from contract.running import Runner, Trained, train, trained_in
from extremes import SEED
from hypothesis import HealthCheck, is_hypothesis_test, seed, settings
from matplotlib.figure import Figure

from tactslip_torch.native import reason_unavailable

settings.register_profile(
    "default",
    deadline=None,
    derandomize=False,  # the seed below is as good, and can be changed
    database=None,
    max_examples=20,
    suppress_health_check=[HealthCheck.too_slow],  # no test fails because a machine is busy
)
torch.set_num_threads(1)  # two processes with two threads each on two cores spend hours waiting

settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


def pytest_configure(config: pytest.Config) -> None:
    """With ``-n``, a file stays in one process, and every process computes in one thread.

    Fixtures of a file are then made once, and tests that count over their file count all of it.
    Processes that tests start themselves read the variable; it is set before workers are made.
    """
    if getattr(config.option, "numprocesses", None):
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        if config.option.dist == "load":  # the plugin's choice where the user made none
            config.option.dist = "loadfile"
        config.option.loadscopereorder = False  # the order is that of slow_files_first
        config.option.maxworkerrestart = "0"  # a crash ends the run with a message
    if not hasattr(config, "workerinput"):
        reason_unavailable()  # builds the native engine once, before any test


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    seed_hypothesis(config, items)
    if hasattr(config, "workerinput"):  # of pytest-xdist
        slow_files_first(items)


def slow_files_first(items: list[pytest.Item]) -> None:
    """What is left for the end is short, so no worker waits long for another."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def seed_hypothesis(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Each hypothesis test draws by the seed of the run and its own name, in any selection."""
    if config.getoption("--hypothesis-seed", None) is not None:
        return  # hypothesis sees to it
    for item in items:
        test = getattr(item, "obj", None)
        if test is not None and is_hypothesis_test(test):
            name = item.nodeid.split("[")[0]
            seed(f"{SEED} {name}")(test)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    line = f"property tests: seed {SEED} (TACTSLIP_SEED={SEED} repeats them)"
    terminalreporter.write_line(line)


# A folder of recordings, and a detector of each recipe that was trained on it: ask for these
# before you make a detector another way. They are made once in a run, when first asked for.


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """By name a folder of all processes of a run, which the first that asks for it fills."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder_of(name: str, fill: Callable[[Path], object]) -> Path:
        folder, mark = shared / name, shared / f"{name}.whole"
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not mark.exists():
                folder.mkdir(exist_ok=True)
                fill(folder)
                mark.touch()
        return folder

    return folder_of


@pytest.fixture(scope="session")
def command() -> Runner:
    """Runs a command in a process of its own."""
    return Runner()


@pytest.fixture(scope="session")
def recordings(once: Callable[..., Path]) -> Path:
    """Twelve text files of a hand of two slow and two fast channels, with their manifest."""
    return once("recordings", write_set)


@pytest.fixture(scope="session")
def cache(once: Callable[..., Path]) -> Path:
    """Features of the recordings."""
    return once("cache", lambda folder: None)


@pytest.fixture(scope="session")
def general(once: Callable[..., Path], command: Runner, recordings: Path, cache: Path) -> Trained:
    """A detector of the default recipe, with an alarm."""
    return _trained(once, "general", command, recordings, cache)


@pytest.fixture(scope="session")
def paper(once: Callable[..., Path], command: Runner, recordings: Path, cache: Path) -> Trained:
    """A detector of the paper's recipe: twelve features, nothing pooled, with an alarm."""
    recipe = {"recipe": "paper", "num_features": 12, "penalties": [0.001, 0.1]}
    return _trained(once, "paper", command, recordings, cache, **recipe)


def _trained(
    once: Callable[..., Path], name: str, command: Runner, root: Path, cache: Path, **recipe: object
) -> Trained:
    words = {"onset": "debounced", "workers": 0, "export": False, "baselines": False, **recipe}
    given = [*of_set(root), *split_of_set(), *overrides(cache=cache, **words)]
    return trained_in(once(name, lambda folder: train(command, folder, given)), given)


@pytest.fixture(scope="session", params=["general", "paper"])
def trained(request: pytest.FixtureRequest) -> Trained:
    """Each of the two detectors."""
    found: Trained = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="session", params=["paper", pytest.param("general", marks=pytest.mark.slow)])
def trained_or_slow(request: pytest.FixtureRequest) -> Trained:
    """The same, the default among the slow tests: for what trains once more."""
    found: Trained = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="session")
def graphs_of(
    request: pytest.FixtureRequest, once: Callable[..., Path], command: Runner
) -> Callable[..., Path]:
    """By recipe and precision a folder with both graphs, exported when first asked for."""

    def graphs(recipe: str, precision: str = "float32") -> Path:
        model = request.getfixturevalue(recipe).file

        def fill(folder: Path) -> None:
            words = {"model": model, "precision": precision, "output": folder, "graph": "both"}
            command.well(folder, "export", *overrides(**words))

        return once(f"graphs_{recipe}_{precision}", fill)

    return graphs


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers that depend on the test's name alone, so order and selection do not matter."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were saved, in order; each file is written as well, small."""
    figures: list[Figure] = []
    write = Figure.savefig

    def keep(self: Figure, target: object, **options: object) -> None:
        figures.append(self)
        write(self, target, **options | {"dpi": 40})

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs a command's module with arguments: exit status, and what stands on both streams."""

    def run(command: Any, *arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["tactslip", *map(str, arguments)])
        try:
            command.main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        return status, *capsys.readouterr()

    return run


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device here")
    return torch.device(request.param)
