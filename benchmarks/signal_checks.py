"""Checks that recordings look like the paper's.

The paper shows and describes its signals. Each ``SignalCheck`` is one sentence of that: a statistic
of filtered recordings and the range it must lie in. ``check_signals`` takes recordings of any
origin; the tests check the simulated ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.wavelet import wavelet_branches

Array = NDArray[np.float64]

FRAMES = {"SG": 51, "PVDF": 11}
"""The paper's Savitzky-Golay frames, samples."""

ALL = ("M1", "M2", "M3", "M4", "M5", "M6")
SUSTAINED = ("M1", "M6")
"""Materials that vibrate throughout a slide."""

QUIET = ("M2", "M3", "M4", "M5")
"""Materials that are quiet once they slide."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Filtered samples of one recording, and where its parts are.

    Shape:
        - sg: ``[S, T]``, volts
        - pvdf: ``[P, T]``, volts
    """

    sg: Array
    pvdf: Array
    sample_rate_hz: float
    onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]

    def part(self, samples: Array, start_s: float, end_s: float) -> Array:
        """A stretch of ``sg`` or ``pvdf``."""
        return samples[:, round(start_s * self.sample_rate_hz) : round(end_s * self.sample_rate_hz)]

    def slide(self, samples: Array, stroke: int) -> Array:
        """The second half of a slide, away from the onset."""
        start_s, end_s = self.sliding_s[stroke]
        return self.part(samples, 0.5 * (start_s + end_s), end_s - 0.05)

    def rest(self, samples: Array, stroke: int = 0) -> Array:
        """From 1.2 to .3 s before an onset: before stretching, after the last stop's ringing.

        Raises:
            ValueError: if the recording begins later than that.
        """
        onset_s = self.onsets_s[stroke]
        if onset_s < 1.2:
            raise ValueError(
                f"checks need 1.2 s of rest before each onset, onset {stroke + 1} is at "
                f"{onset_s:.3f} s; record or simulate a longer pause before the stroke"
            )
        return self.part(samples, onset_s - 1.2, onset_s - 0.3)


Statistic = Callable[[Sequence[Signals]], float]


def filtered(recording: Recording, hand: HandLayout) -> Signals:
    """A recording of the paper's three strokes behind the paper's filter.

    Raises:
        ValueError: if the hand has no SG or no PVDF, or there are fewer than three strokes.
    """
    kinds = [channel.kind for channel in hand.channels]
    if not {"SG", "PVDF"} <= set(kinds):
        raise ValueError(
            f"signal checks need SG and PVDF channels, the hand has {sorted(set(kinds))}"
        )
    if len(recording.onsets_s) < 3:
        raise ValueError(f"checks need three strokes, got {len(recording.onsets_s)}")
    channel_filter = ChannelFilter([FRAMES[kind] for kind in kinds])
    samples = channel_filter(recording.samples.double())
    rows = {kind: [row for row, own in enumerate(kinds) if own == kind] for kind in FRAMES}
    return Signals(
        samples[rows["SG"]].numpy(),
        samples[rows["PVDF"]].numpy(),
        recording.sample_rate_hz,
        recording.onsets_s,
        recording.sliding_s,
    )


def rms(samples: Array) -> Array:
    """Root mean square about the mean of each row, ``[C, T] -> [C]``."""
    power: Array = np.mean((samples - samples.mean(-1, keepdims=True)) ** 2, -1)
    return np.sqrt(power)


# --- statistics: recordings of one material -> number -------------------------------------------


def _sg_offset_spread(seen: Sequence[Signals]) -> float:
    """Spread of the SGs' levels before the first onset, over how much one SG varies there."""
    rests = [s.rest(s.sg) for s in seen]
    return float(np.median([np.std(rest.mean(-1)) / np.median(rms(rest)) for rest in rests]))


def _sg_rise_v(seen: Sequence[Signals]) -> float:
    """How much the SGs' mean level rises from before the first onset to its slide."""
    return float(
        np.mean([(s.slide(s.sg, 0).mean(-1) - s.rest(s.sg).mean(-1)).mean() for s in seen])
    )


def sg_variation(seen: Sequence[Signals]) -> float:
    """SG variation in sliding over that at rest."""
    ratio = [rms(s.slide(s.sg, 1)) / rms(s.rest(s.sg)) for s in seen]
    return float(np.median(np.concatenate(ratio)))


def _pvdf_onset_burst(seen: Sequence[Signals]) -> float:
    """PVDF vibration in the 60 ms around an onset over that later in the slide."""
    ratio = [
        rms(s.part(s.pvdf, onset_s - 0.02, onset_s + 0.04)) / rms(s.slide(s.pvdf, stroke))
        for s in seen
        for stroke, onset_s in enumerate(s.onsets_s)
    ]
    return float(np.median(np.concatenate(ratio)))


def pvdf_slide_over_rest(seen: Sequence[Signals]) -> float:
    """PVDF vibration while sliding at 40 mm/s over that before the first onset."""
    ratio = [rms(s.slide(s.pvdf, 1)) / rms(s.rest(s.pvdf)) for s in seen]
    return float(np.median(np.concatenate(ratio)))


def pvdf_speed_growth(seen: Sequence[Signals]) -> float:
    """The smaller of the growths of PVDF vibration from 20 to 40 and from 40 to 60 mm/s."""
    level = [np.median([rms(s.slide(s.pvdf, k)) for s in seen], axis=0) for k in range(3)]
    return float(min(np.median(level[1] / level[0]), np.median(level[2] / level[1])))


def _num_barely_responding(seen: Sequence[Signals]) -> float:
    """PVDF channels a recording in which the onset is hardly visible."""
    ratio = [
        rms(s.part(s.pvdf, s.onsets_s[1] - 0.05, s.onsets_s[1] + 0.1)) / rms(s.rest(s.pvdf, 1))
        for s in seen
    ]
    return float(np.mean([np.sum(r < 4.0) for r in ratio]))


def _d1_fraction(seen: Sequence[Signals]) -> float:
    """Power of the branch D1 over the vibration's, while sliding."""
    shares = []
    for s in seen:
        slide = s.slide(s.pvdf, 1)
        detail = wavelet_branches(torch.from_numpy(slide), level=1)[:, 1].numpy()
        shares.append(np.sum(detail**2, -1) / np.sum((slide - slide.mean(-1)[:, None]) ** 2, -1))
    return float(np.median(np.concatenate(shares)))


# --- checks: statistics with the range they must lie in ------------------------------------------


@dataclass(frozen=True)
class SignalCheck:
    """A statement about recordings that holds or does not.

    Args:
        name: of the check.
        says: what the paper shows or says.
        statistic: of the recordings of one material, or of several together.
        materials: to check one by one; all at once if ``pooled``.
        low: below every value.
        high: above every value.
        over: compare the least value of ``materials`` with the largest of these.
        pooled: whether the recordings of all ``materials`` are checked as one set.
    """

    name: str
    says: str
    statistic: Statistic
    materials: tuple[str, ...]
    low: float
    high: float = math.inf
    over: tuple[str, ...] = ()
    pooled: bool = False

    def values(self, recordings: Mapping[str, Sequence[Signals]]) -> dict[str, float]:
        """The statistic by material, or of a group of them; only of materials that are there."""
        own = [material for material in self.materials if material in recordings]
        others = [material for material in self.over if material in recordings]
        if self.pooled:
            together = [signals for material in own for signals in recordings[material]]
            return {", ".join(own): self.statistic(together)} if own else {}
        if not self.over:
            return {material: self.statistic(recordings[material]) for material in own}
        if not (own and others):
            return {}
        least = min(self.statistic(recordings[material]) for material in own)
        largest = max(self.statistic(recordings[material]) for material in others)
        return {f"{', '.join(own)} over {', '.join(others)}": least / largest}

    def allows(self, value: float) -> bool:
        """Whether a value lies in the range."""
        return self.low < value < self.high


SIGNAL_CHECKS = (
    SignalCheck("sg_offset", "SGs stand at offsets before onset", _sg_offset_spread, ALL, 30.0),
    SignalCheck("sg_rise", "SG levels rise with sliding", _sg_rise_v, ALL, 0.02, 1.0),
    SignalCheck("sg_variation", "SGs vary more in sliding than at rest", sg_variation, ALL, 1.3),
    SignalCheck(
        "pvdf_abrupt",
        "PVDF is abrupt at onset, then quiet for M2 to M5",
        _pvdf_onset_burst,
        QUIET,
        2.5,
    ),
    SignalCheck(
        "pvdf_abrupt_contrast",
        "M2 to M5 fall off behind the onset, M1 and M6 do not",
        _pvdf_onset_burst,
        QUIET,
        1.5,
        over=SUSTAINED,
    ),
    SignalCheck(
        "pvdf_slide_over_rest",
        "every material is louder in sliding than at rest",
        pvdf_slide_over_rest,
        ALL,
        1.5,
    ),
    SignalCheck(
        "pvdf_sustained",
        "PVDF vibrates throughout the slide for M1 and M6",
        pvdf_slide_over_rest,
        SUSTAINED,
        8.0,
    ),
    SignalCheck("speed", "amplitude grows with speed", pvdf_speed_growth, ALL, 1.05, 3.0),
    SignalCheck(
        "barely",
        "a few channels barely respond",
        _num_barely_responding,
        QUIET,
        0.3,
        4.0,
        pooled=True,
    ),
    SignalCheck("d1", "D1 is nearly empty behind the filter", _d1_fraction, ALL, 0.0, 0.02),
)
"""What the paper shows and says of its signals, and that every material vibrates."""


def check_signals(recordings: Mapping[str, Sequence[Signals]]) -> list[dict[str, Any]]:
    """Every check that the materials at hand can show, JSON-able.

    Args:
        recordings: by material, some of each.

    Returns:
        For each check ``name``, ``says``, ``low``, ``high`` (``None``: unbounded), ``values`` and
        ``holds``.
    """
    results = []
    for check in SIGNAL_CHECKS:
        values = check.values(recordings)
        if not values:
            continue
        results.append(
            {
                "name": check.name,
                "says": check.says,
                "low": check.low,
                "high": check.high if math.isfinite(check.high) else None,
                "values": values,
                "holds": all(map(check.allows, values.values())),
            }
        )
    return results
