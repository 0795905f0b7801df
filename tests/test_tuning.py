"""Settings learned through the fit: the loss, what is learned, descents, and the second fit."""

from dataclasses import replace

import pytest
import torch
from small_set import SmallSet, small_maker
from torch.nn.functional import binary_cross_entropy_with_logits

from tactslip_torch.data.splits import unseen4
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.leave_one_group_out import held_out_scores
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.selection import plan_detector
from tactslip_torch.training.tuning import (
    SETTINGS,
    LearnedSettings,
    Tuning,
    grid_points,
    grouped_loss,
    least_loss,
    most_accurate,
    settled_learner,
    tuning_bins,
)

RECIPE = Recipe(
    num_features=6, penalties=(0.01, 0.1, 1.0), compress=True, tail=0.01, balance="weights"
)


@pytest.fixture(scope="module")
def small():
    """A maker, the sample and the plan of its training recordings, and these."""
    maker = small_maker(SmallSet(materials=("a", "b", "c", "d"), cycles=3))
    split = unseen4(maker.source.ids, seen=["a", "b", "c"], unseen=["d"], train_share=0.7)[0]
    survey = Survey(len(maker.pool.names), 60)
    for recording in split.having("train"):
        made = maker(recording, split)
        survey.update(str(recording), recording.material, made.features, made.is_slip)
    plan = plan_detector(RECIPE, survey)
    return maker, survey.sample.bins(), plan, split


def settings_of(small, learn=SETTINGS, penalty=0.1, offset=0.5):
    return LearnedSettings(learn, penalty, offset, small[2].selection.scaler)


def bins_of(small, most=12):
    _, sample, plan, _ = small
    return tuning_bins(sample, plan.selection.selected, weights_of(sample), most)


def weights_of(sample):
    return torch.where(sample.is_slip, 3.0, 2.0).double()


def test_loss_is_the_mean_over_groups_and_classes(rng):
    scores = torch.from_numpy(rng.standard_normal(40))
    is_slip = torch.arange(40) % 2 == 0
    groups = torch.arange(40) // 14  # of unlike size
    calibration = Platt(1.7, -0.3)
    found = grouped_loss(scores, is_slip, groups, calibration)
    logits = 1.7 * scores - 0.3
    losses, recalls = [], []
    for group in range(3):
        for kind in (True, False):
            own = (groups == group) & (is_slip == kind)
            truth = torch.full_like(scores[own], float(kind))
            losses.append(binary_cross_entropy_with_logits(logits[own], truth))
            recalls.append(float(((scores[own] >= 0) == kind).double().mean()))
    assert float(found.loss) == pytest.approx(float(torch.stack(losses).mean()), rel=1e-12)
    assert found.balanced_accuracy == pytest.approx(sum(recalls) / 6)


def test_the_slope_is_of_least_loss_and_nothing_is_offset(rng):
    is_slip = torch.arange(600) % 3 == 0
    groups = torch.arange(600) // 250
    noise = torch.from_numpy(rng.standard_normal(600))
    scores = torch.where(is_slip, 0.5, -0.5) + noise + 0.3
    found = grouped_loss(scores, is_slip, groups)
    assert found.calibration.offset == 0
    slope = found.calibration.slope
    for other in (0.9 * slope, 1.1 * slope):
        assert grouped_loss(scores, is_slip, groups, Platt(other, 0.0)).loss > found.loss
    leaning = grouped_loss(scores + 1.0, is_slip, groups)
    assert leaning.loss > found.loss + 0.05  # it decides at 0
    assert leaning.balanced_accuracy < found.balanced_accuracy


def test_tuning_bins_are_sampled_training_bins(small):
    _, sample, plan, _ = small
    bins = bins_of(small)
    counts = torch.stack(
        [torch.bincount(bins.group[bins.is_slip == kind]) for kind in (True, False)]
    )
    assert (counts == 12).all()
    sampled = sample.features[:, list(plan.selection.selected)].double()
    assert set(map(tuple, bins.features.tolist())) <= set(map(tuple, sampled.tolist()))
    assert bins.of(1).group.unique().tolist() == [1]
    assert bins.without(1).group.unique().tolist() == [0, 2]
    for kind in (True, False):  # few bins stand for all of their class
        total = weights_of(sample)[sample.is_slip == kind].sum()
        assert float(bins.weights[bins.is_slip == kind].sum()) == pytest.approx(float(total))


def test_settings_start_where_the_plan_is(small):
    _, _, plan, _ = small
    settings, bins = settings_of(small).requires_grad_(False), bins_of(small)
    z = settings.scaled(bins.features)
    torch.testing.assert_close(z, plan.selection.scaler(bins.features), rtol=0, atol=1e-12)
    assert float(settings.penalty) == pytest.approx(0.1, rel=1e-12)
    assert float(settings.offset) == pytest.approx(0.5, rel=1e-12)
    scaler = settings.scaler()
    torch.testing.assert_close(
        scaler.minimum, plan.selection.scaler.minimum, rtol=1e-12, atol=1e-300
    )


def test_a_scaler_holds_what_scales_do(small):
    settings, bins = settings_of(small).requires_grad_(False), bins_of(small)
    with torch.no_grad():
        settings.logs["scales"].copy_(torch.linspace(0.5, -2, 6))
    assert float(settings.scales.max()) > 1.6
    assert float(settings.scales.min()) < 0.14
    z = settings.scaled(bins.features)
    torch.testing.assert_close(settings.scaler()(bins.features), z, rtol=0, atol=1e-12)


def test_gradients_of_every_setting_are_those_of_differences(small):
    settings, bins = settings_of(small), bins_of(small, most=6)
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
        for place in (0, len(flat) // 2):
            kept, step = float(flat[place]), 1e-5
            values = []
            for sign in (1, -1):
                flat[place] = kept + sign * step
                with torch.no_grad():
                    values.append(float(loss(found.calibration).loss))
            flat[place] = kept
            expected = (values[0] - values[1]) / (2 * step)
            assert float(slope[place]) == pytest.approx(expected, rel=2e-3, abs=2e-6), name
            checked += abs(expected) > 1e-5
    assert checked >= 3


def test_grid_is_of_refits_without_the_group(small):
    bins, scaler = bins_of(small), small[2].selection.scaler
    points = grid_points(scaler, bins, (0.1, 1.0), (0.5, 2.0))
    z = scaler(bins.features)
    assert [(point.penalty, point.offset) for point in points] == [
        (0.1, 0.5), (1.0, 0.5), (0.1, 2.0), (1.0, 2.0)
    ]  # fmt: skip
    scores = torch.empty(len(z), dtype=torch.float64)
    for group in range(3):
        own = bins.group == group
        others = TrainingBins(z[~own], bins.is_slip[~own], bins.weights[~own])
        machine = fit_machine(others, 1.0, Polynomial(2, 2.0))
        scores[own] = machine(z[own])
    expected = grouped_loss(scores, bins.is_slip, bins.group)
    assert points[3].loss == pytest.approx(float(expected.loss), rel=1e-6)
    assert least_loss(points).loss == min(point.loss for point in points)
    assert most_accurate(points).balanced_accuracy == max(p.balanced_accuracy for p in points)


@pytest.fixture(scope="module")
def tuned(small):
    return tuned_by(small, small[1], Tuning(bins=10, steps=4, patience=2))


def tuned_by(small, sample, tuning):
    maker, _, plan, _ = small
    names = [str(name) for name in maker.pool.names]
    return tuning(plan, RECIPE, sample, weights_of(sample), names)


def test_the_step_taken_is_that_of_least_mean_loss_of_held_groups(tuned):
    facts = tuned.facts
    held = torch.tensor([[row["held_loss"] for row in group["history"]] for group in facts["held"]])
    assert facts["steps"] == int(held.mean(0).argmin())
    assert len(facts["history"]) == held.shape[1]
    for place, group in enumerate(facts["held"]):
        losses = [row["loss"] for row in group["history"]]
        assert min(losses) < losses[0]  # of what is learned on
        others = torch.cat([held[:place], held[place + 1 :]]).mean(0)
        assert group["tuned"]["steps"] == int(others.argmin())
        assert group["tuned"]["loss"] == group["history"][int(others.argmin())]["held_loss"]
        assert group["grid"]["loss"] == group["history"][0]["held_loss"]
    assert {group["held"] for group in facts["held"]} == {"a", "b", "c"}


def test_a_held_group_has_no_say_in_its_descent(small):
    sample = small[1]
    features = sample.features.clone()
    features[sample.group == 2] *= 1.03
    other = replace(sample, features=features)
    tuning = Tuning(learn=["penalty", "scales"], bins=10, steps=3, patience=3)
    first, second = (tuned_by(small, one, tuning).facts["held"][2] for one in (sample, other))
    assert [row["loss"] for row in first["history"]] == [row["loss"] for row in second["history"]]
    assert first["history"][0]["held_loss"] != second["history"][0]["held_loss"]


def test_second_fit_is_of_what_was_learned(small, tuned):
    maker, _, plan, _ = small

    class First:
        recipe, abstaining, with_baselines = RECIPE, None, False

    learner = settled_learner(First(), maker, tuned.selection, tuned.penalty, tuned.offset)
    assert learner.recipe.penalties_ascending == (tuned.penalty,)
    assert learner.recipe.kernels == (Polynomial(2, tuned.offset),)
    assert learner.recipe.sizes == (len(plan.selection.selected),)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"learn": ["bias"]}, "tuning.learn must be a list of some of penalty, offset"),
        ({"learn": []}, "tuning.learn must be a list of some of penalty, offset"),
        ({"learn": "penalty"}, "tuning.learn must be a list of some of penalty, offset"),
        ({"learn": None}, "tuning.learn must be a list of some of penalty, offset"),
        ({"steps": 0}, "tuning.steps must be a positive whole number, got 0"),
        ({"bins": 1.5}, "tuning.bins must be a positive whole number, got 1.5"),
        ({"bins": "abc"}, "tuning.bins must be a positive whole number, got 'abc'"),
        ({"rate": float("nan")}, "tuning.rate must be a positive number, got nan"),
    ],
)
def test_bad_tuning_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Tuning(**values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"group_by": "cycle"}, None),
        ({"degree": 3}, "needs a polynomial kernel of degree 2"),
        ({"kernel": "rbf", "gamma": 0.1}, "needs a polynomial kernel of degree 2"),
        ({"offsets": 0.0}, r"needs recipe\.offsets above 0"),
        ({"penalties": float("inf")}, r"needs finite recipe\.penalties"),
    ],
)
def test_what_could_not_be_tuned_is_refused_beforehand(small, changes, message):
    _, _, _, split = small
    recipe = replace(RECIPE, **changes)
    if message is None:
        Tuning().check(recipe, split)
        return
    with pytest.raises(ValueError, match=message):
        Tuning().check(recipe, split)


def test_two_groups_leave_none_to_hold_out(small):
    _, _, _, split = small
    roles = {r: role for r, role in split.roles.items() if r.material != "c"}
    with pytest.raises(ValueError, match="needs three groups to hold some out, got a, b"):
        Tuning().check(RECIPE, replace(split, roles=roles))


def test_a_grid_that_tells_slip_backwards_everywhere_is_no_start(small):
    two = bins_of(small).without(2)
    flipped = replace(two, is_slip=two.is_slip ^ (two.group == 1))  # wrong of the other group
    with pytest.raises(ValueError, match="tuning has no place to start: at every C and c"):
        grid_points(small[2].selection.scaler, flipped, (0.1, 1.0), (0.5,))
