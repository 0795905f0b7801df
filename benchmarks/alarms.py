"""The alarm of ``+exp=onset`` over several seeds: ``python -m benchmarks.alarms [key=value ...]``.

Fewer seeds or cycles: ``sizes.seeds=[0] sizes.cycles=2``; MiniRocket: ``sizes.num_kernels=10000``.

Trains a detector with each seed, sets its alarm within the default budget, and checks rates, slips
found, delays and millimetres slid on recordings that set nothing, of seen and of held-out
materials. Beside it, under the same budget and the same instants: a threshold on the largest
wavelet detail and, if it is asked for, MiniRocket with ridge. Then pulses that are weaker and
knocks that are stronger than those that were trained on. All data are simulated. What a seed gave
is kept, so a run that was stopped resumes. Puts its tables into docs/onset.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from benchmarks.harness import Benchmark, Job, resumed, say, trained
from benchmarks.peers import rockets
from benchmarks.subjects import Array, Trained, composed
from benchmarks.tables import COLORS, Report, Table, by, percent
from tactslip_torch import AlarmSettings, FeaturePool, Prediction, SlipDetector
from tactslip_torch.onset.baselines import BaselineDetector
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.onset.events import EventRules, LatencyParts, pooled_metrics, recording_events
from tactslip_torch.onset.thresholds import Budget
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.alarm import (
    JOINT,
    OURS,
    CalibratedAlarm,
    Timing,
    decide,
    score_streams,
    watched,
)

LARGEST_DETAIL = "largest detail"
ROCKET = "MiniRocket and ridge"
ROLES = {"test": "seen", "unseen": "held out"}
PULSES_V = (0.02, 0.05, 0.1, 0.5)
KNOCKS_MV = (10.0, 30.0, 100.0)
_SCENES = ("arm_motion", "taps", "grips", "machine", "mains_bursts")
_OTHERS = ("pulled", "dead_channel", "release_50mv", "release_150mv", "grips_knocked")
_ALL = (*_SCENES, "held", "knocked")
QUICK = '","'.join(
    (
        "data.cycles=2",
        "data.materials=[M1,M6,iron]",
        "split.seen=[M1,M6]",
        "split.unseen=[iron]",
        "split.train_fraction=0.5",
        *(f"extra_scenes.{scene}.cycles=2" for scene in ("knocked", "pulled", *_SCENES)),
        *(f"~extra_scenes.{scene}" for scene in ("paper_loud", "motor_off")),
        *(f"~recipe.scene_weights.{scene}" for scene in ("paper_loud", "motor_off")),
        "recipe.penalties=[0.003]",
        "recipe.sample_bins=20",
        "onset.streams.cycles=6",
        "onset.learn_cycles=2",
        "onset.check_hours=0.002",
        "onset.check_slip_free_hours=0.002",
        "onset.budget.held=3000",
        "onset.hours.held=0.002",
        "onset.budget.taps_share=0.9",
        *(f"onset.budget.{scene}=9000" for scene in _SCENES if scene != "taps"),
        *(f"onset.hours.{scene}=0.002" for scene in _SCENES),
        *(f"onset.streams.extra_scenes.{scene}.cycles=5" for scene in _ALL),
        *(f"onset.streams.extra_scenes.{scene}.tail_s=4" for scene in (*_ALL[1:], _OTHERS[-1])),
        *(f"onset.streams.extra_scenes.{scene}.cycles=3" for scene in _OTHERS),
    )
)


@dataclass(frozen=True)
class Alarms(Benchmark):
    """Every seed, then the first under other pulses and knocks.

    Args:
        seeds: of sets, splits and detectors; weak pulses have the first.
        overrides: of ``tactslip_torch.train +exp=onset``, which say how much is checked.
        pulses_v: ``onset_pulse_v`` of further recordings.
        knocks_mv: their knocks.
        cycles: of each material, pulse and knock.
        peer_recordings: of training, to whose bins MiniRocket's ridge is fitted.
        num_kernels: of MiniRocket; 0 leaves it out, which halves the time of its seed.
    """

    title = "The alarm: slips found, and how late"
    about = "alarms of +exp=onset within the default budget, on recordings that set nothing"
    page, markers, has_headings = "docs/onset.md", "onset", False
    quick = (
        f'seeds=[0] overrides=["{QUICK}"] pulses_v=[0.1] knocks_mv=[30.0] cycles=1 '
        "peer_recordings=3 num_kernels=168"
    )
    libraries = ("aeon",)
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    overrides: tuple[str, ...] = (
        "baselines=false",
        "export=false",
        "onset.check_slip_free_hours=2",
        "onset.check_hours=0.2",
    )
    pulses_v: tuple[float, ...] = PULSES_V
    knocks_mv: tuple[float, ...] = KNOCKS_MV
    cycles: int = 4
    peer_recordings: int = 60
    num_kernels: int = 0

    def measure(self, job: Job) -> dict[str, Any]:
        """Of every seed what the stage tells; of the first also pulses."""
        found = {}
        for seed in self.seeds:
            given = ["+exp=onset", f"seed={seed}", *self.overrides, *job.overrides]
            run = partial(self._of_seed, seed, given, job)
            found[str(seed)] = resumed(job.folder / f"alarm-{seed}.json", given, run)
        return {"seeds": found}

    def _of_seed(self, seed: int, overrides: list[str], job: Job) -> dict[str, Any]:
        folder, is_first = job.folder / f"seed-{seed}", seed == self.seeds[0]
        training = [x for x in overrides if not x.startswith("onset.")] + ["onset=none"]
        trained(training, folder, job.folder / "cache")
        detector = SlipDetector.load(folder / "detector.pt")
        parts = (detector.pool, detector.channel_filter)
        peers: dict[str, Scorer] = {LARGEST_DETAIL: BaselineDetector("largest_detail", *parts)}
        config: Any = OmegaConf.to_container(composed("train", overrides).onset, resolve=True)
        stage: CalibratedAlarm = instantiate(config, _convert_="all")
        if is_first and self.num_kernels:
            peers[ROCKET] = _rocket(detector, training, folder, stage, self)
        say(f"alarm, seed {seed}")
        found = stage(detector, peers)
        detector.save(folder / "detector.pt")
        if is_first:
            found["pulses"] = _pulses(detector, stage, found, self)
        return _told(found)

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Goals, budgets, slips, weak pulses."""
        seeds = numbers["seeds"]
        first = next(iter(seeds.values()))
        set_on = first["settings"]["metadata"]["budget"]
        allowed = ", ".join(
            f"{row['scene']} {row['alarms']} of {row['allowed']} in {row['amount']:.4g}"
            for row in set_on
        )
        note = (
            f"Alarms that calibration had, of those allowed, in so many hours or knocks, seed 0: "
            f"{allowed}. In brackets 95 % intervals of all seeds together; *within* counts seeds "
            "whose own rate lies within the budget."
        )
        found = {
            "False alarms": Table(_budget_rows(seeds), note),
            "Slips of the protocol": Table(
                _slip_rows(
                    {role: of["events"].get(f"{role} stream", {}) for role in ROLES}
                    for of in seeds.values()
                ),
                "Means over seeds, in brackets the worst. Delays are from the release of half of "
                "the load, an alarm before the first release is early.",
            ),
            "Slips among confounders, held out": Table(_scene_slips(seeds)),
        }
        if "pulses" in first:
            found["Weak pulses and strong knocks"] = Table(
                _pulse_rows(first["pulses"]),
                "Slips found in %, seed 0, held-out materials, at the thresholds of the default "
                "budget; false alarms an hour in the rests of the same recordings.",
            )
        return found

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Delay against slips found, and weak pulses."""
        drawing.set_size_inches(11, 4.2)
        left, right = drawing.subplots(1, 2)
        methods = list(next(iter(numbers["seeds"].values()))["methods"])
        for color, method in zip(COLORS, methods, strict=False):
            for role, marker in (("test", "o"), ("unseen", "s")):
                points = [
                    (events["delay_ms"]["median"]["value"], 100 * events["found"]["value"])
                    for of in numbers["seeds"].values()
                    if (events := of["events"].get(f"{role} stream", {}).get(method))
                    and events["delay_ms"]
                ]
                if points:
                    label = f"{method}, {ROLES[role]}"
                    left.plot(*zip(*points, strict=True), marker, color=color, label=label)
        left.set_xlabel("median delay from the release of half of the load, ms")
        left.set_title("slips found, %, a dot a seed", fontsize=10)
        left.legend(frameon=False, fontsize=7)
        pulses = next(iter(numbers["seeds"].values())).get("pulses", [])
        for color, ((knock,), own) in zip(COLORS, by(pulses, "knocks_mv").items(), strict=False):
            volts = [row["pulse_v"] for row in own]
            for method, style, face in ((JOINT, "-", color), (LARGEST_DETAIL, "--", "white")):
                values = [100 * row[method]["found"] for row in own]
                label = f"{method}, knocks {knock:g} mV"
                look: dict[str, Any] = {"color": color, "marker": "o", "markerfacecolor": face}
                right.plot(volts, values, style, label=label, **look)
        right.set_xscale("log")
        right.set_xticks(PULSES_V, [f"{volt:g}" for volt in PULSES_V])
        right.minorticks_off()
        right.set_xlabel("pulse of a release, V per N (trained at 0.05, 0.15 and 0.5)")
        right.set_title("slips found, %, held-out materials, default thresholds", fontsize=10)
        right.legend(frameon=False, fontsize=7)


def _told(found: dict[str, Any]) -> dict[str, Any]:
    """Of what the stage tells, what is told here."""
    names = ("num_onsets", "found", "early", "missed", "delay_ms", "delay_first_ms")

    def of_methods(by_method: Mapping[str, Any]) -> dict[str, Any]:
        told = {}
        for method, events in by_method.items():
            slid_mm = events.get("per_speed", {}).get("40", {}).get("slid_mm")
            told[method] = {name: events.get(name) for name in names}
            told[method]["per_speed"] = {"40": {"slid_mm": slid_mm}}
        return told

    return {
        "settings": {"metadata": {"budget": found["settings"]["metadata"]["budget"]}},
        "methods": list(found["methods"]),
        "budget": found["budget"],
        "events": {role: of_methods(of) for role, of in found["events"].items()},
        "scenes": {
            scene: {"unseen": of_methods(by_role.get("unseen", {}))}
            for scene, by_role in found["scenes"].items()
        },
        **({"pulses": found["pulses"]} if "pulses" in found else {}),
    }


def _budget_rows(seeds: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row for each scene and kind of materials: rates of each method, all seeds together."""
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    totals: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for of in seeds.values():
        for row in of["budget"]:
            if row["role"] in ROLES:
                place = row["scene"], row["role"], row["method"]
                totals.setdefault(place, []).append(row)
    for (scene, role, method), rows in totals.items():
        budget = Budget(scene, rows[0]["limit"], rows[0]["is_share"])
        factor, unit = (100, "% of knocks") if budget.is_share else (1, "/h")
        alarms, amount = sum(row["alarms"] for row in rows), sum(row["amount"] for row in rows)
        if not amount:
            continue
        low, high = budget.interval(alarms, amount)
        ends = f"[{factor * low:.2f}, {factor * high:.2f}]"
        within = sum(row["rate"] <= row["limit"] for row in rows if row["amount"])
        row = {"scene": scene.replace("_", " "), "materials": ROLES[role]}
        row["budget"] = f"{factor * budget.limit:g} {unit}"
        row["of"] = f"{amount:.4g} {'knocks' if budget.is_share else 'h'}"
        own = cells.setdefault((scene, role), row)
        own[method] = f"{factor * alarms / amount:.2f} {ends}, within {within} of {len(rows)}"
    return list(cells.values())


def _slip_rows(by_seed: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each kind of materials and method, of events by role and method of each seed."""
    found: dict[tuple[str, str], list[Any]] = {}
    for by_role in by_seed:
        for role, words in ROLES.items():
            for method, events in by_role.get(role, {}).items():
                found.setdefault((words, method), []).extend(
                    [events] if events["num_onsets"] else []
                )
    rows = []
    for (words, method), own in sorted(found.items(), key=lambda of: of[0][0] != "seen"):
        if not own:
            continue
        row: dict[str, Any] = {"materials": words, "method": method, "seeds": len(own)}
        row["slips"] = sum(events["num_onsets"] for events in own)
        for name, worst in (("found", min), ("early", max), ("missed", max)):
            shares = [events[name]["value"] for events in own]
            row[f"{name} %"] = f"{percent(fmean(shares))} [{percent(worst(shares))}]"
        for title, key, quantile in (
            ("delay ms", "delay_ms", "median"),
            ("p95 ms", "delay_ms", "p95"),
            ("from first release ms", "delay_first_ms", "median"),
        ):
            row[title] = _mean_and_worst([e[key][quantile]["value"] for e in own if e.get(key)], 1)
        slid = [events["per_speed"]["40"]["slid_mm"] for events in own]
        slid = [of["median"]["value"] for of in slid if of]
        rows.append(row | {"mm slid at 40 mm/s": _mean_and_worst(slid, 2)})
    return rows


def _mean_and_worst(values: Sequence[float], digits: int) -> str:
    return f"{fmean(values):.{digits}f} [{max(values):.{digits}f}]" if values else "-"


def _scene_slips(seeds: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [
        {"scene": scene.replace("_", " "), **row}
        for scene in next(iter(seeds.values()))["scenes"]
        for row in _slip_rows(of["scenes"][scene] for of in seeds.values())
        if row["materials"] == "held out" and row["method"] in (JOINT, LARGEST_DETAIL)
    ]


def _pulse_rows(pulses: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    rows = []
    for of in pulses:
        row = {"pulse V/N": f"{of['pulse_v']:g}", "knocks mV": f"{of['knocks_mv']:g}"}
        for method in (JOINT, LARGEST_DETAIL):
            row[f"{method}, found %"] = percent(of[method]["found"])
            row[f"{method}, false /h"] = f"{of[method]['false_per_hour']:.1f}"
        rows.append({**row, "slips": of[JOINT]["slips"]})
    return rows


def _pulses(
    detector: SlipDetector, stage: CalibratedAlarm, found: Mapping[str, Any], sizes: Alarms
) -> list[dict[str, Any]]:
    """Slips found of other pulses and knocks, on held-out materials, at the thresholds as set."""
    settings = AlarmSettings.of(detector)
    assert settings.onset is not None
    of_detail = found["methods"][LARGEST_DETAIL]
    rate, hop = detector.pool.sample_rate_hz, settings.onset.evidence.hop_samples
    plain = BaselineDetector("largest_detail", detector.pool, detector.channel_filter)
    plainer = replace(settings, onset=None, hop_samples=hop).to_dict()
    plainer |= {name: of_detail[name] for name in ("rule", "calibration", "threshold")}
    by_detail = AlarmSettings.from_dict(plainer, detector.pool.hand, rate)
    seen = set(detector.info["train_materials"])
    source_of: Any = type(stage.streams)
    scorers: dict[str, Scorer] = {OURS: detector, LARGEST_DETAIL: plain}
    hops = {OURS: settings.hop_samples, LARGEST_DETAIL: hop}
    materials = sorted({one.material for one in stage.streams.ids} - seen)
    rows = []
    for knocks, pulse in product(sizes.knocks_mv, sizes.pulses_v):
        scene = {"onset_pulse_v": pulse, "burst_mv": knocks}
        source = source_of(seed=1000, cycles=sizes.cycles, materials=materials, scene=scene)
        streams = score_streams(source, source.ids, scorers, hops, settings.onset)
        row: dict[str, Any] = {"pulse_v": pulse, "knocks_mv": knocks}
        for method, name, own in (
            (JOINT, OURS, settings),
            (LARGEST_DETAIL, LARGEST_DETAIL, by_detail),
        ):
            parts = (detector.pool.bin_samples, scorers[name].look_ahead)
            latency = LatencyParts(parts[1] / rate, parts[0] / rate)
            decided = decide(streams[name], own, Timing(rate, hops[name], *parts))
            made = [recording_events(watched(*of), EventRules(), latency) for of in decided]
            events = pooled_metrics(made, num_resamples=1)
            row[method] = {
                "slips": events["num_onsets"],
                "found": events["found"]["value"],
                "early": events["early"]["value"],
                "false_per_hour": events["false_alarms_per_hour"]["value"],
            }
        rows.append(row)
    return rows


@dataclass(frozen=True, eq=False)
class _RocketDetector:
    """MiniRocket in the place of a ``SlipDetector``: the same hand, filter and bins."""

    pool: FeaturePool
    channel_filter: ChannelFilter
    scores: Callable[[Array], Array]
    hop_samples: int

    @property
    def needed_index(self) -> torch.Tensor:
        """All channels, ``[C]``."""
        return torch.arange(len(self.pool.hand))

    @property
    def look_ahead(self) -> int:
        """Samples behind a bin that the longest frame takes in."""
        return self.channel_filter.context_after

    def predict_raw(self, samples: torch.Tensor, *, given: torch.dtype) -> Prediction:
        """Score raw bins with their context; a channel that is missing counts as silent."""
        bins = self.channel_filter.valid(samples)
        is_missing = self.pool.is_missing(bins)
        raw_magnitude = self.channel_filter.raw_magnitude(samples)
        is_valid = (self.pool.is_alive(bins, given, raw_magnitude) & ~is_missing).all(-1)
        windows = torch.where(is_missing[..., None], 0.0, bins).float().contiguous()
        score = torch.from_numpy(np.asarray(self.scores(windows.numpy()))).reshape(-1).to(given)
        return Prediction(score, is_valid, is_missing, torch.zeros_like(score))


def _rocket(
    detector: SlipDetector,
    overrides: list[str],
    folder: Path,
    stage: CalibratedAlarm,
    sizes: Alarms,
) -> Scorer:
    """MiniRocket with ridge on bins of some training recordings, at the hop of bins."""
    own = Trained.by(overrides, folder, folder / "cache")
    order = np.random.default_rng(0).permutation(len(own.recordings("train")))
    some = [own.recordings("train")[at] for at in order[: sizes.peer_recordings]]
    made = [own.maker.filtered_bins(recording) for recording in some]
    windows = torch.cat([bins for bins, _ in made]).float().numpy()
    is_slip = torch.cat([laid.is_slip for _, laid in made]).numpy()
    say(f"MiniRocket and ridge on {len(windows)} bins")
    scores = rockets.fit(windows, is_slip, num_kernels=sizes.num_kernels).score
    return _RocketDetector(detector.pool, detector.channel_filter, scores, stage.hop_samples)


if __name__ == "__main__":
    raise SystemExit(Alarms().run())
