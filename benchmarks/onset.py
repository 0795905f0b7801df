"""What hop and filter buy, and peers on equal terms: ``python -m benchmarks.onset``.

Detectors of ``+exp=onset`` behind each filter watch the same simulated streams at several hops,
with thresholds for the same rate of false alarms; film band power, the largest detail and
MiniRocket with ridge are calibrated and evaluated alike at one hop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import cycle, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from torch import Tensor

from benchmarks.harness import (
    COLORS,
    Benchmark,
    Job,
    Report,
    Table,
    interleaved,
    number,
    on_threads,
    percent,
    say,
    trained,
)
from benchmarks.peers import rockets
from benchmarks.subjects import Array, Trained, composed
from tactslip_torch import AlarmSettings, FeaturePool, Prediction, SlipDetector, StreamingDetector
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.onset.baselines import BaselineDetector
from tactslip_torch.onset.decisions import Scorer
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.alarm import CalibratedAlarm

ROCKET = "MiniRocket and ridge"
BASELINES: Mapping[str, Any] = {
    "film band power": "film_band_power",
    "largest detail": "largest_detail",
}
ROLES = {"test stream": "seen materials", "unseen stream": "held-out materials"}
QUICK_TRAINING = (
    "data.cycles=2",
    "data.materials=[M1,M6,iron]",
    "split.seen=[M1,M6]",
    "split.unseen=[iron]",
    "split.train_fraction=0.5",
    "extra_scenes.held.cycles=2",
    "extra_scenes.held.tail_s=2",
    "extra_scenes.knocked.cycles=2",
    "extra_scenes.knocked.tail_s=2",
    "extra_scenes.arm_motion.cycles=2",
    "recipe.num_features=20",
    "recipe.penalties=[0.003]",
)
_SCENES = ("arm_motion", "taps", "grips", "machine", "mains_bursts", "pulled", "dead_channel")
QUICK_STREAMS = (
    "onset.streams.cycles=4",
    "onset.streams.extra_scenes.held.cycles=4",
    "onset.streams.extra_scenes.held.tail_s=5",
    *(f"onset.streams.extra_scenes.{scene}.cycles=4" for scene in _SCENES),
)


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        training: overrides of ``tactslip_torch.train +exp=onset``, the same for every filter.
        streams: further overrides, of the recordings that are watched.
        aligns: filters, a detector is trained behind each; peers stand beside the first.
        hops_ms: distances of decisions; peers have the last.
        hours: of slip-free stream to calibrate on, as many to check on, seen and held out.
        per_hour: false alarms that thresholds are set for.
        peer_recordings: of training, to whose bins MiniRocket's ridge is fitted.
        num_kernels: of MiniRocket.
        rounds: of timed pushes.
    """

    training: tuple[str, ...] = (
        "data.cycles=8",
        "extra_scenes.held.cycles=2",
        "extra_scenes.knocked.cycles=2",
        "extra_scenes.arm_motion.cycles=4",
        "recipe.penalties=[0.001,0.003,0.01]",
    )
    streams: tuple[str, ...] = (
        "onset.streams.cycles=20",
        "onset.streams.extra_scenes.held.cycles=14",
    )
    aligns: tuple[str, ...] = ("centred", "causal", "trailing")
    hops_ms: tuple[float, ...] = (5.0, 10.0, 25.0, 50.0)
    hours: float = 0.5
    per_hour: float = 20.0
    peer_recordings: int = 60
    num_kernels: int = 10_000
    rounds: int = 60


class Onset(Benchmark[Sizes]):
    """Hops, filters and peers."""

    name = "onset"
    title = "Alarms: hops, filters and peers"
    about = (
        "detectors of +exp=onset on simulated streams, thresholds set for the same rate of false "
        "alarms on streams without slip"
    )
    sizes = Sizes()
    quick = Sizes(
        QUICK_TRAINING,
        QUICK_STREAMS,
        ("centred", "causal"),
        (25.0, 50.0),
        hours=0.002,
        peer_recordings=3,
        num_kernels=168,
        rounds=2,
    )
    libraries = ("aeon",)

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """Train behind every filter, watch at every hop, and time pushes."""
        sizes = job.sizes
        rows: list[dict[str, Any]] = []
        pushes: dict[str, Callable[[], Any]] = {}
        for align, hop_ms in product(sizes.aligns, sizes.hops_ms):
            training = ["+exp=onset", f"features.align={align}", *sizes.training]
            folder = job.folder / align
            with TemporaryDirectory(prefix="tactslip-bench-") as cache:  # some gigabytes
                trained(f"detector, {align}", [*training, "onset=none"], folder, Path(cache))
            detector = SlipDetector.load(folder / "detector.pt")
            peers: dict[str, Scorer] = {}
            if (align, hop_ms) == (sizes.aligns[0], sizes.hops_ms[-1]):
                peers = _peers(detector, [*training, "onset=none"], folder, sizes)
            say(f"onset: {align}, a decision every {hop_ms:g} ms")
            stage = _stage([*training, *sizes.streams], hop_ms, sizes)
            found = stage(detector, peers)
            samples = _protocol_samples(stage)
            for method, of in found["methods"].items():
                is_ours = method == found["rule"]
                if not of["calibrated"] or (of["scorer"] == "detector" and not is_ours):
                    continue
                peer = peers.get(of["scorer"])
                pushed = cast(SlipDetector, _PushedPeer(peer)) if peer else detector
                live = StreamingDetector(pushed, AlarmSettings.of(detector))
                name = f"{align}, hop {hop_ms:g} ms" + ("" if is_ours else f", {method}")
                pushes[name] = _next_hop(live, samples)
                events = {role: found["events"][role][method] for role in ROLES}
                row = {"way": name, "hop_ms": hop_ms, "is_ours": is_ours, "align": align}
                look_ahead_ms = 1e3 * detector.look_ahead / detector.pool.sample_rate_hz
                rows.append(row | {"look_ahead_ms": look_ahead_ms, "events": events})
        with on_threads(1):
            timings = interleaved(pushes, sizes.rounds)
        for row in rows:
            row["push_s"] = timings[row["way"]].summary()["p50_s"]
        return {"rows": rows, "per_hour": sizes.per_hour}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Delay, slips found and false alarms on both kinds of materials, and compute."""
        found = {}
        for role, words in ROLES.items():
            rows = []
            for row in numbers["rows"]:
                events = row["events"][role]
                delay, rate = events["delay_ms"], events["false_alarms_per_hour"]
                cells = {
                    "method": row["way"],
                    "false alarms an hour": number(rate and rate["value"]),
                }
                cells |= {
                    f"{name} %": percent(events[name]["value"]) for name in ("found", "early")
                }
                for title, of in (("delay ms", "median"), ("p95 ms", "p95")):
                    cells[title] = f"{delay[of]['value']:.1f}" if delay else "-"
                slid = events.get("slid_mm")
                cells["mm slid"] = f"{slid['median']['value']:.1f}" if slid else "-"
                cells["look-ahead ms"] = f"{row['look_ahead_ms']:g}"
                rows.append(cells | {"% of a core": number(1e5 * row["push_s"] / row["hop_ms"])})
            note = f"Thresholds were set for {numbers['per_hour']:g} false alarms an hour."
            found[f"On {words}"] = Table(rows, note)
        return found

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Median delay against slips that are not found."""
        panels = drawing.subplots(1, len(ROLES), sharey=True)
        for axes, (role, words) in zip(panels, ROLES.items(), strict=True):
            for place, row in enumerate(numbers["rows"]):
                events = row["events"][role]
                if events["delay_ms"] is None:
                    continue
                x, y = events["delay_ms"]["median"]["value"], 1 - events["found"]["value"]
                color = COLORS[place % len(COLORS)]
                marker = "o" if row["is_ours"] else "s"
                axes.plot(x, 100 * y, marker, color=color, label=row["way"])
            axes.set_title(words, fontsize=10)
            axes.set_xlabel("median delay, ms")
        panels[0].set_ylabel("slips not found, %")
        handles = panels[0].get_legend_handles_labels()
        drawing.legend(*handles, loc="outside lower center", ncols=3, frameon=False, fontsize=7)


def _stage(overrides: list[str], hop_ms: float, sizes: Sizes) -> CalibratedAlarm:
    """The stage behind ``+exp=onset``: the protocol and its quiet alone, and the main rule."""
    onset: Any = OmegaConf.to_container(composed("train", overrides).onset, resolve=True)
    quiet, main = onset["slip_free"], onset["rule"]
    onset["streams"]["extra_scenes"] = {quiet: onset["streams"]["extra_scenes"][quiet]}
    onset["rules"] = {main: onset["rules"][main]}
    onset |= {
        "hours": sizes.hours,
        "false_alarms_per_hour": sizes.per_hour,
        "hop_ms": hop_ms,
    }
    stage: CalibratedAlarm = instantiate(onset, _convert_="all")
    return stage


def _protocol_samples(stage: CalibratedAlarm) -> Tensor:
    recording = next(one for one in stage.streams.ids if one.scene == PAPER_SCENE)
    return stage.streams.load(recording).samples.T.contiguous()


def _next_hop(live: StreamingDetector, samples: Tensor) -> Callable[[], Any]:
    """A call that pushes the next hop, once every push makes a decision."""
    hop = live.settings.hop_samples
    pieces = cycle(samples[: len(samples) // hop * hop].split(hop))
    while not len(live.push(next(pieces)).number):
        pass
    return lambda: live.push(next(pieces))


class _PushedPeer:
    """A peer where a stream takes a ``SlipDetector``: it filters raw bins, then scores them."""

    def __init__(self, scorer: Scorer) -> None:
        self.pool, self.channel_filter = scorer.pool, scorer.channel_filter
        self.needed_index, self.look_ahead = scorer.needed_index, scorer.look_ahead
        self.context_before = self.channel_filter.context_before
        self.context_after = self.channel_filter.context_after
        self._predict = scorer.predict

    def predict_raw(self, samples: Tensor, *, given: torch.dtype, **_: object) -> Prediction:
        """Score raw bins with their context ``[N, C, n + 2 * context]``."""
        return self._predict(self.channel_filter.valid(samples), given=given)


@dataclass(frozen=True, eq=False)
class _RocketDetector:
    """MiniRocket in the place of a ``SlipDetector``: the same hand, filter and bins."""

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

    def predict(self, bins: Tensor, *, given: torch.dtype) -> Prediction:
        """Score filtered bins ``[N, C, n]``; a channel that is missing counts as silent."""
        is_missing = self.pool.is_missing(bins)
        is_valid = (self.pool.is_alive(bins) & ~is_missing).all(-1)
        windows = torch.where(is_missing[..., None], 0.0, bins).float().contiguous()
        score = torch.from_numpy(np.asarray(self.scores(windows.numpy()))).reshape(-1).to(given)
        return Prediction(score, is_valid, is_missing, torch.zeros_like(score))


def _peers(
    detector: SlipDetector, overrides: list[str], folder: Path, sizes: Sizes
) -> dict[str, Scorer]:
    """Baselines, and MiniRocket with ridge on bins of some training recordings."""
    trained = Trained.by(overrides, folder, folder / "cache")
    order = np.random.default_rng(0).permutation(len(trained.recordings("train")))
    some = [trained.recordings("train")[at] for at in order[: sizes.peer_recordings]]
    made = [trained.maker.filtered_bins(recording) for recording in some]
    windows = torch.cat([bins for bins, _ in made]).float().numpy()
    is_slip = torch.cat([laid.is_slip for _, laid in made]).numpy()
    say(f"onset: MiniRocket and ridge on {len(windows)} bins")
    scores = rockets.fit(windows, is_slip, num_kernels=sizes.num_kernels).score
    shared = partial(_RocketDetector, detector.pool, detector.channel_filter)
    baselines: dict[str, Scorer] = {
        name: BaselineDetector(key, detector.pool, detector.channel_filter)
        for name, key in BASELINES.items()
    }
    return baselines | {ROCKET: shared(scores)}


if __name__ == "__main__":
    raise SystemExit(Onset().run())
