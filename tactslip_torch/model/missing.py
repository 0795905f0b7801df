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
        channel_index: of each feature, ``[K]``.
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
        self._of = _stamps(head, typical, channel_index, gaussians)

    def is_of(
        self,
        head: Head,
        typical: Tensor,
        channel_index: Tensor,
        gaussians: ClassGaussians | None,
    ) -> bool:
        """Whether it was made of these, none of them replaced or changed since."""
        now = _stamps(head, typical, channel_index, gaussians)
        return len(now) == len(self._of) and all(
            new is old and version == before
            for (new, version), (old, before) in zip(now, self._of, strict=True)
        )

    def __call__(self, score: Tensor, scaled: Tensor, is_missing: Tensor) -> tuple[Tensor, Tensor]:
        """Scores and their variances; those of bins that miss no feature are as they came, and 0.

        Shape:
            - score: ``[*]``, of all features
            - scaled: ``[*, K]``, features; anything finite where missing
            - is_missing: ``[*, C]``, bool, of channels
            - output: ``[*]`` each
        """
        is_lost = is_missing.index_select(-1, self._channel_index)
        rows = is_lost.any(-1)
        variance = torch.zeros_like(score)
        if self._expected is None:
            filled = torch.where(is_lost, self._typical, scaled)[rows]
            return _put(score, rows, self._head(filled)), variance
        mean, spread = self._expected(scaled[rows], is_lost[rows])
        return _put(score, rows, mean), _put(variance, rows, spread)


def _put(values: Tensor, where: Tensor, others: Tensor) -> Tensor:
    """The same with others where a mask holds, of any number of axes, 0 too."""
    return values.masked_scatter(where, saturating(others, values.dtype))


def _stamps(
    head: Head, typical: Tensor, channel_index: Tensor, gaussians: ClassGaussians | None
) -> list[tuple[Tensor, int]]:
    """Tensors, each with how often it was changed in place."""
    of_features = [] if gaussians is None else gaussians.buffers()
    tensors = [*head.buffers(), typical, channel_index, *of_features]
    return [(each, each._version) for each in tensors]
