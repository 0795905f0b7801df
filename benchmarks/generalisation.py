"""How a detector holds on what it was not trained on: ``python -m benchmarks.generalisation``.

Trains ``+exp=unseen4`` and ``+exp=deploy`` with several seeds and evaluates each detector, as it
stands, on test cycles, held-out materials, the same materials in other sessions, a moving arm
without slip, objects that are pulled, motor vibration of 1 to 30 mV, and with a random half of the
channels missing. Trains ``+exp=hard`` with each recipe. Nothing is chosen on any of these. All data
are simulated. What a seed gave is kept, so a run that was stopped resumes.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks import ROOT
from benchmarks.harness import (
    LIGHT,
    OURS,
    PEER,
    Benchmark,
    Job,
    Report,
    Table,
    between_markers,
    code_digest,
    trained,
    write_text,
)
from benchmarks.subjects import composed
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split, unseen4
from tactslip_torch.features.bin_sample import bin_keys
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import calibration_of
from tactslip_torch.report.results import BASELINES, splits_table
from tactslip_torch.runtime import bar
from tactslip_torch.training.datamodule import RecordingFeatures, SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_maker

SEEN = ("M1", "M2", "M3", "M4", "M5", "M6")
LEVELS_MV = (1.0, 3.0, 10.0, 30.0)
HARD_RECIPES = ("general", "robust", "paper")
LIMITS: dict[str, dict[str, tuple[float, float | None]]] = {
    "unseen4": {
        "test": (98.9, 98.6),
        "held-out materials": (98.5, 97.5),
        "another session": (98.0, None),
        "moving arm called slip, seen": (2.0, None),
        "moving arm called slip, held out": (3.0, None),
        "pulled object found, seen": (99.0, None),
        "pulled object found, held out": (99.0, None),
        "half of the channels missing, test": (97.5, None),
        "half of the channels missing, held out": (96.5, None),
        "calibration error, half missing, test": (2.0, None),
    },
    "deploy": {
        "moving arm called slip, seen": (2.0, None),
        "moving arm called slip, held out": (2.0, None),
        **{f"slips at {mv:g} mV found, held out": (90.0, None) for mv in LEVELS_MV},
        **{f"moving arm at {mv:g} mV called slip, held out": (4.0, None) for mv in LEVELS_MV},
    },
}
"""By experiment and measure: wanted of the mean over seeds, and of the worst seed. Of what is
called slip, and of errors, at most; of the others at least."""


@dataclass(frozen=True)
class Sizes:
    """Seeds of each experiment, and overrides of every training and set of recordings."""

    unseen4: tuple[int, ...] = (0, 1, 2, 3, 4)
    deploy: tuple[int, ...] = (0, 1, 2, 3, 4)
    hard: tuple[int, ...] = (0, 1, 2, 3, 4)
    overrides: tuple[str, ...] = ()


class Generalisation(Benchmark[Sizes]):
    """Every experiment with every seed."""

    name = "generalisation"
    title = "Generalisation: materials, sessions, arms and sensors that were not trained on"
    about = "detectors on what they were not trained on, several seeds"
    page = "docs/generalisation.md"
    sizes = Sizes()
    quick = Sizes((0,), (), (0,), ("data.cycles=5",))

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """All measures of each seed, and what the main job prints."""
        found: dict[str, Any] = {"code": {}, "experiments": {}, "hard": {}}
        small, cache = [*job.sizes.overrides, *job.overrides], job.folder / "cache"
        for name in ("unseen4", "deploy", "hard"):
            for seed in getattr(job.sizes, name):
                kept = job.folder / f"measures-{name}-{seed}.json"
                of = json.loads(kept.read_text()) if kept.exists() else {}
                if of.get("code") != code_digest():
                    run = hard_run if name == "hard" else seed_run
                    of = {"code": code_digest(), "of": run(name, seed, job.folder, cache, small)}
                    write_text(kept, json.dumps(of) + "\n")
                place = found if name == "hard" else found["experiments"]
                place.setdefault(name, {})[str(seed)] = of["of"]
                found["code"][name] = of["code"]
        metrics = json.loads((job.folder / "unseen4-0" / "metrics.json").read_text())
        return found | {"main job": splits_table(metrics)}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Measures, seed by seed and baselines of each experiment; recipes on the hard hand."""
        found = {}
        for name, own in numbers["experiments"].items():
            chosen = "; ".join(f"seed {seed}: {of['chosen']}" for seed, of in own.items())
            note = f"{_about(numbers, name)} Chosen: {chosen}."
            found[f"`+exp={name}`"] = Table.of(_measures(own, name), note)
            found[f"`+exp={name}`, seed by seed"] = Table.of(_by_seed(own), _validation(own, name))
            baselines = [of["baselines"] for of in own.values()]
            found[f"`+exp={name}`, baselines"] = Table.of(_rows(baselines, ("test", "unseen")))
        if hard := numbers["hard"]:
            rows = _rows(list(hard.values()), ("nested validation", "test", "unseen"))
            found["`+exp=hard`"] = Table.of(rows, f"{_about(numbers, 'hard')} {_ahead(hard)}")
        return found

    def section(self, report: Report) -> str:
        """The whole page."""
        parts = [
            "Written by `python -m benchmarks.generalisation`; no number is typed by hand. All "
            "data are **simulated**. Balanced accuracy in %, unless a row says otherwise. "
            "Everything was chosen by validation on training materials. *Worst* is the worst seed; "
            "*wanted* was set before. Baselines were fitted on the same training bins. `+exp=hard` "
            "is the protocol on a simulated hand whose channels differ without slip, as real ones "
            "do ([how it was held against a real one](../benchmarks/results/realism.json): "
            "`python -m benchmarks.realism`).",
            "![Measures by seed](../benchmarks/results/generalisation.png)",
        ]
        for title, table in self.tables(report["numbers"]).items():
            parts += [f"## {title}", table.markdown()]
        return "\n\n".join(parts)

    def publish(self, report: Report, folder: Path) -> None:
        """The page, and README's first result: what the main job prints, and all seeds."""
        super().publish(report, folder)
        if report["quick"]:
            return
        numbers = report["numbers"]
        rows = {
            row["measure"]: row for row in summary(numbers["experiments"]["unseen4"], "unseen4")
        }
        told = []
        for measure in ("test", "held-out materials", "another session"):
            seeds = ", ".join(f"{value:.2f}" for value in rows[measure]["by_seed"])
            told.append({"": measure, "mean ± sd": rows[measure]["mean ± sd"], "by seed": seeds})
        lines = [
            "It prints among others (seed 0, `python -m benchmarks.generalisation`, code "
            f"{numbers['code']['unseen4']}):\n",
            f"```\n{numbers['main job']}\n```\n",
            f"Balanced accuracy, %, {len(rows['test']['by_seed'])} seeds, **simulated**. *Unseen*",
            "are held-out materials, *another session* another mounting of the six seen ones:\n",
            Table.of(told).markdown(),
        ]
        path = ROOT / "README.md"
        text = between_markers(path.read_text(encoding="utf-8"), "first result", "\n".join(lines))
        write_text(path, text)

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Vibration: slips found and false slips, by level, and accuracies by seed."""
        drawing.set_size_inches(12, 3.8)
        found, called, by_seed = drawing.subplots(1, 3)
        labels = ["test", "held-out materials", "another session"]
        for (name, own), color in zip(numbers["experiments"].items(), (OURS, PEER), strict=False):
            rows = {row["measure"]: row for row in summary(own, name)}
            for axes, measure in (
                (found, "slips at {:g} mV found"),
                (called, "moving arm at {:g} mV called slip"),
            ):
                for side, style in (("seen", "--"), ("held out", "-")):
                    means = [rows[f"{measure.format(mv)}, {side}"]["mean"] for mv in LEVELS_MV]
                    text = f"{name}, {side}"
                    axes.plot(LEVELS_MV, means, style, marker="o", color=color, label=text)
            for place, label in enumerate(labels):
                values = rows[label]["by_seed"]
                at = place + (0.12 if color == PEER else -0.12)
                by_seed.plot([at] * len(values), values, "o", color=color, alpha=0.7)
        by_seed.set_xticks(range(3), [label.replace(" ", "\n") for label in labels])
        by_seed.set_title("balanced accuracy, %, a dot a seed", fontsize=10)
        for axes, title in ((found, "slips found, %"), (called, "moving arm called slip, %")):
            axes.set_xscale("log")
            axes.set_xticks(LEVELS_MV, [f"{mv:g}" for mv in LEVELS_MV])
            axes.set_xlabel("motor vibration, mV")
            axes.set_title(f"{title} of bins", fontsize=10)
            axes.set_ylim(bottom=0)
            axes.grid(color=LIGHT)
        found.set_ylim(0, 101)
        found.legend(fontsize=8, handlelength=3.5, frameon=False)


# What a detector says ----------------------------------------------------------------------------
@dataclass(frozen=True)
class Scored:
    """What a detector says of one recording."""

    recording: RecordingId
    truth: Tensor
    score: Tensor
    probability: Tensor | None


def is_at_most(measure: str) -> bool:
    """Whether a measure is better when it is smaller."""
    return "called slip" in measure or "error" in measure


def recordings(
    config: Any, cache: Path, keep: Callable[[RecordingSource], Sequence[RecordingId]], what: str
) -> Iterator[RecordingFeatures]:
    """The features of some recordings of a set."""
    source = instantiate(config.data, _convert_="all")
    rule = instantiate(config.labels)
    maker = feature_maker(source, rule, **config.features)
    chosen = keep(source)
    torch.set_num_threads(1)  # the processors belong to those who make features
    with feature_cache(str(cache)) as maker.cache:
        data = SlipDataModule(maker, Split("benchmark", dict.fromkeys(chosen, "unseen")), None)
        yield from bar(data.loader(["unseen"]), what, "recording", total=len(chosen))


def scored(detector: SlipDetector, made: RecordingFeatures, *, half: bool = False) -> Scored:
    """Scores of a recording, on request without a random half of the channels."""
    features = made.features[:, list(detector.selected)].double()
    is_missing = None
    if half:
        num = len(detector.pool.hand)
        order = bin_keys(f"{made.recording} missing", num).argsort()
        is_missing = torch.zeros(num, dtype=torch.bool)
        is_missing[order[: num // 2]] = True
        is_missing = is_missing.expand(len(features), num)
    with torch.no_grad():
        score = detector.head(detector.scaler(detector.columns(features, is_missing)))
    found = calibration_of(detector)
    probability = None
    if found is not None:
        calibration, slip_share = found
        llr = calibration.llr(score)
        probability = torch.sigmoid(llr + math.log(slip_share / (1 - slip_share)))
    return Scored(made.recording, made.is_slip, score, probability)


def balanced(parts: Sequence[Scored]) -> float:
    """Balanced accuracy of some recordings together, %."""
    truth = torch.cat([part.truth for part in parts])
    says = torch.cat([part.score for part in parts]) >= 0
    recalls = [(says == truth)[truth == kind].double().mean() for kind in (False, True)]
    return 100 * float(sum(recalls)) / 2


def called_slip(parts: Sequence[Scored], *, truth: bool) -> float:
    """Part of the bins of a class that is called slip, %."""
    says = torch.cat([part.score[part.truth == truth] >= 0 for part in parts])
    return 100 * float(says.double().mean())


def calibration_error(parts: Sequence[Scored], num_bins: int = 15) -> float:
    """Expected calibration error of the probability of slip, %, classes weighed as stated."""
    probability = torch.cat([p.probability for p in parts if p.probability is not None])
    truth = torch.cat([p.truth for p in parts if p.probability is not None]).double()
    if not len(probability):
        return math.nan
    places = (probability * num_bins).long().clamp(max=num_bins - 1)
    total = 0.0
    for place in range(num_bins):
        mine = places == place
        if bool(mine.any()):
            total += abs(float((truth[mine] - probability[mine]).sum()))
    return 100 * total / len(truth)


def first_of(source: RecordingSource, role: str, seed: int, num: int) -> list[RecordingId]:
    """The first recordings of each material with a role in ``unseen4``."""
    held_out = [m for m in dict.fromkeys(r.material for r in source.ids) if m not in SEEN]
    split = unseen4(source.ids, seen=SEEN, unseen=held_out, seed=seed)[0]
    found: list[RecordingId] = []
    for material in dict.fromkeys(r.material for r in source.ids):
        own = [r for r in split.having(role) if r.material == material]
        found += own[:num]
    return found


def seed_run(
    name: str, seed: int, folder: Path, cache: Path, small: Sequence[str]
) -> dict[str, Any]:
    """All measures of an experiment with one seed."""
    place = folder / f"{name}-{seed}"
    overrides = [f"+exp={name}", f"seed={seed}", *small]
    metrics = trained(f"{name}, seed {seed}", overrides, place, cache)
    detector = SlipDetector.load(place / "detector.pt")
    nested = metrics.get("nested_validation") or {}
    chosen = next(row for row in metrics["validation"] if row.get("chosen"))
    found: dict[str, Any] = {
        "nested validation": 100 * nested.get("mean", math.nan),
        "chosen": f"{chosen['use']}, {chosen['num_features'] or 'all'}, degree "
        f"{chosen['kernel']['degree']}, C={chosen['penalty']:g}",
        "numbers": len(metrics["selected"]),
        "per material": {
            m: 100 * s["balanced_accuracy"]
            for m, s in metrics["splits"]["unseen"]["per_material"].items()
        },
        "baselines": {
            label: _by_role(baseline["splits"]) for label, baseline in metrics["baselines"].items()
        },
    }

    def on(what: str, over: Sequence[str], keep: Any, *, half: bool = False) -> list[Scored]:
        config = composed("train", ["+exp=unseen4", f"seed={seed}", *small, *over])
        made = recordings(config, cache, keep, f"seed {seed}, {what}")
        return [scored(detector, each, half=half) for each in made]

    def having(role: str, num: int) -> Callable[[RecordingSource], list[RecordingId]]:
        return lambda source: first_of(source, role, seed, num)

    for role, label in (("test", "test"), ("unseen", "held out")):
        keep = having(role, 99)
        whole = on(f"{label}", [], keep)
        found["test" if role == "test" else "held-out materials"] = balanced(whole)
        found[f"calibration error, {label}"] = calibration_error(whole)
        missing = on(f"{label}, half missing", [], keep, half=True)
        found[f"half of the channels missing, {label}"] = balanced(missing)
        found[f"calibration error, half missing, {label}"] = calibration_error(missing)
    over = [f"data.materials=[{','.join(SEEN)}]", "data.sessions=3", "data.cycles=5"]
    sessions = on("sessions", over, lambda source: [r for r in source.ids if r.session])
    found["another session"] = balanced(sessions)
    pairs = sorted({(p.recording.material, p.recording.session) for p in sessions})
    found["sessions by pair"] = by_pair = {
        f"{material}, session {session}": balanced(
            [
                p
                for p in sessions
                if (p.recording.material, p.recording.session) == (material, session)
            ]
        )
        for material, session in pairs
    }
    found["another session, worst pair"] = min(by_pair.values())

    def later(first: int) -> Callable[[RecordingSource], list[RecordingId]]:
        return lambda source: [r for r in source.ids if r.cycle >= first]

    def by_side(parts: Sequence[Scored], measure: str, *, truth: bool) -> None:
        for is_seen, label in ((True, "seen"), (False, "held out")):
            own = [p for p in parts if (p.recording.material in SEEN) == is_seen]
            found[f"{measure}, {label}"] = called_slip(own, truth=truth)

    arm = on("moving arm", ["scene=arm_motion", "data.cycles=10"], later(6))
    by_side(arm, "moving arm called slip", truth=False)
    pulled = on("pulled", ["scene=pulled", "data.cycles=8"], later(4))
    by_side(pulled, "pulled object found", truth=True)
    for level in LEVELS_MV:
        over = [f"+scene.motor_vibration_mv={level}"]

        def some(source: RecordingSource) -> list[RecordingId]:
            return [*having("test", 2)(source), *having("unseen", 3)(source)]

        slips = on(f"slips, {level:g} mV", over, some)
        by_side(slips, f"slips at {level:g} mV found", truth=True)
        over = ["scene=arm_motion", "data.cycles=8", f"scene.motor_vibration_mv={level}"]
        arm = on(f"moving arm, {level:g} mV", [over[0], over[1], f"+{over[2]}"], later(6))
        by_side(arm, f"moving arm at {level:g} mV called slip", truth=False)
    return found


def hard_run(
    name: str, seed: int, folder: Path, cache: Path, small: Sequence[str]
) -> dict[str, Any]:
    """Balanced accuracies of recipes and baselines on ``+exp=hard`` with one seed, %."""
    found: dict[str, Any] = {}
    for recipe in HARD_RECIPES:
        over = [f"+exp={name}", f"recipe={recipe}", f"seed={seed}", *small]
        place = folder / f"{name}-{recipe}-{seed}"
        metrics = trained(f"{name}, {recipe}, seed {seed}", over, place, cache)
        found[f"recipe={recipe}"] = _by_role(metrics["splits"])
        if recipe == HARD_RECIPES[0]:
            nested = metrics.get("nested_validation") or {}
            found[f"recipe={recipe}"]["nested validation"] = 100 * nested.get("mean", math.nan)
            of_baselines = {
                BASELINES.get(label, label): _by_role(baseline["splits"])
                for label, baseline in metrics["baselines"].items()
            }
    return found | of_baselines


def _by_role(splits: Mapping[str, Any]) -> dict[str, float]:
    """Balanced accuracies, %, of the roles that have both classes."""
    return {
        role: 100 * scores["balanced_accuracy"]
        for role, scores in splits.items()
        if scores["balanced_accuracy"] is not None
    }


# Tables ------------------------------------------------------------------------------------------
def summary(own: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """Mean and worst over seeds of each measure of an experiment, beside what was wanted."""
    rows = []
    by_seed = list(own.values())
    for measure in (key for key, value in by_seed[0].items() if isinstance(value, float)):
        values = [of[measure] for of in by_seed]
        at_most = "called slip" in measure or "error" in measure  # is better when it is smaller
        mean, worst = statistics.fmean(values), (max if at_most else min)(values)
        wanted, wanted_worst = LIMITS[name].get(measure, (None, None))
        sign = -1 if at_most else 1
        asked = [(mean, wanted), (worst, wanted_worst)]
        met = all(sign * value >= sign * limit for value, limit in asked if limit is not None)
        spread = statistics.stdev(values) if len(values) > 1 else 0.0
        row: dict[str, Any] = {"measure": measure, "mean": mean, "by_seed": values, "worst": worst}
        row |= {"mean ± sd": f"{mean:.2f} ± {spread:.2f}", "met": None if wanted is None else met}
        rows.append(row | {"wanted": wanted, "wanted_worst": wanted_worst})
    return rows


def _measures(own: Mapping[str, Any], name: str) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for row in summary(own, name):
        wanted = "" if row["wanted"] is None else f"{row['wanted']:g}"
        wanted += "" if row["wanted_worst"] is None else f" ({row['wanted_worst']:g})"
        met = {None: "", True: "met", False: "**missed**"}[row["met"]]
        cells = {"measure": row["measure"], "mean ± sd": row["mean ± sd"]}
        rows.append(cells | {"worst": f"{row['worst']:.2f}", "wanted (worst)": wanted, "": met})
    return rows


def _validation(own: Mapping[str, Any], name: str) -> str:
    """Nested validation beside held-out materials, and slips beside a vibrating motor."""
    rows = {row["measure"]: row["mean"] for row in summary(own, name)}
    below = rows["held-out materials"] - rows["nested validation"]
    loud = (f"{rows[f'slips at {mv:g} mV found, held out']:.1f} % at {mv:g} mV" for mv in LEVELS_MV)
    return (
        f"Nested validation is {below:.2f} points below held-out ones (wanted: -0.5 to 2). Slips "
        f"found on held-out materials beside motor vibration: {', '.join(loud)}."
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
            text = f"{statistics.fmean(known):.2f} (worst {min(known):.2f})" if known else ""
            row["held-out materials" if role == "unseen" else role] = text
        rows.append(row)
    return rows


def _about(numbers: Report, name: str) -> str:
    own = numbers["hard"] if name == "hard" else numbers["experiments"][name]
    return f"Seeds {', '.join(own)}; code {numbers['code'][name]}."


def _ahead(hard: Mapping[str, Any]) -> str:
    """Which baselines the default recipe is behind."""
    labels, ours = next(iter(hard.values())), f"recipe={HARD_RECIPES[0]}"
    means = {
        label: statistics.fmean(of[label]["unseen"] for of in hard.values()) for label in labels
    }
    ahead = [label for label in means if "recipe" not in label and means[label] >= means[ours]]
    told = f"behind {', '.join(ahead)}" if ahead else "ahead of every baseline"
    return f"On held-out materials `{ours}` is {told}."


if __name__ == "__main__":
    raise SystemExit(Generalisation().run())
