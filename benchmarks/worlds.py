"""Every world beside each other, the worst first: ``python -m benchmarks.worlds``.

It measures nothing: rows are of the kept numbers of other benchmarks, so it takes seconds. One row
is a simulated world, the gripper in MuJoCo, or a set of real recordings.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Any, ClassVar

from benchmarks import RESULTS
from benchmarks.harness import Benchmark, Job
from benchmarks.sources import is_current
from benchmarks.tables import Table

SOURCES = (
    "benchmarks/results/alarms.json",
    "benchmarks/results/closed_loop.json",
    "benchmarks/results/generalisation.json",
    "benchmarks/results/real.json",
    "benchmarks/results/real_onsets.json",
)
Row = dict[str, Any]
_OF_GENERALISATION = {
    "test": "test",
    "held-out materials": "unseen",
    "another session": "",
    "half of the channels missing, held out": "",
    "slips at 10 mV found, held out": "",
    "slips at 30 mV found, held out": "",
}
"""Measures, and the role whose baselines are beside them."""


@dataclass(frozen=True)
class Worlds(Benchmark):
    """Kept numbers, by what they were measured on."""

    title = "All worlds"
    about = (
        "what was measured in each world; *found*: slips with an alarm within 250 ms of the first "
        "release, *balanced*: balanced accuracy of windows, *kept*: lifts in which the object "
        "was not lost. The data are named in each row"
    )
    page, is_page, is_simulated = "docs/worlds.md", True, False
    quick = ""
    charts: ClassVar = {"": [("The worst first", ("ours", "best baseline, %"))]}

    def measure(self, job: Job) -> dict[str, Any]:
        """Rows of all results that are there."""
        rows, missing = list[Row](), list[str]()
        for name, rows_of in _READERS.items():
            path = RESULTS / f"{name}.json"
            if not path.exists():
                missing.append(f"`{name}` was not measured")
                continue
            if not is_current(name):
                missing.append(f"`{name}` is of earlier code")
            report = json.loads(path.read_text(encoding="utf-8"))
            rows += rows_of(report["numbers"])
        rows.sort(key=lambda row: float(row["ours, %"]))
        for row in rows:
            if row["best baseline, %"] is not None:
                row["ahead by"] = f"{row['ours, %'] - row['best baseline, %']:+.1f}"
        shown = [
            row | {name: f"{row[name]:.1f}" for name in _PERCENT if row[name] is not None}
            for row in rows
        ]
        note = "; ".join(missing)
        return {
            "tables": {
                "The worst first": Table(shown, f"{note[:1].upper()}{note[1:]}." if note else "")
            }
        }


_PERCENT = ("ours, %", "best baseline, %")


def _row(world: str, data: str, measure: str, ours: float) -> Row:
    return {
        "world": world,
        "data": data,
        "measure": measure,
        "ours, %": ours,
        "best baseline, %": None,
        "ahead by": "-",
        "baseline": "-",
        "delay, ms": "-",
        "false alarms": "-",
    }


def _beside(row: Row, baselines: Mapping[str, float]) -> Row:
    """The row with the best of some baselines."""
    if not baselines:
        return row
    best = max(baselines, key=baselines.__getitem__)
    return row | {"best baseline, %": baselines[best], "baseline": best}


def _alarms(numbers: Mapping[str, Any]) -> Iterator[Row]:
    kinds = {of["kind"]: of["alarm"] for of in numbers["tables"]["False alarms"][0]}
    for of in numbers["tables"]["Slips found"][0]:
        row = _row(of["world"], "simulated", "found", float(of["found %"]))
        others = {name: of.get(f"{name} %", "-") for name in ("bins", "detail")}
        row["delay, ms"] = of["median ms"]
        row["false alarms"] = f"{kinds['confounders'].split()[0]} /h" if kinds else "-"
        yield _beside(row, {name: float(value) for name, value in others.items() if value != "-"})


def _closed_loop(numbers: Mapping[str, Any]) -> Iterator[Row]:
    kept = {
        name.partition(",")[0]: 100 * (1 - of["dropped"][0])
        for name, of in reversed(numbers["methods"].items())  # the first delay last, which stays
    }
    ours = next(of for name, of in numbers["methods"].items() if name.startswith("alarm and hint"))
    row = _row("lifts in a closed loop", "MuJoCo", "kept", kept["alarm and hint"])
    row["delay, ms"] = "-" if ours["late"] is None else f"{ours['late']:.0f}"
    row["false alarms"] = f"{ours['false_alarms']:.2f} a lift"
    yield _beside(row, {name: kept[name] for name in ("energy", "CUSUM")})


def _real(numbers: Mapping[str, Any]) -> Iterator[Row]:
    for name, of in numbers["sets"].items():
        mean = {
            method: 100 * fmean(own["balanced_accuracy"]) for method, own in of["methods"].items()
        }
        yield _beside(_row(f"{name}, objects left out", "real", "balanced", mean.pop(_OURS)), mean)


def _real_onsets(numbers: Mapping[str, Any]) -> Iterator[Row]:
    every = [of | _named(of["method"]) for of in numbers["tables"]["Real onsets"][0]]
    for of in every:
        if not of["name"].startswith("alarm"):
            continue
        baselines = {
            other["name"]: float(other["found %"].split()[0])
            for other in every
            if other["rate"] == of["rate"] and not other["name"].startswith("alarm")
        }
        world = f"osu, begins of slips, {of['name']}, set to {of['rate']}"
        row = _row(world, "real", "found", float(of["found %"].split()[0]))
        row["delay, ms"] = of["delay ms"].split()[0]
        row["false alarms"] = f"{of['false an hour'].split()[0]} /h"
        yield _beside(row, baselines)


def _named(method: str) -> dict[str, str]:
    name, _, rate = method.rpartition(", ")
    return {"name": name, "rate": rate}


def _generalisation(numbers: Mapping[str, Any]) -> Iterator[Row]:
    for name, by_seed in numbers["experiments"].items():
        for measure, role in _OF_GENERALISATION.items():
            values = [of[measure] for of in by_seed.values() if measure in of]
            if not values:
                continue
            kind = "found" if "found" in measure else "balanced"
            row = _row(f"+exp={name}, {measure}", "simulated", kind, fmean(values))
            each = next(iter(by_seed.values()))["baselines"] if role else {}
            baselines = {
                label.replace("_", " "): fmean(
                    of["baselines"][label][role] for of in by_seed.values()
                )
                for label in each
            }
            yield _beside(row, baselines)


_OURS = "SlipClassifier"
_READERS: Mapping[str, Callable[[Mapping[str, Any]], Iterator[Row]]] = {
    "alarms": _alarms,
    "closed_loop": _closed_loop,
    "real": _real,
    "real_onsets": _real_onsets,
    "generalisation": _generalisation,
}


if __name__ == "__main__":
    raise SystemExit(Worlds().run())
