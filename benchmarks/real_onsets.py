"""Onsets of real slips: ``python -m benchmarks.real_onsets FOLDER``.

The folder has the trials that ``benchmarks.real_sets`` reads as ``osu``: acceleration and angular
rate of two fingertips, with the speed of the object by motion tracking. Each object is left out in
turn; the classifier of slipping now is fitted on the others, and every method has the threshold
that gives the same rate of false alarms on these. Puts its table into docs/real_data.md.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.harness import Benchmark, Job, say
from benchmarks.real_sets import HAND_COLUMNS, osu_object, osu_rows
from benchmarks.tables import Table
from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.recording import RecordingId, Stretch, Timeline
from tactslip_torch.onset.events import (
    EventRecord,
    EventRules,
    LatencyParts,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.rules import NOTHING_YET, latch, lowest_threshold
from tactslip_torch.training.onset import HeadName, OnsetTraining

_RATE_HZ = 25.0
_SLIP = "1"  # cm/s that are exceeded
_APART_S = 0.5  # frames of slip with less between them are one slip
_MEAN = np.full(5, 0.2)
_APART = 5  # decisions that re-arm an alarm, and least distance of two
_RULES = EventRules(found_within_s=0.5, early_s=0.2, settle_s=0.5)
_LATENCY = LatencyParts(look_ahead_s=0.0, bin_s=1 / _RATE_HZ)
_CHANNELS = ("lx", "rx", "ly", "ry", "lz", "rz", "lgx", "rgx", "lgy", "rgy", "lgz", "rgz")
_HAND = HandLayout.from_rows(
    dict(zip(HAND_COLUMNS, row, strict=True)) for row in osu_rows(_CHANNELS)
)
Array = NDArray[Any]


class _Trial(NamedTuple):
    """One file.

    Attributes:
        samples: ``[12, T]`` at 25 Hz, as long as the object is tracked.
        slips_s: stretches that are faster than 1 cm/s.
    """

    samples: Array
    slips_s: tuple[Stretch, ...]


@dataclass(frozen=True)
class Trials:
    """A ``RecordingSource`` of the files in a folder; the material is the object.

    Raises:
        ValueError: by ``trials``, if the folder has none that are longer than two seconds.
    """

    folder: Path
    hand: ClassVar = _HAND
    sample_rate_hz: ClassVar = _RATE_HZ
    is_simulated: ClassVar = False

    @cached_property
    def trials(self) -> dict[RecordingId, _Trial]:
        """Files that are long enough to have a score, by object and place."""
        made = dict[RecordingId, _Trial]()
        for place, path in enumerate(sorted(self.folder.glob("*_[CD]_*.csv"))):
            trial = _read(path)
            if trial.samples.shape[1] > 2 * _RATE_HZ:
                made[RecordingId(osu_object(path), place)] = trial
        if not made:
            raise ValueError(
                f"{self.folder} has no trials OBJECT_[CD]_*.csv of over two seconds: "
                "docs/real_data.md says how they are written"
            )
        return made

    @property
    def ids(self) -> tuple[RecordingId, ...]:
        """The recordings, by object and file."""
        return tuple(self.trials)

    def timeline(self, recording: RecordingId) -> Timeline:
        """Its slips; the speed is not known."""
        samples, slips_s = self.trials[recording]
        return Timeline(
            onsets_s=tuple(begin for begin, _ in slips_s),
            sliding_s=slips_s,
            speeds_mm_s=(0.0,) * len(slips_s),
            duration_s=samples.shape[1] / _RATE_HZ,
        )

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """What it is read from."""
        return {"folder": str(self.folder), "recording": str(recording)}

    def load(self, recording: RecordingId, windows: Sequence[Stretch] | None = None) -> Recording:
        """All of it, whatever the windows."""
        times = self.timeline(recording)
        samples = torch.from_numpy(self.trials[recording].samples)
        return Recording(
            *(samples, _RATE_HZ, recording.material),
            *(times.speeds_mm_s, times.onsets_s, times.sliding_s),
        )


def _read(path: Path) -> _Trial:
    with path.open(newline="") as file:
        _, *rows = csv.reader(file)
    is_tracked = [bool(row[13]) for row in rows]
    rows = rows[: is_tracked.index(False) if False in is_tracked else len(rows)]
    time_s = np.array([float(row[0]) for row in rows])
    values = np.array([[float(value) for value in row[1:13]] for row in rows])
    even_s = np.arange(time_s[0], time_s[-1], 1 / _RATE_HZ)
    samples = np.stack([np.interp(even_s, time_s, column) for column in values.T])
    frame_s = np.append(time_s, 2 * time_s[-1] - time_s[-2])  # a frame is five rows
    frames = [(frame_s[i] - time_s[0], frame_s[min(i + 5, len(rows))] - time_s[0])
              for i in range(0, len(rows), 5) if rows[i][13] == _SLIP]  # fmt: skip
    slips = list[Stretch]()
    for begin, end in frames:
        if slips and begin - slips[-1][1] < _APART_S:
            slips[-1] = (slips[-1][0], float(end))
        else:
            slips.append((float(begin), float(end)))
    return _Trial(samples, tuple(slips))


def _energy(samples: Array) -> Array:
    """Log of the mean squared change of acceleration over the last fifth of a second, ``[T]``."""
    acceleration = samples[[channel.kind == "acc" for channel in _HAND.channels]]
    changes = np.square(np.diff(acceleration, prepend=acceleration[:, :1])).mean(0)
    made: Array = np.log(np.convolve(changes, _MEAN)[: len(changes)] + 1e-12)
    return made


@dataclass(frozen=True)
class RealOnsets(Benchmark):
    """Every method at every rate.

    Args:
        per_hour: false alarms an hour on the other objects.
        seeds: of weights and batches.
        epochs: passes over all hops, of which there are far fewer than in ``+exp=onset``.
    """

    title = "Onsets of real slips"
    about = "alarms at the begin of real slips, each object left out"
    page, markers, has_headings = "docs/real_data.md", "real_onsets", False
    is_simulated = False
    quick = "per_hour=[240] seeds=[0] epochs=2"
    charts: ClassVar = {"": [("Real onsets", ("found", "early"))]}
    per_hour: tuple[float, ...] = (60.0, 240.0, 720.0)
    seeds: tuple[int, ...] = (0, 1)
    epochs: int = 50

    def measure(self, job: Job) -> dict[str, Any]:
        """A row for each method and rate.

        Raises:
            ValueError: if no folder of trials is given.
        """
        folders = [Path(text) for text in job.overrides if "=" not in text]
        if len(folders) != 1:
            raise ValueError("give the folder of trials: python -m benchmarks.real_onsets FOLDER")
        source = Trials(folders[0])
        objects = list(dict.fromkeys(recording.material for recording in source.ids))
        heads: tuple[HeadName, ...] = ("quadratic", "network")
        methods = {
            f"alarm, {head}": [self._alarm(source, objects, head, seed) for seed in self.seeds]
            for head in heads
        }
        energy = {name: _energy(trial.samples) for name, trial in source.trials.items()}
        methods["acceleration energy"] = [dict.fromkeys(objects, energy)]
        rows = []
        for per_hour in self.per_hour:
            for name, runs in methods.items():
                events = [one for run in runs for one in _events(source, run, per_hour)]
                rows.append(_row(f"{name}, {per_hour:g} /h", pooled_metrics(events), len(runs)))
        quiet_min = 60 * pooled_metrics(events)["quiet_hours"]
        note = (
            f"{len(source.ids)} trials of {len(objects)} objects, {quiet_min:.1f} min without "
            f"slip; {len(self.seeds)} seeds of the alarm together. After each name: the false "
            "alarms an hour on the other objects, to which the threshold is set. For this, the "
            "alarm scores each of these objects by a classifier that was fitted without it. "
            "Delays: median and, in brackets, 95 % quantile. Other brackets: 95 % intervals of a "
            "bootstrap over trials."
        )
        return {"tables": {"Real onsets": Table(rows, note)}}

    def _alarm(
        self, source: Trials, objects: Sequence[str], head: HeadName, seed: int
    ) -> dict[str, dict[RecordingId, Array]]:
        """Scores of all trials for each object left out: none by a classifier that knows it."""
        scores = dict[str, dict[RecordingId, Array]]()
        for left_out in objects:
            say(f"{head} without {left_out}, seed {seed}")
            others = [name for name in source.ids if name.material != left_out]
            training = OnsetTraining(head, self.epochs, folds=len(objects) - 1, seed=seed)
            classifier, without, _ = training(source, others, num_workers=0)
            scores[left_out] = {
                name: without.get(name.material, classifier)
                .score_recording(torch.from_numpy(trial.samples))
                .numpy()
                for name, trial in source.trials.items()
            }
        return scores


def _events(
    source: Trials, scores: Mapping[str, Mapping[RecordingId, Array]], per_hour: float
) -> list[Any]:
    """What became of the slips of each object, at the threshold of the others."""
    blind = OnsetTraining().evidence(source.hand, _RATE_HZ).first_hop + 2
    made = []
    for left_out, of in scores.items():
        others = [name for name in of if name.material != left_out]
        quiet = [_quiet(source.timeline(name), len(of[name]), blind) for name in others]
        allowed = round(per_hour * sum(map(np.sum, quiet)) / _RATE_HZ / 3600)
        known = [np.where(of[name] > NOTHING_YET, of[name], -np.inf) for name in others]
        threshold = lowest_threshold(known, quiet, allowed, rearm=_APART, refractory=_APART)
        for name in of:
            if name.material != left_out:
                continue
            times = source.timeline(name)
            raised, standing, _ = latch(
                of[name][blind:].tolist(), threshold, rearm=_APART, refractory=_APART
            )
            at = np.flatnonzero(raised)
            ends = [int(np.append(np.flatnonzero(~np.array(standing)[i:]), len(standing))[0]) + i
                    for i in at]  # fmt: skip
            record = EventRecord.of(
                times,
                recording=str(name),
                material=name.material,
                scene="real",
                duration_s=times.duration_s,
                alarms_s=tuple(((at + blind + 1) / _RATE_HZ).tolist()),
                onset_estimates_s=(),
                watched_s=(((blind + 1) / _RATE_HZ, times.duration_s),),
                alarm_ends_s=tuple((end + blind + 1) / _RATE_HZ for end in ends),
            )
            made.append(recording_events(record, _RULES, _LATENCY))
    return made


def _quiet(times: Timeline, num: int, blind: int) -> NDArray[np.bool_]:
    """Decisions of a trial in which an alarm is false."""
    time_s = (np.arange(num) + 1) / _RATE_HZ
    quiet = np.arange(num) >= blind
    for begin, end in times.sliding_s:
        quiet &= (time_s < begin - _RULES.early_s) | (time_s > end + (_RULES.settle_s or 0.0))
    return quiet


def _row(method: str, found: Mapping[str, Any], num: int) -> dict[str, str]:
    def share(name: str) -> str:
        of = found[name]
        return f"{100 * of['value']:.0f} [{100 * of['low']:.0f}, {100 * of['high']:.0f}]"

    delay = found["delay_ms"]
    rate = found["false_alarms_per_hour"]
    return {
        "method": method,
        "slips": str(found["num_onsets"] // num),
        "found %": share("found"),
        "early %": share("early"),
        "missed %": share("missed"),
        "delay ms": f"{delay['median']['value']:.0f} [{delay['p95']['value']:.0f}]"
        if delay
        else "-",
        "false an hour": f"{rate['value']:.0f} [{rate['low']:.0f}, {rate['high']:.0f}]",
    }


if __name__ == "__main__":
    raise SystemExit(RealOnsets().run())
