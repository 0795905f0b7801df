"""Fit on any batch scheduler, without an engine: ``python -m tactslip_torch.stats action=...``.

    alias stats='python -m tactslip_torch.stats'
    for k in $(seq 16); do stats +exp=unseen4 action=collect shard=$k/16 out=survey-$k.stats; done
    stats action=merge 'inputs=survey-*.stats' out=survey.stats
    stats action=plan inputs=survey.stats out=plan.stats
    for k in $(seq 16); do
        stats +exp=unseen4 action=collect plan=plan.stats shard=$k/16 out=sums-$k.stats; done
    stats action=merge 'inputs=sums-*.stats' out=sums.stats
    stats action=solve plan=plan.stats inputs=sums.stats out=detector.pt

``collect`` alone reads data, labels, split, features and recipe; the others read what it wrote.
Every file is whole or absent, so a lost shard is made again. Merging is exact, in any order. The
detector is bit for bit the one that ``train`` makes of more bins than monomials (7381 for 120
features); of fewer ``train`` keeps the bins, and the two agree to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig

from tactslip_torch.abstaining import Abstaining
from tactslip_torch.config import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.datamodule import SlipDataModule
from tactslip_torch.experiment import feature_cache, feature_parts
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.cache import FeatureCache, cache_key
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.files import load_table, save_table, table_form
from tactslip_torch.fitting import solve_facts, solve_sums, training_part
from tactslip_torch.hand import HandLayout
from tactslip_torch.ledger import first_difference
from tactslip_torch.model.class_gaussians import ClassGaussians
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.model.sufficient import SufficientStats
from tactslip_torch.planning import Plan, adds_up, plan_detector
from tactslip_torch.progress import bar
from tactslip_torch.recipe import Recipe
from tactslip_torch.signals.filtering import ChannelFilter

PLAN_FORM = "tactslip_torch plan 1"
_CONSEQUENCES = ("plan", "recordings", "training_bins")  # of other differences


def stats(config: DictConfig) -> str:
    """Do one action; what was done, in words.

    Raises:
        ValueError: for bad input, in one line; nothing is written then.
        FileNotFoundError: if an input is not there.
    """
    actions = {"collect": _collect, "merge": _merge, "plan": _plan, "solve": _solve}
    if config.action not in actions:
        raise ValueError(f"action must be one of {', '.join(actions)}, got {config.action!r}")
    read = [config.plan] if config.plan else []
    read += _inputs(config.inputs) if config.action != "collect" else []
    if Path(config.out).resolve() in {Path(path).resolve() for path in read}:
        raise ValueError(f"out={config.out} is read by this action; give another name")
    return f"{actions[config.action](config)} in {config.out}"


def _collect(config: DictConfig) -> str:
    """Survey a shard of the training recordings or, with a plan, add up what that needs."""
    recipe: Recipe = instantiate(config.recipe, _convert_="all")
    if recipe.validation == "nested":
        raise ValueError(
            "sums need a machine of degree 2 on features of channels, which "
            f"recipe={recipe.name} does not always make; take recipe=robust or recipe=paper"
        )
    if not all(adds_up(kernel) for kernel in recipe.kernels):
        raise ValueError(
            "sums need recipe.kernel=polynomial recipe.degree=2; train fits other kernels"
        )
    with feature_cache(config.cache) as cache:
        data = _data(config, cache)
        recipe.check_pool(len(data.maker.pool.names))
        recipe.allowed(data.maker.pool)  # refuses before any work
        about = _about(config, recipe, data)
        part, parts = _shard(config.shard)
        loader = bar(data.loader(["train"], part - 1, parts), f"shard {config.shard}", "recording")
        torch.set_num_threads(1)  # the processors belong to those who make features
        if config.plan is None:
            survey = Survey(len(data.maker.pool.names), recipe.sample_bins, about)
            for batch in loader:
                mask, group = batch.roles["train"], recipe.group(batch.recording)
                name = str(batch.recording)
                survey.update(name, group, batch.features[mask], batch.is_slip[mask])
            survey.save(config.out)
            return f"survey of {len(survey.ledger)} recordings"
        plan, of_plan = _read_plan(config.plan)
        _check_same(about, of_plan, "this run", config.plan)
        sums = SufficientStats(len(plan.frame.selected), about | {"plan": cache_key(plan.facts())})
        for batch in loader:
            mask, name = batch.roles["train"], str(batch.recording)
            sums.update(name, *training_part(plan, name, batch.features[mask], batch.is_slip[mask]))
        sums.save(config.out)
        return f"sums of {len(sums.ledger)} recordings"


def _merge(config: DictConfig) -> str:
    """Put surveys, or sums, of several shards together."""
    paths = _inputs(config.inputs)
    merged = _read(paths[0])
    for path in bar(paths[1:], "merge", "shard"):
        other = _read(path)
        if type(merged) is not type(other):
            raise ValueError(f"{paths[0]} and {path} are of two kinds; merge surveys or sums alone")
        _check_same(other.about, merged.about, path, paths[0])
        try:
            merged.merge(other)  # type: ignore[arg-type]  # of one type
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    missing = set(merged.about["recordings"]) - set(merged.ledger.entries)
    merged.save(config.out)
    return f"{len(paths)} shards, {len(merged.ledger)} recordings, {len(missing)} missing"


def _plan(config: DictConfig) -> str:
    """Choose features, scaling, K, c and C from the merged survey."""
    survey = _only(config.inputs, Survey)
    _check_complete(survey.about, survey.ledger.entries)
    recipe = Recipe(**survey.about["recipe"])
    pool = FeaturePool(HandLayout.from_rows(survey.about["channels"]), **survey.about["pool"])
    plan = plan_detector(recipe, survey, bar, allowed=recipe.allowed(pool))
    plan = Abstaining(config.coverage, config.coverage_by).settle(plan, recipe, survey)
    facts = {"plan": plan.facts(), "about": survey.about}
    save_table(config.out, PLAN_FORM, facts, plan.tensors())
    return f"{len(plan.frame.selected)} features, C={plan.penalty:g}"


def _solve(config: DictConfig) -> str:
    """The detector of a plan and the merged sums."""
    if config.plan is None:
        raise ValueError("no plan; give plan=plan.stats, as written by action=plan")
    plan, of_plan = _read_plan(config.plan)
    sums = _only(config.inputs, SufficientStats)
    _check_same(sums.about, of_plan | {"plan": cache_key(plan.facts())}, "the sums", config.plan)
    _check_complete(sums.about, sums.ledger.entries)
    about, head = sums.about, solve_sums(plan, sums)
    detector = SlipDetector(
        FeaturePool(HandLayout.from_rows(about["channels"]), **about["pool"]),
        ChannelFilter(
            about["window_lengths"], about["polyorder"], about["align"], about.get("kernels")
        ),
        plan.frame.selected,
        plan.frame.scaler,
        head,
        plan.facts()
        | {"solve": solve_facts(head)}
        | {name: about[name] for name in ("simulated", "experiment", "seed", "split")}
        | {"features_dtype": about["features_dtype"], "train_recordings": about["recordings"]}
        | {"train_materials": about["materials"]},
        plan.typical,
        plan.gaussians,
    )
    detector.save(config.out)
    return f"detector of {int(sums.count.sum())} bins, by {head.solved}"


def _data(config: DictConfig, cache: FeatureCache) -> SlipDataModule:
    source: RecordingSource = instantiate(config.data, _convert_="all")
    rule: LabelRule = instantiate(config.labels)
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    names = [fold.name for fold in folds]
    if config.fold not in ((None, *names) if len(folds) == 1 else names):
        raise ValueError(f"fold must be one of {', '.join(names)}, got {config.fold}")
    fold = folds[names.index(config.fold) if config.fold else 0]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    maker = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, engine)
    return SlipDataModule(maker, fold, config.num_workers)


def _about(config: DictConfig, recipe: Recipe, data: SlipDataModule) -> dict[str, Any]:
    """What must be the same in every shard, as JSON-able facts."""
    source = data.maker.source
    recordings = data.split.having("train")
    return data.about() | {
        "recipe": recipe.facts(),
        "recordings": {str(r): cache_key(source.key(r)) for r in recordings},
        "materials": sorted({r.material for r in recordings}),
        "simulated": source.is_simulated,
        "experiment": config.name,
        "seed": config.seed,
        "split": data.split.name,
    }


def _shard(text: str) -> tuple[int, int]:
    part, _, parts = str(text).partition("/")
    if not (part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)):
        raise ValueError(f"shard must be like 3/16, from 1/16 to 16/16, got {text}")
    return int(part), int(parts)


def _inputs(given: Any) -> list[str]:
    """Files of names or patterns, in the order of their names."""
    patterns = list(given) if isinstance(given, ListConfig | list) else [given]
    found: list[str] = []
    for pattern in map(str, patterns):
        place = Path(pattern)
        is_pattern = any(sign in place.name for sign in "*?[")
        matches = sorted(map(str, place.parent.glob(place.name))) if is_pattern else [pattern]
        if not matches:
            raise ValueError(f"no file fits inputs={pattern}")
        found += matches
    if not found:
        raise ValueError("no inputs; give inputs=FILE, or a pattern such as 'inputs=sums-*.stats'")
    return found


def _read(path: str) -> Survey | SufficientStats:
    found = Survey.load(path) if "survey" in table_form(path) else SufficientStats.load(path)
    if "recordings" not in found.about:
        raise ValueError(f"{path} was not made by action=collect; merge it in Python")
    return found


def _only(given: Any, kind: type[Any]) -> Any:
    paths = _inputs(given)
    if len(paths) > 1:
        raise ValueError(f"one merged file is wanted, got {len(paths)}; action=merge makes it")
    return kind.load(paths[0])


def _read_plan(path: str) -> tuple[Plan, dict[str, Any]]:
    facts, tensors = load_table(path, PLAN_FORM)
    scaler = FeatureScaler(**{name: x for name, x in tensors.items() if "." not in name})
    return Plan.of(facts["plan"], scaler, ClassGaussians.among(tensors)), facts["about"]


def _check_same(ours: Mapping[str, Any], theirs: Mapping[str, Any], what: str, other: str) -> None:
    for name in sorted(ours.keys() | theirs.keys(), key=lambda key: (key in _CONSEQUENCES, key)):
        if found := first_difference(ours.get(name), theirs.get(name), name):
            raise ValueError(
                f"{what} and {other} differ in {found}; use one data set, one configuration and "
                "one version of the code for all shards"
            )


def _check_complete(about: Mapping[str, Any], have: Sequence[str] | Mapping[str, str]) -> None:
    missing = sorted(set(about["recordings"]) - set(have))
    if missing:
        raise ValueError(
            f"{len(missing)} of {len(about['recordings'])} training recordings are missing, such "
            f"as {missing[0]}; collect the lost shards again and merge"
        )


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="stats")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        print(stats(config))


if __name__ == "__main__":
    run_entry_point(main)
