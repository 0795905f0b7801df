"""What was learned is what is deployed: features, cache, files and the alarm of a stream."""

import json

import pytest
import torch
from small_detector import HAND, raw_bins, small_detector
from small_set import SMALL_HAND, SmallSet

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import unseen4
from tactslip_torch.datamodule import SlipDataModule
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.files import load_table, save_table
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.detector_file import FORMAT
from tactslip_torch.signals.binning import bins_at
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.learnable import LearnableSmoothing, extended
from tactslip_torch.signals.lifting import LiftedWavelet

RECORDING = RecordingId("a", 0)


def stepped(module, size=0.1, seed=3):
    """As after a step of learning."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
            parameter.copy_(size * noise)
    return module


def maker_of(source, wavelet="rbio2.2", kernels=None, cache=None):
    pool = FeaturePool(SMALL_HAND, wavelet=wavelet)
    return FeatureMaker(source, pool, ChannelFilter([51, 11], kernels=kernels), LabelRule(), cache)


def split_of(source):
    return unseen4(source.ids, seen=["a", "b"], unseen=["c"])[0]


@pytest.fixture(scope="module")
def wavelet():
    return stepped(LiftedWavelet())


@pytest.fixture(scope="module")
def smoothing():
    return stepped(LearnableSmoothing(ChannelFilter([51, 11])), 1.0)


def test_features_of_the_frozen_filters_are_those_that_were_learned(wavelet, smoothing):
    source = SmallSet()
    frozen = maker_of(source, wavelet.frozen(), smoothing.frozen())
    made = frozen(RECORDING, split_of(source)).features
    starts = frozen.lay_bins(source.timeline(RECORDING)).starts
    whole = extended(source.load(RECORDING).samples.double(), smoothing.channel_filter)
    raw = bins_at(whole, starts, 100 + 2 * 25)
    pool = FeaturePool(SMALL_HAND).with_branches(wavelet.branch_matrix(100))
    learned = pool(smoothing(raw))
    assert learned.requires_grad
    firm = [i for i, name in enumerate(pool.names) if name.descriptor not in ("mode", "entropy")]
    expected = learned.detach().float()[:, firm]
    torch.testing.assert_close(made[:, firm], expected, rtol=1e-5, atol=1e-5)
    plain = maker_of(source)(RECORDING, split_of(source)).features
    assert not torch.allclose(made, plain, rtol=1e-2)


def test_other_filters_are_another_entry_of_the_cache(tmp_path, wavelet, smoothing):
    source, cache = SmallSet(), FeatureCache(tmp_path)
    choices = [
        {},
        {"wavelet": wavelet.frozen()},
        {"wavelet": stepped(LiftedWavelet(), seed=4).frozen()},
        {"kernels": smoothing.frozen()},
        {"kernels": stepped(LearnableSmoothing(ChannelFilter([51, 11])), seed=4).frozen()},
    ]
    for _ in range(2):
        for choice in choices:
            maker_of(source, cache=cache, **choice)(RECORDING, split_of(source))
    assert source.loads == len(choices)


def test_statistics_say_which_filters_they_are_of(wavelet, smoothing):
    source = SmallSet()
    about = [
        SlipDataModule(maker, split_of(source), num_workers=0).about()
        for maker in (
            maker_of(source),
            maker_of(source, wavelet.frozen()),
            maker_of(source, kernels=smoothing.frozen()),
        )
    ]
    assert len({json.dumps(facts, sort_keys=True) for facts in about}) == 3
    assert "kernels" not in about[0]
    assert FeaturePool(SMALL_HAND, **about[1]["pool"]).wavelet == wavelet.frozen()
    assert about[2]["kernels"]["11"] == list(smoothing.frozen()[11])


@pytest.fixture
def detector(wavelet, smoothing):
    plain = small_detector(engine="eager")
    pool = FeaturePool(HAND, wavelet=wavelet.frozen())
    layer = ChannelFilter([51, 51, 11, 11], kernels=smoothing.frozen())
    return SlipDetector(pool, layer, plain.selected, plain.scaler, plain.head, plain.info)


@pytest.mark.parametrize("engine", ["reference", "eager", "compiled"])
def test_a_detector_comes_back_with_its_filters_in_any_engine(tmp_path, detector, engine):
    if engine == "compiled":
        pytest.importorskip("numba")
    detector.save(tmp_path / "detector.pt")
    loaded = SlipDetector.load(tmp_path / "detector.pt", engine=engine)
    assert loaded.extractor.engine == engine
    assert loaded.pool.wavelet == detector.pool.wavelet
    assert loaded.channel_filter.kernels == detector.channel_filter.kernels
    samples = raw_bins(30, seed=1)
    expected = small_detector(engine="eager").score_raw(samples)
    score = loaded.score_raw(samples)
    torch.testing.assert_close(score, detector.score_raw(samples), rtol=1e-9, atol=1e-9)
    assert not torch.allclose(score, expected, rtol=1e-3)


def test_a_file_without_learned_filters_is_as_it_was(tmp_path):
    small_detector().save(tmp_path / "detector.pt")
    facts, _ = load_table(tmp_path / "detector.pt", FORMAT)
    assert "kernels" not in facts
    assert facts["pool"]["wavelet"] == "rbio2.2"
    assert SlipDetector.load(tmp_path / "detector.pt").channel_filter.kernels == {}


@pytest.mark.parametrize(
    "change",
    [
        lambda facts: facts["kernels"].update({"11": [0.1] * 11}),
        lambda facts: facts["kernels"].update({"nine": [1.0]}),
        lambda facts: facts["pool"]["wavelet"].update({"dec_lo": [1.0] * 6}),
        lambda facts: facts["pool"]["wavelet"].pop("name"),
    ],
    ids=["kernel sum", "kernel length", "no wavelet", "no name"],
)
def test_damaged_filters_are_named_in_one_line(tmp_path, detector, change):
    path = tmp_path / "detector.pt"
    detector.save(path)
    facts, tensors = load_table(path, FORMAT)
    change(facts)
    save_table(path, FORMAT, facts, tensors)
    with pytest.raises(ValueError, match="is a damaged detector: ") as error:
        SlipDetector.load(path)
    assert "\n" not in str(error.value)
