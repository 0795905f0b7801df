"""How much ``benchmarks.dead_sensors`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        overrides: of the configuration of ``train +exp=unseen4``.
        halves: random halves of the channels.
        draws: of recordings, for the standard error of a difference.
        refit: whether machines are refitted without the features.
        seed: of halves and draws.
    """

    overrides: tuple[str, ...] = ()
    halves: int = 20
    draws: int = 200
    refit: bool = True
    seed: int = 0


QUICK = Sizes(
    overrides=(
        "data.cycles=4",
        "data.materials=[M1,M2,iron]",
        "split.seen=[M1,M2]",
        "split.unseen=[iron]",
        "cache=off",
        "recipe.num_features=20",
        "recipe.penalties=[0.001,0.01]",
    ),
    halves=2,
    draws=10,
)
