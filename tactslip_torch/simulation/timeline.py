"""The truth about a scene without a single sample: when the hand slides.

The hand's elements do not let go together. Its *onset* is when elements that carry half of the
normal load have let go (the load-weighted median of their breakaways); its sliding ends when
elements that carry half of it stick again. Both are read from the contact, not from the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tactslip_torch.simulation.contact import Slips
from tactslip_torch.simulation.grasp import Grasp, draw_grasp, recording_key
from tactslip_torch.simulation.handling import Handled
from tactslip_torch.simulation.ladder import scene_contact
from tactslip_torch.simulation.motion import ArmStroke, arm_strokes, last_stop_s
from tactslip_torch.simulation.randomness import Array, generator
from tactslip_torch.simulation.scene import Scene


@dataclass(frozen=True)
class Timeline:
    """When what happens, one entry per stroke that slides unless said otherwise.

    Args:
        duration_s: of the recording, a whole number of samples.
        num_samples: the same in samples.
        speeds_mm_s: steady speeds.
        onsets_s: when the contact begins to slide, exact.
        annotated_onsets_s: the same as a person would mark it, with jitter.
        sliding_s: ``(onset, end)`` of each slide. On the dynamic rungs a slide of a tacky material
            includes its stick phases.
        arm_s: ``(start, stop)`` of every stroke that the arm drives, sliding or not.
        non_slip_s: stretches without slip in which the hand is handled, ascending and apart: what
            a detector of motors or knocks would call slip.
        slip_s: none: every onset is known.
        missing_s: none: dropped samples repeat the last, as loggers do.
    """

    duration_s: float
    num_samples: int
    speeds_mm_s: tuple[float, ...]
    onsets_s: tuple[float, ...]
    annotated_onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]
    arm_s: tuple[tuple[float, float], ...]
    non_slip_s: tuple[tuple[float, float], ...] = ()
    slip_s: tuple[tuple[float, float], ...] = ()
    missing_s: tuple[tuple[float, float], ...] = ()


def timeline(scene: Scene) -> Timeline:
    """What is true of the scene's recording, without simulating its samples.

    Raises:
        ValueError: if the contact cannot take the handling that is asked for: see ``Handled``.

    Example:
        >>> truth = timeline(Scene("M5"))
        >>> [round(onset) for onset in truth.onsets_s]
        [2, 9, 14]
        >>> truth.arm_s[0][0] < truth.onsets_s[0]
        True
    """
    plan = arm_strokes(scene.strokes, scene.acceleration_m_s2)
    grasp = draw_grasp(scene)
    return timeline_of(scene, plan, grasp, scene_contact(scene, grasp, plan).slips)


def timeline_of(scene: Scene, plan: tuple[ArmStroke, ...], grasp: Grasp, slips: Slips) -> Timeline:
    """The timeline of a scene whose contact is drawn already.

    Raises:
        ValueError: if the contact cannot take the handling that is asked for: see ``Handled``.
    """
    down = grasp.touching
    onsets = [_weighted_median(row[down], grasp.load_n[down]) for row in slips.start_s]
    sticking = [np.nan_to_num(row[down], nan=-np.inf) for row in slips.end_s]  # never slid
    ends = [_weighted_median(row, grasp.load_n[down]) for row in sticking]
    num_samples = math.ceil((last_stop_s(plan) + scene.tail_s) * scene.sample_rate_hz - 1e-6)
    duration_s = num_samples / scene.sample_rate_hz
    return Timeline(
        duration_s=duration_s,
        num_samples=num_samples,
        speeds_mm_s=tuple(stroke.speed_mm_s for stroke in scene.strokes if stroke.slides),
        onsets_s=tuple(onsets),
        annotated_onsets_s=tuple(_annotated(scene, onsets, ends)),
        sliding_s=tuple(zip(onsets, ends, strict=True)),
        arm_s=tuple((stroke.start_s, stroke.stop_s) for stroke in plan if stroke.drives),
        non_slip_s=Handled(scene, grasp, plan).stretches_s(duration_s),
    )


def _annotated(scene: Scene, onsets: list[float], ends: list[float]) -> list[float]:
    """Onsets with a person's jitter, kept inside the recording and before the slide's end."""
    jitter_s = 1e-3 * scene.disturbances.label_jitter_ms
    draws = generator(*recording_key(scene, "annotation")).standard_normal(len(onsets))
    marks = np.asarray(onsets) + jitter_s * np.clip(draws, -3.0, 3.0)
    return [max(0.0, min(m, e)) for m, e in zip(marks.tolist(), ends, strict=True)]


def _weighted_median(values: Array, weights: Array) -> float:
    """The value at which half of the weight is reached."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, 0.5 * reached[-1])])
