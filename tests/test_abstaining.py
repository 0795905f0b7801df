"""Thresholds for unsure answers at the fit: from which scores, kept how, counted how."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import pytest
import torch
from small_detector import small_detector
from small_set import SMALL_HAND

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.abstention import KEY, Abstention, abstention_of
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.conformal import thresholds
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.onset.decisions import Decider, Decisions, answer_of
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.training.abstention import Abstaining, abstention, groups_of, held_out_scores
from tactslip_torch.training.recipe import Recipe, stand_for
from tactslip_torch.training.selection import Plan, plan_detector

NUM_FEATURES = len(FeaturePool(SMALL_HAND).names)


def quietly(items, what):
    return items


def surveyed(num_cycles: int = 8, apart: float = 0.4) -> Survey:
    """Three materials, features that lie apart by class and shift with every recording."""
    generator = torch.Generator().manual_seed(0)
    survey = Survey(NUM_FEATURES, 60)
    for material in "abc":
        for cycle in range(num_cycles):
            is_slip = torch.arange(12) >= 4
            shift = 0.3 * torch.randn(NUM_FEATURES, generator=generator)
            noise = torch.randn(12, NUM_FEATURES, generator=generator)
            features = noise + shift + apart * is_slip[:, None]
            survey.update(f"{material}/{cycle}", material, features, is_slip)
    return survey


@pytest.fixture(scope="module")
def fitted() -> tuple[Plan, Recipe, Survey]:
    recipe, survey = Recipe(num_features=6, penalties=(0.1, 1.0), balance="weights"), surveyed()
    return plan_detector(recipe, survey, quietly), recipe, survey


@pytest.mark.parametrize("left_out", ["recording", "group"])
def test_scores_are_those_of_machines_refitted_without_the_bin_s_own(fitted, left_out):
    plan, recipe, survey = fitted
    sample = survey.sample.bins()
    scores = held_out_scores(plan, recipe, survey, groups_of(sample, left_out))
    weights = stand_for(sample, recipe, survey.moments.count.tolist())
    z = plan.frame(sample.features)
    group = sample.recording if left_out == "recording" else sample.group
    for number in (0, int(group.max())):
        mine = group == number
        rest = TrainingBins(z[~mine], sample.is_slip[~mine], weights[~mine])
        without = fit_machine(rest, plan.penalty, plan.kernel)
        torch.testing.assert_close(scores[mine], without(z[mine]), rtol=1e-6, atol=1e-8)


def test_the_unit_is_the_recording_whatever_is_left_out(fitted):
    plan, recipe, survey = fitted
    sample = survey.sample.bins()
    for left_out in ("recording", "group"):
        scores = held_out_scores(plan, recipe, survey, groups_of(sample, left_out))
        wanted = thresholds(scores, sample.is_slip, sample.recording, 0.9)
        found = abstention(plan, recipe, survey, 0.9, left_out)
        assert (found.low, found.high) == (wanted.low, wanted.high)
        assert found.facts["unit"] == "recording"
        assert found.facts["left_out"] == {"recording": "recording", "group": "material"}[left_out]
        assert found.facts["num_recordings"] == {"slip": 24, "non_slip": 24}


def test_more_coverage_leaves_more_unsure(fitted):
    plan, recipe, survey = fitted
    found = [abstention(plan, recipe, survey, coverage) for coverage in (0.6, 0.8, 0.9, 0.95)]
    lows, highs = [one.low for one in found], [one.high for one in found]
    assert lows == sorted(lows, reverse=True)
    assert highs == sorted(highs)
    assert lows[-1] < 0 < highs[-1]


def test_a_plan_keeps_its_thresholds(fitted):
    plan, recipe, survey = fitted
    settled = Abstaining(0.9).settle(plan, recipe, survey)
    assert settled.abstain == abstention(plan, recipe, survey, 0.9).to_dict()
    assert replace(settled, abstain=None) == plan
    again = Plan.of(settled.facts(), plan.frame.scaler)
    assert again.abstain == settled.abstain
    older = {name: value for name, value in plan.facts().items() if name != "abstain"}
    assert Plan.of(older, plan.frame.scaler).abstain is None
    assert Abstaining(None).settle(plan, recipe, survey) is plan


def test_too_few_recordings_are_said_and_cost_no_fit(caplog):
    recipe, survey = Recipe(num_features=6, penalties=(0.1, 1.0)), surveyed(4)
    plan = plan_detector(recipe, survey, quietly)
    with pytest.raises(ValueError, match=r"coverage=0\.95 takes 19 training recordings of either"):
        abstention(plan, recipe, survey, 0.95)
    with caplog.at_level(logging.WARNING):
        assert Abstaining(0.95).settle(plan, recipe, survey) is plan
    assert "no answer is ever unsure: coverage=0.95 takes 19" in caplog.text


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((1.0, "recording"), "coverage must lie between 0 and 1"),
        (("much", "recording"), "coverage must lie between 0 and 1, such as 0.95, got 'much'"),
        ((0.9, "finger"), "coverage_by must be recording or group, got 'finger'"),
    ],
)
def test_settings_that_are_none_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Abstaining(*values)


# In a detector's file --------------------------------------------------------------------------


def test_thresholds_survive_the_file(tmp_path):
    detector, kept = small_detector(), Abstention(0.9, -0.5, 0.25, {"unit": "recording"})
    assert abstention_of(detector) is None
    with pytest.raises(ValueError, match=r"no thresholds .* train it with coverage=0\.95"):
        Abstention.of(detector)
    detector.info[KEY] = kept.to_dict()
    detector.save(tmp_path / "a.pt")
    assert Abstention.of(SlipDetector.load(tmp_path / "a.pt")) == kept
    given = kept.answer(torch.tensor([-0.6, -0.5, 0.0, 0.2, 0.25, math.nan]))
    assert given.tolist() == [0, -1, -1, -1, 1, -1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"low": 0.1}, "expected finite low <= 0 <= high"),
        ({"high": math.inf}, "expected finite low <= 0 <= high"),
        ({"low": None}, "no thresholds for unsure answers of this version"),
        ({"coverage": 0}, "coverage must lie between"),
    ],
)
def test_thresholds_that_cannot_be_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Abstention.from_dict(Abstention(0.9, -0.5, 0.25).to_dict() | change)
    with pytest.raises(ValueError, match="of this version"):
        Abstention.from_dict({"coverage": 0.9})


def decided(score, is_valid) -> Decisions:
    settings = AlarmSettings(20, Platt(1.0, 0.0), KOfN(1, 1), 1.0, target_per_hour=None)
    return Decider(settings, 2000.0, 100, 25).decide(score, is_valid)


def test_a_decision_is_unsure_between_the_thresholds_and_where_a_sensor_is_broken():
    detector = small_detector()
    score = torch.tensor([-1.0, -0.1, 0.1, 1.0, 1.0])
    decisions = decided(score, torch.tensor([True, True, True, True, False]))
    assert answer_of(detector, decisions).tolist() == [0, 0, 1, 1, -1]  # by the sign
    detector.info[KEY] = Abstention(0.9, -0.5, 0.5).to_dict()
    assert answer_of(detector, decisions).tolist() == [0, -1, -1, 1, -1]
