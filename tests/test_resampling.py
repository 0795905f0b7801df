"""Intervals over recordings: against lists drawn one by one, SciPy, and how often they hold."""

import numpy as np
import pytest
import torch
from scipy import stats

from tactslip_torch.onset.events import Draws, Resampled


def some(rng, num_recordings=12, num_values=40):
    recording = np.sort(rng.integers(0, num_recordings, num_values))
    return rng.exponential(50.0, num_values), recording, num_recordings


def drawn_lists(resampled, values, recording):
    """What each draw holds, value by value."""
    for times in resampled._times.long().tolist():
        yield np.array([v for v, r in zip(values, recording, strict=True) for _ in range(times[r])])


def between(numbers, level=0.9):
    numbers = np.array([number for number in numbers if not np.isnan(number)])
    return np.quantile(numbers, [(1 - level) / 2, (1 + level) / 2])


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95, 1.0])
def test_quantiles_are_those_of_the_lists_drawn(share, rng):
    values, recording, num = some(rng)
    resampled = Resampled(num, Draws(0.9, 60))
    tensors = torch.from_numpy(values), torch.from_numpy(recording)
    (number,) = resampled.quantiles(*tensors, [share])
    assert number["value"] == pytest.approx(np.quantile(values, share))
    lists = drawn_lists(resampled, values, recording)
    low, high = between([np.quantile(own, share) for own in lists])
    assert number["low"] == pytest.approx(min(low, number["value"]))
    assert number["high"] == pytest.approx(max(high, number["value"]))


def test_means_and_deviations_are_those_of_the_lists_drawn(rng):
    values, recording, num = some(rng)
    resampled = Resampled(num, Draws(0.9, 60))
    tensors = torch.from_numpy(values), torch.from_numpy(recording)
    for number, of in (
        (resampled.average(*tensors), np.mean),
        (resampled.deviation(*tensors), np.std),
    ):
        lists = drawn_lists(resampled, values, recording)
        assert number["value"] == pytest.approx(of(values))
        assert [number["low"], number["high"]] == pytest.approx(between(map(of, lists)))


def test_a_draw_without_any_value_says_nothing(rng):
    """Two of many recordings have values: some draws have none of them."""
    values, recording = np.array([3.0, 5.0]), np.array([0, 7])
    resampled = Resampled(12, Draws(0.36, 2000))  # ends at which the empty ones would count
    assert any(not len(own) for own in drawn_lists(resampled, values, recording))
    tensors = torch.from_numpy(values), torch.from_numpy(recording)
    lists = [own for own in drawn_lists(resampled, values, recording) if len(own)]
    for number, of in (
        (resampled.quantiles(*tensors, [1.0])[0], np.max),
        (resampled.average(*tensors), np.mean),
        (resampled.deviation(*tensors), np.std),
    ):
        low, high = between(map(of, lists), 0.36)  # and never beside the value itself
        expected = [min(low, number["value"]), max(high, number["value"])]
        assert [number["low"], number["high"]] == pytest.approx(expected)


def test_a_mean_agrees_with_scipys_bootstrap(rng):
    sums, numbers = rng.poisson(3.0, 30).astype(float), rng.integers(1, 5, 30).astype(float)
    ours = Resampled(30, Draws(0.95, 4000)).mean(sums.tolist(), numbers.tolist())

    def ratio(a, b, axis):
        return a.sum(axis) / b.sum(axis)

    options = {"paired": True, "vectorized": True, "method": "percentile", "n_resamples": 4000}
    theirs = stats.bootstrap((sums, numbers), ratio, rng=0, **options).confidence_interval
    width = theirs.high - theirs.low
    assert ours["low"] == pytest.approx(theirs.low, abs=0.06 * width)
    assert ours["high"] == pytest.approx(theirs.high, abs=0.06 * width)


@pytest.mark.parametrize(("part", "whole"), [(0, 9), (9, 9), (3, 40), (1, 2)])
def test_a_share_of_one_recording_has_wilsons_interval(part, whole):
    share = Resampled(1, Draws(0.95)).share([part], [whole])
    theirs = stats.binomtest(part, whole).proportion_ci(0.95, method="wilson")
    assert share == pytest.approx({"value": part / whole, "low": theirs.low, "high": theirs.high})


@pytest.mark.parametrize("count", [0, 1, 7, 300])
def test_the_ends_of_a_rate_are_two_sided_scores_of_a_poisson_count(count):
    """The rates at which the count lies just ``z`` standard deviations away."""
    hours, z = 2.5, stats.norm.ppf(0.95)
    rate = Resampled(1, Draws(0.9)).rate([count], [hours], per=3.0)
    for end, sign in (("low", 1), ("high", -1)):
        expected = rate[end] / 3 * hours
        assert count - expected == pytest.approx(sign * z * np.sqrt(expected), abs=1e-9)
    assert rate["value"] == pytest.approx(3 * count / hours)


def test_what_never_happened_in_any_recording_may_still_happen():
    many = Resampled(30, Draws())
    assert many.share([0] * 30, [3] * 30)["high"] == pytest.approx(
        stats.binomtest(0, 90).proportion_ci(method="wilson").high
    )
    assert many.rate([0] * 30, [0.1] * 30)["high"] > 1.0
    assert many.mean([0] * 30, [3] * 30)["high"] == 0.0  # no count of independent events


def test_one_recording_alone_has_no_interval_of_what_is_no_count():
    values, recording = torch.tensor([1.0, 2.0]).double(), torch.tensor([3, 3])
    five = Resampled(5, Draws())
    numbers = [*five.quantiles(values, recording, [0.5]), five.average(values, recording)]
    numbers += [five.deviation(values, recording), five.mean([0, 4.0, 0, 0, 0], [0, 2, 0, 0, 0])]
    for number in numbers:
        assert number["low"] is number["high"] is None
    assert five.share([1, 0, 0, 0, 0], [2, 0, 0, 0, 0])["low"] > 0


def test_nothing_is_none():
    assert Resampled(0, Draws()).share([], []) is None
    assert Resampled(3, Draws()).rate([1, 2, 3], [0, 0, 0]) is None


def test_seeds_and_levels():
    counts, hours = [0, 1, 5, 2, 0, 9], [1.0] * 6
    numbers = {
        (level, seed): Resampled(6, Draws(level, 300, seed)).mean(counts, hours)
        for level in (0.5, 0.9)
        for seed in (0, 1)
    }
    again = Resampled(6, Draws(0.9, 300, 0)).mean(counts, hours)
    assert again == numbers[0.9, 0] != numbers[0.9, 1]
    assert numbers[0.9, 0]["low"] < numbers[0.5, 0]["low"]
    assert numbers[0.5, 0]["high"] < numbers[0.9, 0]["high"]


@pytest.mark.parametrize("draws", [Draws(level=0.0), Draws(level=1.0), Draws(num=0)])
def test_draws_that_are_none_are_refused(draws):
    with pytest.raises(ValueError, match="level between 0 and 1 and at least one draw"):
        Resampled(3, draws)


# ------------------------------------------------------------------------- how often they hold
SETS, RECORDINGS = 300, 40


def test_intervals_hold_as_often_as_they_say_for_counts_that_hang_together(rng):
    """Recordings differ in their rate: 95 % hold the truth, a Poisson count's own interval not."""
    held = alone = 0
    for _ in range(SETS):
        hours = rng.uniform(0.5, 1.5, RECORDINGS)
        counts = rng.poisson(hours * rng.gamma(0.5, 4.0, RECORDINGS))  # 2 an hour in the mean
        rate = Resampled(RECORDINGS, Draws(num=200)).rate(counts.tolist(), hours.tolist())
        naive = Resampled(1, Draws(num=1)).rate([counts.sum()], [hours.sum()])
        held += rate["low"] <= 2.0 <= rate["high"]
        alone += naive["low"] <= 2.0 <= naive["high"]
    assert 0.87 < held / SETS < 0.985  # the bootstrap of 40 is a little short of 95
    assert alone / SETS < 0.8


def test_intervals_of_shares_hold_for_slips_that_hang_together(rng):
    held = 0
    for _ in range(SETS):
        chance = rng.beta(4.0, 1.0, RECORDINGS)  # 80 % in the mean
        found = rng.binomial(3, chance)
        share = Resampled(RECORDINGS, Draws(num=200)).share(found.tolist(), [3] * RECORDINGS)
        held += share["low"] <= 0.8 <= share["high"]
    assert 0.9 < held / SETS < 0.99


def test_intervals_of_medians_hold_for_delays_that_hang_together(rng):
    held = 0
    for _ in range(SETS):
        level = rng.normal(50.0, 10.0, RECORDINGS)
        values = torch.from_numpy(level[:, None] + rng.normal(0.0, 5.0, (RECORDINGS, 3))).flatten()
        recording = torch.arange(RECORDINGS).repeat_interleave(3)
        (median,) = Resampled(RECORDINGS, Draws(num=200)).quantiles(values, recording, [0.5])
        held += median["low"] <= 50.0 <= median["high"]
    assert 0.9 < held / SETS < 0.99
