"""What only the samples of a recording tell: their range, and channels that are dead or broken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.formats import pieces
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.sets.agreement import Part
from tactslip_torch.data.sets.datasets import FileRecordings
from tactslip_torch.data.sets.sampling import even_samples
from tactslip_torch.data.sets.stream import Stream
from tactslip_torch.data.sets.truth import Stretch

PIECE = 1 << 16
"""Samples that are looked at at a time."""


class Inspected(NamedTuple):
    """What the samples of a recording are, as they stand in its file.

    Args:
        least: of each channel, in the order of the hand; NaN if none of it is finite.
        greatest: the same.
        broken: of each channel that has any, how many samples are not finite, gaps apart, and
            when the first of them is, in seconds.
    """

    least: list[float]
    greatest: list[float]
    broken: dict[int, tuple[int, float]]


def inspected(source: FileRecordings, recording: RecordingId) -> Inspected:
    """All samples of a recording looked at once, by stretches.

    Raises:
        FileNotFoundError: if its file is gone.
        ValueError: if it is damaged.
    """
    path = source.root / source.entry(recording).file
    missing_s = source.timeline(recording).missing_s
    found = [_inspected(path, stream, part, missing_s) for stream, part in source.parts(recording)]
    broken: dict[int, tuple[int, float]] = {}
    place = 0
    for one in found:
        broken |= {place + row: what for row, what in one.broken.items()}
        place += len(one.least)
    return Inspected(
        [value for one in found for value in one.least],
        [value for one in found for value in one.greatest],
        broken,
    )


def oddities(source: FileRecordings, found: Inspected) -> list[str]:
    """What in the samples is worth a look, a line each."""
    odd = []
    names = source.hand.names
    for row, (count, first_s) in found.broken.items():
        odd.append(
            f"{names[row]} is not finite in {count} samples, first at {first_s:.4f} s; leave the "
            "stretch out as missing_s, or repair it"
        )
    still = [
        (name, least)
        for name, least, greatest in zip(names, found.least, found.greatest, strict=True)
        if least == greatest
    ]
    odd += [f"{name} never changes, it is {value:g} throughout" for name, value in still]
    return odd


def _inspected(path: Path, stream: Stream, part: Part, missing_s: Sequence[Stretch]) -> Inspected:
    """One stream of a file."""
    missing = [(gap.start, gap.start + gap.missing) for gap in part.found.clock.gaps]
    missing += [(round(a * part.rate_hz), round(b * part.rate_hz)) for a, b in missing_s]
    num, rows = len(part.rows), list(part.rows)
    low = torch.full((num,), torch.inf, dtype=torch.float64)
    high, count = -low, torch.zeros(num, dtype=torch.int64)
    first = torch.full((num,), -1, dtype=torch.int64)
    seen = 0
    with even_samples(path, stream, part.found) as samples:
        for piece in pieces(samples, PIECE):
            values = piece[rows].double()
            is_fine = values.isfinite()
            low = torch.minimum(low, values.where(is_fine, torch.inf).amin(-1))
            high = torch.maximum(high, values.where(is_fine, -torch.inf).amax(-1))
            is_bad = ~is_fine & ~_inside(missing, seen, piece.shape[-1])
            is_first = (first < 0) & is_bad.any(-1)
            first = torch.where(is_first, seen + is_bad.int().argmax(-1), first)
            count += is_bad.sum(-1)
            seen += piece.shape[-1]
    is_known = low <= high
    return Inspected(
        low.where(is_known, torch.nan).tolist(),
        high.where(is_known, torch.nan).tolist(),
        {
            row: (int(count[row]), int(first[row]) / part.rate_hz)
            for row in count.nonzero().flatten().tolist()
        },
    )


def _inside(stretches: Sequence[tuple[int, int]], first: int, num_samples: int) -> Tensor:
    """Which of so many samples from ``first`` on lie in a stretch, ``[n]``."""
    is_inside = torch.zeros(num_samples, dtype=torch.bool)
    for start, end in stretches:
        is_inside[max(start - first, 0) : max(end - first, 0)] = True
    return is_inside
