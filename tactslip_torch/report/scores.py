"""Scores of one split, counted per bin: confusion, accuracy and recalls, in JSON-safe values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.report.published import PAPER_SCENE

_FIRST, _LAST = -20, 19
POSITIONS = (f"<{_FIRST}", *map(str, range(_FIRST, _LAST + 1)), f"{_LAST + 1}+")
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
    (quiet_right, false_slip, missed_slip, slip_right) = cells.tolist()
    return [[quiet_right, false_slip], [missed_slip, slip_right]]


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
    (quiet_right, false_slip), (missed_slip, slip_right) = confusion
    num_bins = quiet_right + false_slip + missed_slip + slip_right
    non_slip_recall = _ratio(quiet_right, quiet_right + false_slip)
    slip_recall = _ratio(slip_right, missed_slip + slip_right)
    balanced = None
    if non_slip_recall is not None and slip_recall is not None:
        balanced = (non_slip_recall + slip_recall) / 2
    return {
        "accuracy": _ratio(quiet_right + slip_right, num_bins),
        "balanced_accuracy": balanced,
        "non_slip_recall": non_slip_recall,
        "slip_recall": slip_recall,
        "confusion": [list(row) for row in confusion],
        "num_bins": num_bins,
    }


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
    alone: pooled, they would say more of which scenes there are than of a material.

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
    for name, labels in (
        ("materials", materials),
        ("speeds_mm_s", speeds_mm_s),
        ("scenes", scenes),
        ("positions", positions),
    ):
        if labels is not None and len(labels) != num_bins:
            raise ValueError(f"{name} must have one entry per bin, {num_bins}, got {len(labels)}")

    is_one = scenes is None or len(set(scenes)) < 2
    counted = [is_one or scene == PAPER_SCENE for scene in scenes or [PAPER_SCENE] * num_bins]

    def by_group(members: Mapping[str, list[int]]) -> dict[str, dict[str, Any]]:
        return {
            label: split_metrics(confusion_matrix(is_slip_true[rows], is_slip_predicted[rows]))
            for label, rows in members.items()
        }

    groups = {"per_material": by_group(_members(materials, counted))}
    per_speed = by_group(_members([f"{float(speed):g}" for speed in speeds_mm_s], counted))
    groups["per_speed"] = {key: per_speed[key] for key in sorted(per_speed, key=float)}
    if scenes is not None:
        groups["per_scene"] = by_group(_members(scenes))
    if positions is not None:
        is_right = is_slip_true == is_slip_predicted
        members = _members([_position_label(place) for place in positions], counted)
        groups["per_position"] = {
            label: _recall(int(is_right[members[label]].sum()), len(members[label]))
            for label in POSITIONS
            if label in members
        }
    return {**whole, **groups}


def summed_metrics(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """``split_metrics`` of all bins of several such together."""
    confusions = [torch.tensor(part["confusion"]) for part in parts]
    return split_metrics(torch.stack(confusions).sum(0).tolist())


def merged_metrics(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Scores of all bins of several ``bin_metrics`` together, from their summed counts.

    Groups are those that any of the parts has; of several kinds of scenes again the paper's alone.

    Example:
        >>> half = {**split_metrics([[1, 0], [0, 1]]), "per_material": {}, "per_speed": {}}
        >>> merged_metrics([half, half])["confusion"]
        [[2, 0], [0, 2]]
    """
    groups: dict[str, dict[str, Any]] = {}
    is_one = len({scene for part in parts for scene in part.get("per_scene", {})}) < 2
    counted = [part for part in parts if is_one or PAPER_SCENE in part.get("per_scene", {})]
    for kind in ("per_material", "per_speed", "per_scene"):
        if any(kind in part for part in parts):
            own_parts = parts if kind == "per_scene" else counted
            having = [part[kind] for part in own_parts if kind in part]
            labels = dict.fromkeys(label for own in having for label in own)
            groups[kind] = {
                label: summed_metrics(own[label] for own in having if label in own)
                for label in labels
            }
    if any("per_position" in part for part in parts):
        having = [part["per_position"] for part in counted if "per_position" in part]
        groups["per_position"] = {}
        for label in POSITIONS:
            own = [places[label] for places in having if label in places]
            if own:
                counts = (sum(place[name] for place in own) for name in ("num_right", "num_bins"))
                groups["per_position"][label] = _recall(*counts)
    return {**summed_metrics(parts), **groups}


def _members(labels: Sequence[str], counted: Sequence[bool] | None = None) -> dict[str, list[int]]:
    """Which bins, of those counted, have each label, labels in order of appearance."""
    members: dict[str, list[int]] = {}
    for row, label in enumerate(labels):
        if counted is None or counted[row]:
            members.setdefault(label, []).append(row)
    return members


def _position_label(position: int | None) -> str:
    """The entry of ``POSITIONS`` for a place; of none, a word that is not among them."""
    if position is None:
        return "none"
    if position < _FIRST:
        return POSITIONS[0]
    return POSITIONS[-1] if position > _LAST else str(position)


def _recall(num_right: int, num_bins: int) -> dict[str, Any]:
    return {
        "recall": _ratio(num_right, num_bins),
        "num_right": num_right,
        "num_bins": num_bins,
    }


def _ratio(part: int, whole: int) -> float | None:
    """``part / whole``; None, JSON's null, where there is nothing to divide by."""
    return part / whole if whole else None
