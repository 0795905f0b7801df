"""A sample of bins depends on which bins there are, and on nothing else."""

import hashlib
from collections import defaultdict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.training.bins import MOST_GROUPS, BinSample, RecordingBins

NUM = 3


def key_of(recording, index):
    text = f"{recording}:{index}".encode()
    return int(hashlib.blake2b(text, digest_size=8).hexdigest(), 16)


def make_recordings(sizes, seed=0, groups="abc"):
    """Recordings of some groups and two scenes; a feature tells recording and bin apart."""
    rng = np.random.default_rng(seed)
    recordings = []
    for number, size in enumerate(sizes):
        features = torch.from_numpy(rng.standard_normal((size, NUM)).astype(np.float32))
        is_slip = torch.from_numpy(rng.uniform(size=size) < 0.6)
        group, scene = (
            groups[int(rng.integers(len(groups)))],
            ("paper", "taps")[int(rng.integers(2))],
        )
        name = f"{group}/{number}"  # in another order as text than as numbers
        recordings.append(RecordingBins(name, group, features, is_slip, scene))
    return recordings


def sorted_at_once(recordings, most):
    """The first bins of each stratum by (key, recording, bin), in the order of recordings."""
    strata, chosen = defaultdict(list), []
    for of in recordings:
        for index, label in enumerate(of.is_slip.tolist()):
            own = key_of(of.name, index), of.name, index, of.features[index].tolist()
            strata[of.group, of.scene, label].append(own)
    for stratum, bins in strata.items():
        kept = sorted(bins)[:most]
        chosen += [(name, row, x, *stratum, len(bins) / len(kept)) for _, name, row, x in kept]
    return [row[2:] for row in sorted(chosen)]


def rows_of(bins):
    groups = [bins.group_names[i] for i in bins.group]
    scenes = [bins.scene_names[i] for i in bins.scene]
    columns = bins.features.tolist(), groups, scenes, bins.is_slip.tolist(), bins.weight.tolist()
    return list(zip(*columns, strict=True))


@given(
    recordings=st.builds(
        make_recordings,
        st.lists(st.integers(0, 9), min_size=1, max_size=14).filter(any),
        st.integers(0, 99),
    ),
    most=st.integers(1, 12),
    order=st.randoms(use_true_random=False),
    num_shards=st.integers(1, 4),
)
def test_any_order_and_sharding_gives_the_bins_of_smallest_key(recordings, most, order, num_shards):
    wanted = sorted_at_once(recordings, most)
    order.shuffle(recordings)
    merged = BinSample(most)
    for shard in range(num_shards):
        sample = BinSample(most)
        for of in recordings[shard::num_shards]:
            sample.update(of)
        merged.merge(sample)
    bins = merged.bins()
    assert rows_of(bins) == wanted
    assert bins.group_names == tuple(sorted(set(bins.group_names)))
    assert bins.features.dtype == torch.float32


@pytest.mark.parametrize("num_shards", [1, 3])
@pytest.mark.parametrize("is_reversed", [False, True])
def test_of_many_groups_each_gives_fewer_bins_in_any_order(num_shards, is_reversed):
    """20 groups: half of what each of ten would give, whoever came first."""
    recordings = make_recordings([30] * 200, groups="abcdefghijklmnopqrst")
    assert len({of.group for of in recordings}) == 20
    wanted = sorted_at_once(recordings, 4)
    merged = BinSample(8)
    for shard in range(num_shards):
        sample = BinSample(8)
        for of in recordings[shard::num_shards][:: -1 if is_reversed else 1]:
            sample.update(of)
        merged.merge(sample)
    assert rows_of(merged.bins()) == wanted


def sample_of(sizes):
    """A sample of groups ``g000`` and on, of so many bins of non-slip and of slip."""
    sample = BinSample(100)
    for number, (quiet, slip) in enumerate(sizes):
        is_slip = torch.arange(quiet + slip) >= quiet
        features = torch.full((len(is_slip), 1), float(number))
        sample.update(RecordingBins(f"r{number}", f"g{number:03}", features, is_slip))
    return sample.bins()


def test_joined_groups_hold_every_group_once_and_are_of_about_one_size():
    sizes = [(3 + number % 5, 2 + number % 3) for number in range(47)]
    bins = sample_of(sizes)
    joined = bins.joined()
    assert len(joined.group_names) == MOST_GROUPS
    of_group = defaultdict(set)
    for number, place in zip(bins.features[:, 0].tolist(), joined.group.tolist(), strict=True):
        of_group[number].add(place)
    assert len(of_group) == 47
    assert all(len(places) == 1 for places in of_group.values())  # a group is never in two
    members = [[n for n, places in of_group.items() if places == {p}] for p in range(MOST_GROUPS)]
    names = [f"g{int(min(own)):03} and {len(own) - 1} more" for own in members]
    assert list(joined.group_names) == names
    counts = [sum(sum(sizes[int(number)]) for number in own) for own in members]
    assert max(counts) - min(counts) <= max(map(sum, sizes))
    assert torch.equal(joined.is_slip, bins.is_slip)
    assert torch.equal(joined.weight, bins.weight)


@pytest.mark.parametrize(
    ("sizes", "num"), [([(6, 0), (0, 5)] * 20, MOST_GROUPS), ([(2, 0)] * 3 + [(0, 2)] * 3, 3)]
)
def test_groups_of_one_class_are_joined_to_groups_of_both(sizes, num):
    """Recordings that are slip, or are not, as a whole; of few, as many as can have both."""
    joined = sample_of(sizes).joined()
    assert len(joined.group_names) == num
    for place in range(num):
        assert len(joined.is_slip[joined.group == place].unique()) == 2


def test_groups_are_not_joined_where_a_class_would_be_left_out_with_all_its_groups():
    """Slip is in two groups alone, which quiet bins would deal to the same place."""
    sizes = [(40 - number, 0) for number in range(MOST_GROUPS)]
    sizes += [(20, 0)] * 10
    sizes[0], sizes[19] = (40, 2), (18, 1)
    bins = sample_of(sizes)
    joined = bins.joined()
    of_slip = joined.group[joined.is_slip].unique()
    assert len(of_slip) == 2


def test_ten_groups_stay_as_they_are():
    bins = sample_of([(4, 3)] * MOST_GROUPS)
    assert bins.joined() is bins


def test_a_sample_of_fewer_than_none_or_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"0 bins or more .* got -1"):
        BinSample(-1)
    with pytest.raises(ValueError, match="got none"):
        BinSample(3).bins()


def test_a_sample_of_a_sample_stands_for_the_same_bins():
    recordings = make_recordings([200, 300, 150, 250], seed=1)
    first = BinSample(20)
    for of in recordings:
        first.update(of)
    sample = first.bins()
    for most, of in ((20, sample), (7, sample), (20, sample.thinned(60))):
        again = BinSample(most)
        for bins in of.by_recording():
            again.update(bins)
        found = again.bins()
        for one in sample.stratum.unique():
            wanted = sample.weight[sample.stratum == one].sum()
            torch.testing.assert_close(found.weight[found.stratum == one].sum(), wanted)
    assert torch.equal(again.bins().features, sample.thinned(60).features)


def test_bins_are_thinned_evenly_over_groups_and_classes():
    recordings = make_recordings([400, 10, 300], seed=2)
    every = BinSample(1000)
    for of in recordings:
        every.update(of)
    whole = every.bins()
    fewer = whole.thinned(100)
    assert 80 < len(fewer.is_slip) <= 100
    sizes = whole.stratum.bincount()
    kept = fewer.stratum.bincount(minlength=len(sizes))
    largest = kept.max()
    for size, num in zip(sizes[sizes > 0].tolist(), kept[sizes > 0].tolist(), strict=True):
        assert num in (size, largest)
    names = [fewer.recording_names[i] for i in fewer.recording]
    of_name = {of.name: of.features for of in recordings}
    for name, row in zip(names, fewer.features, strict=True):
        assert (of_name[name] == row).all(1).any()
