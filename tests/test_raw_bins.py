"""Raw bins that are drawn: of the role, with their context, none twice."""

import pytest
import torch
from hydra.utils import instantiate
from small_detector import small_detector
from test_commands import TINY_DATA, TINY_SPLIT, TinyRecordings, composed

from tactslip_torch.analysis.raw_bins import draw_bins
from tactslip_torch.data.labels import LabelRule, label_bins
from tactslip_torch.training.datamodule import FeatureMaker

SOURCE = TinyRecordings(seed=0, cycles=4, materials=["A", "B", "C"])


def drawn(number, seed=0):
    config = composed(*TINY_DATA, *TINY_SPLIT)
    (fold,) = instantiate(config.split, _convert_="all")(SOURCE.ids)
    detector = small_detector()
    maker = FeatureMaker(SOURCE, detector.pool, detector.channel_filter, LabelRule())
    bins, _, recordings = draw_bins(maker, fold, "train", number, seed)
    return bins, recordings, fold


def keys_of(bins):
    return [one.float().contiguous().numpy().tobytes() for one in bins]


@pytest.mark.parametrize(("number", "num_recordings"), [(5, 1), (81, 3), (250, 4)])
def test_drawn_bins_are_those_of_the_role_with_their_context(number, num_recordings):
    bins, recordings, fold = drawn(number)
    assert len(recordings) == num_recordings
    known = {}
    for recording in fold.having("train"):
        times = SOURCE.timeline(recording)
        own = label_bins(LabelRule(), times.onsets_s, times.sliding_s, times.duration_s, 2000.0)
        samples = SOURCE.load(recording).samples
        cut = [samples[:, start - 25 : start + 125] for start in own.starts.tolist()]
        known |= dict.fromkeys(keys_of(cut), recording)
    assert {known[key] for key in keys_of(bins)} == set(recordings)
    assert len(set(keys_of(bins))) == len(bins) == number  # none twice
    assert {recording.material for recording in recordings} <= {"A", "B"}
    assert torch.equal(bins, drawn(number)[0])
    assert not torch.equal(bins, drawn(number, seed=4)[0])
