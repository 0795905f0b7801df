"""Recordings to bins as a detector has them: its filter, features, scaling, and its label rule."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from tactslip_torch.adapting.bins import RecordingBins
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.detector import SlipDetector

Progress = Callable[[Iterable[Any], str, str], Iterable[Any]]


def recording_bins(
    detector: SlipDetector,
    maker: FeatureMaker,
    progress: Progress,
    *,
    material: str | None = None,
    slip_free: bool = False,
) -> dict[str, RecordingBins]:
    """The bins of every recording of a source, by name; those without a labelled bin are left out.

    Args:
        detector: whose features are made.
        maker: of the recordings, with the detector's pool and filter.
        progress: shows which recording is read.
        material: to call them, whatever they are called; they are numbered then in their order.
        slip_free: take the bins without slip alone.

    Raises:
        ValueError: if a recording cannot be read.
    """
    ids = maker.source.ids
    everyone = Split("adapt", dict.fromkeys(ids, "train"))
    found = {}
    for number, recording in enumerate(progress(ids, "features, new recordings", "recording")):
        name = _renamed(recording, material, number)
        made = maker(recording, everyone)
        kept = ~made.is_slip if slip_free else made.is_slip | True
        z = detector.scaler(made.features[kept][:, list(detector.selected)].double())
        key = cache_key(maker.source.key(recording))
        if len(z):
            found[str(name)] = RecordingBins(name.material, z, made.is_slip[kept], key)
    return found


def _renamed(recording: RecordingId, material: str | None, number: int) -> RecordingId:
    return recording if material is None else replace(recording, material=material, cycle=number)
