"""Bins of a split before filtering, with the context that a detector's filter needs."""

from __future__ import annotations

import math
from collections import Counter

import torch
from torch import Tensor

from tactslip_torch.data.labels import LabelledBins
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.runtime import bar
from tactslip_torch.signals.filtering import refuse_nonfinite
from tactslip_torch.training.datamodule import FeatureMaker

_BINS_OF_RECORDING = 40
"""Drawn from a recording, more where there are too few recordings."""


def bins_inside(
    maker: FeatureMaker, fold: Split, recording: RecordingId, role: str
) -> tuple[LabelledBins, Tensor]:
    """The labelled bins of a recording, and the numbers of those that can be scored as they are.

    These have the role, and their whole context lies inside the recording.

    Shape:
        - numbers: ``[m]``, as ``FeatureMaker.raw_bins`` takes them
    """
    times = maker.source.timeline(recording)
    bins = maker.lay_bins(times)
    first = bins.starts - maker.channel_filter.context_before
    last = bins.starts + bins.bin_samples + maker.channel_filter.context_after
    is_inside = (first >= 0) & (last <= round(times.duration_s * maker.source.sample_rate_hz))
    has_role = fold.bin_roles(recording, len(first))[role]
    return bins, (is_inside & has_role).nonzero()[:, 0]


def draw_bins(
    maker: FeatureMaker,
    fold: Split,
    role: str,
    number: int,
    seed: int,
    each: int = _BINS_OF_RECORDING,
    *,
    by_class: bool = False,
) -> tuple[Tensor, Tensor, list[RecordingId]]:
    """Raw bins of a role with the context that ``score_raw`` needs, drawn at random.

    Recordings are taken from the materials in turn, a few bins of each, so that few bins are of
    many recordings. A bin whose context leaves its recording is passed over.

    Args:
        maker: of the recordings.
        fold: says which role a bin has.
        role: of the bins.
        number: of bins, at most.
        seed: of the draw.
        each: bins of a recording, more where there are too few recordings.
        by_class: as many of non-slip as of slip, as far as a recording has them.

    Returns:
        The bins ``[N, C, context_before + n + context_after]``, whether each is slip ``[N]``, and
        the recordings they are of.

    Raises:
        ValueError: if no recording has the role, none has a bin, or a sample is not finite.
    """
    generator = torch.Generator().manual_seed(seed)
    having = fold.having(role)
    if not having:
        raise ValueError(f"no recording has the role {role!r} in {fold.name}; choose another split")
    each = max(each, math.ceil(number / len(having)))
    seen: Counter[str] = Counter()

    def turn(recording: RecordingId) -> int:
        """The first of each material before a second of any."""
        seen[recording.material] += 1
        return seen[recording.material]

    order = torch.randperm(len(having), generator=generator).tolist()
    in_turn = sorted((having[place] for place in order), key=turn)
    recordings = in_turn[: math.ceil(number / each)]
    drawn: list[Tensor] = []
    labels: list[Tensor] = []
    for recording in bar(recordings, f"{role}, recordings", "recording"):
        bins, inside = bins_inside(maker, fold, recording, role)
        shuffled = inside[torch.randperm(len(inside), generator=generator)]
        if by_class:
            is_slip, half = bins.is_slip[shuffled], math.ceil(each / 2)
            shuffled = torch.cat([shuffled[is_slip == value][:half] for value in (False, True)])
        chosen = shuffled[:each].sort().values
        drawn.append(maker.raw_bins(recording, chosen))
        labels.append(bins.is_slip[chosen])
        refuse_nonfinite(drawn[-1], maker.source.hand.names, f"repair or leave out {recording}")
    samples = torch.cat(drawn)[:number]
    if not len(samples):
        raise ValueError(f"no bin of {role} lies far enough inside its recording; take longer ones")
    return samples, torch.cat(labels)[:number], recordings
