"""How much is done, and what baselines choose from inside a fold."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """The sizes of a run.

    Args:
        objects: how many at most; ``None`` for all.
        each: recordings of each object and scene at most; ``None`` for all.
        inner: groups that the training objects of a fold make to choose from, at most.
        rocket_seeds: of the kernels of MiniRocket; MultiRocketHydra, which is slow, has the first.
        rocket_kernels: of MiniRocket.
        multi_rocket_kernels: of MultiRocket; it makes eight features of each.
        hydra_groups: of Hydra's kernels, eight each, for every dilation.
        trees: of a forest.
        leaves: windows in a leaf of a tree at least, to choose from.
        regression_penalties: C of logistic regression, to choose from.
        draws: of the bootstrap.
        rounds: of the clock.
        batch: windows that are scored at once.
    """

    objects: int | None = None
    each: int | None = None
    inner: int = 5
    rocket_seeds: tuple[int, ...] = (0, 1, 2)
    rocket_kernels: int = 10_000
    multi_rocket_kernels: int = 6_250
    hydra_groups: int = 64
    trees: int = 100
    leaves: tuple[int, ...] = (1, 4)
    regression_penalties: tuple[float, ...] = (0.001, 0.01, 0.1, 1.0, 10.0)
    draws: int = 2000
    rounds: int = 11
    batch: int = 128


QUICK = Sizes(
    objects=3,
    each=1,
    inner=2,
    rocket_seeds=(0, 1),
    rocket_kernels=168,
    multi_rocket_kernels=84,
    hydra_groups=4,
    trees=5,
    leaves=(1,),
    regression_penalties=(0.1, 1.0),
    draws=50,
    rounds=2,
    batch=8,
)
