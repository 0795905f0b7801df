"""Abstention: thresholds beside their definition and by simulation, at the fit, and in a file."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from small_detector import small_detector
from small_set import SMALL_HAND

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.model.calibration import ABSTENTION, Abstention, Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.onset.decisions import AlarmSettings, Decider, answer_of
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.training.plan import Abstaining, plan_detector
from tactslip_torch.training.recipe import Recipe

NUM_FEATURES = len(FeaturePool(SMALL_HAND).names)


def mean_share(wrong, unit):
    """Mean over units of the share of their bins that are wrong."""
    return float(torch.stack([wrong[unit == u].double().mean() for u in unit.unique()]).mean())


def drawn(num, generator, apart=0.8):
    """Scores, truth and unit of recordings that differ in difficulty and in their number of bins.

    All bins of one class of a recording lie close together, as neighbours do; the classes' means
    lie twice ``apart``.
    """
    parts = []
    for index in range(num):
        for is_slip in (True, False):
            size = int(torch.randint(1, 8, (), generator=generator))
            centre = torch.randn((), generator=generator) + (apart if is_slip else -apart)
            scores = (centre + 0.05 * torch.randn(size, generator=generator)).double()
            parts.append((scores, torch.full((size,), is_slip), torch.full((size,), index)))
    return tuple(map(torch.cat, zip(*parts, strict=True)))


def by_definition(x, unit, most_risk):
    """The highest value of x, or -inf, that may be the threshold below which truth is excluded."""
    num = len(unit.unique())
    good = [
        float(t) for t in x if (num * mean_share(x < t, unit) + 1) / (num + 1) <= most_risk + 1e-12
    ]
    return max(good, default=-math.inf)


@pytest.mark.parametrize("coverage", [0.5, 0.95])
@pytest.mark.parametrize("num", [20, 30])
def test_thresholds_are_the_boldest_that_the_definition_allows(num, coverage):
    scores, is_slip, unit = drawn(num, torch.Generator().manual_seed(num))
    found = Abstention.fit(scores, is_slip, unit, coverage)
    low = by_definition(scores[is_slip], unit[is_slip], 1 - coverage)
    high = -by_definition(-scores[~is_slip], unit[~is_slip], 1 - coverage)
    assert found.low == min(low, 0.0)
    assert found.high == max(math.nextafter(high, math.inf), 0.0)
    assert found.metadata["num_recordings"] == {"slip": num, "non_slip": num}
    turn = torch.randperm(len(scores))
    assert found == Abstention.fit(scores[turn], is_slip[turn], unit[turn], coverage)


def fit_drawn(change):
    return Abstention.fit(*change(*drawn(5, torch.Generator().manual_seed(0))))


def of_file(**changes):
    return Abstention.from_dict(Abstention(0.9, -0.5, 0.25).to_dict() | changes)


REFUSED = [
    (lambda: fit_drawn(lambda s, t, u: (s, t, u, 1.0)), "coverage must lie between 0 and 1"),
    (lambda: fit_drawn(lambda s, t, u: (s, t, u, True)), "coverage must lie between 0 and 1"),
    (lambda: fit_drawn(lambda s, t, u: (s[:-1], t, u, 0.9)), "of one N"),
    (lambda: fit_drawn(lambda s, t, u: (s / 0, t, u, 0.9)), "must be finite"),
    (
        lambda: fit_drawn(lambda s, t, u: (s, t | True, u, 0.5)),
        "5 with slip and 0 .*; lower it",
    ),
    (lambda: fit_drawn(lambda s, t, u: (s, t, u, 0.9)), "takes 9 training recordings"),
    (lambda: Abstaining("much", "recording"), "coverage must .* such as 0.95, got 'much'"),
    (lambda: Abstaining(0.9, "finger"), "coverage_by must be .* got 'finger'"),
    (lambda: of_file(low=0.1), "expected finite low <= 0 <= high"),
    (lambda: of_file(high=math.inf), "expected finite low <= 0 <= high"),
    (lambda: of_file(low=None), "no thresholds of abstention of this version"),
    (lambda: of_file(coverage=0), "coverage must lie between"),
]


@pytest.mark.parametrize(("attempt", "message"), REFUSED)
def test_what_cannot_be_is_refused(attempt, message):
    with pytest.raises(ValueError, match=message):
        attempt()


# At the fit ------------------------------------------------------------------------------------


def fitted(num_cycles=8):
    """A plan and its sample: three materials, features that shift with every recording."""
    generator = torch.Generator().manual_seed(0)
    statistics = TrainingStatistics(NUM_FEATURES, 60)
    for material in "abc":
        for cycle in range(num_cycles):
            is_slip = torch.arange(12) >= 4
            shift = 0.3 * torch.randn(NUM_FEATURES, generator=generator)
            noise = torch.randn(12, NUM_FEATURES, generator=generator)
            features = noise + shift + 0.4 * is_slip[:, None]
            statistics.update(f"{material}/{cycle}", material, features, is_slip)
    recipe = Recipe(num_features=6, penalties=(0.1, 1.0), balance="weights")
    return plan_detector(recipe, statistics), statistics.sample.bins()


@pytest.mark.parametrize("left_out", ["recording", "group"])
def test_thresholds_are_those_of_machines_refitted_without_the_bins_own(left_out):
    plan, sample = fitted()
    bins = plan.training_bins(sample)
    groups = sample.recording if left_out == "recording" else sample.group
    scores = torch.empty_like(bins.weights)
    for group in groups.unique():
        mine = groups == group
        rest = (x[~mine] for x in (bins.features, bins.is_slip, bins.weights))
        without = fit_machine(TrainingBins(*rest), plan.penalty, plan.kernel)
        scores[mine] = without(bins.features[mine])
    expected = Abstention.fit(scores, sample.is_slip, sample.recording, 0.9)  # a unit each
    found = Abstaining(0.9, left_out).settle(plan, sample).abstain
    assert (found["low"], found["high"]) == pytest.approx((expected.low, expected.high), rel=1e-6)
    assert found["unit"] == "recording"
    assert found["left_out"] == ("material" if left_out == "group" else "recording")
    assert found["num_recordings"] == {"slip": 24, "non_slip": 24}


# In a detector's file ----------------------------------------------------------------------------


def test_thresholds_survive_the_file_and_decide_where_it_abstains(tmp_path):
    detector, kept = small_detector(), Abstention(0.9, -0.5, 0.25, {"unit": "recording"})
    settings = AlarmSettings(20, Platt(1.0, 0.0), KOfN(1, 1), 1.0, target_per_hour=None)
    score = torch.tensor([-1.0, -0.1, 0.1, 1.0, 1.0])
    decisions = Decider(settings, 2000.0, 100, 25).decide(score, torch.arange(5) < 4)
    assert Abstention.of(detector) is None
    assert answer_of(detector, decisions).tolist() == [0, 0, 1, 1, -1]  # by the sign
    detector.info[ABSTENTION] = kept.to_dict()
    assert answer_of(detector, decisions).tolist() == [0, -1, -1, 1, -1]
    detector.save(tmp_path / "a.pt")
    assert Abstention.of(SlipDetector.load(tmp_path / "a.pt")) == kept
    assert replace(kept, high=0.0).answer(torch.zeros(1)).tolist() == [1]
