"""A whole recording as a detector scores it: one bin every hop, however many fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from tactslip_torch.model.judgement import Judgement
from tactslip_torch.signals.filtering import ChannelFilter


class Scores(NamedTuple):
    """Judgements of N bins of a recording, in order.

    Attributes:
        score: ``[N]``, dtype of the samples; at least 0 means slip.
        is_valid: ``[N]``, bool: whether it can be relied on.
        is_missing: ``[N, C]``, bool: the channel holds a NaN or Inf and was left out.
        variance: ``[N]``, of the score; 0 where no channel in use is missing.
    """

    score: Tensor
    is_valid: Tensor
    is_missing: Tensor
    variance: Tensor


class Bins(Protocol):
    """What is asked of a pool: how long bins are, and in what they are computed."""

    @property
    def bin_samples(self) -> int:
        """Samples of a bin."""

    @property
    def sample_rate_hz(self) -> float:
        """Of the samples."""

    def widen(self, x: Tensor) -> Tensor:
        """Samples in the dtype that is computed in."""


class Scorer(Protocol):
    """What is asked of a detector: ``SlipDetector``, or a baseline that judges filtered bins."""

    @property
    def pool(self) -> Bins:
        """How long bins are, and in what they are computed."""

    @property
    def channel_filter(self) -> ChannelFilter:
        """The frames of all channels."""

    @property
    def needed_index(self) -> Tensor:
        """Channels in use, ascending; the others are not filtered."""

    @property
    def look_ahead(self) -> int:
        """Samples behind a bin that its score waits for."""

    def judge(self, bins: Tensor, *, given: torch.dtype) -> Judgement:
        """Judge filtered bins ``[N, C, n]``, of samples that were ``given`` in a dtype."""


def score_stream(detector: Scorer, samples: Tensor, hop_samples: int, chunk: int = 1024) -> Scores:
    """Score every bin of a recording that begins a whole number of hops from its start.

    The recording is filtered whole, each channel in use, and judged some bins at a time. A NaN
    makes the bins within its frame's reach not valid. A recording shorter than a bin or a frame
    has no scores.

    Args:
        detector: whose judgement.
        samples: the recording, volts; may hold NaN.
        hop_samples: distance of the bins' starts.
        chunk: bins at once, for memory.

    Shape:
        - samples: ``[C, T]``, float32 or float64

    Raises:
        ValueError: if hop or chunk is no positive number, or samples are not of this hand.
    """
    _check(detector, samples)
    if hop_samples < 1 or chunk < 1:
        raise ValueError(f"hop_samples and chunk must be positive, got {hop_samples} and {chunk}")
    with torch.no_grad():
        samples = samples.detach()
        if samples.shape[-1] < _longest_frame(detector):
            return score_filtered(detector, samples[:, :0], hop_samples, samples.dtype, chunk)
        wide = detector.pool.widen(samples)
        filtered = detector.channel_filter(wide, detector.needed_index.tolist())
        return score_filtered(detector, filtered, hop_samples, samples.dtype, chunk)


def score_filtered(
    detector: Scorer, filtered: Tensor, hop_samples: int, given: torch.dtype, chunk: int = 1024
) -> Scores:
    """Score every bin that fits into filtered samples ``[C, m]``, the first at their start.

    Args:
        detector: whose judgement.
        filtered: in the dtype that is computed in.
        hop_samples: distance of the bins' starts.
        given: dtype that the samples came in.
        chunk: bins at once, for memory.
    """
    length = detector.pool.bin_samples
    if filtered.shape[-1] < length:
        none = filtered.new_empty(0, len(filtered))
        empty = none.new_empty(0, dtype=given)
        return Scores(empty, none.bool()[:, 0], none.bool(), empty)
    bins = filtered.unfold(-1, length, hop_samples).transpose(0, 1)  # [N, C, n], a view
    judged = [detector.judge(part.contiguous(), given=given) for part in bins.split(chunk)]
    return Scores(*judged[0]) if len(judged) == 1 else Scores(*_together(judged))


def _check(detector: Scorer, samples: Tensor) -> None:
    """Refuse what is no recording of the detector's hand.

    Raises:
        ValueError: if there are other axes or channels.
    """
    num_channels = len(detector.channel_filter.window_lengths)
    if samples.ndim != 2 or len(samples) != num_channels:
        raise ValueError(
            f"expected a recording [{num_channels}, T] (channels, time), got {tuple(samples.shape)}"
        )


def _together(judged: Sequence[Judgement]) -> list[Tensor]:
    return [torch.cat(parts) for parts in zip(*judged, strict=True)]


def _longest_frame(detector: Scorer) -> int:
    """Samples of the longest frame that a channel in use is filtered by."""
    lengths = detector.channel_filter.window_lengths
    return max(lengths[int(channel)] for channel in detector.needed_index)
