"""Raw bins with the context that a score needs, as many of each class, from many recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.bin_sample import bin_keys
from tactslip_torch.signals.finite import refuse_nonfinite

MOST_RECORDINGS = 60
"""So many at most are read or simulated; of more, materials in turn."""


def draw_raw_bins(
    maker: FeatureMaker,
    fold: Split,
    number: int,
    progress: Callable[[Iterable[Any], str], Iterable[Any]],
) -> tuple[Tensor, Tensor]:
    """Training bins in volts, half of each class, drawn by ``bin_keys``: the same every time.

    A bin whose context leaves its recording is passed over.

    Args:
        maker: of the recordings.
        fold: says who is trained on.
        number: of bins, about.
        progress: wraps the recordings.

    Shape:
        - first output: ``[N, C, before + n + after]``, as ``score_raw`` takes them
        - second output: ``[N]``, bool, whether it is slip

    Raises:
        ValueError: if a class has no such bin, or a sample is not finite.
    """
    recordings = _in_turn(fold.having("train"))[:MOST_RECORDINGS]
    each = max(1, math.ceil(number / 2 / len(recordings)))
    before, after = maker.channel_filter.context_before, maker.channel_filter.context_after
    parts: list[Tensor] = []
    labels: list[Tensor] = []
    for recording in progress(recordings, "raw bins"):
        times = maker.source.timeline(recording)
        bins = maker.lay_bins(times)
        first, last = bins.starts - before, bins.starts + bins.bin_samples + after
        may = fold.bin_roles(recording, len(first))["train"] & (first >= 0)
        may &= last <= round(times.duration_s * maker.source.sample_rate_hz)
        keys = torch.where(may, bin_keys(str(recording), len(first)), torch.inf)
        chosen = list[Tensor]()
        for value in (False, True):
            mine = torch.where(bins.is_slip == value, keys, torch.inf)
            chosen.append(mine.argsort()[: min(each, int(mine.isfinite().sum()))])
        index = torch.cat(chosen)
        parts.append(maker.raw_bins(recording, index))
        labels.append(bins.is_slip[index])
        refuse_nonfinite(parts[-1], maker.source.hand.names, f"repair or leave out {recording}")
    is_slip = torch.cat(labels)
    for value, name in ((False, "non-slip"), (True, "slip")):
        if not bool((is_slip == value).any()):
            raise ValueError(
                f"no {name} bin lies far enough inside its recording; take longer ones"
            )
    return torch.cat(parts), is_slip


def _in_turn(recordings: list[RecordingId]) -> list[RecordingId]:
    """The same in an order by key, but one of each material before a second of any."""
    met: dict[str, int] = {}
    places = []
    for recording in sorted(recordings, key=lambda r: float(bin_keys(str(r), 1)[0])):
        met[recording.material] = met.get(recording.material, 0) + 1
        places.append((met[recording.material], recording.material, recording))
    return [recording for *_, recording in sorted(places)]
