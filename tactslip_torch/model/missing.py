"""What a detector says where channels are missing, and how sure it can be of that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from tactslip_torch.features.pool import saturating
from tactslip_torch.model.class_gaussians import ClassGaussians
from tactslip_torch.model.detector_file import Head
from tactslip_torch.model.expected_score import ExpectedScore
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.runtime import has_values

Dead = Sequence[str] | Tensor
"""Channels that are not to be listened to: their names, or a mask ``[C]``, bool."""


def dead_mask(dead: Dead, names: Sequence[str]) -> Tensor:
    """The mask ``[C]`` of dead channels.

    Raises:
        ValueError: for a channel that is none of these names, or a mask of another shape or dtype.
    """
    if isinstance(dead, Tensor):
        if dead.shape != (len(names),) or dead.dtype != torch.bool:
            raise ValueError(
                f"dead must be names of channels or a bool mask [{len(names)}], got {dead.dtype} "
                f"{tuple(dead.shape)}"
            )
        return dead
    listed = [dead] if isinstance(dead, str) else dead
    if not isinstance(listed, Iterable):
        raise ValueError(f"dead must be a list of names of channels, got {dead!r}")
    if unknown := [name for name in listed if name not in names]:
        raise ValueError(
            f"dead names the channel {unknown[0]!r}, which this hand does not have; take some of "
            f"{', '.join(names)}"
        )
    return torch.tensor([name in listed for name in names], dtype=torch.bool)


def dead_names(dead: Dead, names: Sequence[str]) -> tuple[str, ...]:
    """Names of dead channels, in the order of the hand.

    Raises:
        ValueError: as ``dead_mask``.
    """
    mask = dead_mask(dead, names).tolist()
    return tuple(name for name, is_dead in zip(names, mask, strict=True) if is_dead)


def without(samples: Tensor, dead: Dead | None, names: Sequence[str]) -> Tensor:
    """Samples ``[*, C, n]`` with NaN in dead channels, which is how a missing one looks.

    Raises:
        ValueError: as ``dead_mask``.
    """
    if dead is None:
        return samples
    mask = dead_mask(dead, names).to(samples.device)
    return samples.masked_fill(mask[:, None], torch.nan) if bool(mask.any()) else samples


class MissingScores:
    """Scores of bins some of whose channels are missing.

    Of a quadratic form with Gaussians of its features, the expected score and its variance
    (``ExpectedScore``). Of any other, the score of typical features in the place of those missing,
    and no variance.

    Args:
        head: the machine.
        typical: scaled features, ``[K]``.
        channel_index: of each column, ``[K]``; one past the last channel for a pooled one.
        gaussians: of the features, if they are known.
    """

    def __init__(
        self,
        head: Head,
        typical: Tensor,
        channel_index: Tensor,
        gaussians: ClassGaussians | None,
    ) -> None:
        self._head, self._typical, self._channel_index = head, typical, channel_index
        self._expected: ExpectedScore | None = None
        if gaussians is not None and isinstance(head, QuadraticForm):
            self._expected = ExpectedScore(head, gaussians)
        of = _tensors(head, typical, channel_index, gaussians)
        self._stamps = [(each, _state(each)) for each in of]

    def is_of(
        self,
        head: Head,
        typical: Tensor,
        channel_index: Tensor,
        gaussians: ClassGaussians | None,
    ) -> bool:
        """Whether it was made of these, none of them replaced or changed since."""
        now = _tensors(head, typical, channel_index, gaussians)
        return len(now) == len(self._stamps) and all(map(_is_as_stamped, now, self._stamps))

    def __call__(self, score: Tensor, scaled: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Scores and their variances; those of bins that miss no feature are as they came, and 0.

        Shape:
            - score: ``[*]``, of all features
            - scaled: ``[*, K]``, features; anything finite where missing
            - is_missing: ``[*, C]``, bool, of channels
            - output: ``[*]`` each
        """
        pooled = torch.zeros_like(is_missing[..., :1])  # never lost: it is of the other channels
        is_lost = torch.cat([is_missing, pooled], -1).index_select(-1, self._channel_index)
        rows = is_lost.any(-1)
        if has_values(rows):
            mean, spread = self._of(scaled[rows], is_lost[rows])
            return _put(score, rows, mean), _put(torch.zeros_like(score), rows, spread)
        mean, spread = (saturating(each, score.dtype) for each in self._of(scaled, is_lost))
        return torch.where(rows, mean, score), torch.where(rows, spread, 0.0)

    def _of(self, scaled: Tensor, is_lost: Tensor) -> tuple[Tensor, Tensor]:
        """Of features ``[*, K]``, and which of them are missing."""
        if self._expected is None:
            score = self._head(torch.where(is_lost, self._typical, scaled))
            return score, torch.zeros_like(score)
        return self._expected(scaled, is_lost)


def _put(values: Tensor, where: Tensor, others: Tensor) -> Tensor:
    """The same with others where a mask holds, of any number of axes, 0 too."""
    return values.masked_scatter(where, saturating(others, values.dtype))


def _tensors(
    head: Head, typical: Tensor, channel_index: Tensor, gaussians: ClassGaussians | None
) -> list[Tensor]:
    of_features = [] if gaussians is None else gaussians.buffers()
    return [*head.buffers(), typical, channel_index, *of_features]


def _state(x: Tensor) -> int | Tensor:
    """How often a tensor was changed in place; of inference tensors, which do not count, a copy."""
    return x.clone() if x.is_inference() else x._version


def _is_as_stamped(x: Tensor, stamp: tuple[Tensor, int | Tensor]) -> bool:
    same, state = stamp
    if x is not same:
        return False
    return torch.equal(x, state) if isinstance(state, Tensor) else x._version == state
