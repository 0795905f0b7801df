"""The nested choice of features, degree and penalty on groups that are left out."""

import numpy as np
import pytest
import torch

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.training import selection
from tactslip_torch.training.recipe import FREE_CONSTANT, Recipe, scene_weights, stand_for
from tactslip_torch.training.selection import candidates, choose_model, fitted_frame, group_scores

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


def chosen(sample, how, **options):
    counts = [2.0 * float((~sample.is_slip).sum()), 2.0 * float(sample.is_slip.sum())]
    weights = stand_for(sample, how, counts)
    options = {"num_bins": 480} | options
    return choose_model(how, POOL, sample, weights, lambda items, what: items, **options)


def test_pooled_features_win_where_another_channel_slips_in_each_group(rng):
    choice = chosen(sample_of(rng), recipe())
    assert choice.structure.use == "pooled"
    assert choice.nested is not None
    assert choice.nested["mean"] > 0.95
    best = max(row["mean"] for row in choice.rows)
    of_channels = max(row["mean"] for row in choice.rows if row["use"] == "channel")
    assert of_channels < best - 0.05
    row = next(row for row in choice.rows if row.get("chosen"))
    assert row["mean"] >= best - 0.005
    assert set(row["balanced_accuracy"]) == set(GROUPS)
    assert row["worst"]["at_best_threshold"] >= row["worst"]["balanced_accuracy"]


def test_of_ties_the_simplest_with_the_strongest_penalty_is_taken(rng):
    everything = chosen(sample_of(rng), recipe(tolerance=0.99))
    assert everything.structure.num_features is None
    assert everything.structure.kernel.degree == 1
    assert everything.structure.use == "pooled"
    assert everything.penalty == min(row["penalty"] for row in everything.rows)


def test_a_grid_that_ends_at_its_edge_is_extended_and_says_so(rng):
    choice = chosen(
        sample_of(rng), recipe(use="pooled", num_features=None, degree=1, tolerance=0.2)
    )
    assert "ended at its edge and was extended by 0.0001" in choice.edge
    assert min(row["penalty"] for row in choice.rows) < 0.001


def test_the_left_out_group_teaches_nothing(rng):
    """Whatever is done to a group, what others are predicted without it stays."""
    sample = sample_of(rng)
    how = recipe()
    structures = candidates(how, 480)

    def scores(features):
        data = selection._Data(
            how,
            POOL,
            sample._replace(features=features)
            if hasattr(sample, "_replace")
            else SampledBins(
                features,
                *[
                    getattr(sample, name)
                    for name in (
                        "is_slip",
                        "group",
                        "group_names",
                        "recording",
                        "recording_names",
                        "bin_index",
                        "represents",
                    )
                ],
            ),
            torch.ones(len(features), dtype=torch.float64),
            sample.group,
            None,
        )
        fold = selection._Fold(data, frozenset([0, 1]), structures).at([0.01])
        return fold.scores[0]

    spoilt = sample.features.clone()
    spoilt[sample.group == 1] = 1e6 * torch.rand(spoilt[sample.group == 1].shape)
    for key, one in scores(sample.features).items():
        torch.testing.assert_close(scores(spoilt)[key], one, rtol=0, atol=0)


def test_nested_accuracy_of_a_group_does_not_hang_on_its_labels_in_the_choice(rng):
    """The choice that is evaluated on a group is made without its labels."""
    sample = sample_of(rng)
    before = chosen(sample, recipe())
    flipped = sample.is_slip.clone()
    flipped[sample.group == 2] = ~flipped[sample.group == 2]
    fields = {name: getattr(sample, name) for name in SampledBins.__dataclass_fields__}
    after = chosen(SampledBins(**fields | {"is_slip": flipped}), recipe())
    assert before.nested is not None
    assert after.nested is not None
    accuracy = before.nested["balanced_accuracy"]["M3"]
    # the others' labels are as they were, so the machine is the same and every answer turns
    assert after.nested["balanced_accuracy"]["M3"] == pytest.approx(1 - accuracy)


def test_the_frame_of_a_choice_scales_what_it_names(rng):
    sample = sample_of(rng)
    for structure in candidates(recipe(), 480):
        frame = fitted_frame(recipe(), POOL, sample, structure)
        z = frame(sample.features)
        assert z.shape == (len(sample.features), frame.size)
        assert z.abs().max() <= 1
        if structure.num_features is not None:
            assert frame.size == structure.num_features
        assert (frame.pooling is None) == (structure.use == "channel")


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


def test_degree_two_on_all_features_needs_few_bins():
    few, many = (candidates(recipe(), num) for num in (1000, 10_000))
    whole = [s for s in few if s.num_features is None and s.kernel.degree == 2]
    assert whole
    assert not [s for s in many if s.num_features is None and s.kernel.degree == 2]


def test_scenes_have_the_weight_that_is_asked_for(rng):
    names = ("M1|arm_motion", "M1|paper", "M2|arm_motion", "M2|paper")
    sample = sample_of(rng, names)
    fields = {name: getattr(sample, name) for name in SampledBins.__dataclass_fields__}
    is_quiet = ~(sample.is_slip & torch.isin(sample.group, torch.tensor([0, 2])))
    kept = {
        name: value[is_quiet] if isinstance(value, torch.Tensor) else value
        for name, value in fields.items()
    }
    quiet_arm = SampledBins(**kept)  # an arm that moves without slip
    how = recipe(scene_weights={"arm_motion": 0.5})
    weights = stand_for(quiet_arm, how, [1.0, 1.0])
    is_arm = torch.isin(quiet_arm.group, torch.tensor([0, 2]))
    no_slip = ~quiet_arm.is_slip
    assert float(weights[is_arm].sum() / weights[~is_arm & no_slip].sum()) == pytest.approx(0.5)
    assert float(weights[no_slip].sum()) == pytest.approx(float(weights[~no_slip].sum()))
    assert set(scene_weights(how, quiet_arm)) == {"arm_motion", "paper"}
    with pytest.raises(ValueError, match="scene_weights names 'taps', of which there is no"):
        stand_for(quiet_arm, recipe(scene_weights={"taps": 1.0}), [1.0, 1.0])


def test_one_group_cannot_be_left_out(rng):
    with pytest.raises(ValueError, match="needs two with bins of both classes, got 1"):
        chosen(sample_of(rng, ("M1",)), recipe())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"use": "fingers"}, "recipe.use must be some of channel, pooled, both"),
        ({"use": "pooled", "pooling": None}, "needs statistics over channels"),
        ({"validation": "held"}, "needs recipe.validation=nested"),
        ({"kernel": "rbf", "gamma": 0.1}, "nested needs recipe.kernel=polynomial"),
        ({"degree": 3}, "of degree 1 or 2"),
        ({"tolerance": 1.0}, "recipe.tolerance"),
        ({"scene_weights": {"taps": 0.0}}, "recipe.scene_weights.taps must be positive"),
        ({"drop_channels": 1.0}, "recipe.drop_channels"),
    ],
)
def test_recipes_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        recipe(**changes)


def test_kernels_come_by_degree():
    # at degree 1 the offset weighs the constant alone, which is not penalised
    assert recipe(offsets=[0.5, 1.0]).kernels == (
        Polynomial(1, FREE_CONSTANT),
        Polynomial(2, 0.5),
        Polynomial(2, 1.0),
    )
