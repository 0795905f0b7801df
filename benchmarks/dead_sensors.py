"""A detector that loses sensors: ``python -m benchmarks.dead_sensors``.

Accuracy and calibration of the main job's detector without a channel, a finger, a kind of sensor or
random halves, by the closed form that it has, by filling in means, zeros or 0 V, and by fitting
again without the lost features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import mean
from typing import Any, ClassVar

import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import SEEN_ROLE, Trained
from benchmarks.tables import Report, Table, by, percent
from tactslip_torch import HandLayout, SlipDetector
from tactslip_torch.model.calibration import (
    Calibration,
    calibration_from_dict,
    fit_platt,
    probability,
    reliability,
    widened_llr,
)
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine
from tactslip_torch.model.missing_channels import ClassGaussians, channel_mask, missing_scores
from tactslip_torch.training.recipe import balanced_accuracy

_CALIBRATED_ON = 3000  # training bins at most that a refitted machine is calibrated on


@dataclass(frozen=True)
class DeadSensors(Benchmark):
    """Losses of sensors, and ways to go on.

    Args:
        training: overrides of ``tactslip_torch.train``.
        halves: random halves of the channels.
        channels: that are lost one at a time, at most.
    """

    title = "Dead sensors"
    about = "balanced accuracy and calibration without some sensors, by way to go on"
    quick = (
        'training=[+exp=unseen4,recipe=robust,data.cycles=2,"data.materials=[M1,M2,iron]",'
        '"split.seen=[M1,M2]","split.unseen=[iron]",recipe.num_features=20,num_workers=0,'
        '"recipe.penalties=[0.001,0.01]",split.train_fraction=0.5,baselines=false] halves=1 '
        "channels=4"
    )
    charts: ClassVar = {
        "": [(f"{role}: {of}", ("c", "m", "z", "0", "r")) for role, of in SEEN_ROLE.items()]
    }
    training: tuple[str, ...] = ("+exp=unseen4", "recipe=robust")
    halves: int = 20
    channels: int | None = None

    @torch.no_grad()
    def measure(self, job: Job) -> dict[str, Any]:
        """A row for each loss, role and way; of losses that take a feature and leave one."""
        training = [*self.training, *job.overrides]
        trained = Trained.by(training, job.folder, job.folder / "cache")
        detector = trained.detector
        (fitted, material), *evaluated = (_bins_of(trained, of) for of in ("train", *SEEN_ROLE))
        calibration = calibration_from_dict(detector.info["calibration"])
        rows, ways = [], _ways(detector)
        for kind, name, channels in _losses(detector.pool.hand, self):
            dead = channel_mask(channels, detector.pool.hand.names)
            is_lost = dead[detector.channel_index]
            if not is_lost.any() or is_lost.all():
                continue
            say(f"dead sensors: without {name}, {int(is_lost.sum())} features less")
            left = replace(fitted, features=fitted.features[:, ~is_lost])
            head, of_refit = _refitted(left, material, float(detector.info["penalty"]))
            for role, (bins, _) in zip(SEEN_ROLE, evaluated, strict=True):
                z, lost = bins.features, is_lost.expand(len(bins.is_slip), -1)
                whole, refit = detector.head(z), head(z[:, ~is_lost])
                scored = {
                    way: (calibration, *missing_scores(detector.head, *of, whole, z, lost))
                    for way, of in ways.items()
                } | {"refit": (of_refit, refit, torch.zeros_like(refit))}
                for way, (calibrated, score, variance) in scored.items():
                    stated = probability(widened_llr(calibrated, score, variance), 0.5)
                    ece = reliability(stated, bins.is_slip, weights=bins.sample_weight)["ece"]
                    accuracy = balanced_accuracy(score >= 0, bins.is_slip) or 0.0
                    row = {"kind": kind, "lost": name, "role": role, "way": way}
                    rows.append(row | {"balanced_accuracy": accuracy, "ece": ece})
        return {"rows": rows}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Means over losses of a kind, by role."""
        found: dict[str, list[dict[str, object]]] = {}
        for (role, kind), of in by(numbers["rows"], "role", "kind").items():
            ways = by(of, "way")
            row = {"without": f"a {kind}", "losses": len(next(iter(ways.values())))}
            rows = found.setdefault(f"{role}: {SEEN_ROLE[role]}", [])
            rows.append(row | {way: _cell(own) for (way,), own in ways.items()})
        note = "Balanced accuracy, %, in brackets the expected calibration error; means."
        return {title: Table(rows, note) for title, rows in found.items()}


def _cell(rows: Sequence[Report]) -> str:
    accuracy = percent(mean(row["balanced_accuracy"] for row in rows))
    return f"{accuracy} ({mean(row['ece'] for row in rows):.3f})"


def _bins_of(trained: Trained, role: str) -> tuple[TrainingBins, Tensor]:
    """Scaled bins of a role, weighed so that both classes count alike; numbers of materials."""
    materials = trained.materials("train") + trained.materials("unseen")
    selected = list(trained.detector.selected)
    z, slips, place = [], [], []
    for recording in trained.recordings(role):
        made = trained.maker(recording, trained.split)
        mine = made.roles[role]
        z.append(trained.detector.scaled(made.features[mine][:, selected].double()))
        slips.append(made.is_slip[mine])
        place.append(torch.full((int(mine.sum()),), materials.index(recording.material)))
    is_slip = torch.cat(slips)
    fraction = is_slip.double().mean()
    weights = torch.where(is_slip, 0.5 / fraction, 0.5 / (1 - fraction))
    return TrainingBins(torch.cat(z), is_slip, weights), torch.cat(place)


def _losses(hand: HandLayout, sizes: DeadSensors) -> list[tuple[str, str, list[str]]]:
    """Kind of loss, name, and names of the dead channels."""
    found = [("channel", name, [name]) for name in hand.names[-(sizes.channels or len(hand)) :]]
    for kind in ("finger", "kind"):
        for value in dict.fromkeys(getattr(channel, kind) for channel in hand.channels):
            names = [c.name for c in hand.channels if getattr(c, kind) == value]
            found.append((f"{kind} of sensors" if kind == "kind" else kind, str(value), names))
    generator = torch.Generator().manual_seed(0)
    for number in range(sizes.halves):
        order = torch.randperm(len(hand), generator=generator)[: len(hand) // 2]
        found.append(("random half", f"half {number}", [hand.names[i] for i in order.tolist()]))
    return found


def _ways(detector: SlipDetector) -> dict[str, tuple[ClassGaussians | None, Tensor]]:
    imputation = detector.imputation
    assert imputation is not None  # as trained
    silent = torch.zeros(len(detector.pool.hand), detector.pool.bin_samples)
    features = detector.pool(detector.pool.widen(silent))[list(detector.selected)].double()
    return {
        "closed form": (detector.gaussians, imputation),
        "mean-fill": (None, imputation),
        "zero-fill": (None, torch.zeros_like(imputation)),
        "0 V": (None, detector.scaler(features)),
    }


def _refitted(bins: TrainingBins, material: Tensor, penalty: float) -> tuple[Any, Calibration]:
    """The machine of the features that are left, calibrated without each material in turn."""
    num = len(bins.is_slip)
    some = torch.randperm(num, generator=torch.Generator().manual_seed(0))[:_CALIBRATED_ON]
    is_slip, weights = bins.is_slip[some], bins.sample_weight[some]
    sample = TrainingBins(bins.features[some], is_slip, weights * (num / len(some)))
    scores = HeldOut(sample, material[some]).at(penalty).scores
    return fit_machine(bins, penalty), fit_platt(scores, is_slip, weights)


if __name__ == "__main__":
    raise SystemExit(DeadSensors().run())
