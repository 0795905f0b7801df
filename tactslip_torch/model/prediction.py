"""What a detector says of bins, and which channels it is not to listen to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.sensing import Sensing, is_enough
from tactslip_torch.runtime import full_precision, is_concrete, thread_map

ChannelMask = Sequence[str] | Tensor
"""Channels that are not to be listened to: their names, or a mask ``[C]``, bool."""

_PART_BINS = 256  # that stay in a cache


class Prediction(NamedTuple):
    """Scores, whether they count, and what was left out (``features.sensing``).

    Attributes:
        score: ``[*]``, at least 0 means slip; NaN where not valid.
        is_valid: ``[*]``, bool: enough channels are alive, and the score is finite.
        in_range: ``[*]``, bool: valid, and the channels move about as much as in training.
        channels_lost: ``[*, C]``, bool: channels in use that are missing or silent, and were left
            out.
        span: ``[*, C]``, float64, largest less smallest filtered sample; NaN of a channel that is
            missing or not in use.
    """

    score: Tensor
    is_valid: Tensor
    in_range: Tensor
    channels_lost: Tensor
    span: Tensor

    def in_range_of(self, sensing: Sensing, counted: Tensor) -> Prediction:
        """The same, in range or not by the spans of other recordings than those of training.

        Shape:
            - counted: ``[C]``, 1 for channels that count, else 0
        """
        _, in_range = is_enough(
            ~self.channels_lost, self.span, counted, sensing, range(len(counted))
        )
        return self._replace(in_range=in_range & self.is_valid)

    def __repr__(self) -> str:
        num, slip = self.score.numel(), int((self.score >= 0).sum())
        lost, valid = int(self.channels_lost.any(-1).sum()), int(self.is_valid.sum())
        return (
            f"Prediction({num} bins: {slip} slip, {valid - slip} non-slip, "
            f"{num - valid} not valid; {lost} with lost channels)"
        )


def predict_in_parts(predict: Callable[[Tensor], Prediction], x: Tensor) -> Prediction:
    """What ``predict`` says of bins ``[*, C, n]``: of many in parts that stay in a cache."""
    with full_precision(x):
        if x.ndim < 3 or x.shape[:-2].numel() <= _PART_BINS or not is_concrete(x):
            return predict(x)
        found = thread_map(predict, x.flatten(0, -3).split(_PART_BINS))
    whole = (torch.cat(parts).unflatten(0, x.shape[:-2]) for parts in zip(*found, strict=True))
    return Prediction(*whole)


def _channel_mask(masked: ChannelMask, names: Sequence[str]) -> Tensor:
    """The mask ``[C]`` of masked channels.

    Raises:
        ValueError: for a channel that is none of these names, or a mask of another shape or dtype.
    """
    if isinstance(masked, Tensor):
        if masked.shape != (len(names),) or masked.dtype != torch.bool:
            raise ValueError(
                f"masked_channels must be names of channels or a bool mask [{len(names)}], "
                f"got {masked.dtype} {tuple(masked.shape)}"
            )
        return masked
    listed = [masked] if isinstance(masked, str) else masked
    if not isinstance(listed, Iterable):
        raise ValueError(f"masked_channels must be a list of names of channels, got {masked!r}")
    if unknown := [name for name in listed if name not in names]:
        raise ValueError(
            f"masked_channels names the channel {unknown[0]!r}, which this hand does not have; "
            f"take some of {', '.join(names)}"
        )
    return torch.tensor([name in listed for name in names], dtype=torch.bool)


def masked_names(masked: ChannelMask, names: Sequence[str]) -> tuple[str, ...]:
    """Names of masked channels, in the order of the hand.

    Raises:
        ValueError: as ``_channel_mask``.
    """
    mask = _channel_mask(masked, names).tolist()
    return tuple(name for name, is_masked in zip(names, mask, strict=True) if is_masked)


def without(samples: Tensor, masked: ChannelMask | None, names: Sequence[str]) -> Tensor:
    """Samples ``[*, C, n]`` with NaN in masked channels, which is how a missing one looks.

    Raises:
        ValueError: as ``_channel_mask``.
    """
    if masked is None:
        return samples
    mask = _channel_mask(masked, names).to(samples.device)
    return samples.masked_fill(mask[:, None], torch.nan) if bool(mask.any()) else samples
