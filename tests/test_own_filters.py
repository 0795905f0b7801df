"""Filters of one's own, given as numbers: features, cache, statistics and files."""

import pytest
from any_hands import detector_of, own_kernels, own_wavelet
from small_set import SMALL_HAND, SmallSet

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import FORMAT, SlipDetector
from tactslip_torch.package_files import load_table, save_table
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker

RECORDING = RecordingId("a", 0)


WAVELET = own_wavelet()
KERNELS = own_kernels(ChannelFilter([51, 11]))


def maker_of(source, wavelet="rbio2.2", kernels=None, cache=None):
    pool = FeaturePool(SMALL_HAND, wavelet=wavelet)
    return FeatureMaker(source, pool, ChannelFilter([51, 11], kernels=kernels), LabelRule(), cache)


def test_other_filters_are_another_entry_of_the_cache(tmp_path):
    source, cache = SmallSet(), FeatureCache(tmp_path)
    others = own_kernels(ChannelFilter([51, 11]), seed=4)
    choices = [{}, {"wavelet": WAVELET}, {"kernels": KERNELS}, {"kernels": others}]
    for _ in range(2):
        for choice in choices:
            maker_of(source, cache=cache, **choice)(RECORDING)
    assert source.loads == len(choices)


DAMAGES = {
    "kernel sum": lambda metadata: metadata["kernels"].update({"11": [0.1] * 11}),
    "kernel length": lambda metadata: metadata["kernels"].update({"nine": [1.0]}),
    "no wavelet": lambda metadata: metadata["pool"]["wavelet"].update({"dec_lo": [1.0] * 6}),
    "no name": lambda metadata: metadata["pool"]["wavelet"].pop("name"),
}


@pytest.mark.parametrize("change", DAMAGES)
def test_damaged_filters_are_named_in_one_line(tmp_path, change):
    path = tmp_path / "detector.pt"
    detector_of("own filters").save(path)
    metadata, tensors = load_table(path, FORMAT)
    DAMAGES[change](metadata)
    save_table(path, FORMAT, metadata, tensors)
    with pytest.raises(ValueError, match="is damaged: ") as error:
        SlipDetector.load(path)
    assert "\n" not in str(error.value)
