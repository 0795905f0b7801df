"""Rates with intervals, and the threshold for a target, against brute force and fresh streams."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, chi2
from test_rules import drawn_times, drawn_values

from tactslip_torch.onset import thresholds
from tactslip_torch.onset.rules import latch
from tactslip_torch.onset.thresholds import (
    Budget,
    alarm_rate,
    false_alarms,
    lowest_threshold,
    poisson_interval,
)


# ---------------------------------------------------------------------------- the Poisson interval
@pytest.mark.parametrize("count", [0, 1, 37, 100_000])
@pytest.mark.parametrize("level", [0.5, 0.999])
def test_poisson_interval_is_that_of_chi_square(count: int, level: float) -> None:
    tail = (1 - level) / 2
    low = chi2.ppf(tail, 2 * count) / 2 if count else 0.0
    high = chi2.isf(tail, 2 * count + 2) / 2
    assert poisson_interval(count, level) == pytest.approx((low, high), rel=1e-9, abs=1e-300)


@pytest.mark.parametrize(("count", "level"), [(-1, 0.95), (math.inf, 0.9), (1, 0.0), (1, 1.0)])
def test_poisson_interval_of_nonsense(count: float, level: float) -> None:
    with pytest.raises(ValueError, match=r"must not be negative|must lie between"):
        poisson_interval(count, level)


# ------------------------------------------------------------------------------------ the rate


def bootstrap(counts: np.ndarray, hours: np.ndarray, level: float) -> np.ndarray:
    source = np.random.default_rng(5)
    drawn = source.integers(len(counts), size=(20_000, len(counts)))
    return np.quantile(
        counts[drawn].sum(1) / hours[drawn].sum(1), [(1 - level) / 2, (1 + level) / 2]
    )


def test_interval_holds_the_bootstrap_and_that_of_clusters() -> None:
    # in ten recordings all alarms, in ninety none
    counts = np.array([12, 9, 1, 30, 5, 8, 14, 3, 2, 6] + [0] * 90)
    hours = np.linspace(0.5, 1.5, 100)
    found = alarm_rate(counts.tolist(), hours.tolist(), level=0.9)
    drawn = bootstrap(counts, hours, 0.9)
    total = counts.sum()
    expected = total * hours / hours.sum()
    size = ((counts - expected) ** 2).sum() / total * 100 / 99
    low, high = chi2.ppf(0.05, 2 * total / size) / 2, chi2.isf(0.05, 2 * total / size + 2) / 2
    assert found.low == pytest.approx(min(drawn[0], low * size / hours.sum()), rel=0.05)
    assert found.high == pytest.approx(max(drawn[1], high * size / hours.sum()), rel=0.05)
    assert found.high > 1.3 * poisson_interval(int(total), 0.9)[1] / hours.sum()


@pytest.mark.parametrize(
    ("counts", "hours", "said"),
    [
        ([1, 2], [1.0], r"one count and one number of hours .* got \(2,\) and \(1,\)"),
        ([[1]], [[1.0]], "one count and one number of hours"),
        ([], [], "some time must have been watched, got 0 alarms in 0 h"),
        ([0], [0.0], "some time must have been watched"),
        ([-1, 3], [1.0, 1.0], "must not be negative"),
        ([1, 3], [-1.0, 2.0], "must not be negative"),
        ([1], [math.nan], "some time must have been watched"),
    ],
)
def test_rate_of_nonsense(counts, hours, said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        alarm_rate(counts, hours)
    assert "\n" not in str(error.value)


def clustered(source: np.random.Generator, num: int, total: float, size: float) -> np.ndarray:
    """Counts of recordings: clusters come by chance, each of a geometric number of alarms."""
    clusters = source.poisson(total / size / num, num)
    return np.array([source.geometric(1 / size, c).sum() if c else 0 for c in clusters])


@pytest.mark.parametrize(
    ("total", "size", "at_least"),
    # nominal 0.95; measured with 1000 draws of another seed: 0.96, 0.95, 0.94, 0.88
    [(60, 1, 0.93), (60, 6, 0.88), (10, 3, 0.80)],
)
def test_coverage_on_clustered_streams(
    total: int, size: int, at_least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 100 recordings of 6 minutes: 60 alarms of 20 clusters and so on. The last, of three clusters
    # that were seen, is where any method without a model falls short, and says how far.
    monkeypatch.setattr(thresholds, "_NUM_RESAMPLES", 400)
    source = np.random.default_rng(total + size)
    hours = torch.full((100,), 0.1)
    drawn = [torch.from_numpy(clustered(source, 100, total, size)) for _ in range(150)]
    found = [alarm_rate(counts, hours) for counts in drawn]
    true = total / 10
    covered = np.mean([one.low <= true <= one.high for one in found])
    assert covered >= at_least
    # not by being vacuous: a normal interval that knows the clusters is so wide
    known = 2 * 1.96 * math.sqrt(total * (2 * size - 1)) / 10
    assert np.median([one.high - one.low for one in found]) < 1.4 * known
    if size > 1:  # and Poisson's alone would not do
        ends = [poisson_interval(int(counts.sum())) for counts in drawn]
        assert np.mean([low <= total <= high for low, high in ends]) < covered - 0.1


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
