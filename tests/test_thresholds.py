"""Rates with intervals, and the threshold for a target, against brute force and fresh streams."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, chi2
from test_rules import by_hand, drawn_times, drawn_values
from torch import Tensor

from tactslip_torch.onset import thresholds
from tactslip_torch.onset.rules import Cusum, KOfN, Rule, latch
from tactslip_torch.onset.thresholds import (
    AlarmRate,
    Budget,
    alarm_counts,
    alarm_rate,
    choose_threshold,
    false_alarms,
    lowest_threshold,
    poisson_interval,
)

PLAIN = {"rearm": 1, "refractory": 0}
RAW = KOfN(1, 1)  # the statistic is the ratio


# ---------------------------------------------------------------------------- the Poisson interval
@pytest.mark.parametrize("count", [0, 1, 37, 100_000])
@pytest.mark.parametrize("level", [0.5, 0.999])
def test_poisson_interval_is_that_of_chi_square(count: int, level: float) -> None:
    tail = (1 - level) / 2
    low = chi2.ppf(tail, 2 * count) / 2 if count else 0.0
    high = chi2.isf(tail, 2 * count + 2) / 2
    assert poisson_interval(count, level) == pytest.approx((low, high), rel=1e-9, abs=1e-300)


def test_no_alarm_in_an_hour_leaves_three_point_seven_possible() -> None:
    found = alarm_rate([0, 0], [0.5, 0.5])
    assert (found.alarms, found.per_hour, found.low) == (0, 0, 0)
    assert found.high == pytest.approx(math.log(40))  # exp(-high) = 0.025


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


def test_bootstrap_alone_sets_an_end_that_it_reaches_farther() -> None:
    # short recordings full of alarms: which are drawn decides how long was watched
    counts, hours = np.array([40, 40, 0, 0]), np.array([0.001, 0.001, 1.0, 1.0])
    found = alarm_rate(counts.tolist(), hours.tolist())
    assert found.high == pytest.approx(bootstrap(counts, hours, 0.95)[1], rel=0.01)
    assert found.high == pytest.approx(40_000)  # four short ones, one time in sixteen


def test_recordings_not_watched_at_all_are_not_drawn() -> None:
    found = alarm_rate([40, 40, 0, 0, 0], [0.001, 0.001, 1.0, 1.0, 0.0])
    assert found.high == pytest.approx(40_000)  # drawn alone it would have no rate


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


# ------------------------------------------------------------------------------- the threshold
def smooth(noise: Tensor, memory: int) -> Tensor:
    """Means over so many neighbours, of unit variance: ``[*, T + memory - 1] -> [*, T]``."""
    sums = torch.nn.functional.pad(noise, (1, 0)).double().cumsum(-1)
    return ((sums[..., memory:] - sums[..., :-memory]) / math.sqrt(memory)).float()


def brute(statistics: list[list[float]], allowed: int, how: dict[str, int]) -> tuple[float, int]:
    """The definition: every value tried, from the top, until one raises too many."""
    values = {x for row in statistics for x in row}
    top = max(values)
    tried = sorted(values)
    best, alarms = float(np.nextafter(np.float32(top), np.float32(np.inf))), 0
    for threshold in reversed(tried):
        found = sum(sum(by_hand(row, threshold, **how)[0]) for row in statistics)
        if found > allowed:
            break
        best, alarms = threshold, found
    return best, alarms


@given(
    recordings=st.lists(drawn_values, min_size=1, max_size=4),
    allowed=st.integers(0, 8),
    how=drawn_times,
)
def test_threshold_is_that_of_brute_force(recordings, allowed: int, how) -> None:
    # whole numbers, so that many values are equal
    lengths = list(map(len, recordings))
    statistics = [torch.tensor(row, dtype=torch.float32) for row in recordings]
    hop_s = 3600 / sum(lengths)  # an hour in all
    found = choose_threshold(statistics, RAW, hop_s, allowed + 0.5, **how)
    assert (found.value, found.rate.alarms) == brute(recordings, allowed, how)
    assert found.reached
    assert found.target_per_hour == allowed + 0.5
    assert found.rate.hours == pytest.approx(1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_threshold_in_long_streams(dtype: torch.dtype) -> None:
    # alarms of some hundred decisions each, so that the search needs several passes
    source = torch.Generator().manual_seed(0)
    statistics = list(smooth(torch.randn(8, 4299, generator=source), 300).to(dtype))
    how = {"rearm": 60, "refractory": 90}
    hop_s, target = 3600 / 32_000, 40
    found = choose_threshold(statistics, RAW, hop_s, target, **how)
    top = torch.cat(statistics).max()
    every = torch.cat(statistics).unique()
    tried = every[(every >= found.value) & (every <= top)]
    assert len(tried) > 1000
    hours = sum(map(len, statistics)) * hop_s / 3600
    for level in tried[:: len(tried) // 10].tolist():
        assert int(alarm_counts(statistics, level, **how).sum()) <= target * hours
    assert found.rate.per_hour <= target
    below = float(every[every < found.value][-1])
    assert int(alarm_counts(statistics, below, **how).sum()) > target * hours


def test_a_lower_threshold_with_fewer_alarms_is_not_taken() -> None:
    # at 1 the two peaks are one alarm, at 2 two
    statistics = [torch.tensor([0.0, 2, 1, 2, 0, 0, 0, 0])]
    hop_s = 3600 / 8
    assert [alarm_counts(statistics, at, **PLAIN).tolist() for at in (1.0, 2.0)] == [[1], [2]]
    found = choose_threshold(statistics, RAW, hop_s, 1, **PLAIN)
    assert found.value == np.nextafter(np.float32(2), np.float32(3))
    assert found.rate.alarms == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_threshold_above_a_statistic_that_never_rises_is_a_normal_number(
    dtype: torch.dtype,
) -> None:
    found = choose_threshold([torch.zeros(8, dtype=dtype)], RAW, 3600 / 8, 0.1, **PLAIN)
    assert found.value == np.finfo(np.float32).tiny  # its ceiling is another number in float32
    assert found.rate.alarms == 0


def test_too_few_hours_allow_none_and_say_what_that_proves() -> None:
    source = torch.Generator().manual_seed(0)
    statistics = [torch.randn(360, generator=source) for _ in range(10)]  # 36 s in all
    found = choose_threshold(statistics, RAW, 0.01, 1.0, **PLAIN)
    assert found.value > max(float(row.max()) for row in statistics)
    assert (found.rate.alarms, found.reached) == (0, True)
    assert found.rate.high == pytest.approx(math.log(40) / 0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_constant_streams(dtype: torch.dtype) -> None:
    statistics = [torch.full((50,), 0.3, dtype=dtype)] * 4
    hop_s = 3600 / 200
    found = choose_threshold(statistics, RAW, hop_s, 3, **PLAIN)  # each would raise one
    assert found.value > float(statistics[0][0])
    assert found.value == pytest.approx(0.3)
    assert (found.rate.alarms, found.reached) == (0, True)
    found = choose_threshold(statistics, RAW, hop_s, 4, **PLAIN)
    assert (found.value, found.rate.alarms) == (float(statistics[0][0]), 4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ceiling_that_is_too_low_is_said(dtype: torch.dtype) -> None:
    rule = Cusum(ceiling=3.1)  # which is no float32
    ceiling = float(torch.tensor(3.1, dtype=dtype))
    llr = torch.tensor([5.0, -9, 5, -9, 5, -9, 5, -9, 1, -9, 1, -9], dtype=dtype)
    statistics = [rule.scan(llr, rule.start(llr[0]))[0]] * 2
    found = choose_threshold(statistics, rule, 3600 / 24, 7, **PLAIN)
    assert (found.reached, found.value) == (False, ceiling)
    assert (found.rate.alarms, found.rate.per_hour) == (8, 8)
    found = choose_threshold(statistics, rule, 3600 / 24, 8, **PLAIN)  # itself a threshold
    assert (found.reached, found.value, found.rate.alarms) == (True, ceiling, 8)


def test_calibration_may_set_a_ceiling_that_the_rule_does_not_know() -> None:
    statistics = [torch.tensor([2.0, 0, 2, 0, 1, 0])]
    found = choose_threshold(statistics, RAW, 600.0, 1, **PLAIN, ceiling=2.0)
    assert (found.value, found.reached, found.rate.alarms) == (2.0, False, 2)
    found = choose_threshold(statistics, RAW, 600.0, 1, **PLAIN, ceiling=4.0)
    assert found.reached


def test_busy_streams_of_which_not_all_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    source = torch.Generator().manual_seed(0)
    statistics = list(torch.randn(6, 500, generator=source).cumsum(-1))
    args = (statistics, RAW, 3600 / 3000, 40)
    exact = choose_threshold(*args, rearm=2, refractory=3)
    monkeypatch.setattr(thresholds, "_TRIED_ONE_BY_ONE", 64)
    found = choose_threshold(*args, rearm=2, refractory=3)
    assert found.rate.alarms <= 40
    assert found.value == pytest.approx(exact.value, abs=5)  # of a range of about 60


@pytest.mark.parametrize(
    ("statistics", "hop_s", "target", "said"),
    [
        ([], 0.01, 1.0, "no decision to count alarms in; give at least one recording"),
        ([torch.zeros(2, 3)], 0.01, 1.0, r"recording 0 must be a row .* got shape \(2, 3\)"),
        ([torch.tensor([math.nan])], 0.01, 1.0, "recording 0 must be a row of finite numbers"),
        ([torch.zeros(3)], 0.0, 1.0, "hop_s must be positive, got 0.0"),
        ([torch.zeros(3)], 0.01, 0.0, "false_alarms_per_hour must be positive, got 0.0"),
        ([torch.zeros(3)], 0.01, math.nan, "false_alarms_per_hour must be positive"),
    ],
)
def test_what_no_threshold_can_be_set_on(statistics, hop_s, target, said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        choose_threshold(statistics, RAW, hop_s, target, **PLAIN)
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------- fresh streams
HOW = {"rearm": 5, "refractory": 20}


@pytest.mark.parametrize(
    ("rule", "memory"),
    [
        (RAW, 1),
        (Cusum(0.0, 0.2, 40.0), 10),
    ],
    ids=str,
)
def test_fresh_streams_have_the_target_rate(rule: Rule, memory: int) -> None:
    # 30 recordings of 20 s to choose on and 30 fresh ones, 40 times over; a decision shares what it
    # saw with ``memory`` neighbours. Ten alarms are allowed, so the threshold as well as the fresh
    # count have some 3 of noise: the interval of a fresh count need not hold the target in 95 of
    # 100, and was seen to in 88 to 93, with means of 59 to 66 an hour.
    source = torch.Generator().manual_seed(memory)
    llr = 2 * smooth(torch.randn(40, 60, 1999 + memory, generator=source), memory) - 2
    statistics, _ = rule.scan(llr, rule.start(llr[..., 0]))
    fresh: list[AlarmRate] = []
    for chosen_on, others in zip(statistics[:, :30], statistics[:, 30:], strict=True):
        found = choose_threshold(list(chosen_on), rule, 0.01, 60.0, **HOW)
        assert found.reached
        assert found.rate.alarms <= 10
        counts = alarm_counts(list(others), found.value, **HOW)
        fresh.append(alarm_rate(counts, torch.full((30,), 20 / 3600)))
    assert sum(one.low <= 60 <= one.high for one in fresh) >= 30
    mean = np.mean([one.per_hour for one in fresh])
    assert mean == pytest.approx(60, abs=13)  # a standard error is 60 sqrt(2 / 10 / 40) = 4


# --------------------------------------------------------------------------------------- budgets
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


def test_no_value_beyond_those_tried_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thresholds, "_LEAST_QUIET", 1)
    monkeypatch.setattr(thresholds, "_MOST_TRIED", 5)
    monkeypatch.setattr(thresholds, "_TRIED_ONE_BY_ONE", 2)
    peaks = np.repeat(np.arange(20.0), 2) * np.tile([1, 0], 20)  # each an alarm of its own
    assert lowest_threshold([peaks], [np.ones(40, bool)], 5, **PLAIN) == 15
