"""What drives the lanes of a stroke: the arm's speed and the load of every element.

Times count from the sample at which or before which the stroke starts, so that a trace lies on
the recording's samples. Speeds are exact; loads are joined by straight lines between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.load import normal_force
from tactslip_torch.simulation.motion import ArmStroke
from tactslip_torch.simulation.randomness import Array
from tactslip_torch.simulation.scene import Scene

SETTLING_S = 0.25
"""How long a stroke is integrated on behind its end, or as long as its pause (ours)."""


class Span(NamedTuple):
    """The samples of a stroke and of the settling behind it.

    Attributes:
        first: the sample at which or before which it starts.
        num: samples behind the first.
        settling_s: how long it settles.
    """

    first: int
    num: int
    settling_s: float


def span_of(plan: tuple[ArmStroke, ...], number: int, sample_rate_hz: float) -> Span:
    """The samples of one stroke of a plan."""
    stroke = plan[number]
    rest_s = plan[number + 1].start_s - stroke.stop_s if number + 1 < len(plan) else np.inf
    settling_s = min(SETTLING_S, rest_s)
    first = int(np.floor(stroke.start_s * sample_rate_hz))
    last = int(np.ceil((stroke.stop_s + settling_s) * sample_rate_hz))
    return Span(first, last - first, settling_s)


def loads_n(scene: Scene, grasp: Grasp, stroke: ArmStroke, span: Span) -> Array:
    """Load of every touching element at the samples of a stroke, ``[num + 1, E]``."""
    time_s = (span.first + np.arange(span.num + 1)[:, None]) / scene.sample_rate_hz
    position_mm = stroke.origin_mm + stroke.travel_mm(time_s)
    return normal_force(scene, grasp, grasp.touching, position_mm, time_s)


@dataclass(frozen=True, eq=False)
class StrokeDrive:
    """A ``Drive`` of some lanes.

    Args:
        wait_s: from the first sample to the start.
        length_s: of the stroke, from start to stop.
        acceleration_m_s2: of both ramps.
        peak_m_s: highest speed.
        load_n: at the samples.
        sample_rate_hz: of them.

    Shape:
        - wait_s, length_s, acceleration_m_s2, peak_m_s: ``[L]``, or ``[1]`` where all are alike
        - load_n: ``[num + 1, L]``
    """

    wait_s: Tensor
    length_s: Tensor
    acceleration_m_s2: Tensor
    peak_m_s: Tensor
    load_n: Tensor
    sample_rate_hz: float

    def speed_m_s(self, time_s: Tensor) -> Tensor:
        """The arm's speed, ``[n, L]`` or ``[n, 1]``."""
        since = time_s[:, None] - self.wait_s
        ramp = self.acceleration_m_s2 * torch.minimum(since, self.length_s - since)
        return torch.minimum(ramp.clamp(min=0.0), self.peak_m_s)

    def __call__(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        """Speeds and loads at some times, ``[n, L]``."""
        place = (time_s * self.sample_rate_hz).clamp(max=len(self.load_n) - 1)
        low = place.floor().clamp(max=len(self.load_n) - 2)
        part, row = (place - low)[:, None], low.long()
        before, after = self.load_n[row], self.load_n[row + 1]
        return self.speed_m_s(time_s), before + part * (after - before)


def stroke_drive(
    strokes: list[tuple[ArmStroke, Span, Array]], sample_rate_hz: float, device: torch.device
) -> StrokeDrive:
    """The drive of lanes that are integrated together, recording after recording.

    Args:
        strokes: of every recording, with its samples and loads ``[num + 1, E]``.
        sample_rate_hz: of the recordings.
        device: where the lanes are.
    """
    facts = np.array(
        [
            (
                stroke.start_s - span.first / sample_rate_hz,
                stroke.stop_s - stroke.start_s,
                1e-3 * stroke.acceleration_mm_s2,
                1e-3 * stroke.peak_mm_s,
            )
            for stroke, span, load in strokes
        ]
    )
    if (facts == facts[0]).all():
        columns = facts[:1].T.copy()
    else:
        columns = np.repeat(facts, [load.shape[1] for _, _, load in strokes], axis=0).T.copy()
    loads = np.concatenate([load for _, _, load in strokes], axis=1)
    wait, length, acceleration, peak = (torch.from_numpy(column).to(device) for column in columns)
    load = torch.from_numpy(loads).to(device)
    return StrokeDrive(wait, length, acceleration, peak, load, sample_rate_hz)
