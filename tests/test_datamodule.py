import pytest
import torch
from small_set import RATE_HZ, SmallSet, small_maker

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import leave_one_material_out
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule


def test_features_are_those_of_the_filtered_bins():
    source = SmallSet()
    made = small_maker(source)(RecordingId("a", 1))
    samples = source.load(RecordingId("a", 1)).samples.double()
    filtered = ChannelFilter([51, 11])(samples[:2])
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
        return maker(RecordingId("a", 0))

    first, second = made(), made()
    assert source.loads == 1
    (path,) = tmp_path.glob("*/*.npz")
    path.write_bytes(path.read_bytes()[:-4])
    third = made()
    assert source.loads == 2
    assert "damaged" in caplog.text
    assert torch.equal(first.features, second.features)
    assert torch.equal(first.features, third.features)


def test_shuffled_labels_keep_their_counts_and_lose_their_order():
    source = SmallSet()
    plain = small_maker(source)(RecordingId("a", 0)).is_slip
    maker = small_maker(source, shuffle_seed=3)
    mixed = maker(RecordingId("a", 0)).is_slip
    assert plain.sum() == mixed.sum()
    assert not torch.equal(plain, mixed)
    assert torch.equal(mixed, maker(RecordingId("a", 0)).is_slip)
    assert not torch.equal(mixed, maker(RecordingId("a", 1)).is_slip)


def test_a_sample_that_is_not_finite_is_named():
    broken = RecordingId("b", 2)
    source = SmallSet(broken=broken)
    with pytest.raises(ValueError, match=r"b/2: channel PVDF1, sample \d+ \(1\.\d+ s\) is nan"):
        small_maker(source)(broken)


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
        assert maker(source.ids[0]).features.isfinite().all()
        return
    with pytest.raises(ValueError, match=r"^a/0: channel SG1, sample 150 \(0\.0750 s\) is nan"):
        maker(source.ids[0])


@pytest.mark.parametrize(
    ("num_workers", "memory_gib"),
    [(0, 2.0), (0, 1e-4), pytest.param(2, 1e-4, marks=pytest.mark.slow)],
)
def test_features_are_made_once_for_all_folds_in_memory_or_in_the_cache(
    num_workers, memory_gib, tmp_path
):
    source = SmallSet(cycles=2)
    pool, layer = FeaturePool(source.hand), ChannelFilter([51, 11])
    expected = {recording: small_maker(source)(recording).features for recording in source.ids}
    source.loads = 0
    cache, rule = FeatureCache(tmp_path), LabelRule()
    maker = FeatureMaker(source, pool, layer, rule, cache, memory_gib=memory_gib)
    folds = leave_one_material_out(source.ids)
    data = SlipDataModule(maker, folds, num_workers)
    data.setup()
    for data.fold in folds:
        (trained,) = data.train_dataloader()
        for _ in range(2):
            assert [bins.name for bins in trained] == [str(r) for r in data.fold.having("train")]
        tested = list(data.test_dataloader())
        assert [batch.recording for batch in tested] == sorted(source.ids)
        for batch in tested:
            roles = data.fold.bin_roles(batch.recording, len(batch.is_slip))
            assert {role: mask.tolist() for role, mask in batch.roles.items()} == {
                role: mask.tolist() for role, mask in roles.items()
            }
            assert torch.equal(batch.features, expected[batch.recording])
    assert source.loads == (0 if num_workers else len(source.ids))  # by workers, or once
    with pytest.raises(ValueError, match=r"features.memory_gib"):
        FeatureMaker(source, pool, layer, rule, memory_gib=-1.0)


def test_a_selection_of_the_pool_has_its_columns_and_reads_those_of_a_larger_one(tmp_path):
    source, cache = SmallSet(), FeatureCache(tmp_path)
    whole = small_maker(source, cache)
    options = ChannelFilter([51, 11]), LabelRule(), cache
    few = FeatureMaker(source, whole.pool.select([250, 3, 17]), *options)
    first = few(source.ids[0])
    everything = whole(source.ids[0])
    assert source.loads == 2  # the first one lacks columns
    assert torch.equal(first.features, everything.features[:, [250, 3, 17]])
    again = few(source.ids[0])
    assert source.loads == 2
    assert torch.equal(again.features, first.features)
