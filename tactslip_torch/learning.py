"""What is learned from bins: two passes over the training recordings, then judgement.

The first pass gathers class moments of every feature, one set per validation group. The second
collects the selected features, and ``recipe`` makes a detector of them. Held-out recordings enter
neither.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import ROLES
from tactslip_torch.datamodule import RecordingFeatures, SlipDataModule
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.selection import ClassMoments
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.threshold import FeatureThreshold
from tactslip_torch.progress import bar
from tactslip_torch.recipe import CollectedBins, GroupedMoments, Recipe, fit_detector
from tactslip_torch.report.scores import bin_metrics, confusion_matrix, split_metrics
from tactslip_torch.signals.filtering import ChannelFilter


class _Judged(NamedTuple):
    """Decisions on bins of one recording, ``[N]`` each."""

    material: str
    truth: Tensor
    says_slip: Tensor
    rival_says_slip: Tensor
    speed_mm_s: Tensor


class SlipLearner(L.LightningModule):
    """Learns a ``SlipDetector`` in two epochs and judges it; nothing is optimised by steps.

    Args:
        pool: the features of the bins it is given.
        channel_filter: of those bins, kept with the detector.
        recipe: how the machine is made.
        detector: a finished one, to be judged only.

    Attributes:
        detector: the result, after the second epoch.
        facts: what the recipe found, such as the penalty.
        metrics: ``{"splits": ..., "baselines": ...}`` after a test.
        seconds: time of each stage of the fit.
        worker_seconds: what workers spent on each stage of making features, summed over them.
    """

    def __init__(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        recipe: Recipe | None = None,
        detector: SlipDetector | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.pool = pool
        self.channel_filter = channel_filter
        self.recipe = recipe or Recipe()
        self.detector = detector
        self.threshold: FeatureThreshold | None = None
        if detector and "rival" in detector.info:
            self.threshold = FeatureThreshold(**detector.info["rival"])
        self.facts: dict[str, Any] = {}
        self.metrics: dict[str, Any] = {}
        self.seconds: dict[str, float] = {}
        self.worker_seconds: dict[str, float] = {}
        self._worked: dict[str, Counter[str]] = {}
        self._pass_started = 0.0
        self._num_threads = torch.get_num_threads()
        self._moments = GroupedMoments(self.recipe, len(pool.names))
        self._columns: list[int] = []
        self._collected: list[tuple[RecordingId, Tensor, Tensor]] = []
        self._judged: dict[str, list[_Judged]] = {}

    def configure_optimizers(self) -> list[Any]:
        """No optimiser: the fit is a solve."""
        return []

    def on_train_epoch_start(self) -> None:
        """Start the clock of a pass; the processors belong to those who make features."""
        self._pass_started = time.perf_counter()
        self._num_threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def training_step(self, batch: RecordingFeatures, batch_idx: int) -> None:
        """Gather moments in the first epoch, selected features in the second."""
        self._count_seconds(batch)
        mask = batch.roles["train"]
        features, is_slip = batch.features[mask], batch.is_slip[mask]
        if self.current_epoch == 0:
            self._moments.update(batch.recording, features, is_slip)
        if self._is_single_pass:
            self._columns = list(range(len(self.pool.names)))
        if self._columns:
            self._collected.append((batch.recording, features[:, self._columns], is_slip))

    def on_train_epoch_end(self) -> None:
        """Rank after the first epoch, solve after the second."""
        torch.set_num_threads(self._num_threads)
        name = "moments_pass" if self.current_epoch == 0 else "selection_pass"
        self.seconds[name] = time.perf_counter() - self._pass_started
        if self._collected:
            self._solve()
        else:
            self._columns = self._moments.columns()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep what the first pass gathered, and of which bins."""
        checkpoint["fingerprint"] = self._fingerprint()
        checkpoint["moments"] = {
            group: moments.state_dict() for group, moments in self._moments.groups.items()
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take up what ``on_save_checkpoint`` kept.

        Raises:
            ValueError: if it was gathered from other recordings than those to be trained on.
        """
        if checkpoint.get("fingerprint") != self._fingerprint():
            raise ValueError(
                "the checkpoint was gathered from other training bins; resume with the code, "
                "data, labels, split, validation groups and seed it was made with"
            )
        for group, state in checkpoint["moments"].items():
            self._moments.groups[group] = ClassMoments.from_state_dict(state)
        self._columns = self._moments.columns()

    def on_test_start(self) -> None:
        """Forget what an earlier test judged.

        Raises:
            ValueError: if there is no detector yet.
        """
        if self.detector is None:
            raise ValueError("nothing to test: fit first, or give the learner a detector")
        self._judged = {role: [] for role in ROLES}
        self._num_threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def test_step(self, batch: RecordingFeatures, batch_idx: int) -> None:
        """Score the bins of one recording."""
        assert self.detector is not None  # on_test_start
        self._count_seconds(batch)
        chosen = batch.features[:, list(self.detector.selected)].double()
        device = self.detector.head.linear.device  # Lightning may have moved it
        says_slip = self.detector.score_features(chosen.to(device)).cpu() >= 0
        rival = self.threshold(chosen) if self.threshold else torch.zeros_like(says_slip)
        for role, mask in batch.roles.items():
            if bool(mask.any()):
                decisions = (
                    part[mask] for part in (batch.is_slip, says_slip, rival, batch.speed_mm_s)
                )
                self._judged[role].append(_Judged(batch.recording.material, *decisions))

    def on_test_epoch_end(self) -> None:
        """Turn decisions into metrics."""
        torch.set_num_threads(self._num_threads)
        self.metrics = {"splits": {}, "baselines": {}}
        rivals: dict[str, Any] = {}
        for role, parts in self._judged.items():
            if not parts:
                continue
            materials = [part.material for part in parts for _ in part.truth]
            truth = torch.cat([part.truth for part in parts])
            says_slip = torch.cat([part.says_slip for part in parts])
            rival = torch.cat([part.rival_says_slip for part in parts])
            speeds = torch.cat([part.speed_mm_s for part in parts]).tolist()
            scores = bin_metrics(truth, says_slip, materials, speeds)
            self.metrics["splits"][role] = scores
            rivals[role] = split_metrics(confusion_matrix(truth, rival))
            for name in ("accuracy", "balanced_accuracy"):
                if scores[name] is not None:
                    self.log(f"{role}/{name}", scores[name], batch_size=1)
        if self.threshold and self.detector:
            feature = str(self.detector.selected_names[self.threshold.index])
            self.metrics["baselines"] = {
                "best_single_feature": {"feature": feature, "splits": rivals}
            }

    @property
    def _is_single_pass(self) -> bool:
        """``fast_dev_run`` ends after one epoch, so that one does the work of both passes."""
        return bool(getattr(self.trainer, "fast_dev_run", False))

    def _fingerprint(self) -> str:
        data: SlipDataModule = self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning's
        return f"{data.fingerprint()} by {self.recipe.group_by}"

    def _solve(self) -> None:
        bins = CollectedBins.of(self.recipe, self._columns, self._collected)
        self._collected = []
        fitted = fit_detector(self.recipe, self._moments, bins, bar)
        self.log("penalty", float(fitted.facts["penalty"]), batch_size=1)
        self.seconds |= fitted.seconds
        self.facts = fitted.facts
        self.threshold = fitted.threshold
        info = self.facts | {"rival": fitted.threshold.to_dict()}
        self.detector = SlipDetector(
            self.pool, self.channel_filter, fitted.selected, fitted.scaler, fitted.head, info
        )

    def rates(self) -> dict[str, str]:
        """How fast one worker goes through each stage it has met, for the progress bar."""
        units = {"simulate": "recordings", "read": "recordings", "features": "bins"}
        rates = {}
        for stage, unit in (units | {"read_cache": "recordings"}).items():
            if stage in self._worked:
                rate = self._worked[stage][unit] / max(self.worker_seconds[stage], 1e-9)
                rates[stage] = f"{rate:.0f} {unit}/s"
        return rates

    def _count_seconds(self, batch: RecordingFeatures) -> None:
        for stage, seconds in batch.seconds.items():
            self.worker_seconds[stage] = self.worker_seconds.get(stage, 0.0) + seconds
            done = self._worked.setdefault(stage, Counter())
            done.update(recordings=1, bins=len(batch.is_slip))
