"""Detectors of ``+exp=onset`` behind each filter, and the stage behind them, from its config."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from benchmarks.onset.sizes import Sizes
from benchmarks.reproduction.runs import run
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.training.alarm import CalibratedAlarm


def train_all(sizes: Sizes, folder: Path) -> dict[str, dict[str, Any]]:
    """A detector behind every filter, and how often it is right about bins.

    Args:
        sizes: how much.
        folder: of the runs, one for each filter; those that this very code finished are taken.

    Returns:
        By filter: ``file`` of the detector, ``balanced_accuracy`` by role, ``features`` in use,
        ``training_bins``, and ``seconds`` that the training took.

    Raises:
        RuntimeError: if a training fails.
    """
    found: dict[str, dict[str, Any]] = {}
    for align in sizes.aligns:
        place = folder / align
        overrides = [*training_overrides(sizes, align), "onset=none"]
        with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as cache:  # some gigabytes
            metrics = run(f"detector behind the {align} filter", overrides, place, Path(cache))
        found[align] = {
            "file": str(place / "detector.pt"),
            "balanced_accuracy": {
                role: metrics["splits"][role]["balanced_accuracy"] for role in ("test", "unseen")
            },
            "features": len(metrics["selected"]),
            "training_bins": metrics["num_bins"],
            "seconds": metrics["timing_s"]["total"],
        }
    return found


def training_overrides(sizes: Sizes, align: str) -> list[str]:
    """What ``tactslip_torch.train`` is told, whatever is watched behind it."""
    return ["+exp=onset", f"seed={sizes.seed}", f"features.align={align}", *sizes.training]


def composed(sizes: Sizes, align: str) -> DictConfig:
    """The configuration of a training with the stage behind it."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose("train", [*training_overrides(sizes, align), *sizes.streams])


def alarming_of(
    config: DictConfig, hop_ms: float, hours: float, per_hour: float
) -> CalibratedAlarm:
    """The stage behind ``+exp=onset``: the protocol and its quiet alone, and the main rule.

    Args:
        config: ``composed``.
        hop_ms: of decisions.
        hours: of quiet, to calibrate on and to check on.
        per_hour: false alarms that thresholds are set for.
    """
    onset: Any = OmegaConf.to_container(config.onset, resolve=True)
    quiet, main = onset["slip_free"], onset["rule"]
    onset["streams"]["others"] = {quiet: onset["streams"]["others"][quiet]}
    onset["rules"] = {main: onset["rules"][main]}
    onset |= {"hours": hours, "false_alarms_per_hour": per_hour}
    made: CalibratedAlarm = instantiate(onset, _convert_="all")
    return at_hop(made, hop_ms, float(config.labels.bin_ms))


def at_hop(alarming: CalibratedAlarm, hop_ms: float, bin_ms: float) -> CalibratedAlarm:
    """The same at another hop; the evidence of a decision is the part of its bin that is new."""
    new = min(1.0, hop_ms / bin_ms)

    def rule(numbers: Mapping[str, Any]) -> dict[str, Any]:
        return {**numbers, **({"evidence": new} if "evidence" in numbers else {})}

    rules = {name: rule(numbers) for name, numbers in alarming.rules.items()}
    return replace(alarming, hop_ms=hop_ms, rules=rules)
