"""A recording: one cycle of the protocol as the sensors gave it, with what is true of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Recording:
    """One trial: raw samples and the truth about them.

    Args:
        samples: volts, ``[C, T]``, unfiltered. NaN where a simulation was not asked for a
            channel or a stretch of time; never a silent number.
        sample_rate_hz: samples per second and channel.
        material: what the hand slid on.
        speeds_mm_s: steady speed of each stroke.
        onsets_s: when the *contact* begins to slide, one per stroke, exact where known.
        sliding_s: ``(start, end)`` of every stretch in which the contact slides.
        annotated_onsets_s: the onsets as a person marked them, if that differs; labels use
            these unless told otherwise. Defaults to ``onsets_s``.
        provenance: where it comes from; simulated recordings say ``{"simulated": True, ...}``.

    Raises:
        ValueError: if samples are not ``[C, T]``, the rate is not positive, or the number of
            onsets differs from that of speeds, sliding stretches or annotations.
    """

    samples: Tensor
    sample_rate_hz: float
    material: str
    speeds_mm_s: tuple[float, ...]
    onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]
    annotated_onsets_s: tuple[float, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

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

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.samples.shape[-1] / self.sample_rate_hz
