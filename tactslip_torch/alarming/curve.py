"""What other thresholds would give: false alarms an hour, for a host that lets its user choose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from tactslip_torch.alarming.watching import Clock, Stream, decide
from tactslip_torch.onset.rate import rate_curve
from tactslip_torch.onset.settings import AlarmSettings

LEAST, MOST = 0.1, 1000.0
"""False alarms an hour that are of interest."""

_NUM_POINTS = 25
_NUM_TRIED = 100


def threshold_curve(
    quiet: Sequence[Stream], scorer: str, settings: AlarmSettings, clock: Clock
) -> list[list[float]]:
    """Thresholds and the false alarms an hour at each, of the rule as it stands in the settings.

    Rates fall as thresholds rise; from ``LEAST`` to ``MOST`` an hour, at most 25 points that are
    about equally far apart by the rate's logarithm. Fewer where the recordings show no more: none
    is below one alarm in all of them.

    Args:
        quiet: recordings in which nothing slips.
        scorer: whose scores.
        settings: calibration, rule, re-arming; their threshold does not count.
        clock: of the scores.
    """
    statistics = [made.statistic for _, made in decide(quiet, scorer, settings, clock)]
    falling = torch.cat(statistics).sort(descending=True).values
    ranks = np.unique(np.geomspace(1, len(falling), _NUM_TRIED).astype(int)) - 1
    found = list[list[float]]()
    for value in dict.fromkeys(falling[ranks].tolist()):
        rate = float(
            rate_curve(
                statistics,
                settings.rule,
                clock.hop_s,
                [value],
                rearm=settings.decisions(settings.rearm_s, clock.sample_rate_hz),
                refractory=settings.decisions(settings.refractory_s, clock.sample_rate_hz),
            )[0]
        )
        if rate > MOST:
            break
        if rate >= LEAST and (not found or rate > found[-1][1]):
            found.append([value, rate])
    return _thinned(found)[::-1]


def _thinned(points: list[list[float]]) -> list[list[float]]:
    """Those next to evenly spaced logarithms of the rate."""
    if len(points) <= _NUM_POINTS:
        return points
    rates = np.log([rate for _, rate in points])
    wanted = np.linspace(rates[0], rates[-1], _NUM_POINTS)
    nearest = np.abs(rates - wanted[:, None]).argmin(axis=1)
    return [points[place] for place in np.unique(nearest)]
