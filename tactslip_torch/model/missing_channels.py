"""What a detector says of bins, and of those whose channels are missing.

A column of a missing channel takes its imputation value, the mean over training bins, both classes
counting alike; columns that are pooled over channels leave the channel out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple, TypeVar, get_args

import torch
from torch import Tensor

from tactslip_torch.features.ops import (
    full_precision,
    is_concrete,
)
from tactslip_torch.runtime import in_parts
from tactslip_torch.signals.filtering import refuse_nonfinite

ChannelMask = Sequence[str] | Tensor
"""Channels that are not to be listened to: their names, or a mask ``[C]``, bool."""

Nonfinite = Literal["mask", "raise"]
"""What to do about NaN and Inf: their channels count as missing, or they are refused."""

_PART_BINS = 256  # that stay in a cache


class Prediction(NamedTuple):
    """Scores, and whether they can be relied on.

    Attributes:
        score: ``[*]``, at least 0 means slip; finite, unless the head overflows its dtype.
        is_valid: ``[*]``, bool: every channel that the score depends on can be trusted, and the
            score is finite.
        is_missing: ``[*, C]``, bool: the channel holds a NaN or Inf, or was said to be dead, and
            was left out.
    """

    score: Tensor
    is_valid: Tensor
    is_missing: Tensor

    def __repr__(self) -> str:
        num, slip = self.score.numel(), int((self.score >= 0).sum())
        lost = int(self.is_missing.any(-1).sum())
        return (
            f"Prediction({num} bins: {slip} slip, {num - slip} non-slip; "
            f"{int(self.is_valid.sum())} valid, {lost} with missing channels)"
        )


Said = TypeVar("Said", Tensor, Prediction)


def check_nonfinite(policy: str, samples: Tensor, names: Sequence[str]) -> None:
    """Hold samples ``[*, C, n]`` of the named channels against a policy.

    Raises:
        ValueError: for an unknown policy, or under ``"raise"`` for a NaN or Inf.
    """
    if policy not in get_args(Nonfinite):
        raise ValueError(f"nonfinite must be 'mask' or 'raise', got {policy!r}")
    if policy == "raise":
        refuse_nonfinite(samples, names, "repair the samples, or take nonfinite='mask'")


def predict_in_parts(predict: Callable[[Tensor], Said], x: Tensor) -> Said:
    """What ``predict`` says of bins ``[*, C, n]``: of many in parts that stay in a cache."""

    def joined(parts: Sequence[Tensor]) -> Tensor:
        whole: Tensor = torch.cat(list(parts)).unflatten(0, x.shape[:-2])
        return whole

    with full_precision(x):
        if x.ndim < 3 or x.shape[:-2].numel() <= _PART_BINS or not is_concrete(x):
            return predict(x)
        found = in_parts(predict, x.flatten(0, -3).split(_PART_BINS))
    if isinstance(found[0], Prediction):
        return Prediction(*map(joined, zip(*found, strict=True)))
    return joined(found)


# Missing channels ------------------------------------------------------------------------------


def channel_mask(masked: ChannelMask, names: Sequence[str]) -> Tensor:
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
        ValueError: as ``channel_mask``.
    """
    mask = channel_mask(masked, names).tolist()
    return tuple(name for name, is_masked in zip(names, mask, strict=True) if is_masked)


def without(samples: Tensor, masked: ChannelMask | None, names: Sequence[str]) -> Tensor:
    """Samples ``[*, C, n]`` with NaN in masked channels, which is how a missing one looks.

    Raises:
        ValueError: as ``channel_mask``.
    """
    if masked is None:
        return samples
    mask = channel_mask(masked, names).to(samples.device)
    return samples.masked_fill(mask[:, None], torch.nan) if bool(mask.any()) else samples
