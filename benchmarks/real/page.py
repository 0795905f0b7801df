"""REAL_DATA.md from the report: what the data are, how it was judged, and what came out."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.outcome import QUICK_LINE
from benchmarks.real.bootstrap import COVERAGE
from benchmarks.real.report import tables
from benchmarks.real.tried import tried, tried_table
from benchmarks.real.watched import watched_figure
from benchmarks.reproduction.page import shown

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
        "## What was tried before",
        _before(report),
        f"<details><summary>{len(tried())} variants</summary>\n\n{shown(tried_table())}\n\n"
        "</details>",
    ]
    return "\n\n".join(parts) + "\n"


def _shown(of: Mapping[str, Any], name: str) -> list[str]:
    return [shown(table) for table in of[name]]


def _introduction(report: Report) -> str:
    command = shlex.join(report["command"]) + (" --quick" if report["quick"] else "")
    facts = ", ".join(report["machine"].values())
    versions = ", ".join(f"{name} {of}" for name, of in report["versions"].items())
    return (
        f"Written by `{COMMAND} {command}`. Nothing here is simulated. All was measured in that "
        f"one run, on {facts}; {versions}. But for two things: the figures of 'What was tried "
        "before' are a log that exploration scripts left, and TSFEL's rows, with the time that "
        "they took, are kept, so they may come from an earlier run."
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
        "rivals alike, were settled with all objects in sight. So this is development data, and "
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
        "Everything is fitted and chosen inside the fold. The choices of all but one method are "
        "by balanced accuracy on training objects that are left out in turn. Ours takes the mean "
        "over these objects, with ranking and scaling held, as `train` does (K and C); forest and "
        f"SVC leave out {settings['inner']} groups of objects and refit all; logistic regression "
        "leaves out one object at a time. MiniRocket's ridge is here in two ways, of which the "
        "first leaves out windows. Features that look at no label are made once, for all windows "
        "or, MiniRocket's, for those of the fold. All methods balance the classes.",
        f"Ours: `recipe=robust` and `recipe=paper` on the pool of {data['pool']} features, by the "
        "parts that `tactslip_torch.train` uses. What is timed is `SlipDetector.judge`.",
        f"MiniRocket (aeon, {settings['rocket_kernels']:,} kernels, fitted to the training "
        "windows), standardised, and ridge, whose penalty alpha is chosen in two ways from one "
        "grid. **By windows**: `RidgeClassifierCV`, which leaves one window out and takes the "
        "least squared error. So do MiniRocket's authors, though without class weights and with "
        "a shorter grid. Half of the window left out is in its neighbours, so this tells little "
        "of another object. **By objects**: one training object left out at a time, by "
        "balanced accuracy, all but MiniRocket's features refitted, as the other rivals choose. "
        f"It draws at random, so {len(settings['rocket_seeds'])} seeds are shown, and in each way "
        "the one in the middle by balanced accuracy is what ours stands beside.",
        f"MultiRocketHydra (aeon, {settings['multi_rocket_kernels']:,} kernels of MultiRocket and "
        f"{settings['hydra_groups']} groups of Hydra's, each part with the scaler that aeon gives "
        "it) and ridge, whose penalty is chosen by objects, with the same seeds. Its features and "
        "scalers are fitted once in a fold, without labels.",
        f"TSFEL, all features, and a random forest of {settings['trees']} trees "
        f"({settings['inner_trees']} while choosing). RBF SVC: features by the t-test on our pool, "
        "compressed and scaled as `robust` does. Logistic regression: mean, standard deviation, "
        "range, and standard deviation and mean size of differences of each channel, with or "
        "without their logs.",
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
        "the rate at which they were described (TSFEL's when its rows were made, perhaps earlier)."
    )


def _before(report: Report) -> str:
    rows = [row for row in tried() if not row["what"].startswith("rival")]
    best = max(rows, key=lambda row: float(row["balanced_accuracy"]))
    return (
        "Exploration scripts, not this command, made the figures below, on the same windows and "
        "folds unless a row says otherwise; prototypes of ours and settings of rivals. The best "
        f"of {len(rows)} of ours ({best['what']}) reached {100 * best['balanced_accuracy']:.2f} % "
        f"balanced accuracy and {100 * best['auc']:.2f} % AUC. It is no result: to take it would "
        "be to choose by the objects that were left out. MiniRocket draws windows by their place, "
        "so the order of recordings, which differs here, is another draw as a seed is."
    )
