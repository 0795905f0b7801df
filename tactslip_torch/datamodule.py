"""From a set of recordings to bins with features, one recording after another.

Workers make features (``feature_maker``); nothing but features and labels leaves them, so the whole
set is never in memory. Features are cached on disk by everything that determines them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import lightning as L
from torch.utils.data import DataLoader, Dataset

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import ROLES, Split
from tactslip_torch.feature_maker import FeatureMaker, RecordingFeatures
from tactslip_torch.features.cache import cache_key

NOTHING: Any = ()
"""A batch of no recording."""


class SlipDataModule(L.LightningDataModule):
    """Recordings of a split as batches of one recording each, made by workers.

    The training loader holds the recordings with training bins, always in one order; the test
    loader all that have a role. Of several processes each gets every so-many-th recording: none
    is padded with recordings of another, as Lightning's own sampler would.

    Args:
        maker: makes features of a recording.
        split: who has which role.
        num_workers: processes that make features; 0 makes them in this one, ``None`` takes as
            many as there are processors, at most 8, shared by the processes of a machine.
    """

    def __init__(self, maker: FeatureMaker, split: Split, num_workers: int | None = None) -> None:
        super().__init__()
        self.maker = maker
        self.split = split
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        self.num_workers = min(processors, 8) if num_workers is None else num_workers
        self._shares_processors = num_workers is None

    def train_dataloader(self) -> DataLoader[RecordingFeatures]:
        """This process's share of the recordings with training bins.

        Lightning keeps training in step, so a share that is one short ends in ``NOTHING``.
        """
        part, parts = self._share()
        num = -(-len(self.split.having("train")) // parts)
        return self.loader(["train"], part, parts, at_least=num)

    def test_dataloader(self) -> DataLoader[RecordingFeatures]:
        """This process's share of the recordings with a role."""
        return self.loader(list(ROLES), *self._share())

    def fingerprint(self) -> str:
        """A digest of everything that determines the training bins; for resuming."""
        split = self.split
        features = {
            str(recording): self.maker.key(recording) for recording in split.having("train")
        }
        shared = [split.test_share_of_bins, split.seed, self.maker.rule.shuffle_seed]
        return cache_key({"features": features, "shared": shared})

    def transfer_batch_to_device(self, batch: Any, device: Any, dataloader_idx: int) -> Any:
        """Features stay where they are: moments and solve run in float64 on the processor."""
        return batch

    def loader(
        self, roles: Sequence[str], part: int = 0, parts: int = 1, at_least: int = 0
    ) -> DataLoader[RecordingFeatures]:
        """Recordings with any of the roles, every ``parts``-th of them from ``part`` on.

        Behind them ``NOTHING`` until there are ``at_least`` so many.

        Raises:
            ValueError: if there are more parts than recordings.
        """
        recordings = self.split.having(*roles)
        if parts > len(recordings):
            raise ValueError(
                f"{parts} processes or shards for {len(recordings)} recordings; use fewer"
            )
        workers = self.num_workers
        if self._shares_processors and self.trainer is not None:
            workers = max(1, workers // self.trainer.num_devices)
        return DataLoader(
            _SplitRecordings(self.maker, self.split, recordings[part::parts], at_least),
            batch_size=None,
            num_workers=workers,
            persistent_workers=workers > 0,
        )

    def _share(self) -> tuple[int, int]:
        if self.trainer is None:
            return 0, 1
        return self.trainer.global_rank, self.trainer.world_size


class _SplitRecordings(Dataset[RecordingFeatures]):
    def __init__(
        self, maker: FeatureMaker, split: Split, recordings: list[RecordingId], at_least: int
    ) -> None:
        self.maker = maker
        self.split = split
        self.recordings = recordings
        self.at_least = at_least

    def __len__(self) -> int:
        return max(len(self.recordings), self.at_least)

    def __getitem__(self, index: int) -> RecordingFeatures:
        if index >= len(self.recordings):
            nothing: RecordingFeatures = NOTHING
            return nothing
        return self.maker(self.recordings[index], self.split)
