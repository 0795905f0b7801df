"""What fidelity levels and time steps of the simulated hand cost, and what they change.

``python -m benchmarks.simulation``: seconds per simulated minute, difference of samples and onsets
to the smallest step, and detectors trained on one level and evaluated on all. Held against Radau,
the equations are in the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import torch
from hydra.utils import instantiate

from benchmarks.harness import Benchmark, Job, say
from benchmarks.tables import Table, percent, times
from benchmarks.timing import interleaved, on_threads
from benchmarks.trainings import composed
from tactslip_torch.data.splits import seen6
from tactslip_torch.report.metrics import balanced_accuracy
from tactslip_torch.simulation import SEEN_MATERIALS, Dynamics, Scene, simulate, timeline
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.datamodule import SlipDataModule
from tactslip_torch.training.experiment import feature_maker
from tactslip_torch.training.recipe import General

LEVELS: dict[str, tuple[str, dict[str, int]]] = {
    "kinematic": ("kinematic", {}),
    "one bristle": ("bristles", {"num_bristles": 1}),
    "bristles": ("bristles", {}),
}
"""Fidelity and parameters of the friction by level."""


@dataclass(frozen=True)
class Simulation(Benchmark):
    """Fidelity levels and steps.

    Args:
        steps_us: of the integration, the smallest first: the others are held against it.
        recordings: simulated in a call.
        rounds: of every call.
        materials: that detectors are trained on and evaluated on.
        cycles: of each of them.
        train_bins: of each material and class.
    """

    title = "The simulated hand"
    about = "fidelity levels and time steps: cost, difference to the smallest step, and accuracy"
    charts: ClassVar = {"": (("Levels and steps", "s a minute"),)}
    quick = "steps_us=[250.0,500.0] recordings=1 rounds=1 materials=[M1,M2] cycles=3 train_bins=20"
    steps_us: tuple[float, ...] = (31.25, 62.5, 125.0, 250.0, 500.0)
    recordings: int = 3
    rounds: int = 5
    materials: tuple[str, ...] = tuple(SEEN_MATERIALS)
    cycles: int = 20
    train_bins: int = 200

    def measure(self, job: Job) -> dict[str, Any]:
        """Costs and differences by level and step; accuracies by level."""
        note = (
            "*Samples off*: root mean square difference to the samples at the smallest step, "
            "divided by their standard deviation, for the worst kind of channel. *Onset off*: the "
            "largest difference of an onset."
        )
        about = "Test cycles of seen materials, the same on every level."
        with on_threads(1):
            accuracies = Table(_accuracies(self, job.overrides), about)
            return {
                "tables": {
                    "Levels and steps": Table(_costs(self), note),
                    "Trained on one level, evaluated on another": accuracies,
                }
            }


def _costs(sizes: Simulation) -> list[dict[str, Any]]:
    scenes: dict[tuple[str, float | None], list[Scene]] = {}
    for level, (fidelity, given) in LEVELS.items():
        made = [Scene(m, fidelity=fidelity) for m in SEEN_MATERIALS[: sizes.recordings]]
        for step_us in (None,) if fidelity == "kinematic" else sizes.steps_us:
            if step_us is not None:
                dynamics = Dynamics(step_us=step_us, **given)
                made = [replace(scene, dynamics=dynamics) for scene in made]
            scenes[level, step_us] = made
    some = next(iter(scenes.values()))
    minutes = sum(timeline(scene).duration_s for scene in some) / 60
    say(f"simulation: {sizes.rounds} rounds of {len(scenes)} levels and steps")
    calls: dict[str, Callable[[], Any]] = {
        str(at): partial(_simulated, of) for at, of in scenes.items()
    }
    timings = interleaved(calls, sizes.rounds, block_s=0)
    rows = []
    for (level, step_us), of in scenes.items():
        off, onset_ms = None, None
        if step_us not in (None, sizes.steps_us[0]):
            off, onset_ms = _difference(of, scenes[level, sizes.steps_us[0]])
        seconds = timings[str((level, step_us))]["seconds"]
        rows.append(
            {
                "level": level + (f", {step_us:g} us" if step_us else ""),
                "s a minute of 24 channels": times(seconds, 1 / minutes),
                "samples off": off,
                "onset off, ms": onset_ms,
            }
        )
    return rows


def _simulated(scenes: list[Scene]) -> list[Any]:
    return [simulate(scene) for scene in scenes]


def _difference(scenes: list[Scene], finest: list[Scene]) -> tuple[float, float]:
    """Worst relative difference of samples by kind of channel, and of onsets in ms."""
    off, onset_ms = 0.0, 0.0
    kinds = [channel.kind for channel in scenes[0].hand.channels]
    for own, exact in zip(_simulated(scenes), _simulated(finest), strict=True):
        for kind in dict.fromkeys(kinds):
            rows = torch.tensor([of == kind for of in kinds])
            truth = exact.samples[rows].double()
            distance = (own.samples[rows].double() - truth).square().mean().sqrt()
            off = max(off, float(distance / truth.std(1).mean()))
        for a, b in zip(own.onsets_s, exact.onsets_s, strict=True):
            onset_ms = max(onset_ms, 1e3 * abs(a - b))
    return off, onset_ms


@torch.no_grad()
def _accuracies(sizes: Simulation, overrides: Sequence[str]) -> list[dict[str, str]]:
    """Balanced accuracy on held-out cycles by the level trained on and the one evaluated on."""
    off = ["cache=off", *overrides]
    config = composed("train", off)
    recipe = General(
        views="pooled",
        sample_bins=sizes.train_bins,
        descriptors=None,
    )
    kept = {}
    for level, (fidelity, given) in LEVELS.items():
        say(f"simulation: features of {level}")
        source = SimulatedRecordings(
            cycles=sizes.cycles, materials=list(sizes.materials), fidelity=fidelity, scene=given
        )
        rule = instantiate(config.labels)
        maker = feature_maker(source, rule, recipe=recipe, with_baselines=False, **config.features)
        fold = seen6(source.ids, seen=list(sizes.materials))[0]
        kept[level] = SlipDataModule(maker, [fold], config.num_workers)
        kept[level].setup()
    rows = []
    for level, data in kept.items():
        fit = recipe.fit(data.training_bins(), data.maker.pool)
        row: dict[str, str] = {"balanced accuracy, %": f"trained on {level}"}
        for other, its in kept.items():
            made = list(its.features("test"))
            says = torch.cat([fit.head(fit.selection(each.features)) >= 0 for each in made])
            is_slip = torch.cat([each.is_slip for each in made])
            row[f"on {other}"] = percent(balanced_accuracy(says, is_slip))
        rows.append(row)
    return rows


if __name__ == "__main__":
    raise SystemExit(Simulation().run())
