"""Calibrate the simulated hand: ``tactslip calibrate-simulator``.

Three parameters move together along one line of difficulty (``simulation.scene``) until the
test accuracy on seen materials is the published one, but no further than the signal checks hold.
Every point that was tried is written down; with ``write=true`` the values are frozen into the
package. Unseen materials are not simulated here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from tactslip_torch.analysis.signal_checks import Signals, check_signals, filtered
from tactslip_torch.commands.configuration import Composed
from tactslip_torch.commands.entry import entry_point, leave_results, save_config
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.report import published
from tactslip_torch.report.calibration import calibration_figure, calibration_table, point_line
from tactslip_torch.runtime import __version__, bar, check_number, one_thread, plain, write_json
from tactslip_torch.simulation.scene import (
    CALIBRATED_PATH,
    PRIORS,
    SEEN_MATERIALS,
    SIMULATION_VERSION,
)
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import feature_maker
from tactslip_torch.training.plan import TrainingPass, plan_detector
from tactslip_torch.training.recipe import Recipe

_RESOLUTION = 0.02  # of difficulty, to which a target is bracketed
_CHECKS_RESOLUTION = 0.1  # of difficulty, to which the place is where the checks begin to fail
_FIRST_SEED = 1000  # seeds below are for results that are reported

Point = Mapping[str, Any]
"""A place on the line that was tried: its difficulty, its accuracy, whether all checks hold."""


def parameters_at(difficulty: float) -> dict[str, float | list[float]]:
    """The calibrated parameters at a place on the line of difficulty, JSON-able.

    Example:
        >>> parameters_at(0.0)
        {'friction_noise_mv': 8.0, 'presliding_mm': [0.3, 3.0], 'burst_rate_hz': 0.3}
    """
    values = {name: prior.at(difficulty) for name, prior in PRIORS.items()}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def search(
    evaluate: Callable[[float], Point],
    target: float,
    tolerance: float,
    bounds: Sequence[float],
    step: float = 1.0,
    most_points: int = 10,
) -> list[Point]:
    """Points on the line of difficulty, each closer to a target accuracy.

    Begins at 0 and steps towards the target until it is crossed, a check fails or the bound is
    reached; then halves the bracket. Places are whole hundredths, except a bound that is none; a
    step is ``.02`` or more.

    Args:
        evaluate: a difficulty; accuracy falls with it, roughly.
        target: accuracy.
        tolerance: of it, within which the search ends.
        bounds: of the difficulty, about 0.
        step: until the bracket is there.
        most_points: at most.

    Returns:
        All points in the order in which they were tried. Where the checks fail at 0, that one.
    """
    near = evaluate(0.0)
    points, far = [near], None
    sign = 1 if near["accuracy"] > target else -1
    bound = abs(bounds[1] if sign > 0 else bounds[0])

    def is_met(point: Point) -> bool:
        return bool(point["holds"]) and abs(point["accuracy"] - target) <= tolerance

    while near["holds"] and len(points) < most_points and not is_met(points[-1]):
        at = sign * near["difficulty"]
        if far is None:
            place = min(round(at + max(step, _RESOLUTION), 2), bound)
            if place <= at:
                break
        else:
            high, crosses = sign * far["difficulty"], sign * (far["accuracy"] - target) <= 0
            if high - at <= (_RESOLUTION if crosses else _CHECKS_RESOLUTION):
                break
            place = round((at + high) / 2, 2)
        points.append(evaluate(sign * place))
        if points[-1]["holds"] and sign * (points[-1]["accuracy"] - target) > 0:
            near = points[-1]
        else:
            far = points[-1]
    return points


def best_point(points: Sequence[Point], target: float) -> Point | None:
    """The closest to the target of the points where the checks hold, or ``None``."""
    holding = [point for point in points if point["holds"]]
    return min(
        holding, key=lambda p: (abs(p["accuracy"] - target), abs(p["difficulty"])), default=None
    )


def seen_accuracy(maker: FeatureMaker, data: SlipDataModule, recipe: Recipe, what: str) -> float:
    """Accuracy on the test bins of a split, as ``train`` reports it: the same passes in memory."""
    kept = []
    with one_thread():  # the processors belong to those who make features
        for batch in bar(data.loader(["train", "test"]), what, "recording"):
            roles = data.split.bin_roles(batch.recording, len(batch.is_slip))
            # copies: what workers hand over holds a file open
            kept.append((batch.recording, batch.features.clone(), batch.is_slip.clone(), roles))
    statistics = TrainingStatistics(len(maker.pool.names), recipe.sample_bins)
    training = [
        (recording, features[roles["train"]], is_slip[roles["train"]])
        for recording, features, is_slip, roles in kept
        if bool(roles["train"].any())
    ]
    for recording, features, is_slip in training:
        statistics.update(str(recording), recipe.group(recording), features, is_slip)
    plan = plan_detector(recipe, statistics, maker.pool)
    gathered = TrainingPass(plan)
    for recording, features, is_slip in training:
        gathered.update(str(recording), features, is_slip)
    head = gathered.solve()
    right = [
        (head(plan.selection(features[roles["test"]])) >= 0) == is_slip[roles["test"]]
        for _, features, is_slip, roles in kept
    ]
    return float(torch.cat(right).double().mean())


def evaluate_point(config: DictConfig, difficulty: float) -> dict[str, Any]:
    """Accuracy and signal checks at a place on the line of difficulty, JSON-able."""
    parameters = parameters_at(difficulty)
    accuracies = []
    recordings: dict[str, list[Signals]] = {}
    for seed in config.seeds:
        overrides = {"seed": seed, "scene": parameters}
        of_seed = OmegaConf.merge(OmegaConf.create(OmegaConf.to_container(config)), overrides)
        source: RecordingSource = instantiate(of_seed.data, _convert_="all")
        rule: LabelRule = instantiate(of_seed.labels)
        recipe: Recipe = instantiate(of_seed.recipe, _convert_="all")
        (split,) = instantiate(of_seed.split, _convert_="all")(source.ids)
        maker = feature_maker(source, rule, **of_seed.features)
        recipe.check_pool(len(maker.pool.names))
        data = SlipDataModule(maker, split, of_seed.num_workers)
        accuracies.append(seen_accuracy(maker, data, recipe, f"d {difficulty:+.2f}, seed {seed}"))
        for recording in source.ids:
            if recording.cycle < config.check_cycles:
                signals = filtered(source.load(recording), source.hand)
                recordings.setdefault(recording.material, []).append(signals)
    checks = check_signals(recordings)
    return {
        "difficulty": difficulty,
        "parameters": parameters,
        "accuracy": sum(accuracies) / len(accuracies),
        "accuracy_by_seed": accuracies,
        "holds": all(check["holds"] for check in checks),
        "signal_checks": checks,
    }


def calibrate(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Search the line of difficulty; write every point that was tried and the one that is kept.

    Args:
        config: composed from ``conf/calibrate_simulator.yaml``.
        folder: where results go.

    Returns:
        The content of ``calibration.json``.

    Raises:
        ValueError: for bad input, or if the checks fail at the starting values, in one line.
    """
    _check(config)
    target = published.SPLITS["test"].accuracy
    save_config(config, folder)

    def evaluate(difficulty: float) -> Point:
        point = evaluate_point(config, difficulty)
        print(point_line(point), flush=True)
        return point

    points = search(
        evaluate, target, config.tolerance, config.bounds, config.step, config.most_points
    )
    kept = best_point(points, target)
    if kept is None:
        raise ValueError(
            f"the signal checks {_failed(points[0])} do not hold at the starting values, so there "
            "is no point to calibrate from; raise check_cycles, or mend the simulation"
        )
    content: dict[str, Any] = plain(_content(config, points, kept, target))
    leave_results(folder, "calibration", content, calibration_figure, calibration_table(content))
    if config.write:
        write_json(CALIBRATED_PATH, content)
        print(f"frozen in {CALIBRATED_PATH}")
    return content


def _check(config: DictConfig) -> None:
    """Refuse what would not be a calibration."""
    if unseen := [m for m in config.data.materials if m not in SEEN_MATERIALS]:
        raise ValueError(
            f"calibration simulates seen materials only, {', '.join(SEEN_MATERIALS)}; "
            f"got {', '.join(unseen)}"
        )
    seeds = config.seeds
    if not isinstance(seeds, ListConfig) or any(type(seed) is not int for seed in seeds):
        raise ValueError(f"seeds must be a list of whole numbers, such as [1000,1001], got {seeds}")
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < _FIRST_SEED:
        raise ValueError(
            f"seeds must differ and be {_FIRST_SEED} or more, those below are for reported "
            f"results; got {seeds}"
        )
    bounds = config.bounds
    ends = bounds if isinstance(bounds, ListConfig) else ()
    if len(ends) != 2 or any(type(end) not in (int, float) for end in ends):
        raise ValueError(f"bounds must be two numbers, such as [-2,2], got {bounds}")
    if not bounds[0] <= 0 <= bounds[1]:
        raise ValueError(f"bounds must hold 0, the starting values; got {bounds}")
    for name in ("tolerance", "step"):
        check_number(name, config[name])
    for name in ("most_points", "check_cycles"):
        check_number(name, config[name], whole=True)
    if config.write and (changed := _changed_sections(config)):
        raise ValueError(
            f"write=true freezes what the protocol of conf/calibrate_simulator.yaml finds, and "
            f"{', '.join(changed)} differ from it; leave those overrides out, or write=true"
        )


def _changed_sections(config: DictConfig) -> list[str]:
    """Groups of the configuration that are not as ``calibrate_simulator.yaml`` composes them."""
    default = Composed("calibrate_simulator")
    own: Any = OmegaConf.to_container(default.config)  # unresolved: data has scene in it
    given: Any = OmegaConf.to_container(config)
    return [group.name for group in default.groups if own.get(group.name) != given.get(group.name)]


def _content(
    config: DictConfig, points: Sequence[Point], kept: Point, target: float
) -> dict[str, Any]:
    """The content of ``calibration.json``: no time and no path, so that its bytes repeat."""
    protocol: Any = OmegaConf.to_container(config, resolve=True)
    groups = ("data", "labels", "split", "features", "recipe")
    numbers = ("tolerance", "bounds", "step", "most_points", "check_cycles")
    return {
        "simulated": True,
        "provenance": (
            "tactslip calibrate-simulator: test accuracy on simulated seen materials held "
            "against the published one, and the signal checks; nothing else"
        ),
        "values": kept["parameters"],
        "difficulty": kept["difficulty"],
        "accuracy": kept["accuracy"],
        "target": {
            "accuracy": target,
            "row": "test, six seen materials",
            "source": published.PAPER,
        },
        "outcome": _outcome(config, points, kept, target),
        "seeds": list(config.seeds),
        "priors": {name: asdict(prior) for name, prior in PRIORS.items()},
        "signal_checks": kept["signal_checks"],
        "points": points,
        "protocol": {name: protocol[name] for name in groups + numbers},
        "versions": {
            "tactslip_torch": __version__,
            "simulation": SIMULATION_VERSION,
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def _outcome(config: DictConfig, points: Sequence[Point], kept: Point, target: float) -> str:
    """Whether the target was met, and else why not and by how much."""
    missing = kept["accuracy"] - target
    if abs(missing) <= config.tolerance:
        return f"met within {100 * config.tolerance:g} points"
    sign = 1 if missing > 0 else -1
    failing = [
        point
        for point in points
        if not point["holds"] and sign * (point["difficulty"] - kept["difficulty"]) > 0
    ]
    if failing:
        nearest = min(failing, key=lambda point: abs(point["difficulty"] - kept["difficulty"]))
        why = (
            f"cut back: at d {nearest['difficulty']:+.2f} the checks {_failed(nearest)} do not hold"
        )
    elif kept["difficulty"] in tuple(config.bounds):
        why = "the bound of d is reached"
    else:
        why = "no point tried is closer"
    return f"{100 * missing:+.2f} points from the target: {why}"


def _failed(point: Point) -> str:
    return ", ".join(check["name"] for check in point["signal_checks"] if not check["holds"])


main = entry_point("calibrate_simulator", calibrate)
