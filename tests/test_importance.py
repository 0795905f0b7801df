"""Which sensors matter: sets whose answer is known, machines refitted the slow way, the command."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from sklearn.metrics import balanced_accuracy_score
from small_detector import HAND, raw_bins, small_detector
from test_commands import BAD_INPUT, TINY, composed

from tactslip_torch.analysis.importance import (
    HELD_OUT,
    Ranking,
    Refit,
    balanced_accuracy,
    count_right,
    difference,
    first_order,
    score_gradients,
    without,
)
from tactslip_torch.analysis.old.bin_sample import BinSample
from tactslip_torch.commands.importance import sensors
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.features.selection import ClassMoments, t_scores
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import PAPER_KERNEL
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.training.recipe import FeatureSelection

OF_FEATURE = ["a", "a", "b", "b", "c", "c"]  # of each feature
PENALTIES = (0.01, 0.1, 1.0)


def sampled(seed, tells, groups="MNO", recordings=4, bins=12):
    """Bins whose features ``tells`` follow the class, by how much; the others are noise."""
    rng = np.random.default_rng(seed)
    sample = BinSample(1000)
    for group in groups:
        for number in range(recordings):
            is_slip = torch.arange(bins) % 2 == 0
            noise = torch.from_numpy(rng.standard_normal((bins, len(OF_FEATURE)))).float()
            signal = torch.tensor([tells.get(i, 0.0) for i in range(len(OF_FEATURE))])
            features = noise + torch.where(is_slip, 1.0, -1.0)[:, None] * signal
            sample.update(f"{group}/{seed}/{number}", group, features, is_slip)
    return sample.bins()


def refit_of(tells):
    train = sampled(0, tells)
    scaler = FeatureScaler.fit(train.features.double())
    selection = FeatureSelection(tuple(range(len(OF_FEATURE))), scaler)
    scored = {"test": sampled(1, tells), "unseen": sampled(2, tells, groups="PQ")}
    weights = torch.linspace(0.5, 2.0, len(train.is_slip), dtype=torch.float64)
    return Refit(train, weights, scored, selection, PAPER_KERNEL, PENALTIES)


def ranking_of(refit, num_features=6, allowed=None, most_correlation=1.0):
    moments = ClassMoments(len(OF_FEATURE))
    moments.update(refit.train.features, refit.train.is_slip)
    scores = t_scores(moments, "pooled")
    return Ranking(scores, OF_FEATURE, allowed, refit.train, num_features, most_correlation)


# Accuracy and its draws --------------------------------------------------------------------------


def by_sklearn(scores, bins):
    """Mean over groups of the balanced accuracy of each."""
    groups = [bins.group == group for group in bins.group.unique()]
    return np.mean([balanced_accuracy_score(bins.is_slip[g], scores[g] >= 0) for g in groups])


def test_a_paired_interval_is_nothing_between_equals_and_holds_the_difference():
    bins = sampled(5, {})
    draw = torch.rand(len(bins.is_slip), generator=torch.Generator().manual_seed(2))
    better, worse = count_right(draw < 0.9, bins), count_right(draw < 0.6, bins)
    assert set(difference(better, better, 50, 0).values()) == {0.0}
    lost = difference(better, worse, 400, 0)
    assert 0 < lost["low"] < lost["lost"] < lost["high"]
    assert lost["lost"] == pytest.approx(
        float(balanced_accuracy(better)) - float(balanced_accuracy(worse))
    )
    with pytest.raises(ValueError, match="at least one draw, got 0"):
        difference(better, worse, 0, 0)


# Machines refitted -------------------------------------------------------------------------------


def test_a_result_is_that_of_machines_fitted_without_each_group():
    refit, features = refit_of({0: 0.8, 2: 0.5}), [0, 2, 5]
    train = refit.train
    z = FeatureScaler.fit(train.features[:, features].double())(train.features[:, features])
    best = None
    for penalty in PENALTIES:
        scores = torch.empty(len(z), dtype=torch.float64)
        for group in train.group.unique():
            own = train.group == group
            rest = TrainingBins(z[~own], train.is_slip[~own], refit.weights[~own])
            scores[own] = fit_machine(rest, penalty)(z[own])
        accuracy = by_sklearn(scores, train)
        error = refit.weights @ (torch.where(train.is_slip, 1.0, -1.0) - scores).square()
        merit = (accuracy, -float(error / refit.weights.sum()))
        if best is None or merit > best[0]:
            best = merit, penalty
    result = refit(features)
    assert result.penalty == best[1]
    assert result.merit == pytest.approx(best[0])
    head = fit_machine(TrainingBins(z, train.is_slip, refit.weights), result.penalty)
    for role, bins in refit.scored.items():
        scaled = FeatureScaler.fit(train.features[:, features].double())(bins.features[:, features])
        is_right = (head(scaled) >= 0) == bins.is_slip
        assert torch.equal(result.counts[role].right, count_right(is_right, bins).right)


def test_bins_of_other_roles_choose_nothing():
    refit = refit_of({0: 0.8})
    spoilt = refit_of({0: 0.8})
    for bins in spoilt.scored.values():
        bins.features.neg_()
    before, after = refit([0, 1]), spoilt([0, 1])
    assert (before.penalty, before.merit) == (after.penalty, after.merit)
    assert before.accuracies["unseen"] != after.accuracies["unseen"]
    without_a_feature = dict.fromkeys((HELD_OUT, "test", "unseen"), 0.5)
    assert refit([]).accuracies == without_a_feature  # every bin is slip


# Sets of channels --------------------------------------------------------------------------------


def test_a_ranking_takes_the_largest_scores_of_the_channels_it_may():
    refit = refit_of({5: 3.0, 4: 2.5, 3: 1.0, 1: 0.5})
    ranking = ranking_of(refit, num_features=3)
    assert ranking("abc") == [5, 4, 3]
    assert ranking("ab")[:2] == [3, 1]
    allowed = torch.tensor([True] * 4 + [False] * 2)
    assert ranking_of(refit, 6, allowed)("c") == []
    assert ranking_of(refit, 6, allowed)("bc")[0] == 3
    assert without([5, 3, 1, 0], {"a", "c"}, OF_FEATURE) == [3]
    shared = replace(ranking, is_shared=True)  # as many of each channel
    assert [shared(channels) for channels in ("abc", "c")] == [[5, 3, 1], [5, 4]]
    assert replace(shared, num_features=1)("bc") == [5, 3]  # one of each at least
    refit.train.features[:, 4] = 3 * refit.train.features[:, 5]
    assert ranking_of(refit, 2)("abc") == [4, 5]
    assert ranking_of(refit, 2, most_correlation=0.99)("abc") == [4, 3]  # passes over a repetition


# Gradients ---------------------------------------------------------------------------------------


def test_gradients_are_those_of_finite_differences():
    detector, samples = small_detector(2), raw_bins(3)
    scores, gradients = score_gradients(detector, samples)
    torch.testing.assert_close(scores, detector.score_raw(samples))
    generator = torch.Generator().manual_seed(0)
    way = torch.randn(samples.shape, generator=generator, dtype=torch.float64)
    step = 1e-7  # as entropy and mode step, of which gradients know nothing
    ahead, back = (detector.score_raw(samples + sign * step * way) for sign in (1, -1))
    slope = (ahead - back) / (2 * step)
    torch.testing.assert_close((gradients * way).sum((1, 2)), slope, rtol=1e-6, atol=0)
    used = {name.channel for name in detector.selected_names}
    assert [bool(part.any()) for part in gradients.unbind(1)] == [n in used for n in HAND.names]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"is_slip": torch.ones(4, dtype=torch.bool)}, "give bins of slip and of non-slip"),
        ({"scores": torch.full((4,), 2.0)}, "all 4 scores are 2; nothing moves them"),
        ({"gradients": torch.zeros(4, 2, 2)}, r"expected scores and is_slip \[N\]"),
    ],
)
def test_what_no_first_order_can_be_told_of_is_refused(change, words):
    given = {
        "scores": torch.arange(4.0),
        "gradients": torch.zeros(4, 2, 3),
        "samples": torch.zeros(4, 2, 3),
        "is_slip": torch.arange(4) < 2,
    }
    with pytest.raises(ValueError, match=words):
        first_order(**(given | change))


# The command -----------------------------------------------------------------------------------


def refused(folder, *overrides):
    """What is wrong, in a line."""
    config = composed("num_workers=0", "cache=off", *overrides, name="importance")
    with pytest.raises(BAD_INPUT) as caught:
        sensors(config, folder)
    assert not list(folder.glob("sensors.*"))
    return one_line(caught.value)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("bins=1", "bins must be a whole number of at least 2, got 1"),
        ("num_features=0", "num_features must be a positive whole number, got 0"),
        ("reselect=equal", "reselect must be ranked or shared, got 'equal'"),
    ],
)
def test_bad_input_is_one_line(tmp_path, override, words):
    assert words in refused(tmp_path, "model=nothing.pt", override)


def test_a_detector_without_its_run_is_refused(tmp_path):
    detector, model = small_detector(), tmp_path / "run" / "deep" / "detector.pt"
    detector.info |= {"split": "unseen4", "train_recordings": []}
    detector.save(model)
    assert "no config.yaml beside" in refused(tmp_path, f"model={model}")
    config = composed(*TINY)
    OmegaConf.save(config, model.with_name("config.yaml"))
    wrong = refused(tmp_path, f"model={model}")
    assert "are not those that detector.pt was trained on" in wrong
    del config.recipe
    OmegaConf.save(config, model.with_name("config.yaml"))
    wrong = refused(tmp_path, f"model={model}")
    assert "has no recipe; give the config.yaml of a training" in wrong
