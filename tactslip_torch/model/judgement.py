"""A score with its validity, and what becomes of NaN and Inf: the policy is the caller's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from torch import Tensor

from tactslip_torch.signals.finite import refuse_nonfinite

Nonfinite = Literal["mask", "raise"]
_POLICIES = get_args(Nonfinite)


class Judgement(NamedTuple):
    """Scores, and whether they can be relied on.

    Attributes:
        score: ``[*]``, at least 0 means slip; finite, unless the head overflows its dtype.
        is_valid: ``[*]``, bool: every channel that the score depends on can be trusted, and the
            score is finite.
        is_missing: ``[*, C]``, bool: the channel holds a NaN or Inf and was left out.
    """

    score: Tensor
    is_valid: Tensor
    is_missing: Tensor


def check_nonfinite(policy: str, samples: Tensor, names: Sequence[str]) -> None:
    """Hold samples ``[*, C, n]`` of the named channels against a policy.

    Raises:
        ValueError: for an unknown policy, or under ``"raise"`` for a NaN or Inf.
    """
    if policy not in _POLICIES:
        raise ValueError(f"nonfinite must be 'mask' or 'raise', got {policy!r}")
    if policy == "raise":
        refuse_nonfinite(samples, names, "repair the samples, or take nonfinite='mask'")
