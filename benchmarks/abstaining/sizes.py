"""How much ``benchmarks.abstaining`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        overrides: of the configuration of ``crossval``: materials and cycles.
        num_unseen: materials left out of a split.
        splits: how many choices of them, drawn by the seed behind the paper's.
        train_bins: of each seen material and class to fit and calibrate on.
        judged_bins: of each material and class, at most, to judge on.
        num_features: K.
        penalties: to choose C from.
        coverages: that are asked for, ascending.
        seed: of the simulated set and of the splits.
    """

    overrides: tuple[str, ...] = ()
    num_unseen: int = 4
    splits: int = 8
    train_bins: int = 200
    judged_bins: int = 600
    num_features: int = 60
    penalties: tuple[float, ...] = (1e-4, 1e-3, 1e-2)
    coverages: tuple[float, ...] = (0.8, 0.9, 0.95, 0.97, 0.99)
    seed: int = 0


QUICK = Sizes(
    overrides=("data.cycles=4", "data.materials=[M1,M4,iron]", "cache=off", "num_workers=0"),
    num_unseen=1,
    splits=2,
    train_bins=30,
    judged_bins=40,
    num_features=20,
    penalties=(1e-3,),
    coverages=(0.5, 0.8),
)
