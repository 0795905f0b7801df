"""Intervals over recordings: against lists drawn one by one, SciPy, and how often they hold."""

import numpy as np
import pytest
import torch
from scipy import stats

from tactslip_torch.onset.events import Bootstrap


def values_of(rng, num_recordings=12, num_values=40):
    recording = np.sort(rng.integers(0, num_recordings, num_values))
    return rng.exponential(50.0, num_values), recording


def drawn_lists(bootstrap, values, recording):
    """What each draw holds, value by value; empty lists left out."""
    for times in bootstrap._times.long().tolist():
        own = [v for v, r in zip(values, recording, strict=True) for _ in range(times[r])]
        if own:
            yield np.array(own)


@pytest.mark.parametrize("few", [False, True])
def test_numbers_are_those_of_the_lists_drawn(few, rng):
    """With values in two of many recordings some draws have none of them, and say nothing."""
    values, recording = (np.array([3.0, 5.0]), np.array([0, 7])) if few else values_of(rng)
    bootstrap = Bootstrap(12, 0.36, 400)
    lists = list(drawn_lists(bootstrap, values, recording))
    assert (len(lists) < 400) == few
    tensors = torch.from_numpy(values), torch.from_numpy(recording)
    for share in (0.0, 0.5, 0.95, 1.0):
        low, high = np.quantile([np.quantile(own, share) for own in lists], [0.32, 0.68])
        value = np.quantile(values, share)
        expected = {"value": value, "low": min(low, value), "high": max(high, value)}
        assert bootstrap.quantile(*tensors, share) == pytest.approx(expected)


def test_a_ratio_agrees_with_scipys_bootstrap(rng):
    sums, numbers = rng.poisson(3.0, 30).astype(float), rng.integers(1, 5, 30).astype(float)
    ours = Bootstrap(30, 0.95, 4000).ratio(sums.tolist(), numbers.tolist())

    def ratio(a, b, axis):
        return a.sum(axis) / b.sum(axis)

    options = {"paired": True, "vectorized": True, "method": "percentile", "n_resamples": 4000}
    theirs = stats.bootstrap((sums, numbers), ratio, rng=0, **options).confidence_interval
    width = theirs.high - theirs.low
    assert ours["low"] == pytest.approx(theirs.low, abs=0.06 * width)
    assert ours["high"] == pytest.approx(theirs.high, abs=0.06 * width)


@pytest.mark.parametrize(("part", "whole"), [(0, 9), (9, 9), (3, 40)])
def test_a_share_of_one_recording_has_wilsons_interval(part, whole):
    share = Bootstrap(1).share([part], [whole])
    theirs = stats.binomtest(part, whole).proportion_ci(0.95, method="wilson")
    assert share == pytest.approx({"value": part / whole, "low": theirs.low, "high": theirs.high})


@pytest.mark.parametrize("count", [0, 7])
def test_the_ends_of_a_rate_are_two_sided_scores_of_a_poisson_count(count):
    """The rates at which the count lies just ``z`` standard deviations away."""
    hours, z = 2.5, stats.norm.ppf(0.95)
    rate = Bootstrap(1, 0.9).rate([count], [hours], per=3.0)
    for end, sign in (("low", 1), ("high", -1)):
        expected = rate[end] / 3 * hours
        assert count - expected == pytest.approx(sign * z * np.sqrt(expected), abs=1e-9)
    assert rate["value"] == pytest.approx(3 * count / hours)


def test_what_never_happened_may_still_happen_and_nothing_is_none():
    many = Bootstrap(30)
    assert many.share([0] * 30, [3] * 30)["high"] == pytest.approx(
        stats.binomtest(0, 90).proportion_ci(method="wilson").high
    )
    assert many.ratio([0] * 30, [3] * 30)["high"] == 0.0  # no count of independent events
    assert many.rate([1] * 30, [0] * 30) is Bootstrap(0).share([], []) is None


def test_wilsons_lower_end_stays_below_one_where_every_recording_is_right():
    """Draws of recordings alone would say 100 % without doubt."""
    number = Bootstrap(30).share([3] * 30, [3] * 30)
    assert number["low"] == pytest.approx(
        stats.binomtest(90, 90).proportion_ci(method="wilson").low
    )
    assert number["high"] == number["value"] == 1.0


def test_recordings_drawn_within_groups_leave_the_differences_between_groups_out():
    """A mean that depends on the group alone is sure; each group is drawn by itself."""
    groups = torch.tensor([0, 1, 1, 0, 0, 1, 1, 1])
    within = Bootstrap(8, 0.95, 500, groups)

    def mean(sums):
        return sums[:, 0] / 8

    by_group = within.statistic(mean, 3.0 + groups[:, None])
    assert by_group["low"] == by_group["high"] == by_group["value"] == 3.625
    whole = Bootstrap(8, 0.95, 500).statistic(mean, 3.0 + groups[:, None])
    assert whole["low"] < 3.4 < 3.8 < whole["high"]
    mirrored = torch.tensor([1.0, -1, -1, 1])  # cancels where both groups have the same draw
    apart = Bootstrap(4, 0.95, 500, torch.tensor([0, 0, 1, 1])).statistic(mean, mirrored[:, None])
    assert apart["low"] < 0 < apart["high"]
