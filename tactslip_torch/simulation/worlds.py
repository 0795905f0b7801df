"""Recordings of many worlds: scenes drawn over ranges, with slips and with what is taken for them.

An alarm that is trained in one simulated world finds slips of that world. Here every recording has
a mounting, contact, noise and gain of its own, and confounders are drawn over the same ranges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.runtime import check_number, check_share
from tactslip_torch.simulation._blocks import generator, log_uniform
from tactslip_torch.simulation._contact import draw_grasp
from tactslip_torch.simulation._sensors import Handled
from tactslip_torch.simulation.scene import SEEN_MATERIALS, Scene, paper_scenes
from tactslip_torch.simulation.simulate import SimulatedRecordings

SLIP = "slip"
"""The kind of recordings with slips."""
_RANGES = {
    "load_n": (0.1, 3.0),
    "acceleration_m_s2": (0.1, 2.0),
    "texture_scale": (0.5, 1.5),
    "friction_noise_mv": (4.0, 12.0),
    "white_noise_mv": (0.5, 10.0),
    "mains_mv": (1.0, 10.0),
    "motor_vibration_mv": (1.0, 40.0),
    "arm_transient_mv": (10.0, 300.0),
    "burst_rate_hz": (0.05, 1.0),
    "burst_mv": (10.0, 200.0),
}
"""Of every recording; log-uniform, as are all below that are not said to be even."""
_SKIN_HZ, _SKIN_SPREAD = (20.0, 270.0), 1.5  # middle of the lowest element; the highest over it
_IMPERFECT = {"local_noise_mv": (0.3, 2.0), "pickup_mv": (0.1, 1.0)}
_SHARE_WANDER, _PARTIAL_SLIPS = 0.25, 0.3  # at most, drawn evenly
_GAIN, _GAIN_DRAWN = (0.1, 10.0), 0.6
_60_HZ, _ONE_BRISTLE, _NO_PULSE, _FADES, _HANDLED = 0.2, 0.2, 0.25, 0.5, 0.3  # of recordings
_PULSE_V, _FADE_S = (0.005, 0.5), (0.02, 0.3)
_SPEED_MM_S, _DISTANCE_MM, _NUM_SLIPS = (10.0, 80.0), 16.0, 3
_PAUSES_S = ((1.3, 1.8), (1.0, 1.6))  # of the first and of later slips, even
_MOST_DRAWS = 50
Rng = np.random.Generator


def _between(rng: Rng, low: float, high: float) -> float:
    return float(log_uniform(rng, (low, high)))


def _strokes_that_carry(rng: Rng, duration_s: float) -> list[dict[str, Any]]:
    """Of an arm that starts, carries or lifts, and stops, for about so long."""
    strokes, now_s = list[dict[str, Any]](), 0.0
    while now_s < duration_s:
        speed, distance = _between(rng, 10, 100), float(rng.uniform(10, 50))
        pause_s = float(rng.uniform(0.5, 1.2))
        strokes.append(
            {"speed_mm_s": speed, "distance_mm": distance, "pause_s": pause_s, "moves": "both"}
        )
        now_s += distance / speed + pause_s
    return strokes


CONFOUNDERS: Mapping[str, Callable[[Rng], dict[str, Any]]] = {
    "held": lambda rng: {"partial_slips_per_s": 0.0},
    "grips": lambda rng: {"grips_per_s": 0.8},
    "reflex_grips": lambda rng: {
        "grips_per_s": 0.8,
        "grip_share": (0.3, 4.0),
        "grip_s": (0.04, 0.25),
    },
    "loosened": lambda rng: {"loosenings_per_s": 0.8, "grip_s": (0.05, 1.0)},
    "taps": lambda rng: {"taps_per_s": 1.0, "tap_n": (0.2, 10.0), "tap_ms": (5.0, 60.0)},
    "knocks": lambda rng: {
        "burst_rate_hz": _between(rng, 0.5, 6),
        "burst_mv": _between(rng, 20, 500),
    },
    "machine": lambda rng: {"machine_mv": _between(rng, 3, 60), "machine_hz": (12.0, 200.0)},
    "mains_bursts": lambda rng: {
        "mains_bursts_per_s": 0.4,
        "mains_burst_mv": _between(rng, 20, 200),
    },
    "grips_knocked": lambda rng: {
        "grips_per_s": 0.8,
        "grip_share": (0.1, 2.0),
        "grip_s": (0.05, 1.0),
        "burst_rate_hz": 2.0,
        "burst_mv": _between(rng, 10, 200),
        "taps_per_s": 0.5,
        "tap_n": (0.2, 4.0),
    },
    "arm": lambda rng: {"carried_kg": _between(rng, 0.05, 1.0)},
    "lifted": lambda rng: {
        "carried_kg": _between(rng, 0.05, 0.5),
        "weight_share": float(rng.uniform(0.1, 0.85)),
        "lift_s": _between(rng, 0.01, 0.2),
    },
    "creeping_finger": lambda rng: {"partial_slips_per_s": float(rng.uniform(0.1, 0.5))},
}
"""Kinds of recordings without slip of the hand, and what is drawn of each beside the ranges.

In ``held`` no finger creeps, whether channels have imperfections or not: ``creeping_finger`` is the
kind of recordings where one does.
"""
_BESIDE_SLIPS = ("grips", "reflex_grips", "loosened", "taps", "knocks", "machine")


class WorldRecordings(SimulatedRecordings):
    """A ``RecordingSource`` of scenes drawn over ranges, each with a mounting of its own.

    The scene of a recording is its kind: ``"slip"``, or one of ``CONFOUNDERS``. What a seed draws
    of one kind does not depend on how many there are of others.

    Args:
        seed: of the whole set.
        purpose: sets of one seed for several purposes have nothing in common.
        slips: recordings with three slips each.
        confounders: recordings of each kind without slip; kinds that are not named have none.
        materials: ids in ``MATERIALS``, taken in turn.
        channels: rows for ``HandLayout.from_rows``; ``None`` for the paper's hand.
        tail_s: length of a recording without slip.
        imperfect: fraction of recordings with imperfections; in ``held`` these are of channels
            alone.
        bristles: fraction whose contact is of bristles; the others are kinematic.
        scene: what all recordings have in common, in place of what is drawn.

    Raises:
        ValueError: if a fraction or number is out of range, or there is no such kind.

    Example:
        >>> worlds = WorldRecordings(slips=1, confounders={"taps": 1}, materials=["M1", "M2"])
        >>> [str(recording) for recording in worlds.ids]
        ['M1/0/slip', 'M1/0/taps']
    """

    def __init__(
        self,
        *,
        seed: int = 0,
        purpose: str = "learn",
        slips: int = 0,
        confounders: Mapping[str, int] | None = None,
        materials: Iterable[str] = SEEN_MATERIALS,
        channels: Iterable[Mapping[str, str]] | None = None,
        tail_s: float = 11.0,
        imperfect: float = 0.4,
        bristles: float = 0.4,
        scene: Mapping[str, Any] | None = None,
    ) -> None:
        check_number("slips", slips, least=0, whole=True)
        check_number("tail_s", tail_s)
        for name, share in (("imperfect", imperfect), ("bristles", bristles)):
            if share not in (0, 1):
                check_share(name, share)
        super().__init__(seed=seed, materials=(), channels=channels)
        confounders = dict(confounders or {})
        if unknown := sorted(set(confounders) - set(CONFOUNDERS)):
            raise ValueError(
                f"no kind of recordings without slip is called {', '.join(unknown)}; there are "
                f"{', '.join(CONFOUNDERS)}"
            )
        self._seed, self._tail_s, self._fixed = seed, tail_s, dict(scene or {})
        self._purpose = purpose
        self._shares = imperfect, bristles
        materials = tuple(materials)
        for kind, num in ({SLIP: slips} | confounders).items():
            check_number(f"confounders.{kind}", num, least=0, whole=True)
            for number in range(num):
                of = materials[number % len(materials)]
                recording = RecordingId(of, number // len(materials), kind)
                self._scenes[recording] = self._drawn(of, kind, number)
        self.ids = tuple(self._scenes)

    def _drawn(self, material: str, kind: str, number: int) -> Scene:
        """The scene of a recording; drawn again where its contact cannot take what is asked for."""
        rng = generator(self._seed, "world", self._purpose, kind, number)
        session = f"{material}/{self._purpose}/{kind}/{number}"
        for _ in range(_MOST_DRAWS):
            values = self._common(rng)
            values |= self._with_slips(rng) if kind == SLIP else self._without(rng, kind)
            (scene,) = paper_scenes(
                seed=self._seed,
                cycles=1,
                materials=[material],
                hand=self.hand,
                **(values | self._fixed | {"name": kind, "session": session}),
            )
            try:
                Handled(scene, draw_grasp(scene))
            except ValueError:
                continue
            return scene
        raise ValueError(f"no scene of kind {kind} was found that its contact can take")

    def _common(self, rng: Rng) -> dict[str, Any]:
        imperfect, bristles = self._shares
        values: dict[str, Any] = {
            name: float(log_uniform(rng, bounds)) for name, bounds in _RANGES.items()
        }
        lowest_hz = float(log_uniform(rng, _SKIN_HZ))
        values["skin_resonance_hz"] = (lowest_hz, _SKIN_SPREAD * lowest_hz)
        fingers = list(dict.fromkeys(channel.finger for channel in self.hand.channels))
        num = int(rng.integers(min(2, len(fingers)), len(fingers) + 1))
        chosen = rng.permutation(fingers)[:num]
        if num < len(fingers):
            values["touching"] = [c.name for c in self.hand.channels if c.finger in chosen]
        if rng.random() < _60_HZ:
            values["mains_hz"] = 60.0
        if rng.random() < imperfect:
            values |= {name: float(log_uniform(rng, of)) for name, of in _IMPERFECT.items()}
            values["share_wander"] = float(rng.uniform(0, _SHARE_WANDER))
            values["gain_drift"] = 0.1
            values["partial_slips_per_s"] = float(rng.uniform(0, _PARTIAL_SLIPS))
        if rng.random() < bristles:
            values["fidelity"] = "bristles"
            values["num_bristles"] = 1 if rng.random() < _ONE_BRISTLE else 24
        else:
            is_silent = rng.random() < _NO_PULSE
            values["onset_pulse_v"] = 0.0 if is_silent else float(log_uniform(rng, _PULSE_V))
            if rng.random() < _FADES:
                values["slide_rise_s"] = values["recoil_s"] = float(log_uniform(rng, _FADE_S))
        if rng.random() < _GAIN_DRAWN:
            values["gain"] = float(log_uniform(rng, _GAIN))
        return values

    def _with_slips(self, rng: Rng) -> dict[str, Any]:
        moves = "hand" if rng.random() < 0.5 else "object"
        strokes = [
            {
                "speed_mm_s": float(log_uniform(rng, _SPEED_MM_S)),
                "distance_mm": _DISTANCE_MM,
                "pause_s": float(rng.uniform(*_PAUSES_S[min(number, 1)])),
                "moves": moves,
            }
            for number in range(_NUM_SLIPS)
        ]
        values: dict[str, Any] = {"strokes": strokes, "tail_s": 0.3}
        if rng.random() < _HANDLED:
            values |= CONFOUNDERS[_BESIDE_SLIPS[int(rng.integers(len(_BESIDE_SLIPS)))]](rng)
        return values

    def _without(self, rng: Rng, kind: str) -> dict[str, Any]:
        values = {"strokes": [], "tail_s": self._tail_s} | CONFOUNDERS[kind](rng)
        if kind in ("arm", "lifted"):
            values |= {"strokes": _strokes_that_carry(rng, self._tail_s), "tail_s": 0.5}
            values["acceleration_m_s2"] = _between(rng, 0.2, 3)
        return values
