"""What a folder of your own costs: ``python -m benchmarks.own_folder [KEY=VALUE ...]``.

``detect`` on many short files and on a recording of hours, and ``train`` on many objects: processor
time of the whole process with its workers, and the most memory of it, also above what a short file
needs. Recordings are drawn, and no more like slip than it takes to be trained on.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks import ROOT
from benchmarks.harness import Benchmark, Job, say
from benchmarks.tables import Table
from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.formats import FORMATS

SOURCES = (
    "tactslip_torch/pretrained/paper24-sim.pt",
    "tactslip_torch/commands/detect.py",
    "tactslip_torch/commands/train.py",
    "tactslip_torch/data/formats/*.py",
    "conf/**/*.yaml",
)
_MODEL = ROOT / "tactslip_torch" / "pretrained" / "paper24-sim.pt"
_RATE_HZ, _MINUTE = 2000, 120_000
_LOST = 40  # samples of a gap
_HAND = """data:
  pattern: "{{material}}_{{label}}_{{trial}}"
  labels: {{still: non-slip, slip: slip}}
  channels:
{rows}
  reading: {{sample_rate_hz: 1000}}
features: {{frames: {{force: 25, acc: 5}}, level: null}}
split: {{by: material, folds: {folds}}}
"""


class _Cost(NamedTuple):
    """Of a command and the processes that it started."""

    cpu_s: float
    wall_s: float
    most_mb: float


@dataclass(frozen=True)
class OwnFolder(Benchmark):
    """Commands on folders that are made for it.

    Args:
        files: of two seconds, that ``detect`` looks through.
        hours: of the long recording.
        kinds: of its file; a ``.csv`` has times with gaps.
        objects: that ``train`` has recordings of.
        recordings: of two seconds, of each object.
        folds: of the estimate.
    """

    title = "A folder of your own"
    about = "processor time and memory of commands on many files, long files and many objects"
    quick = "files=3 hours=0.05 kinds=[csv] objects=3 recordings=4 folds=2"
    charts: ClassVar = {"": [("Commands", ("CPU",))]}
    files: int = 200
    hours: float = 2.0
    kinds: tuple[str, ...] = ("csv", "npz", "h5")
    objects: int = 100
    recordings: int = 20
    folds: int = 10

    def measure(self, job: Job) -> dict[str, Any]:
        """A row for each command."""
        rows = []
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            _short_files(folder / "one", 1)
            idle = _detected(folder / "one", folder)
            rows.append(_row("detect, 1 file of 2 s", idle, idle))
            _short_files(folder / "many", self.files)
            cost = _detected(folder / "many", folder)
            rows.append(_row(f"detect, {self.files} files of 2 s", cost, idle))
            for kind in self.kinds:
                path = folder / f"long.{kind}"
                _long_file(path, self.hours)
                cost = _detected(path, folder)
                path.unlink()
                rows.append(_row(f"detect, {self.hours:g} h in .{kind}", cost, idle))
            _objects(folder / "own", self.objects, self.recordings, self.folds)
            cost = _run("train", str(folder / "own"), f"cache={folder / 'cache'}", folder=folder)
            num = self.objects * self.recordings
            rows.append(_row(f"train, {num} files of {self.objects} objects", cost, idle))
        note = (
            "24 channels at 2 kHz, for *train* at 1 kHz. Reading the files and computing their "
            "features is included. *Memory*: the most of any one process. *Above one file*: the "
            "same less that of the first row."
        )
        return {"tables": {"Commands": Table(rows, note)}}


def _row(name: str, cost: _Cost, idle: _Cost) -> dict[str, str]:
    return {
        "command": name,
        "CPU s": f"{cost.cpu_s:.1f}",
        "wall s": f"{cost.wall_s:.1f}",
        "memory MB": f"{cost.most_mb:.0f}",
        "above one file MB": f"{cost.most_mb - idle.most_mb:.0f}",
    }


def _run(command: str, *words: str, folder: Path) -> _Cost:
    """The cost of a command in a process of its own.

    Raises:
        RuntimeError: if it fails.
    """
    say(f"tactslip {command}")
    typed: Sequence[str] = [command, *words, f"hydra.run.dir={folder / command}"]
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "tactslip_torch", *typed], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"tactslip {command} ended with status {process.returncode}")
    wall_s = time.perf_counter() - started
    return _Cost(used.ru_utime + used.ru_stime, wall_s, used.ru_maxrss / 1024)


def _detected(place: Path, folder: Path) -> _Cost:
    given = (f"model={_MODEL}", f"input={place}", f"sample_rate_hz={_RATE_HZ}")
    return _run("detect", *given, folder=folder)


def _short_files(folder: Path, num: int) -> None:
    """Files of two seconds, every third of them louder for a while."""
    folder.mkdir()
    hand = HandLayout.paper24()
    for number in range(num):
        samples = _noise(np.random.default_rng(number), 2 * _RATE_HZ)
        is_loud = number % 3 == 0
        truth: dict[str, Any] = {"speeds_mm_s": (), "onsets_s": (), "sliding_s": ()}
        if is_loud:
            samples[:, _RATE_HZ : _RATE_HZ * 8 // 5] *= 15
            truth = {"speeds_mm_s": (20.0,), "onsets_s": (1.0,), "sliding_s": ((1.0, 1.6),)}

        recording = Recording(torch.from_numpy(samples), _RATE_HZ, "M1", **truth)
        FORMATS["npz"].save(folder / f"r{number:03}.npz", recording, hand, {})


def _noise(rng: np.random.Generator, num: int) -> NDArray[np.float32]:
    return (0.02 * rng.normal(size=(24, num))).astype(np.float32)


def _long_file(path: Path, hours: float) -> None:
    """A minute of noise over and over."""
    minute = np.ascontiguousarray(_noise(np.random.default_rng(0), _MINUTE).T)
    num = round(60 * hours)
    if path.suffix == ".npz":
        header = {"descr": "<f4", "fortran_order": False, "shape": (num * _MINUTE, 24)}
        with (
            zipfile.ZipFile(path, "w") as archive,
            archive.open("samples.npy", "w", force_zip64=True) as member,
        ):
            np.lib.format.write_array_header_1_0(member, header)  # type: ignore[no-untyped-call]
            for _ in range(num):
                member.write(minute.tobytes())
    elif path.suffix == ".h5":
        h5py = importlib.import_module("h5py")
        with h5py.File(path, "w") as file:
            samples = file.create_dataset("samples", (num * _MINUTE, 24), "f4", chunks=(8192, 24))
            for number in range(num):
                samples[number * _MINUTE : (number + 1) * _MINUTE] = minute
    else:
        rows = [",".join(f"{value:.3f}" for value in row) for row in minute.tolist()]
        with path.open("w", encoding="utf-8") as table:
            table.write(",".join(["time_s", *HandLayout.paper24().names]) + "\n")
            for number in range(num):
                first = number * _MINUTE + number // 10 * _LOST  # a gap every ten minutes
                times = (f"{(first + k) / _RATE_HZ:.4f}" for k in range(_MINUTE))
                table.writelines(f"{time},{row}\n" for time, row in zip(times, rows, strict=True))


def _objects(folder: Path, objects: int, recordings: int, folds: int) -> None:
    """Recordings of objects of different loudness and pitch of slip, and their settings."""
    folder.mkdir()
    times = np.arange(2000) / 1000
    for number in range(objects):
        rng = np.random.default_rng(number)
        gain, pitch = np.exp(0.4 * rng.normal()), rng.uniform(60, 200)
        for trial in range(recordings):
            samples = gain * _noise(rng, len(times))
            samples[:12] = 0.02 * samples[:12].cumsum(1) + rng.normal(size=(12, 1))
            if trial % 2:
                loud = 0.03 * gain * np.exp(0.5 * rng.normal()) * rng.uniform(0.2, 1, (12, 1))
                samples[12:] += loud * np.sin(2 * np.pi * pitch * times + rng.uniform(0, 6))
            name = f"obj{number:03}_{'slip' if trial % 2 else 'still'}_{trial:02}.npz"
            np.savez(folder / name, samples=samples.astype(np.float32))
    kinds = [("force", "slow")] * 12 + [("acc", "fast")] * 12
    rows = "\n".join(
        f"    - {{name: ch{place}, kind: {kind}, adapting: {adapting}}}"
        for place, (kind, adapting) in enumerate(kinds, 1)
    )
    (folder / "hand.yaml").write_text(_HAND.format(rows=rows, folds=folds), encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(OwnFolder().run())
