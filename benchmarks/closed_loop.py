"""A grip that an alarm saves: ``python -m benchmarks.closed_loop [sizes.lifts=N ...]``.

A gripper in MuJoCo lifts boxes and cylinders of materials that the detector has not seen, with
masses that its controller does not expect, and loads that grow gradually and suddenly
(``benchmarks.lifts``). What tightens the grip differs: the alarm of a ``StreamingDetector``, a
threshold on the energy of fast channels, a CUSUM of the contact's status, an oracle that knows how
fast pads slide; and nothing, with the planned and with twice the force. All of them get the same
lifts and one reflex. Puts its tables into docs/onset.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.gripper import Array
from benchmarks.harness import Benchmark, Job, say
from benchmarks.lifts import (
    HOP,
    REACH_MM,
    Energy,
    Lift,
    Listening,
    Never,
    Oracle,
    Trigger,
    run_lift,
)
from benchmarks.tables import Report, Table, percent
from benchmarks.trainings import resumed
from tactslip_torch import AlarmSettings, SlipDetector
from tactslip_torch.onset.rules import Cusum
from tactslip_torch.report import style
from tactslip_torch.simulation import SEEN_MATERIALS

SOURCES = (
    "tactslip_torch/pretrained/paper24-sim.pt",
    "benchmarks/alarms.py",
    "conf/onset/alarms.yaml",
)
_CYCLE = ("gradual", "sudden", "heavy", "gradual", "sudden", "steady") * 2
_KINDS = (*_CYCLE[:-1], "sudden, 1.4")
"""Of lifts, in turn; the last is shown apart, as few grips can save it."""
_OURS, _NEVER = "alarm and hint", "no reflex"
_CUSUM_CEILING = 1.5  # over its threshold: it comes down when a slip has ended


@dataclass(frozen=True)
class ClosedLoop(Benchmark):
    """Every lift with every trigger.

    Args:
        lifts: how many; a twelfth of them are loaded with 1.4 times the limit, shown apart.
        delays_ms: of the actuator.
        calibration: lifts of lighter objects of seen materials, which do not slip, with a grip
            raised by nobody's alarm, in which neither energy nor CUSUM may reach its threshold.
        detector: shipped one or file, trained on ``SEEN_MATERIALS``; empty: the one whose alarm
            ``python -m benchmarks.alarms`` has set with its first seed.
    """

    title = "A grip that an alarm tightens"
    about = "lifts in MuJoCo, in a closed loop: dropped, slid, and how much force it took"
    page, markers, has_headings = "docs/onset.md", "closed_loop", False
    quick = "lifts=2 delays_ms=[10] calibration=1 detector=paper24-sim"
    libraries = ("mujoco",)
    charts: ClassVar = {"": []}
    lifts: int = 240
    delays_ms: tuple[int, ...] = (10, 40)
    calibration: int = 20
    detector: str = ""

    def measure(self, job: Job) -> dict[str, Any]:
        """Rows of all lifts together, and of each kind at the first delay."""
        torch.set_num_threads(1)  # an actor hears one hop at a time
        path = self.detector or str(job.folder.parent / "alarms" / "seed-0" / "detector.pt")
        if not self.detector and not Path(path).exists():
            raise SystemExit(
                f"there is no {path}: run python -m benchmarks.alarms first, or give "
                "sizes.detector=paper24-sim"
            )
        is_file = Path(path).suffix == ".pt"
        load = SlipDetector.load if is_file else SlipDetector.pretrained
        detector = load(path)
        key = [path, repr(AlarmSettings.of(detector))]
        set_by = resumed(
            job.folder / "thresholds.json",
            [*key, f"{self.calibration}"],
            partial(_thresholds, detector, self.calibration),
        )
        triggers = _triggers(detector, set_by)
        found: list[dict[str, Any]] = []
        for number in range(self.lifts):
            kind = _KINDS[number % len(_KINDS)]
            say(f"lift {number + 1} of {self.lifts}: {kind}")
            own = [*key, f"{set_by}", f"{self.delays_ms}"]
            run = partial(_outcomes, kind, number, triggers, self.delays_ms)
            found.append({"kind": kind, "of": resumed(job.folder / f"{number}.json", own, run)})
        main = [lift["of"] for lift in found if lift["kind"] != _KINDS[-1]] or [found[0]["of"]]
        by_kind = {
            kind: {
                name: float(np.mean([lift["of"][name]["dropped"] for lift in of]))
                for name in main[0]
                if name.endswith(f"{self.delays_ms[0]}") or name in (_NEVER, "twice the grip")
            }
            for kind in dict.fromkeys(_KINDS)
            if (of := [lift for lift in found if lift["kind"] == kind])
        }
        return {
            "methods": {name: _row(main, name) for name in main[0]},
            "kinds": by_kind,
            "lifts": len(main),
            "calibration": self.calibration,
        }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All lifts, and each kind."""
        rows = [
            {
                "tightened by": _words(name),
                "dropped %": _percents(row["dropped"]),
                "more than with alarm and hint, %": _percents(row["beside"]),
                "slid mm": f"{row['slid'][1]:.2f} [{row['slid'][2]:.1f}]",
                "peak grip": f"{row['peak'][1]:.2f} [{row['peak'][2]:.2f}]",
                "mean grip": f"{row['mean'][1]:.2f}",
                "late ms": "-" if row["late"] is None else f"{row['late']:.0f}",
                "false alarms a lift": f"{row['false_alarms']:.2f}",
                "false hints a lift": f"{row['false_hints']:.2f}",
            }
            for name, row in numbers["methods"].items()
        ]
        note = (
            f"{numbers['lifts']} lifts. *Dropped*: with 95 % intervals of a bootstrap over lifts. "
            "*More than with alarm and hint*: the difference at the same delay. *Slid* and *peak "
            "grip*: median and, in brackets, 95 % quantile. Grips are multiples of the "
            "lowest grip that holds the largest load. *Late*: from the begin of a slide to the "
            "first tightening in it, median. *False*: the grip was tightened although no pad had "
            "slid in the quarter second before. The thresholds of energy and CUSUM are the highest "
            f"values in {numbers['calibration']} lifts of seen materials without slip."
        )
        kinds = [
            {"dropped %, by load": kind}
            | {_words(name): percent(share, 0) for name, share in of.items()}
            for kind, of in numbers["kinds"].items()
        ]
        return {"Lifts": Table(rows, note), "Dropped, by load": Table(kinds)}

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Drops, slides and force of every method, by delay."""
        methods = numbers["methods"]
        names = list(dict.fromkeys(name.split(", ")[0] for name in methods))
        drawing.set_size_inches(9.2, 4.2)
        panels = drawing.subplots(1, 3, sharey=True)
        titles = {"dropped": "dropped, %", "slid": "slid, mm", "peak": "peak grip / least needed"}
        for axes, (key, title) in zip(panels, titles.items(), strict=True):
            for name, row in methods.items():
                method, _, delay = name.partition(", ")
                is_first = delay in ("", _first_delay(methods))
                lane = names.index(method) + (0.0 if not delay else -0.14 if is_first else 0.14)
                middle, low, high = row[key] if key == "dropped" else np.array(row[key])[[1, 0, 2]]
                factor, colour = 100.0 if key == "dropped" else 1.0, style.PALETTE[not is_first]
                axes.plot(np.multiply([low, high], factor), [lane, lane], color=colour, alpha=0.4)
                axes.plot(factor * middle, lane, "o", color=colour, markersize=5)
            axes.set_title(title)
            style.lanes(axes, names)
        panels[1].set(xscale="log", xlim=(0.02, 1.5 * REACH_MM))
        delays = dict.fromkeys(name.partition(", ")[2] for name in methods if ", " in name)
        handles = [
            Line2D([], [], color=style.PALETTE[place], marker="o", label=f"{delay} ms of delay")
            for place, delay in enumerate(delays)
        ]
        style.legend_below(drawing, handles, len(handles))


def _words(name: str) -> str:
    method, _, delay = name.partition(", ")
    return f"{method}, {delay} ms" if delay else method


def _first_delay(methods: Iterable[str]) -> str:
    """That of the first method which has one."""
    return next(name.partition(", ")[2] for name in methods if ", " in name)


def _percents(shares: list[float] | None) -> str:
    """A percentage with its interval."""
    if shares is None:
        return "-"
    value, low, high = (f"{100 * share:.1f}" for share in shares)
    return f"{value} [{low}, {high}]"


def _thresholds(detector: SlipDetector, num: int) -> dict[str, float]:
    """What energy and CUSUM reach at most, in lifts without slip."""
    energy, cusum = -np.inf, -np.inf
    for number in range(num):
        lift = Lift(
            10_000 + number, "steady", mass=(0.4, 0.6), materials=SEEN_MATERIALS, tightens=True
        )
        of_energy = Energy(list(detector.pool.hand.fast))
        of_cusum = Listening(detector, _by_cusum(detector, np.inf))
        for trigger in (of_energy, of_cusum):
            run_lift(lift, trigger, 0.01)
        energy, cusum = max(energy, of_energy.highest), max(cusum, of_cusum.highest)
    return {"energy": float(energy), "cusum": float(cusum)}


def _by_cusum(detector: SlipDetector, threshold: float) -> AlarmSettings:
    """An alarm by a CUSUM of the status alone, every other hop."""
    settings, hop = AlarmSettings.of(detector), 2 * HOP
    rule = Cusum(evidence=hop / detector.pool.bin_samples, ceiling=_CUSUM_CEILING * threshold)
    return replace(settings, onset=None, hop_samples=hop, rule=rule, threshold=threshold)


def _triggers(
    detector: SlipDetector, set_by: Mapping[str, float]
) -> dict[str, Callable[[], Trigger]]:
    """What makes a trigger for one lift, by method."""
    above = 1.0 + 1e-6  # what calibration reached is not enough
    cusum = _by_cusum(detector, above * set_by["cusum"])
    fast = list(detector.pool.hand.fast)
    return {
        _OURS: partial(Listening, detector, with_hint=True),
        "alarm": partial(Listening, detector),
        "energy": partial(Energy, fast, above * set_by["energy"]),
        "CUSUM": partial(Listening, detector, cusum),
        "oracle": Oracle,
    }


def _outcomes(
    kind: str,
    number: int,
    triggers: Mapping[str, Callable[[], Trigger]],
    delays_ms: tuple[int, ...],
) -> dict[str, dict[str, Any]]:
    """What becomes of one lift, by method and delay."""
    over = (1.4, 1.4) if kind == _KINDS[-1] else (1.02, 1.2)
    lift = Lift(number, kind.split(",")[0], over)  # type: ignore[arg-type]
    found = {
        _NEVER: run_lift(lift, Never(), 0.0),
        "twice the grip": run_lift(lift, Never(), 0.0, factor=2.0),
    }
    for name, make in triggers.items():
        for delay_ms in delays_ms:
            found[f"{name}, {delay_ms}"] = run_lift(lift, make(), 1e-3 * delay_ms)
    return found


def _row(lifts: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Of one method in all lifts: values with intervals, quantiles and means."""
    own = {key: [lift[name][key] for lift in lifts] for key in lifts[0][name]}
    dropped = np.array(own["dropped"], float)
    ours = f"{_OURS}, {name.partition(', ')[2] or _first_delay(lifts[0])}"
    beside = dropped - np.array([lift[ours]["dropped"] for lift in lifts], float)
    late = [ms for ms in own["late_ms"] if ms is not None]
    return {
        "dropped": _interval(dropped),
        "beside": None if name == ours else _interval(beside),
        "late": float(np.median(late)) if late else None,
        **{key: float(np.mean(own[key])) for key in ("false_alarms", "false_hints")},
        **{
            key: np.quantile(own[source], [0.05, 0.5, 0.95]).tolist()
            for key, source in (("slid", "slid_mm"), ("peak", "peak"), ("mean", "mean"))
        },
    }


def _interval(values: Array) -> list[float]:
    """A mean with the ends of its 95 % interval, by the bootstrap over lifts."""
    drawn = np.random.default_rng(0).integers(0, len(values), (2000, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), [0.025, 0.975])
    return [float(values.mean()), float(low), float(high)]


if __name__ == "__main__":
    raise SystemExit(ClosedLoop().run())
