"""The tables and limits of ``benchmarks.real``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.harness import QUICK_LINE, Table, limits, number
from benchmarks.real.bootstrap import in_words

AIM_BALANCED, AIM_AUC = 0.952, 0.99
TIMES_FASTER = 10.0

Report = Mapping[str, Any]


def limit_rows(rows: Mapping[str, Any], ours: str, rockets: Sequence[str]) -> list[dict[str, Any]]:
    """What was wanted of ours, and by how much it is met or missed.

    Args:
        rows: of methods.
        ours: name of the one that limits are for.
        rockets: names of the baselines by random convolutions; times are compared with the first.
    """
    mine, found = rows[ours], []
    for rocket in rockets:
        other = rows[rocket]["balanced_accuracy"]
        gap = mine["balanced_accuracy"] - other
        found.append(
            {
                "what": f"balanced accuracy above that of {rocket}",
                "measured": f"{100 * mine['balanced_accuracy']:.2f} %, {100 * gap:+.2f} points",
                "limit": f"above {100 * other:.2f} %",
                "ok": gap > 0,
            }
        )
    for name, key, aim in (
        ("balanced accuracy", "balanced_accuracy", AIM_BALANCED),
        ("AUC", "auc", AIM_AUC),
    ):
        found.append(
            {
                "what": f"{name}, the aim",
                "measured": f"{100 * mine[key]:.2f} %, {100 * (mine[key] - aim):+.2f} points",
                "limit": f"at least {100 * aim:g} %",
                "ok": mine[key] >= aim,
            }
        )
    for how, words in (("batched", "many windows at once"), ("alone", "one window alone")):
        ratio = mine["time"][f"{how}_times_faster"]["median"]
        found.append(
            {
                "what": f"times faster than {rockets[0]}: {words}",
                "measured": number(ratio),
                "limit": f"at least {TIMES_FASTER:g}",
                "ok": ratio >= TIMES_FASTER,
            }
        )
    return found


def tables(report: Report) -> dict[str, list[Table]]:
    """All tables by title, the limits first."""
    return {
        "limits": [limits(report["limits"])],
        "scores": [scores_table(report)],
        "objects": [objects_table(report)],
        "slips": [scenes_table(report)],
        "differences": [differences_table(report)],
        "watched": [watched_table(report)],
        "times": [times_table(report)],
        "choices": [choices_table(report)],
    }


def scores_table(report: Report) -> Table:
    """What all windows together say of each method."""
    cells = []
    for name, row in report["sections"]["methods"].items():
        worst = row["worst"]
        values = (row[key] for key in _SCORES)
        cells.append(
            [
                name,
                *(f"{100 * value:.2f}" for value in values),
                f"{worst['object']} {100 * worst['balanced_accuracy']:.1f}",
            ]
        )
    return Table(["method", *_SCORES.values(), "worst object %"], cells)


_SCORES = {
    "balanced_accuracy": "balanced accuracy %",
    "auc": "AUC %",
    "sensitivity": "sensitivity %",
    "specificity": "specificity %",
    "objects_mean": "mean over objects %",
}


def objects_table(report: Report) -> Table:
    """Balanced accuracy on each object, which its fold left out."""
    rows = report["sections"]["methods"]
    names = report["data"]["objects"]
    cells = [
        [name, *(f"{100 * row['objects'][of]:.1f}" for of in names)] for name, row in rows.items()
    ]
    return Table(["balanced accuracy %", *names], cells)


SCENES = {
    "n": "north",
    "s": "south",
    "e": "east",
    "w": "west",
    "cw": "clockwise",
    "aw": "anticlockwise",
    "t": "stable touch",
}
"""What the set's folders mean."""


def scenes_table(report: Report) -> Table:
    """The share of windows that are told right, by direction of slip."""
    rows = report["sections"]["methods"]
    there = next(iter(rows.values()))["scenes"]
    names = [name for name in SCENES if name in there]
    cells = [
        [name, *(f"{100 * row['scenes'][of]:.1f}" for of in names)] for name, row in rows.items()
    ]
    return Table(["windows told right, %", *(SCENES[name] for name in names)], cells)


def watched_table(report: Report) -> Table:
    """Recordings with an alarm, by direction of slip."""
    found = report["sections"]["watched"]["by_scene"]
    names = [name for name in SCENES if name in found]
    cells = [
        [SCENES[name], str(found[name]["recordings"]), str(found[name]["with_alarm"])]
        for name in names
    ]
    return Table(["watched as streams", "recordings", "with an alarm"], cells)


def differences_table(report: Report) -> Table:
    """Ours minus each baseline, with bootstrap intervals."""
    header = [f"{report['ours']} minus", "balanced accuracy, points", "above in", "AUC, points"]
    cells = [
        [
            name,
            in_words(found["balanced_accuracy"]),
            f"{100 * found['balanced_accuracy']['share']:.1f} % of draws",
            in_words(found["auc"]),
        ]
        for name, found in report["sections"]["differences"].items()
    ]
    return Table(header, cells)


def times_table(report: Report) -> Table:
    """What a fit and a window cost on one thread."""
    cells = []
    for name, row in report["sections"]["methods"].items():
        time = row["time"]
        if time is None:
            cells.append([name, number(row["fit_s"]), *["-"] * 5])
            continue
        cells.append(
            [
                name,
                number(row["fit_s"]),
                str(time["batch"]),
                number(1e6 * time["batched_s"]),
                f"{number(time['batched_times_faster']['median'])} x",
                number(1e6 * time["alone_s"]),
                f"{number(time['alone_times_faster']['median'])} x",
            ]
        )
    header = ["method", "fit of a fold, s", "batch", "us a window, batched", "faster"]
    note = f"Faster: than {report['rockets'][0]}, round by round; below 1 is slower."
    return Table([*header, "us a window, alone", "faster "], cells, note)


def choices_table(report: Report) -> Table:
    """What the folds chose for themselves, and how many of them."""
    cells = []
    for name, row in report["sections"]["methods"].items():
        counts = Counter(
            ", ".join(f"{key} {_short(value)}" for key, value in chosen.items())
            for chosen in row["chosen"]
        )
        text = "; ".join(f"{choice} ({num}x)" for choice, num in counts.most_common())
        cells.append([name, text])
    return Table(["method", "chosen inside the folds"], cells)


def _short(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"


def report_text(report: Report) -> str:
    """A report as text, limits first."""
    lines = [
        "REAL recordings of one BioTac SP; DEVELOPMENT data, see REAL_DATA.md",
        f"machine   {', '.join(report['machine'].values())}; 1 thread",
        f"versions  {', '.join(f'{name} {of}' for name, of in report['versions'].items())}",
        *([QUICK_LINE] if report["quick"] else []),
    ]
    parts = [table.text() for of in tables(report).values() for table in of]
    return "\n\n".join(["\n".join(lines), *parts])
