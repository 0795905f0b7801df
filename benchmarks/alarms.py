"""The alarm of ``+exp=onset`` over several seeds: ``python -m benchmarks.alarms [key=value ...]``.

Fewer seeds or cycles: ``sizes.seeds=[0] sizes.cycles=2``.

Runs ``tactslip train +exp=onset`` with each seed, which sets the alarm within the default budget,
and shows rates, slips found, delays and millimetres slid on recordings that set nothing, of seen
and of held-out materials. Beside it, under the same budget and the same instants: a threshold on
the largest wavelet detail. Then pulses that are weaker and knocks that are stronger than those that
were trained on. All data are simulated. What a seed gave is kept, so a run that was stopped
resumes. Puts its tables into docs/onset.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from statistics import fmean
from typing import Any, ClassVar

from benchmarks.harness import Benchmark, Job, resumed, trained
from benchmarks.tables import Table, by, percent
from tactslip_torch import AlarmSettings, SlipDetector
from tactslip_torch.onset.baselines import BaselineDetector
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.onset.events import EventRules, LatencyParts, pooled_metrics, recording_events
from tactslip_torch.onset.rules import Budget
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.alarm import JOINT, OURS, Timing, decide, event_record, score_streams

LARGEST_DETAIL = "largest detail"
ROLES = {"test": "seen", "unseen": "held out"}
_SCENES = ("held", "arm_motion", "taps")
_OTHERS = ("knocked", "grips", "machine", "mains_bursts", "pulled")  # not in quick ones
_BUDGETED = ("grips", "machine", "mains_bursts")
QUICK = '","'.join(
    (
        "num_workers=0",
        "baselines=false",
        "data.cycles=2",
        "data.materials=[M1,M6,iron]",
        "split.seen=[M1,M6]",
        "split.unseen=[iron]",
        "split.train_fraction=0.5",
        *(f"extra_scenes.{scene}.cycles=2" for scene in _SCENES[1:]),
        *(f"~extra_scenes.{scene}" for scene in (*_OTHERS, "paper_loud", "motor_off")),
        *(f"~recipe.scene_weights.{scene}" for scene in (*_OTHERS, "paper_loud", "motor_off")),
        "recipe.penalties=[0.003]",
        "recipe.sample_bins=20",
        "onset.classifier.scenes=[paper,held,arm_motion,taps]",
        "onset.classifier.cycles=1",
        "onset.check_hours.others=0.002",
        "onset.check_hours.held=0.002",
        "onset.budget={held:3000,arm_motion:9000,taps_share:0.9}",
        *(f"~onset.{key}.{scene}" for key in ("budget", "hours") for scene in _BUDGETED),
        *(f"onset.hours.{scene}=0.002" for scene in _SCENES),
        "onset.streams.cycles=4",
        *(f"onset.streams.extra_scenes.{scene}.cycles=4" for scene in _SCENES),
        *(f"onset.streams.extra_scenes.{scene}.tail_s=4" for scene in ("held", "taps")),
        *(f"~onset.streams.extra_scenes.{scene}" for scene in _OTHERS),
        *(f"~onset.streams.extra_scenes.{scene}" for scene in ("dead_channel", "grips_knocked")),
        *(f"~onset.streams.extra_scenes.release_{volts}" for volts in ("50mv", "150mv")),
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
    """

    title = "The alarm: slips found, and how late"
    about = "alarms of +exp=onset within the default budget, on recordings that set nothing"
    page, markers, has_headings = "docs/onset.md", "onset", False
    quick = f'seeds=[0] overrides=["{QUICK}"] pulses_v=[0.1] knocks_mv=[30.0] cycles=1'
    charts: ClassVar = {
        "": [
            ("Slips of the protocol", ("found", "early", "missed")),
            ("Slips of the protocol", ("delay", "from")),
            ("Weak pulses and strong knocks", (f"{JOINT}, found", f"{LARGEST_DETAIL}, found")),
        ]
    }
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    overrides: tuple[str, ...] = (
        "baselines=false",
        "onset.check_hours.held=2",
        "onset.check_hours.others=0.2",
    )
    pulses_v: tuple[float, ...] = (0.02, 0.05, 0.1, 0.5)
    knocks_mv: tuple[float, ...] = (10.0, 30.0, 100.0)
    cycles: int = 4

    def measure(self, job: Job) -> dict[str, Any]:
        """Goals, budgets and slips of every seed; of the first also weak pulses."""
        seeds, pulses = list[dict[str, Any]](), list[dict[str, Any]]()
        for seed in self.seeds:
            given = ["+exp=onset", f"seed={seed}", *self.overrides, *job.overrides]
            folder = job.folder / f"seed-{seed}"
            metrics = trained(given, folder, job.folder / "cache")
            if not seeds:
                detector = SlipDetector.load(folder / "detector.pt")
                of_detail = metrics["alarm"]["methods"][LARGEST_DETAIL]
                held_out = sorted(metrics["splits"]["unseen"]["per_material"])
                run = partial(_pulses, detector, of_detail, held_out, self)
                pulses = resumed(folder / "pulses.json", [*given, repr(self)], run)
            seeds.append(metrics)
        first = seeds[0]["alarm"]
        allowed = ", ".join(
            f"{row['scene']} {row['alarms']} of {row['allowed']} in {row['amount']:.4g}"
            for row in first["settings"]["metadata"]["budget"]
        )
        note = (
            f"Alarms that calibration had, of those allowed, in so many hours or knocks, seed 0: "
            f"{allowed}. In brackets 95 % intervals of all seeds together; *within* counts seeds "
            "whose own rate lies within the budget."
        )
        by_role = [{role: of["events"].get(f"{role} stream", {}) for role in ROLES} for of in seeds]
        among = [
            {"scene": scene.replace("_", " "), **row}
            for scene in first["scenes"]
            for row in _slip_rows(of["alarm"]["scenes"][scene] for of in seeds)
            if row["materials"] == "held out" and row["method"] in (JOINT, LARGEST_DETAIL)
        ]
        tables = {
            "False alarms": Table(_budget_rows(of["alarm"]["budget"] for of in seeds), note),
            "Slips of the protocol": Table(
                _slip_rows(by_role),
                "Means over seeds, in brackets the worst. Delays are from the release of half of "
                "the load, an alarm before the first release is early.",
            ),
            "Slips among confounders, held out": Table(among),
            "Weak pulses and strong knocks": Table(
                _pulse_rows(pulses),
                "Slips found in %, seed 0, held-out materials, at the thresholds of the default "
                "budget; false alarms an hour in the rests of the same recordings.",
            ),
        }
        return {"tables": tables}


def _budget_rows(by_seed: Iterable[Sequence[Any]]) -> list[dict[str, Any]]:
    """A row for each scene and kind of materials: rates of each method, all seeds together."""
    rows = []
    every = [row for budget in by_seed for row in budget if row["role"] in ROLES]
    for (scene, role), own in by(every, "scene", "role").items():
        budget = Budget(scene, own[0]["limit"], own[0]["is_share"])
        factor, unit, counted = (
            (100, "% of knocks", "knocks") if budget.is_share else (1, "/h", "h")
        )
        row = {"scene": scene.replace("_", " "), "materials": ROLES[role]}
        row["budget"] = f"{factor * budget.limit:g} {unit}"
        for (method,), of in by(own, "method").items():
            alarms, amount = (sum(one[key] for one in of) for key in ("alarms", "amount"))
            if not amount:
                continue
            low, high = budget.interval(alarms, amount)
            within = sum(one["rate"] <= one["limit"] for one in of if one["amount"])
            row.setdefault("of", f"{amount:.4g} {counted}")
            row[method] = (
                f"{factor * alarms / amount:.2f} [{factor * low:.2f}, {factor * high:.2f}], "
                f"within {within} of {len(of)}"
            )
        rows += [row] if "of" in row else []
    return rows


def _slip_rows(by_seed: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each kind of materials and method, of events by role and method of each seed."""
    events = [
        {"materials": words, "method": method, "of": of}
        for by_role in by_seed
        for role, words in ROLES.items()
        for method, of in by_role.get(role, {}).items()
        if of["num_onsets"]
    ]
    rows = []
    for (words, method), found in by(events, "materials", "method").items():
        own = [one["of"] for one in found]
        row: dict[str, Any] = {"materials": words, "method": method, "seeds": len(own)}
        row["slips"] = sum(of["num_onsets"] for of in own)
        for name, worst in (("found", min), ("early", max), ("missed", max)):
            shares = [of[name]["value"] for of in own]
            row[f"{name} %"] = f"{percent(fmean(shares))} [{percent(worst(shares))}]"
        for title, key, quantile in (
            ("delay ms", "delay_ms", "median"),
            ("p95 ms", "delay_ms", "p95"),
            ("from first release ms", "delay_first_ms", "median"),
        ):
            row[title] = _mean_and_worst([of.get(key) for of in own], quantile, 1)
        slid = [of.get("per_speed", {}).get("40", {}).get("slid_mm") for of in own]
        rows.append(row | {"mm slid at 40 mm/s": _mean_and_worst(slid, "median", 2)})
    return sorted(rows, key=lambda row: row["materials"] != "seen")


def _mean_and_worst(found: Sequence[Mapping[str, Any] | None], quantile: str, digits: int) -> str:
    values = [of[quantile]["value"] for of in found if of]
    return f"{fmean(values):.{digits}f} [{max(values):.{digits}f}]" if values else "-"


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
    detector: SlipDetector, of_detail: Mapping[str, Any], held_out: Sequence[str], sizes: Alarms
) -> list[dict[str, Any]]:
    """Slips found of other pulses and knocks, on held-out materials, at the thresholds as set."""
    settings, rate = AlarmSettings.of(detector), detector.pool.sample_rate_hz
    assert settings.onset is not None
    hop = settings.onset.evidence.hop_samples
    plain = BaselineDetector("largest_detail", detector.pool, detector.channel_filter)
    plainer = replace(settings, onset=None, hop_samples=hop).to_dict()
    plainer |= {name: of_detail[name] for name in ("rule", "calibration", "threshold")}
    by_detail = AlarmSettings.from_dict(plainer, detector.pool.hand, rate)
    scorers: dict[str, Scorer] = {OURS: detector, LARGEST_DETAIL: plain}
    hops = {OURS: settings.hop_samples, LARGEST_DETAIL: hop}
    rows = []
    for knocks, pulse in product(sizes.knocks_mv, sizes.pulses_v):
        scene = {"onset_pulse_v": pulse, "burst_mv": knocks}
        source = SimulatedRecordings(
            seed=1000, cycles=sizes.cycles, materials=list(held_out), scene=scene
        )
        streams = score_streams(source, source.ids, scorers, hops, settings.onset)
        row: dict[str, Any] = {"pulse_v": pulse, "knocks_mv": knocks}
        for method, name, own in (
            (JOINT, OURS, settings),
            (LARGEST_DETAIL, LARGEST_DETAIL, by_detail),
        ):
            parts = (detector.pool.bin_samples, scorers[name].look_ahead)
            latency = LatencyParts(parts[1] / rate, parts[0] / rate)
            decided = decide(streams[name], own, Timing(rate, hops[name], *parts))
            made = [recording_events(event_record(*of), EventRules(), latency) for of in decided]
            events = pooled_metrics(made, num_resamples=1)
            row[method] = {
                "slips": events["num_onsets"],
                "found": events["found"]["value"],
                "early": events["early"]["value"],
                "false_per_hour": events["false_alarms_per_hour"]["value"],
            }
        rows.append(row)
    return rows


if __name__ == "__main__":
    raise SystemExit(Alarms().run())
