"""How much ``benchmarks.onset`` measures."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.signals.filtering import Align


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        training: overrides of ``tactslip_torch.train +exp=onset``, the same for every filter.
        streams: further overrides, of the recordings that are watched.
        aligns: filters, a detector is trained behind each.
        hop_ms: distances of decisions, all multiples of the first.
        hours: of slip-free stream to calibrate on, as many to check on, seen and unseen.
        target_per_hour: false alarms that thresholds are set for.
        rival_align: the detector that rivals stand beside.
        rival_hop_ms: of all methods that are compared.
        rival_hours: as ``hours``, of these.
        rival_bins: of each class, to which MiniRocket's ridge is fitted.
        num_kernels: of MiniRocket.
        rounds: of timed pushes.
        seed: of recordings, draws and the order of calls.
    """

    training: tuple[str, ...] = (
        "data.cycles=8",
        "others.held.cycles=2",
        "others.knocked.cycles=2",
        "others.arm_motion.cycles=4",
        "recipe.penalties=[0.001,0.003,0.01]",
    )
    streams: tuple[str, ...] = ("onset.streams.cycles=20", "onset.streams.others.held.cycles=14")
    aligns: tuple[Align, ...] = ("centred", "causal", "trailing")
    hop_ms: tuple[float, ...] = (5.0, 10.0, 25.0, 50.0)
    hours: float = 0.5
    target_per_hour: float = 20.0
    rival_align: Align = "centred"
    rival_hop_ms: float = 50.0
    rival_hours: float = 0.5
    rival_bins: int = 1500
    num_kernels: int = 10_000
    rounds: int = 60
    seed: int = 0


QUICK = Sizes(
    training=(
        "data.cycles=2",
        "data.materials=[M1,M6,iron]",
        "split.seen=[M1,M6]",
        "split.unseen=[iron]",
        "split.train_share=0.5",
        "others.held.cycles=2",
        "others.held.tail_s=2",
        "others.knocked.cycles=2",
        "others.knocked.tail_s=2",
        "others.arm_motion.cycles=2",
        "recipe.num_features=20",
        "recipe.penalties=[0.003]",
    ),
    streams=(
        "onset.streams.cycles=4",
        "onset.streams.others.held.cycles=4",
        "onset.streams.others.held.tail_s=5",
    ),
    hours=0.002,
    rival_hours=0.002,
    rival_bins=40,
    num_kernels=168,
    rounds=3,
)
