"""A detector that loses sensors: ``python -m benchmarks.dead_sensors``.

Accuracy and calibration of the main job's detector without a channel, a finger, a kind of sensor or
random halves, by the closed form that it has, by filling in means, zeros or 0 V, and by fitting
again without the lost features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import SEEN_ROLE, Trained
from benchmarks.tables import Report, Table, bars, by, percent
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

OURS, REFIT = "closed form", "refit"
_CALIBRATED_ON = 3000  # training bins at most that a refitted machine is calibrated on


@dataclass(frozen=True, eq=False)
class _Bins:
    """Scaled bins ``[N, K]``, which are slip ``[N]``, and the number of their material ``[N]``."""

    z: Tensor
    is_slip: Tensor
    material: Tensor


@dataclass(frozen=True)
class DeadSensors(Benchmark):
    """Losses of sensors, and ways to go on.

    Args:
        training: overrides of ``tactslip_torch.train``.
        halves: random halves of the channels.
    """

    title = "Dead sensors"
    about = "balanced accuracy and calibration without some sensors, by way to go on"
    quick = (
        'training=[+exp=unseen4,recipe=robust,data.cycles=4,"data.materials=[M1,M2,iron]",'
        '"split.seen=[M1,M2]","split.unseen=[iron]",recipe.num_features=20,'
        '"recipe.penalties=[0.001,0.01]"] halves=1'
    )
    training: tuple[str, ...] = ("+exp=unseen4", "recipe=robust")
    halves: int = 20

    @torch.no_grad()
    def measure(self, job: Job) -> dict[str, Any]:
        """A row for each loss, role and way; of losses that take a feature and leave one."""
        training = [*self.training, *job.overrides]
        trained = Trained.by(training, job.folder, job.folder / "cache")
        detector = trained.detector
        bins = {role: _bins_of(trained, role) for role in ("train", *SEEN_ROLE)}
        calibration = calibration_from_dict(detector.info["calibration"])
        rows, ways = [], _ways(detector)
        for kind, name, channels in _losses(detector.pool.hand, self.halves):
            dead = channel_mask(channels, detector.pool.hand.names)
            is_lost = dead[detector.channel_index]
            if not is_lost.any() or is_lost.all():
                continue
            say(f"dead sensors: without {name}, {int(is_lost.sum())} features less")
            head, of_refit = _refitted(bins["train"], is_lost, float(detector.info["penalty"]))
            for role in SEEN_ROLE:
                z, lost = bins[role].z, is_lost.expand(len(bins[role].z), -1)
                whole, refit = detector.head(z), head(z[:, ~is_lost])
                scored = {
                    way: (calibration, *missing_scores(detector.head, *of, whole, z, lost))
                    for way, of in ways.items()
                } | {REFIT: (of_refit, refit, torch.zeros_like(refit))}
                for way, (calibrated, score, variance) in scored.items():
                    stated = probability(widened_llr(calibrated, score, variance), 0.5)
                    row = {"kind": kind, "lost": name, "role": role, "way": way}
                    rows.append(row | _evaluated(bins[role], score, stated))
        return {"rows": rows}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Means over losses of a kind, by role."""
        found = {}
        for role, words in SEEN_ROLE.items():
            rows = []
            for (kind,), of in by(_of_role(numbers, role), "kind").items():
                ways = by(of, "way")
                row = {"without": f"a {kind}", "losses": len(next(iter(ways.values())))}
                rows.append(row | {way: _cell(own) for (way,), own in ways.items()})
            note = "Balanced accuracy, %, in brackets the expected calibration error; means."
            found[f"{role}: {words}"] = Table(rows, note)
        return found

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Mean accuracy by kind of loss and way, held-out cycles."""
        rows = _of_role(numbers, "test")
        kinds = [kind for (kind,) in by(rows, "kind")]
        series = {
            way: [
                100 * mean(row["balanced_accuracy"] for row in of)
                for of in by(own, "kind").values()
            ]
            for (way,), own in by(rows, "way").items()
        }
        axes = drawing.subplots()
        bars(axes, kinds, series, "balanced accuracy, %, held-out cycles", is_log=False)
        axes.set_xlim(left=45)


def _of_role(numbers: Report, role: str) -> list[Report]:
    return [row for row in numbers["rows"] if row["role"] == role]


def _cell(rows: Sequence[Report]) -> str:
    accuracy = percent(mean(row["balanced_accuracy"] for row in rows))
    return f"{accuracy} ({mean(row['ece'] for row in rows):.3f})"


def _bins_of(trained: Trained, role: str) -> _Bins:
    materials = trained.materials("train") + trained.materials("unseen")
    selected = list(trained.detector.selected)
    z, is_slip, place = [], [], []
    for recording in trained.recordings(role):
        made = trained.maker(recording, trained.split)
        mine = made.roles[role]
        z.append(trained.detector.scaled(made.features[mine][:, selected].double()))
        is_slip.append(made.is_slip[mine])
        place.append(torch.full((int(mine.sum()),), materials.index(recording.material)))
    return _Bins(torch.cat(z), torch.cat(is_slip), torch.cat(place))


def _losses(hand: HandLayout, halves: int) -> list[tuple[str, str, list[str]]]:
    """Kind of loss, name, and names of the dead channels."""
    found = [("channel", name, [name]) for name in hand.names]
    for kind in ("finger", "kind"):
        for value in dict.fromkeys(getattr(channel, kind) for channel in hand.channels):
            names = [c.name for c in hand.channels if getattr(c, kind) == value]
            found.append((f"{kind} of sensors" if kind == "kind" else kind, str(value), names))
    generator = torch.Generator().manual_seed(0)
    for number in range(halves):
        order = torch.randperm(len(hand), generator=generator)[: len(hand) // 2]
        found.append(("random half", f"half {number}", [hand.names[i] for i in order.tolist()]))
    return found


def _ways(detector: SlipDetector) -> dict[str, tuple[ClassGaussians | None, Tensor]]:
    imputation = detector.imputation
    assert imputation is not None  # as trained
    silent = torch.zeros(len(detector.pool.hand), detector.pool.bin_samples)
    features = detector.pool(detector.pool.widen(silent))[list(detector.selected)].double()
    return {
        OURS: (detector.gaussians, imputation),
        "mean-fill": (None, imputation),
        "zero-fill": (None, torch.zeros_like(imputation)),
        "0 V": (None, detector.scaler(features)),
    }


def _refitted(training: _Bins, is_lost: Tensor, penalty: float) -> tuple[Any, Calibration]:
    """The machine of the features that are left, calibrated without each material in turn."""
    z, weights = training.z[:, ~is_lost], _class_weights(training.is_slip)
    head = fit_machine(TrainingBins(z, training.is_slip, weights), penalty)
    some = torch.randperm(len(z), generator=torch.Generator().manual_seed(0))[:_CALIBRATED_ON]
    is_slip = training.is_slip[some]
    sample = TrainingBins(z[some], is_slip, weights[some] * (len(z) / len(some)))
    scores = HeldOut(sample, training.material[some]).at(penalty).scores
    return head, fit_platt(scores, is_slip, weights[some])


def _evaluated(bins: _Bins, score: Tensor, stated: Tensor) -> dict[str, float]:
    weights = _class_weights(bins.is_slip)
    ece = reliability(stated, bins.is_slip, weights=weights)["ece"]
    return {"balanced_accuracy": balanced_accuracy(score >= 0, bins.is_slip) or 0.0, "ece": ece}


def _class_weights(is_slip: Tensor) -> Tensor:
    """By which both classes count alike, ``[N]``, float64; 1 in the mean."""
    fraction = is_slip.double().mean()
    return torch.where(is_slip, 0.5 / fraction, 0.5 / (1 - fraction))


if __name__ == "__main__":
    raise SystemExit(DeadSensors().run())
