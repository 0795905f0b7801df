"""A sample of bins depends on which bins there are, and on nothing else."""

import hashlib
from collections import defaultdict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.training.bins import BinSample, RecordingBins

NUM = 3


def key_of(recording, index):
    text = f"{recording}:{index}".encode()
    return int(hashlib.blake2b(text, digest_size=8).hexdigest(), 16)


def make_recordings(sizes, seed=0):
    """Recordings of three groups and two scenes; a feature tells recording and bin apart."""
    rng = np.random.default_rng(seed)
    recordings = []
    for number, size in enumerate(sizes):
        features = torch.from_numpy(rng.standard_normal((size, NUM)).astype(np.float32))
        is_slip = torch.from_numpy(rng.uniform(size=size) < 0.6)
        group, scene = "abc"[int(rng.integers(3))], ("paper", "taps")[int(rng.integers(2))]
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


def test_a_sample_of_fewer_than_none_or_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"0 bins or more .* got -1"):
        BinSample(-1)
    with pytest.raises(ValueError, match="got none"):
        BinSample(3).bins()
