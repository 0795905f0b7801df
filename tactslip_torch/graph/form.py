"""What a graph is made for: its numbers, and the samples that a bin needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from tactslip_torch.model.detector import SlipDetector

Precision = Literal["float32", "float64"]


@dataclass(frozen=True)
class Form:
    """How a graph is written.

    Args:
        precision: of samples, scores and of all that there is one of per sample; what steps or
            cancels is float64 in either.

    Raises:
        ValueError: for another precision.
    """

    precision: Precision = "float32"

    def __post_init__(self) -> None:
        if self.precision not in (known := get_args(Precision)):
            raise ValueError(f"precision must be one of {', '.join(known)}, got {self.precision!r}")

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of samples and scores."""
        return np.dtype(self.precision)


@dataclass(frozen=True)
class Window:
    """The samples that a bin is judged by.

    Attributes:
        channels: indices in the hand of the channels in use, ascending.
        before: samples before the bin that their filters take in.
        bin: samples of the bin.
        after: samples behind it, the look-ahead.
    """

    channels: tuple[int, ...]
    before: int
    bin: int
    after: int

    @classmethod
    def of(cls, detector: SlipDetector) -> Window:
        """That of a detector."""
        channels = detector.extractor.plan.channels
        reaches = [detector.channel_filter.reaches[channel] for channel in channels]
        before, after = (max(each) for each in zip(*reaches, strict=True))
        return cls(channels, before, detector.pool.bin_samples, after)

    @property
    def length(self) -> int:
        """Of all samples."""
        return self.before + self.bin + self.after
