"""TSFEL's features of all windows: slow, so kept recording by recording, to go on with."""

from __future__ import annotations

import hashlib
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from benchmarks.peers.others import tsfel_features
from benchmarks.real.windows import Array, Windows
from tactslip_torch.files import whole_file
from tactslip_torch.progress import bar


def tsfel_rows(windows: Windows, folder: Path) -> tuple[Array, float]:
    """Features of every window, computed or from the folder, and the seconds that one took.

    Args:
        windows: all.
        folder: of one file for each recording, by its content.

    Shape:
        - output: ``[N, F]``, float32, finite
    """
    rate = windows.maker.pool.sample_rate_hz
    describe = tsfel_features(rate)
    folder.mkdir(parents=True, exist_ok=True)
    rows, seconds = [], 0.0
    for place in bar(range(len(windows.recordings)), "TSFEL", "recording"):
        mine = windows.samples[windows.recording == place]
        if not len(mine):
            continue
        path = folder / f"{_digest(mine, rate)}.npz"
        if not path.exists():
            started = time.perf_counter()
            found = finite(np.stack([describe(window) for window in mine]))
            taken = time.perf_counter() - started
            with whole_file(path) as temporary, temporary.open("wb") as file:
                np.savez(file, features=found, seconds=taken)
        with np.load(path, allow_pickle=False) as kept:
            rows.append(kept["features"])
            seconds += float(kept["seconds"])
    return np.concatenate(rows), seconds / len(windows.samples)


def finite(rows: Array) -> Array:
    """In float32, with 0 for what is not a number and the widest value for what is infinite."""
    found: Array = np.nan_to_num(rows, posinf=1e30, neginf=-1e30).astype(np.float32)
    return found


def _digest(samples: Array, rate: float) -> str:
    facts = f"{version('tsfel')} {rate:g} {samples.shape} {samples.dtype}".encode()
    return hashlib.sha256(facts + np.ascontiguousarray(samples).tobytes()).hexdigest()[:32]
