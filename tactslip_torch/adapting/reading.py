"""Recordings to bins as a detector has them: its filter, features, scaling, and its label rule."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
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
    names: Mapping[str, tuple[str, str]] | None = None,
    taken: Collection[str] = (),
) -> dict[str, RecordingBins]:
    """The bins of every recording of a source, by name; those without a labelled bin are left out.

    Args:
        detector: whose features are made.
        maker: of the recordings, with the detector's pool and filter.
        progress: shows which recording is read.
        material: to call them, whatever they are called; they are numbered then in their order.
        slip_free: take the bins without slip alone.
        names: what recordings are called and their materials, by key, whatever else holds.
        taken: names that none is numbered to.

    Raises:
        ValueError: if a recording cannot be read.
    """
    ids = maker.source.ids
    everyone = Split("adapt", dict.fromkeys(ids, "train"))
    found, number = {}, itertools.count()
    for recording in progress(ids, "features, new recordings", "recording"):
        key = cache_key(maker.source.key(recording))
        name, called = (names or {}).get(key) or _named(recording, material, number, taken)
        made = maker(recording, everyone)
        kept = ~made.is_slip if slip_free else made.is_slip | True
        z = detector.scaler(made.features[kept][:, list(detector.selected)].double())
        if len(z):
            found[name] = RecordingBins(called, z, made.is_slip[kept], key)
    return found


def _named(
    recording: RecordingId, material: str | None, number: Iterator[int], taken: Collection[str]
) -> tuple[str, str]:
    """Name and material; of one that is renamed the next number that is free."""
    if material is None:
        return str(recording), recording.material
    names = (str(replace(recording, material=material, cycle=cycle)) for cycle in number)
    return next(name for name in names if name not in taken), material
