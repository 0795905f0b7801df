"""Make the detector and the recording that come with the package.

``python -m tactslip_torch.pretrained.make`` trains as ``tactslip train +exp=unseen4`` does, with a
debounced alarm, and simulates one slip of another session on a material that was held out.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from tactslip_torch.data.formats import named_format
from tactslip_torch.features.cache import versions
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.pretrained import NAME, RECORDING
from tactslip_torch.runtime import whole_file
from tactslip_torch.simulation.scene import Scene, Stroke
from tactslip_torch.simulation.simulate import simulate

TRAIN = ["+exp=unseen4", "onset=debounced", "baselines=false", "export=false"]
SCENE = Scene(
    "wood", seed=7, session="sample", strokes=(Stroke(40.0, 40.0, pause_s=1.2),), tail_s=0.4
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


def main() -> None:
    """Make both."""
    with tempfile.TemporaryDirectory() as folder:
        train = [sys.executable, "-m", "tactslip_torch", "train", *TRAIN]
        subprocess.run([*train, f"hydra.run.dir={folder}"], check=True)
        _make_detector(Path(folder))
    _make_recording()
    for path in (RECORDING.with_suffix(".pt"), RECORDING):
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
