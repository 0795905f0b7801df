"""Baselines: what each learns, and what is kept of them."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.metrics import balanced_accuracy_score
from small_detector import HAND
from small_set import SmallSet
from test_learner import learn, unseen_c

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.training.baselines import Baselines, _best_threshold, _PooledNumber
from tactslip_torch.training.bins import BinSample, RecordingBins
from tactslip_torch.training.evaluation import Outcomes, compared

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*isinstance.treespec, LeafSpec.*",
    "ignore:.*does not have many workers",
)
SIMPLE = ["logistic_regression", "logistic_regression_simple", "random_forest_simple"]
NAMES = ["best_pooled_number", *SIMPLE]


def bins_of(num, seed=0):
    """Noise on an offset, ``[N, 4, 100]``, of which slip is twice as loud; every level occurs."""
    rng = np.random.default_rng(seed)
    is_slip = np.arange(num) % 2 == 0
    level = np.where(is_slip, 2.0, 1.0) * rng.uniform(0.9, 1.1, num)
    bins = level[:, None, None] * rng.standard_normal((num, 4, 100))
    bins[:, :2] += 3.0
    return torch.from_numpy(bins), torch.from_numpy(is_slip)


def sampled(num=160):
    pool, sample = FeaturePool(HAND), BinSample(400)
    for seed, group in enumerate("ab"):
        bins, is_slip = bins_of(num, seed)
        sample.update(RecordingBins(f"{group}/0", group, pool(bins).float(), is_slip))
    return pool, sample.bins()


def test_the_pooled_number_is_the_best_of_all_means_and_deviations():
    pool, sample = sampled()
    number = _PooledNumber(pool, sample)
    assert number.name.statistic in ("mean", "std")
    rng = np.random.default_rng(0)
    features = torch.from_numpy(rng.standard_normal(sample.features.shape)).float().abs()
    place = {str(name): index for index, name in enumerate(pool.names)}
    for channel in ("PVDF1", "PVDF2"):
        features[:, place[f"{channel} A3 time iqr"]] += 5.0 * ~sample.is_slip
    found = _PooledNumber(pool, replace(sample, features=features))
    assert str(found.name) == "PVDF A3 time iqr [mean]"
    assert found.metadata["sign"] == -1
    assert torch.equal(found(features), sample.is_slip)


def test_one_class_is_refused():
    pool, sample = sampled(40)
    only = replace(sample, is_slip=torch.ones_like(sample.is_slip))
    with pytest.raises(ValueError, match="both classes; got only one"):
        Baselines(pool, sample.features[:, :5], only)


# ------------------------------------------------------------------------------ one threshold


def best_of_all(features, is_slip):
    """Every feature, every cut between two of its values or outside them, both directions."""
    scores = [0.5]
    for column in features.T:
        values = np.unique(column)
        for cut, sign in itertools.product((values[1:] + values[:-1]) / 2, (1, -1)):
            scores.append(balanced_accuracy_score(is_slip, sign * column > sign * cut))
    return max(scores)


@pytest.mark.parametrize("num_levels", [3, 1000])
@pytest.mark.parametrize("share", [0.5, 0.15])
def test_no_cut_is_better(num_levels, share, rng):
    """Few levels make ties: a cut between equal values is none."""
    for _ in range(3):
        features = rng.integers(0, num_levels, (17, 4)).astype(float)
        is_slip = rng.uniform(size=17) < share
        is_slip[:2] = True, False
        weights = torch.ones(17, dtype=torch.float64)
        given = torch.from_numpy(features), torch.from_numpy(is_slip), weights
        index, threshold, sign = _best_threshold(*given)
        found = balanced_accuracy_score(is_slip, sign * features[:, index] > sign * threshold)
        assert found == pytest.approx(best_of_all(features, is_slip), abs=1e-12)


def test_a_learner_evaluates_them_on_the_same_bins():
    source = SmallSet()
    metrics = learn(source, unseen_c(source), with_baselines=True).metrics
    assert list(metrics["baselines"]) == NAMES
    for found in metrics["baselines"].values():
        assert list(found["splits"]) == list(metrics["splits"])
        for role, scores in found["splits"].items():
            assert scores["num_bins"] == metrics["splits"][role]["num_bins"]
        assert found["splits"]["train"]["balanced_accuracy"] > 0.75
    for role in ("test", "unseen"):
        beside = metrics["comparison"][role]
        assert beside["detector"] == metrics["splits"][role]["balanced_accuracy"]
        assert {n: of["balanced_accuracy"] for n, of in beside["baselines"].items()} == {
            n: of["splits"][role]["balanced_accuracy"] for n, of in metrics["baselines"].items()
        }
    json.dumps(metrics["baselines"])


# Beside the detector -----------------------------------------------------------------------------


def outcomes_of_objects(wrong, num_objects=8, trials=5):
    """Confusions of recordings of 20 bins; ``wrong``: how many of a class, by method and object."""
    ids = [RecordingId(f"object {i}", trial) for i in range(num_objects) for trial in range(trials)]
    confusions = {
        name: torch.tensor(
            [[[10 - of(r), of(r)], [of(r), 10 - of(r)]] for r in range(num_objects)]
        ).repeat_interleave(trials, 0)
        for name, of in wrong.items()
    }
    return Outcomes(tuple(ids), confusions)


def test_a_baseline_that_is_better_on_one_object_alone_is_not_ahead_where_objects_are_left_out():
    wrong = {"detector": lambda r: 6 * (r == 0), "one": lambda r: 0}
    outcomes = outcomes_of_objects(wrong)
    by_object, by_recording = (compared([outcomes], role) for role in ("unseen", "test"))
    assert (by_object["drawn"], by_object["num_drawn"]) == ("material", 8)
    assert (by_recording["drawn"], by_recording["num_drawn"]) == ("recording", 40)
    number = by_object["baselines"]["one"]["difference"]
    assert number["value"] == pytest.approx(0.6 / 8)
    assert number["low"] == 0 < number["high"]
    assert by_recording["baselines"]["one"]["difference"]["low"] > 0
    assert compared([outcomes_of_objects(wrong, num_objects=4)], "unseen")["drawn"] == "recording"


def test_the_difference_from_the_detector_is_paired_and_of_all_folds():
    """Where both fail in the same recordings the interval is narrow, however these differ."""
    wrong = {"detector": lambda r: r, "same": lambda r: r, "better": lambda r: max(r - 1, 0)}
    outcomes = outcomes_of_objects(wrong)
    cut = 15
    folds = [
        Outcomes(outcomes.recordings[part], {n: c[part] for n, c in outcomes.confusions.items()})
        for part in (slice(cut), slice(cut, None))
    ]
    found = compared(folds, "unseen")
    assert found == compared([outcomes], "unseen")
    assert found["detector"] == pytest.approx(1 - 0.35)
    assert found["baselines"]["same"]["difference"] == {"value": 0, "low": 0, "high": 0}
    better = found["baselines"]["better"]["difference"]
    assert 0.02 < better["low"] <= better["value"] <= better["high"] <= 0.1 + 1e-12
    slip_alone = {n: c * torch.tensor([[0], [1]]) for n, c in outcomes.confusions.items()}
    assert compared([Outcomes(outcomes.recordings, slip_alone)], "test") == {}
