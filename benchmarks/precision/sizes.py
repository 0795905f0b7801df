"""How much ``benchmarks.precision`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        overrides: of the configuration of the main job; how many cycles of each material.
        every: of so many bins of a recording, one is taken.
        timed_bins: whose features are taken in one call.
        scored_bins: that the head scores in one call.
        rounds: of the calls that are timed.
        repeats: of the solve.
        seed: of the order of calls.
    """

    overrides: tuple[str, ...] = ("data.cycles=5", "recipe.sample_bins=100")
    every: int = 1
    timed_bins: int = 64
    scored_bins: int = 256
    rounds: int = 31
    repeats: int = 3
    seed: int = 0


QUICK = Sizes(
    overrides=(
        "data.cycles=2",
        "data.materials=[M1,M4,iron]",
        "split.seen=[M1,M4]",
        "split.unseen=[iron]",
        "split.train_share=0.5",
        "recipe.sample_bins=30",
        "recipe.num_features=30",
    ),
    every=6,
    timed_bins=8,
    rounds=5,
    repeats=1,
)
