"""What the learner learns from, and that it learns from nothing else."""

from dataclasses import replace

import lightning as L
import pytest
import torch
from small_set import RATE_HZ, SMALL_HAND, SmallSet, small_maker, small_recipe

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.splits import random_bins, seen6, unseen4
from tactslip_torch.features.cache import FeatureCache
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.sensing import without_stuck
from tactslip_torch.onset.events import LatencyParts
from tactslip_torch.signals.filtering import ChannelFilter, bins_at
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.evaluation import evaluated_bins, events_by_rule
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.recipe import General

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*isinstance.treespec, LeafSpec.*",
    "ignore:.*does not have many workers",
)


def trainer(**changes):
    options = {
        "accelerator": "cpu",
        "max_epochs": 1,
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    return L.Trainer(**(options | changes))


def learn(source, split, maker=None, recipe=None, *, with_baselines=False):
    maker = maker or small_maker(source)
    data = SlipDataModule(maker, [split], num_workers=0)
    recipe = recipe or small_recipe()
    learner = SlipLearner(maker.pool, maker.channel_filter, recipe, with_baselines=with_baselines)
    backend = trainer()
    backend.fit(learner, datamodule=data)
    backend.test(learner, datamodule=data, verbose=False)
    return learner


def unseen_c(source):
    return unseen4(source.ids, seen=["a", "b"], unseen=["c"])[0]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return FeatureCache(tmp_path_factory.mktemp("features"))


# What is learned from ----------------------------------------------------------------------------


def test_held_out_bins_of_the_random_split_are_not_learned_from(cache):
    source = SmallSet()
    split = random_bins(source.ids, seen=["a", "b", "c"])[0]
    maker = small_maker(source, cache)
    before = learn(source, split, maker)

    class Perturbed(FeatureMaker):
        def __call__(self, recording):
            made = super().__call__(recording)
            is_test = split.bin_roles(recording, len(made.is_slip))["test"]
            return made._replace(features=torch.where(is_test[:, None], -9.0, made.features))

    options = (maker.pool, maker.channel_filter, maker.rule, cache)
    after = learn(source, split, Perturbed(source, *options))
    assert after.detector.selected == before.detector.selected
    assert after.metadata == before.metadata
    for name, value in before.detector.state_dict().items():
        assert torch.equal(after.detector.state_dict()[name], value), name
    assert before.metrics["splits"]["test"] != after.metrics["splits"]["test"]


def test_a_detector_computes_by_the_backend_of_its_training(cache):
    source = SmallSet()
    pool = FeaturePool(SMALL_HAND, backend="torch")
    maker = FeatureMaker(source, pool, ChannelFilter([51, 11]), LabelRule(), cache)
    assert learn(source, unseen_c(source), maker).detector.extractor.backend == "torch"


# What a test tells -------------------------------------------------------------------------------


def test_events_are_of_the_detectors_own_decisions_and_the_exact_onset():
    class Apart(SmallSet):
        """A person marked the onset 20 ms late."""

        def timeline(self, recording):
            return replace(super().timeline(recording), annotated_onsets_s=(1.12,))

    source = Apart()
    learner, maker, split = learn(source, unseen_c(source)), small_maker(source), unseen_c(source)
    latency = LatencyParts(learner.detector.look_ahead / RATE_HZ, 0.05)
    for role in ("test", "unseen"):
        parts, right = [], []
        for recording in split.having(role):
            bins, labels = maker.filtered_bins(recording)
            says_slip = learner.detector(bins) >= 0
            right.append(says_slip == labels.is_slip)
            batch, is_valid = maker(recording).in_split(split), torch.ones_like(says_slip)
            parts.append(evaluated_bins(batch, says_slip, is_valid, {})[role])
        scores = learner.metrics["splits"][role]
        assert scores["accuracy"] == pytest.approx(float(torch.cat(right).double().mean()))
        assert str(learner.events[role]) == str(events_by_rule(parts, latency))
        assert learner.metrics["events"][role]["two_of_three"]["num_onsets"] == len(parts)
        assert {part.bins.times.onsets_s for part in parts} == {(1.1,)}
        for found in learner.events[role]["first_transition"]:  # from 1.12 - 0.01 - 1 on
            assert found.quiet_s == pytest.approx(0.9 - 0.11 - latency.look_ahead_s)


class Dying(SmallSet):
    """Of material c: one channel sticks, all stick, one falls silent, one has a large offset."""

    def shape(self, noise, time_s, recording, generator):
        super().shape(noise, time_s, recording, generator)
        middle = noise.shape[1] // 2 + 37
        if recording.material == "c":
            dies = slice(None) if recording.cycle == 1 else slice(0, 1)
            size, level = {2: (1e-4, 1.0), 3: (0.2, 3e5)}.get(recording.cycle, (0.0, 1.0))
            noise[dies, middle:] = size * noise[dies, middle:] + level


@pytest.mark.parametrize(
    ("align", "bin_ms"), [("centred", 50.0), ("causal", 50.0), ("centred", 5.0)]
)
def test_a_test_decides_as_the_detector_does_where_channels_die(align, bin_ms, cache):
    source, length = Dying(), round(bin_ms * 1e-3 * RATE_HZ)
    layer = ChannelFilter([51, 11], align=align)
    pool = FeaturePool(SMALL_HAND, bin_samples=length, level=None)
    maker = FeatureMaker(source, pool, layer, LabelRule(bin_ms=bin_ms, hop_ms=10), cache)
    split = unseen_c(source)
    learner = learn(source, split, maker, General(sample_bins=50))
    detector, right, num_lost, num_invalid = learner.detector, [], 0, 0
    for recording in split.having("unseen"):
        labels = maker.lay_bins(source.timeline(recording))
        samples = without_stuck(source.load(recording).samples, detector.sensing.stuck_samples)
        before, behind = layer.context_before, layer.context_after
        windows = bins_at(samples, labels.starts - before, before + length + behind)
        found = detector.predict_raw(windows)
        right.append((found.is_valid & (found.score >= 0)) == labels.is_slip)
        num_lost += int(found.channels_lost.any(-1).sum())
        num_invalid += int((~found.is_valid).sum())
    assert num_lost > num_invalid + 50 > 100
    found = learner.metrics["splits"]["unseen"]
    assert found["accuracy"] == pytest.approx(float(torch.cat(right).double().mean()))
    assert found["num_not_valid"] == num_invalid


@pytest.mark.slow
def test_shuffled_labels_are_not_learned():
    source = SmallSet(cycles=30)
    split = seen6(source.ids, seen=["a", "b", "c"])[0]
    honest = learn(source, split).metrics["splits"]["test"]["balanced_accuracy"]
    shuffled = learn(source, split, small_maker(source, shuffle_seed=1))
    found = shuffled.metrics["splits"]["test"]
    # 666 bins, independent labels: a standard deviation of 2 %
    assert found["num_bins"] == 18 * 37
    assert abs(found["balanced_accuracy"] - 0.5) < 0.08
    assert honest > 0.75
    events = shuffled.metrics["events"]["test"]["first_transition"]
    assert events["num_onsets"] == 18
    assert events["num_false_alarms"] > 18  # whatever comes: it decides by nothing
