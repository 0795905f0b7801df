import hashlib

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
        # of several lengths, and in another order as text than as numbers
        name = f"{group}/{number}"
        recordings.append((name, group, torch.from_numpy(features), torch.from_numpy(is_slip)))
    return recordings


def sample_of(recordings, most):
    sample = BinSample(most)
    for recording in recordings:
        sample.update(*recording)
    return sample


def sorted_at_once(recordings, most):
    """All bins of each stratum by (key, recording, bin), the first of them."""
    strata = {}
    for name, group, features, is_slip in recordings:
        for index in range(len(is_slip)):
            bins = strata.setdefault((group, bool(is_slip[index])), [])
            bins.append((key_of(name, index), name, index, features[index].tolist()))
    chosen = []
    for (group, label), bins in strata.items():
        kept = sorted(bins)[:most]
        chosen += [(*bin[1:], group, label, len(bins) / len(kept)) for bin in kept]
    seen = {name: len(bins) for name, bins in strata.items()}
    return sorted(chosen), seen


def rows_of(bins):
    return [
        (
            bins.recording_names[bins.recording[i]],
            int(bins.bin_index[i]),
            bins.features[i].tolist(),
            bins.group_names[bins.group[i]],
            bool(bins.is_slip[i]),
            float(bins.sample_weight[i]),
        )
        for i in range(len(bins.features))
    ]


recordings_of_any_sizes = st.builds(
    make_recordings, st.lists(st.integers(0, 9), max_size=14), st.integers(0, 99)
)


@given(recordings=recordings_of_any_sizes, most=st.integers(1, 12))
def test_a_sample_equals_sorting_all_keys_at_once(recordings, most):
    sample = sample_of(recordings, most)
    chosen, seen = sorted_at_once(recordings, most)
    bins = sample.bins()
    assert rows_of(bins) == chosen
    assert sample.num_seen == seen
    assert list(sample.num_seen) == sorted(seen)
    assert bins.group_names == tuple(sorted({group for group, _ in seen}))
    assert bins.recording_names == tuple(sorted({row[0] for row in chosen}))
    assert bins.features.dtype == torch.float32
    assert bins.is_slip.dtype == torch.bool
    assert bins.group.dtype == bins.recording.dtype == bins.bin_index.dtype == torch.int64
    assert bins.sample_weight.dtype == torch.float64


def test_a_sample_of_fewer_than_none_is_refused():
    with pytest.raises(ValueError, match=r"0 bins or more .* got -1"):
        BinSample(-1)
