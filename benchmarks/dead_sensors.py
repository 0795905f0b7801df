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

from benchmarks.harness import Benchmark, Job, Report, Table, bars, by, percent, say
from benchmarks.subjects import SEEN_ROLE, Trained
from tactslip_torch import HandLayout
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

OURS, REFIT = "closed form", "refit"
_CALIBRATED_ON = 3000  # training bins at most that a refitted machine is calibrated on


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        training: overrides of ``tactslip_torch.train``.
        halves: random halves of the channels.
    """

    training: tuple[str, ...] = ("+exp=unseen4", "recipe=robust")
    halves: int = 20


@dataclass(frozen=True, eq=False)
class _Bins:
    """Scaled bins ``[N, K]``, which are slip ``[N]``, and the number of their material ``[N]``."""

    z: Tensor
    is_slip: Tensor
    material: Tensor


class DeadSensors(Benchmark[Sizes]):
    """Losses of sensors, and ways to go on."""

    name = "dead_sensors"
    title = "Dead sensors"
    about = "balanced accuracy and calibration without some sensors, by way to go on"
    sizes = Sizes()
    quick = Sizes(
        (
            "+exp=unseen4",
            "recipe=robust",
            "data.cycles=4",
            "data.materials=[M1,M2,iron]",
            "split.seen=[M1,M2]",
            "split.unseen=[iron]",
            "recipe.num_features=20",
            "recipe.penalties=[0.001,0.01]",
        ),
        halves=1,
    )

    @torch.no_grad()
    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """A row for each loss, role and way; of losses that take a feature and leave one."""
        training = [*job.sizes.training, *job.overrides]
        trained = Trained.by(training, job.folder, job.folder / "cache")
        detector = trained.detector
        bins = {role: _bins_of(trained, role) for role in ("train", *SEEN_ROLE)}
        calibration = calibration_from_dict(detector.info["calibration"])
        rows = []
        for kind, name, channels in _losses(detector.pool.hand, job.sizes.halves):
            dead = channel_mask(channels, detector.pool.hand.names)
            is_lost = dead[detector.channel_index]
            if not is_lost.any() or is_lost.all():
                continue
            say(f"dead sensors: without {name}, {int(is_lost.sum())} features less")
            head, of_refit = _refitted(bins["train"], is_lost, float(detector.info["penalty"]))
            for role in SEEN_ROLE:
                own = bins[role]
                loss = {"kind": kind, "lost": name, "role": role}
                for way, (gaussians, fill) in _ways(trained).items():
                    whole, lost = detector.head(own.z), is_lost.expand(len(own.z), -1)
                    score, variance = missing_scores(
                        detector.head, gaussians, fill, whole, own.z, lost
                    )
                    stated = probability(widened_llr(calibration, score, variance), 0.5)
                    rows.append(loss | {"way": way} | _evaluated(own, score, stated))
                score = head(own.z[:, ~is_lost])
                stated = probability(widened_llr(of_refit, score, torch.zeros_like(score)), 0.5)
                rows.append(loss | {"way": REFIT} | _evaluated(own, score, stated))
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
                mean(100 * row["balanced_accuracy"] for row in of)
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


def _ways(trained: Trained) -> dict[str, tuple[ClassGaussians | None, Tensor]]:
    detector = trained.detector
    imputation = detector.imputation
    assert imputation is not None  # as trained
    silent = torch.zeros(len(detector.pool.hand), detector.pool.bin_samples)
    features = detector.pool(detector.pool.widen(silent))[list(detector.selected)].double()
    fills = {
        "mean-fill": imputation,
        "zero-fill": torch.zeros_like(imputation),
        "0 V": detector.scaler(features),
    }
    return {OURS: (detector.gaussians, imputation)} | {
        name: (None, fill) for name, fill in fills.items()
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
    is_right = (score >= 0) == bins.is_slip
    recalls = [is_right[bins.is_slip].double().mean(), is_right[~bins.is_slip].double().mean()]
    calibration = reliability(stated, bins.is_slip, weights=_class_weights(bins.is_slip))
    return {"balanced_accuracy": float(sum(recalls)) / 2, "ece": calibration["ece"]}


def _class_weights(is_slip: Tensor) -> Tensor:
    """By which both classes count alike, ``[N]``, float64; 1 in the mean."""
    fraction = is_slip.double().mean()
    return torch.where(is_slip, 0.5 / fraction, 0.5 / (1 - fraction))


if __name__ == "__main__":
    raise SystemExit(DeadSensors().run())
