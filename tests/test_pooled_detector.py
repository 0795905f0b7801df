"""A detector that pools over channels, as the default recipe makes it, in every use of a detector.

It is the one that comes with the package; commands are tested on a small one of their own.
"""

import copy

import pytest
import torch
from test_commands import TINY, run_train

from tactslip_torch import SlipDetector, sample_recording

DEAD = ("SG2", "SG9", "PVDF1", "PVDF7")


@pytest.fixture(scope="module")
def detector():
    return SlipDetector.pretrained("paper24-sim")


def test_a_damaged_pooling_is_refused(detector, tmp_path):
    broken = copy.deepcopy(detector)
    broken.pooling.compression[0] = -1.0
    broken.save(tmp_path / "broken.pt")
    with pytest.raises(ValueError, match=r"broken\.pt") as caught:
        SlipDetector.load(tmp_path / "broken.pt")
    assert "\n" not in str(caught.value)


# Dead channels -----------------------------------------------------------------------------------


def test_dead_channels_are_left_out_of_their_pools(detector):
    recording = sample_recording().samples.double()
    bins = recording.unfold(-1, 400, 400).transpose(0, 1)[:, :, : detector.pool.bin_samples]
    judged = detector.predict(bins, masked_channels=list(DEAD))
    mask = torch.tensor([name in DEAD for name in detector.pool.hand.names])
    features = detector.extractor(bins.masked_fill(mask[:, None], 0.0), torch.float64)
    columns = detector.columns(features, mask.expand(len(bins), -1))
    wanted = detector.head(detector.scaler(columns))
    torch.testing.assert_close(judged.score, wanted, rtol=1e-10, atol=1e-12)
    assert judged.is_valid.all()
    assert torch.equal(judged.channels_lost, mask.expand(len(bins), -1))
    holed = bins.clone()
    holed[:, mask, 7] = torch.nan
    torch.testing.assert_close(detector.predict(holed).score, judged.score, rtol=1e-10, atol=1e-12)


# Commands ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.onnx
def test_an_order_statistic_and_both_kinds_of_column_are_exported(tmp_path):
    folder = tmp_path / "both"
    run_train(
        folder, *TINY[:-1], "recipe.views=[channel,pooled]", "recipe.tolerance=0.9",
        "features.pooling=[mean,std,min,max,median]", "data.cycles=8", "cache=off",
    )  # fmt: skip
    made = SlipDetector.load(folder / "detector.pt")
    assert (folder / "model.onnx").exists()
    assert {name.is_pooled for name in made.selected_names} == {True, False}
