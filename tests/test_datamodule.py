import pytest
import torch
from small_set import RATE_HZ, SmallSet, small_maker

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import unseen4
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.filtering import ChannelFilter, savgol_filter
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule


def split_of(source, **options):
    return unseen4(source.ids, seen=["a", "b"], unseen=["c"], **options)[0]


def test_features_are_those_of_the_filtered_bins():
    source = SmallSet()
    made = small_maker(source)(RecordingId("a", 1), split_of(source))
    samples = source.load(RecordingId("a", 1)).samples.double()
    filtered = torch.stack([savgol_filter(samples[0], 51), savgol_filter(samples[1], 11)])
    edge = round((1.1 - 0.010) * RATE_HZ)
    starts = [edge - 2000 + 100 * i for i in range(20)] + [edge + 100 * i for i in range(17)]
    bins = torch.stack([filtered[:, s : s + 100] for s in starts])
    torch.testing.assert_close(made.features, FeaturePool(source.hand)(bins).float())
    assert made.is_slip.tolist() == [False] * 20 + [True] * 17
    assert made.speed_mm_s.tolist() == [20.0] * 37


def test_the_cache_saves_the_work_and_a_damaged_entry_is_made_anew(tmp_path, caplog):
    source = SmallSet()
    maker = small_maker(source, FeatureCache(tmp_path))

    def made():
        return maker(RecordingId("a", 0), split_of(source))

    first, second = made(), made()
    assert (source.loads, set(second.seconds)) == (1, {"read_cache"})
    (path,) = tmp_path.glob("*/*.npz")
    path.write_bytes(path.read_bytes()[:-4])
    third = made()
    assert source.loads == 2
    assert "damaged" in caplog.text
    assert torch.equal(first.features, second.features)
    assert torch.equal(first.features, third.features)


def test_shuffled_labels_keep_their_counts_and_lose_their_order():
    source = SmallSet()
    plain = small_maker(source)(RecordingId("a", 0), split_of(source)).is_slip
    maker = small_maker(source, shuffle_seed=3)
    mixed = maker(RecordingId("a", 0), split_of(source)).is_slip
    assert plain.sum() == mixed.sum()
    assert not torch.equal(plain, mixed)
    assert torch.equal(mixed, maker(RecordingId("a", 0), split_of(source)).is_slip)
    assert not torch.equal(mixed, maker(RecordingId("a", 1), split_of(source)).is_slip)


def test_a_sample_that_is_not_finite_is_named():
    broken = RecordingId("b", 2)
    source = SmallSet(broken=broken)
    with pytest.raises(ValueError, match=r"b/2: channel PVDF1, sample \d+ \(1\.\d+ s\) is nan"):
        small_maker(source)(broken, split_of(source))


class BrokenBefore(SmallSet):
    """One sample is missing 30 before the first bin."""

    def shape(self, noise, time_s, recording, generator):
        noise[0, 150] = torch.nan


@pytest.mark.parametrize("align", ["centred", "causal"])
def test_a_broken_sample_before_a_causal_bin_is_named(align):
    """A centred frame does not reach it."""
    source, layer = BrokenBefore(), ChannelFilter([51, 11], align=align)
    maker = FeatureMaker(source, FeaturePool(source.hand), layer, LabelRule())
    assert int(maker.lay_bins(source.timeline(source.ids[0])).starts[0]) == 180
    if align == "centred":
        assert maker(source.ids[0], split_of(source)).features.isfinite().all()
        return
    with pytest.raises(ValueError, match=r"^a/0: channel SG1, sample 150 \(0\.0750 s\) is nan"):
        maker(source.ids[0], split_of(source))


@pytest.mark.parametrize("num_workers", [0, 2])
def test_loaders_give_the_recordings_of_their_roles_in_order(num_workers):
    source = SmallSet()
    data = SlipDataModule(small_maker(source), split_of(source), num_workers)
    trained = [batch.recording for batch in data.train_dataloader()]
    assert trained == data.split.having("train")
    assert len(trained) == 8
    assert [batch.recording for batch in data.test_dataloader()] == sorted(source.ids)
    with pytest.raises(ValueError, match="9 processes or shards for 8 recordings; use fewer"):
        data.loader(["train"], parts=9)
