"""Labels of the bins of a recording: slip or not.

``whole_slide`` is what the authors' scripts do: one second of non-slip before each onset, the whole
slide as slip, the onset moved 10 ms earlier. ``half_second`` is what the paper's text has: half a
second on either side of each onset.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.recording import Label, Stretch, Timeline
from tactslip_torch.runtime import check_choice, check_number

Layout = Literal["whole_slide", "half_second"]
OnsetSource = Literal["annotated", "exact"]
Assign = Literal["whole", "majority", "last"]

SpeedUnit = Literal["mm/s", "cm/s", "m/s", "um/s"]
_MM_S: Mapping[SpeedUnit, float] = {"mm/s": 1.0, "cm/s": 10.0, "m/s": 1000.0, "um/s": 1e-3}

NO_POSITION = torch.iinfo(torch.int64).min
"""The position of a bin that belongs to no stroke."""


@dataclass(frozen=True)
class LabelRule:
    """How bins are laid around onsets.

    Args:
        layout: ``"whole_slide"`` (published numbers) or ``"half_second"`` (the text).
        onsets: ``"annotated"``, as a person marked them, or ``"exact"``, where known.
        bin_ms: length of a bin.
        hop_ms: distance between bins; ``None`` for no overlap, as in the paper.
        shuffle_seed: if given, labels are permuted within each recording. A sanity check: what
            is learned from such labels must score 50 % balanced accuracy.
        assign: the label of a bin. ``"whole"``: that of all its samples; bins begin at the onset
            or at the start of a stretch. ``"majority"`` (slip if more than half of its samples
            are) or ``"last"`` (that of its last sample): bins begin at sample 0, a hop apart, and
            those of which every sample has a label are kept.
        column: the column of files that has a label for each sample, by name or by number from 0,
            for recordings of ``data=files`` and ``data=named``; ``None``: there is none.
        over: slip is where the magnitude of that column is above it.
        unit: of the column and of ``over``, if it is a speed of slip; ``None``: it is a label.
        slip: words, or numbers, of the column that are slip; all others are non-slip. ``None``:
            words are known ones (``label_of``), numbers are compared with ``over``.

    Raises:
        ValueError: for an unknown layout, onset source or assignment, or a length that is not
            positive.
    """

    layout: Layout = "whole_slide"
    onsets: OnsetSource = "annotated"
    bin_ms: float = 50.0
    hop_ms: float | None = None
    shuffle_seed: int | None = None
    assign: Assign = "whole"
    column: str | int | None = None
    over: float = 0.5
    unit: SpeedUnit | None = None
    slip: Sequence[str | float] | None = None

    def __post_init__(self) -> None:
        for name, kinds in (("layout", Layout), ("onsets", OnsetSource), ("assign", Assign)):
            check_choice(f"labels.{name}", getattr(self, name), get_args(kinds))
        for name in ("bin_ms", "hop_ms"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"labels.{name} must be positive, got {value}")
        _ = self.label_column

    @property
    def label_column(self) -> LabelColumn | None:
        """The column that says what is slip, if one does.

        Raises:
            ValueError: for a value that cannot be.
        """
        if self.column is None:
            return None
        return LabelColumn(self.column, self.over, self.unit, self.slip)


# Words and columns ------------------------------------------------------------------------------

_WORDS: Mapping[str, Label] = {
    **dict.fromkeys(("slip", "slipping", "true", "yes"), "slip"),
    **dict.fromkeys(("nonslip", "noslip", "stick", "stable", "static", "hold"), "non-slip"),
    **dict.fromkeys(("false", "no", "none"), "non-slip"),
}
"""What a word means, in small letters, without blanks, hyphens and underscores."""


def _plain(word: str) -> str:
    return re.sub(r"[\s_-]", "", word.lower())


def label_of(word: str) -> Label | None:
    """The label that a word is, as people spell it: ``slip``, ``Non-slip``, ``no_slip``, ``hold``.

    Example:
        >>> label_of("No slip"), label_of("stable"), label_of("grasp")
        ('non-slip', 'non-slip', None)
    """
    return _WORDS.get(_plain(word))


@dataclass(frozen=True)
class LabelColumn:
    """The column of a file that says of each sample whether it is slip.

    Args:
        name: of the column, or its number from 0.
        over: slip is where the magnitude is above it.
        unit: of the column and of ``over``, if it is a speed; ``None``: it is a label.
        slip: words or numbers that are slip; ``None``: known words, and numbers by ``over``.

    Raises:
        ValueError: for a value that cannot be.
    """

    name: str | int
    over: float = 0.5
    unit: SpeedUnit | None = None
    slip: Sequence[str | float] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str | int) or isinstance(self.name, bool):
            raise ValueError(f"labels.column must be a name, a number or null, got {self.name!r}")
        check_number("labels.over", self.over, least=0)
        check_choice("labels.unit", self.unit, (None, *_MM_S))
        if self.slip is None:
            return
        if isinstance(self.slip, str) or not isinstance(self.slip, Sequence) or not self.slip:
            raise ValueError(f"labels.slip must be a list of words or null, got {self.slip!r}")
        if self.unit is not None:
            raise ValueError("labels.slip is of words, labels.unit of a speed; give one of both")

    def number_of(self, word: str) -> float | None:
        """What stands for a word among numbers: infinity for slip, 0 for non-slip.

        ``None`` for a word that is not known, and for every word in a column of speeds.
        """
        if self.unit is not None:
            return None
        if self.slip is not None:
            return math.inf if _plain(word) in {_plain(str(one)) for one in self.slip} else 0.0
        label = label_of(word)
        return None if label is None else math.inf if label == "slip" else 0.0

    def no_label(self, word: str) -> str:
        """What to say of a word that is not known, in a line that names the file."""
        if self.unit is not None:
            return f"{word!r} in column {self.name!r} is no speed; set labels.unit=null for labels"
        return (
            f"{word!r} in column {self.name!r} is no known label; list the words that are slip, as "
            f"labels.slip=[slip], and all others are non-slip"
        )

    def states(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """1 where a value is slip, 0 where it is not, -1 where there is none; ``[T]``."""
        is_slip = np.abs(values) > self.over
        if self.slip is not None:
            is_slip = np.isinf(values)
            for one in self.slip:
                with suppress(ValueError):
                    is_slip |= values == float(one)
        return np.where(np.isnan(values), -1, is_slip)

    def timeline(
        self,
        values: NDArray[np.float64],
        sample_rate_hz: float,
        told: Timeline | None = None,
        skip_s: float = 0.0,
    ) -> Timeline:
        """Where the column says that slip begins and ends, and what is not labelled.

        Args:
            values: of the column, NaN where a cell is empty.
            sample_rate_hz: of the values.
            told: what else is said of the recording, which is in the timeline as well. Its slides
                and stretches of slip or non-slip take precedence; a label of all of it is taken
                where the column is empty.
            skip_s: at the start that such a label does not stand for.

        Shape:
            - values: ``[T]``
        """
        state = self.states(values)
        speed = None
        if self.unit is not None:
            speed = np.abs(values) * _MM_S[self.unit]
            state = _without_flicker(state, sample_rate_hz)
        if told is None:
            return _timeline_of(state, sample_rate_hz, speed, self.over_mm_s)
        if told.label is not None:
            rest = state[round(skip_s * sample_rate_hz) :]
            rest[rest < 0] = told.label == "slip"
        for start_s, end_s in (*told.sliding_s, *told.slip_s, *told.non_slip_s):
            end = len(state) if end_s == math.inf else round(end_s * sample_rate_hz)
            state[round(start_s * sample_rate_hz) : end] = _TOLD
        found = _timeline_of(state, sample_rate_hz, speed, self.over_mm_s)
        return replace(told, label=None).joined(found)

    @property
    def over_mm_s(self) -> float:
        """The threshold in mm/s, if the column is a speed."""
        return self.over * _MM_S[self.unit or "mm/s"]


_NO_LABEL, _TOLD = -1, -2  # beside 0 and 1: an empty cell, and a sample of which others say more
_SHORTEST_S = 0.02
"""A speed that is above or below the threshold for less than that is noise."""


def _without_flicker(state: NDArray[np.int64], sample_rate_hz: float) -> NDArray[np.int64]:
    """States of which none that is shorter than 20 ms stands between two of the other kind."""
    shortest = _SHORTEST_S * sample_rate_hz
    for kind in (0, 1):
        for before, (start, stop, value), behind in _neighbours(_runs(state)):
            if value == kind and before == behind == 1 - kind and stop - start < shortest:
                state[start:stop] = 1 - kind
    return state


def _timeline_of(
    state: NDArray[np.int64],
    sample_rate_hz: float,
    speed_mm_s: NDArray[np.float64] | None,
    over_mm_s: float,
) -> Timeline:
    """The timeline of states, ``[T]``.

    Of labels it begins and ends with samples; of speeds where the straight line between two samples
    crosses the threshold. ``speeds_mm_s`` are the median speeds of slides to two digits, so that
    results by speed have few rows. What is slip and does not follow non-slip is ``slip_s``.
    """

    def edge(place: int) -> float:
        is_known = 0 < place < len(state) and min(state[place - 1 : place + 1]) >= 0
        if speed_mm_s is None or not is_known:
            return place / sample_rate_hz
        low, high = speed_mm_s[place - 1], speed_mm_s[place]
        return float(place - 1 + (over_mm_s - low) / (high - low)) / sample_rate_hz

    sliding, speeds, slip, rest, unlabelled = [], [], [], [], []
    for before, (start, stop, value), _ in _neighbours(_runs(state)):
        stretch = edge(start), edge(stop)
        if value == _NO_LABEL:
            unlabelled.append(stretch)
        elif value == 0:
            rest.append(stretch)
        elif value == 1 and before == 0:
            sliding.append(stretch)
            if speed_mm_s is not None:
                speeds.append(float(f"{np.median(speed_mm_s[start:stop]):.2g}"))
        elif value == 1:
            slip.append(stretch)
    return Timeline(
        tuple(start for start, _ in sliding),
        speeds_mm_s=tuple(speeds),
        sliding_s=tuple(sliding),
        slip_s=tuple(slip),
        non_slip_s=tuple(rest),
        unlabelled_s=tuple(unlabelled),
    )


_Run = tuple[int, int, int]


def _runs(state: NDArray[np.int64]) -> list[_Run]:
    """Start, end and value of each run of equal values."""
    edges = np.flatnonzero(np.diff(state)) + 1
    bounds = [0, *edges.tolist(), len(state)]
    return [(start, stop, int(state[start])) for start, stop in pairwise(bounds) if start < stop]


def _neighbours(runs: Sequence[_Run]) -> list[tuple[int | None, _Run, int | None]]:
    """Each run with the values of those before and behind it."""
    values = [None, *(value for _, _, value in runs), None]
    return list(zip(values[:-2], runs, values[2:], strict=True))


# Bins -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LabelledBins:
    """Bins of one recording.

    Args:
        starts: ``[N]``, first sample of each bin, ascending within a stroke or stretch.
        is_slip: ``[N]``, bool.
        stroke: ``[N]``, index of the stroke each bin belongs to; -1 for bins of a stretch, which
            are behind those of all strokes, and for those that leave what is labelled of a stroke.
        position: ``[N]``, int64, place of the bin beside its onset: -1 is the last bin before it,
            0 the first slip bin. ``NO_POSITION`` where the stroke is -1.
        bin_samples: length of every bin.
    """

    starts: Tensor
    is_slip: Tensor
    stroke: Tensor
    position: Tensor
    bin_samples: int


def bins_of(
    rule: LabelRule, times: Timeline, sample_rate_hz: float, before: int = 0, after: int = 0
) -> LabelledBins:
    """Lay bins around the onsets of a recording, and in its stretches of slip or of none.

    With ``rule.assign="whole"`` a slip bin lies wholly before the end of its slide, a non-slip bin
    wholly between what was slip or not labelled and the onset, or wholly inside a stretch. Bins of
    a stretch start with it, a hop apart; those that would meet a bin of a stroke, one of an earlier
    stretch, or a slide are left out. With the other assignments the same samples have a label, and
    bins are those of which all have one. Nothing is laid before the start of the recording, nor
    where a bin needs missing samples. One without onsets and stretches has no bins.

    Args:
        rule: the layout.
        times: of the recording.
        sample_rate_hz: of the recording.
        before: samples that the filter reads before a bin.
        after: and behind it.

    Raises:
        ValueError: if a slide or stretch leaves the recording, or a bin is no whole number of
            samples.
    """
    bins = _laid_bins(rule, times, sample_rate_hz)
    first, stop = bins.starts - before, bins.starts + bins.bin_samples + after
    is_whole = torch.ones_like(bins.is_slip)
    for start_s, end_s in times.missing_s:
        start, end = round(start_s * sample_rate_hz), round(end_s * sample_rate_hz)
        is_whole &= (stop <= start) | (first >= end)
    names = ("starts", "is_slip", "stroke", "position")
    return replace(bins, **{name: getattr(bins, name)[is_whole] for name in names})


def _laid_bins(rule: LabelRule, times: Timeline, sample_rate_hz: float) -> LabelledBins:
    """Bins whether samples are missing or not."""
    bin_samples = whole_samples(rule.bin_ms, sample_rate_hz, "labels.bin_ms")
    hop = bin_samples
    if rule.hop_ms is not None:
        hop = whole_samples(rule.hop_ms, sample_rate_hz, "labels.hop_ms")
    num_samples = round(times.duration_s * sample_rate_hz)
    strokes = _strokes(rule, times, num_samples, sample_rate_hz)
    told = [(stretch, False) for stretch in times.non_slip_s]
    told += [(stretch, True) for stretch in times.slip_s]
    stretches = [(*_samples_of(s, num_samples, sample_rate_hz), is_slip) for s, is_slip in told]
    if rule.assign != "whole":
        return _windows(rule, strokes, stretches, bin_samples, hop, num_samples)
    lead = 0 if not strokes else strokes[0].edge - strokes[0].first
    if strokes and lead < bin_samples:
        raise ValueError(
            f"labels.bin_ms={rule.bin_ms:g} is longer than the "
            f"{1000 * lead / sample_rate_hz:g} ms before an onset that "
            f"labels.layout={rule.layout} takes as non-slip"
        )
    is_taken = torch.zeros(num_samples, dtype=torch.bool)  # by a bin or a slide
    parts = [_laid(torch.zeros(0, dtype=torch.int64), is_slip=False)]
    for number, (first, free, edge, last, slide_start, slide_end) in enumerate(strokes):
        before = torch.arange(first, edge - bin_samples + 1, hop)
        before = before[before >= free]
        after = torch.arange(edge, max(last - bin_samples + 1, edge), hop)
        after = after[after >= 0]
        position = torch.arange(-len(before), len(after))
        parts.append(_laid(before, False, number, position[: len(before)]))
        parts.append(_laid(after, True, number, position[len(before) :]))
        is_taken[slide_start:slide_end] = True
    within = torch.arange(bin_samples)
    for starts, *_ in parts:
        is_taken[starts[:, None] + within] = True
    for start, stop, is_slip in stretches:
        starts = torch.arange(start, max(stop - bin_samples + 1, start), hop)
        starts = starts[~is_taken[starts[:, None] + within].any(-1)]
        is_taken[starts[:, None] + within] = True
        parts.append(_laid(starts, is_slip))
    starts, is_slips, numbers, positions = map(torch.cat, zip(*parts, strict=True))
    return LabelledBins(starts, is_slips, numbers, positions, bin_samples)


class _Stroke(NamedTuple):
    """What is labelled around an onset, in samples.

    Args:
        first: of the time before the onset that is non-slip; may lie before the recording.
        free: the end of what was slip or not labelled before, or 0: from there on the time is
            non-slip.
        edge: first sample of slip.
        last: end of slip, exclusive.
        slide_start: from here to ``slide_end`` no stretch gives a label.
        slide_end: exclusive.
    """

    first: int
    free: int
    edge: int
    last: int
    slide_start: int
    slide_end: int


def _strokes(
    rule: LabelRule, times: Timeline, num_samples: int, sample_rate_hz: float
) -> list[_Stroke]:
    """What the layout labels around each onset.

    No earlier time is non-slip than the end of what was slip or not labelled before it. Onsets that
    a column labels are exact; others are moved as the authors do.
    """
    is_annotated = rule.onsets == "annotated" and times.annotated_onsets_s
    onsets_s = times.annotated_onsets_s if is_annotated else times.onsets_s
    others_s = (*times.slip_s, *times.unlabelled_s)
    lead_s, shift_s = (1.0, 0.010) if rule.layout == "whole_slide" else (0.5, 0.0)
    shift_s = 0.0 if rule.column is not None else shift_s
    lead = round(lead_s * sample_rate_hz)
    found: list[_Stroke] = []
    for onset_s, (start_s, end_s) in zip(onsets_s, times.sliding_s, strict=True):
        edge = round((onset_s - shift_s) * sample_rate_hz)
        last = int(end_s * sample_rate_hz)
        if rule.layout == "half_second":
            last = min(last, edge + lead)
        if onset_s < 0 or last > num_samples:
            raise ValueError(
                f"stroke {len(found) + 1} with its onset at {onset_s:.3f} s needs samples up to "
                f"{last}, outside the recording of {num_samples / sample_rate_hz:.3f} s"
            )
        start = max(min(edge, int(start_s * sample_rate_hz)), 0)
        ends = (math.ceil(other_s * sample_rate_hz - 1e-6) for _, other_s in others_s)
        free = max([found[-1].slide_end if found else 0, *(one for one in ends if one <= edge)])
        end = math.ceil(end_s * sample_rate_hz)
        found.append(_Stroke(edge - lead, free, edge, last, start, end))
    return found


def _windows(
    rule: LabelRule,
    strokes: Sequence[_Stroke],
    stretches: Sequence[tuple[int, int, bool]],
    bin_samples: int,
    hop: int,
    num_samples: int,
) -> LabelledBins:
    """Bins from sample 0 on, a hop apart, each with the label of most of its samples or its last.

    Shape:
        - columns of the output: ``[N]``, bins whose ``bin_samples`` samples all have a label
    """
    label = torch.full((max(num_samples, bin_samples),), -1, dtype=torch.int8)  # 0, 1; -1: none
    stroke = torch.full_like(label, -1, dtype=torch.int64)
    for start, stop, kind in stretches:
        label[start:stop] = int(kind)
    for number, (first, free, edge, last, slide_start, slide_end) in enumerate(strokes):
        first, edge = max(first, free), max(edge, 0)
        label[slide_start:slide_end] = -1
        label[first:edge] = 0
        label[edge:last] = 1
        stroke[first:last] = number
    labels, strokes_of = (each.unfold(0, bin_samples, hop) for each in (label, stroke))  # [N, n]
    is_known = (labels >= 0).all(-1)
    labels, strokes_of = labels[is_known], strokes_of[is_known]
    is_slip = labels[:, -1] == 1
    if rule.assign == "majority":
        is_slip = 2 * labels.sum(-1) > bin_samples
    one = torch.where(strokes_of[:, 0] == strokes_of[:, -1], strokes_of[:, 0], -1)
    position = torch.full_like(one, NO_POSITION)
    for number in range(len(strokes)):
        own = one == number
        num_before = int((own & ~is_slip).sum())
        position[own] = torch.arange(int(own.sum())) - num_before
    starts = is_known.nonzero().flatten() * hop
    order = (one < 0).int().argsort(stable=True)  # those of no stroke last
    return LabelledBins(starts[order], is_slip[order], one[order], position[order], bin_samples)


def _laid(
    starts: Tensor, is_slip: bool, stroke: int = -1, position: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The columns of ``LabelledBins`` for bins of one stroke or stretch and one kind."""
    if position is None:
        position = torch.full_like(starts, NO_POSITION)
    is_slip_each = torch.full_like(starts, is_slip, dtype=torch.bool)
    return starts, is_slip_each, torch.full_like(starts, stroke), position


def _samples_of(stretch: Stretch, num_samples: int, sample_rate_hz: float) -> tuple[int, int]:
    """First sample that lies inside a stretch, and the end of those that do."""
    first = math.ceil(stretch[0] * sample_rate_hz - 1e-6)  # what was meant as a whole sample is one
    stop = math.floor(stretch[1] * sample_rate_hz + 1e-6)
    if first < 0 or stop > num_samples:
        raise ValueError(
            f"the stretch from {stretch[0]:.3f} s to {stretch[1]:.3f} s leaves the "
            f"recording of {num_samples / sample_rate_hz:.3f} s"
        )
    return first, stop


def needed_windows(
    bins: LabelledBins, context_samples: int, duration_s: float, sample_rate_hz: float
) -> list[Stretch]:
    """The stretches of time that filtering the bins needs, merged where they touch, in seconds.

    A stretch within two contexts of an end of the recording reaches to that end, so that the
    filter sees the true edge.
    """
    num_samples = round(duration_s * sample_rate_hz)
    windows: list[list[int]] = []
    for start in bins.starts.sort().values.tolist():
        low, high = start - context_samples, start + bins.bin_samples + context_samples
        low = 0 if low < context_samples else low
        high = num_samples if high > num_samples - context_samples else high
        if windows and low <= windows[-1][1]:
            windows[-1][1] = max(windows[-1][1], high)
        else:
            windows.append([low, high])
    return [(low / sample_rate_hz, high / sample_rate_hz) for low, high in windows]


def shuffled(is_slip: Tensor, seed: int, place: int) -> Tensor:
    """Labels permuted within a recording, ``[N]``; ``place`` is the recording's own number."""
    generator = torch.Generator().manual_seed(seed * 1_000_003 + place)
    return is_slip[torch.randperm(len(is_slip), generator=generator)]


def whole_samples(length_ms: float, sample_rate_hz: float, name: str) -> int:
    """A length in samples.

    Args:
        length_ms: the length.
        sample_rate_hz: of the samples.
        name: of the setting, for the error.

    Raises:
        ValueError: if it is no whole number of samples, or none.
    """
    samples = length_ms * sample_rate_hz / 1000
    if abs(samples - round(samples)) > 1e-6 or round(samples) < 1:
        raise ValueError(
            f"{name}={length_ms:g} is {samples:g} samples at {sample_rate_hz:g} Hz; "
            "choose a whole number of samples"
        )
    return round(samples)
