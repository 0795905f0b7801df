"""Whether stated false-alarm rates hold: ``python -m benchmarks.stated_rates [KEY=VALUE ...]``.

Of 50 h of decisions without slip sets of segments are drawn at random; each sets the threshold of
an alarm for a rate, as ``tactslip calibrate`` does, and the rate is counted in all other segments.
Decisions are noise and disturbances that come in bunches; beside the bound with the dispersion of
counts stands that of a Poisson process. Decisions are drawn, no sensor is simulated. Puts its table
into docs/onset.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.harness import Benchmark, Job, say
from benchmarks.tables import Table
from tactslip_torch import AlarmSettings
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.training.alarm import Stream, Timing
from tactslip_torch.training.calibrate import Calibrator, ScoredRecording, in_stretches

_TIMING = Timing(1000.0, 500, 1000, 0)
"""A decision every half second."""
_STRETCH_H = 0.1
_SESSION_H = 0.5


class Process(NamedTuple):
    """How disturbances come.

    Attributes:
        bunches_per_hour: on average.
        size: disturbances of a bunch, on average; geometric.
        spacing_s: between two of a bunch, on average.
        sessions: variance of the rate of bunches between sessions of half an hour, by its square.
    """

    bunches_per_hour: float
    size: float
    spacing_s: float
    sessions: float = 0.0


PROCESSES = {
    "one by one": Process(60, 1, 8),
    "bunches of 2.5 within seconds": Process(30, 2.5, 8),
    "bunches of 2.5 within minutes": Process(30, 2.5, 40),
    "bunches of 5 within seconds": Process(80, 5, 8),
    "sessions differ": Process(60, 1.5, 8, 0.5),
}


@dataclass(frozen=True)
class StatedRates(Benchmark):
    """Every process and number of hours.

    Args:
        hours: of decisions.
        hours_of_set: of each calibration set; other values are other rows.
        per_hour: rate that is to hold.
        sets: drawn, of each.
    """

    title = "Stated false-alarm rates"
    about = "in how many of the calibration sets the stated rate holds in the other hours"
    page, markers, has_headings = "docs/onset.md", "stated_rates", False
    quick = "hours=10 hours_of_set=[3] sets=3"
    charts: ClassVar = {"": [("Stated rates", ("holds",))]}
    hours: float = 50.0
    hours_of_set: tuple[float, ...] = (8.0,)
    per_hour: float = 10.0
    sets: int = 200

    def measure(self, job: Job) -> dict[str, Any]:
        """A row for each process and size of the sets."""
        rows = []
        for seed, (name, process) in enumerate(PROCESSES.items()):
            made = Calibrator(_settings(), _TIMING, LabelRule(bin_ms=1000.0), self.per_hour)
            whole = _stream(np.random.default_rng(seed), process, self.hours)
            stretches = in_stretches(whole, _TIMING, round(self.hours / _STRETCH_H))
            scored = [made.scored(stretch) for stretch in stretches]
            for hours in self.hours_of_set:
                say(f"{name}, {hours:g} h")
                rows.append({"false alarms": name, "set": f"{hours:g} h"})
                rows[-1] |= self._row(made, scored, round(hours / _STRETCH_H))
        note = (
            f"{self.sets} sets of segments of {60 * _STRETCH_H:g} min, drawn from {self.hours:g} "
            f"h. Stated: at most {self.per_hour:g} false alarms an hour, with a confidence of "
            "0.95. *Holds*: sets for which the rate in the other hours was at most that. *Without "
            "dispersion*: the same, if the bound takes the alarms as independent. *Dispersion*: "
            "the median. *Refused*: sets with too few hours for such bunches; they are not counted "
            "in *holds*. *Counted / stated*: the rate in the other hours divided by the stated "
            "rate, median."
        )
        return {"tables": {"Stated rates": Table(rows, note)}}

    def _row(self, made: Calibrator, scored: Sequence[ScoredRecording], num: int) -> dict[str, str]:
        rng = np.random.default_rng(0)
        rates: dict[bool, list[float]] = {True: [], False: []}
        dispersions = []
        for _ in range(self.sets):
            order = rng.permutation(len(scored)).tolist()
            own, rest = ([scored[i] for i in part] for part in (order[:num], order[num:]))
            dispersions.append(made.dispersion(own))
            for sees_bunches, found in rates.items():
                budget = made.budget(dispersions[-1] if sees_bunches else 1.0)
                hours = sum(one.hours for one in own)
                if budget.bound(0, hours) > self.per_hour:
                    continue
                alarm = made.fit(own, budget).alarm
                alarms = sum(len(one.alarms.alarms(alarm, 1000.0)[0]) for one in rest)
                found.append(alarms / sum(one.hours for one in rest))
        seen, single = rates[True], rates[False]
        return {
            "holds %": _held(seen, self.per_hour),
            "holds % without dispersion": _held(single, self.per_hour),
            "dispersion": f"{median(dispersions):.1f}",
            "refused": f"{self.sets - len(seen)}",
            "counted / stated": f"{median(seen) / self.per_hour:.2f}" if seen else "-",
        }


def _held(rates: Sequence[float], limit: float) -> str:
    share = sum(rate <= limit for rate in rates) / len(rates) if rates else None
    return "-" if share is None else f"{100 * share:.1f}"


def _settings() -> AlarmSettings:
    calibration = Platt(1.0, 0.0)
    return AlarmSettings(500, calibration, KOfN(1, 1), 0.0, None, rearm_s=1.0, refractory_s=1.0)


def _stream(rng: np.random.Generator, process: Process, hours: float) -> Stream:
    """Decisions without slip: noise, and disturbances in bunches of like height."""
    score = torch.from_numpy(_scores(rng, process, hours)).float()
    duration_s = (len(score) + 1) * _TIMING.hop_s
    times = Timeline(non_slip_s=((0.0, duration_s),), duration_s=duration_s)
    none = torch.empty(0, dtype=torch.float64)
    return Stream(RecordingId("drawn", 0), times, score, score.isfinite(), none)


def _scores(rng: np.random.Generator, process: Process, hours: float) -> NDArray[np.float64]:
    num = round(hours * 3600 / _TIMING.hop_s)
    score = rng.normal(-4.0, 0.5, num)
    for session in range(round(hours / _SESSION_H)):
        spread = process.sessions
        factor = rng.gamma(1 / spread, spread) if spread else 1.0
        for _ in range(rng.poisson(factor * process.bunches_per_hour * _SESSION_H)):
            at = (session + rng.random()) * num * _SESSION_H / hours
            height = rng.exponential(2.0)
            for _ in range(rng.geometric(1 / process.size)):
                if at < num:
                    score[int(at)] = max(score[int(at)], height + rng.normal(0.0, 0.3))
                at += (2.0 + rng.exponential(process.spacing_s)) / _TIMING.hop_s
    return score


if __name__ == "__main__":
    raise SystemExit(StatedRates().run())
