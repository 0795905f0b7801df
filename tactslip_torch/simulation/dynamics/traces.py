"""Lanes of one or many recordings, integrated together, and what is kept of them.

Every stroke is integrated alone, from the shear that the pause before it left, through the stroke
and its settling. So lanes of all strokes and recordings that last equally long run side by side,
and each has the same bits however many run beside it (by the compiled engine; by the eager one,
to rounding).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.simulation.dynamics.drive import (
    Span,
    StrokeDrive,
    loads_n,
    span_of,
    stroke_drive,
)
from tactslip_torch.simulation.dynamics.lanes import GROSS_SHARE, LaneState
from tactslip_torch.simulation.dynamics.physics import Skins, lanes_of, skins
from tactslip_torch.simulation.dynamics.stepper import EngineName, Trace, integrate, integrator
from tactslip_torch.simulation.friction import StickSlips, slips
from tactslip_torch.simulation.grasp import Grasp, draw_grasp
from tactslip_torch.simulation.motion import ArmStroke, arm_strokes
from tactslip_torch.simulation.randomness import Array
from tactslip_torch.simulation.scene import Scene

MOVING_SHARE = 0.02
"""Of its highest speed, below which the arm counts as at rest (ours)."""


@dataclass(frozen=True, eq=False)
class StrokeTrace:
    """One stroke of the touching elements of a recording, at its samples.

    Args:
        span: which samples; rows are from ``first`` to ``first + num``.
        friction_n: what the skin transmits, ``[num + 1, E]`` float32.
        inertia_n: of the skin, ``[num + 1, E]`` float32.
        slide: slip speed over the arm's, 0 where it slips back or the arm rests,
            ``[num + 1, E]`` float32.
        start_s: when gross sliding begins, NaN where it never does, ``[E]``.
        end_s: when it ends for good, ``[E]``.
        incipient_s: when the first bristle slides, ``[E]``.
        integrator: what integrated it: see ``integrator``.
    """

    span: Span
    friction_n: NDArray[np.float32]
    inertia_n: NDArray[np.float32]
    slide: NDArray[np.float32]
    start_s: Array
    end_s: Array
    incipient_s: Array
    integrator: Mapping[str, str]


class _Job(NamedTuple):
    """One stroke of one recording."""

    scene: Scene
    skin: Skins
    stroke: ArmStroke
    span: Span
    load_n: Array
    shear_n: Array


def steps_per_sample(scene: Scene) -> int:
    """How many steps of the integration make a sample.

    Raises:
        ValueError: if that is not a whole number.
    """
    sample_us = 1e6 / scene.sample_rate_hz
    steps = round(sample_us / scene.dynamics.step_us)
    if steps < 1 or abs(steps * scene.dynamics.step_us - sample_us) > 1e-6 * sample_us:
        raise ValueError(
            f"a whole number of steps must make a sample, got dynamics.step_us="
            f"{scene.dynamics.step_us:g} at sample_rate_hz={scene.sample_rate_hz:g} "
            f"({sample_us:g} us); take {sample_us / max(steps, 1):g}"
        )
    return steps


def traces_of(
    scenes: Sequence[Scene],
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float64,
    engine: EngineName = "auto",
) -> list[tuple[StrokeTrace, ...]]:
    """Every stroke that slides of every recording, integrated together.

    Args:
        scenes: on a dynamic rung.
        device: where lanes are integrated.
        dtype: in which they are.
        engine: see ``integrate``.

    Raises:
        ValueError: if no whole number of steps makes a sample. Whether a hand slides enough is
            ``require_sliding``'s to say.
    """
    if find_spec("numba") is None and engine == "auto":
        _say_slow()
    jobs: dict[tuple[float, float, int, int], list[tuple[int, int]]] = {}
    work: list[list[_Job]] = []
    for index, scene in enumerate(scenes):
        steps_per_sample(scene)
        work.append(_jobs(scene))
        for number, job in enumerate(work[-1]):
            alike = (scene.sample_rate_hz, scene.dynamics.step_us, job.skin.num_bristles)
            jobs.setdefault((*alike, job.span.num), []).append((index, number))
    found: dict[tuple[int, int], StrokeTrace] = {}
    for places in jobs.values():
        together = [work[index][number] for index, number in places]
        done = _integrated(together, torch.device(device), dtype, engine)
        found |= dict(zip(places, done, strict=True))
    return [
        tuple(found[index, number] for number in range(len(own))) for index, own in enumerate(work)
    ]


@cache
def _say_slow() -> None:
    logging.getLogger(__name__).warning(
        "numba is not installed: dynamic rungs are integrated by engine eager, which is slow; "
        'pip install "tactslip_torch[fast]"'
    )


def _jobs(scene: Scene) -> list[_Job]:
    plan = tuple(s for s in arm_strokes(scene.strokes, scene.acceleration_m_s2) if s.slides)
    grasp = draw_grasp(scene)
    skin, rest = skins(scene, grasp), slips(grasp, plan)
    found = []
    for number, stroke in enumerate(plan):
        span = span_of(plan, number, scene.sample_rate_hz)
        load = loads_n(scene, grasp, stroke, span)
        shear = shear_before_n(grasp, rest, number, load[0])
        found.append(_Job(scene, skin, stroke, span, load, shear))
    return found


def shear_before_n(grasp: Grasp, rest: StickSlips, number: int, load_n: Array) -> Array:
    """Shear of the touching elements as a stroke starts, under a load; ``[E]``."""
    return np.asarray(grasp.surface.mu_s * load_n * rest.shear_before[number][grasp.touching])


def _integrated(
    jobs: list[_Job], device: torch.device, dtype: torch.dtype, engine: EngineName
) -> list[StrokeTrace]:
    """Strokes of one length, side by side."""
    scene, num = jobs[0].scene, jobs[0].span.num
    every = steps_per_sample(scene)
    lanes = lanes_of([job.skin for job in jobs], dtype, device)
    drive = stroke_drive(
        [(job.stroke, job.span, job.load_n) for job in jobs], scene.sample_rate_hz, device
    )
    shear = torch.from_numpy(np.concatenate([job.shear_n for job in jobs])).to(device, dtype)
    with torch.no_grad():
        trace, _ = integrate(
            lanes,
            LaneState.sticking(lanes, shear),
            drive,
            num * every,
            1.0 / (scene.sample_rate_hz * every),
            every,
            engine=engine,
        )
    by = integrator(engine, dtype, device)
    ends = np.cumsum([len(job.shear_n) for job in jobs])
    columns = _columns(trace, drive, num)
    return [
        _stroke_trace(job, by, *(column[:, end - len(job.shear_n) : end] for column in columns))
        for job, end in zip(jobs, ends.tolist(), strict=True)
    ]


def _columns(trace: Trace, drive: StrokeDrive, num: int) -> tuple[Array, ...]:
    """Friction, inertia, slip, the arm's speed, and whether any bristle slips; float64 on the CPU.

    Shape:
        - output: ``[num, L]`` each
    """
    time_s = torch.arange(1, num + 1, dtype=torch.float64, device=drive.load_n.device)
    arm = drive.speed_m_s(time_s / drive.sample_rate_hz).expand(trace.slip_m_s.shape)
    moving = arm > MOVING_SHARE * drive.peak_m_s
    arm = torch.where(moving, arm, 0.0)
    tensors = (trace.friction_n, trace.inertia_n, trace.slip_m_s, arm, trace.incipient)
    return tuple(values.double().cpu().numpy() for values in tensors)


def _stroke_trace(
    job: _Job,
    by: Mapping[str, str],
    friction: Array,
    inertia: Array,
    slip: Array,
    arm: Array,
    incipient: Array,
) -> StrokeTrace:
    """What is kept of one stroke of one recording; ``[num, E]``."""
    rate_hz, first = job.scene.sample_rate_hz, job.span.first
    excess = np.where(arm > 0, slip - GROSS_SHARE * arm, -np.abs(slip))
    start_s, end_s = _gross(excess, first, rate_hz)
    some = (incipient > 0) & (arm > 0)
    incipient_s = (first + 1 + some.argmax(0)) / rate_hz
    incipient_s = np.where(some.any(0), np.fmin(incipient_s, start_s), np.nan)
    lead = (job.shear_n, np.zeros_like(job.shear_n), np.zeros_like(job.shear_n))
    floor = MOVING_SHARE * 1e-3 * job.stroke.peak_mm_s
    slide = np.where(arm > 0, np.maximum(slip / np.maximum(arm, floor), 0.0), 0.0)
    kept = [
        np.concatenate([row[None], rows]).astype(np.float32)
        for row, rows in zip(lead, (friction, inertia, slide), strict=True)
    ]
    return StrokeTrace(job.span, kept[0], kept[1], kept[2], start_s, end_s, incipient_s, by)


def _gross(excess: Array, first: int, rate_hz: float) -> tuple[Array, Array]:
    """First and last time at which elements slide grossly, between samples by straight lines.

    Args:
        excess: of the slip speed over the threshold, ``[num, E]``.
        first: the sample before row 0.
        rate_hz: of the samples.
    """
    num, lanes = excess.shape[0], np.arange(excess.shape[1])
    gross = excess > 0
    begins, ends = gross.argmax(0), num - 1 - gross[::-1].argmax(0)
    padded = np.concatenate([np.zeros((1, len(lanes))), excess, np.zeros((1, len(lanes)))])

    def crossing(inside: NDArray[np.int64], outside: NDArray[np.int64]) -> Array:
        """From the sample inside towards that outside, in samples of the padded rows."""
        high, low = padded[inside, lanes], padded[outside, lanes]
        with np.errstate(invalid="ignore"):
            part = np.where(high > 0, high / (high - low), 0.0)
        return np.asarray(inside + (outside - inside) * part, dtype=np.float64)

    start, end = crossing(begins + 1, begins), crossing(ends + 1, ends + 2)
    slides = gross.any(0)
    return (
        np.where(slides, (first + start) / rate_hz, np.nan),
        np.where(slides, (first + end) / rate_hz, np.nan),
    )


def require_sliding(grasp: Grasp, found: Mapping[int, StrokeTrace]) -> None:
    """Refuse a stroke in which the hand never slides: its onset would not exist.

    Raises:
        ValueError: if elements that carry half of the load never slide in a stroke.
    """
    load = grasp.load_n[grasp.touching]
    for number, trace in found.items():
        sliding = load[np.isfinite(trace.start_s)].sum() / load.sum()
        if sliding < 0.5:
            raise ValueError(
                f"stroke {number + 1} never slides: elements that carry {100 * sliding:.0f} % of "
                "the load let go, 50 % must; give it more travel or less friction"
            )
