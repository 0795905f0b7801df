"""What follows from the measurements of ``benchmarks.onset``: limits and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from benchmarks.onset.front import JUDGED, compute
from benchmarks.outcome import heading
from benchmarks.rates import information
from benchmarks.tables import Table, limits, limits_last, number
from tactslip_torch.training.alarm import FIRST_TRANSITION, OURS

SECTIONS = ("trained", "front", "rivals")
ROLES = {"test": "materials trained on, other cycles", "unseen": "new materials"}
SHOWN = {OURS: "our detector", FIRST_TRANSITION: "our detector, first transition (paper)"}
"""Names of methods for people, where they differ."""

Rows = Sequence[Mapping[str, Any]]


def limit_rows(front: Rows, rivals: Rows) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold.

    Thresholds must keep their target on other recordings of the materials they were set on, as far
    as the interval can tell; and no rival with a threshold for that target may find more slips.
    """
    rows = []
    for row in front:
        rate, target = row["test"]["false_alarms_per_hour"], row["threshold"]["target_per_hour"]
        rows.append(
            {
                "what": f"{row['align']}, hop {row['hop_ms']:g} ms: false alarms an hour on other "
                "recordings, low end of the interval",
                "measured": number(rate["low"]),
                "limit": f"<= {target:g}",
                "ok": rate["low"] <= target,
            }
        )
    (ours,) = (row for row in rivals if row["method"] == OURS)
    others = [row for row in rivals if row["scorer"] != OURS]
    for role, what in ROLES.items():
        most = max((row[role]["found"]["value"] for row in others), default=0.0)
        found = ours[role]["found"]["value"]
        rows.append(
            {
                "what": f"slips found, %, {what}, hop of the rivals",
                "measured": percent(found),
                "limit": f">= {percent(most)}, the best rival",
                "ok": found >= most,
            }
        )
        rows.append(
            information(f"median delay, ms, {what}, hop of the rivals", delay(ours[role], "median"))
        )
    return rows


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    found, settings = report["sections"], report["settings"]
    return {
        "Limits": [limits(report["limits"])],
        "What a filter costs in accuracy": [_filters(found["trained"], found["front"]["rows"])],
        **{
            f"Hops and filters, {what}": [_front(found["front"], role)]
            for role, what in ROLES.items()
        },
        f"Rivals, a decision every {settings['rival_hop_ms']:g} ms": [_rivals(found["rivals"])],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report), titled=True))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line: target, and hours that it was set and checked on."""
    settings, found = report["settings"], report["sections"]
    return (
        "alarms on the simulated hand; thresholds for "
        f"{settings['target_per_hour']:g} false alarms an hour; hops and filters: "
        f"{hours_text(found['front']['streams'])}; rivals: "
        f"{hours_text(found['rivals']['streams'])}"
    )


def hours_text(streams: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Hours without slip, and slips, that thresholds were set on and judged on."""

    def amount(scenes: Mapping[str, Mapping[str, float]]) -> str:
        quiet = sum(scene["hours"] for scene in scenes.values() if not scene["slips"])
        slips = sum(scene["slips"] for scene in scenes.values())
        return f"{number(quiet)} h without slip and {slips:,} slips"

    setting, seen, unseen = (amount(streams[role]) for role in ("calibrate", *JUDGED))
    return f"set on {setting}, checked on {seen} of seen and {unseen} of unseen materials"


def percent(share: float) -> str:
    """A share for people.

    Example:
        >>> percent(0.98765)
        '98.8'
    """
    return f"{100 * share:.1f}"


def delay(events: Mapping[str, Any], which: str) -> str:
    """Median or p95 of the delays with its interval, ms; a dash where no slip was found."""
    if events["delay_ms"] is None:
        return "-"
    return _between(events["delay_ms"][which], lambda value: f"{value:.0f}")


def rate(events: Mapping[str, Any]) -> str:
    """False alarms an hour with their interval."""
    return _between(events["false_alarms_per_hour"], number)


def _between(of: Mapping[str, float], text: Callable[[float], str]) -> str:
    return f"{text(of['value'])} ({text(of['low'])} to {text(of['high'])})"


_HEADER = ["delay, ms", "p95, ms", "found, %", "early, %", "missed, %", "false alarms an hour"]
_NOTE = (
    "Simulated hand. Delay: from the exact onset to the alarm, look-ahead in it, median and p95 of "
    "slips found within 500 ms. Early: an alarm up to 200 ms before the onset. In brackets 95 % "
    "intervals over recordings."
)


def _events(events: Mapping[str, Any]) -> list[str]:
    outcomes = [percent(events[name]["value"]) for name in ("found", "early", "missed")]
    return [delay(events, "median"), delay(events, "p95"), *outcomes, rate(events)]


def _filters(trained: Mapping[str, Mapping[str, Any]], rows: Rows) -> Table:
    ahead = {row["align"]: row["look_ahead_ms"] for row in rows}
    header = ["filter", "look-ahead, ms", "bins right, seen, %", "bins right, unseen, %"]
    header += ["features", "training bins", "training, s"]
    cells = [
        [
            align,
            f"{ahead[align]:g}",
            *(percent(of["balanced_accuracy"][role]) for role in JUDGED),
            str(of["features"]),
            f"{of['training_bins']:,}",
            number(of["seconds"]),
        ]
        for align, of in trained.items()
    ]
    note = (
        "Balanced accuracy of bins of 50 ms, of recordings that were not trained on, knocks and "
        "arm motion among them; trained on the same recordings behind each filter. Look-ahead: of "
        "the channels that the detector uses; centred frames of gauges reach 12.5 ms, of films "
        "2.5 ms. Trailing looks at nothing ahead and is half a frame late."
    )
    return Table(header, cells, note)


def _front(front: Mapping[str, Any], role: str) -> Table:
    rows = front["rows"]
    engines = list(rows[0]["push_s"])
    header = ["filter", "hop, ms", *_HEADER]
    is_first = role == "test"
    if is_first:
        header += [f"compute, {engine}, ms/s" for engine in engines]
    cells = []
    for row in rows:
        cost = [number(1e3 * compute(row, engine)) for engine in engines] if is_first else []
        name = row["align"] + (" *" if role in row["on"] else "")
        name += " +" if is_first and "compute" in row["on"] else ""
        cells.append([name, f"{row['hop_ms']:g}", *_events(row[role]), *cost])
    note = f"{_NOTE} *: no other is better in median delay and in slips not found."
    if is_first:
        note += (
            " +: nor in median delay and compute. Compute: milliseconds for a second of stream on "
            "one thread, pushes of one hop each."
        )
    return Table(header, cells, note)


def _rivals(rivals: Mapping[str, Any]) -> Table:
    header = ["method", "materials", *_HEADER, "a decision, ms"]
    cells = []
    for row in rivals["rows"]:
        name = SHOWN.get(row["method"], row["method"])
        for role in JUDGED:
            short = "seen" if role == "test" else "unseen"
            cells.append([name, short, *_events(row[role]), number(1e3 * row["push_s"])])
    fit, bins = rivals["fit"], rivals["fit"]["bins"]
    note = (
        f"{_NOTE} All watch the same recordings, behind the same filter; each has its own "
        "calibration and threshold, by the same rule for the same target, but first transition, "
        f"which has no threshold. MiniRocket: {fit['kernels']:,} kernels, its ridge fitted in "
        f"{number(fit['seconds'])} s to {bins['slip']:,} slip and {bins['non_slip']:,} non-slip "
        "bins of our training recordings. A decision: the push of one hop, on one thread."
    )
    return Table(header, cells, note)
