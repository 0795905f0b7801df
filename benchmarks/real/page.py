"""REAL_DATA.md from the report: what the data are, how it was judged, and what came out."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.harness import QUICK_LINE
from benchmarks.real.bootstrap import COVERAGE
from benchmarks.real.report import tables
from benchmarks.real.watched import watched_figure

COMMAND = "python -m benchmarks.real"
SOURCE = "github.com/yayaneath/BioTacSP-DoS"
CITATION = (
    'B. S. Zapata-Impata, P. Gil, F. Torres, "Learning Spatio Temporal Tactile Features with a '
    'ConvLSTM for the Direction Of Slip Detection", Sensors 19(3):523, 2019, '
    "doi:10.3390/s19030523"
)
Report = Mapping[str, Any]


def page(report: Report, figure: Path, place: Path) -> str:
    """The content of REAL_DATA.md.

    Args:
        report: as ``--json`` keeps it.
        figure: its PNG.
        place: where the page goes; the figure is named from there.
    """
    of = tables(report)
    image = Path(os.path.relpath(figure.resolve(), place.resolve().parent)).as_posix()
    parts = [
        "# Real recordings: slip against stable touch on a BioTac SP",
        _introduction(report),
        *([f"**{QUICK_LINE}.**"] if report["quick"] else []),
        "## Limits",
        _verdict(report),
        *_shown(of, "limits"),
        "## The data",
        _data(report),
        "## Development data",
        _development(),
        "## Protocol",
        _protocol(report),
        "## Scores",
        *_shown(of, "scores"),
        f"![Objects and ROC curves]({image})",
        "### Each object, left out of everything",
        *_shown(of, "objects"),
        "### Each direction of slip",
        *_shown(of, "slips"),
        "### As streams",
        _watched(report),
        *_shown(of, "watched"),
        f"![One recording through detect]({watched_figure(Path(image)).as_posix()})",
        "### How sure the differences are",
        _bootstrap(report),
        *_shown(of, "differences"),
        "## Time",
        _times(report),
        *_shown(of, "times"),
        "## What the folds chose",
        *_shown(of, "choices"),
    ]
    return "\n\n".join(parts) + "\n"


def _shown(of: Mapping[str, Any], name: str) -> list[str]:
    return [table.markdown() for table in of[name]]


def _introduction(report: Report) -> str:
    command = shlex.join(report["command"]) + (" --quick" if report["quick"] else "")
    facts = ", ".join(report["machine"].values())
    versions = ", ".join(f"{name} {of}" for name, of in report["versions"].items())
    return (
        f"Written by `{COMMAND} {command}`. Nothing here is simulated. All was measured in that "
        f"one run, on {facts}; {versions}; code {report['code']}."
    )


def _verdict(report: Report) -> str:
    judged = [row["ok"] for row in report["limits"]]
    rows = {name: row["balanced_accuracy"] for name, row in report["sections"]["methods"].items()}
    above = [name for name, value in rows.items() if value > rows[report["ours"]]]
    return (
        f"{sum(judged)} of {len(judged)} limits are met, by {report['ours']}. Higher in balanced "
        f"accuracy, of all methods and seeds: {'; '.join(above) or 'none'}."
    )


def _data(report: Report) -> str:
    data = report["data"]
    windows = data["windows"]
    return (
        f"BioTac SP direction of slip, {SOURCE}: {CITATION}. Please cite it. **The repository "
        "states no licence, so nothing of it is copied here**: fetch it yourself and point "
        f"`data.root` at it.\n\n{data['recordings']} recordings of one fingertip on "
        f"{len(data['objects'])} objects ({', '.join(data['objects'])}): {data['channels']} "
        "electrodes in counts, about 92 Hz by the rows (100 Hz nominal), about three seconds each. "
        f"They make {windows['all']} windows, {windows['slip']} of slip in six directions and "
        f"{windows['all'] - windows['slip']} of stable touch. A label is of a whole recording: no "
        "onset is known, so delays cannot be told, and a window of a slip recording may hold "
        "little slip. Speeds and forces were not recorded, and there is no pressure channel, so "
        "nothing above some 45 Hz is in it. The set's own paper tells the direction (seven classes "
        "from 50 ms), which is another task: none of its numbers compares with those below."
    )


def _development() -> str:
    return (
        "**This set was looked at while this software was planned.** How windows are tared, which "
        "kinds of features and scaling there are, and what may be chosen from, for ours and for "
        "baselines alike, were settled with all objects in sight. So this is development data, and "
        "results are optimistic for every method whose grid and preprocessing we picked. One "
        "sensor, one laboratory and few objects say little about another hand."
    )


def _protocol(report: Report) -> str:
    data, settings = report["data"], report["settings"]
    lines = [
        f"The first half second of a recording is skipped, and its mean taken off each channel; no "
        f"method sees the absolute level. Windows of {data['samples']} samples, every half window.",
        "Each object is left out in turn; a method is fitted to the windows of the others and "
        "scores those of that object. Scores of all folds are pooled as they are, with the "
        "decision at 0: no threshold is set afterwards.",
        "Everything is fitted and chosen inside the fold, by balanced accuracy on training objects "
        "that are left out in turn. `recipe=general` ranks, scales and forms its constants anew "
        "without each of them, and takes the simplest machine within half a point of the best; "
        "`robust` and `paper` hold ranking and scaling. Simple statistics leave out "
        f"{settings['inner']} groups of objects. Features that look at no label are made once, for "
        "all windows or, those of random convolutions, for those of the fold. All methods balance "
        "the classes.",
        f"Ours: `recipe=general`, `robust` and `paper` on the pool of {data['pool']} features, by "
        "the parts that `tactslip_torch.train` uses; `general` has the values of each feature in "
        "ascending order over the electrodes beside them (`features.pooling=sorted`).",
        f"MiniRocket (aeon, {settings['rocket_kernels']:,} kernels, standardised) and "
        f"MultiRocketHydra (aeon, {settings['multi_rocket_kernels']:,} kernels of MultiRocket and "
        f"{settings['hydra_groups']} groups of Hydra's, each part with the scaler that aeon gives "
        "it), with ridge. Their features and scalers are fitted to the training windows. They draw "
        f"at random, so MiniRocket is shown with {len(settings['rocket_seeds'])} seeds.",
        "Logistic regression on the columns of our first detector of the same fold, and on mean, "
        "standard deviation, rms, range and mean size of differences of each channel, with or "
        f"without their logs; a random forest of {settings['trees']} trees on these.",
    ]
    return "\n".join(f"- {line}" for line in lines)


def _bootstrap(report: Report) -> str:
    return (
        f"Recordings are drawn anew within slip and within stable touch, "
        f"{report['settings']['draws']:,} times with a fixed seed, the same for both methods; "
        f"brackets hold {100 * COVERAGE:g} % of the differences. Scores are held, so this says "
        f"nothing of other training recordings or other objects. {_open(report)}"
    )


def _open(report: Report) -> str:
    """Which differences in balanced accuracy the draws leave open."""
    gaps = report["sections"]["differences"]
    unsure = [
        name
        for name, found in gaps.items()
        if found["balanced_accuracy"]["low"] <= 0 <= found["balanced_accuracy"]["high"]
    ]
    if not unsure:
        return "No interval of balanced accuracy holds 0."
    named = "; ".join(unsure)
    return f"**The interval of balanced accuracy holds 0, so nothing is settled, beside:** {named}."


def _watched(report: Report) -> str:
    found = report["sections"]["watched"]
    return (
        "Each whole recording through `StreamingDetector`, by the machine of the fold that left "
        f"its object out: a decision every {found['hop_ms']:g} ms, an alarm when {found['k']} of "
        f"{found['n']} decisions say slip (`onset=debounced`). Nothing was set on alarms, and no "
        "rate of false alarms is promised; when slip begins nobody knows, so there are no delays. "
        f"The picture is what `detect` leaves of one of them, `{found['shown']}`."
    )


def _times(report: Report) -> str:
    rounds = report["settings"]["rounds"]
    return (
        "On one thread, from a window in memory to its score, all methods in turns, medians of "
        f"{rounds} rounds. For one window alone the calls themselves weigh most, aeon's and "
        "scikit-learn's as well as ours. A fit counts the description of its training windows, at "
        "the rate at which they were described."
    )
