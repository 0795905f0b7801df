"""The alarm of ``+exp=onset`` in many worlds: ``python -m benchmarks.alarms [key=value ...]``.

Fewer seeds or slips: ``sizes.seeds=[0] sizes.sessions=2``.

Fits the classifier on the mixture of each seed and sets its threshold, as ``+exp=onset`` does, for
the detector that comes with the package. Then slips of held-out materials, in worlds of which some
lie at the end of what was trained on: found within 250 ms of the first release, early, and how
late; beside it hints, the detector of bins and, with the first seed, the largest wavelet detail
under the same budgets. Then false alarms of held-out materials by kind of recording, of reflex
grips and strokes of the arm, and of recordings with imperfections. All data are simulated. What a
seed gave is kept, so a run that was stopped resumes. Puts its tables into docs/onset.md.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np
from hydra.utils import instantiate

from benchmarks.earlier import KEPT
from benchmarks.harness import Benchmark, Job
from benchmarks.onset_baselines import BaselineDetector
from benchmarks.tables import Report, Table, by, percent
from benchmarks.trainings import composed, resumed, say
from tactslip_torch import AlarmSettings, SlipDetector
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.hand import HandLayout
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.onset.events import first_releases
from tactslip_torch.onset.rules import Budget
from tactslip_torch.simulation.simulate import SimulatedRecordings, Timeline
from tactslip_torch.simulation.worlds import CONFOUNDERS as KINDS
from tactslip_torch.simulation.worlds import SLIP
from tactslip_torch.training.alarm import (
    CONFOUNDERS,
    OURS,
    SLIPPING_NOW,
    Stream,
    Timing,
    budget_scores,
    decide,
    score_streams,
)

SOURCES = (
    "tactslip_torch/pretrained/paper24-sim.pt",
    "benchmarks/kept/alarms_0_2_0.json",
)
FOUND_S, EARLY_S, HINT_S = 0.25, 0.2, 0.1
"""Of the first release: an alarm until then finds a slip, before it is early; a hint is in time."""
HINT, BINS, EARLIER = "hint", "bins", "0.2.0"
DETAIL = "largest_detail"
GRIPS_PER_S = KINDS["reflex_grips"](np.random.default_rng(0))["grips_per_s"]
"""Of recordings of reflex grips, in the mean."""


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
    "bristles": _PULLED | _BRISTLES,
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
    *(f"onset.streams.confounders.{kind}=60" for kind in KINDS if kind != "held"),
    "onset.hours={held:3,slip:0.06,others:0.15}",
    "onset.check_hours={held:2,slip:0,others:0.2}",
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


class _Seed(NamedTuple):
    """What a seed gave.

    Attributes:
        alarm: how it was set.
        slips: what became of each, by world and method.
        quiet: false alarms by kind of recording and method.
    """

    alarm: dict[str, Any]
    slips: list[dict[str, Any]]
    quiet: list[dict[str, Any]]


@dataclass(frozen=True)
class Alarms(Benchmark):
    """Every seed, fitted and evaluated.

    Args:
        seeds: of mixtures, weights, mountings and recordings that set thresholds.
        overrides: of ``tactslip_torch.train +exp=onset``, of which ``onset`` is taken: so many
            hours set thresholds and are checked.
        worlds: names of ``WORLDS``.
        sessions: mountings of each material and world, each with three slips.
        without_bristles: whether the first seed learns once more, from no bristles.
    """

    title = "The alarm in many worlds"
    about = "alarms of +exp=onset within the default budget, on recordings that set nothing"
    page, markers, has_headings = "docs/onset.md", "onset", False
    quick = f'seeds=[0] overrides=["{QUICK}"] worlds=["pulled","bristles"] sessions=1'
    charts: ClassVar = {
        "": [
            ("Slips found", ("found", "bins", "detail", EARLIER)),
            ("Slips found", ("median", "p95")),
            ("False alarms", ("alarm",)),
        ]
    }
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    overrides: tuple[str, ...] = OVERRIDES
    worlds: tuple[str, ...] = tuple(WORLDS)
    sessions: int = 4
    without_bristles: bool = True

    def measure(self, job: Job) -> dict[str, Any]:
        """Slips in every world and false alarms of every kind, seeds together."""
        given = [[f"seed={seed}", *self.overrides, *job.overrides] for seed in self.seeds]
        of_seeds = [
            self._seed(job.folder / f"seed-{seed}", seed, own, with_quiet=True)
            for seed, own in zip(self.seeds, given, strict=True)
        ]
        set_by = [each.alarm for each in of_seeds]
        slips = [row for each in of_seeds for row in each.slips]
        quiet = [row for each in of_seeds for row in each.quiet]
        first = self.seeds[0]
        earlier = self._earlier(given[0])
        quiet += [{"method": EARLIER} | row for row in earlier["quiet"].values()]
        without = [*given[0], "onset.worlds.bristles=0"]
        others = replace(self, worlds=tuple(w for w in self.worlds if "bristles" in w))
        unknown = list[dict[str, Any]]()
        if others.worlds and self.without_bristles:
            unknown = others._seed(job.folder / "without bristles", first, without).slips
        before = earlier["slips"]
        rows = [
            _world_row(world, own, before.get(world, []))
            for (world,), own in by(slips, "world").items()
        ]
        rows.sort(key=itemgetter("found %"))
        tables = {
            "Slips found": Table(
                rows,
                "*Found*: an alarm within 250 ms of the first release, all seeds together; a slip "
                "with an early alarm does not count as found. *Lowest*: of the seed that found "
                "fewest. *Early*: an alarm was raised or active in the 200 ms before the first "
                "release. *Median* and *p95*: of the delay. *Hint*: a hint within 100 ms. *Bins*: "
                "alarms of the detector of bins and its rule. *Detail*: a threshold on the largest "
                f"wavelet detail of a fast channel, seed {first} only. Both are set under the same "
                "budgets. *0.2.0*: the alarm of version 0.2.0 with the threshold from its own "
                f"training, seed {first}. Heads of the onset classifier, by seed: "
                f"{', '.join(alarm['classifier']['head'] for alarm in set_by)}.",
            ),
            "False alarms": Table(
                _quiet_rows(quiet, self.budget(given[0])),
                "False alarms an hour on held-out materials, with 95 % intervals, all seeds "
                "together. *Confounders*: all kinds below, together. *With imperfections*: the "
                "confounders in which single elements have imperfections. *Of each*: false alarms "
                f"in % of the reflex grips ({GRIPS_PER_S:g} a second) or of the arm's strokes. The "
                f"thresholds are set on {_hours(set_by[-1]['streams']['calibrate'])} of other "
                "materials, at the point estimate. 0.2.0 was run on a part of the recordings of "
                "the first seed; its hours are their whole durations. "
                f"{_left_out(earlier['others'])}",
            ),
        }
        if unknown:
            known = {row["world"]: row for row in slips if row["seed"] == first}
            tables["Without bristles in what is learned from"] = Table(
                [
                    {
                        "world": row["world"],
                        "found %": percent(_share(row[SLIPPING_NOW], FOUND_S)),
                        "with bristles %": percent(
                            _share(known[row["world"]][SLIPPING_NOW], FOUND_S)
                        ),
                        "slips": len(row[SLIPPING_NOW]),
                    }
                    for row in unknown
                ],
                "*Found*: by a classifier that was trained without bristle contact; beside it the "
                f"classifier of the tables above, trained with it. Seed {first}.",
            )
        return {"tables": tables}

    def budget(self, given: Sequence[str]) -> Mapping[str, float]:
        """False alarms an hour that are allowed, by kind."""
        of: Mapping[str, float] = composed("train", ["+exp=onset", *given]).onset.budget
        return of

    def _seed(
        self,
        folder: Path,
        seed: int,
        given: Sequence[str],
        with_quiet: bool = False,
    ) -> _Seed:
        """The alarm of a seed, slips in all worlds and, on request, recordings without slip."""
        given, has_detail = ["+exp=onset", *given], with_quiet and seed == self.seeds[0]
        made_by = [*given, f"detail={has_detail}"]
        say(f"the alarm in {folder.name}")
        fit = partial(_fitted, given, folder / "detector.pt", has_detail)
        alarm: dict[str, Any] = resumed(folder / "alarm.json", made_by, fit)
        methods = _Methods.of(SlipDetector.load(folder / "detector.pt"), alarm)
        say(f"{len(self.worlds)} worlds of {folder.name}")
        of_worlds = [*made_by, *self.worlds, f"sessions={self.sessions}"]
        run = partial(_slips, methods, alarm["held_out"], self, seed)
        slips = resumed(folder / "worlds.json", of_worlds, run)
        if not with_quiet:
            return _Seed(alarm, slips, [])
        say(f"recordings without slip of {folder.name}")
        quiet = resumed(folder / "quiet.json", made_by, partial(_quiet, methods, given))
        return _Seed(alarm, slips, quiet)

    def _earlier(self, given: Sequence[str]) -> dict[str, Any]:
        """Kept results of 0.2.0, of groups whose recordings are still the same, and the others."""
        kept: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
        made, known = self.digests(given), kept.get("digests", {})
        same = {name for name, own in made.items() if known.get(name) == own}
        others = [name for name in made if name not in same]
        if others:
            named = ", ".join(others) if same else "all"
            say(f"kept results of 0.2.0 are of other recordings ({named}); run benchmarks.earlier")
        rows = {
            part: {name: of for name, of in kept.get(part, {}).items() if name in same}
            for part in ("slips", "quiet")
        }
        return {**rows, "others": others}

    def digests(self, given: Sequence[str]) -> dict[str, str]:
        """Of the recordings of the first seed, by world and by kind without slip."""
        source, groups, materials = quiet_recordings(["+exp=onset", *given])
        digests = {
            quiet_name(*group): _digest(source, recordings) for group, recordings in groups.items()
        }
        for world in self.worlds:
            own = world_recordings(world, materials, self.sessions, self.seeds[0])
            digests[world] = _digest(own, own.ids)
        return digests

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
    set_alarm.streams.ids = tuple(roles["calibrate"])  # nothing is checked but what is shown
    found: dict[str, Any] = set_alarm(detector, others, num_workers=config.num_workers)
    path.parent.mkdir(parents=True, exist_ok=True)
    detector.save(path)
    held_out = list(dict.fromkeys(recording.material for recording in roles["unseen"]))
    return {name: found[name] for name in ("methods", "classifier", "streams")} | {
        "held_out": held_out
    }


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
        DETAIL: BaselineDetector(detector.pool, detector.channel_filter),
    }


class _Methods(NamedTuple):
    """What makes alarms of recordings.

    Attributes:
        scorers: by name.
        settings: by method the name of its scorer, and what makes alarms of scores.
    """

    scorers: dict[str, Scorer]
    settings: dict[str, tuple[str, AlarmSettings]]

    @classmethod
    def of(cls, detector: SlipDetector, alarm: Mapping[str, Any]) -> Self:
        ours, pool = AlarmSettings.of(detector), detector.pool
        assert ours.onset is not None
        settings = {
            SLIPPING_NOW: (OURS, ours),
            HINT: (OURS, ours.at_threshold(ours.onset.hint)),
        }
        for name, label in {ours.rule.name: BINS, DETAIL: DETAIL}.items():
            if made := alarm["methods"].get(name):
                plain = {field.name: made[field.name] for field in fields(AlarmSettings)}
                plain |= {"onset": None}
                own = AlarmSettings.from_dict(plain, pool.hand, pool.sample_rate_hz)
                settings[label] = made["scorer"], own
        return cls(_scorers(detector, DETAIL in settings), settings)

    @property
    def ours(self) -> AlarmSettings:
        """Of the alarm."""
        return self.settings[SLIPPING_NOW][1]

    def timing(self, name: str) -> Timing:
        """Of a scorer."""
        pool, look_ahead = self.scorers[OURS].pool, self.scorers[name].look_ahead
        return Timing(pool.sample_rate_hz, self.ours.hop_samples, pool.bin_samples, look_ahead)

    def score(
        self, source: RecordingSource, recordings: Sequence[RecordingId]
    ) -> dict[str, list[Stream]]:
        """Streams of each scorer."""
        hops = dict.fromkeys(self.scorers, self.ours.hop_samples)
        return score_streams(source, recordings, self.scorers, hops, self.ours.onset)


def world_recordings(
    world: str, materials: Sequence[str], sessions: int, seed: int
) -> SimulatedRecordings:
    """Slips in a world, of mountings and draws that nothing else has."""
    return SimulatedRecordings(
        seed=1000 + seed,
        cycles=1,
        sessions=sessions,
        materials=materials,
        scene=WORLDS[world],
    )


def quiet_recordings(
    given: Sequence[str],
) -> tuple[RecordingSource, dict[tuple[str, bool], list[RecordingId]], list[str]]:
    """Recordings without slip of held-out materials, by kind and whether channels differ.

    Returns:
        Their source, them, and the materials.
    """
    set_alarm = instantiate(composed("train", given).onset, _convert_="all")
    source = set_alarm.streams
    groups = defaultdict[tuple[str, bool], list[RecordingId]](list)
    for recording in set_alarm.roles(SlipDetector.pretrained())["unseen"]:
        if recording.scene != SLIP:
            is_imperfect = "local_noise_mv" in source.key(recording).get("imperfections", {})
            groups[recording.scene, is_imperfect].append(recording)
    materials = dict.fromkeys(one.material for own in groups.values() for one in own)
    return source, dict(groups), list(materials)


def _left_out(groups: Sequence[str]) -> str:
    """What is not shown of 0.2.0, as a sentence; empty if all is."""
    if not groups:
        return ""
    names = ", ".join(group.replace("_", " ") for group in groups)
    return f"It was not run again where recordings have changed since: {names}."


def quiet_name(kind: str, is_imperfect: bool) -> str:
    """Of a group of recordings without slip, among the kept results of 0.2.0."""
    return f"{kind}, with imperfections" if is_imperfect else kind


def _digest(source: RecordingSource, recordings: Sequence[RecordingId]) -> str:
    keys = [source.key(recording) for recording in recordings]
    return hashlib.sha256(json.dumps(keys, default=str).encode()).hexdigest()[:16]


def _slips(
    methods: _Methods, materials: Sequence[str], sizes: Alarms, seed: int
) -> list[dict[str, Any]]:
    """What became of each slip of held-out materials, by world and method."""
    rows = list[dict[str, Any]]()
    for world in sizes.worlds:
        source = world_recordings(world, materials, sizes.sessions, seed)
        streams = methods.score(source, source.ids)
        found = {
            name: [
                delay
                for stream, made in decide(streams[scorer], own, methods.timing(scorer))
                for delay in delays(stream.times, made)
            ]
            for name, (scorer, own) in methods.settings.items()
        }
        rows.append({"world": world, "seed": seed, **found})
    return rows


def _quiet(methods: _Methods, given: Sequence[str]) -> list[dict[str, Any]]:
    """False alarms of held-out materials by kind, with and without imperfections."""
    source, groups, _ = quiet_recordings(given)
    rows = list[dict[str, Any]]()
    for (scene, is_imperfect), own in groups.items():
        streams = methods.score(source, own)
        timelines = [cast(Timeline, source.timeline(recording)) for recording in own]
        for name, (scorer, settings) in methods.settings.items():
            timing = methods.timing(scorer)
            (found,) = budget_scores(streams[scorer], settings, timing, [Budget(scene, 1.0)])
            alarms = found.alarms(settings, timing.sample_rate_hz)
            rows.append(
                {
                    "kind": scene,
                    "is_imperfect": is_imperfect,
                    "method": name,
                    "alarms": sum(map(len, alarms)),
                    "hours": found.amount,
                    "strokes": sum(len(times.arm_s) for times in timelines),
                }
            )
    return rows


def delays(times: Any, made: Any) -> list[float | str]:
    """Seconds from the first release of each slip to its alarm, or ``early``, or ``missed``."""
    time_s = made.available_s.numpy()
    raised, is_on = time_s[made.is_alarm.numpy()], made.is_on.numpy()
    outcomes = list[float | str]()
    for first_s in first_releases(times.onsets_s, times.released_s):
        if is_on[(time_s > first_s - EARLY_S) & (time_s <= first_s)].any():
            outcomes.append("early")
            continue
        own = raised[(raised > first_s) & (raised <= first_s + FOUND_S)]
        outcomes.append(float(own[0] - first_s) if len(own) else "missed")
    return outcomes


def _share(delays: Sequence[float | str], within_s: float) -> float:
    """Of slips that are found in time."""
    return fmean(not isinstance(delay, str) and delay <= within_s for delay in delays)


def _world_row(
    world: str, by_seed: Sequence[Mapping[str, Any]], before: Sequence[float | str]
) -> dict[str, Any]:
    def shares(name: str, within_s: float = FOUND_S) -> list[float]:
        return [_share(of[name], within_s) for of in by_seed if name in of]

    every = [delay for of in by_seed for delay in of[SLIPPING_NOW]]
    delays_ms = 1e3 * np.array([delay for delay in every if not isinstance(delay, str)])
    median, p95 = np.quantile(delays_ms, (0.5, 0.95)) if len(delays_ms) else (np.nan, np.nan)
    hints = [delay for of in by_seed for delay in of[HINT]]
    return {
        "world": world,
        "found %": round(100 * fmean(shares(SLIPPING_NOW)), 1),
        "lowest %": round(100 * min(shares(SLIPPING_NOW)), 1),
        "early %": percent(fmean(delay == "early" for delay in every)),
        "median ms": f"{median:.0f}",
        "p95 ms": f"{p95:.0f}",
        "hint %": percent(fmean(shares(HINT, HINT_S))),
        "early hints %": percent(fmean(delay == "early" for delay in hints)),
        "bins %": percent(fmean(shares(BINS))),
        "detail %": percent(fmean(shares(DETAIL))) if shares(DETAIL) else "-",
        f"{EARLIER} %": percent(_share(before, FOUND_S)) if before else "-",
        "slips": len(every),
    }


def _quiet_rows(
    found: Sequence[Mapping[str, Any]], budget: Mapping[str, float]
) -> list[dict[str, Any]]:
    """A row for each kind: rates of the alarm, of hints, of bins and of detail."""
    others = [row for row in found if row["kind"] not in budget]
    kinds = by(found, "kind")
    held = {kind: own for (kind,), own in kinds.items() if kind in budget}
    alone = {kind.replace("_", " "): own for (kind,), own in kinds.items() if kind not in budget}
    alone = dict(sorted(alone.items(), key=lambda item: -_rate(item[1], SLIPPING_NOW)))
    imperfect = [row for row in others if row["is_imperfect"]]
    groups = held | {CONFOUNDERS: others} | {"with imperfections": imperfect} | alone
    return [_quiet_row(kind, own, budget.get(kind)) for kind, own in groups.items() if own]


def _quiet_row(
    kind: str, found: Sequence[Mapping[str, Any]], limit: float | None
) -> dict[str, Any]:
    row: dict[str, Any] = {"kind": kind}
    for method in (SLIPPING_NOW, HINT, BINS, DETAIL, EARLIER):
        own = [one for one in found if one["method"] == method]
        if not own:
            continue
        alarms, hours = sum(one["alarms"] for one in own), sum(one["hours"] for one in own)
        low, high = Budget(kind, 1.0).interval(alarms, hours)
        name = "alarm" if method == SLIPPING_NOW else method.replace("largest_", "")
        row[name] = f"{alarms / hours:.2f} [{low:.2f}, {high:.2f}]"
        if method == SLIPPING_NOW:
            of = {
                "reflex grips": 3600 * GRIPS_PER_S * hours,
                **dict.fromkeys(("arm", "lifted"), sum(one["strokes"] for one in own)),
            }
            row["of each"] = f"{100 * alarms / of[kind]:.2f} %" if kind in of else "-"
            row["hours"] = f"{hours:.2f}"
    return row | {"budget": "-" if limit is None else f"{limit:g} /h"}


def _rate(found: Sequence[Mapping[str, Any]], method: str) -> float:
    own = [one for one in found if one["method"] == method]
    return float(sum(one["alarms"] for one in own) / sum(one["hours"] for one in own))


if __name__ == "__main__":
    raise SystemExit(Alarms().run())
