"""How a detector holds on what it was not trained on: ``python -m benchmarks.generalisation``.

Trains ``+exp=unseen4`` and ``+exp=deploy`` with several seeds and evaluates each detector, as it
stands, on test cycles, held-out materials, the same materials in other sessions, a moving arm
without slip, objects that are pulled, motor vibration of 1 to 30 mV, and with a random half of the
channels missing. Trains ``+exp=hard`` with each recipe. Nothing is chosen on any of these. All data
are simulated. What a seed gave is kept, so a run that was stopped resumes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from statistics import fmean
from typing import Any, ClassVar, NamedTuple

import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from benchmarks import ROOT
from benchmarks.harness import Benchmark, Job, put_between
from benchmarks.tables import Report, Table, lines, mean_sd
from benchmarks.trainings import composed, features_of_some, resumed, trained
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report.results import BASELINES
from tactslip_torch.training.bins import bin_keys
from tactslip_torch.training.datamodule import RecordingFeatures

LEVELS_MV = (1.0, 3.0, 10.0, 30.0)
SIDES = ("seen", "held out")
LOUD = "slips at {:g} mV found, {}"
LOUD_ARM = "moving arm at {:g} mV called slip, {}"
LIMITS: dict[str, dict[str, tuple[float, ...]]] = {
    "unseen4": {
        "test": (99.1, 98.6),
        "held-out materials": (98.9, 98.6),
        "another session": (98.3,),
        "moving arm called slip, seen": (2.0,),
        "moving arm called slip, held out": (3.0,),
        "pulled object found, seen": (99.0,),
        "pulled object found, held out": (99.0,),
        "half of the channels missing, test": (97.5,),
        "half of the channels missing, held out": (97.5,),
        "calibration error, held out": (1.0,),
        "calibration error, half missing, held out": (3.0,),
    },
    "deploy": {
        "moving arm called slip, seen": (2.0,),
        "moving arm called slip, held out": (2.0,),
        **{LOUD.format(mv, "held out"): (90.0,) for mv in LEVELS_MV},
        **{LOUD_ARM.format(mv, "held out"): (4.0,) for mv in LEVELS_MV},
    },
}
"""By experiment and measure: wanted of the mean over seeds and, if there are two, of the worst. Of
what is called slip, and of errors, at most; of the others at least."""


@dataclass(frozen=True)
class Generalisation(Benchmark):
    """Every experiment with every seed.

    Args:
        unseen4: seeds of that experiment; ``deploy`` and ``hard`` the same.
        recipes: on ``hard``; the first is the one that baselines are held against.
        overrides: of every training and set of recordings.
        levels_mv: of motor vibration.
        evaluated: cycles of a moving arm and of pulled objects; of the others in proportion.
    """

    title = "Generalisation: materials, sessions, arms and sensors that were not trained on"
    about = (
        "detectors on what they were not trained on, with several seeds. Numbers are balanced "
        "accuracy in %, unless a row says otherwise; all data are **simulated**. Everything was "
        "chosen by validation on training materials. *Worst*: the worst seed. *Limit*: set before "
        "the measurement, in brackets for the worst seed; an upper limit of errors and of what is "
        "called slip, else a lower one. *Pair*: a material in a session. Baselines were fitted on "
        "the same training bins"
    )
    page, is_page = "docs/generalisation.md", True
    quick = (
        "unseen4=[0] deploy=[] hard=[0] recipes=[general] levels_mv=[3.0] evaluated=1 overrides=["
        'data.cycles=2,split.train_fraction=0.5,"data.materials=[M1,M4,M6,iron]",'
        '"split.seen=[M1,M4,M6]","split.unseen=[iron]",recipe.sample_bins=20,num_workers=0,'
        '"recipe.views=[pooled]","recipe.penalties=[1.0,10.0]"] few=[5]'
    )
    charts: ClassVar = {"": ()}
    unseen4: tuple[int, ...] = (0, 1, 2, 3, 4)
    deploy: tuple[int, ...] = (0, 1, 2, 3, 4)
    hard: tuple[int, ...] = (0, 1, 2, 3, 4)
    recipes: tuple[str, ...] = ("general", "paper")
    overrides: tuple[str, ...] = ()
    levels_mv: tuple[float, ...] = LEVELS_MV
    evaluated: int = 4
    few: tuple[int, ...] = (20, 60)

    def measure(self, job: Job) -> dict[str, Any]:
        """All measures of each seed."""
        by_name: dict[str, dict[str, Any]] = {"unseen4": {}, "deploy": {}, "hard": {}}
        for name, own in by_name.items():
            for seed in getattr(self, name):
                given = [f"seed={seed}", *self.overrides, *job.overrides]
                run = partial(_on_hard if name == "hard" else _measured, name, given, job, self)
                own[str(seed)] = resumed(job.folder / f"measures-{name}-{seed}.json", given, run)
        found: dict[str, Any] = {"hard": by_name.pop("hard")}
        found["experiments"] = {name: own for name, own in by_name.items() if own}
        small: dict[str, list[dict[str, float]]] = {}
        for num, seed in product(self.few, self.unseen4):
            given = [f"seed={seed}", *self.overrides, *job.overrides]
            place = job.folder / f"measures-{num}-numbers-{seed}.json"
            run = partial(_with_few, num, given, job)
            small.setdefault(str(num), []).append(resumed(place, [str(num), *given], run))
        return found | {"few numbers": small}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Measures, seed by seed and baselines of each experiment; recipes on the hard hand."""
        found = {}
        for name, own in numbers["experiments"].items():
            chosen = "; ".join(f"seed {seed}: {of['chosen']}" for seed, of in own.items())
            about = f"Seeds: {', '.join(own)}. Weights of the views (and penalties C): {chosen}."
            found[f"`+exp={name}`"] = Table(_measures(own, name), about)
            found[f"`+exp={name}`, seed by seed"] = Table(_by_seed(own), _validation(own))
            baselines = [of["baselines"] for of in own.values()]
            found[f"`+exp={name}`, baselines"] = Table(_rows(baselines, ("test", "unseen")))
        if small := numbers["few numbers"]:
            found["Few numbers"] = Table(
                [
                    {"numbers of each view": num}
                    | {m: f"{fmean(v):.2f} (worst {min(v):.2f})" for m, v in _columns(own).items()}
                    for num, own in small.items()
                ],
                "`+exp=unseen4` with `recipe.num_features`; mean and worst over its seeds.",
            )
        if hard := numbers["hard"]:
            by_seed = list(hard.values())
            about = (
                "The protocol on a simulated hand whose channels differ without slip, as those of "
                f"a real BioTac SP do. Seeds: {', '.join(hard)}. {_ahead(by_seed)}"
            )
            rows = _rows(by_seed, ("nested validation", "test", "unseen"))
            found["`+exp=hard`"] = Table(rows, about)
        return found

    def publish_more(self, report: Report) -> None:
        """README's table of the main job over all seeds."""
        own = list(report["numbers"]["experiments"]["unseen4"].values())
        parts = {"test": "test", "held-out materials": "unseen", "another session": ""}

        def row(name: str, scores: Mapping[str, Sequence[float]]) -> dict[str, str]:
            cells = {
                part: f"{mean_sd(of)} ({min(of):.2f})" if of else "" for part, of in scores.items()
            }
            return {"balanced accuracy, %": name} | cells

        rows = [row("`tactslip train`", {part: [of[part] for of in own] for part in parts})]
        for label, words in BASELINES.items():
            by_role = [of["baselines"][label] for of in own]
            rows.append(row(words, {p: [of[r] for of in by_role if r] for p, r in parts.items()}))
        text = [
            f"**Simulated**, mean ± sd over {len(own)} seeds and the lowest (`python -m "
            f"benchmarks.generalisation`, code {report['code']}):\n",
            Table(rows).markdown(),
        ]
        put_between(ROOT / "README.md", "first result", "\n".join(text))

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Slips found and moving arms called slip beside motor vibration."""
        for axes, measure in zip(drawing.subplots(1, 2), (LOUD, LOUD_ARM), strict=True):
            series = {}
            for (name, own), side in product(numbers["experiments"].items(), SIDES):
                levels = _levels_mv(own)
                keys = [measure.format(mv, side) for mv in levels]
                series[f"{name}, {side}"] = levels, [fmean(_over(own, key)) for key in keys]
            words = measure.format(0, "%").replace(" at 0 mV", "")
            lines(axes, series, "motor vibration, mV", words)
            axes.set_xscale("log")
            axes.set_xticks(levels, [f"{mv:g}" for mv in levels])


# Scores of a detector -----------------------------------------------------------------------------
class _Scored(NamedTuple):
    """Scores and probabilities of the bins of one recording, ``[N]``."""

    recording: RecordingId
    truth: Tensor
    score: Tensor
    probability: Tensor


@torch.no_grad()
def _scored(detector: SlipDetector, made: RecordingFeatures, *, half: bool) -> _Scored:
    """Scores of a recording, on request without a random half of the channels."""
    features = made.features[:, list(detector.selected)].double()
    is_missing = None
    if half:
        num = len(detector.pool.hand)
        rank = bin_keys(f"{made.recording} missing", num).argsort().argsort()
        is_missing = (rank < num // 2).expand(len(features), num)
    score = detector.head(detector.scaler(detector.columns(features, is_missing)))
    calibrated = detector.calibration
    assert calibrated is not None  # as trained
    calibration, slip_share = calibrated
    stated = probability(calibration.llr(score), slip_share)
    return _Scored(made.recording, made.is_slip, score, stated)


def _called_slip(parts: Sequence[_Scored], *, truth: bool) -> float:
    """Part of the bins of a class that is called slip, %."""
    is_called = torch.cat([part.score[part.truth == truth] >= 0 for part in parts])
    return 100 * float(is_called.double().mean())


def _balanced(parts: Sequence[_Scored]) -> float:
    """Balanced accuracy of some recordings together, %."""
    return 50 + (_called_slip(parts, truth=True) - _called_slip(parts, truth=False)) / 2


def _calibration_error(parts: Sequence[_Scored], num_cells: int = 15) -> float:
    """Expected calibration error of the probability of slip, in cells of equal width, %."""
    stated = torch.cat([part.probability for part in parts]).double()
    truth = torch.cat([part.truth for part in parts]).double()
    cell = (stated * num_cells).long().clamp(max=num_cells - 1)
    gaps = stated.new_zeros(num_cells).index_add(0, cell, truth - stated)
    return 100 * float(gaps.abs().sum()) / len(truth)


def _having(config: DictConfig, **most: int) -> Callable[[RecordingSource], list[RecordingId]]:
    """The first recordings of each material with a role in the split, by role how many."""

    def keep(source: RecordingSource) -> list[RecordingId]:
        (split,) = instantiate(config.split, _convert_="all")(source.ids)
        by_material: dict[str, list[RecordingId]] = {}
        for role in most:  # a material has training and test recordings, or held-out ones
            for recording in split.having(role):
                by_material.setdefault(recording.material, []).append(recording)
        return [one for own in by_material.values() for one in own[: most[split.roles[own[0]]]]]

    return keep


def _measured(name: str, given: Sequence[str], job: Job, sizes: Generalisation) -> dict[str, Any]:
    """All measures of an experiment with the overrides that give its seed and size."""
    folder, cache = job.folder / f"{name}-{given[0]}".replace("=", "-"), job.folder / "cache"
    metrics = trained([f"+exp={name}", *given], folder, cache)
    detector = SlipDetector.load(folder / "detector.pt")
    chosen = [row for row in metrics["validation"] if row.get("chosen")]
    found: dict[str, Any] = {
        "nested validation": _nested(metrics),
        "chosen": ", ".join(
            f"{row['view']} {row['weight']:.2f} (C={row['penalty']:g})" for row in chosen
        ),
        "numbers": len(metrics["selected"]),
        "per material": {
            m: 100 * s["balanced_accuracy"]
            for m, s in metrics["splits"]["unseen"]["per_material"].items()
        },
        "baselines": {
            label: _by_role(baseline["splits"]) for label, baseline in metrics["baselines"].items()
        },
    }
    whole = composed("train", ["+exp=unseen4", *given])
    seen = list(whole.split.seen)

    def on(keep: Any, *over: str, half: bool = False) -> list[_Scored]:
        config = composed("train", ["+exp=unseen4", *given, *over]) if over else whole
        made = features_of_some(config, cache, keep)
        return [_scored(detector, each, half=half) for each in made]

    having = partial(_having, whole)

    def later(first: int) -> Callable[[RecordingSource], list[RecordingId]]:
        return lambda source: [r for r in source.ids if r.cycle >= first]

    def by_side(parts: Sequence[_Scored], measure: str, *, truth: bool) -> None:
        for side in SIDES:
            own = [p for p in parts if (p.recording.material in seen) == (side == "seen")]
            found[measure.format(side)] = _called_slip(own, truth=truth)

    for role, label, name in (
        ("test", "test", "test"),
        ("unseen", "held out", "held-out materials"),
    ):
        every, without = on(having(**{role: 99})), on(having(**{role: 99}), half=True)
        found[name] = _balanced(every)
        found[f"calibration error, {label}"] = _calibration_error(every)
        found[f"half of the channels missing, {label}"] = _balanced(without)
        found[f"calibration error, half missing, {label}"] = _calibration_error(without)
    num, few = sizes.evaluated, -(-sizes.evaluated // 2)
    over = [f"data.materials=[{','.join(seen)}]", "data.sessions=3", f"data.cycles={num + 1}"]
    sessions = on(lambda source: [r for r in source.ids if r.session], *over)
    found["another session"] = _balanced(sessions)
    by_pair: dict[str, list[_Scored]] = {}
    for one in sorted(sessions, key=lambda one: one.recording):
        pair = f"{one.recording.material}, session {one.recording.session}"
        by_pair.setdefault(pair, []).append(one)
    found["sessions by pair"] = {pair: _balanced(parts) for pair, parts in by_pair.items()}
    found["another session, worst pair"] = min(found["sessions by pair"].values())
    arm = on(later(6), "scene=arm_motion", f"data.cycles={6 + num}")
    by_side(arm, "moving arm called slip, {}", truth=False)
    pulled = on(later(4), "scene=pulled", f"data.cycles={4 + num}")
    by_side(pulled, "pulled object found, {}", truth=True)
    for mv in sizes.levels_mv:
        loud = f"+scene.motor_vibration_mv={mv}"
        slips = on(having(test=few, unseen=few + 1), loud)
        by_side(slips, LOUD.format(mv, "{}"), truth=True)
        arm = on(later(6), "scene=arm_motion", f"data.cycles={6 + few}", loud)
        by_side(arm, LOUD_ARM.format(mv, "{}"), truth=False)
    return found


def _on_hard(name: str, given: Sequence[str], job: Job, sizes: Generalisation) -> dict[str, Any]:
    """Balanced accuracies of recipes and baselines on ``+exp=hard``, %."""
    found: dict[str, dict[str, float]] = {}
    baselines: dict[str, Any] = {}
    for recipe in sizes.recipes:
        folder = job.folder / f"{name}-{recipe}-{given[0]}".replace("=", "-")
        over = [f"+exp={name}", f"recipe={recipe}", *given]
        metrics = trained(over, folder, job.folder / "cache")
        own = _by_role(metrics["splits"])
        if not found:
            own["nested validation"] = _nested(metrics)
            baselines = metrics["baselines"]
        found[f"recipe={recipe}"] = own
    return found | {BASELINES.get(n, n): _by_role(of["splits"]) for n, of in baselines.items()}


def _with_few(num: int, given: Sequence[str], job: Job) -> dict[str, float]:
    """Balanced accuracies of a detector of few numbers, with all and half of the channels, %."""
    folder, cache = job.folder / f"{num}-numbers-{given[0]}".replace("=", "-"), job.folder / "cache"
    metrics = trained(["+exp=unseen4", f"recipe.num_features={num}", *given], folder, cache)
    detector = SlipDetector.load(folder / "detector.pt")
    whole = composed("train", ["+exp=unseen4", *given])
    found = {"numbers in all": float(len(metrics["selected"]))}
    for role, label in (("test", "test"), ("unseen", "held-out materials")):
        for half, words in ((False, ""), (True, ", half of the channels missing")):
            made = features_of_some(whole, cache, _having(whole, **{role: 99}))
            found[label + words] = _balanced([_scored(detector, one, half=half) for one in made])
    return found


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Values of each key over rows."""
    return {key: [row[key] for row in rows] for key in rows[0]}


def _nested(metrics: Mapping[str, Any]) -> float:
    return 100 * float((metrics.get("nested_validation") or {}).get("mean", math.nan))


def _by_role(splits: Mapping[str, Any]) -> dict[str, float]:
    """Balanced accuracies, %, of the roles that have both classes."""
    found = {role: scores["balanced_accuracy"] for role, scores in splits.items()}
    return {role: 100 * value for role, value in found.items() if value is not None}


# Tables ------------------------------------------------------------------------------------------
def _over(own: Mapping[str, Any], measure: str) -> list[float]:
    return [of[measure] for of in own.values()]


def _levels_mv(own: Mapping[str, Any]) -> list[float]:
    """Of motor vibration that was measured."""
    measures = next(iter(own.values()))
    found = [re.match(r"slips at (\S+) mV found, seen", measure) for measure in measures]
    return [float(level[1]) for level in found if level]


def _measures(own: Mapping[str, Any], name: str) -> list[dict[str, object]]:
    """Mean and worst over seeds of each measure of an experiment, beside what was wanted."""
    rows: list[dict[str, object]] = []
    for measure, value in next(iter(own.values())).items():
        if not isinstance(value, float):
            continue
        values = _over(own, measure)
        at_most = "called slip" in measure or "error" in measure  # is better when it is smaller
        worst, sign = (max(values), -1) if at_most else (min(values), 1)
        asked = LIMITS[name].get(measure, ())
        pairs = zip((fmean(values), worst), asked, strict=False)
        met = "met" if all(sign * of >= sign * wanted for of, wanted in pairs) else "**missed**"
        texts = [f"({of:g})" if place else f"{of:g}" for place, of in enumerate(asked)]
        row = {"measure": measure, "mean ± sd": mean_sd(values), "worst": f"{worst:.2f}"}
        rows.append(row | {"limit (worst)": " ".join(texts), "": met if asked else ""})
    return rows


def _validation(own: Mapping[str, Any]) -> str:
    """Nested validation beside held-out materials, and slips beside a vibrating motor."""
    below = fmean(_over(own, "held-out materials")) - fmean(_over(own, "nested validation"))
    found = {mv: fmean(_over(own, LOUD.format(mv, "held out"))) for mv in _levels_mv(own)}
    loud = ", ".join(f"{of:.1f} % at {mv:g} mV" for mv, of in found.items())
    return (
        f"Nested validation is {below:.2f} points below the accuracy on held-out materials "
        f"(limits: -0.5 to 2). Slips found on held-out materials beside motor vibration: {loud}."
    )


def _by_seed(own: Mapping[str, Any]) -> list[dict[str, object]]:
    """Validation beside the truth, seed by seed."""
    rows: list[dict[str, object]] = []
    for seed, of in own.items():
        row: dict[str, object] = {"seed": seed}
        for key in ("nested validation", "held-out materials"):
            row[key] = f"{of[key]:.2f}"
        for title, key in (("material", "per material"), ("session", "sessions by pair")):
            worst = min(of[key], key=of[key].__getitem__)
            row[f"worst {title}"] = f"{worst} {of[key][worst]:.2f}"
        rows.append(row)
    return rows


def _rows(by_seed: Sequence[Mapping[str, Any]], roles: Sequence[str]) -> list[dict[str, object]]:
    """Mean and worst over seeds of each role, by baseline or recipe."""
    rows: list[dict[str, object]] = []
    for label in by_seed[0]:
        row: dict[str, object] = {"": BASELINES.get(label, label)}
        for role in roles:
            known = [of[label][role] for of in by_seed if role in of[label]]
            text = f"{fmean(known):.2f} (worst {min(known):.2f})" if known else ""
            row["held-out materials" if role == "unseen" else role] = text
        rows.append(row)
    return rows


def _ahead(by_seed: Sequence[Mapping[str, Any]]) -> str:
    """Which baselines the first recipe is behind."""
    means = {label: fmean(of[label]["unseen"] for of in by_seed) for label in by_seed[0]}
    ours = next(iter(means))
    ahead = [label for label in means if "recipe" not in label and means[label] >= means[ours]]
    place = f"behind {', '.join(ahead)}" if ahead else "ahead of every baseline"
    return f"On held-out materials `{ours}` is {place}."


if __name__ == "__main__":
    raise SystemExit(Generalisation().run())
