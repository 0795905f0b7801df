"""Recordings of a gripper that somebody built, as its logger writes them: the whole journey's data.

Six channels, three of force and three of acceleration, at 1 kHz. Files have semicolons, decimal
commas, times in milliseconds, a column of words that says what happens, some empty cells and some
dropped rows. Slip is a band of vibration whose strength and centre depend on the object; forces
ramp up and down whether the object slips or not, the arm shakes the gripper a little, and twice
something knocks against it.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RATE_HZ = 1000
CHANNELS = ("force_1", "force_2", "force_3", "acc_x", "acc_y", "acc_z")
OBJECTS = {  # strength of its vibration and the centre of the band, Hz
    "cup": (1.0, 120.0),
    "box": (1.6, 90.0),
    "bottle": (0.7, 150.0),
    "sponge": (0.5, 60.0),
    "can": (1.3, 200.0),
}
STATES = ("stick", "slip")
_KNOCK = 40  # samples
_NOISE = 0.25  # of acceleration where nothing happens, beside a band of strength 1


def recording(
    material: str, trial: int, seconds: float = 4.0, slips: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Samples of a recording, and which of them are slip.

    Args:
        material: one of ``OBJECTS``.
        trial: its number, which seeds it.
        seconds: how long it lasts.
        slips: whether the object slips twice; else it is only held.

    Shape:
        - output: ``[T, 6]`` and ``[T]``
    """
    strength, centre_hz = OBJECTS[material]
    rng = np.random.default_rng([list(OBJECTS).index(material), trial, int(slips)])
    num = round(seconds * RATE_HZ)
    time_s = np.arange(num) / RATE_HZ
    is_slip = np.zeros(num, dtype=bool)
    for part in (0.2, 0.62) if slips else ():
        first = round(num * (part + 0.08 * rng.random()))
        is_slip[first : first + round(num * (0.15 + 0.1 * rng.random()))] = True
    knots = np.linspace(0, seconds, max(round(4 * seconds), 4))
    ramps = [np.interp(time_s, knots, 2 + rng.random(len(knots))) for _ in range(3)]
    forces = np.stack(ramps, 1) + 0.01 * rng.standard_normal((num, 3))
    shaking = 0.4 * np.sin(2 * np.pi * 7 * time_s + 6 * rng.random())[:, None]
    band = _band_noise(rng, num, centre_hz) * strength * (0.6 + 0.8 * rng.random())
    acceleration = _NOISE * rng.standard_normal((num, 3)) + shaking + band * is_slip[:, None]
    for first in rng.integers(0, num - _KNOCK, 2):
        decay = np.exp(-np.arange(_KNOCK) / 8) * np.sin(2 * np.pi * 0.3 * np.arange(_KNOCK))
        acceleration[first : first + _KNOCK] += decay[:, None] * rng.uniform(1, 3, 3)
    return np.concatenate([forces, acceleration], 1), is_slip


def _band_noise(rng: np.random.Generator, num: int, centre_hz: float) -> NDArray[np.float64]:
    """Noise of variance one around a frequency, ``[T, 3]``."""
    spectrum = np.fft.rfft(rng.standard_normal((num, 3)), axis=0)
    distance = (np.fft.rfftfreq(num, 1 / RATE_HZ) - centre_hz) / (0.3 * centre_hz)
    noise = np.fft.irfft(spectrum * np.exp(-0.5 * distance**2)[:, None], num, axis=0)
    return np.asarray(noise / noise.std(0))


def write_recordings(
    folder: Path, trials: int = 6, seconds: float = 4.0, states: tuple[str, str] = STATES
) -> None:
    """Write ``OBJECT_TRIAL.csv`` for each object and trial, the folder made if it is not there."""
    for material in OBJECTS:
        for trial in range(1, trials + 1):
            samples, is_slip = recording(material, trial, seconds)
            write_csv(folder / f"{material}_{trial}.csv", samples, is_slip, states, seed=trial)


def write_quiet(folder: Path, minutes: float = 2.0, seconds: float = 30.0) -> None:
    """Write recordings in which objects are held, one behind the other, and nothing slips."""
    for trial in range(round(60 * minutes / seconds)):
        material = list(OBJECTS)[trial % len(OBJECTS)]
        samples, is_slip = recording(material, 100 + trial, seconds, slips=False)
        write_csv(folder / f"{material}_{100 + trial}.csv", samples, is_slip, seed=trial)


def write_csv(
    path: Path,
    samples: NDArray[np.float64],
    is_slip: NDArray[np.bool_],
    states: tuple[str, str] = STATES,
    *,
    seed: int = 0,
    dropped: int = 3,
    empty: int = 4,
) -> None:
    """Write a recording as its logger does.

    Args:
        path: of the file.
        samples: of its channels, ``[T, 6]``.
        is_slip: of each sample, ``[T]``.
        states: the words for what holds and what slips.
        seed: of what is lost.
        dropped: number of gaps, of up to eight rows each.
        empty: number of cells that are empty, one of them in the column of states.
    """
    rng = np.random.default_rng(seed)
    num = len(samples)
    kept = np.ones(num, dtype=bool)
    for first in rng.integers(num // 10, num - num // 10, dropped):
        kept[first : first + rng.integers(1, 9)] = False
    cells = [[f"{value:.4f}".replace(".", ",") for value in row] for row in samples]
    words = [states[int(slips)] for slips in is_slip]
    lost = rng.integers(0, num, empty)
    words[lost[0]] = ""
    for place in lost[1:]:
        cells[place][rng.integers(len(CHANNELS))] = ""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [";".join(["t_ms", *CHANNELS, "state"])]
    lines += [f"{n};{';'.join(cells[n])};{words[n]}" for n in np.flatnonzero(kept)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
