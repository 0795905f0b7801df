"""The detector behind a step: a new machine, and what its file says of calibration and promises."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from tactslip_torch.adapting.bins import KnownBins
from tactslip_torch.adapting.held_out import Solved, class_scales
from tactslip_torch.adapting.statistics import Machine, Statistics
from tactslip_torch.fitting import solve_facts
from tactslip_torch.model import abstention
from tactslip_torch.model.abstention import abstention_of
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.class_gaussians import ClassGaussians
from tactslip_torch.model.conformal import check_number, thresholds
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.held_out import HeldOut
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.onset.settings import KEY as ALARM

log = logging.getLogger(__name__)

JOURNAL = "adaptations"
"""Under which ``SlipDetector.info`` keeps the entries of all steps."""


def renewed(
    detector: SlipDetector, statistics: Statistics, solved: Solved, entry: Mapping[str, Any]
) -> SlipDetector:
    """A detector with another machine; features, scaling and filter stay.

    As training does it, but of the bins that are known: what stands in for a missing sensor; the
    calibration, of scores by machines that never met the bin's material, an alarm's too; thresholds
    for unsure answers, by machines that never met the recording or, as in training, the material.
    The latter go where they cannot be told. An alarm keeps its threshold, but promises no rate.

    Args:
        detector: as it was; kept.
        statistics: after the step.
        solved: their machine.
        entry: of the journal.
    """
    new, known = copy.deepcopy(detector), solved.known
    new.head = solved.head
    bins = _training_bins(statistics, known)
    _renew_stand_ins(new, bins)
    info = new.info
    info["solve"] = solve_facts(solved.head)
    info["num_bins"] = int(statistics.sums.count.sum())
    info[JOURNAL] = [*info.get(JOURNAL, []), dict(entry)]
    info["train_materials"] = [known.materials[i] for i in known.material.unique()]
    keys = info.get("train_recordings", {}) | {n: b.key for n, b in statistics.bins.items()}
    entries = statistics.sums.ledger.entries
    out = {name for name in statistics.bins if name not in entries}
    info["train_recordings"] = {n: key for n, key in keys.items() if n not in out}
    if info.get("calibration") or ALARM in info:
        found = _calibration(bins, known, statistics.machine)
        if info.get("calibration"):
            info["calibration"] = found or info["calibration"]
        if ALARM in info:
            info[ALARM] = _alarm(info[ALARM], found)
    if (answers := abstention_of(new)) is not None:
        info[abstention.KEY] = _thresholds(bins, known, statistics.machine, answers)
    return new


def _training_bins(statistics: Statistics, known: KnownBins) -> TrainingBins:
    """Known bins, each weighing as much as all that it stands for, the classes balanced."""
    scales = class_scales(statistics.sums, statistics.machine)
    weights = scales[known.is_slip.long()] * known.represents
    return TrainingBins(known.z, known.is_slip, weights)


def _renew_stand_ins(detector: SlipDetector, bins: TrainingBins) -> None:
    """What is expected of a sensor that is missing."""
    gaussians = ClassGaussians.fit(bins.features, bins.is_slip, bins.weights)
    detector.typical.copy_(gaussians.mean.mean(0))  # both classes counting alike
    if detector.gaussians is not None:
        detector.gaussians = gaussians


def _scores_without(groups: Tensor, bins: TrainingBins, machine: Machine) -> Tensor:
    """Of each known bin, by the machine of known bins that never met its group."""
    return HeldOut(bins, groups, Polynomial(2, machine.offset)).at(machine.penalty).scores


def _calibration(bins: TrainingBins, known: KnownBins, machine: Machine) -> dict[str, Any] | None:
    """From held-out scores, each material left out; ``None`` where that cannot be told."""
    try:
        scores = _scores_without(known.material, bins, machine)
        return fit_platt(scores, known.is_slip, bins.weights).to_dict()
    except ValueError as error:
        log.warning("the calibration stays as it was: %s", error)
        return None


def _alarm(plain: Mapping[str, Any], calibration: Mapping[str, Any] | None) -> dict[str, Any]:
    """Settings of an alarm that promise no rate, with the calibration if there is a new one."""
    which = "that of the machine before" if calibration is None else "made anew"
    said = (
        "the machine changed after the threshold was set: no rate is promised; the calibration is "
        f"{which}; train with +exp=onset"
    )
    return {
        **plain,
        "calibration": calibration or plain["calibration"],
        "target_per_hour": None,
        "facts": {**(plain.get("facts") or {}), "adapted": said},
    }


def _thresholds(
    bins: TrainingBins, known: KnownBins, machine: Machine, answers: abstention.Abstention
) -> dict[str, Any] | None:
    """Conformal thresholds for the same coverage on the recordings that are known."""
    coverage = answers.coverage
    left_out = "recording" if answers.facts.get("left_out") == "recording" else "material"
    try:
        groups = known.recording if left_out == "recording" else known.material
        scores = _scores_without(groups, bins, machine)
        found = thresholds(scores, known.is_slip, known.recording, coverage)
        check_number(found, coverage)
    except ValueError as error:
        log.warning("no answer is unsure any more: %s", error)
        return None
    facts = dict(answers.facts) | {
        "left_out": left_out,
        "num_recordings": {"slip": found.num_slip, "non_slip": found.num_non_slip},
        "num_bins": len(scores),
        "adapted": "set anew on all recordings that are known, added ones among them, each bin "
        f"scored by a machine of the others that never met its {left_out}",
    }
    return abstention.Abstention(coverage, found.low, found.high, facts).to_dict()
