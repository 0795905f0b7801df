"""Onsets as rows: of the table in the terminal, and of ``onsets.csv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tactslip_torch.report.tables import SIMULATED_LINE, aligned

COLUMNS = (
    "file",
    "alarm_s",
    "onset_s",
    "end_s",
    "score",
    "probability",
    "statistic",
    "is_valid",
    "outcome",
    "true_onset_s",
    "delay_s",
    "simulated",
)
_MOST_ROWS = 40
_SAME_S = 1e-8


def alarm_outcome(alarm_s: float, truth: Mapping[str, Any]) -> dict[str, Any]:
    """What an alarm was: its ``outcome`` as in ``onset_rows``, of which onset, and how late.

    Args:
        alarm_s: when it was raised.
        truth: of an entry of ``onsets.json``.
    """
    if alarm_s in truth["false_alarms_s"]:
        return {"outcome": "false", "true_onset_s": None, "delay_s": None}
    for onset in truth["onsets"]:  # onsets ascend: the last one that has begun stays
        delay_s = alarm_s - onset["onset_s"]
        is_found = onset["outcome"] == "found" and abs(delay_s - onset["delay_s"]) < _SAME_S
        if is_found or delay_s > -truth["early_s"] - _SAME_S:
            behind = "late" if onset["outcome"] == "missed" else "repeated"
            outcome = "found" if is_found else "early" if delay_s < 0 else behind
            own = {"outcome": outcome, "true_onset_s": onset["onset_s"], "delay_s": delay_s}
        if is_found:
            break
    return own


def onset_rows(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every alarm, and every onset that was missed, in order of time; each with all ``COLUMNS``.

    ``outcome`` is that of the alarm: it ``found`` a slip, came ``early``, ``repeated`` the alarm of
    a slip, came too ``late`` for one that was missed, or is ``false``; or ``missed``, of an onset.
    ``None`` where the truth is not known.

    Args:
        content: of ``onsets.json``.
    """
    rows: list[dict[str, Any]] = []
    for entry in content["recordings"]:
        own = [alarm | {"at": alarm["alarm_s"]} for alarm in entry["alarms"]]
        own += [
            {"outcome": "missed", "true_onset_s": onset["onset_s"], "at": onset["onset_s"]}
            for onset in (entry["truth"] or {}).get("onsets", ())
            if onset["outcome"] == "missed"
        ]
        named = {"file": entry["file"], "simulated": entry["simulated"]}
        for row in sorted(own, key=lambda row: float(row["at"])):
            rows.append({column: (named | row).get(column) for column in COLUMNS})
    return rows


def onsets_title(entry: Mapping[str, Any], *, of_simulated: bool) -> str:
    """A line about one recording, which says what of it is simulated.

    Args:
        entry: of ``onsets.json``.
        of_simulated: whether the detector was trained on simulated data.
    """
    kind = "SIMULATED recording" if entry["simulated"] else "Recording"
    parts = [f"{kind} {entry['file']}"]
    parts += [f"material {entry['material']}"] if entry["material"] else []
    count = len(entry["alarms"])
    parts += [f"{count} alarm{'s' * (count != 1)}"]
    if truth := entry["truth"]:
        found = sum(onset["outcome"] == "found" for onset in truth["onsets"])
        parts += [f"{found} of {len(truth['onsets'])} slips found"]
        parts += [f"{len(truth['false_alarms_s'])} false"]
    parts += ["detector trained on simulated data"] if of_simulated else []
    return ", ".join(parts)


def onsets_table(rows: Sequence[Mapping[str, Any]], *, simulated: bool) -> str:
    """The first rows of ``onset_rows`` as text.

    Args:
        rows: of ``onset_rows``.
        simulated: whether any recording is; the first line says so.
    """
    cells = []
    for place, row in enumerate(rows[:_MOST_ROWS]):
        is_first = place == 0 or rows[place - 1]["file"] != row["file"]
        cells.append(
            [
                row["file"] if is_first else "",
                _number(row["alarm_s"], 3),
                _number(row["onset_s"], 3),
                _number(row["probability"], 2),
                {None: "-", True: "yes", False: "NO"}[row["is_valid"]],
                _number(row["true_onset_s"], 3),
                _number(row["delay_s"], 3),
                row["outcome"] or "-",
            ]
        )
    header = ["file", "alarm s", "onset s", "P(slip)", "valid", "true onset s", "delay s"]
    table = aligned([*header, "outcome"], cells) if cells else "no alarm, and no slip missed"
    rest = len(rows) - len(cells)
    more = [f"and {rest} more, see onsets.csv"] if rest else []
    return "\n".join([*([SIMULATED_LINE] if simulated else []), table, *more])


def onsets_summary(content: Mapping[str, Any], seconds: float) -> str:
    """What was heard in all, in a few lines.

    Args:
        content: of ``onsets.json``.
        seconds: that it took.
    """
    entries = content["recordings"]
    heard_s = sum(entry["duration_s"] for entry in entries)
    alarms = sum(len(entry["alarms"]) for entry in entries)
    invalid = sum(entry["decisions"]["invalid"] for entry in entries)
    number = sum(entry["decisions"]["number"] for entry in entries)
    lines = [
        f"{alarms} alarms in {heard_s:.1f} s of {len(entries)} recordings; "
        f"took {seconds:.1f} s, {heard_s / seconds:.0f} times real time"
    ]
    if invalid:
        lines.append(
            f"NOTE: {100 * invalid / number:.1f} % of the decisions are not valid: a channel in "
            "use is missing or dead; they count as long as another is left"
        )
    if events := content["events"]:
        delay = events["delay_ms"]
        median = f", median delay {delay['median']['value']:.1f} ms" if delay else ""
        lines.append(
            f"of {events['num_onsets']} slips {events['num_found']} found{median}, "
            f"{events['num_early']} early, {events['num_missed']} missed; "
            f"{events['num_false_alarms']} false alarms in {60 * events['quiet_hours']:.2f} "
            "minutes without slip"
        )
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
