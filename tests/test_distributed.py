"""Several processes under Lightning: the detector of one, to rounding."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from test_commands import TINY, assert_same_detector, run_train

from tactslip_torch import SlipDetector

HERE = Path(__file__).parent
MANY = ("data.cycles=8", "split.train_fraction=0.75")
BINS = ("recipe.num_features=40",)  # 861 monomials: fewer bins, so bins are kept
pytestmark = pytest.mark.slow


def launched(folder, *overrides, torchrun=0, tiny=(*TINY, *MANY)):
    start = [sys.executable, "-m"]
    if torchrun:
        start += ["torch.distributed.run", f"--nproc_per_node={torchrun}", "--standalone", "-m"]
    command = [*start, "tactslip_torch.train", *tiny, f"hydra.run.dir={folder}", *overrides]
    environment = {k: v for k, v in os.environ.items() if k != "TACTSLIP_TRACEBACK"}
    environment |= {"PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, cwd=folder.parent, env=environment, capture_output=True, text=True, timeout=300
    )


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return f"cache={tmp_path_factory.mktemp('cache')}"


def test_processes_learn_what_one_does(cache, tmp_path):  # 3 share the recordings unevenly
    _, alone = run_train(tmp_path / "alone", *TINY, *MANY, *BINS, cache)
    done = launched(tmp_path / "ddp", *BINS, cache, "trainer.strategy=ddp", "trainer.devices=3")
    assert done.returncode == 0, done.stderr[-2000:]
    assert_same_detector(tmp_path / "alone", tmp_path / "ddp")
    together = json.loads((tmp_path / "ddp" / "metrics.json").read_text())
    assert together["splits"] == alone["splits"]
    assert done.stdout.count("results in") == 1
    one, three = (SlipDetector.load(tmp_path / n / "detector.pt").info for n in ("alone", "ddp"))
    same, other = one.pop("solve"), three.pop("solve")
    assert same.keys() == other.keys()
    for name, value in same.items():  # sums are rounded by the order of their parts
        is_number = isinstance(value, float)
        assert value == (pytest.approx(other[name], rel=1e-6) if is_number else other[name])
    assert one == three


def test_what_another_process_cannot_read_is_named(cache, tmp_path):
    broken = "+data.broken=A/1"  # the second of the training recordings
    done = launched(tmp_path / "ddp", "cache=off", broken, "trainer.strategy=ddp",
                    "trainer.devices=2")  # fmt: skip
    assert done.returncode != 0
    line = r"error in process 1: A/1: channel SG1, sample 2000 \(1\.0000 s\) is nan; repair"
    assert re.search(line, done.stderr)


def test_torchrun_without_its_strategy_is_refused(tmp_path, monkeypatch):
    for name, value in {"WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "run"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=r"2 processes were started, .* add trainer\.strategy=ddp"):
        run_train(tmp_path, *TINY, *MANY, "cache=off")


def test_folds_with_uneven_shares_under_torchrun(cache, tmp_path):
    folds = ("split=leave_one_material_out", "split.materials=[A,B,C]")
    folds += ("data.cycles=5", "split.train_fraction=0.6")
    plain = [o for o in TINY if not o.startswith("split.")]
    _, alone = run_train(tmp_path / "alone", *plain, *folds, cache)
    four = ("trainer.strategy=ddp", "trainer.devices=4")
    done = launched(tmp_path / "ddp", cache, *four, torchrun=4, tiny=(*plain, *folds))
    assert done.returncode == 0, done.stderr[-2000:]
    assert_same_detector(tmp_path / "alone" / "without_A", tmp_path / "ddp" / "without_A")
    together = json.loads((tmp_path / "ddp" / "metrics.json").read_text())
    assert together["splits"] == alone["splits"]
