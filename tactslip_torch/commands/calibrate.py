"""Where on the line of difficulty to try next: a bracketed search that stays where facts hold.

What is searched for costs a minute a point, so the search is a function of the points tried.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

import tactslip_torch
from tactslip_torch.analysis.signal_checks import Signals, filtered, judge_facts
from tactslip_torch.commands.entry import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.features.survey import Survey
from tactslip_torch.report import published
from tactslip_torch.report.calibration import calibration_figure, calibration_table, point_line
from tactslip_torch.runtime import bar, whole_file
from tactslip_torch.simulation.parameters import (
    CALIBRATED_PATH,
    PRIORS,
    SEEN_MATERIALS,
    parameters_at,
)
from tactslip_torch.simulation.scene import SIMULATION_VERSION
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import feature_parts, save_config
from tactslip_torch.training.fitting import TrainingPass
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.selection import plan_detector

RESOLUTION = 0.02
"""How closely a target is bracketed on the line of difficulty."""

FACTS_RESOLUTION = 0.1
"""How closely the place is bracketed where the facts begin to fail."""


@dataclass(frozen=True)
class Point:
    """One place on the line of difficulty that was tried.

    Args:
        difficulty: prior standard deviations from the starting values.
        accuracy: seen-material test accuracy, the mean over seeds.
        holds: whether all qualitative facts hold.
    """

    difficulty: float
    accuracy: float
    holds: bool


def next_difficulty(
    points: Sequence[Point],
    target: float,
    tolerance: float,
    bounds: tuple[float, float],
    step: float = 1.0,
) -> float | None:
    """Where to try next, or ``None`` when there is nothing left to try.

    Begins at 0 and steps towards the target until it is crossed, the facts fail or the bound is
    reached; then narrows the bracket, by a secant kept off its ends if it crosses the target, by
    halves if facts alone fail at its far end. Of points where the facts fail none is returned to.
    Places are whole hundredths, except a bound that is none; a step is ``RESOLUTION`` or more.

    Example:
        >>> next_difficulty([Point(0.0, 0.99, True)], 0.96, 0.001, (-3, 3))
        1.0
        >>> tried = [Point(0.0, 0.99, True), Point(1.0, 0.95, True)]
        >>> next_difficulty(tried, 0.96, 0.001, (-3, 3))
        0.75
    """
    if not points:
        return 0.0
    start = min(points, key=lambda point: abs(point.difficulty))
    if not start.holds or any(_is_met(point, target, tolerance) for point in points):
        return None
    way = 1 if start.accuracy > target else -1
    bound = abs(bounds[1] if way > 0 else bounds[0])
    ahead = sorted((point for point in points), key=lambda point: way * point.difficulty)
    near = start
    for point in ahead:
        if way * point.difficulty <= way * near.difficulty:
            continue
        if not (point.holds and way * (point.accuracy - target) > 0):
            return _between(near, point, target, way)
        near = point
    reached = way * near.difficulty
    if reached >= bound:
        return None
    return way * min(round(reached + max(step, RESOLUTION), 2), bound)


def _is_met(point: Point, target: float, tolerance: float) -> bool:
    return point.holds and abs(point.accuracy - target) <= tolerance


def _between(near: Point, far: Point, target: float, way: int) -> float | None:
    """A place within the bracket, or ``None`` if it is too narrow."""
    low, high = way * near.difficulty, way * far.difficulty
    crosses = way * (far.accuracy - target) <= 0
    if high - low <= (RESOLUTION if crosses else FACTS_RESOLUTION):
        return None
    share = 0.5
    if crosses:
        share = (near.accuracy - target) / (near.accuracy - far.accuracy)
    place = low + min(max(share, 0.1), 0.9) * (high - low)
    return way * round(min(max(place, low + RESOLUTION / 2), high - RESOLUTION / 2), 2)


def chosen_point(points: Sequence[Point], target: float) -> int | None:
    """Index of the point to keep: the closest to the target of those where the facts hold."""
    holding = [index for index, point in enumerate(points) if point.holds]
    if not holding:
        return None
    return min(holding, key=lambda i: (abs(points[i].accuracy - target), abs(points[i].difficulty)))


FIRST_SEED = 1000
"""Seeds below are for results that are reported, those from here on for calibration."""


def seen_accuracy(maker: FeatureMaker, data: SlipDataModule, recipe: Recipe, what: str) -> float:
    """Accuracy on the test bins of a split, as ``train`` reports it: the same passes in memory."""
    kept = []
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the processors belong to those who make features
    for batch in bar(data.loader(["train", "test"]), what, "recording"):
        roles = data.split.bin_roles(batch.recording, len(batch.is_slip))
        # copies: what workers hand over holds a file open
        kept.append((batch.recording, batch.features.clone(), batch.is_slip.clone(), roles))
    torch.set_num_threads(num_threads)
    survey = Survey(len(maker.pool.names), recipe.sample_bins)
    training = [
        (recording, features[roles["train"]], is_slip[roles["train"]])
        for recording, features, is_slip, roles in kept
        if bool(roles["train"].any())
    ]
    for recording, features, is_slip in training:
        survey.update(str(recording), recipe.group(recording), features, is_slip)
    allowed = recipe.allowed(maker.pool)
    plan = plan_detector(recipe, survey, _quietly, allowed=allowed)
    gathered = TrainingPass(plan)
    for recording, features, is_slip in training:
        gathered.update(str(recording), features, is_slip)
    head = gathered.solve()
    right = [
        (head(plan.frame(features[roles["test"]])) >= 0) == is_slip[roles["test"]]
        for _, features, is_slip, roles in kept
    ]
    return float(torch.cat(right).double().mean())


def evaluate_point(config: DictConfig, difficulty: float) -> dict[str, Any]:
    """Accuracy and facts at a place on the line of difficulty, JSON-able."""
    knobs = parameters_at(difficulty)
    accuracies = []
    recordings: dict[str, list[Signals]] = {}
    for seed in config.seeds:
        plain = OmegaConf.to_container(config)
        overrides = {"seed": seed, "scene": {name: _listed(knobs[name]) for name in knobs}}
        of_seed = OmegaConf.merge(OmegaConf.create(plain), overrides)
        source: RecordingSource = instantiate(of_seed.data, _convert_="all")
        rule: LabelRule = instantiate(of_seed.labels)
        recipe: Recipe = instantiate(of_seed.recipe, _convert_="all")
        (split,) = instantiate(of_seed.split, _convert_="all")(source.ids)
        parts = feature_parts(source, rule.bin_ms, **of_seed.features)
        pool, channel_filter, dtype, engine = parts
        recipe.check_pool(len(pool.names))
        maker = FeatureMaker(source, pool, channel_filter, rule, None, dtype, engine)
        data = SlipDataModule(maker, split, of_seed.num_workers)
        accuracies.append(seen_accuracy(maker, data, recipe, f"d {difficulty:+.2f}, seed {seed}"))
        for recording in source.ids:
            if recording.cycle < config.fact_cycles:
                signals = filtered(source.load(recording), source.hand)
                recordings.setdefault(recording.material, []).append(signals)
    facts = judge_facts(recordings)
    return {
        "difficulty": difficulty,
        "knobs": {name: _listed(value) for name, value in knobs.items()},
        "accuracy": sum(accuracies) / len(accuracies),
        "accuracy_by_seed": accuracies,
        "holds": all(fact["holds"] for fact in facts),
        "facts": facts,
    }


def calibrate(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Search the line of difficulty and write what was found.

    Args:
        config: composed from ``conf/calibrate.yaml``.
        folder: where results go.

    Returns:
        The content of ``calibration.json``.

    Raises:
        ValueError: for bad input, or if the facts fail at the starting values, in one line.
    """
    _check(config)
    target = published.SPLITS["test"].accuracy
    save_config(config, folder)
    tried: list[dict[str, Any]] = []
    points: list[Point] = []
    for _ in range(config.most_points):
        low, high = config.bounds
        place = next_difficulty(points, target, config.tolerance, (low, high), config.step)
        if place is None:
            break
        tried.append(evaluate_point(config, place))
        points.append(Point(place, tried[-1]["accuracy"], tried[-1]["holds"]))
        print(point_line(tried[-1]), flush=True)
    index = chosen_point(points, target)
    if index is None:
        failed = [fact["name"] for fact in tried[0]["facts"] if not fact["holds"]]
        raise ValueError(
            f"the facts {', '.join(failed)} do not hold at the starting values, so there is no "
            "point to calibrate from; raise fact_cycles, or mend the simulation"
        )
    found = _found(config, tried, index, target)
    text = json.dumps(found, indent=1, allow_nan=False) + "\n"
    paths = [folder / "calibration.json"] + ([CALIBRATED_PATH] if config.write else [])
    for path in paths:
        with whole_file(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    calibration_figure(found, folder / "calibration.png")
    print("\n" + calibration_table(found))
    print(f"\nresults in {folder}" + (f", frozen in {CALIBRATED_PATH}" if config.write else ""))
    return found


def _check(config: DictConfig) -> None:
    """Refuse what would not be a calibration."""
    strangers = [m for m in config.data.materials if m not in SEEN_MATERIALS]
    if strangers:
        raise ValueError(
            f"calibration simulates seen materials only, {', '.join(SEEN_MATERIALS)}; "
            f"got {', '.join(strangers)}"
        )
    seeds = config.seeds
    if not isinstance(seeds, ListConfig) or any(type(seed) is not int for seed in seeds):
        raise ValueError(f"seeds must be a list of whole numbers, such as [1000,1001], got {seeds}")
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < FIRST_SEED:
        raise ValueError(
            f"seeds must differ and be {FIRST_SEED} or more, those below are for reported "
            f"results; got {seeds}"
        )
    bounds = config.bounds
    ends = bounds if isinstance(bounds, ListConfig) else ()
    if len(ends) != 2 or any(type(end) not in (int, float) for end in ends):
        raise ValueError(f"bounds must be two numbers, such as [-2,2], got {bounds}")
    if not bounds[0] <= 0 <= bounds[1]:
        raise ValueError(f"bounds must hold 0, the starting values; got {bounds}")
    for name in ("tolerance", "step"):
        if type(config[name]) not in (int, float) or not 0 < config[name] < math.inf:
            raise ValueError(f"{name} must be a positive number, got {config[name]}")
    for name in ("most_points", "fact_cycles"):
        if type(config[name]) is not int or config[name] < 1:
            raise ValueError(f"{name} must be a positive whole number, got {config[name]}")
    if config.write and (changed := _changed_sections(config)):
        raise ValueError(
            f"write=true freezes what the protocol of conf/calibrate.yaml finds, and "
            f"{', '.join(changed)} differ from it; leave those overrides out, or write=true"
        )


def _changed_sections(config: DictConfig) -> list[str]:
    """Groups of the configuration that are not as ``conf/calibrate.yaml`` composes them."""
    own: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / "calibrate.yaml"))
    options = {k: v for entry in own["defaults"] if entry != "_self_" for k, v in entry.items()}
    groups: Any = {k: OmegaConf.load(conf_dir() / k / f"{v}.yaml") for k, v in options.items()}
    whole: Any = OmegaConf.to_container(OmegaConf.merge(groups, own))
    given: Any = OmegaConf.to_container(config)  # unresolved: seeds come in turn
    return [group for group in groups if given[group] != whole[group]]


def _found(
    config: DictConfig, tried: list[dict[str, Any]], index: int, target: float
) -> dict[str, Any]:
    """The content of ``calibration.json``: no time and no path, so that its bytes repeat."""
    kept = tried[index]
    protocol = OmegaConf.to_container(config, resolve=True)
    assert isinstance(protocol, dict)
    groups = ("data", "labels", "split", "features", "recipe")
    numbers = ("tolerance", "bounds", "step", "most_points", "fact_cycles")
    return {
        "simulated": True,
        "provenance": (
            "python -m tactslip_torch calibrate: test accuracy on simulated seen materials held "
            "against the published one, and the qualitative facts; nothing else"
        ),
        "values": kept["knobs"],
        "difficulty": kept["difficulty"],
        "accuracy": kept["accuracy"],
        "target": {
            "accuracy": target,
            "row": "test, six seen materials",
            "source": published.PAPER,
        },
        "verdict": _verdict(tried, kept, target, config),
        "seeds": list(config.seeds),
        "priors": {
            name: asdict(prior) | {"start": _listed(prior.start)} for name, prior in PRIORS.items()
        },
        "facts": kept["facts"],
        "points": tried,
        "protocol": {name: protocol[name] for name in groups + numbers},
        "versions": {
            "tactslip_torch": tactslip_torch.__version__,
            "simulation": SIMULATION_VERSION,
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def _verdict(
    tried: Sequence[Mapping[str, Any]], kept: Mapping[str, Any], target: float, config: DictConfig
) -> str:
    """Whether the target was met, and else why not and by how much."""
    missing = kept["accuracy"] - target
    if abs(missing) <= config.tolerance:
        return f"met within {100 * config.tolerance:g} points"
    way = 1 if missing > 0 else -1
    beyond = [row for row in tried if way * (row["difficulty"] - kept["difficulty"]) > 0]
    if any(not row["holds"] for row in beyond):
        nearest = min(
            (row for row in beyond if not row["holds"]),
            key=lambda row: abs(row["difficulty"] - kept["difficulty"]),
        )
        failed = ", ".join(fact["name"] for fact in nearest["facts"] if not fact["holds"])
        why = f"cut back: at d {nearest['difficulty']:+.2f} the facts {failed} do not hold"
    elif kept["difficulty"] in tuple(config.bounds):
        why = "the bound of d is reached"
    else:
        why = "no point tried is closer"
    return f"{100 * missing:+.2f} points from the target: {why}"


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="calibrate")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        calibrate(config, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    run_entry_point(main)
