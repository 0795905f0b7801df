"""Columns of views: what is scaled how, what stands for lost channels, and parts of them."""

import numpy as np
import pytest
import torch
from small_detector import HAND, raw_bins

from tactslip_torch.features.pool import FeaturePool, is_simple_of
from tactslip_torch.features.sensing import SpanFeatures
from tactslip_torch.training.columns import VIEWS, joined, view_columns

POOL = FeaturePool(HAND, level=2)
SIMPLE = is_simple_of(POOL)
DESCRIBED = torch.tensor([name.descriptor in ("std", "range", "skewness") for name in POOL.names])
DESCRIBED &= POOL.is_paper
STATISTICS = ["mean", "std", "min"]
DEAD = HAND.names.index("PVDF2")


def drawn(num=60, seed=0, is_dead=None):
    """Features of bins of noise of several sizes, in some of which a channel is dead; weights."""
    bins = raw_bins(num, seed, num_samples=100)
    if is_dead is not None:
        bins[is_dead, DEAD] = 0.0
    weights = np.random.default_rng(seed).uniform(0.2, 2.0, num)
    return POOL(bins), torch.from_numpy(weights)


def columns_of(view, features, weights):
    allowed = SIMPLE if view == "simple" else DESCRIBED
    spans = SpanFeatures(POOL.hand, POOL.names, POOL.bin_samples)
    return view_columns(view, POOL.hand, POOL.names, spans, allowed, features, weights, STATISTICS)


def source(selection):
    """Of each scaled column what it is made of."""
    names = selection.names if selection.pooling is None else selection.pooling.names
    return [names[place] for place in selection.scaler.columns.tolist()]


# Scales ------------------------------------------------------------------------------------------


def test_simple_statistics_come_as_they_are_and_as_logarithms():
    """The logarithms against NumPy's; means, which may be negative, have none."""
    features, weights = drawn()
    selection = columns_of("simple", features, weights)
    z, names = selection(features).numpy(), source(selection)
    place = {name: index for index, name in enumerate(POOL.names)}
    num = int(SIMPLE.sum())
    assert set(names[:num]) == {name for name in POOL.names if name.is_simple}
    assert names[num:] == [name for name in names[:num] if name.descriptor != "mean"]
    for index, name in enumerate(names):
        x = features[:, place[name]].numpy()
        wanted = x if index < num else np.log(x)
        slope, level = np.polyfit(z[:, index], wanted, 1)
        assert slope > 0
        error = np.abs(slope * z[:, index] + level - wanted).max()
        assert error < (1e-4 if index < num else 0.01) * np.ptp(wanted), str(name)


def test_simple_statistics_are_clipped_only_a_range_beyond_training():
    """The range of training is the middle third; what is further than its width is one."""
    features, weights = drawn()
    selection = columns_of("simple", features, weights)
    z = selection(features)
    torch.testing.assert_close(z.amin(0), torch.full((selection.size,), -1 / 3).double())
    torch.testing.assert_close(z.amax(0), torch.full((selection.size,), 1 / 3).double())
    low, high = features.amin(0), features.amax(0)
    beyond = torch.stack([high + share * (high - low) for share in (0.5, 0.9, 1.1, 50.0)])
    plain = selection(beyond)[:, : int(SIMPLE.sum())]
    expected = torch.tensor([2 / 3, 14 / 15, 1.0, 1.0]).double()[:, None].expand_as(plain)
    torch.testing.assert_close(plain, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("view", ["channel", "pooled"])
def test_descriptors_are_compressed_mildly_and_strongly_and_clipped_beyond_quantiles(view):
    """By NumPy's quantiles; a part of the training bins lies outside of them."""
    features, weights = drawn(150)
    selection = columns_of(view, features, weights)
    x = features[:, list(selection.selected)].double()
    if selection.pooling is not None:
        x = selection.pooling(x)
    x, num = x.numpy(), x.shape[1]
    assert selection.scaler.columns.tolist() == [*range(num), *range(num)]
    z = selection(features).numpy()
    for part, share in ((z[:, :num], 1.0), (z[:, num:], 0.01)):
        scale = share * np.median(np.abs(x), axis=0)
        y = scale * np.sign(x) * np.log1p(np.abs(x) / scale)
        low, high = np.quantile(y, [0.01, 0.99], axis=0)
        expected = np.clip(2 * (y - low) / (high - low) - 1, -1, 1)
        np.testing.assert_allclose(part, expected, atol=1e-9)
    assert ((np.abs(z) == 1).mean(0) >= 2 / 150).all()


# Lost channels -----------------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["simple", "channel"])
def test_columns_of_a_lost_or_silent_channel_are_the_mean_of_training(view):
    """By weight, and of the bins as they are; those of other channels are not touched."""
    is_dead = torch.arange(60) % 4 == 3
    features, weights = drawn(is_dead=is_dead)
    selection = columns_of(view, features, weights)
    of_dead = torch.tensor([name.channel == HAND.names[DEAD] for name in source(selection)])
    before = selection.scaler(features[:, list(selection.selected)].double())
    mean = weights @ before / weights.sum()
    found = selection(features)
    torch.testing.assert_close(found[:, ~of_dead], before[:, ~of_dead], rtol=0, atol=0)
    torch.testing.assert_close(found[~is_dead], before[~is_dead], rtol=0, atol=0)
    torch.testing.assert_close(found[is_dead][:, of_dead], mean[of_dead].expand(15, -1))
    is_lost = torch.zeros(60, len(HAND), dtype=torch.bool)
    is_lost[0, 0] = True
    lost = selection(features, is_lost)
    of_first = torch.tensor([name.channel == HAND.names[0] for name in source(selection)])
    torch.testing.assert_close(lost[0, of_first], mean[of_first])
    torch.testing.assert_close(lost[0, ~of_first], found[0, ~of_first], rtol=0, atol=0)
    torch.testing.assert_close(lost[1:], found[1:], rtol=0, atol=0)


def test_pools_leave_out_lost_and_silent_channels():
    """A dead channel makes the bin of those that remain; nothing of it is read."""
    is_dead = torch.arange(60) % 4 == 3
    features, weights = drawn(is_dead=is_dead)
    selection = columns_of("pooled", features, weights)
    is_lost = torch.zeros(60, len(HAND), dtype=torch.bool)
    is_lost[:, DEAD] = True
    lost = selection(features, is_lost)
    torch.testing.assert_close(selection(features)[is_dead], lost[is_dead], rtol=0, atol=0)
    assert not torch.equal(selection(features)[~is_dead], lost[~is_dead])
    of_dead = torch.tensor([name.channel == HAND.names[DEAD] for name in POOL.names])
    other = torch.where(of_dead, 7.0, features)
    torch.testing.assert_close(selection(other, is_lost), lost, rtol=0, atol=0)
    alone = [name.statistic == "std" and name.channel == "PVDF" for name in source(selection)]
    assert (lost[:, alone].std(0) < 1e-12).all()  # of one channel that remains


# Parts -------------------------------------------------------------------------------------------


def masks(rng, num=60):
    return [None, torch.from_numpy(rng.uniform(size=(num, len(HAND))) < 0.3)]


@pytest.mark.parametrize("view", VIEWS)
def test_some_of_the_columns_are_what_they_were_among_all(view, rng):
    """In any order, the same feature at both scales; no feature is read that none needs."""
    features, weights = drawn(is_dead=torch.arange(60) % 4 == 3)
    selection = columns_of(view, features, weights)
    places = rng.permutation(selection.size)[:7].tolist()
    twice = selection.scaler.columns.tolist().index(selection.scaler.columns[-1])
    some = selection.take([*places, selection.size - 1, twice])
    assert some.size == 9
    assert len(some.selected) < len(selection.selected)
    of = source(selection)
    assert source(some) == [of[place] for place in (*places, selection.size - 1, twice)]
    for is_lost in masks(rng):
        expected = selection(features, is_lost)[:, [*places, selection.size - 1, twice]]
        torch.testing.assert_close(some(features, is_lost), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("order", [VIEWS, VIEWS[::-1], ("channel", "simple"), ("pooled",)], ids=str)
@pytest.mark.parametrize("is_taken", [False, True])
def test_joined_columns_are_those_of_the_views_side_by_side(order, is_taken, rng):
    """Views share features; each is read once."""
    features, weights = drawn(is_dead=torch.arange(60) % 4 == 3)
    parts = [columns_of(view, features, weights) for view in order]
    if is_taken:
        parts = [part.take(rng.permutation(part.size)[:6].tolist()) for part in parts]
    whole = joined(parts)
    assert len(set(whole.selected)) == len(whole.selected)
    assert set(whole.selected) == {index for part in parts for index in part.selected}
    for is_lost in masks(rng):
        expected = torch.cat([part(features, is_lost) for part in parts], 1)
        torch.testing.assert_close(whole(features, is_lost), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(whole.fill, torch.cat([part.fill for part in parts]))


def test_columns_of_many_bins_are_those_of_few_at_a_time():
    features, weights = drawn(60)
    selection = columns_of("pooled", features, weights)
    many = features.repeat(40, 1)  # more than are scaled at a time
    expected = selection(features).repeat(40, 1)
    torch.testing.assert_close(selection.in_parts(many), expected, rtol=0, atol=0)
