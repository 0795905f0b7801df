"""Which sensors matter, as tables for the terminal and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from tactslip_torch.report.tables import SIMULATED_LINE, aligned

ROLE_WORDS = {"held_out": "held-out", "test": "test", "unseen": "unseen"}
"""What the roles are called; ``held_out`` bins are training bins of groups left out in turn."""

ANEW_WORDS = {
    "ranked": "by the recipe's ranking, in which strong channels crowd out others",
    "shared": "as many of each channel",
}
BEST_LINE = (
    "best few, greedily by held-out accuracy (which is optimistic for it; test and unseen choose "
    "nothing):"
)


def sensors_table(content: Mapping[str, Any]) -> str:
    """One row per channel, finger and kind: gradients, what its absence costs, it alone.

    Args:
        content: of ``sensors.json``.
    """
    head = [SIMULATED_LINE] if content["simulated"] else []
    head += [*lines_about(content), with_all_line(content)]
    tables = [unit_rows(content, unit) for unit in content["best"]]
    return "\n".join(head) + "\n\n" + "\n\n".join(aligned(rows[0], rows[1:]) for rows in tables)


def lines_about(content: Mapping[str, Any]) -> list[str]:
    """What the columns mean."""
    return [
        f"balanced accuracy, mean over groups; machines of {content['num_bins']['held_out']} "
        "training bins; held-out: each of the groups "
        f"{', '.join(content['groups']['held_out'])} left out",
        "moves score: root mean square of gradient times own spread, in sd of the score, at "
        "non-slip / slip bins",
        "lost: points of balanced accuracy without it, [95 % of draws of recordings]; anew: "
        f"features selected again among the others, {ANEW_WORDS[content['settings']['anew']]}",
    ]


def unit_rows(content: Mapping[str, Any], unit: str) -> list[list[str]]:
    """A header, and a row for each channel, finger or kind."""
    roles = list(content["num_bins"])
    header = [unit, "in use", "moves score"]
    header += [f"lost {ROLE_WORDS[role]}" for role in roles]
    header += [f"anew {ROLE_WORDS[role]}" for role in roles]
    rows = [_cells(row, roles) for row in content["units"] if row["unit"] == unit]
    return [[*header, "alone, held-out %"], *rows]


def with_all_line(content: Mapping[str, Any]) -> str:
    """What is reached with all sensors, in words."""
    words = []
    for name, verdict in content["with_all"].items():
        scores = (f"{r} {percent(s)}" for r, s in _named(verdict["balanced_accuracy"]).items())
        words.append(f"{name.replace('_', ' ')}: {', '.join(scores)} %")
    return "all sensors, features " + "; ".join(words)


def best_table(content: Mapping[str, Any]) -> str:
    """Accuracy kept with the best few, in the order in which they join; of all units."""
    parts = []
    for unit in content["best"]:
        rows = best_rows(content, unit)
        parts.append(aligned(rows[0], rows[1:], num_left=2))
    return f"{BEST_LINE}\n\n" + "\n\n".join(parts)


def best_rows(content: Mapping[str, Any], unit: str) -> list[list[str]]:
    """A header, and a row for each step of the best few."""
    roles = list(content["num_bins"])
    header = [f"{unit}s", "joins", "features", *(f"{ROLE_WORDS[role]} %" for role in roles)]
    rows = [[*header, *(f"lost {ROLE_WORDS[role]}" for role in roles)]]
    for number, step in enumerate(content["best"][unit], 1):
        scores = [percent(step["balanced_accuracy"][role]) for role in roles]
        row = [str(number), step["joins"], str(step["num_features"])]
        rows.append([*row, *scores, *(_interval(step["lost"][role]) for role in roles)])
    return rows


def sensors_csv(content: Mapping[str, Any]) -> str:
    """One row per channel, finger and kind, all of its numbers in columns."""
    places = {
        (unit, step["joins"]): number
        for unit, steps in content["best"].items()
        for number, step in enumerate(steps, 1)
    }
    rows = []
    for row in content["units"]:
        flat = {name: row[name] for name in ("unit", "name", "num_channels", "features_in_use")}
        flat["joins_as"] = places.get((row["unit"], row["name"]), "")
        for at in ("non_slip", "slip"):
            flat[f"moves_score_{at}"] = "" if row["gradient"] is None else row["gradient"][at]
        for what in ("lost", "lost_anew"):
            for role, numbers in row[what].items():
                flat |= {f"{what}_{role}_{end}": value for end, value in numbers.items()}
        flat |= {f"alone_{role}": value for role, value in row["alone"].items()}
        rows.append(flat | {"simulated": content["simulated"]})
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def percent(share: float) -> str:
    """A share in percent, two decimals.

    Example:
        >>> percent(0.97531)
        '97.53'
    """
    return f"{100 * share:.2f}"


def _cells(row: Mapping[str, Any], roles: Sequence[str]) -> list[str]:
    gradient = row["gradient"]
    moved = "-" if gradient is None else f"{gradient['non_slip']:.2f} / {gradient['slip']:.2f}"
    cells = [row["name"], str(row["features_in_use"]), moved]
    cells += [_interval(row["lost"][role]) for role in roles]
    cells += [_interval(row["lost_anew"][role]) for role in roles]
    return [*cells, percent(row["alone"]["held_out"])]


def _interval(lost: Mapping[str, float]) -> str:
    return f"{100 * lost['lost']:+.2f} [{100 * lost['low']:+.2f}, {100 * lost['high']:+.2f}]"


def _named(scores: Mapping[str, float]) -> dict[str, float]:
    return {ROLE_WORDS[role]: score for role, score in scores.items()}
