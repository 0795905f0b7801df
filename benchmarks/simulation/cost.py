"""What a rung and a step cost: seconds per simulated minute of 24 channels, and of parts of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import torch

from benchmarks.clocks import say, shuffled_turns, timed
from benchmarks.simulation.sizes import NUM_BRISTLES, Sizes, parameters_of, scene_on
from tactslip_torch.data.labels import LabelRule, label_bins, needed_windows
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation import (
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Contact,
    Scene,
    Stroke,
    paper_scenes,
    simulate,
    simulate_many,
    timeline,
)
from tactslip_torch.simulation.contact import slides_of, traces_of
from tactslip_torch.simulation.grasp import draw_grasp
from tactslip_torch.simulation.simulate import recording_of

RUNGS = tuple(NUM_BRISTLES)
MIDDLE_US = 250.0
"""The step at which engines are compared."""

FRAMES = {"SG": 51, "PVDF": 11}


def at_step(scene: Scene, step_us: float) -> Scene:
    """The scene at a step; one that a sample of 500 us does not hold is sampled that coarsely."""
    rate_hz = min(scene.sample_rate_hz, 1e6 / step_us)
    dynamics = replace(scene.dynamics, step_us=step_us)
    return replace(scene, dynamics=dynamics, sample_rate_hz=rate_hz)


def minute_costs(sizes: Sizes) -> list[dict[str, Any]]:
    """Seconds per simulated minute of 24 channels: integration, and all else."""
    materials = [SEEN_MATERIALS[n % len(SEEN_MATERIALS)] for n in range(sizes.recordings)]
    scenes = {
        rung: [scene_on(rung, m, sizes.seed) for m in materials] for rung in ("kinematic", *RUNGS)
    }
    minutes = sum(timeline(scene).duration_s for scene in scenes["kinematic"]) / 60.0
    calls: dict[str, Callable[[], object]] = {
        "kinematic": partial(_samples, scenes["kinematic"]),
        "samples": partial(_given_samples, scenes["lugre"], traces_of(scenes["lugre"])),
    }
    for rung in RUNGS:
        for step_us in sizes.steps_us:
            coarse = [at_step(scene, step_us) for scene in scenes[rung]]
            calls[f"{rung} {step_us:g}"] = partial(traces_of, coarse)
    turns = shuffled_turns(calls, sizes.rounds, sizes.seed, "cost")
    seconds = {name: median(turn.seconds) / minutes for name, turn in turns.items()}
    rows = [_row("kinematic", None, "-", 0.0, seconds["kinematic"])]
    for rung in RUNGS:
        for step_us in sizes.steps_us:
            integration = seconds[f"{rung} {step_us:g}"]
            rows.append(_row(rung, step_us, "compiled", integration, seconds["samples"]))
    rows += [_eager(rung, sizes, minutes / len(materials), seconds["samples"]) for rung in RUNGS]
    return rows


def _row(
    rung: str, step_us: float | None, engine: str, integration: float, samples: float
) -> dict[str, Any]:
    return {
        "rung": rung,
        "step_us": step_us,
        "engine": engine,
        "integration_s": integration,
        "seconds_per_minute": integration + samples,
    }


def _samples(scenes: Sequence[Scene]) -> None:
    for scene in scenes:
        simulate(scene)


def _given_samples(scenes: Sequence[Scene], traces: Any) -> None:
    for scene, own in zip(scenes, traces, strict=True):
        recording_of(scene, own)


def _eager(rung: str, sizes: Sizes, minutes: float, samples: float) -> dict[str, Any]:
    """The eager engine on many short recordings together, by proportion of lanes and steps."""
    short = (Stroke(60.0, sizes.eager_mm, 0.1),)
    scenes = paper_scenes(
        cycles=sizes.eager,
        materials=["M2"],
        strokes=short,
        presliding_mm=(0.3, 0.3),
        step_us=MIDDLE_US,
        **parameters_of(rung),
    )
    say(f"cost: {rung}, eager, {len(scenes)} recordings together")
    seconds, _ = timed(lambda: traces_of(scenes, engine="eager"))
    whole = scene_on(rung, "M2")
    integration = seconds * lane_samples([whole]) / lane_samples(scenes) / minutes
    return _row(rung, MIDDLE_US, "eager", integration, samples)


def lane_samples(scenes: Sequence[Scene]) -> int:
    """Samples times lanes that are integrated."""
    slides = (slide for scene in scenes for slide in slides_of(scene, draw_grasp(scene)))
    return sum(slide.num * len(slide.shear_n) for slide in slides)


# --- parts of a batch ---------------------------------------------------------------------------


def apart_hand() -> HandLayout:
    """The paper's channels, each in an element of its own: 24 elements."""
    rows = [{**row, "segment": row["name"]} for row in HandLayout.paper24().to_rows()]
    return HandLayout.from_rows(rows)


SOME = ("SG4", "SG10", "SG13", "PVDF3", "PVDF7", "PVDF9")
"""Six elements of 24."""

WINDOW = (1.8, 2.8)
"""A second around the first onset, of 15.4 s."""


def parts(rung: str, sizes: Sizes) -> dict[str, float]:
    """Seconds of a batch: all of it, with six elements in contact, and a second of each."""
    contact = Contact(lifted_fraction=0.0)

    def scenes(contact: Contact) -> list[Scene]:
        materials = SEEN_MATERIALS[: min(len(SEEN_MATERIALS), sizes.batch)]
        cycles = -(-sizes.batch // len(materials))
        made = paper_scenes(
            seed=sizes.seed,
            cycles=cycles,
            materials=materials,
            hand=apart_hand(),
            contact=contact,
            **parameters_of(rung),
        )
        return made[: sizes.batch]

    def drain(scenes: list[Scene], **options: Any) -> None:
        for _ in simulate_many(scenes, **options):
            pass

    whole, some = scenes(contact), scenes(replace(contact, touching=SOME))
    second = [[WINDOW]] * len(whole)
    calls: dict[str, Callable[[], object]] = {
        "whole": partial(drain, whole),
        "some": partial(drain, some),
        "some alone": partial(drain, some, channels=SOME),
        "window": partial(drain, whole, windows=second),
    }
    drain(whole[:1])
    taken = {}
    for name, call in calls.items():
        taken[name], _ = timed(call)
        say(f"batch of {len(whole)}, {rung}, {name}: {taken[name]:.1f} s")
    return taken


# --- what a training needs ----------------------------------------------------------------------


def needed_seconds(rung: str, sizes: Sizes, processes: int = 2) -> dict[str, Any]:
    """Seconds in which processes generate what the paper's cycles need for their bins."""
    scenes = paper_scenes(
        seed=sizes.seed,
        cycles=sizes.whole_cycles,
        materials=SEEN_MATERIALS + UNSEEN_MATERIALS,
        **parameters_of(rung),
    )
    say(f"needed windows of {len(scenes)} recordings, {rung}, {processes} processes")
    with ProcessPoolExecutor(processes, initializer=_ready, initargs=(rung,)) as pool:
        list(pool.map(_needed, scenes[:processes]))  # starts them
        seconds, samples = timed(lambda: sum(pool.map(_needed, scenes, chunksize=4)))
    return {
        "rung": rung,
        "recordings": len(scenes),
        "processes": processes,
        "seconds": seconds,
        "samples": samples,
    }


def _ready(rung: str) -> None:
    torch.set_num_threads(1)
    _needed(scene_on(rung, "M2"))


def _needed(scene: Scene) -> int:
    """Simulate what the bins of a recording need; how many samples that are."""
    truth, rule = timeline(scene), LabelRule()
    bins = label_bins(
        rule, truth.annotated_onsets_s, truth.sliding_s, truth.duration_s, scene.sample_rate_hz
    )
    context = ChannelFilter([FRAMES[c.kind] for c in scene.hand.channels]).context_before
    windows = needed_windows(bins, context, truth.duration_s, scene.sample_rate_hz)
    return int(simulate(scene, windows=windows).samples.isfinite().sum())
