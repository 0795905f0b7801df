"""How far features and scores are from the reference, in units in which they matter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import CV_FLOOR

FLOOR_CV = 0.9 / CV_FLOOR  # beyond it the floor stands in for the mean
ELSEWHERE = 1e-4


def feature_errors(found: Tensor, reference: Tensor, names: Sequence[object]) -> dict[str, Any]:
    """The largest error over all bins and features, JSON-able.

    An error is counted over max(magnitude of the reference, standard deviation of its column).
    Entropy, which steps, is in bits; a mode counts as elsewhere beyond 1e-4 of that size. A cv
    about 1e6 has the floor in the place of its mean, which is rounding, its sign too: there the
    sign may differ.

    Args:
        found: features to be judged.
        reference: by ``FeaturePool`` in float64, of the same bins and perhaps more, which tell
            what is usual in a column.
        names: of the columns; the last word of each is the descriptor.

    Returns:
        ``worst`` of all but entropy and mode, its descriptor ``at``, ``entropy_bits``,
        ``mode_elsewhere`` as a share of all modes, and ``not_finite``, how many values are left
        out because they are NaN or Inf.

    Shape:
        - found: ``[N, K]``; reference: ``[M, K]``, N first rows of the same bins
    """
    found, usual = found.double(), reference.double().std(0, correction=0)
    reference = reference[: len(found)].double()
    kinds = [str(name).split()[-1] for name in names]
    size = torch.maximum(reference.abs(), usual)
    is_finite = found.isfinite()
    distance = torch.where(is_finite, (found - reference).abs(), 0.0)
    relative = torch.where(distance == 0, 0.0, distance / size)
    is_cv = torch.tensor([kind == "cv" for kind in kinds])
    is_floor = is_cv & is_finite & (reference.abs() > FLOOR_CV)
    relative = torch.where(is_floor, (found.abs() - reference.abs()).abs() / size, relative)
    worst: dict[str, float] = {}
    for kind in dict.fromkeys(kinds):
        mine = torch.tensor([other == kind for other in kinds])
        worst[kind] = float((distance if kind == "entropy" else relative)[:, mine].max())
    modes = relative[:, torch.tensor([kind == "mode" for kind in kinds])]
    smooth = {kind: value for kind, value in worst.items() if kind not in ("entropy", "mode")}
    at = max(smooth, key=smooth.__getitem__, default="")
    return {
        "worst": smooth.get(at, 0.0),
        "at": at,
        "entropy_bits": worst.get("entropy", 0.0),
        "mode_elsewhere": float((modes > ELSEWHERE).double().mean()) if modes.numel() else 0.0,
        "not_finite": int((~is_finite).sum()),
    }


def score_error(found: Tensor, reference: Tensor) -> float:
    """Largest difference of scores, in standard deviations of the reference."""
    distance = (found.double() - reference.double()).abs().max()
    return float(distance / reference.double().std(correction=0))
