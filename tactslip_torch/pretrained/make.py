"""Make the detectors and recordings that come with the package.

``python -m tactslip_torch.pretrained.make`` trains as ``tactslip train +exp=unseen4`` does, with a
debounced alarm, and simulates one slip of another session on a material that was held out. The real
detector is trained on six of the seven real recordings, as ``tactslip setup`` reads them. With
``--xela FOLDER``, the folder ``data_set`` of github.com/imanlab/proactive-slip-control, these are
packed anew.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from tactslip_torch.data.formats import named_format
from tactslip_torch.features.cache import versions
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.pretrained import (
    HELD_OUT,
    NAME,
    REAL,
    REAL_NAME,
    RECORDING,
    write_real_recordings,
)
from tactslip_torch.runtime import whole_file
from tactslip_torch.simulation.scene import Scene, Stroke
from tactslip_torch.simulation.simulate import simulate

TRAIN = ["+exp=unseen4", "onset=debounced", "baselines=false", "export=false"]
SCENE = Scene(
    "wood", seed=7, session="sample", strokes=(Stroke(40.0, 40.0, pause_s=1.2),), tail_s=0.4
)
SETUP_REAL = ["--yes", "--units", "counts"]
TRAIN_REAL = ["baselines=false", "export=false"]
_XELA = (
    "Recordings of two XELA uSkin fingers: github.com/imanlab/proactive-slip-control, data_set; "
    "converted to one table each."
)
_LEFT_OUT = ("validation", "train_recordings", "solve")
"""Metadata of the training that are long, and made again by training again."""


def _make_detector(run: Path) -> None:
    """Keep the detector of a finished run, without what is long, with what its test found."""
    detector = SlipDetector.load(run / "detector.pt")
    splits = json.loads((run / "metrics.json").read_text())["splits"]
    info = {name: value for name, value in detector.info.items() if name not in _LEFT_OUT}
    detector.info = info | {
        "name": NAME,
        "made_by": " ".join(["tactslip train", *TRAIN]),
        "balanced_accuracy": {role: own["balanced_accuracy"] for role, own in splits.items()},
        "versions": versions(),
    }
    detector.save(RECORDING.with_suffix(".pt"))


def _make_recording() -> None:
    """Simulate and keep the recording, packed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.npz"
        named_format("npz").save(path, simulate(SCENE), SCENE.hand, SCENE.to_dict())
        with (
            whole_file(RECORDING) as temporary,
            zipfile.ZipFile(path) as plain,
            zipfile.ZipFile(temporary, "w") as packed,
        ):
            for member in plain.infolist():
                entry = zipfile.ZipInfo(member.filename, member.date_time)
                packed.writestr(entry, plain.read(member), zipfile.ZIP_DEFLATED, 9)


def _pack_real(data_set: Path) -> None:
    """Pack the real recordings: counts as they are, slip unknown behind the loss of the box."""
    packed: dict[str, Any] = {"names": [], "channels": []}
    for number, folder in enumerate(sorted(data_set.iterdir()), 1):
        name, tables = f"box_{number}", list[Any]()
        packed["names"].append(name)
        packed["channels"] = []
        for finger in (1, 2):
            path = folder / f"xela_sensor{finger}.csv"
            axes = path.read_text().splitlines()[0].split(",")
            packed["channels"] += [f"{axis[-1]}_f{finger}_{axis[:-2]}" for axis in axes]
            tables.append(np.loadtxt(path, delimiter=",", skiprows=1).astype(np.uint16))
        slip, fail = np.loadtxt(folder / "slip_label.csv", delimiter=",", skiprows=1).T
        with (folder / "meta_data.csv").open(newline="") as file:
            (about,) = csv.DictReader(file)
        packed[f"{name}_samples"] = np.concatenate(tables, axis=1)
        packed[f"{name}_slip"] = np.where(fail > 0, -1, slip).astype(np.int8)
        packed[f"{name}_rate_hz"] = float(about["frequency_hz"])
    np.savez_compressed(REAL, **packed)
    licence = (data_set.parent / "LICENSE").read_text()
    REAL.with_suffix(".LICENSE").write_text(f"{_XELA}\n\n{licence}")


def _make_real_detector() -> None:
    """Train on the real recordings but one, with nothing said beside what setup finds."""
    tactslip = [sys.executable, "-m", "tactslip_torch"]
    with tempfile.TemporaryDirectory() as folder:
        write_real_recordings(Path(folder, "box"))
        Path(folder, "box", HELD_OUT).unlink()
        subprocess.run([*tactslip, "setup", "box", *SETUP_REAL], check=True, cwd=folder)
        subprocess.run(
            [*tactslip, "train", "box", *TRAIN_REAL, "hydra.run.dir=run"], check=True, cwd=folder
        )
        detector = SlipDetector.load(Path(folder, "run", "detector.pt"))
    info = {name: value for name, value in detector.info.items() if name not in _LEFT_OUT}
    detector.info = info | {
        "name": REAL_NAME,
        "trained_on": sorted(detector.info["train_recordings"]),
        "made_by": " ".join(["tactslip train", *TRAIN_REAL]),
        "source": _XELA,
        "versions": versions(),
    }
    detector.save(REAL.with_suffix(".pt"))


def main() -> None:
    """Make all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--xela", type=Path, help="pack the real recordings of this folder anew")
    parser.add_argument("--real", action="store_true", help="make the real detector alone")
    given = parser.parse_args()
    if given.xela is not None:
        _pack_real(given.xela)
    _make_real_detector()
    if given.real:
        return
    with tempfile.TemporaryDirectory() as folder:
        train = [sys.executable, "-m", "tactslip_torch", "train", *TRAIN]
        subprocess.run([*train, f"hydra.run.dir={folder}"], check=True)
        _make_detector(Path(folder))
    _make_recording()
    for path in (RECORDING.with_suffix(".pt"), RECORDING):
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
