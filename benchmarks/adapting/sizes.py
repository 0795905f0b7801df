"""How much ``benchmarks.adapting`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        training: overrides of ``tactslip_torch.train``; its unseen materials are the new ones.
        counts: recordings that are added.
        slip_free_counts: likewise, of their bins without slip alone.
        draws: of which recordings.
        slip_free_draws: likewise.
        train_share: of a new material's recordings, from which they are drawn; the ceiling is
            trained on all of these, and everything is judged on the others.
        judged: the count that limits are on.
        margin: that old materials may lose on average.
        seed: of the simulated set and of draws.
    """

    training: tuple[str, ...] = ("+exp=unseen4", "recipe=robust")
    counts: tuple[int, ...] = (1, 2, 5, 10)
    slip_free_counts: tuple[int, ...] = (2, 5, 10)
    draws: int = 3
    slip_free_draws: int = 1
    train_share: float = 0.8
    judged: int = 5
    margin: float = 0.005
    seed: int = 0


QUICK = Sizes(
    training=(
        "+exp=quick",
        "recipe=robust",
        "data.cycles=4",
        "recipe.num_features=10",
        "recipe.penalties=[0.0003]",
        "split.train_share=0.75",
    ),
    counts=(1, 2),
    slip_free_counts=(1,),
    draws=1,
    train_share=0.6,
    judged=2,
)
