"""Several processes under Lightning: the detector of one, to rounding."""

import json
import multiprocessing
import os
import re
import socket
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from test_commands import TINY, TINY_BY_FOLD, assert_same_detector, run_train

from tactslip_torch import SlipDetector
from tactslip_torch.__main__ import main

pytestmark = pytest.mark.slow


def together(num, *words):
    """Processes that train together, forked from this one, with the variables of torchrun."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free.getsockname()[1]}
    shared |= {"WORLD_SIZE": num, "GROUP_RANK": 0, "TORCHELASTIC_RUN_ID": "run"}
    forks = multiprocessing.get_context("fork")
    words = (*words, "trainer.strategy=ddp", f"trainer.devices={num}")
    places = [shared | {"RANK": rank, "LOCAL_RANK": rank} for rank in range(num)]
    processes = [forks.Process(target=carry_out, args=(place, words)) for place in places]
    for process in processes:
        process.start()
    return processes


def carry_out(place, words):
    os.environ.update({name: str(value) for name, value in place.items()})
    warnings.simplefilter("default")
    sys.argv = ["tactslip", "train", *words]
    main()


def assert_same_scores(folder, other):
    one, its = (json.loads((f / "metrics.json").read_text()) for f in (folder, other))
    assert one["splits"] == its["splits"]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return f"cache={tmp_path_factory.mktemp('cache')}"


def test_processes_that_lightning_starts_learn_what_one_does(cache, tmp_path):
    alone, ddp = tmp_path / "alone", tmp_path / "ddp"
    run_train(alone, *TINY, cache)
    words = *TINY, cache, f"hydra.run.dir={ddp}", "trainer.strategy=ddp"
    command = [sys.executable, "-m", "tactslip_torch", "train", *words, "trainer.devices=2"]
    tests = Path(__file__).parent
    path = os.pathsep.join(map(str, (tests, tests.parent)))  # this package, whichever is installed
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    options = {"cwd": tmp_path, "env": environment, "timeout": 300}
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("results in") == 1
    assert_same_detector(alone, ddp)
    assert_same_scores(alone, ddp)
    one, two = (SlipDetector.load(folder / "detector.pt").info for folder in (alone, ddp))
    same, other = one.pop("solve"), two.pop("solve")
    assert same.keys() == other.keys()
    for name, value in same.items():  # sums are rounded by the order of their parts
        is_number = isinstance(value, float)
        assert value == (pytest.approx(other[name], rel=1e-6) if is_number else other[name])
    assert one == two


def test_folds_are_learned_in_uneven_shares(cache, tmp_path):
    alone, ddp = tmp_path / "alone", tmp_path / "ddp"
    run_train(alone, *TINY_BY_FOLD, cache)
    for process in together(3, *TINY_BY_FOLD, cache, f"hydra.run.dir={ddp}"):  # of 4 recordings
        process.join(300)
        assert process.exitcode == 0
    assert_same_detector(alone / "without_A", ddp / "without_A")
    assert_same_scores(alone, ddp)


def test_what_another_process_cannot_read_is_named(tmp_path, capfd):
    broken = "+data.broken=A/1"  # one that trains and is the second process's
    first, second = together(2, *TINY, "cache=off", broken, f"hydra.run.dir={tmp_path / 'run'}")
    second.join(300)
    first.kill()  # which waits for the other, unless it is told by who started both
    first.join()
    assert second.exitcode == 2
    line = r"error in process 1: A/1: channel SG1, sample 2000 \(1\.0000 s\) is nan; repair"
    assert re.search(line, capfd.readouterr().err)


def test_torchrun_without_its_strategy_is_refused(tmp_path, monkeypatch):
    for name, value in {"WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "run"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=r"2 processes were started, .* add trainer\.strategy=ddp"):
        run_train(tmp_path, *TINY, "cache=off")
