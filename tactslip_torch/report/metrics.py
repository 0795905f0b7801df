"""Scores per bin of a split and of its groups, in JSON-safe values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from tactslip_torch.report.published import PAPER_SCENE
from tactslip_torch.runtime import check_share

_Label = TypeVar("_Label", str, int)
_FIRST, _LAST = -20, 19
_POSITIONS = (f"<{_FIRST}", *map(str, range(_FIRST, _LAST + 1)), f"{_LAST + 1}+")
"""Places beside an onset that ``bin_metrics`` counts, earliest first."""


def confusion_matrix(is_slip_true: Tensor, is_slip_predicted: Tensor) -> list[list[int]]:
    """Number of bins by truth and prediction.

    Returns ``[[non-slip as non-slip, non-slip as slip], [slip as non-slip, slip as slip]]``:
    truth by row, prediction by column, non-slip first. No bins give zeros.

    Shape:
        - is_slip_true, is_slip_predicted: ``[N]``, bool

    Raises:
        ValueError: if the two are not bool vectors of one length.

    Example:
        >>> truth = torch.tensor([False, False, True, True, True])
        >>> confusion_matrix(truth, torch.tensor([False, True, True, True, False]))
        [[1, 1], [1, 2]]
    """
    for name, flags in (("is_slip_true", is_slip_true), ("is_slip_predicted", is_slip_predicted)):
        if flags.dtype != torch.bool or flags.ndim != 1:
            raise ValueError(f"{name} must be [N] bool, got {tuple(flags.shape)} {flags.dtype}")
    if is_slip_true.shape != is_slip_predicted.shape:
        raise ValueError(
            "truth and prediction must have one length, "
            f"got {len(is_slip_true)} and {len(is_slip_predicted)} bins"
        )
    cells = torch.bincount(2 * is_slip_true.long() + is_slip_predicted.long(), minlength=4)
    counts: list[list[int]] = cells.view(2, 2).tolist()
    return counts


def split_metrics(confusion: Sequence[Sequence[int]]) -> dict[str, Any]:
    """Scores of a confusion matrix, as fractions.

    Returns ``accuracy``, ``balanced_accuracy`` (mean of the two recalls), ``non_slip_recall``,
    ``slip_recall``, ``confusion`` and ``num_bins``. The recall of a class without bins is None,
    and so is balanced accuracy then: a missing class is no perfect score.

    Args:
        confusion: as ``confusion_matrix`` returns it.

    Example:
        >>> split_metrics([[3, 1], [0, 4]])["balanced_accuracy"]
        0.875
        >>> split_metrics([[0, 0], [1, 3]])["balanced_accuracy"] is None
        True
    """
    recalls = [_ratio(row[truth], sum(row)) for truth, row in enumerate(confusion)]
    num_bins = sum(map(sum, confusion))
    return {
        "accuracy": _ratio(confusion[0][0] + confusion[1][1], num_bins),
        "balanced_accuracy": _mean(recalls),
        "non_slip_recall": recalls[0],
        "slip_recall": recalls[1],
        "confusion": [list(row) for row in confusion],
        "num_bins": num_bins,
    }


def balanced_accuracy(
    says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None
) -> float | None:
    """Mean recall of both classes, of decisions and truths ``[N]``; ``None`` if one is absent."""
    is_right = says_slip == is_slip
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    return _mean(
        [_ratio(weights[of & is_right].sum(), weights[of].sum()) for of in (~is_slip, is_slip)]
    )


def bin_metrics(
    is_slip_true: Tensor,
    is_slip_predicted: Tensor,
    materials: Sequence[str],
    speeds_mm_s: Sequence[float],
    scenes: Sequence[str] | None = None,
    positions: Sequence[int | None] | None = None,
) -> dict[str, Any]:
    """Scores of a split: of all its bins, and of groups of them.

    Returns what ``split_metrics`` returns plus ``per_material`` (in order of appearance) and
    ``per_speed`` (slowest first; keys ``"20"``, ``"40"``, ...; ``"0"`` for bins of no stroke), each
    a dict of such scores. With ``scenes``, even if all are one, also ``per_scene``, in order of
    appearance. With ``positions`` also ``per_position``: ``recall``, ``num_right`` and ``num_bins``
    at each place beside the onset that has bins, ``"-20"`` to ``"19"``, earlier ones together as
    ``"<-20"`` and later ones as ``"20+"``.

    Of several kinds of scenes, materials, speeds and positions count bins of the paper's scene
    alone, where it is one of them: pooled, they would say more of which scenes there are than of a
    material.

    Args:
        is_slip_true: what each bin is.
        is_slip_predicted: what the detector calls it.
        materials: the material of each bin.
        speeds_mm_s: the steady speed of the stroke each bin belongs to.
        scenes: the kind of scene of each bin.
        positions: the place of each bin beside the onset of its stroke, 0 for the first slip bin;
            None for bins of no stroke, which have none.

    Shape:
        - all: ``[N]``

    Raises:
        ValueError: if the lengths differ or the tensors are not bool vectors.
    """
    whole = split_metrics(confusion_matrix(is_slip_true, is_slip_predicted))
    num_bins = whole["num_bins"]
    given: dict[str, Sequence[object] | None] = {"materials": materials}
    given |= {"speeds_mm_s": speeds_mm_s, "scenes": scenes, "positions": positions}
    for name, labels in given.items():
        if labels is not None and len(labels) != num_bins:
            raise ValueError(f"{name} must have one entry per bin, {num_bins}, got {len(labels)}")

    is_all = scenes is None or len(set(scenes)) < 2 or PAPER_SCENE not in scenes
    counted = [is_all or scene == PAPER_SCENE for scene in scenes or [PAPER_SCENE] * num_bins]
    members = {
        "per_material": _members(materials, counted),
        "per_speed": _members([f"{float(speed):g}" for speed in speeds_mm_s], counted),
    }
    members["per_speed"] = dict(sorted(members["per_speed"].items(), key=lambda of: float(of[0])))
    if scenes is not None:
        members["per_scene"] = _members(scenes)
    groups = {
        kind: {
            label: split_metrics(confusion_matrix(is_slip_true[rows], is_slip_predicted[rows]))
            for label, rows in by_label.items()
        }
        for kind, by_label in members.items()
    }
    if positions is not None:
        is_right = is_slip_true == is_slip_predicted
        places = [p if p is None else min(max(p, _FIRST - 1), _LAST + 1) for p in positions]
        groups["per_position"] = {
            _POSITIONS[place - _FIRST + 1]: _recall(int(is_right[rows].sum()), len(rows))
            for place, rows in sorted(_members(places, counted).items())
        }
    return {**whole, **groups}


def summed_metrics(scores: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """``split_metrics`` of all bins of several such together."""
    confusions = [torch.tensor(own["confusion"]) for own in scores]
    return split_metrics(torch.stack(confusions).sum(0).tolist())


def merged_metrics(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Scores of all bins of several ``bin_metrics`` together, from their summed counts.

    Groups are those that any of them has; of several kinds of scenes again the paper's alone,
    where it is one of them.

    Example:
        >>> half = {**split_metrics([[1, 0], [0, 1]]), "per_material": {}, "per_speed": {}}
        >>> merged_metrics([half, half])["confusion"]
        [[2, 0], [0, 2]]
    """
    groups: dict[str, dict[str, Any]] = {}
    scenes = {scene for own in scores for scene in own.get("per_scene", {})}
    is_all = len(scenes) < 2 or PAPER_SCENE not in scenes
    counted = [own for own in scores if is_all or PAPER_SCENE in own.get("per_scene", {})]
    for kind in ("per_material", "per_speed", "per_scene", "per_position"):
        if not any(kind in own for own in scores):
            continue
        having = [own[kind] for own in (scores if kind == "per_scene" else counted) if kind in own]
        labels = dict.fromkeys(label for group in having for label in group)
        by_label = {label: [group[label] for group in having if label in group] for label in labels}
        if kind == "per_position":
            groups[kind] = {
                label: _recall(
                    sum(place["num_right"] for place in by_label[label]),
                    sum(place["num_bins"] for place in by_label[label]),
                )
                for label in _POSITIONS
                if label in by_label
            }
        else:
            groups[kind] = {label: summed_metrics(of) for label, of in by_label.items()}
    not_valid = {"num_not_valid": sum(own.get("num_not_valid", 0) for own in scores)}
    return {**summed_metrics(scores), **not_valid, **groups}


def weights_at_share(is_slip: Tensor, slip_share: float) -> Tensor:
    """Weights of mean 1 under which this fraction of the bins is slip.

    With them ``reliability`` evaluates probabilities that are stated for the balance of a stream on
    bins of another balance.

    Shape:
        - is_slip: ``[N]``, bool; output: ``[N]``, float64

    Raises:
        ValueError: if a class is absent or the fraction does not lie between 0 and 1.
    """
    check_share("slip_share", slip_share)
    if not is_slip.any() or is_slip.all():
        raise ValueError(
            f"expected bins of slip and of non-slip, got one of them in {len(is_slip)}"
        )
    own = float(is_slip.double().mean())
    weights = torch.full(is_slip.shape, (1 - slip_share) / (1 - own), dtype=torch.float64)
    return weights.masked_fill(is_slip.cpu(), slip_share / own)


def _members(
    labels: Sequence[_Label | None], counted: Sequence[bool] | None = None
) -> dict[_Label, list[int]]:
    """Rows of the counted bins by label, labels in order of appearance; ``None`` is no label."""
    members: dict[_Label, list[int]] = {}
    for row, label in enumerate(labels):
        if label is not None and (counted is None or counted[row]):
            members.setdefault(label, []).append(row)
    return members


def _recall(num_right: int, num_bins: int) -> dict[str, Any]:
    return {"recall": _ratio(num_right, num_bins), "num_right": num_right, "num_bins": num_bins}


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean; None if one of them is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def _ratio(part: Tensor | int, whole: Tensor | int) -> float | None:
    """``part / whole``; None, JSON's null, where there is nothing to divide by."""
    return float(part) / float(whole) if whole else None
