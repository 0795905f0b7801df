import hashlib
from collections import defaultdict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.features.bin_sample import BinSample

NUM = 3


def key_of(recording, index):
    text = f"{recording}:{index}".encode()
    return int(hashlib.blake2b(text, digest_size=8).hexdigest(), 16)


def make_recordings(sizes, seed=0):
    """(name, group, features, is_slip) of each; a feature tells recording and bin apart."""
    rng = np.random.default_rng(seed)
    recordings = []
    for number, size in enumerate(sizes):
        features = rng.standard_normal((size, NUM)).astype(np.float32)
        is_slip = rng.uniform(size=size) < 0.6
        group = "abc"[int(rng.integers(3))]
        name = f"{group}/{number}"  # in another order as text than as numbers
        recordings.append((name, group, torch.from_numpy(features), torch.from_numpy(is_slip)))
    return recordings


def sorted_at_once(recordings, most):
    """All bins of each stratum by (key, recording, bin), the first of them; how many there are."""
    strata, chosen = defaultdict(list), []
    for name, group, features, is_slip in recordings:
        for index, label in enumerate(is_slip.tolist()):
            own = key_of(name, index), name, index, features[index].tolist()
            strata[group, label].append(own)
    for (group, label), bins in strata.items():
        kept = sorted(bins)[:most]
        chosen += [(*own, group, label, len(bins) / len(kept)) for _, *own in kept]
    return sorted(chosen), {stratum: len(bins) for stratum, bins in strata.items()}


def rows_of(bins):
    recordings = [bins.recording_names[i] for i in bins.recording]
    groups = [bins.group_names[i] for i in bins.group]
    index, features = bins.bin_index.tolist(), bins.features.tolist()
    is_slip, weight = bins.is_slip.tolist(), bins.sample_weight.tolist()
    return list(zip(recordings, index, features, groups, is_slip, weight, strict=True))


recordings_of_any_sizes = st.builds(
    make_recordings, st.lists(st.integers(0, 9), max_size=14), st.integers(0, 99)
)


@given(recordings=recordings_of_any_sizes, most=st.integers(1, 12))
def test_a_sample_equals_sorting_all_keys_at_once(recordings, most):
    sample = BinSample(most)
    for recording in recordings:
        sample.update(*recording)
    chosen, seen = sorted_at_once(recordings, most)
    bins = sample.bins()
    assert rows_of(bins) == chosen
    assert list(sample.num_seen.items()) == sorted(seen.items())
    assert bins.group_names == tuple(sorted({group for group, _ in seen}))
    assert bins.recording_names == tuple(sorted({row[0] for row in chosen}))
    columns = bins.features, bins.is_slip, bins.sample_weight
    assert [x.dtype for x in columns] == [torch.float32, torch.bool, torch.float64]
    assert {x.dtype for x in (bins.group, bins.recording, bins.bin_index)} == {torch.int64}


def test_a_sample_of_fewer_than_none_is_refused():
    with pytest.raises(ValueError, match=r"0 bins or more .* got -1"):
        BinSample(-1)
