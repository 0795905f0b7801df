"""Sets of real windows, one ``.npz`` each: ``python -m benchmarks.real_sets DATA OUT`` makes three.

It reads the folders ``biotacsp-dos`` and ``osu-imu`` of DATA, whichever are there, and writes
``biotacsp.npz``, ``biotacsp_direction.npz`` and ``osu.npz`` to OUT, which ``python -m
benchmarks.real OUT`` takes.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch import HandLayout
from tactslip_torch.commands.stopping import errors_in_one_line

Array = NDArray[Any]
HAND_COLUMNS = ("name", "kind", "finger", "segment", "adapting")
LEAST_GROUPS = 3
"""One is left out, and to choose among two methods another one."""


class RealSet(NamedTuple):
    """Windows of real recordings; a file holds the same under the same names.

    Attributes:
        X: windows as they were measured, tared at most; float32.
        y: True for slip; or whole numbers or words of several classes.
        group: what is left out together, such as the object; words.
        recording: of which recording of its group each window is; words.
        sample_rate_hz: of the windows.
        hand: a row for each channel, its columns those of ``HAND_COLUMNS``.
        source: where the set comes from, and its licence.

    Shape:
        - X: ``[N, C, T]``; y, group, recording: ``[N]``; hand: ``[C, 5]``
        - sample_rate_hz, source: ``[]``
    """

    X: Array
    y: Array
    group: Array
    recording: Array
    sample_rate_hz: Array
    hand: Array
    source: Array

    @property
    def layout(self) -> HandLayout:
        """The channels."""
        rows = [dict(zip(HAND_COLUMNS, map(str, row), strict=True)) for row in self.hand]
        return HandLayout.from_rows(rows)

    def classes(self) -> tuple[Array, Array]:
        """The classes, ascending, and of which each window is, ``[N]``."""
        names, index = np.unique(self.y, return_inverse=True)
        return names, index

    def trials(self) -> tuple[Array, Array]:
        """Of which recording each window is, ``[N]``, and the group of each recording, ``[R]``."""
        pairs = np.stack([self.group, self.recording], 1)
        each, index = np.unique(pairs, axis=0, return_inverse=True)
        return index.reshape(-1), np.unique(each[:, 0], return_inverse=True)[1]

    def part(self, windows: Array) -> RealSet:
        """The set of some windows."""
        return self._replace(**{n: getattr(self, n)[windows] for n in self._fields[:4]})

    def check(self) -> None:
        """Check sizes and types, and that a group can be left out.

        Raises:
            ValueError: if something is amiss; says what.
        """
        x, num = self.X, len(self.y)
        if x.ndim != 3 or x.dtype != np.float32 or not x.size or not np.isfinite(x).all():
            raise ValueError(f"expected finite float32 X [N, C, T], got {x.dtype} {list(x.shape)}")
        for name, shape, kinds in (
            ("y", (len(x),), "biuU"),
            ("group", (len(x),), "U"),
            ("recording", (len(x),), "U"),
            ("sample_rate_hz", (), "fiu"),
            ("hand", (x.shape[1], len(HAND_COLUMNS)), "U"),
            ("source", (), "U"),
        ):
            value = getattr(self, name)
            if value.shape != shape or value.dtype.kind not in kinds:
                raise ValueError(
                    f"expected {name} of shape {list(shape)} and a type of {kinds!r} for X "
                    f"{list(x.shape)}, got {value.dtype} {list(value.shape)}"
                )
        if not 0 < self.sample_rate_hz < np.inf:
            raise ValueError(f"expected a positive sample_rate_hz, got {self.sample_rate_hz}")
        groups, classes = np.unique(self.group), len(np.unique(self.y))
        if len(groups) < LEAST_GROUPS or classes < 2:
            raise ValueError(
                f"expected {LEAST_GROUPS} groups and 2 classes at least, got {len(groups)} and "
                f"{classes} in {num} windows"
            )
        for group in groups:
            if len(np.unique(self.y[self.group != group])) < classes:
                raise ValueError(f"a class has windows of group {group} alone, which is left out")


def read_set(path: Path) -> RealSet:
    """Read and check a set; nothing in the file is executed.

    Raises:
        ValueError: if a name is missing, or ``RealSet.check`` finds something amiss.
    """
    with np.load(path, allow_pickle=False) as file:
        if missing := sorted(set(RealSet._fields) - set(file.files)):
            raise ValueError(f"{path.name} has no {', '.join(missing)}")
        found = RealSet(**{name: file[name] for name in RealSet._fields})
    try:
        found.check()
        found.layout  # noqa: B018  # refuses rows that are no channels
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
    return found


def made(
    windows: Iterable[tuple[Array, bool | str, str, str]],
    rate_hz: float,
    hand: Iterable[tuple[str, ...]],
    source: str,
) -> RealSet:
    """A set of windows ``[C, T]``, each with its label, group and recording."""
    x, y, group, recording = zip(*windows, strict=True)
    return RealSet(
        np.stack(x).astype(np.float32),
        np.array(y),
        np.array(group),
        np.array(recording),
        np.array(rate_hz),
        np.array(list(hand)),
        np.array(source),
    )


def biotacsp(root: Path) -> RealSet:
    """BioTac SP: 24 electrodes at 100 Hz (nominal), each object in six slips and a stable touch."""
    windows = []
    for path in sorted(root.glob("csvs/*/*.csv")):
        with path.open() as file:
            num_named = 0 if file.readline()[:1].isdigit() else 1  # lines of names
        samples = np.loadtxt(path, delimiter=",", skiprows=num_named)
        samples = (samples - samples[:50].mean(0)).T  # [24, T], tared on the first half second
        letters = re.match("[a-z]+", path.name)
        assert letters is not None  # files are named by object and number
        group = letters[0].replace("strippes", "striped")  # one file is misspelt
        recording, is_slip = f"{path.parent.name}/{path.stem}", path.parent.name != "t"
        windows += [
            (samples[:, start : start + 64], is_slip, group, recording)
            for start in range(50, samples.shape[1] - 63, 32)
        ]
    hand = [(f"e{place}", "electrode", "finger", "distal", "fast") for place in range(24)]
    source = "BioTac SP, github.com/yayaneath/BioTacSP-DoS, doi:10.3390/s19030523; no licence"
    return made(windows, 100.0, hand, source)


def biotacsp_direction(root: Path) -> RealSet:
    """The same windows with the direction of the slip: the folder that its recording lies in.

    ``n``, ``s``, ``e`` and ``w`` are translations, ``cw`` and ``aw`` rotations, ``t`` is a touch.
    """
    found = biotacsp(root)
    return found._replace(y=np.array([name.split("/")[0] for name in found.recording]))


def osu_rows(names: Iterable[str]) -> list[tuple[str, ...]]:
    """The channels of the set ``osu``, by ``HAND_COLUMNS``: fingertips left and right."""
    fingers = {"l": "left", "r": "right"}
    return [(n, "gyro" if "g" in n else "acc", fingers[n[0]], "distal", "fast") for n in names]


def osu_object(path: Path) -> str:
    """The object of a trial of the set ``osu``, by its file's name."""
    return re.sub(r"_[CD]_.*", "", path.stem)


def osu(root: Path) -> RealSet:
    """Acceleration and angular rate of two fingertips at about 25 Hz, slip over 1 cm/s."""
    windows = []
    for path in sorted(root.glob("*.csv")):
        with path.open(newline="") as file:
            names, *rows = csv.reader(file)
        values = np.array([[float(value or "nan") for value in row[1:13]] for row in rows])
        samples = (values - np.nanmean(values[:15], 0)).T  # [12, T], tared on three frames
        group = osu_object(path)
        for end in range(20, samples.shape[1] + 1, 5):
            window, label = samples[:, end - 20 : end], rows[end - 1][13]
            if label and np.isfinite(window).all():
                windows.append((window, label == "1", group, path.stem))
    hand = osu_rows(names[1:13])
    source = "fingertip IMUs, github.com/OSUrobotics/SimpleSlipDetection, GPL-2.0"
    return made(windows, 25.0, hand, source)


def main(arguments: list[str]) -> int:
    """Make the sets whose folders are there."""
    with errors_in_one_line():
        if len(arguments) != 2:
            raise ValueError("usage: python -m benchmarks.real_sets DATA OUT")
        data, out = map(Path, arguments)
        out.mkdir(parents=True, exist_ok=True)
        found = {"biotacsp-dos": (biotacsp, biotacsp_direction), "osu-imu": (osu,)}
        if not any((data / name).is_dir() for name in found):
            raise ValueError(f"{data} has no folder {' or '.join(found)}")
        for name, makers in found.items():
            for make in makers if (data / name).is_dir() else ():
                path = out / f"{make.__name__}.npz"
                np.savez_compressed(path, **make(data / name)._asdict())
                read = read_set(path)
                print(f"{path}: windows {list(read.X.shape)}, {len(read.trials()[1])} recordings")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
