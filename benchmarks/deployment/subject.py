"""The detector that is deployed: one machine, both as a kernel sum and folded."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.bins import WINDOW_LENGTHS
from benchmarks.clocks import say
from benchmarks.detectors import Timed, timed_detector
from benchmarks.streaming.ways import settings_of
from tactslip_torch.features.extractor import EngineName
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.quadratic import collapse
from tactslip_torch.onset.settings import KEY
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation import UNSEEN_MATERIALS
from tactslip_torch.simulation.source import SimulatedRecordings

HOP = 20
"""Samples between decisions where a detector says nothing of alarms."""
_SEED = 1  # of held-out recordings; those that heads are fitted to have 0


@dataclass(frozen=True, eq=False)
class Subject:
    """What every way judges by.

    Args:
        timed: selection, scaler and the folded head.
        machine: the kernel sum that was folded.
        info: of the detector that was given, for its alarm settings.
        source: where the selection comes from, JSON-able.
    """

    timed: Timed
    machine: KernelSum = field(repr=False)
    info: Mapping[str, Any] = field(repr=False)
    source: Mapping[str, Any]

    def detector(self, engine: EngineName, dtype: str) -> SlipDetector:
        """A detector of its own by this engine, in a dtype of ``DTYPES``."""
        made = self.timed.detector(engine, dtype)
        made.info = dict(self.info)
        return made


def subject_of(num_recordings: int, path: Path | None) -> Subject:
    """Fit a machine to simulated bins, with the features, ranges and kernel of a detector.

    The bins stay known, which a trained detector's file does not keep: so the same machine can be a
    kernel sum and a quadratic form, equal to rounding.

    Args:
        num_recordings: simulated, of whose bins it is fitted.
        path: of the detector; default: the selection that ``benchmarks.selection`` has kept.

    Raises:
        FileNotFoundError: if there is no such detector.
        ValueError: if it is damaged, or is not of the paper's hand and bins.
    """
    say("deployment: fit a machine")
    timed = timed_detector(num_recordings, path)
    machine = timed.kernel_sum()
    folded = collapse(machine.support, machine.beta, timed.kernel)
    info: dict[str, Any] = {"simulated": True, KEY: settings_of(HOP).to_dict()}
    source = dict(timed.selection["trained"])
    if path is not None:
        info |= SlipDetector.load(path).info
        source["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    return Subject(replace(timed, head=folded), machine, info, source)


def held_out_bins(num: int) -> Tensor:
    """Raw bins of simulated recordings of unseen materials, with context, one every 50 ms.

    Shape:
        - output: ``[num, 24, 150]``, float32, volts
    """
    length = 100 + 2 * ChannelFilter(WINDOW_LENGTHS).context
    source = SimulatedRecordings(seed=_SEED, cycles=-(-num // 1000), materials=UNSEEN_MATERIALS)
    parts, found = list[Tensor](), 0
    for recording in sorted(source.ids, key=lambda each: (each.cycle, each.material)):
        samples = source.load(recording).samples.float()
        parts.append(samples.unfold(-1, length, 100).transpose(0, 1))
        found += len(parts[-1])
        if found >= num:
            break
    return torch.cat(parts)[:num].contiguous()
