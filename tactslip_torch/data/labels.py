"""Which bins of a recording are slip and which are not (REFERENCE.md section 1, *Labels*).

``whole_slide`` is what the authors' scripts do and the published confusion matrices fit: one second
of non-slip before each onset, the whole slide as slip, the onset moved 10 ms earlier.
``half_second`` is what the paper's text says: half a second on either side of each onset. Stretches
in which the hand is handled without slip, which the paper did not record, are non-slip in both, and
those that are known to be slip, but not since when, are slip in both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from torch import Tensor

Layout = Literal["whole_slide", "half_second"]
OnsetSource = Literal["annotated", "exact"]

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

    Raises:
        ValueError: for an unknown layout or onset source, or a length that is not positive.
    """

    layout: Layout = "whole_slide"
    onsets: OnsetSource = "annotated"
    bin_ms: float = 50.0
    hop_ms: float | None = None
    shuffle_seed: int | None = None

    def __post_init__(self) -> None:
        for name, kinds in (("layout", Layout), ("onsets", OnsetSource)):
            if getattr(self, name) not in get_args(kinds):
                raise ValueError(
                    f"labels.{name} must be one of {', '.join(get_args(kinds))}, "
                    f"got {getattr(self, name)!r}"
                )
        for name in ("bin_ms", "hop_ms"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"labels.{name} must be positive, got {value}")


@dataclass(frozen=True)
class LabelledBins:
    """Bins of one recording.

    Args:
        starts: ``[N]``, first sample of each bin, ascending within a stroke or stretch.
        is_slip: ``[N]``, bool.
        stroke: ``[N]``, index of the stroke each bin belongs to; -1 for bins of a stretch, which
            are behind those of all strokes.
        position: ``[N]``, int64, place of the bin beside its onset: -1 is the last bin before it,
            0 the first slip bin. ``NO_POSITION`` where the stroke is -1.
        bin_samples: length of every bin.
    """

    starts: Tensor
    is_slip: Tensor
    stroke: Tensor
    position: Tensor
    bin_samples: int


def label_bins(
    rule: LabelRule,
    onsets_s: Sequence[float],
    sliding_s: Sequence[tuple[float, float]],
    duration_s: float,
    sample_rate_hz: float,
    non_slip_s: Sequence[tuple[float, float]] = (),
    slip_s: Sequence[tuple[float, float]] = (),
) -> LabelledBins:
    """Lay bins around the onsets of a recording, and in its stretches of slip or of none.

    A slip bin lies wholly before the end of its slide, a non-slip bin wholly between the end of the
    slide before and the onset, or wholly inside a stretch. Bins of a stretch start with it, a hop
    apart; those that would meet a bin of a stroke, one of an earlier stretch, or a slide are left
    out. A recording without onsets and stretches has no bins.

    Args:
        rule: the layout.
        onsets_s: one per stroke, annotated or exact as the caller chose.
        sliding_s: start and end of each slide, exact. Strokes read only the ends.
        duration_s: length of the recording.
        sample_rate_hz: of the recording.
        non_slip_s: start and end of each stretch that is non-slip beside what is around onsets.
        slip_s: the same of slip; its bins come last.

    Raises:
        ValueError: if a bin would lie outside the recording, a stretch does, or a bin is no whole
            number of samples.
    """
    bin_samples = whole_samples(rule.bin_ms, sample_rate_hz, "labels.bin_ms")
    hop = bin_samples
    if rule.hop_ms is not None:
        hop = whole_samples(rule.hop_ms, sample_rate_hz, "labels.hop_ms")
    lead_s, shift_s = (1.0, 0.010) if rule.layout == "whole_slide" else (0.5, 0.0)
    num_samples = round(duration_s * sample_rate_hz)
    is_taken = torch.zeros(num_samples, dtype=torch.bool)  # by a bin or a slide
    parts = [_laid(torch.zeros(0, dtype=torch.int64), is_slip=False)]
    previous_end = 0
    for stroke, (onset_s, (start_s, end_s)) in enumerate(zip(onsets_s, sliding_s, strict=True)):
        edge = round((onset_s - shift_s) * sample_rate_hz)
        first = edge - round(lead_s * sample_rate_hz)
        last = int(end_s * sample_rate_hz)
        if rule.layout == "half_second":
            last = min(last, edge + round(lead_s * sample_rate_hz))
        if first < 0 or last > num_samples:
            raise ValueError(
                f"stroke {stroke + 1} with its onset at {onset_s:.3f} s needs samples from "
                f"{first} to {last}, outside the recording of {duration_s:.3f} s"
            )
        if edge - first < bin_samples:
            raise ValueError(
                f"labels.bin_ms={rule.bin_ms:g} is longer than the {1000 * lead_s:g} ms before an "
                f"onset that labels.layout={rule.layout} takes as non-slip"
            )
        before = torch.arange(first, edge - bin_samples + 1, hop)
        before = before[before >= previous_end]
        after = torch.arange(edge, max(last - bin_samples + 1, edge), hop)
        position = torch.arange(-len(before), len(after))
        parts.append(_laid(before, False, stroke, position[: len(before)]))
        parts.append(_laid(after, True, stroke, position[len(before) :]))
        previous_end = math.ceil(end_s * sample_rate_hz)
        is_taken[min(edge, int(start_s * sample_rate_hz)) : previous_end] = True
    within = torch.arange(bin_samples)
    for starts, *_ in parts:
        is_taken[starts[:, None] + within] = True
    told = [(stretch, False) for stretch in non_slip_s] + [(stretch, True) for stretch in slip_s]
    for stretch, is_slip in told:
        starts = _starts_inside(stretch, bin_samples, hop, duration_s, sample_rate_hz)
        free = starts[~is_taken[starts[:, None] + within].any(-1)]
        is_taken[free[:, None] + within] = True
        parts.append(_laid(free, is_slip))
    starts, is_slips, strokes, positions = map(torch.cat, zip(*parts, strict=True))
    return LabelledBins(starts, is_slips, strokes, positions, bin_samples)


def _laid(
    starts: Tensor, is_slip: bool, stroke: int = -1, position: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The columns of ``LabelledBins`` for bins of one stroke or stretch and one kind."""
    if position is None:
        position = torch.full_like(starts, NO_POSITION)
    is_slip_each = torch.full_like(starts, is_slip, dtype=torch.bool)
    return starts, is_slip_each, torch.full_like(starts, stroke), position


def _starts_inside(
    stretch: tuple[float, float],
    bin_samples: int,
    hop: int,
    duration_s: float,
    sample_rate_hz: float,
) -> Tensor:
    """First samples of the bins that lie wholly inside a stretch, from its start on."""
    first = math.ceil(stretch[0] * sample_rate_hz - 1e-6)  # what was meant as a whole sample is one
    last = math.floor(stretch[1] * sample_rate_hz + 1e-6)
    if first < 0 or last > round(duration_s * sample_rate_hz):
        raise ValueError(
            f"the stretch from {stretch[0]:.3f} s to {stretch[1]:.3f} s leaves the "
            f"recording of {duration_s:.3f} s"
        )
    return torch.arange(first, max(last - bin_samples + 1, first), hop)


def clear_of(
    bins: LabelledBins,
    missing_s: Sequence[tuple[float, float]],
    before: int,
    after: int,
    sample_rate_hz: float,
) -> LabelledBins:
    """The bins of which no sample is missing that their filter needs.

    Args:
        bins: of a recording.
        missing_s: start and end of each stretch without samples.
        before: samples that the filter reads before a bin.
        after: and behind it.
        sample_rate_hz: of the recording.
    """
    first = bins.starts - before
    stop = bins.starts + bins.bin_samples + after
    is_whole = torch.ones_like(bins.is_slip)
    for start_s, end_s in missing_s:
        start, end = round(start_s * sample_rate_hz), round(end_s * sample_rate_hz)
        is_whole &= (stop <= start) | (first >= end)
    names = ("starts", "is_slip", "stroke", "position")
    return replace(bins, **{name: getattr(bins, name)[is_whole] for name in names})


def needed_windows(
    bins: LabelledBins, context_samples: int, duration_s: float, sample_rate_hz: float
) -> list[tuple[float, float]]:
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
