"""How channels differ and move together, real and simulated: ``python -m benchmarks.realism``.

With ``data.root=FOLDER`` of the BioTac SP set (``+exp=biotacsp_dos``). Beside its electrodes: the
films of the simulated hand as the paper's protocol has it (``scene=paper``) and of the hard one
(``scene=hard``). Levels are standard deviations of a window without its straight line: vibration,
whatever the unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from hydra.utils import instantiate
from sklearn.metrics import roc_auc_score

from benchmarks.harness import Benchmark, Job
from benchmarks.subjects import Array, composed
from benchmarks.tables import Table
from tactslip_torch.data.recording import RecordingSource, Timeline

WINDOW_S, WINDOWS = 0.25, 4
"""Length of a window, 25 samples of the real set; and windows in a stretch of one second."""
REST_S = (1.2, 0.1)
"""Before an onset, the stretch without slip: the hand holds still for most of it."""
STATISTICS = {
    "spread": "spread of levels between channels",
    "wander": "wander of a channel's level about the mean over channels",
    "common": "wander of the mean over channels",
    "level_correlation": "correlation of the channels' levels",
    "sample_correlation": "magnitude of the correlation of samples, mean over pairs",
    "strongest": "the same with the most similar channel",
    "chance": "the same of as many independent samples",
}
AREAS = {
    "mean": "AUC of the mean over channels of the log level",
    "sd": "AUC of the standard deviation over channels of the level",
    "single": "AUC of the level of the best channel",
}


@dataclass(frozen=True)
class Realism(Benchmark):
    """Statistics of three sets, without a detector.

    Cycles of every material of the simulated sets.
    """

    title = "Channels, real and simulated"
    about = "how channels differ and move together, without slip and with it"
    quick = "cycles=1"
    is_simulated = False
    charts: ClassVar = {"": [("Channels", "")]}
    cycles: int = 6

    def measure(self, job: Job) -> dict[str, Any]:
        """Statistics of each set; the real one needs ``data.root=FOLDER``."""
        cycles = f"data.cycles={self.cycles}"
        overrides = {
            "real": ["+exp=biotacsp_dos", *job.overrides],
            "simulated, paper": ["scene=paper", cycles],
            "simulated, hard": ["scene=hard", cycles],
        }
        shown: dict[str, dict[str, str]] = {text: {} for text in STATISTICS.values()}
        areas: dict[str, dict[str, str]] = {text: {} for text in AREAS.values()}
        for name, given in overrides.items():
            source = instantiate(composed("train", given).data, _convert_="all")
            windows = {kind: _windows(source, kind == "slip") for kind in ("rest", "slip")}
            for kind, own in windows.items():
                for statistic, value in _statistics(own).items():
                    shown[STATISTICS[statistic]][f"{name}, {kind}"] = f"{value:.2f}"
            for area, value in _areas(windows["slip"], windows["rest"]).items():
                areas[AREAS[area]][name] = f"{value:.2f}"
        note = (
            f"Windows of {WINDOW_S:g} s. Real: electrodes of one fingertip; simulated: films of "
            "five fingers. Spreads and wander are of natural logarithms."
        )
        channels = Table([{"statistic": text} | of for text, of in shown.items()], note)
        by_threshold = Table([{"slip by a threshold": text} | of for text, of in areas.items()])
        return {"tables": {"Channels": channels, "Areas": by_threshold}}


def _stretches(times: Timeline, is_slip: bool) -> list[float]:
    """Starts of stretches of one second of a class."""
    found = [*times.sliding_s, *times.slip_s] if is_slip else list(times.non_slip_s)
    if not is_slip:
        found += [(onset - REST_S[0], onset - REST_S[1]) for onset in times.onsets_s]
    length_s = WINDOWS * WINDOW_S
    return [
        start_s + number * length_s
        for start_s, end_s in found
        for number in range(int((end_s - start_s) / length_s + 1e-6))
    ]


def _windows(source: RecordingSource, is_slip: bool) -> Array:
    """Windows of a class without their straight lines, ``[N, C, WINDOWS, samples]``.

    Raises:
        ValueError: if there is no stretch long enough.
    """
    size = round(WINDOW_S * source.sample_rate_hz)
    line = np.linspace(-1.0, 1.0, size)
    line /= np.linalg.norm(line)
    fast = [i for i, channel in enumerate(source.hand.channels) if channel.adapting == "fast"]
    rows = []
    for recording in source.ids:
        starts = _stretches(source.timeline(recording), is_slip)
        samples = source.load(recording).samples.double().numpy()[fast] if starts else np.empty(0)
        for start_s in starts:
            first = round(start_s * source.sample_rate_hz)
            stretch = samples[:, first : first + WINDOWS * size]
            if stretch.shape[-1] == WINDOWS * size and np.isfinite(stretch).all():
                cut = stretch.reshape(len(fast), WINDOWS, size)
                cut = cut - cut.mean(-1, keepdims=True)
                rows.append(cut - (cut @ line)[..., None] * line)
    if not rows:
        what = "slip" if is_slip else "rest"
        raise ValueError(f"no stretch of {WINDOWS * WINDOW_S:g} s of {what} in the recordings")
    return np.stack(rows)


def _levels(windows: Array) -> Array:
    """Levels ``[N, C, WINDOWS]``; a window without any change has the least level there is."""
    levels = windows.std(-1)
    return np.asarray(np.maximum(levels, levels[levels > 0].min()))


def _statistics(windows: Array) -> dict[str, float]:
    logs = np.log(_levels(windows))
    about, own = logs - logs.mean(1, keepdims=True), logs - logs.mean(2, keepdims=True)
    levels = np.corrcoef(own.transpose(1, 0, 2).reshape(own.shape[1], -1))
    pairs = []
    for row in windows:
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.abs(np.nan_to_num(np.corrcoef(row.reshape(len(row), -1))))
        np.fill_diagonal(found, np.nan)
        pairs.append(found)
    num = windows.shape[-2] * windows.shape[-1]
    return {
        "spread": float(logs.mean(2).std(1).mean()),
        "wander": float(about.std(2, ddof=1).mean()),
        "common": float(logs.mean(1).std(1, ddof=1).mean()),
        "level_correlation": float(levels[np.triu_indices(len(levels), 1)].mean()),
        "sample_correlation": float(np.nanmean(pairs)),
        "strongest": float(np.nanmax(pairs, -1).mean()),
        "chance": float(np.sqrt(2 / (np.pi * num))),
    }


def _areas(slip: Array, rest: Array) -> dict[str, float]:
    """Areas under the ROC curve of numbers that would tell slip by a threshold."""
    both = [_levels(one).transpose(1, 0, 2).reshape(one.shape[1], -1) for one in (slip, rest)]
    truth = np.repeat([1, 0], [one.shape[1] for one in both])
    levels = np.concatenate(both, axis=1)
    return {
        "mean": float(roc_auc_score(truth, np.log(levels).mean(0))),
        "sd": float(roc_auc_score(truth, levels.std(0))),
        "single": max(float(roc_auc_score(truth, channel)) for channel in levels),
    }


if __name__ == "__main__":
    raise SystemExit(Realism().run())
