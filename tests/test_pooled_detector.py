"""A detector that pools over channels, as the default recipe makes it, in every use of a detector.

It is the one that comes with the package; commands are tested on a small one of their own.
"""

import copy

import pytest
import torch
from hydra.utils import instantiate
from test_commands import TINY, composed, run_train

from tactslip_torch import SlipDetector
from tactslip_torch.onset.decisions import score_stream

HOP = 50
STUCK_AT = 9_000  # sample
MOST_MOVED = 1e-4  # of the scores' standard deviation
DEAD = ("SG2", "SG9", "PVDF1", "PVDF7")


@pytest.fixture(scope="module")
def detector():
    return SlipDetector.pretrained("paper24-sim")


@pytest.fixture(scope="module")
def recording():
    """A test recording in float64, with digits that float32 does not hold."""
    source = instantiate(composed("+exp=quick").data, _convert_="all")
    samples = source.load(source.ids[1]).samples.double()
    generator = torch.Generator().manual_seed(0)
    digits = torch.rand(samples.shape, generator=generator, dtype=torch.float64) - 0.5
    return samples + digits * torch.finfo(torch.float32).eps * samples.abs()


@pytest.fixture(scope="module")
def whole(detector, recording):
    return score_stream(detector, recording, HOP)


def noise_like(samples, size=1e-9):
    generator = torch.Generator().manual_seed(1)
    return size * torch.randn(samples.shape, generator=generator, dtype=torch.float64)


def test_a_damaged_pooling_is_refused(detector, tmp_path):
    broken = copy.deepcopy(detector)
    broken.pooling.compression[0] = -1.0
    broken.save(tmp_path / "broken.pt")
    with pytest.raises(ValueError, match=r"broken\.pt") as caught:
        SlipDetector.load(tmp_path / "broken.pt")
    assert "\n" not in str(caught.value)


# Must hold: last digits, and channels that get stuck ---------------------------------------------


def test_a_nanovolt_of_noise_moves_no_score(detector, recording, whole):
    found = score_stream(detector, recording + noise_like(recording), HOP)
    sd = float(whole.score.std())
    assert float((found.score - whole.score).abs().max()) < MOST_MOVED * sd
    assert torch.equal(found.score >= 0, whole.score >= 0)


@pytest.mark.parametrize("noise", [0.0, 1e-9], ids=["constant", "1 nV"])
@pytest.mark.parametrize("channel", DEAD)
def test_a_stuck_channel_is_left_out_within_a_second(channel, noise, detector, recording, whole):
    place = detector.pool.hand.names.index(channel)
    stuck, dead = recording.clone(), recording.clone()
    rest = stuck[place, STUCK_AT:]
    rest[:] = recording[place, STUCK_AT] + noise_like(rest, noise)
    dead[place] = torch.nan
    found, wanted = (score_stream(detector, x, HOP) for x in (stuck, dead))
    starts = HOP * torch.arange(len(found.score))
    later = starts + detector.pool.bin_samples > STUCK_AT + 2000  # bins that end a second later
    assert int(later.sum()) > 100
    assert torch.equal(found.score[later], wanted.score[later])
    before = starts + detector.pool.bin_samples + detector.look_ahead < STUCK_AT
    assert torch.equal(found.score[before], whole.score[before])
    assert not torch.equal(found.score[later], whole.score[later])  # it was in use


# Dead channels -----------------------------------------------------------------------------------


def test_dead_channels_are_left_out_of_their_pools(detector, recording):
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


def test_a_hand_that_says_nothing_has_no_score(detector, recording):
    """Unplugged, it is zeros or a volt of offset and the converter's noise; once, that was slip."""
    quiet = 0.01 * torch.tensor(detector.sensing.rest_span).double()[:, None]
    for samples in (recording * 0.0, recording * torch.nan, 1.0 + quiet * noise_like(recording, 1)):
        found = score_stream(detector, samples, HOP)
        assert found.score.isnan().all()
        assert found.channels_lost.all()
        assert not (found.is_valid | found.in_range).any()


# Commands ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.onnx
def test_an_order_statistic_and_both_kinds_of_column_are_exported(tmp_path):
    folder = tmp_path / "both"
    run_train(
        folder, *TINY[:-1], "recipe.use=both", "recipe.num_features=25", "recipe.degree=2",
        "features.pooling=[mean,std,min,max,median]", "data.cycles=8", "cache=off",
    )  # fmt: skip
    made = SlipDetector.load(folder / "detector.pt")
    assert (folder / "model.onnx").exists()
    assert {name.is_pooled for name in made.selected_names} == {True, False}
