"""A certificate as one page: the verdict, a figure, then tables. It asks for no other file."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from tactslip_torch.report.certificate import (
    Points,
    certificate_figure,
    found_in,
    number,
    verdict,
)

MARK = '<meta name="generator" content="tactslip_torch.certify">'
"""In every page, so that only our own are replaced."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto;
  padding: 0 1.2rem; }
h1 { font-size: 1.5rem; font-weight: 600; margin: 0 0 .2rem; }
h2 { font-size: 1.02rem; font-weight: 600; margin: 2rem 0 .4rem; }
.sub { color: #666; margin: 0 0 1rem; }
.verdict { font-size: 1.12rem; padding: .7rem 1rem; border-left: .45rem solid; }
.good { border-color: #009e73; background: #e9f6f1; }
.bad { border-color: #d55e00; background: #fbeee5; }
.tiles { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1rem 0; }
.tile { flex: 1 1 10rem; border: 1px solid #ddd; border-radius: .4rem; padding: .5rem .8rem; }
.tile b { display: block; font-size: 1.35rem; font-weight: 600; }
.tile span, .note { color: #666; font-size: .87rem; }
img { width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .87rem;
  font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: #666; vertical-align: bottom; }
th, td { padding: .25rem .7rem .25rem 0; border-bottom: 1px solid #e5e5e5; }
td { vertical-align: top; overflow-wrap: anywhere; }
td.num { text-align: right; white-space: nowrap; padding-right: 1.3rem; }
th.num { text-align: right; padding-right: 1.3rem; }
td.no { color: #b84300; font-weight: 600; }
@media print { body { margin: 0; max-width: none; font-size: 11px; }
  h2 { break-after: avoid; } tr, img, .tile { break-inside: avoid; }
  .verdict { -webkit-print-color-adjust: exact; print-color-adjust: exact; } }
"""
_HOLDS = {True: "yes", False: "NO", None: "open"}


def certificate_page(content: Mapping[str, Any], points: Points) -> str:
    """The page as HTML, with its figure inside and no script.

    Args:
        content: of ``certificate.json``.
        points: of every set and kind, for the figure.
    """
    drawn = io.BytesIO()
    certificate_figure(content, points).savefig(drawn, format="png", dpi=170, facecolor="white")
    picture = base64.b64encode(drawn.getvalue()).decode()
    title = f"Float32 certificate of {content['detector']['file']}"
    alt = "Error of the score against its size, with margin and bound; errors of generated extremes"
    kind = "simulated" if content["simulated"] else "recorded"
    tone = "good" if content["holds"] else "bad"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="sub">{content["detector"]["features"]} features, {kind} data</p>',
        f'<p class="verdict {tone}">{escape(verdict(content))}</p>',
        _tiles(content),
        f'<img alt="{alt}" src="data:image/png;base64,{picture}">',
        *_tables(content, kind),
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n{MARK}\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _tiles(content: Mapping[str, Any]) -> str:
    sets = content["sets"]
    judged = {name: facts for name, facts in sets.items() if name != "calibration"}
    num_bins = sum(facts["bins"] for facts in judged.values())
    inside = sum(facts["inside_margin"]["bins"] for facts in judged.values())
    flips = [
        sum(facts["flips"][part] for facts in judged.values())
        for part in ("inside_margin", "outside_margin")
    ]
    worst = [facts["error"]["worst_sd"] for facts in sets.values()]
    shown = {
        "worst error on recordings, sd of the score": None if None in worst else max(worst),
        "margin, sd of the score": content["margin"]["sd"],
        f"of {num_bins} held-out bins inside the margin": inside,
        "of them decide otherwise, inside and outside the margin": f"{flips[0]} and {flips[1]}",
    }
    tiles = [
        f'<div class="tile"><b>{escape(number(value))}</b><span>{escape(what)}</span></div>'
        for what, value in shown.items()
    ]
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _tables(content: Mapping[str, Any], kind: str) -> list[str]:
    conditions = [
        [row["name"], found_in(row), row["wanted"], _HOLDS[row["holds"]]]
        for row in content["conditions"]
    ]
    sets, extremes = content["sets"].items(), content["extremes"].items()
    features = [[name, *facts["worst_feature"].values()] for name, facts in sets]
    ranges = [
        [own, x["low_v"], x["high_v"], x["span_v"], x["relative_span"]]
        for own, x in content["range"]["kinds"].items()
    ]
    heads = ["set", "bins", "worst", "99 %", "median", "features", "scaler", "head"]
    heads += ["in margin", "flips", "outside range"]
    sorts = ["kind", "bins", "flagged", "worst of valid", "median of valid", "worst", "median"]
    sorts += ["flips", "outside range"]
    spans = ["channels", "least", "greatest", "smallest span, filtered", "over its magnitude"]
    valid = f"And a valid bin: {content['range']['validity']}."
    flagged = (
        "Flagged: not valid, as a dead sensor is (rule below); what is said of the score holds for "
        "the others. A spike is flagged where the filter leaves none of it in the bin."
    )
    stages = "Features, scaler and head: the worst that arises in each."
    return [
        _table("What was checked", ["", "found", "wanted", "holds"], conditions),
        _table(f"Bins of {kind} recordings, errors in sd of the score", heads,
               [_set_row(*pair) for pair in sets], stages),
        _table("Generated extremes, errors in sd of the score", sorts,
               [_extreme_row(*pair) for pair in extremes], flagged),
        _table("The scaled feature that is off most, of a range of 2",
               ["set", "feature", "error"], features),
        _table("Margin, in units of the score", ["", "score", ""], _margin_rows(content)),
        _table("Condition numbers", ["", "", ""], _condition_rows(content["condition_numbers"])),
        _table("Inputs for which it holds, volts", spans, ranges, valid),
        _table("Of what", ["", ""], _origin_rows(content)),
    ]  # fmt: skip


def _set_row(name: str, facts: Mapping[str, Any]) -> list[object]:
    error, stages = facts["error"], facts["stages"]
    return [
        name,
        facts["bins"],
        *(error[key] for key in ("worst_sd", "p99_sd", "median_sd")),
        *(stages[key]["worst_sd"] for key in ("features", "scaler", "head")),
        facts["inside_margin"]["bins"],
        _flips(facts),
        facts["outside_range"],
    ]


def _extreme_row(name: str, facts: Mapping[str, Any]) -> list[object]:
    of_valid, of_all = facts["error_of_valid"], facts["error"]
    return [
        name,
        facts["bins"],
        facts["invalid"],
        *(part[key] for part in (of_valid, of_all) for key in ("worst_sd", "median_sd")),
        _flips(facts),
        facts["outside_range"],
    ]


def _flips(facts: Mapping[str, Any]) -> int:
    return int(facts["flips"]["inside_margin"] + facts["flips"]["outside_margin"])


def _margin_rows(content: Mapping[str, Any]) -> list[list[object]]:
    head, margin = content["head"], content["margin"]
    of_bound = head["note"] or "any order of summation, with or without FMA"
    searched = f"by a search of the box; the bound is {number(head['ratio'])} times that"
    return [
        ["margin", margin["score"], margin["rule"]],
        ["bound of the head", head["bound"], of_bound],
        ["worst error of the head seen", head["worst_seen"], searched],
        ["worst error on calibration bins", margin["worst_calibration_error"], "end to end"],
        ["standard deviation of the score", content["score_sd"], "over calibration bins"],
    ]


def _condition_rows(numbers: Mapping[str, Any]) -> list[list[object]]:
    rows: list[list[object]] = [
        [f"gradient of the score {name.replace('_', ' ')}, {which}", x[which], f"{x['bins']} bins"]
        for name, x in numbers["score"].items()
        for which in ("median", "largest")
    ]
    solve = numbers["solve"]
    if not isinstance(solve, Mapping):
        return [*rows, ["solve", None, str(solve)]]
    return rows + [[f"solve: {name.replace('_', ' ')}", x, ""] for name, x in solve.items()]


def _origin_rows(content: Mapping[str, Any]) -> list[list[object]]:
    rows: list[list[object]] = [
        ["detector", content["detector"]["file"]],
        ["SHA-256", content["detector"]["sha256"]],
        ["compared", "float32 with float64, " + _inside(content["dtype"]["inside"])],
    ]
    for name, facts in content["data"]["drawn"].items():
        text = (
            f"{facts['recordings']} {facts['role']} recordings of {', '.join(facts['materials'])}"
        )
        text += f"; {facts['recordings_of_training']} of them the detector was trained on"
        rows.append([name, text])
    versions = ", ".join(f"{name} {value}" for name, value in content["versions"].items())
    rows += [["split", content["data"]["split"]], ["seed", str(content["seed"])]]
    return [*rows, ["threads", str(content["threads"])], ["versions", versions]]


def _inside(arithmetic: str) -> str:
    if arithmetic == "double":
        return "float32 samples filtered, described and scaled in float64"
    return "float32 samples filtered and described in float32"


def _table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[object]], note: str = ""
) -> str:
    """A table under its title; numbers flush right."""
    columns = list(zip(*rows, strict=True))
    is_number = [not any(isinstance(value, str) for value in column) for column in columns]

    def cells(tag: str, row: Sequence[object]) -> str:
        shown = []
        for right, value in zip(is_number, row, strict=True):
            own = "no" if value == "NO" else "num" if right else ""
            shown.append(f'<{tag} class="{own}">{escape(number(value))}</{tag}>')
        return f"<tr>{''.join(shown)}</tr>"

    head = cells("th", header) if any(header) else ""
    below = f'<p class="note">{escape(note)}</p>' if note else ""
    body = "".join(cells("td", row) for row in rows)
    return f'<h2>{escape(title)}</h2><div class="wide"><table>{head}{body}</table></div>{below}'
