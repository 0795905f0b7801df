"""Settings learned through the fit: the loss, what is learned, descents, and the second fit."""

from dataclasses import replace

import pytest
import torch
from small_set import SMALL_HAND, SmallSet, small_maker
from torch.nn.functional import binary_cross_entropy_with_logits

from tactslip_torch.data.splits import random_bins, unseen4
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.held_out_gradient import held_out_scores
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.planning import plan_detector
from tactslip_torch.recipe import Recipe
from tactslip_torch.tuning.bins import tuning_bins
from tactslip_torch.tuning.described import selected_features
from tactslip_torch.tuning.grid import grid_points, least_loss, most_accurate
from tactslip_torch.tuning.learned import SETTINGS, LearnedSettings
from tactslip_torch.tuning.module import Descent
from tactslip_torch.tuning.objective import grouped_loss
from tactslip_torch.tuning.second_fit import settled_learner, tuned_maker
from tactslip_torch.tuning.stage import Tuning

RECIPE = Recipe(
    num_features=6, penalties=(0.01, 0.1, 1.0), compress=True, tail=0.01, balance="weights"
)


def quiet(items, what):
    return items


@pytest.fixture(scope="module")
def small():
    """A maker, the sample and the plan of its training recordings, and these."""
    maker = small_maker(SmallSet(materials=("a", "b", "c", "d"), cycles=3))
    split = unseen4(maker.source.ids, seen=["a", "b", "c"], unseen=["d"], train_share=0.7)[0]
    survey = Survey(len(maker.pool.names), 60)
    for recording in split.having("train"):
        made = maker(recording, split)
        survey.update(str(recording), recording.material, made.features, made.is_slip)
    plan = plan_detector(RECIPE, survey, quiet)
    return maker, survey.sample.bins(), plan, split


def settings_of(small, learn=SETTINGS, penalty=0.1, offset=0.5):
    maker, _, plan, _ = small
    names = [maker.pool.names[i] for i in plan.frame.selected]
    parts = (plan.frame.scaler, names, maker.pool, maker.channel_filter)
    return LearnedSettings(learn, penalty, offset, *parts)


def bins_of(small, most=12, *, raw=True):
    maker, sample, plan, split = small
    selected, weights = plan.frame.selected, weights_of(sample)
    return tuning_bins(sample, selected, weights, most, maker if raw else None, split)


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


def test_raw_bins_filter_to_what_features_are_taken_from(small):
    maker, _, _, split = small
    recording = split.having("train")[0]
    bins, labels = maker.filtered_bins(recording)
    index = torch.arange(0, len(labels.starts), 5)
    raw = maker.raw_bins(recording, index)
    torch.testing.assert_close(maker.channel_filter.valid(raw), bins[index], rtol=0, atol=1e-12)


def test_tuning_bins_are_sampled_training_bins(small):
    _, sample, plan, _ = small
    bins = bins_of(small)
    counts = torch.stack(
        [torch.bincount(bins.group[bins.is_slip == kind]) for kind in (True, False)]
    )
    assert (counts == 12).all()
    sampled = sample.features[:, list(plan.frame.selected)].double()
    assert set(map(tuple, bins.features.tolist())) <= set(map(tuple, sampled.tolist()))
    assert bins.of([1]).group.unique().tolist() == [1]
    assert len(bins.of([1]).raw) == 24
    for kind in (True, False):  # few bins stand for all of their class
        total = weights_of(sample)[sample.is_slip == kind].sum()
        assert float(bins.weights[bins.is_slip == kind].sum()) == pytest.approx(float(total))


def test_raw_bins_are_those_that_were_sampled_where_bins_are_split(small):
    maker, _, plan, _ = small
    split = random_bins(maker.source.ids, seen=["a", "b", "c"], train_share=0.6)[0]
    survey = Survey(len(maker.pool.names), 40)
    for recording in split.having("train"):
        made = maker(recording, split)
        own = made.roles["train"]
        survey.update(str(recording), recording.material, made.features[own], made.is_slip[own])
    sample = survey.sample.bins()
    bins = bins_of((maker, sample, plan, split))
    found = settings_of(small).requires_grad_(False).features(bins)
    torch.testing.assert_close(found, bins.features, rtol=2e-5, atol=1e-6)


def test_selected_features_are_the_pools(rng):
    pool = FeaturePool(SMALL_HAND)
    bins = torch.from_numpy(rng.standard_normal((7, 2, 100)))
    order = rng.permutation(len(pool.names)).tolist()
    found = selected_features(pool, bins, [pool.names[i] for i in order])
    torch.testing.assert_close(found, pool(bins)[:, order], rtol=1e-10, atol=1e-12)


def test_settings_start_where_the_plan_is(small):
    _, _, plan, _ = small
    settings, bins = settings_of(small).requires_grad_(False), bins_of(small)
    torch.testing.assert_close(settings.features(bins), bins.features, rtol=2e-5, atol=1e-6)
    z = settings.scaled(bins.features)
    torch.testing.assert_close(z, plan.frame.scaler(bins.features), rtol=0, atol=1e-12)
    assert float(settings.penalty) == pytest.approx(0.1, rel=1e-12)
    assert float(settings.offset) == pytest.approx(0.5, rel=1e-12)
    scaler = settings.scaler()
    torch.testing.assert_close(scaler.minimum, plan.frame.scaler.minimum, rtol=1e-12, atol=1e-300)


def test_a_scaler_holds_what_scales_do(small):
    settings, bins = settings_of(small).requires_grad_(False), bins_of(small)
    with torch.no_grad():
        settings.log_scales.copy_(torch.linspace(0.5, -2, len(settings.log_scales)))
    assert float(settings.scales.max()) > 1.6
    assert float(settings.scales.min()) < 0.14
    z = settings.scaled(bins.features)
    torch.testing.assert_close(settings.scaler()(bins.features), z, rtol=0, atol=1e-12)


def test_gradients_of_every_setting_are_those_of_differences(small):
    settings, bins = settings_of(small), bins_of(small, most=6)
    with torch.no_grad():  # away from the start, where clipped values lie on the edge
        settings.log_scales -= 0.1
    module = Descent(settings, bins)
    module.judged()[0].loss.backward()
    calibration = module.judged()[0].calibration

    def loss():
        z = settings.scaled(settings.features(bins))
        scores = held_out_scores(
            z, bins.is_slip, bins.group, settings.penalty, settings.offset, bins.weights
        )
        return float(grouped_loss(scores, bins.is_slip, bins.group, calibration).loss)

    checked = 0
    for name, parameter in settings.named_parameters():
        flat, slope = parameter.data.view(-1), parameter.grad.reshape(-1)
        for place in (0, len(flat) // 2):
            kept, step = float(flat[place]), 1e-5
            values = []
            for sign in (1, -1):
                flat[place] = kept + sign * step
                with torch.no_grad():
                    values.append(loss())
            flat[place] = kept
            expected = (values[0] - values[1]) / (2 * step)
            assert float(slope[place]) == pytest.approx(expected, rel=2e-3, abs=2e-6), name
            checked += abs(expected) > 1e-5
    assert checked >= 4


def test_grid_is_of_refits_without_the_group(small):
    settings, bins = settings_of(small), bins_of(small, raw=False)
    z = settings.scaled(bins.features).detach()
    points = grid_points(z, bins.is_slip, bins.group, bins.weights, (0.1, 1.0), (0.5, 2.0))
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
    maker, sample, plan, split = small
    learn = ["penalty", "offset", "scales", "smoothing", "wavelet"]
    tuning = Tuning(learn=learn, bins=10, steps=4, patience=2)
    return tuning(plan, RECIPE, sample, weights_of(sample), maker, split)


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
    maker, sample, plan, split = small
    features = sample.features.clone()
    features[sample.group == 2] *= 1.03
    other = replace(sample, features=features)
    tuning = Tuning(learn=["penalty", "scales"], bins=10, steps=3, patience=3)
    first, second = (
        tuning(plan, RECIPE, one, weights_of(one), maker, split).facts["held"][2]
        for one in (sample, other)
    )
    assert [row["loss"] for row in first["history"]] == [row["loss"] for row in second["history"]]
    assert first["history"][0]["held_loss"] != second["history"][0]["held_loss"]


def test_second_fit_is_of_what_was_learned(small, tuned):
    maker, _, plan, _ = small
    made = tuned_maker(tuned, maker)
    assert made.pool.wavelet == tuned.wavelet
    assert made.channel_filter.kernels == {k: tuple(v) for k, v in tuned.kernels.items()}

    class First:
        recipe, abstaining, with_baselines = RECIPE, None, False

    learner = settled_learner(First(), made, tuned.frame, tuned.penalty, tuned.offset)
    assert learner.recipe.penalties_ascending == (tuned.penalty,)
    assert learner.recipe.kernels == (Polynomial(2, tuned.offset),)
    assert learner.recipe.sizes == (len(plan.frame.selected),)


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
    maker, _, _, split = small
    recipe = replace(RECIPE, **changes)
    if message is None:
        Tuning().check(recipe, maker.pool, split)
        return
    with pytest.raises(ValueError, match=message):
        Tuning().check(recipe, maker.pool, split)


def test_two_groups_leave_none_to_hold_out(small):
    maker, _, _, split = small
    roles = {r: role for r, role in split.roles.items() if r.material != "c"}
    with pytest.raises(ValueError, match="needs three groups to hold some out, got a, b"):
        Tuning().check(RECIPE, maker.pool, replace(split, roles=roles))


def test_a_wavelet_that_cannot_be_lifted_is_refused_beforehand(small):
    _, _, _, split = small
    with pytest.raises(ValueError, match="db4"):
        Tuning().check(RECIPE, FeaturePool(SMALL_HAND, wavelet="db4", level=3), split)


def test_selected_features_of_strange_bins_are_the_pools(rng):
    pool = FeaturePool(SMALL_HAND)
    bins = torch.from_numpy(rng.standard_normal((4, 2, 100)))
    bins[0] = 0.0
    bins[1] = 2.5
    bins[2] += 1e9
    bins[3] *= 1e-12
    found = selected_features(pool, bins, pool.names)
    torch.testing.assert_close(found, pool(bins), rtol=1e-9, atol=0)


def test_a_point_of_the_grid_that_tells_slip_backwards_is_not_the_start(small):
    settings, bins = settings_of(small), bins_of(small, raw=False)
    two = bins.of([0, 1])
    flipped = two.is_slip ^ (two.group == 1)  # what one group teaches is wrong of the other
    z = settings.scaled(two.features).detach()
    points = grid_points(z, flipped, two.group, two.weights, (0.1, 1.0), (0.5,))
    assert [point.loss for point in points] == [float("inf")] * 2
