"""What is known of a recording, laid on its time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from tactslip_torch.data.sets.truth import STRETCHES, Stretch, Truth


@dataclass(frozen=True)
class FileTimeline:
    """A truth on the time of its recording: all is known and lies inside; a ``Timeline``."""

    duration_s: float
    onsets_s: tuple[float, ...] = ()
    annotated_onsets_s: tuple[float, ...] = ()
    sliding_s: tuple[Stretch, ...] = ()
    speeds_mm_s: tuple[float, ...] = ()
    non_slip_s: tuple[Stretch, ...] = ()
    slip_s: tuple[Stretch, ...] = ()
    missing_s: tuple[Stretch, ...] = ()


def on_time(
    truth: Truth,
    duration_s: float,
    *,
    skip_s: float = 0.0,
    slide_s: float = 0.5,
    slack_s: float = 0.0,
    missing_s: Iterable[Stretch] = (),
) -> tuple[FileTimeline, list[str]]:
    """A truth on the time of its recording, and what does not fit there.

    Args:
        truth: as somebody said it.
        duration_s: of the recording.
        skip_s: at the start that a label of all of it does not stand for.
        slide_s: how long a slide lasts of which only the onset is known; it ends before that with
            the next onset, stretch without slip, or the recording.
        slack_s: by which a stretch may leave the recording; it is cut then.
        missing_s: further stretches without samples, of the file.
    """
    problems = []
    named: list[tuple[str, Stretch]] = [
        (name, stretch) for name in STRETCHES for stretch in getattr(truth, name)
    ]
    for name, (start, end) in named:
        if start >= duration_s or (end > duration_s + slack_s and end != math.inf):
            span = f"{start:g}-{'end' if end == math.inf else format(end, 'g')} s"
            problems.append(f"{name}: {span} leaves the recording of {duration_s:.4g} s")
    for name in ("onsets_s", "annotated_onsets_s"):
        for onset in getattr(truth, name):
            if onset >= duration_s:
                problems.append(f"{name}: {onset:g} s is behind the end, {duration_s:.4g} s")
    if truth.label and skip_s >= duration_s:
        problems.append(
            f"label: of {duration_s:.4g} s nothing is left behind the first {skip_s:g} s; "
            "lower skip_s"
        )
    if problems:
        return FileTimeline(duration_s), problems

    def cut(stretches: Iterable[Stretch]) -> tuple[Stretch, ...]:
        return tuple((start, min(end, duration_s)) for start, end in stretches)

    onsets = truth.onsets_s
    sliding = truth.sliding_s
    if not sliding:
        stops = [*onsets, duration_s, *(start for start, _ in truth.non_slip_s)]
        sliding = tuple((t, min([t + slide_s, *(s for s in stops if s > t)])) for t in onsets)
    all_of_it = ((skip_s, duration_s),)
    return (
        FileTimeline(
            duration_s,
            onsets,
            truth.annotated_onsets_s or onsets,
            cut(sliding),
            truth.speeds_mm_s if len(truth.speeds_mm_s) == len(onsets) else (0.0,) * len(onsets),
            all_of_it if truth.label == "non-slip" else cut(truth.non_slip_s),
            all_of_it if truth.label == "slip" else cut(truth.slip_s),
            tuple(sorted({*cut(truth.missing_s), *missing_s})),
        ),
        [],
    )


def scaled(truth: Truth, factor: float) -> Truth:
    """A truth told by a clock that runs ``factor`` times as fast as the one wanted."""

    def moments(own: Iterable[float]) -> tuple[float, ...]:
        return tuple(moment * factor for moment in own)

    def stretches(own: Iterable[Stretch]) -> tuple[Stretch, ...]:
        return tuple((start * factor, end * factor) for start, end in own)

    return Truth(
        moments(truth.onsets_s),
        moments(truth.annotated_onsets_s),
        truth.speeds_mm_s,
        stretches(truth.sliding_s),
        stretches(truth.slip_s),
        stretches(truth.non_slip_s),
        stretches(truth.missing_s),
        truth.label,
    )
