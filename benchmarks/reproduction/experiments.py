"""What ``benchmarks.reproduction`` trains, in the order that shares most features."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from omegaconf import OmegaConf


class Experiment(NamedTuple):
    """A training run of every seed.

    Attributes:
        about: what is trained and judged, in a phrase.
        overrides: of ``tactslip_torch.train``.
        most_seeds: where fewer are taken than asked for.
    """

    about: str
    overrides: tuple[str, ...]
    most_seeds: int | None = None

    def num_seeds(self, asked: int) -> int:
        """How many seeds, from 0."""
        return asked if self.most_seeds is None else min(asked, self.most_seeds)


SEEDS = 5
"""How many there are of an experiment that states no fewer."""

EXPERIMENTS: dict[str, Experiment] = {
    # these use the features of one set of recordings ...
    "unseen4": Experiment(
        "split by cycle, whole slides, the paper's recipe", ("+exp=unseen4", "recipe=paper")
    ),
    "unseen4 robust": Experiment(
        "split by cycle, whole slides, the default recipe", ("+exp=unseen4", "recipe=robust")
    ),
    "random_bins": Experiment(
        "split at random over bins, as the authors split, the paper's recipe",
        ("+exp=random_bins", "recipe=paper"),
    ),
    "shuffled": Experiment(
        "labels permuted; must show 50 %",
        ("+exp=seen6", "recipe=paper", "labels.shuffle_seed=1"),
        most_seeds=1,
    ),
    "SG means only": Experiment(
        "means of the strain gauges alone",
        ("+exp=unseen4", "recipe=paper", "recipe.among={kind:SG,descriptor:mean}"),
        most_seeds=3,
    ),
    "PVDF only": Experiment(
        "features of the films alone",
        ("+exp=unseen4", "recipe=paper", "recipe.among={kind:PVDF}"),
        most_seeds=2,
    ),
    # ... these of another ...
    "half_second": Experiment(
        "split by cycle, half a second on either side of an onset, the paper's recipe",
        ("+exp=unseen4", "recipe=paper", "labels=half_second"),
    ),
    "half_second random_bins": Experiment(
        "split at random over bins, half a second on either side, the paper's recipe",
        ("+exp=random_bins", "recipe=paper", "labels=half_second"),
    ),
    # ... and each of these its own
    "motor_off": Experiment(
        "the arm neither heard nor felt",
        ("+exp=unseen4", "recipe=paper", "scene=motor_off"),
        most_seeds=2,
    ),
    "motor_only": Experiment(
        "motors and jolts of the arm, the contact as good as silent",
        ("+exp=unseen4", "recipe=paper", "scene=motor_only"),
        most_seeds=2,
    ),
    "confound": Experiment(
        "judged on scenes where arm and slip part, the default recipe",
        ("+exp=confound",),
        most_seeds=2,
    ),
}
"""By name, as tables call them."""

CONFOUND = Path(__file__).parents[2] / "conf" / "others" / "confound.yaml"
QUICK = ("data.cycles=2", "split.train_share=0.5", "recipe.sample_bins=60")
"""Overrides of every run of ``--quick``."""


def overrides_of(name: str, quick: bool) -> list[str]:
    """Overrides of an experiment; with ``quick`` of few recordings."""
    overrides = [*EXPERIMENTS[name].overrides, *(QUICK if quick else ())]
    if quick and name == "confound":
        scenes = [str(name) for name in OmegaConf.load(CONFOUND) if name != "defaults"]
        overrides += [f"others.{scene}.cycles=2" for scene in scenes]
    return overrides
