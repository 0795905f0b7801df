"""Abstention: thresholds beside their definition and by simulation, at the fit, and in a file."""

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
from tactslip_torch.model.abstention import (
    ABSTAIN,
    KEY,
    NON_SLIP,
    SLIP,
    Abstention,
    abstention_of,
    answers,
    fewest_recordings,
    thresholds,
)
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.onset.decisions import Decider, answer_of
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.training.abstention import Abstaining, held_out_scores
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.selection import plan_detector

NUM_FEATURES = len(FeaturePool(SMALL_HAND).names)


def mean_share(wrong, unit):
    """Mean over units of the share of their bins that are wrong."""
    return float(torch.stack([wrong[unit == u].double().mean() for u in unit.unique()]).mean())


def drawn(num, generator, apart=0.8):
    """Scores, truth and unit of recordings that differ in difficulty and in their number of bins.

    All bins of one class of a recording lie close together, as neighbours do; the classes' means
    lie twice ``apart``.
    """
    scores, truth, unit = [], [], []
    for index in range(num):
        for is_slip in (True, False):
            size = int(torch.randint(1, 8, (), generator=generator))
            centre = torch.randn((), generator=generator) + (apart if is_slip else -apart)
            scores.append(centre + 0.05 * torch.randn(size, generator=generator))
            truth.append(torch.full((size,), is_slip))
            unit.append(torch.full((size,), index))
    return torch.cat(scores).double(), torch.cat(truth), torch.cat(unit)


def risks(found, scores, is_slip, unit):
    """Of slip and of non-slip: mean share of a recording that is answered with the other."""
    given = answers(scores, found.low, found.high)
    wrong_slip, wrong_rest = given[is_slip] == NON_SLIP, given[~is_slip] == SLIP
    return mean_share(wrong_slip, unit[is_slip]), mean_share(wrong_rest, unit[~is_slip])


def by_definition(x, unit, most_risk):
    """The highest value of x, or -inf, that may be the threshold below which truth is excluded."""
    num = len(unit.unique())
    good = [
        float(t) for t in x if (num * mean_share(x < t, unit) + 1) / (num + 1) <= most_risk + 1e-12
    ]
    return max(good, default=-math.inf)


@pytest.mark.parametrize("coverage", [0.5, 0.9, 0.95])
@pytest.mark.parametrize("num", [3, 9, 10, 30])
def test_thresholds_are_the_boldest_that_the_definition_allows(num, coverage):
    scores, is_slip, unit = drawn(num, torch.Generator().manual_seed(num))
    found = thresholds(scores, is_slip, unit, coverage)
    low = by_definition(scores[is_slip], unit[is_slip], 1 - coverage)
    high = -by_definition(-scores[~is_slip], unit[~is_slip], 1 - coverage)
    assert found.low == min(low, 0.0)
    assert found.high == max(math.nextafter(high, math.inf), 0.0)
    assert found.num_slip == found.num_non_slip == num
    turn = torch.randperm(len(scores))
    assert found == thresholds(scores[turn], is_slip[turn], unit[turn], coverage)


def test_the_next_recording_is_covered_in_the_mean():
    """Over calibration sets and the next recording alike; bins as units would miss it."""
    generator, num, coverage, trials = torch.Generator().manual_seed(1), 4, 0.75, 600
    found = []
    for _ in range(trials):
        scores, is_slip, unit = drawn(num + 1, generator, apart=0.0)
        past = unit < num
        newest = (scores[~past], is_slip[~past], unit[~past])
        # without the + 1 of (n R + 1) / (n + 1): the coverage at which the two agree
        bolder = 1 - (num * (1 - coverage) + 1) / (num + 1)
        ways = ((unit, coverage), (unit, bolder), (torch.arange(len(unit)), coverage))
        own = [thresholds(scores[past], is_slip[past], u[past], c) for u, c in ways]
        found.append([risks(each, *newest) for each in own])
    most = 1 - coverage
    noise = 4 * math.sqrt(most * coverage / trials)  # four standard errors of a share of that mean
    ours, plain, bins = torch.tensor(found).mean(0)
    assert ((ours > 0) & (ours <= most + noise)).all(), ours  # it is not by never answering
    assert (plain > most + noise).all(), plain
    assert (bins > ours).all(), bins


def test_too_few_recordings_never_answer_and_separate_classes_always():
    assert fewest_recordings(0.9) == 9
    found = [thresholds(*drawn(n, torch.Generator().manual_seed(3)), 0.9) for n in (8, 9)]
    assert found[0][:2] == (-math.inf, math.inf)
    assert all(map(math.isfinite, found[1]))
    scores = torch.cat([torch.linspace(1, 2, 40), -torch.linspace(1, 2, 40)])
    apart = thresholds(scores, scores > 0, torch.arange(80) % 20, 0.9)
    assert apart[:2] == (0.0, 0.0)  # they would cross at 1 and -1


def test_recordings_weigh_alike_whatever_their_length():
    # nineteen recordings of one bin each and one, of which all is wrong, of a thousand
    scores = torch.cat([torch.ones(19), torch.full((1000,), -1.0), -torch.ones(20)])
    is_slip = torch.arange(len(scores)) < 1019
    unit = torch.cat([torch.arange(19), torch.full((1000,), 19), torch.arange(20)])
    assert thresholds(scores, is_slip, unit, 0.9).low == 0  # one of twenty may be lost
    assert thresholds(scores, is_slip, torch.arange(len(scores)), 0.9).low == -1  # most may not


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_answers_in_any_shape_and_dtype(dtype):
    scores = torch.tensor([[-2.0, -1.0, 0.0], [0.5, 3.0, math.nan]], dtype=dtype)
    wanted = [[NON_SLIP, ABSTAIN, ABSTAIN], [SLIP, SLIP, ABSTAIN]]
    assert answers(scores, -1.0, 0.5).tolist() == wanted
    assert answers(scores[:0], -1.0, 0.5).shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, t, u: (s, t, u, 1.0), "coverage must lie between 0 and 1"),
        (lambda s, t, u: (s, t, u, True), "coverage must lie between 0 and 1"),
        (lambda s, t, u: (s[:-1], t, u, 0.9), "of one N"),
        (lambda s, t, u: (s / 0, t, u, 0.9), "must be finite"),
        (lambda s, t, u: (s, t | True, u, 0.9), "no non-slip bin"),
    ],
)
def test_what_sets_no_thresholds_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        thresholds(*change(*drawn(5, torch.Generator().manual_seed(0))))


# At the fit ------------------------------------------------------------------------------------


def fitted(num_cycles=8):
    """A plan and its sample: three materials, features that shift with every recording."""
    generator = torch.Generator().manual_seed(0)
    survey = Survey(NUM_FEATURES, 60)
    for material in "abc":
        for cycle in range(num_cycles):
            is_slip = torch.arange(12) >= 4
            shift = 0.3 * torch.randn(NUM_FEATURES, generator=generator)
            noise = torch.randn(12, NUM_FEATURES, generator=generator)
            features = noise + shift + 0.4 * is_slip[:, None]
            survey.update(f"{material}/{cycle}", material, features, is_slip)
    recipe = Recipe(num_features=6, penalties=(0.1, 1.0), balance="weights")
    return plan_detector(recipe, survey), survey.sample.bins()


@pytest.mark.parametrize("left_out", ["recording", "group"])
def test_scores_are_those_of_machines_refitted_without_the_bin_s_own(left_out):
    plan, sample = fitted()
    scores, bins = held_out_scores(plan, sample, left_out), plan.training_bins(sample)
    group = sample.recording if left_out == "recording" else sample.group
    for number in (0, int(group.max())):
        mine = group == number
        rest = (x[~mine] for x in (bins.features, bins.is_slip, bins.weights))
        without = fit_machine(TrainingBins(*rest), plan.penalty, plan.kernel)
        wanted = without(bins.features[mine])
        torch.testing.assert_close(scores[mine], wanted, rtol=1e-6, atol=1e-8)
    wanted = thresholds(scores, sample.is_slip, sample.recording, 0.9)  # whatever is left out
    found = Abstaining(0.9, left_out).abstention(plan, sample)
    assert (found.low, found.high) == (wanted.low, wanted.high)
    assert found.metadata["unit"] == "recording"
    assert found.metadata["left_out"] == ("material" if left_out == "group" else "recording")
    assert found.metadata["num_recordings"] == {"slip": 24, "non_slip": 24}


def test_a_plan_gets_thresholds_and_more_coverage_abstains_more():
    plan, sample = fitted()
    found = [Abstaining(c).settle(plan, sample).abstain for c in (0.6, 0.8, 0.9, 0.95)]
    lows, highs = [one["low"] for one in found], [one["high"] for one in found]
    assert lows == sorted(lows, reverse=True)
    assert highs == sorted(highs)
    assert lows[-1] < 0 < highs[-1]
    assert Abstaining(None).settle(plan, sample) is plan


def test_too_few_recordings_are_said_and_cost_no_fit(caplog):
    plan, sample = fitted(4)
    with caplog.at_level(logging.WARNING):
        assert Abstaining(0.95).settle(plan, sample) is plan
    wanted = "the detector never abstains: coverage=0.95 takes 19 training recordings of either"
    assert wanted in caplog.text


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (("much", "recording"), "coverage must lie between 0 and 1, such as 0.95, got 'much'"),
        ((0.9, "finger"), "coverage_by must be recording or group, got 'finger'"),
    ],
)
def test_settings_that_are_none_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Abstaining(*values)


# In a detector's file ----------------------------------------------------------------------------


def test_thresholds_survive_the_file_and_decide_where_it_abstains(tmp_path):
    detector, kept = small_detector(), Abstention(0.9, -0.5, 0.25, {"unit": "recording"})
    settings = AlarmSettings(20, Platt(1.0, 0.0), KOfN(1, 1), 1.0, target_per_hour=None)
    score = torch.tensor([-1.0, -0.1, 0.1, 1.0, 1.0])
    is_valid = torch.tensor([True, True, True, True, False])
    decisions = Decider(settings, 2000.0, 100, 25).decide(score, is_valid)
    assert abstention_of(detector) is None
    assert answer_of(detector, decisions).tolist() == [0, 0, 1, 1, -1]  # by the sign
    with pytest.raises(ValueError, match=r"never abstains; train it with coverage=0\.95"):
        Abstention.of(detector)
    detector.info[KEY] = kept.to_dict()
    assert answer_of(detector, decisions).tolist() == [0, -1, -1, 1, -1]
    detector.save(tmp_path / "a.pt")
    assert Abstention.of(SlipDetector.load(tmp_path / "a.pt")) == kept
    assert replace(kept, high=0.0).answer(torch.zeros(1)).tolist() == [1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"low": 0.1}, "expected finite low <= 0 <= high"),
        ({"high": math.inf}, "expected finite low <= 0 <= high"),
        ({"low": None}, "no thresholds of abstention of this version"),
        ({"coverage": 0}, "coverage must lie between"),
    ],
)
def test_thresholds_that_cannot_be_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Abstention.from_dict(Abstention(0.9, -0.5, 0.25).to_dict() | change)
