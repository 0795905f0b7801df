"""How channels differ and move together, real and simulated: statistics without a detector.

``python -m benchmarks.simulation.realism data.root=FOLDER`` with the folder of the BioTac SP set
(``+exp=biotacsp_dos``). Beside its electrodes: the films of the simulated hand as the paper's
protocol has it (``scene=paper``) and of the hard one (``scene=hard``). A table, and numbers in
``benchmarks/results`` (``--json FILE`` to keep them elsewhere, ``--quick`` to see that it runs).

Levels are standard deviations of a window without its straight line: vibration, whatever the unit.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

import tactslip_torch
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import RESULTS, keep_numbers, refuse_paths
from benchmarks.tables import Table
from tactslip_torch.commands.entry import conf_dir, errors_in_one_line
from tactslip_torch.data.recording import RecordingSource, Timeline
from tactslip_torch.features.cache import source_digest

Array = NDArray[np.float64]

WINDOW_S = 0.25
"""Length of a window: 25 samples of the real set."""

WINDOWS = 4
"""Windows in a stretch, over which levels may wander."""

REST_S = (1.2, 0.1)
"""Before an onset, the stretch without slip: the hand holds still for most of it."""

SETS = ("real", "simulated, paper", "simulated, hard")

STATISTICS = {
    "spread": "spread of levels between channels",
    "wander": "wander of a channel's level about the mean over channels",
    "common": "wander of the mean over channels",
    "level_correlation": "correlation of the channels' levels",
    "sample_correlation": "|correlation| of samples, mean over pairs",
    "strongest": "|correlation| of samples with the most similar channel",
    "chance": "|correlation| of samples of as many independent ones",
}
"""Of one class; spreads and wander are standard deviations of natural logarithms."""

AREAS = {
    "mean": "mean over channels of the log level",
    "sd": "standard deviation over channels of the level",
    "single": "level of the best channel",
}
"""Numbers that would tell slip by a threshold, by their area under the ROC curve."""


def stretches(times: Timeline, is_slip: bool) -> list[tuple[float, float]]:
    """Stretches of one second of a class, ``[(start_s, end_s)]``."""
    if is_slip:
        found = [*times.sliding_s, *times.slip_s]
    else:
        found = list(times.non_slip_s)
        found += [(onset - REST_S[0], onset - REST_S[1]) for onset in times.onsets_s]
    length_s = WINDOWS * WINDOW_S
    return [
        (start_s + number * length_s, start_s + (number + 1) * length_s)
        for start_s, end_s in found
        for number in range(int((end_s - start_s) / length_s + 1e-6))
    ]


def gathered(source: RecordingSource, is_slip: bool) -> Array:
    """Windows of a class without their straight lines, ``[N, C, WINDOWS, samples]``.

    Args:
        source: of recordings; of their channels those that adapt fast count.
        is_slip: which class.

    Raises:
        ValueError: if there is no stretch long enough.
    """
    rate_hz = source.sample_rate_hz
    size = round(WINDOW_S * rate_hz)
    line = np.linspace(-1.0, 1.0, size)
    line /= np.linalg.norm(line)
    fast = [i for i, channel in enumerate(source.hand.channels) if channel.adapting == "fast"]
    rows = []
    for recording in source.ids:
        spans = stretches(source.timeline(recording), is_slip)
        samples = source.load(recording).samples.double().numpy()[fast] if spans else None
        for start_s, _ in spans:
            first = round(start_s * rate_hz)
            part = samples[:, first : first + WINDOWS * size]  # type: ignore[index]
            if part.shape[-1] == WINDOWS * size and np.isfinite(part).all():
                cut = part.reshape(len(fast), WINDOWS, size)
                cut = cut - cut.mean(-1, keepdims=True)
                rows.append(cut - (cut @ line)[..., None] * line)
    if not rows:
        what = "slip" if is_slip else "rest"
        raise ValueError(f"no stretch of {WINDOWS * WINDOW_S:g} s of {what} in the recordings")
    return np.stack(rows)


def levels_of(windows: Array) -> Array:
    """Levels, ``[N, C, WINDOWS]``; a window without any change has the least level there is."""
    levels = windows.std(-1)
    return np.asarray(np.maximum(levels, levels[levels > 0].min()))


def statistics(windows: Array) -> dict[str, float]:
    """``STATISTICS`` of a class.

    Shape:
        - windows: ``[N, C, WINDOWS, samples]``
    """
    logs = np.log(levels_of(windows))
    about = logs - logs.mean(1, keepdims=True)
    own = logs - logs.mean(2, keepdims=True)
    levels = np.corrcoef(own.transpose(1, 0, 2).reshape(own.shape[1], -1))
    samples = np.stack([_correlations(row.reshape(len(row), -1)) for row in windows])
    num = windows.shape[-2] * windows.shape[-1]
    return {
        "spread": float(logs.mean(2).std(1).mean()),
        "wander": float(about.std(2, ddof=1).mean()),
        "common": float(logs.mean(1).std(1, ddof=1).mean()),
        "level_correlation": float(levels[np.triu_indices(len(levels), 1)].mean()),
        "sample_correlation": float(np.nanmean(samples)),
        "strongest": float(np.nanmax(samples, -1).mean()),
        "chance": float(np.sqrt(2 / (np.pi * num))),
    }


def _correlations(rows: Array) -> Array:
    """Magnitudes of all correlations between rows, their own NaN."""
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.abs(np.nan_to_num(np.corrcoef(rows)))
    np.fill_diagonal(found, np.nan)
    return np.asarray(found)


def areas(slip: Array, rest: Array) -> dict[str, float]:
    """``AREAS`` of windows of slip over those without.

    Shape:
        - slip, rest: ``[N, C, WINDOWS, samples]``
    """
    both = [levels_of(one).transpose(1, 0, 2).reshape(one.shape[1], -1) for one in (slip, rest)]
    truth = np.repeat([1, 0], [one.shape[1] for one in both])
    levels = np.concatenate(both, axis=1)
    return {
        "mean": float(roc_auc_score(truth, np.log(levels).mean(0))),
        "sd": float(roc_auc_score(truth, levels.std(0))),
        "single": max(float(roc_auc_score(truth, channel)) for channel in levels),
    }


def sources(overrides: Sequence[str], cycles: int) -> list[RecordingSource]:
    """The three sets, as ``SETS``.

    Args:
        overrides: of the real one, with ``data.root``.
        cycles: of every material of the simulated ones.

    Raises:
        ValueError: for bad overrides.
    """
    cut = f"data.cycles={cycles}"
    every = [["+exp=biotacsp_dos", *overrides], ["scene=paper", cut], ["scene=hard", cut]]
    try:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return [instantiate(compose("train", each).data, _convert_="all") for each in every]
    except HydraException as error:
        raise ValueError(str(error)) from None


def measure(overrides: Sequence[str], cycles: int, quick: bool) -> dict[str, Any]:
    """The report, JSON-able.

    Args:
        overrides: with ``data.root``.
        cycles: of every material of the simulated sets.
        quick: whether that is too little to mean anything.
    """
    sets = {}
    for name, source in zip(SETS, sources(overrides, cycles), strict=True):
        slip, rest = (gathered(source, is_slip) for is_slip in (True, False))
        sets[name] = {
            "simulated": source.is_simulated,
            "sample_rate_hz": source.sample_rate_hz,
            "channels": slip.shape[1],
            "stretches": {"slip": len(slip), "rest": len(rest)},
            "slip": statistics(slip),
            "rest": statistics(rest),
            "areas": areas(slip, rest),
        }
    return {
        "code": source_digest(Path(tactslip_torch.__file__).parent),
        "quick": quick,
        "machine": machine_facts(),
        "versions": versions(()),
        "settings": {"window_s": WINDOW_S, "windows": WINDOWS, "cycles": cycles},
        "sets": sets,
    }


def table(report: dict[str, Any]) -> Table:
    """Every statistic of every set: rest, then slip."""
    sets = [report["sets"][name] for name in SETS]
    rows = [
        [text, *(f"{one['rest'][name]:.2f} / {one['slip'][name]:.2f}" for one in sets)]
        for name, text in STATISTICS.items()
    ]
    rows += [
        [f"AUC of the {text}", *(f"{one['areas'][name]:.2f}" for one in sets)]
        for name, text in AREAS.items()
    ]
    note = (
        f"Rest / slip, windows of {WINDOW_S:g} s; real: electrodes of one fingertip at "
        f"{sets[0]['sample_rate_hz']:g} Hz; simulated: films of five fingers at "
        f"{sets[1]['sample_rate_hz']:g} Hz. Code {report['code']}."
    )
    return Table(["statistic", *SETS], rows, note)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.simulation.realism",
        description="How channels differ and move together: real, simulated, and simulated hard.",
    )
    parser.add_argument(
        "overrides", nargs="*", metavar="key=value", help="of train; data.root=FOLDER of the set"
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the numbers go")
    parsed = parser.parse_intermixed_args(arguments)
    if not parsed.quick:
        parsed.json = parsed.json or RESULTS / "realism.json"
    refuse_paths(parser, parsed, "json")
    if wrong := [text for text in parsed.overrides if "=" not in text]:
        parser.error(f"overrides are key=value, got {wrong[0]!r}")
    with errors_in_one_line():
        report = measure(parsed.overrides, 1 if parsed.quick else 6, parsed.quick)
    print(table(report).text())
    keep_numbers(report, parsed.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
