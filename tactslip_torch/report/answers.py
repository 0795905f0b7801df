"""Answers of slip, non-slip and unsure beside the truth, recording by recording, JSON-safe.

An answer *covers* a bin unless it is the other class: one that is unsure holds both. What was asked
of the thresholds is a mean over recordings, so coverage is counted by recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

Counts = Sequence[Sequence[int]]
"""Bins of a recording by truth (non-slip, slip) and answer (unsure, non-slip, slip)."""

CLASSES = ("non_slip", "slip")
_ROUNDING = 1e-12  # of a share


def answer_counts(is_slip: Tensor, answer: Tensor) -> list[list[int]]:
    """Bins by truth and answer.

    Args:
        is_slip: the truth.
        answer: 1 for slip, 0 for non-slip, -1 for unsure.

    Shape:
        - is_slip (bool), answer: ``[N]``

    Raises:
        ValueError: if lengths differ or an answer is none of these.

    Example:
        >>> answer_counts(torch.tensor([True, True, False]), torch.tensor([1, -1, 0]))
        [[0, 1, 0], [1, 0, 1]]
    """
    if is_slip.shape != answer.shape or is_slip.ndim != 1:
        shapes = f"{tuple(is_slip.shape)} and {tuple(answer.shape)}"
        raise ValueError(f"expected is_slip and answer [N] of one N, got {shapes}")
    if len(answer) and not -1 <= int(answer.min()) <= int(answer.max()) <= 1:
        raise ValueError(f"answers are -1, 0 or 1, got {answer.unique().tolist()}")
    cells = torch.bincount(3 * is_slip.long() + answer.long() + 1, minlength=6)
    counts: list[list[int]] = cells.view(2, 3).tolist()
    return counts


def answer_metrics(recordings: Mapping[str, Counts], coverage: float) -> dict[str, Any]:
    """What answers are worth: coverage by recording, how many are unsure, errors of the others.

    Returns ``coverage`` (as asked), ``unsure`` (share of all bins), ``sure_accuracy`` and
    ``sure_balanced_accuracy`` (of bins that are not unsure), ``counts`` (of all bins),
    ``recordings`` (the counts of each) and for each of ``CLASSES`` a dict: ``coverage``, the mean
    over recordings of the share of bins whose truth is in the answer; ``reached``, the share of
    recordings that have at least what was asked, which is not promised; ``unsure``, of its bins;
    ``num_recordings``, with bins of it. None where there is nothing to divide by.

    Args:
        recordings: counts by name of the recording, as ``answer_counts`` has them.
        coverage: that was asked for.
    """
    table = torch.tensor(list(recordings.values()), dtype=torch.int64).view(-1, 2, 3)
    total = table.sum(0)
    sure = total[:, 1:].double()
    recalls = [_ratio(sure[c, c], sure[c].sum()) for c in (0, 1)]
    found: dict[str, Any] = {
        "coverage": coverage,
        "unsure": _ratio(total[:, 0].sum(), total.sum()),
        "sure_accuracy": _ratio(sure.diagonal().sum(), sure.sum()),
        "sure_balanced_accuracy": _mean(recalls),
        "counts": total.tolist(),
    }
    for index, name in enumerate(CLASSES):
        shares = covered_shares(table, index)
        found[name] = {
            "coverage": _ratio(shares.sum(), len(shares)),
            "reached": _ratio((shares >= coverage - _ROUNDING).sum(), len(shares)),
            "unsure": _ratio(total[index, 0], total[index].sum()),
            "num_recordings": len(shares),
        }
    return found | {"recordings": {name: list(map(list, c)) for name, c in recordings.items()}}


def covered_shares(table: Tensor, truth: int) -> Tensor:
    """Of recordings with bins of a class, the share of them whose truth is in the answer.

    Shape:
        - table: ``[R, 2, 3]``; output: at most ``[R]``, float64
    """
    own = table[:, truth].double()
    own = own[own.sum(1) > 0]
    return 1 - own[:, 2 - truth] / own.sum(1)  # the answer that is the other class


def merged_answers(folds: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """``answer_metrics`` of several folds together, which were asked for one coverage.

    A recording of several folds is one of each: ``recordings`` has it by fold and name.
    """
    if len(folds) == 1:
        return dict(next(iter(folds.values())))
    recordings = {
        f"{fold}/{name}": counts
        for fold, part in folds.items()
        for name, counts in part["recordings"].items()
    }
    return answer_metrics(recordings, next(iter(folds.values()))["coverage"])


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def _ratio(part: Tensor | int, whole: Tensor | int) -> float | None:
    return float(part) / float(whole) if float(whole) else None
