"""A score with its validity, and what becomes of NaN and Inf: the policy is the caller's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeVar, get_args

import torch
from torch import Tensor

from tactslip_torch.runtime import in_parts, is_concrete
from tactslip_torch.signals.binning import refuse_nonfinite

Nonfinite = Literal["mask", "raise"]
_POLICIES = get_args(Nonfinite)
_PART_BINS = 256


class Prediction(NamedTuple):
    """Scores, and whether they can be relied on.

    Attributes:
        score: ``[*]``, at least 0 means slip; finite, unless the head overflows its dtype.
        is_valid: ``[*]``, bool: every channel that the score depends on can be trusted, and the
            score is finite.
        is_missing: ``[*, C]``, bool: the channel holds a NaN or Inf, or was said to be dead, and
            was left out.
        variance: ``[*]``, of the score, which is an expected one where a channel in use is missing;
            0 where none is.
    """

    score: Tensor
    is_valid: Tensor
    is_missing: Tensor
    variance: Tensor


Said = TypeVar("Said", Tensor, Prediction)


def check_nonfinite(policy: str, samples: Tensor, names: Sequence[str]) -> None:
    """Hold samples ``[*, C, n]`` of the named channels against a policy.

    Raises:
        ValueError: for an unknown policy, or under ``"raise"`` for a NaN or Inf.
    """
    if policy not in _POLICIES:
        raise ValueError(f"nonfinite must be 'mask' or 'raise', got {policy!r}")
    if policy == "raise":
        refuse_nonfinite(samples, names, "repair the samples, or take nonfinite='mask'")


def predict_in_parts(predict: Callable[[Tensor], Said], x: Tensor) -> Said:
    """What ``predict`` says of bins ``[*, C, n]``: of many in parts that stay in a cache."""
    if x.ndim < 3 or x.shape[:-2].numel() <= _PART_BINS or not is_concrete(x):
        return predict(x)

    def joined(parts: Sequence[Tensor]) -> Tensor:
        whole: Tensor = torch.cat(list(parts)).unflatten(0, x.shape[:-2])
        return whole

    found = in_parts(predict, x.flatten(0, -3).split(_PART_BINS))
    if isinstance(found[0], Prediction):
        return Prediction(*map(joined, zip(*found, strict=True)))
    return joined(found)
