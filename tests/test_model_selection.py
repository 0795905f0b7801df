"""The nested choice of features, degree and penalty on groups that are left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.training.plan import candidates, choose_model, fitted_selection, group_scores
from tactslip_torch.training.recipe import FREE_CONSTANT, Recipe, sample_weight, scene_weights

HAND = HandLayout.from_rows(
    {"name": f"PVDF{i}", "kind": "PVDF", "finger": f"f{i}", "segment": "distal"} for i in range(4)
)
POOL = FeaturePool(HAND, level=1)
GROUPS = ("M1", "M2", "M3", "M4")


def recipe(**changes):
    base = {
        "validation": "nested",
        "use": ["channel", "pooled", "both"],
        "pooling": ["mean", "std"],
        "num_features": [None, 10],
        "degree": [1, 2],
        "ranking": "gd",
        "compress": True,
        "tail": 0.01,
        "balance": "weights",
        "tolerance": 0.005,
        "penalties": [0.001, 0.1],
    }
    return Recipe(**base | changes)


def sample_of(rng, groups=GROUPS, per=30):
    """Slip is a louder channel, another one in each group: only pooling carries it over."""
    bins, is_slip, group = [], [], []
    for index in range(len(groups)):
        for slip in (False, True):
            x = rng.standard_normal((per, 4, 100)) * 10 ** rng.uniform(-0.3, 0.3, (per, 1, 1))
            if slip:
                x[:, index % 4] *= 30
            bins.append(x)
            is_slip += [slip] * per
            group += [index] * per
    features = POOL(torch.from_numpy(np.concatenate(bins))).float()
    num = len(is_slip)
    return SampledBins(
        features,
        torch.tensor(is_slip),
        torch.tensor(group),
        tuple(groups),
        torch.arange(num) // 5,
        tuple(f"r{i}" for i in range(num // 5)),
        torch.arange(num),
        torch.full((num,), 2.0, dtype=torch.float64),
    )


def chosen(sample, how):
    return choose_model(how, POOL, sample)


@pytest.fixture(scope="module")
def drawn():
    sample = sample_of(np.random.default_rng(0))
    return sample, chosen(sample, recipe())


def test_pooled_features_win_where_another_channel_slips_in_each_group(drawn):
    _, choice = drawn
    assert choice.structure.use == "pooled"
    assert choice.nested["mean"] > 0.95
    best = max(row["mean"] for row in choice.rows)
    of_channels = max(row["mean"] for row in choice.rows if row["use"] == "channel")
    assert of_channels < best - 0.05
    row = next(row for row in choice.rows if row.get("chosen"))
    assert row["mean"] >= best - 0.005
    assert set(row["balanced_accuracy"]) == set(GROUPS)
    assert row["worst"]["at_best_threshold"] >= row["worst"]["balanced_accuracy"]


def test_of_ties_the_simplest_with_the_strongest_penalty_is_taken(drawn):
    everything = chosen(drawn[0], recipe(tolerance=0.99))
    assert everything.structure == ("pooled", None, Polynomial(1, FREE_CONSTANT))
    assert everything.penalty == min(row["penalty"] for row in everything.rows)


def test_a_grid_that_ends_at_its_edge_is_extended_and_says_so(drawn):
    few = recipe(use="pooled", num_features=None, degree=1, tolerance=0.2)
    choice = chosen(drawn[0], few)
    assert "ended at its edge and was extended by 0.0001" in choice.edge
    assert min(row["penalty"] for row in choice.rows) < 0.001


def test_what_is_done_to_a_group_does_not_reach_machines_without_it(drawn):
    """Features and labels of a group change: its nested score alone does."""
    sample, before = drawn
    mine = sample.group == 2
    flipped = torch.where(mine, ~sample.is_slip, sample.is_slip)
    after = chosen(replace(sample, is_slip=flipped), recipe())
    accuracy = before.nested["balanced_accuracy"]["M3"]
    # the others' labels are as they were, so the machine is the same and every answer turns
    assert after.nested["balanced_accuracy"]["M3"] == pytest.approx(1 - accuracy)
    spoilt = sample.features.clone()
    spoilt[mine] = 1e6 * torch.rand(spoilt[mine].shape)
    single = recipe(use="both", num_features=10, degree=2, penalties=0.1)
    rows = [chosen(replace(sample, features=x), single).rows[0] for x in (sample.features, spoilt)]
    assert rows[0]["balanced_accuracy"]["M3"] != rows[1]["balanced_accuracy"]["M3"]


def test_the_selection_of_a_choice_scales_what_it_names(drawn):
    sample = drawn[0]
    for structure in candidates(recipe(), 480):
        found = fitted_selection(recipe(), POOL, sample, structure)
        z = found(sample.features)
        assert z.shape == (len(sample.features), found.size)
        assert z.abs().max() <= 1
        assert found.size == (structure.num_features or found.size)
        assert (found.pooling is None) == (structure.use == "channel")


def test_group_scores_prefer_what_holds_in_every_group(rng):
    is_slip = torch.tensor([False, True] * 60)
    groups = torch.arange(120) // 30
    noise = torch.from_numpy(0.1 * rng.standard_normal((120, 3)))
    steady = is_slip.double()
    level = steady + 3.0 * groups  # its threshold moves from group to group
    turning = torch.where(groups % 2 == 0, steady, -steady)
    scores = group_scores(torch.stack([steady, level, turning], 1) + noise, is_slip, groups)
    assert scores[0] > 5 * scores[1] > 0
    assert scores[0] > 5 * scores[2]


def test_scenes_have_the_weight_that_is_asked_for(rng):
    names = ("M1|arm_motion", "M1|paper", "M2|arm_motion", "M2|paper")
    sample = sample_of(rng, names)
    is_quiet = ~(sample.is_slip & torch.isin(sample.group, torch.tensor([0, 2])))
    per_bin = ("features", "is_slip", "group", "recording", "bin_index", "sample_weight")
    kept = {name: getattr(sample, name)[is_quiet] for name in per_bin}
    quiet_arm = replace(sample, **kept)  # an arm that moves without slip
    how = recipe(scene_weights={"arm_motion": 0.5})
    weights = sample_weight(how, quiet_arm)
    is_arm = torch.isin(quiet_arm.group, torch.tensor([0, 2]))
    no_slip = ~quiet_arm.is_slip
    assert float(weights[is_arm].sum() / weights[~is_arm & no_slip].sum()) == pytest.approx(0.5)
    assert float(weights[no_slip].sum()) == pytest.approx(float(weights[~no_slip].sum()))
    assert set(scene_weights(how, quiet_arm)) == {"arm_motion", "paper"}
    with pytest.raises(ValueError, match="scene_weights names 'taps', of which there is no"):
        sample_weight(recipe(scene_weights={"taps": 1.0}), quiet_arm)


def test_one_group_cannot_be_left_out(rng):
    with pytest.raises(ValueError, match="needs two with bins of both classes, got 1"):
        chosen(sample_of(rng, ("M1",)), recipe())
