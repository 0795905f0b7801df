"""The general recipe on every choice: ``python -m benchmarks.crossval_general``.

It takes longest, so it has a run and a table of its own.
"""

from __future__ import annotations

from benchmarks.crossval import Crossval, Sizes


class CrossvalGeneral(Crossval):
    """The general recipe alone."""

    name = "crossval_general"
    sizes = Sizes(("~recipes.paper", "~recipes.robust"), seeds=(0, 4))


if __name__ == "__main__":
    raise SystemExit(CrossvalGeneral().run())
