"""What stops a command: one line that says what is saved and how to go on, and the exit status."""

import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tactslip_torch.commands.stopping import Stopped, stopping

ROOT = Path(__file__).parents[1]
TRAIN = (
    "train +exp=quick data.materials=[M1,M6,iron] split.seen=[M1,M6] "
    "recipe.num_features=10 baselines=false export=false"
)
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}


@pytest.mark.parametrize("number", STATUS)
def test_a_signal_is_a_line_and_a_status(number, capsys):
    before = signal.getsignal(number)

    def stopped():
        with stopping():
            try:
                os.kill(os.getpid(), number)
                time.sleep(10)
            except Stopped as stop:
                raise stop.saying("half of it is saved") from None

    with pytest.raises(SystemExit) as end:
        stopped()
    assert end.value.code == STATUS[number]
    assert capsys.readouterr().err == f"\nstopped by {number.name}; half of it is saved\n"
    assert signal.getsignal(number) is before


STOPPED = [
    (signal.SIGTERM, TRAIN, "../cache", "in the cache; start it again"),
    (signal.SIGINT, "generate materials=M1 cycles=20", "M1_paper_00.npz", "are whole"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "command", "seen", "saved"), STOPPED)
def test_a_command_that_is_stopped_says_how_to_go_on(number, command, seen, saved, tmp_path):
    """The command that it names is carried out, and ends well."""
    told = [*command.split(), "hydra.run.dir=run", "cache=cache", "num_workers=1"]
    if command.startswith("generate"):
        told.remove("cache=cache")
    start = [sys.executable, "-m", "tactslip_torch"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    options = {"cwd": tmp_path, "env": environment, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*start, *told], stdout=subprocess.DEVNULL, **options) as running:
        end = time.monotonic() + 300
        while not (tmp_path / "run" / seen).exists():
            assert time.monotonic() < end
            assert running.poll() is None
            time.sleep(0.02)
        running.send_signal(number)
        _, said = running.communicate(timeout=120)
    assert running.returncode == STATUS[number], said
    line = said.strip().splitlines()[-1]
    assert line.startswith(f"stopped by {number.name}"), said
    assert "Traceback" not in said
    assert saved in line
    if command == TRAIN:
        _, *again = shlex.split(line.rpartition(": ")[2])
        done = subprocess.run([*start, *again], stdout=subprocess.DEVNULL, **options)
        assert done.returncode == 0
        assert (tmp_path / "run" / "detector.pt").is_file()
