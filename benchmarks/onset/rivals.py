"""Our detector, what the paper argues against and MiniRocket, with one rule for one target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from benchmarks.clocks import say, timed
from benchmarks.onset.cost import push_seconds
from benchmarks.onset.front import in_short
from benchmarks.onset.sizes import Sizes
from benchmarks.onset.trained import alarming_of, composed
from benchmarks.peers.others import mini_rocket_ridge
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.judgement import Judgement
from tactslip_torch.onset.baselines import BaselineDetector
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.runtime import in_processes
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.alarm import FIRST_TRANSITION, OURS
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_parts

MINI_ROCKET = "MiniRocket and ridge"
BASELINES: Mapping[str, Any] = {
    "film band power": "film_band_power",
    "largest detail": "largest_detail",
}
Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class MiniRocketDetector:
    """MiniRocket where ``score_stream`` takes a ``SlipDetector``: the same hand, filter and bins.

    Args:
        pool: of the detector that it stands beside.
        channel_filter: of that detector.
        scores: of filtered bins ``[N, C, n]``, float32, at least 0 for slip.
    """

    pool: FeaturePool
    channel_filter: ChannelFilter
    scores: Callable[[Array], Array]

    @property
    def needed_index(self) -> Tensor:
        """All channels, ``[C]``."""
        return torch.arange(len(self.pool.hand))

    @property
    def look_ahead(self) -> int:
        """Samples behind a bin that the longest frame takes in."""
        return self.channel_filter.context_after

    def judge(self, bins: Tensor, *, given: torch.dtype) -> Judgement:
        """Score filtered bins; a channel that is missing counts as silent, the score as not valid.

        Shape:
            - bins: ``[N, C, n]``; score and validity ``[N]``, missing channels ``[N, C]``
        """
        self.pool.check(bins)
        is_missing = self.pool.is_missing(bins)
        is_valid = (self.pool.is_alive(bins) & ~is_missing).all(-1)
        windows = torch.where(is_missing[..., None], 0.0, bins).float().contiguous()
        scores = torch.from_numpy(np.asarray(self.scores(windows.numpy())))
        score = scores.reshape(len(bins)).to(given)
        return Judgement(score, is_valid, is_missing, torch.zeros_like(score))


def rivals_of(sizes: Sizes, trained: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Every method on the same recordings, by the same rule for the same target.

    Args:
        sizes: how much.
        trained: ``train_all``.

    Returns:
        ``"streams"``; ``"fit"``, bins and seconds of MiniRocket's; ``"rows"``, one a method.
    """
    align = sizes.rival_align
    config = composed(sizes, align)
    detector = SlipDetector.load(trained[align]["file"])
    windows, is_slip = drawn_bins(config, sizes.rival_bins, sizes.seed)
    say(f"rivals: MiniRocket and ridge on {len(windows)} bins")
    targets = np.where(is_slip, 1.0, -1.0)
    fit_s, scores = timed(partial(mini_rocket_ridge, windows, targets, 1, sizes.num_kernels))
    parts = (detector.pool, detector.channel_filter)
    rivals: dict[str, Scorer] = {
        **{name: BaselineDetector(key, *parts) for name, key in BASELINES.items()},
        MINI_ROCKET: MiniRocketDetector(*parts, scores),
    }
    stage = alarming_of(config, sizes.rival_hop_ms, sizes.rival_hours, sizes.target_per_hour)
    found = stage(detector, rivals)
    rows = []
    for name, method in found["methods"].items():
        rows.append(
            {
                "method": OURS if name == found["rule"] else name,
                "scorer": method["scorer"],
                "threshold": method["calibrated"],
                "test": in_short(found["events"]["test stream"][name]),
                "unseen": in_short(found["events"]["unseen stream"][name]),
            }
        )
    scorers = {OURS: cast(Scorer, detector), **rivals}
    live = {
        row["method"]: StreamingDetector(
            cast(SlipDetector, scorers[row["scorer"]]), AlarmSettings.of(detector)
        )
        for row in rows
        if row["method"] != FIRST_TRANSITION
    }
    seconds = push_seconds(live, stage.streams, sizes.rounds, sizes.seed)
    for row in rows:
        row["push_s"] = seconds.get(row["method"], seconds[OURS])
    counts = {"slip": int(is_slip.sum()), "non_slip": int((~is_slip).sum())}
    fit = {"bins": counts, "kernels": sizes.num_kernels, "seconds": fit_s}
    return {"streams": found["streams"], "fit": fit, "rows": rows}


def drawn_bins(
    config: DictConfig, per_class: int, seed: int, num_workers: int | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Filtered bins ``[N, C, n]``, float32, of the training recordings, and which are slip.

    Each bin that the detector was trained on is as likely as another of its class.

    Args:
        config: of the training.
        per_class: how many, or all if there are fewer.
        seed: of the draw.
        num_workers: processes.
    """
    source = instantiate(config.data, _convert_="all")
    rule = instantiate(config.labels)
    split = instantiate(config.split, _convert_="all")(source.ids)[0]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    maker = FeatureMaker(source, pool, channel_filter, rule, None, dtype, engine)
    recordings = split.having("train")
    laid = [maker.lay_bins(source.timeline(recording)) for recording in recordings]
    is_slip = torch.cat([bins.is_slip for bins in laid])
    generator = torch.Generator().manual_seed(seed)
    taken = torch.zeros(len(is_slip), dtype=torch.bool)
    for places in (is_slip.nonzero().flatten(), (~is_slip).nonzero().flatten()):
        taken[places[torch.randperm(len(places), generator=generator)[:per_class]]] = True
    of_each = taken.split([len(bins.starts) for bins in laid])
    wanted = [
        (recording, own.nonzero().flatten().tolist())
        for recording, own in zip(recordings, of_each, strict=True)
        if bool(own.any())
    ]
    cut = partial(_cut, maker)
    windows = list(in_processes(cut, wanted, "bins for MiniRocket", "recording", num_workers))
    return np.concatenate(windows), is_slip[taken].numpy()


def _cut(maker: FeatureMaker, wanted: tuple[RecordingId, list[int]]) -> Array:
    recording, places = wanted
    bins, _ = maker.filtered_bins(recording)
    return np.asarray(bins[places].float().numpy())
