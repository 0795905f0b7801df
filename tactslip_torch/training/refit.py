"""Training bins kept beside a detector, and the detector fitted anew with further recordings.

``bins.npz`` has the sample of training bins that the recipe chose by, each with the number of bins
that it stands for. A refit solves everything again, from these bins and those of new recordings, by
the recipe that made the detector. It holds arrays and JSON text alone; reading it executes nothing.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.calibration import calibration_from_dict
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.runtime import in_processes, whole_file
from tactslip_torch.training.bins import BinSample, RecordingBins, SampledBins
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.recipe import General

BINS = "bins.npz"
"""Name of the file beside ``detector.pt``."""
MOST_BYTES = 50_000_000
"""Of the file; of more bins it keeps fewer, even over groups, scenes and classes."""

_FORMAT = "tactslip_torch bins 1"
_ARRAYS = {"is_slip": "?", "group": "<i4", "scene": "<i4", "recording": "<i4", "weight": "<f8"}
_PER_BIN = sum(np.dtype(kind).itemsize for kind in _ARRAYS.values())
_OVERHEAD = 4096  # of the archive


@dataclass(frozen=True)
class KeptBins:
    """Training bins of a detector and the recipe that made it.

    Args:
        sample: the bins; their features are those that training read.
        selected: of each feature its number in the detector's pool.
        recipe: that is fitted again.
        digest: of the detector's hand, pool, filter and training recordings.
    """

    sample: SampledBins
    selected: tuple[int, ...]
    recipe: General
    digest: str

    @classmethod
    def of(
        cls, detector: SlipDetector, sample: SampledBins, selected: Sequence[int], recipe: General
    ) -> KeptBins:
        """Of a detector whose ``info`` says what it was trained on."""
        return cls(sample, tuple(selected), recipe, _digest(detector))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, whole or not at all; at most ``MOST_BYTES``."""
        names = ("group_names", "scene_names", "recording_names", "longest_run")
        text = json.dumps(
            {
                "format": _FORMAT,
                "digest": self.digest,
                "selected": self.selected,
                "recipe": asdict(self.recipe),
                **{name: getattr(self.sample, name) for name in names},
            }
        ).encode()
        room = MOST_BYTES - len(text) - _OVERHEAD
        sample = self.sample.thinned(room // (4 * self.sample.features.shape[1] + _PER_BIN))
        arrays: dict[str, NDArray[Any]] = {
            name: getattr(sample, name).numpy().astype(kind) for name, kind in _ARRAYS.items()
        }
        arrays["features"] = sample.features.numpy().astype("<f4")
        arrays["metadata"] = np.frombuffer(text, dtype=np.uint8)
        with whole_file(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes names for options

    @classmethod
    def load(cls, path: str | os.PathLike[str], detector: SlipDetector) -> KeptBins:
        """The bins kept of a detector.

        Raises:
            ValueError: if there is no file, it is damaged, or of another detector.
        """
        try:
            arrays = _arrays(Path(path))
            known = json.loads(arrays["metadata"].tobytes())
            kept = _checked(arrays, known)
        except FileNotFoundError:
            raise ValueError(
                f"no file at {os.fspath(path)}, which a refit needs: the detector was trained with "
                "keep_bins=false, recipe=paper, several folds or an earlier version; train it again"
            ) from None
        except Exception as error:  # zipfile, zlib, NumPy and JSON raise many of damaged bytes
            raise ValueError(
                f"{os.fspath(path)} is damaged or no file of this package; train the detector again"
            ) from error
        if kept.digest != _digest(detector):
            raise ValueError(
                f"{os.fspath(path)} was kept of another detector (hand, rate, features, filter or "
                "training recordings differ); give the detector that it was written with"
            )
        return kept

    def pool(self, detector: SlipDetector) -> FeaturePool:
        """The features that training read."""
        return detector.pool.select(self.selected)

    def recordings(
        self,
        detector: SlipDetector,
        source: RecordingSource,
        rule: LabelRule,
        times: Mapping[RecordingId, Timeline],
        num_workers: int | None = None,
    ) -> dict[RecordingId, RecordingBins]:
        """Bins of new recordings in groups of their own: materials; of one material recordings.

        As many of each group, scene and class as the recipe samples; they stand for the others.
        Recordings without labelled bins are left out.

        Args:
            detector: that the bins were kept of.
            source: of the recordings.
            rule: how their bins are labelled.
            times: what is true of each.
            num_workers: processes; ``None`` for as many as there are processors, at most 8.

        Raises:
            ValueError: if there is no bin, or as ``FeatureMaker``, such as for bins of another
                length.
        """
        dtype = getattr(torch, detector.info.get("features_dtype", "float64"))
        maker = FeatureMaker(
            source, self.pool(detector), detector.channel_filter, rule, dtype=dtype
        )
        known = {*detector.info.get("train_materials", ()), *(one.material for one in times)}
        taken = {*self.sample.group_names, *self.sample.recording_names}
        groups = {one: one.material if len(known) > 1 else str(one) for one in times}
        unique = {name: _unused(name, taken) for name in {*groups.values(), *map(str, times)}}
        made = in_processes(
            partial(_made, maker, times), list(times), "features", "recording", num_workers
        )
        sample = BinSample(self.recipe.sample_bins)
        for one, (features, is_slip, longest_run) in zip(times, made, strict=True):
            name, group, kinds = unique[str(one)], unique[groups[one]], torch.from_numpy(is_slip)
            x = torch.from_numpy(features)
            sample.update(RecordingBins(name, group, x, kinds, one.scene, longest_run))
        found = {bins.name: bins for bins in sample.bins().by_recording()}
        return {one: found[unique[str(one)]] for one in times if unique[str(one)] in found}

    @torch.no_grad()
    def refitted(
        self, detector: SlipDetector, new: Iterable[RecordingBins]
    ) -> tuple[SlipDetector, KeptBins]:
        """The detector fitted to the kept bins and new ones, and the bins to keep of it.

        Its alarm keeps the rule and what its threshold means, on the scores as they become; it is
        set for no rate. What it was trained on is not added to its ``info``.

        Raises:
            ValueError: if scores of recordings left out do not tell slip from non-slip.
        """
        pool = self.pool(detector)
        fit = self.recipe.fit([*self.sample.by_recording(), *new], pool)
        if fit.calibration is None:
            raise ValueError(
                "a refit leaves out groups to set its alarm by, and their scores do not tell slip "
                "from non-slip; add recordings of both"
            )
        old = AlarmSettings.of(detector)
        settings = replace(
            old,
            calibration=calibration_from_dict(fit.calibration),
            target_per_hour=None,
            metadata={},
        )
        info = {key: value for key, value in detector.info.items() if key != "calibrated"}
        info |= fit.metadata | {"calibration": fit.calibration, KEY: settings.to_dict()}
        made = fit.detector(pool, detector.channel_filter, info)
        return made, replace(self, sample=fit.sample)

    def written_with(self, detector: SlipDetector) -> KeptBins:
        """The same bins, kept of a detector as its ``info`` is now."""
        return replace(self, digest=_digest(detector))


def _made(
    maker: FeatureMaker, times: Mapping[RecordingId, Timeline], recording: RecordingId
) -> tuple[NDArray[np.float32], NDArray[np.bool_], int]:
    made = maker(recording, times[recording])
    return made.features.numpy(), made.is_slip.numpy(), made.longest_run


def _unused(name: str, taken: set[str]) -> str:
    """A name that is not taken: the same, or with a number behind it."""
    number, found = 2, name
    while found in taken:
        number, found = number + 1, f"{name} ({number})"
    return found


def _digest(detector: SlipDetector) -> str:
    """Of what bins of a detector depend on, and of the recordings it was trained on."""
    pool = detector.pool
    return cache_key(
        {
            "channels": pool.hand.to_rows(),
            "pool": pool.config(),
            "filter": list(detector.channel_filter.config().values()),
            "dtype": detector.info.get("features_dtype", "float64"),
            "units": detector.info.get("units", "V"),
            "recordings": detector.info.get("train_recordings", {}),
        }
    )


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an archive, read to their ends, where the check sums are."""
    if not path.exists():
        raise FileNotFoundError(path)
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > MOST_BYTES:
            raise ValueError("it unpacks to too much")
        if archive.testzip() is not None:
            raise ValueError("a check sum differs")
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in ("features", "metadata", *_ARRAYS)}


def _checked(arrays: Mapping[str, NDArray[Any]], known: Mapping[str, Any]) -> KeptBins:
    """Bins of arrays and metadata that fit together.

    Raises:
        Exception: of any kind, if they do not.
    """
    features = torch.from_numpy(arrays["features"])
    num, selected = len(features), tuple(int(each) for each in known["selected"])
    if known["format"] != _FORMAT or features.shape != (num, len(selected)) or num == 0:
        raise ValueError("format or shape")
    names = {key: tuple(known[f"{key}_names"]) for key in ("group", "scene", "recording")}
    for key, kind in _ARRAYS.items():
        if arrays[key].shape != (num,) or arrays[key].dtype != np.dtype(kind):
            raise ValueError(f"shape or kind of {key}")
        if key in names and not 0 <= arrays[key].min() <= arrays[key].max() < len(names[key]):
            raise ValueError(f"a {key} without a name")
    weight = torch.from_numpy(arrays["weight"])
    if not bool(features.isfinite().all()) or not bool(
        (weight > 0).all() & weight.isfinite().all()
    ):
        raise ValueError("numbers that cannot be")
    sample = SampledBins(
        features,
        torch.from_numpy(arrays["is_slip"]),
        torch.from_numpy(arrays["group"]).long(),
        names["group"],
        torch.from_numpy(arrays["scene"]).long(),
        names["scene"],
        weight,
        torch.from_numpy(arrays["recording"]).long(),
        names["recording"],
        known["longest_run"],
    )
    return KeptBins(sample, selected, General(**known["recipe"]), known["digest"])
