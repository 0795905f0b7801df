"""The detector behind a step: a new machine, and what its file says of calibration and promises."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from tactslip_torch.adapting.held_out import Solved, class_scales
from tactslip_torch.adapting.statistics import Statistics
from tactslip_torch.fitting import solve_facts
from tactslip_torch.model import abstention
from tactslip_torch.model.abstention import abstention_of
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.conformal import fewest_recordings, thresholds
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

    The calibration is made anew, of scores by machines that never met the bin's material, as in
    training. An alarm keeps its threshold but promises no rate any more. Thresholds for unsure
    answers are set anew on the recordings that are known, or go.

    Args:
        detector: as it was; kept.
        statistics: after the step.
        solved: their machine.
        entry: of the journal.
    """
    new = copy.deepcopy(detector)
    new.head = solved.head
    info = new.info
    info["solve"] = solve_facts(solved.head)
    info["num_bins"] = int(statistics.sums.count.sum())
    info[JOURNAL] = [*info.get(JOURNAL, []), dict(entry)]
    info["train_materials"] = [solved.known.materials[i] for i in solved.known.material.unique()]
    keys = info.get("train_recordings", {}) | {n: b.key for n, b in statistics.bins.items()}
    entries = statistics.sums.ledger.entries
    out = {name for name in statistics.bins if name not in entries}
    info["train_recordings"] = {n: key for n, key in keys.items() if n not in out}
    if info.get("calibration"):
        info["calibration"] = _calibration(statistics, solved) or info["calibration"]
    if ALARM in info:
        facts = dict(info[ALARM].get("facts") or {}) | {"adapted": _SAID}
        info[ALARM] = info[ALARM] | {"target_per_hour": None, "facts": facts}
    if (answers := abstention_of(new)) is not None:
        info[abstention.KEY] = _thresholds(solved, answers)
    return new


_SAID = (
    "the machine changed after the threshold was set: no rate is promised; train with +exp=onset"
)


def _calibration(statistics: Statistics, solved: Solved) -> dict[str, Any] | None:
    """From held-out scores, each material left out; ``None`` where there is but one, or none tells.

    As training does it, of a machine of the known bins, each weighing as much as all that it stands
    for.
    """
    known, machine = solved.known, statistics.machine
    scales = class_scales(statistics.sums, machine)
    weights: Tensor = scales[known.is_slip.long()] * known.represents
    bins = TrainingBins(known.z, known.is_slip, weights)
    try:
        left_out = HeldOut(bins, known.material, Polynomial(2, machine.offset))
        scores = left_out.at(machine.penalty).scores
        return fit_platt(scores, known.is_slip, weights).to_dict()
    except ValueError as error:
        log.warning("the calibration stays as it was: %s", error)
        return None


def _thresholds(solved: Solved, answers: abstention.Abstention) -> dict[str, Any] | None:
    """Conformal thresholds for the same coverage on the recordings that are known."""
    known, coverage = solved.known, answers.coverage
    found = thresholds(solved.scores, known.is_slip, known.recording, coverage)
    if fewest_recordings(coverage) > min(found.num_slip, found.num_non_slip):
        log.warning("no answer is unsure any more: too few recordings for coverage=%g", coverage)
        return None
    facts = dict(answers.facts) | {
        "num_recordings": {"slip": found.num_slip, "non_slip": found.num_non_slip},
        "num_bins": len(solved.scores),
        "adapted": "set anew on all recordings that are known, added ones among them",
    }
    return abstention.Abstention(coverage, found.low, found.high, facts).to_dict()
