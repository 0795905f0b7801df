"""What follows from the measurements of ``benchmarks.simulation``: limits, a default, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.outcome import heading
from benchmarks.rates import NOT_MEASURED, information, not_measured
from benchmarks.tables import Table, limits, limits_last, number

SECTIONS = ("cost", "errors", "accuracy", "parts", "needed")

MOST_SOME = 0.35  # of a batch of 24 elements, what one of 6 may cost
MOST_WINDOW = 0.1  # of whole recordings, what a second of 15 may cost
MOST_NEEDED_S = 60.0  # for the needed windows of the paper's 280 cycles on two cores
PAPER_RECORDINGS = 280

MOST_FRICTION = 0.03  # of static friction, error that a recommended step may have
MOST_ONSET_S = 0.5e-3  # a sample at 2 kHz
MOST_LOST = 0.01  # of balanced accuracy, that the recommended rung may lose

Rows = Sequence[Mapping[str, Any]]


def limit_rows(parts: Mapping[str, Mapping[str, float]], needed: Rows) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold; those of lugre's parts inform."""
    rows = []
    for rung, seconds in parts.items():
        shares = (
            ("6 of 24 elements, in contact and asked for / all", "some alone", MOST_SOME),
            ("6 of 24 elements in contact, all channels asked for / all", "some", MOST_SOME),
            ("1 s window at an onset / all", "window", MOST_WINDOW),
        )
        for what, name, most in shares:
            share = seconds[name] / seconds["whole"]
            what = f"{rung}, batch: {what}"
            if rung == "kinematic":
                rows.append(_at_most(what, share, most))
            else:
                rows.append(information(what, number(share)))
    found = {row["rung"]: row for row in needed}
    for rung in ("kinematic", "lugre"):
        what = f"{rung}, needed windows of the paper's 280 cycles on 2 cores, s"
        row = found.get(rung)
        if row is None or row["recordings"] != PAPER_RECORDINGS:
            rows.append(not_measured(what, f"<= {MOST_NEEDED_S:g}"))
        else:
            rows.append(_at_most(what, row["seconds"], MOST_NEEDED_S))
    return rows


def _at_most(what: str, measured: float, most: float) -> dict[str, Any]:
    return {
        "what": what,
        "measured": number(measured),
        "limit": f"<= {most:g}",
        "ok": measured <= most,
    }


def recommended(costs: Rows, errors: Rows, accuracy: Rows) -> dict[str, Any]:
    """The rung and step to take by default, and why, from the numbers alone.

    The step is the longest whose errors stay within ``MOST_FRICTION`` and ``MOST_ONSET_S`` on
    every dynamic rung. The rung is the cheapest whose detectors lose no more than ``MOST_LOST`` of
    balanced accuracy, judged on each rung's recordings beside the detector trained on them.

    Returns:
        ``step_us``, ``rung`` (``None`` where nothing qualifies or was measured) and ``why``.
    """
    step_us = _step(errors)
    rung, lost = _rung(costs, accuracy)
    why = []
    if step_us is None:
        why.append("no step measured keeps the errors asked for")
    else:
        worst = [row for row in errors if row["step_us"] == step_us]
        why.append(
            f"{step_us:g} us is the longest step with friction within "
            f"{100 * MOST_FRICTION:g} % ({100 * max(r['friction_error'] for r in worst):.2g} %) "
            f"and onset within {1e3 * MOST_ONSET_S:g} ms "
            f"({1e3 * max(r['onset_error_s'] for r in worst):.2g} ms) of Radau"
        )
    if rung is None:
        why.append("accuracy was not measured")
    else:
        cheapest = {
            row["rung"]: row["seconds_per_minute"]
            for row in costs
            if row["step_us"] in (step_us, None) and row["engine"] != "eager"
        }
        cost = ", ".join(f"{name} {number(value)} s" for name, value in cheapest.items())
        why.append(
            f"{rung} is the cheapest rung (a simulated minute: {cost}) whose detectors lose at "
            f"most {100 * MOST_LOST:g} points on any rung's test ({100 * lost:.1f})"
        )
    return {"step_us": step_us, "rung": rung, "why": "; ".join(why)}


def _step(errors: Rows) -> float | None:
    steps = {row["step_us"] for row in errors if row["step_us"] is not None}
    fine = [
        step
        for step in steps
        if all(
            row["friction_error"] <= MOST_FRICTION and row["onset_error_s"] <= MOST_ONSET_S
            for row in errors
            if row["step_us"] == step
        )
    ]
    return max(fine, default=None)


def _rung(costs: Rows, accuracy: Rows) -> tuple[str | None, float]:
    """The cheapest rung that loses little, else the one that loses least; and what it loses."""
    finest = {row["rung"]: row for row in accuracy}
    if not finest:
        return None, 0.0
    lost = {
        rung: max(finest[test]["on"][test] - row["on"][test] for test in finest)
        for rung, row in finest.items()
    }
    cost = {
        rung: min(row["seconds_per_minute"] for row in costs if row["rung"] == rung)
        for rung in finest
    }
    fine = [rung for rung in finest if lost[rung] <= MOST_LOST]
    rung = min(fine, key=cost.__getitem__) if fine else min(lost, key=lost.__getitem__)
    return rung, max(0.0, lost[rung])


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    found = report["sections"]
    return {
        "Limits": [limits(report["limits"])],
        "Rungs and steps": [_ladder(found["cost"], found["errors"], found["accuracy"])],
        "Trained on one rung, judged on another": [_across(found["accuracy"])],
        "Parts of a batch, and a training's windows": [_parts(found["parts"], found["needed"])],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report)))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line, and what is recommended."""
    default = report["recommended"]
    step = "-" if default["step_us"] is None else f"{default['step_us']:g} us"
    return (
        f"the simulated hand's rungs; recommended: rung {default['rung'] or '-'}, step {step}: "
        f"{default['why']}"
    )


def _ladder(costs: Rows, errors: Rows, accuracy: Rows) -> Table:
    by_place = {(row["rung"], row["step_us"]): row for row in errors}
    trained = {(row["rung"], row["step_us"]): row["accuracy"] for row in accuracy}
    header = ["rung", "step, us", "engine", "s per simulated minute", "of it integration"]
    header += ["friction error, %", "onset error, ms", "balanced test accuracy, %"]
    cells = []
    for row in costs:
        place = (row["rung"], row["step_us"])
        error = by_place.get(place)
        accurate = None if row["engine"] == "eager" else trained.get(place)
        cells.append(
            [
                row["rung"],
                "-" if row["step_us"] is None else f"{row['step_us']:g}",
                row["engine"],
                number(row["seconds_per_minute"]),
                number(row["integration_s"]),
                "-" if error is None else number(100 * error["friction_error"]),
                "-" if error is None else number(1e3 * error["onset_error_s"]),
                "-" if accurate is None else f"{100 * accurate:.1f}",
            ]
        )
    note = (
        "24 channels, one process, one thread; median of rounds. Errors: the worst of single "
        "elements against scipy's Radau, rtol 1e-9, of static friction, sampled at every step; the "
        "kinematic row is the closed form against LuGre. The eager engine: many short recordings "
        "together, by proportion. A step longer than a sample (500 us) is refused by a scene; its "
        "cost is that of a coarser recording, its accuracy not measured."
    )
    return Table(header, cells, note)


def _across(accuracy: Rows) -> Table:
    if not accuracy:
        return Table(["trained on"], [[NOT_MEASURED]])
    tests = list(accuracy[0]["on"])
    header = ["trained on", "step, us", *(f"on {rung}, %" for rung in tests)]
    cells = [
        [
            row["rung"],
            "-" if row["step_us"] is None else f"{row['step_us']:g}",
            *(f"{100 * row['on'][rung]:.1f}" for rung in tests),
        ]
        for row in accuracy
    ]
    note = "Balanced accuracy on test cycles of the seen materials, each rung at its finest step."
    return Table(header, cells, note)


def _parts(parts: Mapping[str, Mapping[str, float]], needed: Rows) -> Table:
    names = {
        "whole": "24 elements, whole recordings",
        "some": "6 of 24 elements in contact",
        "some alone": "the same, and only their channels asked for",
        "window": "1 s at an onset",
    }
    rungs = list(parts)
    cells = [[text, *(number(parts[r][name]) for r in rungs)] for name, text in names.items()]
    by_rung = {row["rung"]: row for row in needed}
    if by_rung:
        counts = sorted({row["recordings"] for row in needed})
        what = f"needed windows of {', '.join(map(str, counts))} recordings, 2 processes"
        cells.append(
            [what, *(number(by_rung[r]["seconds"]) if r in by_rung else "-" for r in rungs)]
        )
    note = (
        "Seconds. On lugre the truth about onsets and ends is read from the integrated contact, "
        "which takes every stroke to its end whatever is asked for: a window saves the rest. A "
        "channel out of contact still has its noise, mains, arm and converter. A second touches "
        "4 blocks of a quarter second and one before them, of 61."
    )
    return Table(["batch", *rungs], cells, note)
