"""Settings learned through the fit: loss and gradients, where descents stop, what is refused."""

import json
from dataclasses import replace

import pytest
import torch
from small_set import SmallSet, small_maker
from test_commands import TINY, composed
from torch.nn.functional import binary_cross_entropy_with_logits

from tactslip_torch import SlipDetector
from tactslip_torch.commands.train import train
from tactslip_torch.data.splits import unseen4
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.fit import TrainingBins, fit_machine, held_out_scores
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.training.plan import plan_detector
from tactslip_torch.training.recipe import Recipe, sample_weight
from tactslip_torch.training.tuning import (
    SETTINGS,
    GridPoint,
    LearnedSettings,
    Tuning,
    grid_points,
    grouped_loss,
    least_loss,
    tuning_bins,
)

RECIPE = Recipe(
    num_features=6, penalties=(0.01, 0.1, 1.0), compress=True, tail=0.01, balance="weights"
)


@pytest.fixture(scope="module")
def small():
    """A maker, the sample and the plan of its training recordings, and their split."""
    maker = small_maker(SmallSet(materials=("a", "b", "c", "d"), cycles=3))
    split = unseen4(maker.source.ids, seen=["a", "b", "c"], unseen=["d"], train_fraction=0.7)[0]
    statistics = TrainingStatistics(len(maker.pool.names), 60)
    for recording in split.having("train"):
        made = maker(recording, split)
        statistics.update(str(recording), recording.material, made.features, made.is_slip)
    return maker, statistics.sample.bins(), plan_detector(RECIPE, statistics), split


@pytest.fixture(scope="module")
def bins(small):
    _, sample, plan, _ = small
    return tuning_bins(sample, plan.selection.selected, sample_weight(RECIPE, sample), 12)


@pytest.fixture
def settings(small):
    return LearnedSettings(SETTINGS, GridPoint(0.1, 0.5, 0.0, 0.0), small[2].selection.scaler)


def tuned_by(small, sample, tuning):
    maker, _, plan, _ = small
    return tuning(plan, sample, [str(name) for name in maker.pool.names])


def test_loss_is_the_mean_over_groups_and_classes_by_the_slope_of_least_loss(rng):
    is_slip, groups = torch.arange(600) % 3 == 0, torch.arange(600) // 250
    scores = torch.where(is_slip, 0.5, -0.5) + torch.from_numpy(rng.standard_normal(600)) + 0.3
    found = grouped_loss(scores, is_slip, groups, Platt(1.7, -0.3))
    losses, recalls = [], []
    for group in range(3):
        for kind in (True, False):
            own = (groups == group) & (is_slip == kind)
            truth = torch.full_like(scores[own], float(kind))
            losses.append(binary_cross_entropy_with_logits(1.7 * scores[own] - 0.3, truth))
            recalls.append(float(((scores[own] >= 0) == kind).double().mean()))
    assert float(found.loss) == pytest.approx(float(torch.stack(losses).mean()), rel=1e-12)
    assert found.balanced_accuracy == pytest.approx(sum(recalls) / 6)
    fitted = grouped_loss(scores, is_slip, groups)
    assert fitted.calibration.offset == 0
    for factor in (0.9, 1.1):
        other = Platt(factor * fitted.calibration.slope, 0.0)
        assert grouped_loss(scores, is_slip, groups, other).loss > fitted.loss
    assert grouped_loss(scores + 1.0, is_slip, groups).loss > fitted.loss + 0.05  # decides at 0


def test_gradients_of_every_setting_are_those_of_differences(settings, bins):
    with torch.no_grad():  # away from the start, where clipped values lie on the edge
        settings.logs["scales"] -= 0.1

    def loss(calibration=None):
        z = settings.scaled(bins.features)
        scores = held_out_scores(
            z, bins.is_slip, bins.group, settings.penalty, settings.offset, bins.weights
        )
        return grouped_loss(scores, bins.is_slip, bins.group, calibration)

    found = loss()
    found.loss.backward()
    checked = 0
    for name, parameter in settings.named_parameters():
        flat, slope = parameter.data.view(-1), parameter.grad.reshape(-1)
        for place in {0, len(flat) // 2}:
            kept, step, values = float(flat[place]), 1e-5, []
            for sign in (1, -1):
                flat[place] = kept + sign * step
                with torch.no_grad():
                    values.append(float(loss(found.calibration).loss))
            flat[place] = kept
            expected = (values[0] - values[1]) / (2 * step)
            assert float(slope[place]) == pytest.approx(expected, rel=2e-3, abs=2e-6), name
            checked += abs(expected) > 1e-5
    assert checked >= 3


def test_grid_is_of_refits_without_the_group(small, bins):
    recipe = replace(RECIPE, penalties=(0.1, 1.0), offsets=(0.5, 2.0))
    scaler = small[2].selection.scaler
    points = grid_points(scaler, bins, recipe)
    assert [point[:2] for point in points] == [(0.1, 0.5), (1.0, 0.5), (0.1, 2.0), (1.0, 2.0)]
    z, scores = scaler(bins.features), torch.empty(len(bins.group), dtype=torch.float64)
    for group in range(3):
        own = bins.group == group
        others = TrainingBins(z[~own], bins.is_slip[~own], bins.weights[~own])
        scores[own] = fit_machine(others, 1.0, Polynomial(2, 2.0))(z[own])
    expected = grouped_loss(scores, bins.is_slip, bins.group)
    assert points[3].loss == pytest.approx(float(expected.loss), rel=1e-6)
    assert least_loss(points).loss == min(point.loss for point in points)
    two = bins.where(bins.group != 2)
    backwards = two._replace(is_slip=two.is_slip ^ (two.group == 1))  # wrong of the other group
    with pytest.raises(ValueError, match="tuning has no place to start: at every C and c"):
        grid_points(scaler, backwards, recipe)


def test_the_step_taken_is_that_of_least_mean_loss_of_held_out_groups(small):
    tuned = tuned_by(small, small[1], Tuning(bins=10, steps=4, patience=2))
    found = tuned.metadata
    held = torch.tensor([[row["held_loss"] for row in group["history"]] for group in found["held"]])
    assert found["steps"] == int(held.mean(0).argmin())
    assert len(found["history"]) == held.shape[1]
    for place, group in enumerate(found["held"]):
        losses = [row["loss"] for row in group["history"]]
        assert min(losses) < losses[0]
        steps = int(torch.cat([held[:place], held[place + 1 :]]).mean(0).argmin())
        assert group["tuned"]["steps"] == steps
        assert group["tuned"]["loss"] == group["history"][steps]["held_loss"]
        assert group["grid"]["loss"] == group["history"][0]["held_loss"]
    assert {group["held"] for group in found["held"]} == {"a", "b", "c"}
    assert (found["penalty"], found["offset"]) == (tuned.penalty, tuned.offset)


def test_a_held_out_group_does_not_change_its_descent(small):
    sample = small[1]
    features = sample.features.clone()
    features[sample.group == 2] *= 1.03
    tuning = Tuning(learn=["penalty", "scales"], bins=8, steps=2, patience=3)
    first, second = (
        tuned_by(small, replace(sample, features=x), tuning).metadata["held"][2]
        for x in (sample.features, features)
    )
    assert [row["loss"] for row in first["history"]] == [row["loss"] for row in second["history"]]
    assert first["history"][0]["held_loss"] != second["history"][0]["held_loss"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"learn": ["bias"]}, "tuning.learn must be a list of some of penalty, offset"),
        ({"learn": []}, "tuning.learn must be a list"),
        ({"learn": "penalty"}, "tuning.learn must be a list"),
        ({"steps": 0}, "tuning.steps must be a positive whole number, got 0"),
        ({"bins": "abc"}, "tuning.bins must be a positive whole number, got 'abc'"),
        ({"rate": float("nan")}, "tuning.rate must be a positive finite number, got nan"),
    ],
)
def test_bad_tuning_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Tuning(**values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"degree": 3}, "needs recipe.kernel=polynomial recipe.degree=2"),
        ({"offsets": 0.0}, r"needs recipe\.offsets above 0"),
        ({}, "needs three groups to hold some out, got a, b"),
    ],
    ids=str,
)
def test_what_could_not_be_tuned_is_refused_beforehand(small, changes, message):
    split = small[3]
    if not changes:
        roles = {r: role for r, role in split.roles.items() if r.material != "c"}
        split = replace(split, roles=roles)
    with pytest.raises(ValueError, match=message):
        Tuning().check(replace(RECIPE, **changes), split)
    Tuning().check(replace(RECIPE, group_by="cycle"), small[3])


@pytest.mark.slow
def test_training_tunes_and_keeps_the_detectors_that_it_began_with(tmp_path):
    options = ("recipe=robust", "recipe.num_features=6", "recipe.group_by=cycle", "data.seed=0")
    quick = ("baselines=false", "export=false", "cache=off", "coverage=null")
    tuning = ("tuning=gradient", "tuning.bins=6", "tuning.steps=2", "tuning.learn=[penalty]")
    train(composed(*TINY, *options, *quick, *tuning), tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    found = metrics["tuning"]
    assert found["learned"] == ["penalty"]
    assert metrics["penalty"] == pytest.approx(found["penalty"])
    assert set(found["splits"]) == {"recipe", "grid"}
    for name, penalty in (("start", found["start"]["penalty"]), ("detector", found["penalty"])):
        detector = SlipDetector.load(tmp_path / f"{name}.pt")
        assert detector.info["penalty"] == pytest.approx(penalty)
    assert detector.info["tuned"]["steps"] == found["steps"]
    assert (tmp_path / "grid.pt").exists()
    assert (tmp_path / "tuning.png").stat().st_size > 10_000
