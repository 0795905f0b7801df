"""New materials brought to a detector, recording by recording, beside what else one could do.

Ways: ``auto`` (the weight that old materials allow), ``slip-free`` (the same, of bins without slip
alone), ``weight 1`` (what fitting again on everything gives, features and scaling kept),
``threshold`` (the machine stays, its threshold goes where the new recordings are told best) and
``ceiling`` (trained on the whole training share of the new material too, features ranked and scaled
anew, K, c and C kept).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.adapting.sizes import Sizes
from benchmarks.adapting.subject import Subject, divided, drawn, joined
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.detector_file import Head
from tactslip_torch.runtime import bar
from tactslip_torch.training.adaptation import (
    FACTORS,
    Solved,
    add,
    mean_recall,
    renewed,
    solve,
    taken,
    undo,
)
from tactslip_torch.training.fitting import TrainingPass
from tactslip_torch.training.selection import plan_detector
from tactslip_torch.training.statistics import RecordingBins, Statistics, detector_digest

AUTO, SLIP_FREE, ONE, SHIFT, CEILING = "auto", "slip-free", "weight 1", "threshold", "ceiling"
_SHARE_SEED = 1000  # of which recordings are judged; draws count from 0


@dataclass(frozen=True)
class Job:
    """One change to make."""

    material: str
    way: str
    count: int
    draw: int


def adapted(subject: Subject, sizes: Sizes) -> dict[str, Any]:
    """Every new material, way, count and draw.

    Returns:
        ``rows`` of a job with balanced accuracy ``new`` and ``old`` (a mean over materials), the
        ``weight`` of an added bin in parts of an average old material where it was chosen, and
        whether it was ``accepted``; ``before`` with ``new`` by material and ``old``.
    """
    before = solve(subject.statistics)
    old = old_bins(subject)
    rows = []
    for job in bar(jobs_of(subject, sizes), "new materials", "change"):
        pool, judged = _divided(subject, sizes, job.material)
        chosen = subject.named(drawn(pool, job.count, sizes.seed + job.draw))
        found = _way(subject, sizes, before, job, chosen, subject.named(judged))
        rows.append(asdict(job) | found)
    new = {
        material: _score(before.head, subject.named(_divided(subject, sizes, material)[1]))
        for material in subject.materials("unseen")
    }
    return {"rows": rows, "before": {"new": new, "old": _old_score(before.head, old)}}


def jobs_of(subject: Subject, sizes: Sizes) -> list[Job]:
    """All changes, in order."""
    jobs = []
    for material in subject.materials("unseen"):
        pool, _ = _divided(subject, sizes, material)
        for way, counts, draws in (
            (AUTO, sizes.counts, sizes.draws),
            (ONE, sizes.counts, sizes.draws),
            (SHIFT, sizes.counts, sizes.draws),
            (SLIP_FREE, sizes.slip_free_counts, sizes.slip_free_draws),
            (CEILING, (len(pool),), 1),
        ):
            jobs += [Job(material, way, n, draw) for n in counts for draw in range(draws)]
    return jobs


def chosen_weights(subject: Subject, sizes: Sizes) -> dict[str, Any]:
    """What weights do where each training material in turn is new: ``FACTORS`` is chosen on this.

    Features and scaling saw the material. No new material, and no test recording, is among it.

    Returns:
        ``rows`` of ``material``, ``factor`` (0: none added), ``new`` on the material's other
        training recordings and ``old``, a mean over the other materials, held out in closed form.
    """
    rows = []
    for material in bar(subject.materials("train"), "weights, on training materials", "material"):
        mine = subject.recordings("train", material)
        added = drawn(mine, sizes.judged, sizes.seed)
        judged = subject.named([one for one in mine if one not in added])
        without = subject.statistics.reweighed(
            dict.fromkeys(map(str, mine), 0.0), subject.named(mine)
        )
        bins = subject.named(added)
        total = sum(len(subject.bins[str(r)].z) for r in subject.recordings("train"))
        average = (total - sum(len(subject.bins[str(r)].z) for r in mine)) / (
            len(subject.materials("train")) - 1
        )
        unit = average / sum(len(own.z) for own in bins.values())
        for factor in (0.0, *FACTORS):
            after = without.reweighed(dict.fromkeys(bins, factor * unit), bins)
            solved = solve(after)
            old = [
                mean_recall((solved.scores >= 0)[of], solved.known.is_slip[of])
                for place, name in enumerate(solved.known.materials)
                if name != material and bool((of := solved.known.material == place).any())
            ]
            rows.append(
                {
                    "material": material,
                    "factor": factor,
                    "new": _score(solved.head, judged),
                    "old": sum(old) / len(old),
                }
            )
    return {"rows": rows}


def one_step(subject: Subject, sizes: Sizes) -> dict[str, Any]:
    """A step and back: what it takes, and whether the files are what they were.

    Returns:
        ``seconds`` of reading, adding and renewing, and of undoing; ``recordings``, ``features``;
        whether undoing ``restores`` detector and statistics bit for bit.
    """
    material = subject.materials("unseen")[0]
    chosen = drawn(subject.recordings("unseen", material), sizes.judged, sizes.seed)
    bare = _uncached(subject)
    started = time.perf_counter()
    for recording in chosen:
        bare(recording, subject.split)
    read = time.perf_counter()
    before = solve(subject.statistics)
    change = add(subject.statistics, before, subject.named(chosen), None, 1.0)
    new = renewed(subject.detector, change.statistics, change.solved, {})
    added = time.perf_counter()
    content = subject.file.read_bytes()
    file = torch.frombuffer(bytearray(content), dtype=torch.uint8)
    after = taken(subject.statistics, change, {"action": "add"}, file, detector_digest(new))
    with tempfile.TemporaryDirectory() as folder:
        after.save(Path(folder, "after.pt"))
        undoing = time.perf_counter()
        back, detector = undo(Statistics.load(Path(folder, "after.pt")))
        back.save(Path(folder, "back.pt"))
        undone = time.perf_counter()
        is_same = (
            Path(folder, "back.pt").read_bytes()
            == subject.file.with_name("statistics.pt").read_bytes()
            and bytes(detector.numpy()) == content
        )
    return {
        "seconds": {"read": read - started, "add": added - read, "undo": undone - undoing},
        "recordings": len(chosen),
        "features": len(subject.detector.selected),
        "restores": is_same,
    }


def _uncached(subject: Subject) -> Any:
    """The maker of features without its cache."""
    maker = subject.maker
    parts = maker.source, maker.pool, maker.channel_filter, maker.rule
    return type(maker)(*parts, None, maker.dtype, maker.extractor.engine)


def _divided(
    subject: Subject, sizes: Sizes, material: str
) -> tuple[list[RecordingId], list[RecordingId]]:
    of_material = subject.recordings("unseen", material)
    return divided(of_material, sizes.train_share, _SHARE_SEED + sizes.seed)


def _way(
    subject: Subject,
    sizes: Sizes,
    before: Solved,
    job: Job,
    chosen: dict[str, RecordingBins],
    judged: dict[str, RecordingBins],
) -> dict[str, Any]:
    old = old_bins(subject)
    if job.way == CEILING:
        return ceiling(subject, job.material, list(chosen), judged)
    if job.way == SHIFT:
        shift = best_shift(before.head, *joined(chosen))
        return {
            "new": _score(before.head, judged, shift),
            "old": _old_score(before.head, old, shift),
        }
    if job.way == ONE:
        after = subject.statistics.reweighed(dict.fromkeys(chosen, 1.0), chosen)
        machine = after.machine
        head = after.sums.solve(machine.penalty, machine.offset, balance=machine.balance)
        return {"new": _score(head, judged), "old": _old_score(head, old)}
    if job.way == SLIP_FREE:
        chosen = {
            name: replace(own, z=own.z[~own.is_slip], is_slip=own.is_slip[~own.is_slip])
            for name, own in chosen.items()
        }
    change = add(subject.statistics, before, chosen, None, sizes.margin)
    is_accepted = change.problem(sizes.margin) is None
    head = change.solved.head if is_accepted else before.head
    return {
        "new": _score(head, judged),
        "old": _old_score(head, old),
        "factor": change.factor,
        "accepted": is_accepted,
    }


def ceiling(
    subject: Subject, material: str, added: list[str], judged: Mapping[str, RecordingBins]
) -> dict[str, Any]:
    """Trained on these recordings of the new material too: ranked, scaled and solved anew."""
    machine = subject.statistics.machine
    recipe = replace(
        subject.recipe,
        num_features=len(subject.detector.selected),
        penalties=machine.penalty,
        offsets=machine.offset,
    )
    recordings = [
        *subject.recordings("train"),
        *(r for r in subject.recordings("unseen", material) if str(r) in added),
    ]
    pool = subject.maker.pool
    survey = Survey(len(pool.names), recipe.sample_bins)
    for recording in recordings:
        made = subject.maker(recording, subject.split)
        survey.update(str(recording), recording.material, made.features, made.is_slip)
    plan = plan_detector(recipe, survey, lambda items, _: items, allowed=recipe.allowed(pool))
    gathered = TrainingPass(plan)
    for recording in recordings:
        made = subject.maker(recording, subject.split)
        gathered.update(str(recording), made.features, made.is_slip)
    head = gathered.solve()

    def score(recordings: list[RecordingId]) -> float:
        made = [subject.maker(recording, subject.split) for recording in recordings]
        z = torch.cat([plan.frame(one.features) for one in made])
        return mean_recall(head(z) >= 0, torch.cat([one.is_slip for one in made]))

    of_material = subject.recordings("unseen", material)
    old = [score(subject.recordings("test", name)) for name in subject.materials("test")]
    return {
        "new": score([one for one in of_material if str(one) in judged]),
        "old": sum(old) / len(old),
    }


def best_shift(head: Head, z: Tensor, is_slip: Tensor) -> float:
    """What to add to scores so that balanced accuracy on these bins is best.

    Example:
        >>> best_shift(lambda z: z[:, 0], torch.tensor([[-2.0], [-1.0]]), torch.tensor([0, 1]) > 0)
        1.5
    """
    scores = head(z).sort()
    truth = is_slip[scores.indices]
    missed = torch.cat([truth.new_zeros(1, dtype=torch.double), truth.double().cumsum(0)])
    quiet = torch.cat([missed[:1] * 0, (~truth).double().cumsum(0)])
    of_slip, of_rest = missed[-1].clamp(min=1), quiet[-1].clamp(min=1)
    place = int(((of_slip - missed) / of_slip + quiet / of_rest).argmax())
    values = scores.values
    low = values[max(place - 1, 0)]
    return -float((low + values[min(place, len(values) - 1)]) / 2)


def old_bins(subject: Subject) -> dict[str, dict[str, RecordingBins]]:
    """Test recordings by old material."""
    return {m: subject.named(subject.recordings("test", m)) for m in subject.materials("test")}


def _score(head: Head, bins: dict[str, RecordingBins], shift: float = 0.0) -> float:
    z, is_slip = joined(bins)
    return mean_recall(head(z) + shift >= 0, is_slip)


def _old_score(head: Head, old: dict[str, dict[str, RecordingBins]], shift: float = 0.0) -> float:
    return sum(_score(head, bins, shift) for bins in old.values()) / len(old)
