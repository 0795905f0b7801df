"""A recording: one trial as the sensors gave it, and when slip begins and ends in it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

from torch import Tensor

from tactslip_torch.hand import HandLayout

PAPER_SCENE = "paper"
"""The scene of recordings that are the paper's protocol."""


@dataclass(frozen=True, order=True)
class RecordingId:
    """Names a recording within its set.

    Args:
        material: what the hand slid on.
        cycle: number of the cycle on that material, from 0.
        scene: what was done with the hand; the paper's protocol unless stated otherwise.
        session: the mounting it was recorded in, where a material has several; ``""`` for its
            first or only one. Each session counts its cycles from 0.

    Example:
        >>> str(RecordingId("M1", 3)), str(RecordingId("M1", 3, "taps", session="2"))
        ('M1/3', 'M1/3/taps@2')
    """

    material: str
    cycle: int
    scene: str = PAPER_SCENE
    session: str = ""

    def __str__(self) -> str:
        scene = "" if self.scene == PAPER_SCENE else f"/{self.scene}"
        session = f"@{self.session}" if self.session else ""
        return f"{self.material}/{self.cycle}{scene}{session}"


Stretch = tuple[float, float]
"""Start and end, in seconds."""
Label = Literal["slip", "non-slip"]
MOMENTS = ("onsets_s", "annotated_onsets_s", "speeds_mm_s")
STRETCHES = ("sliding_s", "slip_s", "non_slip_s", "released_s")
"""What a ``Recording`` says of its time: numbers, one of each slide, and pairs of start and end."""
SPANS = (*STRETCHES, "missing_s", "unlabelled_s")
TIMES = (*MOMENTS, *SPANS)
"""What a ``Timeline`` says beside the duration and a label."""


@dataclass(frozen=True)
class Timeline:
    """When things happen in a recording, known before any sample is, as far as it is annotated.

    Args:
        onsets_s: when a slide begins, exact where known; those of ``sliding_s`` where only they
            were given.
        annotated_onsets_s: the same as a person marked them, where both are known.
        speeds_mm_s: steady speed, one per onset.
        sliding_s: start and end of the slide behind each onset.
        slip_s: stretches that are slip, begun nobody knows when.
        non_slip_s: stretches without slip in which the hand is handled.
        missing_s: stretches without samples, or whose samples are not to be used; no bin is laid
            that needs one of them.
        released_s: of each onset, when the first and the last element of the skin let go; empty
            where that is not known.
        label: of all of the recording; none is left in what a ``RecordingSource`` gives.
        duration_s: length of the recording; 0 before it is opened.
        unlabelled_s: stretches of which nobody knows whether they are slip, although an onset
            follows; the time before other onsets is taken as non-slip.
    """

    onsets_s: tuple[float, ...] = ()
    annotated_onsets_s: tuple[float, ...] = ()
    speeds_mm_s: tuple[float, ...] = ()
    sliding_s: tuple[Stretch, ...] = ()
    slip_s: tuple[Stretch, ...] = ()
    non_slip_s: tuple[Stretch, ...] = ()
    missing_s: tuple[Stretch, ...] = ()
    released_s: tuple[Stretch, ...] = ()
    label: Label | None = None
    duration_s: float = 0.0

    @property
    def has_stretches(self) -> bool:
        """Whether it says of some stretch that it is slip or that it is not."""
        return bool(self.onsets_s or self.slip_s or self.non_slip_s)

    unlabelled_s: tuple[Stretch, ...] = ()

    def with_slides(self, duration_s: float, slide_s: float) -> Timeline:
        """The same, in which every onset has its slide.

        One of which only the onset is known lasts ``slide_s``, or ends before that with the next
        onset, stretch without slip, or the recording.
        """
        if self.sliding_s:
            return self
        onsets = self.onsets_s
        stops = [*onsets, duration_s, *(start for start, _ in self.non_slip_s)]
        ends = [min([onset + slide_s, *(s for s in stops if s > onset)]) for onset in onsets]
        return replace(self, sliding_s=tuple(zip(onsets, ends, strict=True)))

    def joined(self, other: Timeline) -> Timeline:
        """What both say, of different parts of a recording; every onset must have its slide."""
        strokes = sorted(
            (onset, annotated, speed, slide)
            for times in (self, other)
            for onset, annotated, speed, slide in zip(
                times.onsets_s,
                times.annotated_onsets_s or times.onsets_s,
                times.speeds_mm_s or (0.0,) * len(times.onsets_s),
                times.sliding_s,
                strict=True,
            )
        )
        onsets, annotated, speeds, slides = zip(*strokes, strict=True) if strokes else ((),) * 4
        spans: dict[str, Any] = {
            name: tuple(sorted((*getattr(self, name), *getattr(other, name))))
            for name in ("slip_s", "non_slip_s", "missing_s", "unlabelled_s")
        }
        is_known = self.released_s and not other.onsets_s
        released = self.released_s if is_known else ()
        both = replace(self, onsets_s=onsets, annotated_onsets_s=annotated, speeds_mm_s=speeds)
        return replace(both, sliding_s=slides, released_s=released, **spans)


def on_time(
    truth: Timeline,
    duration_s: float,
    *,
    skip_s: float = 0.0,
    slide_s: float = 0.5,
    slack_s: float = 0.0,
    missing_s: Iterable[Stretch] = (),
) -> tuple[Timeline, list[str]]:
    """A timeline on the time of its recording, and what does not fit there.

    Args:
        truth: as it was annotated.
        duration_s: of the recording.
        skip_s: at the start that a label of all of it does not stand for.
        slide_s: how long a slide lasts of which only the onset is known (``Timeline.with_slides``).
        slack_s: by which a stretch may leave the recording; it is cut then.
        missing_s: further stretches without samples, of the file.
    """
    problems = []
    for name in SPANS:
        for start, end in getattr(truth, name):
            if start >= duration_s or (end > duration_s + slack_s and end != math.inf):
                span = f"{start:g}-{'end' if end == math.inf else format(end, 'g')} s"
                problems.append(f"{name}: {span} leaves the recording of {duration_s:.4g} s")
    for name in ("onsets_s", "annotated_onsets_s"):
        late = [onset for onset in getattr(truth, name) if onset >= duration_s]
        problems += [f"{name}: {onset:g} s is behind the end, {duration_s:.4g} s" for onset in late]
    if truth.label and skip_s >= duration_s:
        problems.append(
            f"label: of {duration_s:.4g} s nothing is left behind the first {skip_s:g} s; "
            "lower skip_s"
        )
    if problems:
        return Timeline(duration_s=duration_s), problems
    truth = truth.with_slides(duration_s, slide_s)
    onsets = truth.onsets_s
    cut: dict[str, Any] = {
        name: tuple((start, min(end, duration_s)) for start, end in getattr(truth, name))
        for name in SPANS
    }
    if truth.label is not None:
        cut["slip_s" if truth.label == "slip" else "non_slip_s"] = ((skip_s, duration_s),)
    cut["missing_s"] = tuple(sorted({*cut["missing_s"], *missing_s}))
    speeds = truth.speeds_mm_s if len(truth.speeds_mm_s) == len(onsets) else (0.0,) * len(onsets)
    annotated = truth.annotated_onsets_s or onsets
    return Timeline(onsets, annotated, speeds, **cut, duration_s=duration_s), []


def scaled(truth: Timeline, factor: float) -> Timeline:
    """A timeline of a clock that runs ``factor`` times as fast as the one wanted."""
    changes: dict[str, Any] = {
        name: tuple(moment * factor for moment in getattr(truth, name))
        for name in ("onsets_s", "annotated_onsets_s")
    }
    for name in SPANS:
        spans = getattr(truth, name)
        changes[name] = tuple((start * factor, end * factor) for start, end in spans)
    return replace(truth, **changes)


@dataclass(frozen=True, eq=False)
class Recording:
    """One trial: raw samples and the truth about them.

    Args:
        samples: ``[C, T]``, in ``units``, unfiltered. NaN where a simulation was not asked for a
            channel or a stretch of time; never a silent number.
        sample_rate_hz: samples per second and channel.
        material: what the hand slid on.
        speeds_mm_s: steady speed of each stroke.
        onsets_s: when the *contact* begins to slide, one per stroke, exact where known.
        sliding_s: ``(start, end)`` of every stretch in which the contact slides.
        annotated_onsets_s: the onsets as a person marked them, if that differs; labels use
            these unless stated otherwise. Defaults to ``onsets_s``.
        non_slip_s: ``(start, end)`` of stretches without slip that are as telling as the second
            before an onset: the hand is carried, tapped, gripped.
        provenance: where it comes from; simulated recordings say ``{"simulated": True, ...}``.
        slip_s: ``(start, end)`` of stretches that are slip though nobody knows when it began.
        units: of the samples.
        released_s: of each onset, when the first and when the last element of the skin lets go;
            at the onset half of the load has. Empty where that is not known.

    Raises:
        ValueError: if samples are not ``[C, T]``, the rate is not positive, the number of onsets
            differs from that of speeds, sliding stretches, annotations or known releases, or an
            onset does not lie between its releases.
    """

    samples: Tensor
    sample_rate_hz: float
    material: str
    speeds_mm_s: tuple[float, ...]
    onsets_s: tuple[float, ...]
    sliding_s: tuple[Stretch, ...]
    annotated_onsets_s: tuple[float, ...] = ()
    non_slip_s: tuple[Stretch, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    slip_s: tuple[Stretch, ...] = ()
    units: str = "V"
    released_s: tuple[Stretch, ...] = ()

    def __post_init__(self) -> None:
        if self.samples.ndim != 2:
            raise ValueError(f"samples must be [C, T], got {tuple(self.samples.shape)}")
        if not self.sample_rate_hz > 0:
            raise ValueError(f"sample_rate_hz must be positive, got {self.sample_rate_hz}")
        if not self.annotated_onsets_s:
            object.__setattr__(self, "annotated_onsets_s", self.onsets_s)
        counts = [
            len(self.speeds_mm_s),
            len(self.onsets_s),
            len(self.sliding_s),
            len(self.annotated_onsets_s),
        ]
        if len(set(counts)) != 1:
            raise ValueError(
                "a recording has as many speeds as onsets, sliding stretches and annotated "
                f"onsets, got {counts}"
            )
        if self.released_s and len(self.released_s) != len(self.onsets_s):
            raise ValueError(
                f"released_s must be empty or one of each of {len(self.onsets_s)} onsets, got "
                f"{len(self.released_s)}"
            )
        for onset, (first, last) in zip(self.onsets_s, self.released_s, strict=False):
            if not first <= onset <= last:
                raise ValueError(
                    f"the onset at {onset:g} s must lie between its releases, {first:g}-{last:g} s"
                )

    def __repr__(self) -> str:
        origin = ", simulated" * bool(self.provenance.get("simulated"))
        num = len(self.onsets_s)
        slips = f"{num} slip{'s' * (num != 1)}" if num else "no slip marked"
        return (
            f"Recording({len(self.samples)} channels, {self.duration_s:.2f} s at "
            f"{self.sample_rate_hz:g} Hz, in {self.units}, material {self.material}, "
            f"{slips}{origin})"
        )

    @property
    def has_truth(self) -> bool:
        """Whether it says where slip is and where not; one that nobody annotated does not."""
        is_annotated = self.onsets_s or self.non_slip_s or self.slip_s
        return bool(is_annotated or self.provenance.get("simulated"))

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.samples.shape[-1] / self.sample_rate_hz


class RecordingSource(Protocol):
    """A set of recordings that are made or read one at a time, when asked for."""

    @property
    def hand(self) -> HandLayout:
        """The channels of every recording."""

    @property
    def sample_rate_hz(self) -> float:
        """Of every recording."""

    @property
    def is_simulated(self) -> bool:
        """Whether samples come from a simulation; every result says so."""

    @property
    def ids(self) -> tuple[RecordingId, ...]:
        """The recordings, in a fixed order."""

    def timeline(self, recording: RecordingId) -> Timeline:
        """When things happen in a recording; cheap."""

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """Everything that determines the samples, JSON-able; for caches."""

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """The recording; samples outside the windows (seconds) may be NaN."""
