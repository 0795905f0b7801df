"""A set of files looked at as a whole: whether they agree, and whether their truth fits them.

No sample is read for that but what tells times. Every problem of every file is found in one go.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from tactslip_torch.data.clock import refuse_gaps
from tactslip_torch.data.sets.agreement import Part, agreed
from tactslip_torch.data.sets.look_memory import keep, memory_of, recall
from tactslip_torch.data.sets.manifest import Entry
from tactslip_torch.data.sets.manifest_lines import Problem
from tactslip_torch.data.sets.sampling import Treatment, missing_of, num_recorded, refuse_ratio
from tactslip_torch.data.sets.stream import Found, Stream, look
from tactslip_torch.data.sets.timeline import FileTimeline, on_time, scaled
from tactslip_torch.data.sets.truth import Truth
from tactslip_torch.signals.resampling import MOST_CUT_S
from tactslip_torch.workers import in_processes

BEFORE_ONSET_S = 1.01
"""What ``labels=whole_slide`` takes as non-slip before an onset."""
_PATIENCE_S = 2.0  # what takes longer is done by several processes, and not again
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Plan:
    """How all files of a set are read and labelled.

    Args:
        root: their folder.
        streams: of each file, at least one.
        treatment: of their samples.
        skip_s: what a label of a whole recording leaves out at its start.
        slide_s: how long a slide lasts of which only the onset is known.
    """

    root: Path
    streams: tuple[Stream, ...]
    treatment: Treatment
    skip_s: float = 0.0
    slide_s: float = 0.5


class Surveyed(NamedTuple):
    """A recording that can be read: each of its streams, and when things happen in it."""

    entry: Entry
    parts: tuple[Part, ...]
    times: FileTimeline


class Survey(NamedTuple):
    """What was found in a set.

    Args:
        recordings: those that can be read and agree with most of the others.
        problems: of the files that were left out, at the places of their entries.
        warnings: what is worth a look in the others.
    """

    recordings: tuple[Surveyed, ...]
    problems: tuple[Problem, ...]
    warnings: tuple[Problem, ...]


def survey(plan: Plan, entries: Sequence[Entry]) -> Survey:
    """Look at every file of a set.

    Raises:
        ValueError: if streams of several rates are not to be resampled.
    """
    problems: list[Problem] = []
    seen: list[tuple[Entry, tuple[Found, ...]]] = []
    for entry, found in zip(entries, _look_at_all(plan, entries), strict=True):
        if isinstance(found, str):
            problems.append(_at(entry, found))
        else:
            seen.append((entry, found))
    places = [entry.place for entry, _ in seen]
    any_rate = plan.treatment.resample_hz is not None
    columns = [
        agreed(stream, places, [found[number] for _, found in seen], any_rate=any_rate)
        for number, stream in enumerate(plan.streams)
    ]
    recordings: list[Surveyed] = []
    warnings: list[Problem] = []
    for (entry, _), *parts in zip(seen, *columns, strict=True):
        whole = tuple(part for part in parts if isinstance(part, Part))
        wrong = list(dict.fromkeys(part for part in parts if isinstance(part, str)))
        if not wrong:
            recording, wrong = _timed(plan, entry, whole)
            if not wrong:
                recordings.append(recording)
                warnings += [_at(entry, doubt) for doubt in _doubts(recording)]
        problems += [_at(entry, what) for what in wrong]
    _refuse_several_rates(plan, recordings)
    return Survey(tuple(recordings), tuple(problems), tuple(warnings))


def _look_at_all(plan: Plan, entries: Sequence[Entry]) -> Iterable[tuple[Found, ...] | str]:
    """What each file says, or why it cannot be read; by several processes if that takes long."""

    def look_at(entry: Entry) -> tuple[Found, ...] | str:
        path = plan.root / entry.file
        try:
            return tuple(look(path, stream, entry.sample_rate_hz) for stream in plan.streams)
        except (ValueError, OSError) as error:
            return str(error).replace(f"{plan.root}{os.sep}", "")

    memory = memory_of(plan.root, plan.streams)
    stated_hz = {entry.file: entry.sample_rate_hz for entry in entries}
    known = recall(memory, plan.root, stated_hz)
    unknown = [entry for entry in entries if entry.file not in known]
    looked, seconds = [], 0.0
    for entry in unknown[:2]:  # the first waits for libraries that are not yet loaded
        started = time.perf_counter()
        looked.append(look_at(entry))
        seconds = time.perf_counter() - started
    is_slow = seconds * len(unknown) >= _PATIENCE_S
    if is_slow:
        looked += in_processes(look_at, unknown[2:], "looking at files", "file")
    else:
        looked += map(look_at, unknown[2:])
    seen = {entry.file: found for entry, found in zip(unknown, looked, strict=True)}
    if is_slow:
        whole = {file: found for file, found in seen.items() if not isinstance(found, str)}
        keep(memory, plan.root, stated_hz, whole)
    return [(seen | known)[entry.file] for entry in entries]


def _timed(plan: Plan, entry: Entry, parts: tuple[Part, ...]) -> tuple[Surveyed, list[str]]:
    """A recording with its truth on its time, and what does not fit."""
    how = plan.treatment
    wrong = []
    for part in parts:
        try:
            refuse_ratio(part.rate_hz, how)
            if how.gaps == "refuse":
                refuse_gaps(part.found.clock, "it")
        except ValueError as error:
            wrong.append(str(error).removeprefix("it: "))
    ends_s = [
        num_recorded(part.found, part.rate_hz, how) / (how.resample_hz or part.rate_hz)
        for part in parts
    ]
    duration_s = min(ends_s)
    if max(ends_s) - duration_s > MOST_CUT_S:
        wrong.append(
            f"its streams last {duration_s:.4g} to {max(ends_s):.4g} s; cut the longer one"
        )
    missing_s = [gap for part in parts for gap in missing_of(part.found, part.rate_hz, how)]
    if how.tare_s is not None:
        first_s, last_s = how.tare_s
        if last_s > duration_s:
            wrong.append(f"lasts {duration_s:.4g} s, tare_s wants {last_s:g} s")
        if any(start <= first_s and last_s <= end for start, end in missing_s):
            wrong.append(f"nothing is there to tare on from {first_s:g} to {last_s:g} s")
    found, rate_hz = parts[0].found, parts[0].rate_hz
    truth = entry.truth or found.truth or Truth()
    pace = found.clock.sample_rate_hz / rate_hz
    if found.is_measured and abs(pace - 1) > _ROUNDING:  # a person read the file's own times
        truth = scaled(truth, pace)
    times, misfits = on_time(
        truth,
        duration_s,
        skip_s=plan.skip_s,
        slide_s=plan.slide_s,
        slack_s=math.inf if entry.is_nominal else 1.0 / rate_hz,
        missing_s=missing_s,
    )
    return Surveyed(entry, parts, times), [*wrong, *misfits]


def _doubts(recording: Surveyed) -> list[str]:
    """What is worth a look in a recording that can be read."""
    entry, parts, times = recording
    doubts = []
    if not (times.onsets_s or times.slip_s or times.non_slip_s):
        doubts.append("has no label, so no bin is taken from it")
    early = [onset for onset in times.onsets_s if onset < BEFORE_ONSET_S]
    if early:
        doubts.append(
            f"slips at {early[0]:g} s already; labels=whole_slide takes the second before an onset"
        )
    for number, part in enumerate(parts):
        clock = part.found.clock
        if clock.gaps:
            lost = sum(gap.missing for gap in clock.gaps)
            doubts.append(
                f"lacks {lost} samples in {len(clock.gaps)} gaps, first at "
                f"{clock.gaps[0].start / part.rate_hz:.4g} s"
            )
        if clock.jitter_s * part.rate_hz > 1:
            doubts.append(
                f"has times that are early or late by {1000 * clock.jitter_s:.3g} ms; "
                "samples are taken as even"
            )
        material = part.found.material
        if number == 0 and material not in (None, entry.recording.material):
            doubts.append(f"itself says {material!r}, not {entry.recording.material!r}")
    return doubts


def _at(entry: Entry, what: str) -> Problem:
    """What is said of an entry, its file named once."""
    said = what.removeprefix(entry.file).lstrip(":, ")
    return Problem(entry.place, said if entry.place == entry.file else f"{entry.file}: {said}")


def _refuse_several_rates(plan: Plan, recordings: Sequence[Surveyed]) -> None:
    if plan.treatment.resample_hz is None and recordings:
        rates = [part.rate_hz for part in recordings[0].parts]
        if len(set(rates)) > 1:
            told = ", ".join(
                f"{stream.name} has {rate:g} Hz"
                for stream, rate in zip(plan.streams, rates, strict=True)
            )
            raise ValueError(f"the streams must be brought to one rate, {told}: resample_hz=...")
