"""Weights of scenes of ``+exp=deploy``, by validation: ``python -m benchmarks.scene_weights``.

For each set of weights, and for each training material: a machine is fitted to training bins of the
other training materials, and evaluated on those of this one. No test cycle and no held-out material
is read. The weights with the least mean error are taken, of equals those with the least error on
the protocol; the error is the mean of three: protocol bins decided wrongly (mean of both classes),
bins of a moving arm without slip called slip, and slips beside a loud arm that are missed. All data
are simulated.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar

import torch
from hydra.utils import instantiate

from benchmarks.harness import Benchmark, Job
from benchmarks.tables import Table, by
from benchmarks.trainings import composed
from tactslip_torch.data.recording import PAPER_SCENE
from tactslip_torch.data.splits import Split
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.training.bins import RecordingBins
from tactslip_torch.training.choice import recalls
from tactslip_torch.training.datamodule import SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_maker
from tactslip_torch.training.recipe import General

PENALTY = 1e-3  # what validation takes for every seed of +exp=unseen4
SCENES = ("arm_motion", "paper_loud", "others")
_QUICK_SCENES = ("pulled", "taps", "grips", "machine", "mains_bursts")


@dataclass(frozen=True)
class SceneWeights(Benchmark):
    """Every set of weights.

    Args:
        arm_motion: weights of that scene to choose from; ``paper_loud`` and ``others`` the same.
        seeds: of sets of recordings.
        overrides: of the sets.
    """

    title = "Weights of scenes in `+exp=deploy`"
    about = "errors on training materials left out, of training bins alone, by weights of scenes"
    page = "docs/generalisation.md"
    quick = (
        "arm_motion=[1.0,3.0] paper_loud=[1.0] others=[0.1,0.3] seeds=[0] overrides=["
        'num_workers=0,data.cycles=2,"data.materials=[M1,M6,iron]","split.seen=[M1,M6]",'
        '"split.unseen=[iron]",split.train_fraction=0.5,recipe.sample_bins=20,'
        "extra_scenes.arm_motion.cycles=2,extra_scenes.paper_loud.cycles=2,"
        + ",".join(f"extra_scenes.{scene}.cycles=2" for scene in _QUICK_SCENES)
        + ",extra_scenes.motor_off.cycles=2,extra_scenes.knocked.cycles=2]"
    )
    charts: ClassVar = {"": [("Errors, %", ("protocol", "moving", "slips", "mean"))]}
    arm_motion: tuple[float, ...] = (0.3, 1.0, 3.0, 10.0)
    paper_loud: tuple[float, ...] = (0.3, 1.0, 3.0)
    others: tuple[float, ...] = (0.03, 0.1, 0.3)
    seeds: tuple[int, ...] = (0, 1, 2)
    overrides: tuple[str, ...] = ()

    def measure(self, job: Job) -> dict[str, Any]:
        """Errors of each set of weights, the least mean error first."""
        found: list[dict[str, float]] = []
        for seed in self.seeds:
            small = [f"seed={seed}", *self.overrides, *job.overrides]
            found += _errors(*_training_bins(job.folder / "cache", small), self)
        rows: list[dict[str, float]] = []
        for weights, of in by(found, *SCENES).items():
            errors = {name: fmean(one[name] for one in of) for name in of[0] if name not in SCENES}
            row = dict(zip(SCENES, weights, strict=True)) | errors
            rows.append(row | {"mean error": fmean(errors.values())})
        rows.sort(key=lambda row: (round(row["mean error"], 6), row["protocol"]))
        told = [{name: f"{of:.3g}" for name, of in row.items()} for row in rows]
        note = f"Seeds {', '.join(map(str, self.seeds))}; the least mean error first."
        return {"tables": {"Errors, %": Table(told, note)}}


def _training_bins(
    cache: Path, small: Sequence[str]
) -> tuple[General, FeaturePool, list[RecordingBins]]:
    """The recipe of ``+exp=deploy`` without second copies, its pool, and its training bins."""
    config = composed("train", ["+exp=deploy", *small])
    recipe: General = instantiate(config.recipe, _convert_="all")
    source = instantiate(config.data, _convert_="all")
    fold: Split = instantiate(config.split, _convert_="all")(source.ids)[0]
    maker = feature_maker(
        source,
        instantiate(config.labels),
        recipe=recipe,
        with_baselines=False,
        **config.features,
    )
    with feature_cache(str(cache)) as maker.cache:
        data = SlipDataModule(maker, [fold], config.num_workers)
        data.setup()
        bins = list(data.training_bins())
    return replace(recipe, drop_channels=0.0, penalties=PENALTY), maker.pool, bins


def _errors(
    recipe: General, pool: FeaturePool, bins: Sequence[RecordingBins], sizes: SceneWeights
) -> Iterator[dict[str, float]]:
    """Errors in % on each left-out material, for each set of weights."""
    for material in sorted({of.group for of in bins}):
        out = [of for of in bins if of.group == material]
        training = [replace(of, group="others") for of in bins if of.group != material]
        for weights in itertools.product(sizes.arm_motion, sizes.paper_loud, sizes.others):
            by_scene = dict.fromkeys(recipe.scene_weights, weights[-1])
            by_scene |= dict(zip(SCENES, weights[:-1], strict=False))
            fit = replace(recipe, scene_weights=by_scene).fit(training, pool)
            wrong = {}
            for scene in (PAPER_SCENE, *SCENES[:2]):
                own = [of for of in out if of.scene == scene]
                says = torch.cat([fit.head(fit.selection(of.features)) >= 0 for of in own])
                found = recalls(says, torch.cat([of.is_slip for of in own]))
                wrong[scene] = [100 * (1 - recall) for recall in found]
            yield dict(zip(SCENES, weights, strict=True)) | {
                "protocol": fmean(wrong[PAPER_SCENE]),
                "moving arm called slip": wrong["arm_motion"][0],
                "slips beside a loud arm missed": wrong["paper_loud"][1],
            }


if __name__ == "__main__":
    raise SystemExit(SceneWeights().run())
