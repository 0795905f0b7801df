"""Rates with intervals, and the threshold for a target, against brute force and fresh streams."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, chi2
from test_rules import drawn_times, drawn_values

from tactslip_torch.onset import thresholds
from tactslip_torch.onset.rules import latch
from tactslip_torch.onset.thresholds import (
    Budget,
    false_alarms,
    lowest_threshold,
)


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_bounds_are_those_of_garwood_and_of_clopper_and_pearson(confidence: float) -> None:
    rate, share = Budget("held", 1.0, False, confidence), Budget("taps", 0.1, True, confidence)
    for alarms in (0, 1, 7, 199):
        upper = chi2.isf(1 - confidence, 2 * alarms + 2) / 2
        assert rate.bound(alarms, 2.5) == pytest.approx(upper / 2.5, rel=1e-9)
        upper = beta.isf(1 - confidence, alarms + 1, 200 - alarms)
        assert share.bound(alarms, 200) == pytest.approx(upper, rel=1e-9)
    assert rate.bound(0, 0.0) == share.bound(0, 0) == math.inf
    assert share.bound(200, 200) == share.bound(300, 200) == 1  # several alarms a knock


def test_budgets_hold_as_often_as_is_stated() -> None:
    # of recordings at a rate, or share, just above the limit, few show that it is kept
    source = np.random.default_rng(0)
    rate, share = Budget("held", 2.0, False, 0.9), Budget("taps", 0.05, True, 0.9)
    counts = source.poisson(2.0 * 5, 20_000)
    assert 0.05 < np.mean(counts <= rate.allowed(5)) <= 0.105  # a standard error is 0.002
    knocks = source.binomial(400, 0.05, 20_000)
    assert 0.05 < np.mean(knocks <= share.allowed(400)) <= 0.105


@pytest.mark.parametrize(
    ("budget", "amount", "allowed"),
    [
        (Budget("held", 1.0), 10.0, 4),  # bounds: 4 show 9.15, 5 show 10.51
        (Budget("machine", 10.0), 0.3, 0),  # exp(-3) is just below 0.05
        (Budget("held", 1.0, confidence=0.5), 10.0, 9),  # medians: 9 show 9.67, 10 show 10.67
        (Budget("taps", 0.01, True), 299, 0),  # 0.99 ** 299 = 0.0495
        (Budget("taps", 0.5, True), 5, 0),  # none: 0.45, one: 0.66
    ],
)
def test_alarms_that_are_allowed(budget: Budget, amount: float, allowed: int) -> None:
    assert budget.allowed(amount) == allowed


@pytest.mark.parametrize(
    ("budget", "amount", "match"),
    [
        (
            Budget("machine", 10.0),
            0.29,
            r"0\.29 h of machine cannot show a rate of at most 10 .* 0\.3 h",
        ),
        (
            Budget("held", 1.0, confidence=0.9),
            0.0,
            r"0 h of held .* give at least 2\.303 h, or a la",
        ),
        (Budget("taps", 0.01, True), 298, r"298 knocks of taps cannot show a share .* 299 knocks"),
    ],
)
def test_too_little_to_show_a_budget_is_refused_with_what_would_do(budget, amount, match) -> None:
    with pytest.raises(ValueError, match=match) as error:
        budget.allowed(amount)
    assert "\n" not in str(error.value)
    least = float(str(error.value).split("at least ")[1].split()[0])
    assert budget.allowed(least) == 0


@pytest.mark.parametrize(
    ("numbers", "match"),
    [
        ({"limit": 0.0}, "onset.budget of held must be positive, got 0"),
        ({"limit": math.inf}, "onset.budget of held must be positive, got inf"),
        ({"limit": 1.0, "is_share": True}, "onset.budget of held must be between 0 and 1, got 1"),
        ({"limit": 1.0, "confidence": 1.0}, "onset.confidence must lie between 0 and 1, got 1"),
    ],
)
def test_what_is_no_budget(numbers, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Budget("held", **numbers)


def by_latch(scores, quiet, raised, threshold: float, how: dict[str, int]) -> int:
    """False alarms of all recordings, one decision after the other."""
    rows = zip(scores, quiet, raised, strict=True)
    return sum(
        is_alarm and is_quiet
        for row, of_quiet, other in rows
        for is_alarm, is_quiet in zip(
            latch(
                [float(x >= threshold or o) for x, o in zip(row, other, strict=True)], 1.0, **how
            )[0],
            of_quiet,
            strict=True,
        )
    )


@given(
    recordings=st.lists(drawn_values, min_size=1, max_size=4),
    allowed=st.integers(0, 6),
    how=drawn_times,
    seed=st.integers(0, 2**20),
    has_other=st.booleans(),
    most=st.sampled_from([5, 200_000]),
    least_quiet=st.sampled_from([1, 4]),
    one_by_one=st.sampled_from([500, 2]),
)
def test_the_lowest_threshold_is_that_of_trying_every_value(
    recordings,
    allowed: int,
    how,
    seed: int,
    has_other: bool,
    most: int,
    least_quiet: int,
    one_by_one: int,
) -> None:
    source = np.random.default_rng(seed)
    fine = source.random() < 0.5  # else many values are equal
    scores = [(np.array(row) + fine * source.random(len(row))).astype("f4") for row in recordings]
    quiet = [source.random(len(row)) < 0.8 for row in scores]
    raised = [source.random(len(row)) < 0.1 * has_other for row in scores]
    given_ = {**how, "is_raised": raised} if has_other else how
    ranked = np.sort(np.concatenate([row[q] for row, q in zip(scores, quiet, strict=True)]))[::-1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(thresholds, "_MOST_TRIED", most)
        patch.setattr(thresholds, "_LEAST_QUIET", least_quiet)
        patch.setattr(thresholds, "_TRIED_ONE_BY_ONE", one_by_one)
        if not len(ranked):
            with pytest.raises(ValueError, match="no decision to count alarms in"):
                lowest_threshold(scores, quiet, allowed, **given_)
            return
        found = lowest_threshold(scores, quiet, allowed, **given_)
    above = float(np.nextafter(ranked[0], np.float32(np.inf)))
    if found < above or by_latch(scores, quiet, raised, above, how) <= allowed:
        assert by_latch(scores, quiet, raised, found, how) <= allowed
    expected = above
    tried = max(1, min(most, len(ranked) // least_quiet))
    for value in dict.fromkeys(ranked[:tried].tolist()):
        if by_latch(scores, quiet, raised, value, how) > allowed:
            break
        expected = value
    assert found == expected if one_by_one == 500 else found in {above, *ranked.tolist()}


@given(values=drawn_values, how=drawn_times, seed=st.integers(0, 2**20))
def test_false_alarms_are_those_of_the_latch_in_quiet(values, how, seed: int) -> None:
    quiet = np.random.default_rng(seed).random(len(values)) < 0.5
    expected = by_latch([values], [quiet], [[False] * len(values)], 1, how)
    assert false_alarms(np.array(values) >= 1, quiet, **how) == expected
