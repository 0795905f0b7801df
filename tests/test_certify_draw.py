"""``certify``: which bins it draws."""

import pytest
import torch
from hydra.utils import instantiate
from small_detector import small_detector
from test_certify import composed, source

from tactslip_torch.commands.certify import draw_bins
from tactslip_torch.data.labels import LabelRule, label_bins
from tactslip_torch.data.splits import Split
from tactslip_torch.features.cache import cache_key
from tactslip_torch.training.datamodule import FeatureMaker


def drawn(number, role="train", seed=0, fold=None, rule=None):
    fold = fold or instantiate(composed("model=x").split, _convert_="all")(source().ids)[0]
    detector = small_detector()
    maker = FeatureMaker(source(), detector.pool, detector.channel_filter, rule or LabelRule())
    return draw_bins(maker, fold, role, number, seed), fold


@pytest.mark.parametrize(("number", "recordings"), [(5, 1), (81, 3), (160, 4), (250, 4)])
def test_drawn_bins_are_those_of_the_role_with_their_context(number, recordings):
    (bins, facts), fold = drawn(number)
    assert len(bins) == number
    assert facts["recordings"] == recordings
    known, rule = {}, LabelRule()
    for recording in fold.having("train"):
        times = source().timeline(recording)
        own = label_bins(rule, times.onsets_s, times.sliding_s, times.duration_s, 2000.0)
        samples = source().load(recording).samples
        for start in own.starts.tolist():
            known[samples[:, start - 25 : start + 125].numpy().tobytes()] = recording
    met = [known[one.contiguous().numpy().tobytes()] for one in bins]
    assert len(set(met)) == recordings
    assert len({one.numpy().tobytes() for one in bins}) == number  # none twice
    if recordings > 1:
        assert {recording.material for recording in met} == {"A", "B"}


def test_the_draw_repeats_itself_by_seed():
    first, again, other = (drawn(50, seed=seed)[0][0] for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_drawn_recordings_are_known_by_their_keys():
    (_, facts), fold = drawn(200)
    assert sorted(facts["keys"]) == sorted(cache_key(source().key(r)) for r in fold.having("train"))


def test_bins_of_one_recording_may_have_two_roles():
    recordings = source().ids[:2]
    fold = Split("random_bins", dict.fromkeys(recordings, "train"), test_share_of_bins=0.5)
    train, test = (drawn(20, role, fold=fold)[0][0] for role in ("train", "test"))
    own, other = ({one.numpy().tobytes() for one in bins} for bins in (train, test))
    assert not own & other


def test_a_role_that_nobody_has_is_refused():
    fold = Split("odd", {source().ids[0]: "train"})
    with pytest.raises(ValueError, match="no recording has the role 'unseen' in odd; choose"):
        drawn(5, "unseen", fold=fold)
