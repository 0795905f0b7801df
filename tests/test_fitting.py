"""Plans and passes: what is chosen, and that neither order nor workers matter."""

import json
from dataclasses import replace

import pytest
import torch
from test_recipe import make_parts, surveyed, together

from tactslip_torch.model.calibration import calibration_from_dict, fit_platt
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.missing_channels import RESOLUTION
from tactslip_torch.training import selection
from tactslip_torch.training.fitting import TrainingPass
from tactslip_torch.training.recipe import Recipe, recalls_mean
from tactslip_torch.training.selection import Plan, plan_detector


def quiet(items, what):
    return items


def planned(recipe, parts):
    return plan_detector(recipe, surveyed(recipe, parts), quiet)


def passed(plan, parts):
    gathered = TrainingPass(plan)
    for recording, features, is_slip in parts:
        gathered.update(str(recording), features, is_slip)
    return gathered


def assert_same_head(one, other):
    for name, value in one.state_dict().items():
        torch.testing.assert_close(value, other.state_dict()[name], rtol=1e-9, atol=1e-11)


FEW = {"num_features": 4, "penalties": (0.1, 3.0), "sample_bins": 500}


def test_validation_equals_refits_without_the_group(rng):
    parts = make_parts(rng)
    plan = planned(Recipe(**FEW, balance="weights"), parts)
    features, is_slip = together(parts)
    z = plan.frame(features)
    weights = (len(is_slip) / (2 * torch.bincount(is_slip.long()).double()))[is_slip.long()]
    rows = torch.tensor([material == "b" for r, _, s in parts for material in r.material * len(s)])
    assert [row["penalty"] for row in plan.validation] == [0.1, 3.0]
    for row in plan.validation:
        others = TrainingBins(z[~rows], is_slip[~rows], weights[~rows])
        says_slip = fit_machine(others, row["penalty"])(z[rows]) >= 0
        expected = recalls_mean(says_slip, is_slip[rows])
        assert row["balanced_accuracy"]["b"] == pytest.approx(expected)
        assert row["mean"] == pytest.approx(sum(row["balanced_accuracy"].values()) / 3)
    best = max(row["mean"] for row in plan.validation)
    assert plan.penalty == min(r["penalty"] for r in plan.validation if r["mean"] == best)


def test_scores_are_calibrated_by_machines_that_never_met_the_group(rng):
    parts = make_parts(rng)
    plan = planned(Recipe(**FEW, balance="weights"), parts)
    features, is_slip = together(parts)
    z = plan.frame(features)
    weights = (len(is_slip) / (2 * torch.bincount(is_slip.long()).double()))[is_slip.long()]
    material = [r.material for r, _, s in parts for _ in s]
    scores = torch.zeros(len(is_slip), dtype=torch.float64)
    for name in set(material):
        mine = torch.tensor([each == name for each in material])
        others = TrainingBins(z[~mine], is_slip[~mine], weights[~mine])
        scores[mine] = fit_machine(others, plan.penalty)(z[mine])
    expected = fit_platt(scores, is_slip, weights)
    found = calibration_from_dict(plan.calibration)
    assert (found.slope, found.offset) == pytest.approx((expected.slope, expected.offset), rel=1e-6)
    assert Plan.of(plan.facts(), plan.frame.scaler).calibration == plan.calibration


def test_scores_that_tell_slip_backwards_are_not_calibrated(rng, caplog):
    features, is_slip = together(make_parts(rng))
    bins = TrainingBins(features.double(), is_slip)
    assert selection._calibration(-is_slip.double(), bins.is_slip, bins.weights) is None
    assert "slip has the lower scores" in caplog.text


def test_size_offset_and_penalty_are_chosen_together(rng):
    recipe = Recipe(num_features=[5, 2], offsets=[0.5, 2.0], penalties=(0.1, 1.0))
    plan = planned(recipe, make_parts(rng))
    assert len(plan.validation) == 8
    best = max(plan.validation, key=lambda row: row["mean"])
    assert len(plan.frame.selected) == best["num_features"] == plan.frame.scaler.minimum.numel()
    assert (plan.kernel.to_dict(), plan.penalty) == (best["kernel"], best["penalty"])


@pytest.mark.parametrize("bins", [10, 40], ids=["bins kept", "sums"])
@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_neither_order_nor_workers_change_the_machine(bins, balance, rng):
    parts = make_parts(rng, bins=bins, share=0.7)
    recipe = Recipe(**FEW | {"num_features": 12}, balance=balance)
    plan, other = planned(recipe, parts), planned(recipe, parts[::-1])
    assert plan.facts() == other.facts()
    assert plan.adds_up == (bins == 40)  # 91 monomials of 12 features
    whole = passed(plan, parts)
    shares = [passed(plan, parts[start::3]) for start in (2, 0, 1)]
    for share in shares[1:]:
        shares[0].merge(share)
    assert_same_head(whole.solve(), shares[0].solve())


def test_the_machine_of_sums_is_the_machine_of_bins(rng):
    parts = make_parts(rng, bins=60, share=0.7)
    plan = planned(Recipe(**FEW, balance="weights"), parts)
    assert plan.adds_up
    features, is_slip = together(parts)
    weights = (len(is_slip) / (2 * torch.bincount(is_slip.long()).double()))[is_slip.long()]
    z = plan.frame(features)
    by_bins = fit_machine(TrainingBins(z, is_slip, weights), plan.penalty, plan.kernel)
    by_sums = passed(plan, parts).solve()
    torch.testing.assert_close(by_sums(z), by_bins(z), rtol=1e-9, atol=1e-9)


def test_undersampling_keeps_about_as_many_slips_as_non_slips(rng):
    parts = make_parts(rng, cycles=8, share=0.8)
    plan = planned(Recipe(**FEW), parts)
    non_slips = int((~together(parts)[1]).sum())
    kept = passed(plan, parts).stats.count.tolist()
    assert kept[0] == non_slips
    assert abs(kept[1] - non_slips) < 5 * non_slips**0.5
    assert plan.num_bins == 2 * non_slips


def test_other_kernels_keep_their_bins(rng):
    parts = make_parts(rng, bins=60)
    for recipe in (Recipe(**FEW, degree=3), Recipe(**FEW, kernel="rbf", gamma=0.3)):
        plan = planned(recipe, parts)
        assert not plan.adds_up
        head = passed(plan, parts).solve()
        features, is_slip = together(parts)
        assert recalls_mean(head(plan.frame(features)) >= 0, is_slip) > 0.8
        assert head.num_features == 4


def test_one_group_leaves_nothing_to_validate(rng, caplog):
    plan = planned(Recipe(num_features=3, penalties=(0.1, 0.2, 3.0)), make_parts(rng, "a"))
    assert plan.penalty == 0.2
    assert plan.validation == []
    assert "unvalidated" in caplog.text


def test_unvalidated_it_is_the_middle_penalty_of_the_most_features(rng, caplog):
    recipe = Recipe(num_features=[2, 3], offsets=[0.5, 2.0], penalties=(3.0, 0.1, 0.2))
    plan = planned(recipe, make_parts(rng, "a"))
    assert (len(plan.frame.selected), plan.penalty) == (3, 0.2)
    assert "K=3" in caplog.text


def test_groups_of_one_class_each_cannot_validate(rng):
    parts = [
        (recording, features, torch.full_like(is_slip, recording.material in "ab"))
        for recording, features, is_slip in make_parts(rng, "abcd")
    ]
    with pytest.raises(ValueError, match="no validation group has bins of both classes"):
        planned(Recipe(**FEW), parts)


@pytest.mark.parametrize("change", [{"degree": 3}, {"kernel": "rbf", "gamma": 0.3}], ids=str)
@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_thinned_bins_stand_for_all(change, balance, rng, monkeypatch, caplog):
    parts = make_parts(rng, cycles=5, bins=80, share=0.6)
    recipe = Recipe(**FEW | {"penalties": 0.01}, balance=balance, **change)
    whole = planned(recipe, parts)
    monkeypatch.setattr(selection, "MOST_KEPT_BINS", 300)
    thinned = planned(recipe, parts)
    assert (whole.stands_for, thinned.num_bins) == (1.0, 300)
    assert thinned.stands_for == pytest.approx(whole.num_bins / 300, rel=1e-3)
    assert "takes 300 of" in caplog.text
    z = whole.frame(together(parts)[0])
    full, few = (passed(plan, parts).solve()(z) for plan in (whole, thinned))
    lighter = passed(replace(thinned, stands_for=1.0), parts).solve()(z)
    assert (few - full).square().mean() < 0.5 * (lighter - full).square().mean()


def test_degree_one_takes_every_bin(rng, monkeypatch):
    monkeypatch.setattr(selection, "MOST_KEPT_BINS", 50)
    parts = make_parts(rng)
    plan = planned(Recipe(**FEW, degree=1, balance="weights"), parts)
    gathered = passed(plan, parts)
    assert gathered.stats is not None
    assert gathered.stats.degree == 1
    assert int(gathered.stats.count.sum()) == plan.num_bins == 240


def test_a_single_choice_is_taken_as_it_is(rng):
    plan = planned(Recipe(num_features=3, penalties=float("inf")), make_parts(rng))
    assert plan.penalty == float("inf")
    assert plan.validation == []


def test_typical_features_lie_midway_between_the_classes(rng):
    parts = make_parts(rng, share=0.2)
    plan = planned(Recipe(**FEW), parts)
    features, is_slip = together(parts)
    z = plan.frame(features)
    assert 0 < is_slip.double().mean() < 0.4
    expected = (z[is_slip].mean(0) + z[~is_slip].mean(0)) / 2  # the sample holds every bin
    torch.testing.assert_close(torch.tensor(plan.imputation, dtype=torch.float64), expected)


def test_gaussians_are_of_the_selected_features_of_either_class(rng):
    parts = make_parts(rng, share=0.2)
    plan = planned(Recipe(**FEW), parts)
    features, is_slip = together(parts)
    z = plan.frame(features)
    assert plan.gaussians is not None
    for place, mine in enumerate((~is_slip, is_slip)):
        torch.testing.assert_close(plan.gaussians.mean[place], z[mine].mean(0))
        spread = z[mine].var(0, correction=0) + RESOLUTION
        torch.testing.assert_close(plan.gaussians.covariance[place].diagonal(), spread)
    cubic = Recipe(**FEW, degree=3)
    assert planned(cubic, parts).gaussians is None


def test_a_plan_survives_its_facts(rng):
    plan = planned(Recipe(**FEW, compress=True), make_parts(rng))
    parts = (plan.frame.scaler, plan.gaussians)
    again = Plan.of(json.loads(json.dumps(plan.facts(), allow_nan=False)), *parts)
    assert again.facts() == plan.facts()
    assert again == plan
    older = {name: fact for name, fact in plan.facts().items() if name != "among"}
    assert Plan.of(older, *parts) == plan  # written before rankings were restricted


def test_a_recording_counts_once(rng):
    parts = make_parts(rng, bins=60)
    gathered = passed(planned(Recipe(**FEW), parts), parts)
    with pytest.raises(ValueError, match="already"):
        gathered.update(str(parts[0][0]), parts[0][1], parts[0][2])
    with pytest.raises(ValueError, match="both statistics"):
        gathered.merge(passed(gathered.plan, parts[:1]))
