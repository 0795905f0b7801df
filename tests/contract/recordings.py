"""A folder of small recordings of a real hand's kind: four channels, text files, a manifest.

Rest is noise, slip a louder noise, louder by another factor in each recording, so that detectors
are neither right everywhere nor by chance. Nothing of the package is used.
"""

import csv
from pathlib import Path

import numpy as np
import torch

from .names import MANIFEST, settings

RATE_HZ = 2000
CHANNELS = [
    {"name": f"{kind}{i}", "kind": kind, "finger": finger, "segment": "distal"}
    for kind in ("SG", "PVDF")
    for i, finger in enumerate(("index", "thumb"), 1)
]
NAMES = [channel["name"] for channel in CHANNELS]
SEEN, HELD_OUT = ("A", "B", "C"), ("D",)
TRIALS = (1, 2, 3)
SLIDE_S = (1.2, 2.6)


def samples_of(material: str, trial: int, version: int = 0) -> np.ndarray:
    """Three seconds, volts ``[T, C]``; another version has others, and a faint slip."""
    rng = np.random.default_rng([ord(material), trial, version])
    time_s = np.arange(3 * RATE_HZ) / RATE_HZ
    samples = 0.1 * rng.standard_normal((len(time_s), len(NAMES)))
    is_sliding = (time_s >= SLIDE_S[0]) & (time_s < SLIDE_S[1])
    samples[is_sliding] *= rng.uniform(1.15, 1.6) - 0.6 * version
    samples[is_sliding, :2] *= 2  # so that channels of both kinds are worth selecting
    samples[:, :2] += 1 + 0.1 * rng.standard_normal(2)
    return samples.astype(np.float32)


def bins_of(detector, samples: np.ndarray, step: int = 97) -> torch.Tensor:
    """Raw bins of a recording with the context that a detector needs, ``[N, C, n]``."""
    length = detector.context_before + detector.pool.bin_samples + detector.context_after
    return torch.from_numpy(samples.T.astype(np.float64)).unfold(1, length, step).transpose(0, 1)


def write_recording(path: Path, samples: np.ndarray) -> Path:
    """Text: a column of times and one a channel, all digits of float32."""
    time_s = np.arange(len(samples)) / RATE_HZ
    table = np.column_stack([time_s, samples.astype(np.float64)])
    header = ",".join(["time", *NAMES])
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


def write_set(folder: Path, versions: dict[str, int] | None = None) -> Path:
    """All recordings and their manifest; ``versions`` by "material/trial", 0 where not named."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for material in (*SEEN, *HELD_OUT):
        for trial in TRIALS:
            version = (versions or {}).get(f"{material}/{trial}", 0)
            path = folder / f"{material}_{trial}.csv"
            write_recording(path, samples_of(material, trial, version))
            slide_s = f"{SLIDE_S[0]}-{SLIDE_S[1]}"
            lines.append([path.name, material, trial, slide_s])
    with (folder / MANIFEST).open("w", newline="") as file:
        csv.writer(file).writerows([["file", "material", "trial", "sliding_s"], *lines])
    return folder


def of_set(root: Path) -> list[str]:
    """Overrides of commands for such a folder."""
    return settings(data="files", root=root, channels=CHANNELS)


def split_of_set() -> list[str]:
    """How it is split: held-out materials, and of the others a trial each to test on."""
    return settings(seen=SEEN, held_out=HELD_OUT, train_share=0.67)
