"""The alarm of ``+exp=onset`` in many worlds: ``python -m benchmarks.alarms [key=value ...]``.

Fewer seeds or slips: ``sizes.seeds=[0] sizes.sessions=2``.

Fits the classifier on the mixture of each seed and sets its threshold, as ``+exp=onset`` does, for
the detector that comes with the package. Then slips of held-out materials, in worlds of which some
lie at the end of what was trained on: found within 250 ms of the first release, early, and how
late; beside it hints, and with the first seed the detector of bins and the largest wavelet detail
under the same budgets. Then false alarms of held-out materials by kind of recording. All data are
simulated. What a seed gave is kept, so a run that was stopped resumes. Puts its tables into
docs/onset.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar

import numpy as np
from hydra.utils import instantiate

from benchmarks.harness import Benchmark, Job
from benchmarks.tables import Report, Table, by, percent
from benchmarks.trainings import composed, resumed, say
from tactslip_torch import AlarmSettings, SlipDetector
from tactslip_torch.hand import HandLayout
from tactslip_torch.onset.baselines import BaselineDetector, BaselineName
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.onset.events import first_releases
from tactslip_torch.onset.rules import Budget, Cusum
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.simulation.worlds import CONFOUNDERS, SLIP
from tactslip_torch.training.alarm import (
    OURS,
    SLIPPING_NOW,
    Stream,
    Timing,
    decide,
    score_streams,
)

SOURCES = ("tactslip_torch/pretrained/paper24-sim.pt",)
FOUND_S, EARLY_S, HINT_S = 0.25, 0.2, 0.1
"""Of the first release: an alarm until then finds a slip, before it is early; a hint is in time."""
HINT, BINS = "hint", "bins"
DETAIL: BaselineName = "largest_detail"


def _pulled(*speeds_mm_s: float, moves: str = "object", distance_mm: float = 16.0) -> Any:
    pauses_s = (1.6, 1.2, 1.2)
    strokes = [
        {"speed_mm_s": v, "distance_mm": distance_mm, "pause_s": pause, "moves": moves}
        for v, pause in zip(speeds_mm_s, pauses_s, strict=True)
    ]
    return {"strokes": strokes, "tail_s": 0.3}


_PULLED, _BY_ARM = _pulled(20.0, 40.0, 60.0), _pulled(20.0, 40.0, 60.0, moves="hand")
_BRISTLES, _SILENT = {"fidelity": "bristles"}, {"onset_pulse_v": 0.0}
_PINCH = {
    "touching": [c.name for c in HandLayout.paper24().channels if c.finger in ("index", "thumb")]
}
WORLDS: Mapping[str, Mapping[str, Any]] = {
    "pulled": _PULLED,
    "by the arm": _BY_ARM,
    "stiff skin": _PULLED | {"skin_resonance_hz": (200.0, 400.0)},
    "gain a tenth": _PULLED | {"gain": 0.1},
    "gain tenfold": _PULLED | {"gain": 10.0},
    "motor 20 mV": _BY_ARM | {"motor_vibration_mv": 20.0},
    "white noise 10 mV": _PULLED | {"white_noise_mv": 10.0},
    "no pulse": _PULLED | _SILENT,
    "load .3 N": _PULLED | {"load_n": 0.3},
    "between reflex grips": _PULLED
    | {"grips_per_s": 0.8, "grip_share": (0.3, 4.0), "grip_s": (0.04, 0.25)},
    "bristles, pulled": _PULLED | _BRISTLES,
    "bristles, by the arm": _BY_ARM | _BRISTLES,
    "creep .2 s": _PULLED | _SILENT | {"recoil_s": 0.2, "slide_rise_s": 0.2},
    "load .1 N": _PULLED | {"load_n": 0.1},
    "load .3 N, bristles": _PULLED | _BRISTLES | {"load_n": 0.3},
    "quiet material, no pulse": _PULLED
    | _SILENT
    | {"friction_noise_mv": 2.0, "texture_scale": 0.25},
    "pinch": _PULLED | _PINCH,
    "pinch, bristles": _PULLED | _BRISTLES | _PINCH,
    "hard": _PULLED
    | {
        "local_noise_mv": 2.0,
        "share_wander": 0.25,
        "gain_drift": 0.1,
        "pickup_mv": 0.5,
        "partial_slips_per_s": 0.3,
    },
    "1 mm/s, no pulse": _pulled(1.0, 1.0, 1.0, distance_mm=3.0)
    | _SILENT
    | {"presliding_mm": (0.3, 1.0)},
    "pulled at .1 m/s2": _PULLED | {"acceleration_m_s2": 0.1},
}
"""Slips, by what is changed of the protocol; each recording has three."""
OVERRIDES = (
    "onset.hop_ms=50",
    "onset.classifier.head=network",
    "onset.confidence=0.5",
    "onset.streams.slips=60",
    "onset.streams.confounders.held=600",
    *(f"onset.streams.confounders.{kind}=60" for kind in CONFOUNDERS if kind != "held"),
    "onset.hours={held:1.5,slip:0.06,others:0.15}",
    "onset.check_hours={held:2,slip:0.05,others:0.2}",
)
"""Of ``+exp=onset``: fewer hours than by default set the threshold, so at the point estimate."""
QUICK = '","'.join(
    (
        "num_workers=0",
        "data.materials=[M1,M6,iron]",
        "split.seen=[M1,M6]",
        "split.unseen=[iron]",
        "onset.classifier.epochs=1",
        "onset.classifier.head=quadratic",
        "onset.worlds.slips=4",
        "~onset.worlds.confounders",
        "+onset.worlds.confounders={held:2,taps:2}",
        "onset.worlds.tail_s=4",
        "onset.hop_ms=50",
        "onset.streams.slips=4",
        "~onset.streams.confounders",
        "+onset.streams.confounders={held:4,taps:4}",
        "onset.streams.tail_s=4",
        "onset.hours={held:0.002,slip:0.002,others:0.002}",
        "onset.check_hours={others:0.001}",
        "onset.budget={held:3000,confounders:3000}",
    )
)


@dataclass(frozen=True)
class Alarms(Benchmark):
    """Every seed, fitted and evaluated.

    Args:
        seeds: of mixtures, weights, mountings and recordings that set thresholds.
        overrides: of ``tactslip_torch.train +exp=onset``, of which ``onset`` is taken: so many
            hours set thresholds and are checked.
        worlds: names of ``WORLDS``.
        sessions: mountings of each material and world, each with three slips.
    """

    title = "The alarm in many worlds"
    about = "alarms of +exp=onset within the default budget, on recordings that set nothing"
    page, markers, has_headings = "docs/onset.md", "onset", False
    quick = f'seeds=[0] overrides=["{QUICK}"] worlds=["pulled","pinch"] sessions=1'
    charts: ClassVar = {
        "": [
            ("Slips found", ("found", "bins", "detail")),
            ("Slips found", ("median", "p95")),
            ("False alarms", ("alarm",)),
        ]
    }
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    overrides: tuple[str, ...] = OVERRIDES
    worlds: tuple[str, ...] = tuple(WORLDS)
    sessions: int = 4

    def measure(self, job: Job) -> dict[str, Any]:
        """Slips in every world and false alarms of every kind, seeds together."""
        slips, budgets, heads = list[dict[str, Any]](), list[list[Any]](), list[str]()
        for seed in self.seeds:
            given = ["+exp=onset", f"seed={seed}", *self.overrides, *job.overrides]
            folder, has_detail = job.folder / f"seed-{seed}", seed == self.seeds[0]
            made_by = [*given, f"detail={has_detail}"]
            of_worlds = [*made_by, *self.worlds, f"sessions={self.sessions}"]
            say(f"the alarm of seed {seed}")
            fit = partial(_fitted, given, folder / "detector.pt", has_detail)
            alarm = resumed(folder / "alarm.json", made_by, fit)
            say(f"{len(self.worlds)} worlds of seed {seed}")
            detector = SlipDetector.load(folder / "detector.pt")
            run = partial(_slips, detector, alarm, self, seed)
            slips += resumed(folder / "worlds.json", of_worlds, run)
            budgets.append(alarm["budget"])
            amounts = alarm["streams"]["calibrate"]
            heads.append(alarm["classifier"]["head"])
        rows = [_world_row(world, own) for (world,), own in by(slips, "world").items()]
        rows.sort(key=itemgetter("found %"))
        return {
            "tables": {
                "Slips found": Table(
                    rows,
                    "Within 250 ms of the first release, in % of all seeds; *lowest*: of the seed "
                    "that found least. *Early*: an alarm that stood or was raised up to 200 ms "
                    "before it. *Hint*: within 100 ms. *Bins*: the detector of bins behind its "
                    "rule, *detail*: the largest wavelet detail of a fast channel, under the same "
                    f"budgets; detail of seed {self.seeds[0]} alone. Heads: {', '.join(heads)}.",
                ),
                "False alarms": Table(
                    _alarm_rows(budgets),
                    "An hour, of materials that were held out, with 95 % intervals; all seeds "
                    "together. *confounders*: all kinds below it. Thresholds of each seed are "
                    f"those of {_hours(amounts)} of other materials, at the point estimate.",
                ),
            }
        }

    def section(self, report: Report) -> str:
        """The tables, and their figure."""
        figure = "![Slips found, delays and false alarms](../benchmarks/results/alarms.png)"
        return f"{super().section(report)}\n\n{figure}"


def _fitted(given: Sequence[str], path: Path, has_detail: bool) -> dict[str, Any]:
    """What came of setting the alarm of the detector that comes with the package; kept there."""
    config, detector = composed("train", given), SlipDetector.pretrained()
    scorers = _scorers(detector, has_detail)
    others = {name: scorer for name, scorer in scorers.items() if name != OURS}
    set_alarm = instantiate(config.onset, _convert_="all")
    roles = set_alarm.roles(detector)
    set_alarm.streams.ids = (*roles["calibrate"], *roles["unseen"])  # none checks seen materials
    found: dict[str, Any] = set_alarm(detector, others, num_workers=config.num_workers)
    path.parent.mkdir(parents=True, exist_ok=True)
    detector.save(path)
    return found


def _hours(amounts: Mapping[str, Mapping[str, float]]) -> str:
    """Of what sets thresholds."""
    hours = {kind: own["hours"] for kind, own in amounts.items()}
    held = hours.pop("held")
    others = sum(h for kind, h in hours.items() if kind != SLIP)
    return f"{held:.1f} h held and {others:.1f} h of confounders"


def _scorers(detector: SlipDetector, has_detail: bool) -> dict[str, Scorer]:
    if not has_detail:
        return {OURS: detector}
    return {
        OURS: detector,
        DETAIL: BaselineDetector(DETAIL, detector.pool, detector.channel_filter),
    }


def _slips(
    detector: SlipDetector, alarm: Mapping[str, Any], sizes: Alarms, seed: int
) -> list[dict[str, Any]]:
    """What became of each slip of held-out materials, by world and method."""
    ours, pool = AlarmSettings.of(detector), detector.pool
    assert ours.onset is not None
    scorers, rate = _scorers(detector, seed == sizes.seeds[0]), pool.sample_rate_hz
    methods = {
        SLIPPING_NOW: (OURS, ours),
        HINT: (OURS, ours.at_threshold(ours.onset.hint)),
    }
    for name, label in {ours.rule.name: BINS, DETAIL: DETAIL}.items():
        if made := alarm["methods"].get(name):
            plain = {field.name: made[field.name] for field in fields(AlarmSettings)}
            settings = AlarmSettings.from_dict(plain | {"onset": None}, pool.hand, rate)
            methods[label] = made["scorer"], settings
    hops = dict.fromkeys(scorers, ours.hop_samples)
    timings = {
        name: Timing(rate, hops[name], pool.bin_samples, scorer.look_ahead)
        for name, scorer in scorers.items()
    }
    rows = list[dict[str, Any]]()
    for world in sizes.worlds:
        source = SimulatedRecordings(
            seed=1000 + seed,
            cycles=1,
            sessions=sizes.sessions,
            materials=alarm["held_out"],
            scene=WORLDS[world],
        )
        streams = score_streams(source, source.ids, scorers, hops, ours.onset)
        found = {
            name: [
                delay
                for stream, made in decide(streams[scorer], own, timings[scorer])
                for delay in _delays(stream, made)
            ]
            for name, (scorer, own) in methods.items()
        }
        rows.append({"world": world, "seed": seed, **found})
    return rows


def _delays(stream: Stream, made: Any) -> list[float | str]:
    """Seconds from the first release of each slip to its alarm, or ``early``, or ``missed``."""
    times, time_s = stream.times, made.available_s.numpy()
    raised, is_on = time_s[made.is_alarm.numpy()], made.is_on.numpy()
    outcomes = list[float | str]()
    for first_s in first_releases(times.onsets_s, times.released_s):
        if is_on[(time_s > first_s - EARLY_S) & (time_s <= first_s)].any():
            outcomes.append("early")
            continue
        own = raised[(raised > first_s) & (raised <= first_s + FOUND_S)]
        outcomes.append(float(own[0] - first_s) if len(own) else "missed")
    return outcomes


def _world_row(world: str, by_seed: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    def share(name: str, within_s: float = FOUND_S) -> list[float]:
        return [
            fmean(not isinstance(delay, str) and delay <= within_s for delay in of[name])
            for of in by_seed
            if name in of
        ]

    every = [delay for of in by_seed for delay in of[SLIPPING_NOW]]
    delays_ms = 1e3 * np.array([delay for delay in every if not isinstance(delay, str)])
    median, p95 = np.quantile(delays_ms, (0.5, 0.95)) if len(delays_ms) else (np.nan, np.nan)
    hints = [delay for of in by_seed for delay in of[HINT]]
    return {
        "world": world,
        "found %": round(100 * fmean(share(SLIPPING_NOW)), 1),
        "lowest %": round(100 * min(share(SLIPPING_NOW)), 1),
        "early %": percent(fmean(delay == "early" for delay in every)),
        "median ms": f"{median:.0f}",
        "p95 ms": f"{p95:.0f}",
        "hint %": percent(fmean(share(HINT, HINT_S))),
        "early hints %": percent(fmean(delay == "early" for delay in hints)),
        "bins %": percent(fmean(share(BINS))),
        "detail %": percent(fmean(share(DETAIL))) if share(DETAIL) else "-",
        "slips": len(every),
    }


def _alarm_rows(by_seed: Iterable[Sequence[Any]]) -> list[dict[str, Any]]:
    """A row for each kind: rates of the alarm, of bins and of detail, all seeds together."""
    every = [row for budget in by_seed for row in budget if row["role"] == "unseen"]
    rows = []
    for (scene,), own in by(every, "scene").items():
        limit = own[0]["limit"]
        row = {"kind": scene.replace("_", " ")}
        for method, column in {SLIPPING_NOW: "alarm", Cusum.name: BINS, DETAIL: "detail"}.items():
            of = [one for one in own if one["method"] == method]
            alarms, hours = sum(one["alarms"] for one in of), sum(one["amount"] for one in of)
            if not of:
                continue
            low, high = Budget(scene, 1.0).interval(alarms, hours)
            row |= {column: f"{alarms / hours:.2f} [{low:.2f}, {high:.2f}]"}
            if method == SLIPPING_NOW:
                row |= {"budget": "-" if limit is None else f"{limit:g} /h", "of": f"{hours:.2f} h"}
        rows.append(row)
    return rows


if __name__ == "__main__":
    raise SystemExit(Alarms().run())
