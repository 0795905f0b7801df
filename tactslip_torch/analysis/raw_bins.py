"""Bins of a split before filtering, with the context that a detector's filter needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from torch import Tensor

from tactslip_torch.data.labels import LabelledBins
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.training.datamodule import FeatureMaker


def in_turn(recordings: Iterable[RecordingId]) -> list[RecordingId]:
    """The same recordings, the first of each material before a second of any."""
    seen: Counter[str] = Counter()
    numbered = []
    for recording in recordings:
        seen[recording.material] += 1
        numbered.append((seen[recording.material], recording))
    return [recording for _, recording in sorted(numbered, key=lambda pair: pair[0])]


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
