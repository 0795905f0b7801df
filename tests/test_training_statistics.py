import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.features.bin_sample import BinSample
from tactslip_torch.features.selection import ClassMoments
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.runtime import content_digest

NUM = 4


def make_recordings(num=9, seed=0):
    rng = np.random.default_rng(seed)
    recordings = []
    for number in range(num):
        size = int(rng.integers(0, 12))
        features = rng.standard_normal((size, NUM)) * 10.0 ** rng.integers(-4, 4, NUM)
        features[:, 3] = rng.choice([0.0, -0.0], size)  # ranges must not show which came first
        features = torch.from_numpy(features.astype(np.float32))
        is_slip = torch.from_numpy(rng.uniform(size=size) < 0.6)
        recordings.append((f"M{number % 3}/{number}", f"M{number % 3}", features, is_slip))
    return recordings


def statistics_of(recordings, sample_bins=3):
    statistics = TrainingStatistics(NUM, sample_bins)
    for recording in recordings:
        statistics.update(*recording)
    return statistics


def bits_of(statistics):
    """All of a statistics but its moments, as bytes and text, so that 0 and -0 differ."""
    sample = vars(statistics.sample.bins())
    tensors = {name: x for name, x in sample.items() if isinstance(x, torch.Tensor)}
    tensors |= {"minimum": statistics.minimum, "maximum": statistics.maximum}
    bits = {
        name: (str(tensor.dtype), tuple(tensor.shape), tensor.numpy().tobytes())
        for name, tensor in tensors.items()
    }
    names = sample["group_names"], sample["recording_names"]
    return sorted(statistics.seen_batches.items()), names, bits


def test_statistics_are_their_parts():
    recordings = make_recordings()
    statistics = statistics_of(recordings)
    features = torch.cat([recording[2] for recording in recordings])
    is_slip = torch.cat([recording[3] for recording in recordings])
    moments, sample = ClassMoments(NUM), BinSample(3)
    moments.update(features, is_slip)
    for recording in recordings:
        sample.update(*recording)
    assert torch.equal(statistics.moments.count, moments.count)
    torch.testing.assert_close(statistics.moments.mean, moments.mean, rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(
        statistics.moments.sum_sq_dev, moments.sum_sq_dev, rtol=1e-9, atol=1e-9
    )
    assert torch.equal(statistics.minimum, features.amin(0))
    assert torch.equal(statistics.maximum, features.amax(0))
    assert torch.equal(statistics.sample.bins().features, sample.bins().features)
    assert statistics.seen_batches == {r[0]: content_digest(r[2], r[3]) for r in recordings}
    assert statistics.num_features == NUM
    assert statistics.minimum.dtype == statistics.maximum.dtype == torch.float32


@given(
    seed=st.integers(0, 99),
    order=st.randoms(use_true_random=False),
    num_shards=st.integers(1, 5),
    sample_bins=st.integers(0, 6),
)
def test_any_order_and_sharding_gives_the_same_bits(seed, order, num_shards, sample_bins):
    recordings = make_recordings(seed=seed)
    whole = statistics_of(recordings, sample_bins)
    order.shuffle(recordings)
    shards = [statistics_of(recordings[i::num_shards], sample_bins) for i in range(num_shards)]
    order.shuffle(shards)
    merged = TrainingStatistics(NUM, sample_bins)
    for shard in shards:
        before = bits_of(shard)
        merged.merge(shard)
        assert bits_of(shard) == before
    assert bits_of(merged) == bits_of(whole)
    assert bits_of(statistics_of(recordings, sample_bins)) == bits_of(whole)


def test_ranges_without_bins_take_in_any_other():
    statistics = TrainingStatistics(2, 3)
    assert statistics.minimum.tolist() == [math.inf] * 2
    assert statistics.maximum.tolist() == [-math.inf] * 2
    statistics.update("none", "a", torch.zeros(0, 2), torch.zeros(0))
    assert statistics.minimum.tolist() == [math.inf] * 2
    other = TrainingStatistics(2, 3)
    other.update("one", "a", torch.tensor([[-3.0, 5.0]]), torch.ones(1))
    statistics.merge(other)
    assert statistics.minimum.tolist() == statistics.maximum.tolist() == [-3, 5]
    assert len(statistics.seen_batches) == 2


def broken_bins(value):
    features = torch.zeros(5, NUM)
    features[2, 1] = value
    return features


@pytest.mark.parametrize(
    ("name", "features", "labels", "match"),
    [
        ("M1/1", torch.zeros(5, NUM), torch.zeros(5), "'M1/1' is in these statistics already"),
        ("new", torch.zeros(5, 3), torch.zeros(5), r"'new'.*\[N, 4\].*\(5, 3\)"),
        ("new", torch.zeros(5, NUM), torch.zeros(4), r"'new'.*\(5, 4\) and \(4,\)"),
        ("new", torch.zeros(5, NUM), torch.zeros(()), r"'new'.*\(5, 4\) and \(\)"),
        ("new", torch.zeros(5, NUM).double(), torch.zeros(5), "'new'.*hand float32"),
        ("new", broken_bins(math.nan), torch.zeros(5), "'new'.*nan in row 2, column 1"),
        ("new", broken_bins(-math.inf), torch.zeros(5), "'new'.*-inf in row 2, column 1"),
    ],
)
def test_a_refused_recording_changes_nothing(name, features, labels, match):
    statistics = statistics_of(make_recordings())
    before = bits_of(statistics)
    with pytest.raises(ValueError, match=match) as error:
        statistics.update(name, "M1", features, labels)
    assert "\n" not in str(error.value)
    assert bits_of(statistics) == before
    if name == "new":
        statistics.update(name, "M1", torch.zeros(5, NUM), torch.zeros(5))


def test_other_refusals_of_merge_change_nothing():
    recordings = make_recordings()
    statistics = statistics_of(recordings[:5])
    before = bits_of(statistics)
    for other, match in [
        (statistics_of(recordings[4:]), "1 batches are in both statistics, such as 'M1/4'"),
        (statistics, "5 batches are in both"),
        (statistics_of(recordings[5:], sample_bins=4), "statistics of 3 and 4 sample_bins"),
        (TrainingStatistics(NUM + 1, 3), "4 and 5 features"),
    ]:
        with pytest.raises(ValueError, match=match):
            statistics.merge(other)
        assert bits_of(statistics) == before
