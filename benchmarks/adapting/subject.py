"""The detector that new materials are brought to, its statistics, and the bins of every recording.

It is trained as a user does, by ``tactslip_torch.train statistics=true``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor

from benchmarks.adapting.sizes import Sizes
from benchmarks.reproduction.runs import run
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.training.adaptation import recording_bins
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_parts
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.statistics import RecordingBins, Statistics, statistics_of


@dataclass(frozen=True, eq=False)
class Subject:
    """What everything starts from.

    Args:
        file: of the detector.
        detector: as trained.
        statistics: beside it.
        recipe: it was made by.
        split: it was trained on.
        maker: of features.
        bins: of every recording, by name.
    """

    file: Path
    detector: SlipDetector = field(repr=False)
    statistics: Statistics = field(repr=False)
    recipe: Recipe
    split: Split
    maker: FeatureMaker = field(repr=False)
    bins: dict[str, RecordingBins] = field(repr=False)

    def recordings(self, role: str, material: str | None = None) -> list[RecordingId]:
        """Those of a role and, if it is given, of a material."""
        found = self.split.having(role)
        return [one for one in found if material in (None, one.material)]

    def materials(self, role: str) -> list[str]:
        """Of the recordings of a role, ascending."""
        return sorted({one.material for one in self.recordings(role)})

    def named(self, recordings: list[RecordingId]) -> dict[str, RecordingBins]:
        """The bins of recordings by name."""
        return {str(one): self.bins[str(one)] for one in recordings}


def subject_of(sizes: Sizes, folder: Path, cache: Path) -> Subject:
    """Train, or take what this very code trained, and read all bins.

    Args:
        sizes: how it is trained.
        folder: of the run.
        cache: of features.

    Raises:
        RuntimeError: if the training fails.
    """
    overrides = [*sizes.training, f"seed={sizes.seed}", "statistics=true"]
    run("detector", overrides, folder, cache)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("train", overrides)
    source = instantiate(config.data, _convert_="all")
    rule = instantiate(config.labels)
    (split,) = instantiate(config.split, _convert_="all")(source.ids)
    pool, filters, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    maker = FeatureMaker(source, pool, filters, rule, FeatureCache(cache), dtype, engine)
    file = folder / "detector.pt"
    detector = SlipDetector.load(file)
    return Subject(
        file,
        detector,
        statistics_of(file, detector),
        instantiate(config.recipe, _convert_="all"),
        split,
        maker,
        recording_bins(detector, maker),
    )


def divided(
    recordings: list[RecordingId], share: float, seed: int
) -> tuple[list[RecordingId], list[RecordingId]]:
    """Recordings to draw from, and those that are judged."""
    order = drawn(recordings, len(recordings), seed)
    num = round(share * len(order))
    return order[:num], order[num:]


def drawn(recordings: list[RecordingId], count: int, seed: int) -> list[RecordingId]:
    """Some of the recordings, at random."""
    generator = torch.Generator().manual_seed(seed)
    order: Tensor = torch.randperm(len(recordings), generator=generator)
    return [recordings[place] for place in order[:count].tolist()]


def joined(bins: dict[str, RecordingBins]) -> tuple[Tensor, Tensor]:
    """Scaled features and truth of several recordings."""
    parts: list[Any] = list(bins.values())
    return torch.cat([one.z for one in parts]), torch.cat([one.is_slip for one in parts])
