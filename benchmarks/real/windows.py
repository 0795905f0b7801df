"""The windows that every method is fitted to and judged on, and the folds of ``train``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from benchmarks.real.sizes import Sizes
from tactslip_torch.commands.entry import conf_dir, unknown_choice
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.runtime import bar
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_parts
from tactslip_torch.training.recipe import Recipe

Array = NDArray[Any]
EXPERIMENT = "+exp=biotacsp_dos"


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of all recordings, in the order of the recordings and of time.

    Attributes:
        maker: what reads, cuts and describes them.
        recordings: whose windows there are.

    Shape:
        - samples: ``[N, C, n]``, float64, tared and filtered as the configuration says
        - is_slip: ``[N]``, bool
        - recording: ``[N]``, place in ``recordings``
    """

    maker: FeatureMaker
    recordings: tuple[RecordingId, ...]
    samples: Array
    is_slip: Array
    recording: Array

    @property
    def objects(self) -> Array:
        """What each window was touched with, ``[N]``, text."""
        return np.array([recording.material for recording in self.recordings])[self.recording]

    @property
    def scenes(self) -> Array:
        """How it slid, or that it did not, ``[N]``, text."""
        return np.array([recording.scene for recording in self.recordings])[self.recording]

    def of(self, recordings: Sequence[RecordingId]) -> Array:
        """Which windows are of these recordings, ``[N]``, bool."""
        wanted = set(recordings)
        return np.array([of in wanted for of in self.recordings])[self.recording]


def composed(overrides: Sequence[str], recipe: str) -> DictConfig:
    """The configuration of a training.

    Args:
        overrides: as ``tactslip_torch.train`` takes them, such as ``data.root=FOLDER``.
        recipe: by name.

    Raises:
        ValueError: if one names what does not exist.
    """
    every = [EXPERIMENT, *overrides, f"recipe={recipe}"]
    if problem := unknown_choice(every):
        raise ValueError(problem)
    try:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return compose("train", every)
    except HydraException as error:
        raise ValueError(str(error)) from None


def recipe_of(overrides: Sequence[str], name: str) -> Recipe:
    """The recipe of that name, with what the overrides change in it."""
    made: Recipe = instantiate(composed(overrides, name).recipe, _convert_="all")
    return made


def read_windows(config: DictConfig, sizes: Sizes) -> tuple[Windows, list[Split]]:
    """All windows and the folds.

    Args:
        config: ``composed``.
        sizes: of how many objects, and how many recordings of each and scene.

    Raises:
        ValueError: as source, label rule and split do, or if recordings are simulated or a class is
            absent.
    """
    source: RecordingSource = instantiate(config.data, _convert_="all")
    if source.is_simulated:
        raise ValueError("recordings of data.root say that they are simulated; give real ones")
    rule: LabelRule = instantiate(config.labels)
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    maker = FeatureMaker(source, pool, channel_filter, rule, None, dtype, engine)
    recordings = some_of(source.ids, sizes)
    folds: list[Split] = instantiate(config.split, _convert_="all")(recordings)
    samples, labels, places = [], [], []
    for place, recording in enumerate(bar(recordings, "read and cut", "recording")):
        cut, bins = maker.filtered_bins(recording)
        samples.append(cut.double().numpy())
        labels.append(bins.is_slip.numpy())
        places.append(np.full(len(bins.is_slip), place))
    is_slip = np.concatenate(labels).astype(bool)
    if is_slip.all() or not is_slip.any():
        which = "no window of stable touch" if is_slip.all() else "no window of slip"
        raise ValueError(f"the {len(is_slip)} windows of data.root hold {which}; give both")
    every = np.concatenate(samples), is_slip, np.concatenate(places)
    return Windows(maker, tuple(recordings), *every), folds


def some_of(recordings: Sequence[RecordingId], sizes: Sizes) -> list[RecordingId]:
    """So many objects at most, and so many recordings of each and scene; sorted."""
    materials = sorted({recording.material for recording in recordings})[: sizes.objects]
    kept: dict[tuple[str, str], list[RecordingId]] = {}
    for recording in sorted(recordings):
        if recording.material in materials:
            kept.setdefault((recording.material, recording.scene), []).append(recording)
    return sorted(each for of in kept.values() for each in of[: sizes.each])
