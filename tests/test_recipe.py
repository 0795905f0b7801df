"""Recipes: what is chosen and fitted, and that nothing of a left-out group is learned."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import ttest_ind
from small_set import SMALL_HAND, refitted_scores

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import calibration_from_dict, fit_platt
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.training import recipe as recipes
from tactslip_torch.training.bins import BinSample, RecordingBins
from tactslip_torch.training.choice import CandidateBins, balanced_accuracy, group_scores
from tactslip_torch.training.recipe import FREE_CONSTANT, General, Paper

WHOLE_POOL = FeaturePool(SMALL_HAND)
POOL = WHOLE_POOL.paper()
FAST_POOL = FeaturePool(
    HandLayout.from_rows(
        {"name": f"f{i}", "kind": "fast", "finger": f"f{i}", "segment": "tip", "adapting": "fast"}
        for i in range(4)
    ),
    level=1,
)
FEW = {"num_features": 4, "penalties": (0.1, 3.0)}


def random_bins(rng, materials="abc", cycles=2, num=40, share=0.5, effect=2.0):
    """Recordings of random features, of which every fifth tells the classes apart."""
    found = []
    apart = torch.zeros(len(POOL.names))
    apart[::5] = torch.linspace(0.1, 1.0, len(apart[::5])) * effect
    for material in materials:
        for cycle in range(cycles):
            is_slip = torch.from_numpy(rng.permutation(num) < share * num)
            features = 10 + torch.from_numpy(rng.standard_normal((num, len(POOL.names))))
            features = (features + apart * is_slip[:, None]).float()
            found.append(RecordingBins(f"{material}/{cycle}", material, features, is_slip))
    return found


def together(bins):
    return torch.cat([of.features for of in bins]), torch.cat([of.is_slip for of in bins])


def accuracy(fit, bins):
    features, is_slip = together(bins)
    return balanced_accuracy(fit.head(fit.selection(features)) >= 0, is_slip)


# The paper's recipe ------------------------------------------------------------------------------


def test_the_paper_ranks_by_the_t_statistic_and_scales_to_the_range_of_all_bins(rng):
    bins = random_bins(rng)
    features, is_slip = together(bins)
    scores = np.abs(ttest_ind(features[is_slip], features[~is_slip]).statistic)
    fit = Paper(num_features=4, sample_bins=2).fit(bins, POOL)  # far fewer than there are
    assert list(fit.selection.selected) == np.argsort(-scores)[:4].tolist()
    scaled = fit.selection(features)
    assert scaled.amax(0).tolist() == [1] * 4
    assert scaled.amin(0).tolist() == [-1] * 4


def test_the_papers_penalty_and_calibration_are_those_of_refits_without_the_group(rng):
    bins = random_bins(rng)
    fit = Paper(**FEW).fit(bins, POOL)
    features, is_slip = together(bins)
    group = torch.tensor([ord(of.group) for of in bins for _ in of.is_slip])
    counts = torch.bincount(is_slip.long()).double()
    weights = (counts.min() / counts)[is_slip.long()]
    training = TrainingBins(fit.selection(features), is_slip, weights)
    for row in fit.validation:
        scores = refitted_scores(training, group, row["penalty"])
        for name, found in row["balanced_accuracy"].items():
            mine = group == ord(name)
            assert found == balanced_accuracy(scores[mine] >= 0, is_slip[mine])
    best = max(fit.validation, key=lambda row: row["mean"])
    assert (fit.penalty, fit.calibration) == (best["penalty"], best["calibration"])
    scores = refitted_scores(training, group, fit.penalty)
    expected = vars(fit_platt(scores, is_slip, weights))
    assert vars(calibration_from_dict(best["calibration"])) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("num", [10, 60], ids=["bins kept", "sums"])
def test_classes_are_undersampled_and_neither_order_nor_sums_change_the_machine(num, rng):
    recipe = Paper(num_features=12, penalties=0.1)  # 91 monomials
    bins = random_bins(rng, num=num, share=0.7)
    fit, turned = recipe.fit(bins, POOL), recipe.fit(bins[::-1], POOL)
    _, is_slip = together(bins)
    assert fit.num_bins == 2 * min(int(is_slip.sum()), int((~is_slip).sum()))
    heads = [each.head.state_dict() for each in (fit, turned)]
    torch.testing.assert_close(heads[0], heads[1], rtol=1e-9, atol=1e-11)


def test_more_features_than_match_are_cut_and_reported(rng, caplog):
    recipe = Paper(feature_filter={"kind": "SG"}, penalties=0.1)
    fit = recipe.fit(random_bins(rng), POOL)
    assert {POOL.names[index].channel for index in fit.selection.selected} == {"SG1"}
    assert fit.selection.size == 13
    assert "cut to 13" in caplog.text
    with pytest.raises(ValueError, match=r"num_features=9999 exceeds"):
        Paper(num_features=9999).allowed(POOL)


FILTERS = [
    ({"kind": "SG"}, lambda name: name.channel.startswith("SG")),
    ({"kind": "SG", "descriptor": "mean"}, lambda name: str(name).endswith("raw time mean")),
    ({"channel": ["SG1", "PVDF1"], "domain": "freq"}, lambda name: name.domain == "freq"),
    ({"component": "D1", "domain": "time"}, lambda name: " D1 time " in str(name)),
]


@pytest.mark.parametrize(
    ("wanted", "matches"), FILTERS, ids=[" ".join(wanted) for wanted, _ in FILTERS]
)
def test_a_filter_lets_pass_what_has_every_attribute_asked_for(wanted, matches):
    allowed = Paper(feature_filter=wanted).allowed(POOL)
    assert allowed.tolist() == [matches(name) for name in POOL.names]


@pytest.mark.parametrize("recipe", [Paper(num_features=1), General(), General(descriptors=None)])
def test_features_that_the_paper_lacks_are_not_selected(recipe):
    allowed = recipe.allowed(WHOLE_POOL)
    assert allowed[WHOLE_POOL.is_paper].any()
    assert not allowed[~WHOLE_POOL.is_paper].any()


# Both --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recipe", [Paper(**FEW), General(**FEW, use="channel", degree=2)])
def test_a_fit_is_refused_without_both_classes_and_unvalidated_with_one_group(recipe, rng, caplog):
    bins = random_bins(rng)
    with pytest.raises(ValueError, match="no non-slip bin"):
        recipe.fit([replace(of, is_slip=of.is_slip | True) for of in bins], POOL)
    apart = [replace(of, is_slip=of.is_slip & False | (of.group in "ab")) for of in bins]
    if isinstance(recipe, Paper):
        with pytest.raises(ValueError, match="without group"):
            recipe.fit(apart, POOL)
    else:
        assert recipe.fit(apart, POOL).validation == []
        assert "needs two groups with slip and non-slip, got 0 of" in caplog.text
    fit = recipe.fit([replace(of, group="a") for of in bins], POOL)
    assert (fit.penalty, fit.validation, fit.calibration) == (3.0, [], None)
    assert re.search("unvalidated|got 1 of a", caplog.text)


@pytest.mark.parametrize("recipe", [Paper(**FEW), General(**FEW, use="channel", degree=1)])
def test_lost_columns_get_the_mean_of_the_two_class_means(recipe, rng):
    bins = random_bins(rng, share=0.2)
    fit = recipe.fit(bins, POOL)
    features, is_slip = together(bins)
    z = fit.selection(features)
    expected = (z[is_slip].mean(0) + z[~is_slip].mean(0)) / 2
    torch.testing.assert_close(fit.imputation, expected)


BAD = [
    (Paper, {"penalties": ()}, r"recipe.penalties must be positive, got \[\]"),
    (Paper, {"penalties": (0.1, float("inf"))}, "validation needs finite values"),
    (Paper, {"penalties": ("0.1",)}, r"recipe.penalties must be a number, got '0.1'"),
    (Paper, {"num_features": 1.5}, "recipe.num_features"),
    (Paper, {"offset": -1.0}, "offset"),
    (Paper, {"sample_bins": 1}, "recipe.sample_bins"),
    (Paper, {"degree": 3}, "degree of the kernel must be 1 or 2, got 3"),
    (Paper, {"feature_filter": {"kinds": "SG"}}, "recipe.feature_filter: unknown 'kinds'"),
    (Paper, {"feature_filter": "SG"}, r"recipe.feature_filter must be like .*, got 'SG'"),
    (General, {"use": "all"}, r"recipe.use must be one of .*, got 'all'"),
    (General, {"pooling": None}, "needs statistics over channels"),
    (General, {"tolerance": 1.0}, r"recipe.tolerance must lie in \[0, 1\), got 1.0"),
    (General, {"num_features": 0}, "recipe.num_features"),
    (General, {"degree": 0}, "degree of the kernel must be 1 or 2, got 0"),
    (General, {"scene_weights": {"taps": 0.0}}, "recipe.scene_weights"),
    (General, {"min_alive": 0}, "recipe.min_alive"),
]


@pytest.mark.parametrize(("recipe", "change", "message"), BAD, ids=str)
def test_bad_recipes_are_refused(recipe, change, message):
    with pytest.raises(ValueError, match=message):
        recipe(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"descriptors": ["meen"]}, "recipe.descriptors: unknown 'meen'"),
        ({"feature_filter": {"descriptor": "meen"}}, "no feature has descriptor='meen'"),
        ({"feature_filter": {"kind": "SG", "domain": "freq"}}, "kind=SG, domain=freq together"),
    ],
)
def test_what_no_feature_has_is_refused_before_any_work(change, message):
    for recipe in (Paper(**change), General(**change)):
        with pytest.raises(ValueError, match=message):
            recipe.allowed(POOL)


# The general recipe ------------------------------------------------------------------------------


def moving_slip(rng, groups=("M1", "M2", "M3", "M4"), num=30):
    """Slip is a louder channel, another one in each group, and groups differ in gain."""
    bins = []
    for index, group in enumerate(groups):
        x = rng.standard_normal((2 * num, 4, 100)) * 10 ** rng.uniform(-0.3, 0.3, (2 * num, 1, 1))
        is_slip = np.arange(2 * num) % 2 == 0
        x[is_slip, index % 4] *= 30
        features = FAST_POOL(torch.from_numpy(x * 2.0**index)).float()
        bins.append(RecordingBins(f"{group}/0", group, features, torch.from_numpy(is_slip)))
    return bins


ALL = General(pooling=["mean", "std"], num_features=[None, 10], penalties=[0.001, 0.1])


@pytest.fixture(scope="module")
def moved():
    bins = moving_slip(np.random.default_rng(0))
    return bins, ALL.fit(bins, FAST_POOL)


def test_pooled_features_win_where_another_channel_slips_in_each_group(moved):
    bins, fit = moved
    (row,) = (row for row in fit.validation if row.get("chosen"))
    assert row["use"] == "pooled"
    assert row["mean"] >= max(row["mean"] for row in fit.validation) - ALL.tolerance
    of_channels = max(row["mean"] for row in fit.validation if row["use"] == "channel")
    assert of_channels < row["mean"] - 0.05
    assert fit.nested["mean"] > 0.95
    assert set(row["balanced_accuracy"]) == {of.group for of in bins}


def test_of_ties_the_simplest_with_the_strongest_penalty_is_taken(moved):
    fit = replace(ALL, tolerance=0.99).fit(moved[0], FAST_POOL)
    assert (fit.kernel.degree, fit.kernel.offset) == (1, FREE_CONSTANT)
    assert all(name.is_pooled for name in fit.selection.pooling.names)
    assert fit.penalty == min(row["penalty"] for row in fit.validation)


def test_a_grid_that_ends_at_its_edge_is_extended_and_logged(moved, caplog):
    few = replace(ALL, use="pooled", num_features=None, degree=1, tolerance=0.2)
    with caplog.at_level("INFO"):
        fit = few.fit(moved[0], FAST_POOL)
    assert "extended by 0.0001" in caplog.text
    assert min(row["penalty"] for row in fit.validation) < 0.001


@pytest.mark.parametrize(("degree", "wanted"), [([1, 2], {1}), (2, {2})])
def test_of_many_bins_degree_2_is_no_candidate_unless_it_is_the_only_one(
    moved, monkeypatch, degree, wanted
):
    for name in ("MOST_DUAL_BINS", "MOST_SQUARE_BINS"):
        monkeypatch.setattr(recipes, name, 10)
    recipe = replace(ALL, degree=degree, num_features=10, penalties=0.1)
    rows = recipe.fit(moved[0], FAST_POOL, is_nested=False).validation
    assert {row["kernel"]["degree"] for row in rows} == wanted


SINGLE = [
    {"use": "channel", "num_features": None, "degree": 1},
    {"use": "pooled", "num_features": None, "degree": 1},
    {"use": "both", "num_features": 10, "degree": 2},
]


@pytest.mark.parametrize("structure", SINGLE, ids=str)
@pytest.mark.parametrize("louder", [1.0, 1000.0])
def test_compression_scaler_and_pooling_of_a_fold_are_learned_without_the_left_out_group(
    structure, louder, rng
):
    """Its score is that of the machine that is fitted to the other groups alone."""
    bins = moving_slip(rng)
    bins[1] = replace(bins[1], features=louder * bins[1].features)
    recipe = replace(ALL, **structure, penalties=0.1, drop_channels=0.0)
    (row,) = recipe.fit(bins, FAST_POOL, is_nested=False).validation
    for out in bins:
        others = [of for of in bins if of is not out]
        expected = accuracy(recipe.fit(others, FAST_POOL, is_nested=False), [out])
        assert row["balanced_accuracy"][out.group] == pytest.approx(expected, abs=1e-9)


def test_of_many_groups_several_are_left_out_together_and_train_nothing(rng):
    bins = moving_slip(rng, [f"M{number:02}" for number in range(13)])
    recipe = replace(
        ALL, use="pooled", num_features=None, degree=1, penalties=0.1, drop_channels=0.0
    )
    (row,) = recipe.fit(bins, FAST_POOL, is_nested=False).validation
    sample = BinSample(recipe.sample_bins)
    for of in bins:
        sample.update(of)
    whole, joined = sample.bins(), sample.bins().joined()
    assert list(row["balanced_accuracy"]) == list(joined.group_names)
    left_out = []
    for place, name in enumerate(joined.group_names):
        groups = {whole.group_names[group] for group in whole.group[joined.group == place]}
        left_out += groups
        inside, others = ([of for of in bins if (of.group in groups) == is_in] for is_in in (1, 0))
        expected = accuracy(recipe.fit(others, FAST_POOL, is_nested=False), inside)
        assert row["balanced_accuracy"][name] == pytest.approx(expected, abs=1e-9)
    assert sorted(left_out) == sorted({of.group for of in bins})


@pytest.mark.parametrize("seed", [0, 4])  # draws by which the choices differ, and their scores
def test_the_nested_score_of_a_group_is_of_the_choice_made_without_it(seed):
    """Not of the overall choice, which has seen the group."""
    bins = random_bins(np.random.default_rng(seed), "abcde", cycles=1, num=60, effect=0.5)
    recipe = General(
        use="channel", num_features=[1, 2, 4, 8, 16, 32], degree=1, penalties=0.1, tolerance=0.0,
        drop_channels=0.0, pooling=None, descriptors=None,
    )  # fmt: skip
    fit = recipe.fit(bins, POOL)
    (overall,) = (row["balanced_accuracy"] for row in fit.validation if row.get("chosen"))
    for out in bins:
        other = recipe.fit([of for of in bins if of is not out], POOL, is_nested=False)
        found = fit.nested["balanced_accuracy"][out.group]
        assert found == pytest.approx(accuracy(other, [out]), abs=1e-9)
    assert fit.nested["balanced_accuracy"] != overall  # else the overall choice would do as well


def test_one_group_of_both_classes_cannot_be_left_out(rng, caplog):
    bins = moving_slip(rng, ("M1", "M2"))
    bins[1] = replace(bins[1], is_slip=bins[1].is_slip & False)
    assert ALL.fit(bins, FAST_POOL).validation == []
    assert "needs two groups with slip and non-slip, got 1 of M1, M2" in caplog.text


def test_scores_of_features_count_how_effect_and_level_move_between_groups(rng):
    """``|mean effect| / sqrt(variance within + of the effect + of the level)``."""
    level, effect = rng.uniform(0, 9, (3, 5)), rng.uniform(0, 3, (3, 5))
    level[:, 0] = effect[:, 1] = 1.0
    is_slip, groups = np.arange(60) % 2 == 0, np.arange(60) // 20
    x = rng.standard_normal((60, 5)) + level[groups] + effect[groups] * is_slip[:, None]
    slips = np.stack([x[is_slip & (groups == g)].mean(0) for g in range(3)])
    quiets = np.stack([x[~is_slip & (groups == g)].mean(0) for g in range(3)])
    within = [x[(is_slip == s) & (groups == g)].var(0) for s in (0, 1) for g in range(3)]
    moves = (slips - quiets).var(0, ddof=1) + ((slips + quiets) / 2).var(0, ddof=1)
    wanted = np.abs((slips - quiets).mean(0)) / np.sqrt(np.mean(within, 0) + moves)
    found = group_scores(*map(torch.from_numpy, (x, is_slip, groups)))
    np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-9)


def test_thinned_strata_keep_the_weight_of_all_their_bins(rng):
    """One of 300 bins is fitted to 100 of three times the weight; one of 50 keeps all."""
    sample = BinSample(1000)
    for group, num in {"a": 600, "b": 100}.items():
        is_slip = torch.arange(num) % 2 == 0
        features = torch.from_numpy(rng.standard_normal((num, len(POOL.names)))).float()
        sample.update(RecordingBins(group, group, features, is_slip))
    drawn = sample.bins()
    bins = CandidateBins(drawn, drawn.weight, POOL, torch.ones(len(POOL.names)) > 0)
    thinned = bins.thinned()
    for stratum, num_kept in zip(drawn.stratum.unique(), (100, 100, 50, 50), strict=True):
        mine = drawn.stratum == stratum
        kept = mine & thinned.is_kept
        assert int(kept.sum()) == num_kept
        assert float(thinned.weights[kept].sum()) == pytest.approx(float(mine.sum()))
    assert bool(bins.is_kept.all())  # others are as they were


def test_scenes_have_the_weight_that_is_asked_for(rng):
    """Of an arm that moves without slip, half of the protocol's bins of that class."""
    bins = []
    for of in moving_slip(rng, ("M1", "M2")):
        still = replace(of, name=f"{of.name} arm", scene="arm_motion", is_slip=of.is_slip & False)
        bins += [of, still]
    recipe = replace(ALL, scene_weights={"arm_motion": 0.5})
    sample = BinSample(400)
    for of in bins:
        sample.update(of)
    drawn = sample.bins()
    weights = recipe.weights(drawn)
    table = torch.tensor([weights[scene] for scene in drawn.scene_names])
    weight = drawn.weight * table[drawn.scene, drawn.is_slip.long()]
    is_arm, no_slip = drawn.scene == drawn.scene_names.index("arm_motion"), ~drawn.is_slip
    assert float(weight[is_arm].sum() / weight[~is_arm & no_slip].sum()) == pytest.approx(0.5)
    assert float(weight[no_slip].sum()) == pytest.approx(float(weight[~no_slip].sum()))
    with pytest.raises(ValueError, match="names 'taps', of which there is no"):
        replace(ALL, scene_weights={"taps": 1.0}).fit(bins, FAST_POOL)


def test_scenes_and_classes_weigh_in_the_solve_as_in_the_choice(rng):
    """The machine is that of all bins, each with its weight."""
    bins = moving_slip(rng, ("M1", "M2"))
    bins += [replace(of, name=f"{of.name} arm", scene="arm_motion") for of in bins]
    recipe = replace(
        ALL, use="pooled", num_features=None, degree=1, penalties=0.1, drop_channels=0.0,
        scene_weights={"arm_motion": 0.25},
    )  # fmt: skip
    fit = recipe.fit(bins, FAST_POOL)
    features, is_slip = together(bins)
    is_arm = torch.tensor([of.scene == "arm_motion" for of in bins for _ in of.is_slip])
    z, weights = fit.selection(features), torch.where(is_arm, 0.25, 1.0).double()
    expected = fit_machine(TrainingBins(z, is_slip, weights), 0.1, fit.kernel)(z)
    torch.testing.assert_close(fit.head(z), expected, rtol=1e-6, atol=1e-8)


def test_second_copies_lack_up_to_a_part_of_the_channels(rng):
    """They make another machine, and set how many channels must be alive."""
    bins = moving_slip(rng)
    single = replace(ALL, use="pooled", num_features=None, degree=1, penalties=0.1)
    with_copies = single.fit(bins, FAST_POOL)
    without = replace(single, drop_channels=0.0).fit(bins, FAST_POOL)
    assert not torch.equal(with_copies.head.linear, without.head.linear)
    alive = [fit.sensing.min_alive for fit in (with_copies, without)]
    assert alive == [2, 2]
    assert replace(single, drop_channels=0.25).fit(bins, FAST_POOL).sensing.min_alive == 3
    assert replace(single, min_alive=4).fit(bins, FAST_POOL).sensing.min_alive == 4
