"""What comes with the package: two small detectors, each with recordings to try it on.

``paper24-sim`` and its recording are simulated. ``xela-real`` was trained on real recordings of two
XELA uSkin fingers that pick up and move a box; source: github.com/imanlab/proactive-slip-control,
MIT (``xela-real.LICENSE``). ``python -m tactslip_torch.pretrained.make`` makes both anew.
"""

from pathlib import Path

import numpy as np

from tactslip_torch.data.formats import named_format
from tactslip_torch.data.recording import Recording
from tactslip_torch.runtime import PACKAGE

NAME = "paper24-sim"
RECORDING = PACKAGE / "pretrained" / f"{NAME}.npz"
REAL_NAME = "xela-real"
REAL = PACKAGE / "pretrained" / f"{REAL_NAME}.npz"
HELD_OUT = "box_5.csv"
"""The real recording that ``xela-real`` was not trained on, the first in which the box slips."""


def sample_recording() -> Recording:
    """A simulated recording of the paper's hand with one slip, on a material held out in training.

    Example:
        >>> sample_recording()
        Recording(24 channels, 2.68 s at 2000 Hz, in V, material wood, 1 slip, simulated)
    """
    return named_format("npz").load(RECORDING).recording


def write_real_recordings(folder: Path) -> list[Path]:
    """Write the seven real recordings as CSV files, with their licence.

    Each has a column of times in s, 96 channels in counts (two fingers of 16 taxels with axes x, y
    and z) at about 60 Hz, and ``slip``: 1 where the box slips, 0 where it does not, empty behind
    its loss.

    Args:
        folder: made if it is not there.

    Returns:
        Their paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    license_ = REAL.with_suffix(".LICENSE")
    (folder / "LICENSE.md").write_text(license_.read_text(encoding="utf-8"), encoding="utf-8")
    paths = []
    with np.load(REAL) as stored:
        for name in stored["names"].tolist():
            samples, slip = stored[f"{name}_samples"], stored[f"{name}_slip"]
            rows = [",".join(["time_s", *stored["channels"].tolist(), "slip"])]
            for number, (row, label) in enumerate(
                zip(samples.tolist(), slip.tolist(), strict=True)
            ):
                time_s = f"{number / float(stored[f'{name}_rate_hz']):.5f}"
                rows.append(",".join([time_s, *map(str, row), "" if label < 0 else str(label)]))
            paths.append(folder / f"{name}.csv")
            paths[-1].write_text("\n".join(rows) + "\n", encoding="utf-8")
    return paths


def real_onset_s() -> float:
    """When the box begins to slip in ``HELD_OUT``, by its labels.

    Example:
        >>> round(real_onset_s(), 2)
        1.34
    """
    name = HELD_OUT.removesuffix(".csv")
    with np.load(REAL) as stored:
        return float(stored[f"{name}_slip"].argmax() / stored[f"{name}_rate_hz"])
