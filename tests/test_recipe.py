"""Recipes: what is chosen and fitted, and that nothing of a left-out group is learned."""

import re
from dataclasses import replace

import numpy as np
import oracles
import pytest
import torch
from scipy.stats import ttest_ind
from small_set import SMALL_HAND, refitted_scores
from test_views import POOL as FAST_POOL

from tactslip_torch.features.pool import FeaturePool, is_simple_of
from tactslip_torch.model.calibration import calibration_from_dict, fit_platt
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.report.metrics import balanced_accuracy
from tactslip_torch.training.bins import BinSample, RecordingBins
from tactslip_torch.training.columns import VIEWS
from tactslip_torch.training.recipe import General, Paper
from tactslip_torch.training.views import ViewBins

WHOLE_POOL = FeaturePool(SMALL_HAND)
POOL = WHOLE_POOL.paper()
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


def test_each_view_may_use_its_own_features_and_training_reads_them_all():
    """Without the simple view and baselines none but the paper's are read; ranges always are."""
    recipe = General(feature_filter={"kind": "SG"})
    masks = recipe.allowed_by_view(WHOLE_POOL)
    assert list(masks) == list(VIEWS)
    for view, mask in masks.items():
        names = [name for name, is_in in zip(WHOLE_POOL.names, mask, strict=True) if is_in]
        assert {name.channel for name in names} == {"SG1"}
        assert all(name.is_simple for name in names) == (view == "simple")
    for views, with_baselines in ((VIEWS, False), ("pooled", True)):
        wanted = General(views=views).wanted(WHOLE_POOL, with_baselines)
        assert wanted[is_simple_of(WHOLE_POOL)].all()
    few = General(views="pooled", descriptors=["std"])
    wanted = few.wanted(WHOLE_POOL, with_baselines=False)
    names = [name for name, is_in in zip(WHOLE_POOL.names, wanted, strict=True) if is_in]
    assert {name.descriptor for name in names} == {"std", "range"}
    assert WHOLE_POOL.is_paper[wanted].all()
    only_spectra = General(feature_filter={"domain": "freq"})
    with pytest.raises(ValueError, match=r"the view 'simple' of recipe.views has no feature"):
        only_spectra.allowed_by_view(WHOLE_POOL)


# Both --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recipe", [Paper(**FEW), General(**FEW, views="channel")])
def test_a_fit_is_refused_without_both_classes_and_unvalidated_with_one_group(recipe, rng, caplog):
    bins = random_bins(rng)
    with pytest.raises(ValueError, match="no non-slip bin"):
        recipe.fit([replace(of, is_slip=of.is_slip | True) for of in bins], POOL)
    apart = [replace(of, is_slip=of.is_slip & False | (of.group in "ab")) for of in bins]
    if isinstance(recipe, Paper):
        with pytest.raises(ValueError, match="without group"):
            recipe.fit(apart, POOL)
    else:
        unvalidated = recipe.fit(apart, POOL)
        assert (unvalidated.validation, unvalidated.metadata["validated"]) == ([], None)
        assert "needs two groups with every class, got 3 of a, b, c" in caplog.text
    fit = recipe.fit([replace(of, group="a") for of in bins], POOL)
    assert (fit.penalty, fit.validation, fit.calibration) == (3.0, [], None)
    assert re.search("unvalidated|got 1 of a", caplog.text)


def test_lost_columns_get_the_mean_of_the_two_class_means(rng):
    bins = random_bins(rng, share=0.2)
    fit = Paper(**FEW).fit(bins, POOL)
    features, is_slip = together(bins)
    z = fit.selection(features)
    expected = (z[is_slip].mean(0) + z[~is_slip].mean(0)) / 2
    torch.testing.assert_close(fit.imputation, expected)


BAD = [
    (Paper, {"penalties": ()}, r"recipe.penalties must be positive, got \[\]"),
    (Paper, {"penalties": (0.1, float("inf"))}, "validation needs finite values"),
    (Paper, {"penalties": ("0.1",)}, r"recipe.penalties must be a number, got '0.1'"),
    (Paper, {"num_features": 1.5}, "recipe.num_features"),
    (General, {"per_cost": "m33", "num_features": 5}, r"recipe\.per_cost must be one of m7, x86"),
    (General, {"per_cost": "m7"}, r"give recipe\.num_features"),
    (Paper, {"offset": -1.0}, "offset"),
    (Paper, {"sample_bins": 1}, "recipe.sample_bins"),
    (Paper, {"degree": 3}, "degree of the kernel must be 1 or 2, got 3"),
    (Paper, {"feature_filter": {"kinds": "SG"}}, "recipe.feature_filter: unknown 'kinds'"),
    (Paper, {"feature_filter": "SG"}, r"recipe.feature_filter must be like .*, got 'SG'"),
    (General, {"views": ("pooled", "all")}, r"recipe.views must be one of .*, got 'all'"),
    (General, {"views": ()}, "recipe.views must be some of simple, channel, pooled, got none"),
    (General, {"threshold": "most"}, r"recipe.threshold must be one of .*, got 'most'"),
    (General, {"penalties": float("inf")}, "recipe.penalties must be finite"),
    (General, {"pooling": None}, "needs statistics over channels"),
    (General, {"tolerance": 1.0}, r"recipe.tolerance must lie in \[0, 1\), got 1.0"),
    (General, {"num_features": 0}, "recipe.num_features"),
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


def standardised(z, weights):
    """Columns of mean 0 and of one size, so that the kernel of degree 1 is 1 in the mean."""
    share = weights / weights.sum()
    away = z - share @ z
    spread = (share @ away.square()).sqrt()
    u = torch.where(spread > 1e-9, away / spread, 0.0)
    return u / (share @ u.square().sum(1)).sqrt()


def machine(u, is_slip, weights, new, penalty):
    """Scores of new bins by NumPy's ridge machine."""
    given = u.numpy(), is_slip.long().numpy(), weights.numpy()
    slopes, intercept = oracles.class_ridge(*given, 1 / penalty, np.array([[-1.0], [1.0]]))
    return torch.from_numpy(new.numpy() @ slopes + intercept)[:, 0]


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


ALL = General(pooling=["mean", "std"], penalties=[0.1, 10.0])


@pytest.fixture(scope="module")
def moved():
    bins = moving_slip(np.random.default_rng(0))
    return bins, ALL.fit(bins, FAST_POOL)


def test_the_pooled_view_wins_where_another_channel_slips_in_each_group(moved):
    bins, fit = moved
    views = fit.metadata["views"]
    assert list(views) == list(VIEWS)
    assert views["pooled"] > 0.9
    assert fit.metadata["penalty"] == fit.metadata["penalties"]["pooled"]
    means = {view: [r["mean"] for r in fit.validation if r["view"] == view] for view in VIEWS}
    assert max(means["channel"]) < max(means["pooled"]) - 0.05
    assert fit.metadata["validated"] > 0.95
    assert fit.nested["mean"] > 0.95
    row = next(row for row in fit.validation if row.get("chosen"))
    assert set(row["balanced_accuracy"]) == {of.group for of in bins}


@pytest.mark.parametrize("view", ["simple", "pooled"])
def test_compression_scaler_and_pooling_do_not_move_with_labels(view, rng):
    """All that is learned of a group that is left out has no labels in it."""
    bins = moving_slip(rng)
    one = replace(ALL, views=view, penalties=1.0)
    other = [replace(of, is_slip=of.is_slip[rng.permutation(len(of.is_slip))]) for of in bins]
    fits = [one.fit(some, FAST_POOL) for some in (bins, other)]
    torch.testing.assert_close(*(fit.selection(bins[0].features) for fit in fits))
    assert not torch.allclose(*(fit.head.linear for fit in fits))


def test_of_many_groups_several_are_left_out_together_and_train_nothing(rng):
    """A group's score is that of the machine of the others, by the sums of all of their bins."""
    bins = moving_slip(rng, [f"M{number:02}" for number in range(13)])
    recipe = replace(ALL, views="pooled", penalties=0.1, drop_channels=0.0, threshold="zero")
    fit = recipe.fit(bins, FAST_POOL)
    (row,) = fit.validation
    sample = BinSample(recipe.sample_bins)
    for of in bins:
        sample.update(of)
    whole, joined = sample.bins(), sample.bins().joined()
    assert list(row["balanced_accuracy"]) == list(joined.group_names)
    features, is_slip = together(bins)
    ones, left_out = torch.ones(len(is_slip), dtype=torch.float64), []
    u = standardised(fit.selection(features), ones)
    for place, name in enumerate(joined.group_names):
        groups = {whole.group_names[group] for group in whole.group[joined.group == place]}
        left_out += groups
        inside = torch.tensor([of.group in groups for of in bins for _ in of.is_slip])
        score = machine(u[~inside], is_slip[~inside], ones[~inside], u[inside], penalty=0.1)
        expected = balanced_accuracy(score >= 0, is_slip[inside])
        assert row["balanced_accuracy"][name] == pytest.approx(expected, abs=1e-9)
    assert sorted(left_out) == sorted({of.group for of in bins})


def test_thinned_strata_keep_the_weight_of_all_their_bins(rng):
    """Of 300 bins about 100 are kept of three times the weight; where there are 50, all."""
    groups = torch.cat([torch.zeros(600), torch.ones(100)]).long()
    labels = torch.arange(700) % 2
    features = torch.from_numpy(rng.standard_normal((700, 2)))
    weights = torch.from_numpy(rng.uniform(0.5, 1.5, 700))
    bins = ViewBins(features, labels, groups, ("a", "b"), weights, 2 * groups + labels)
    places, thinned = bins.thinned(300)
    assert places.tolist() == sorted(set(places.tolist()))
    for stratum, num_kept in enumerate((100, 100, 50, 50)):
        kept = bins.stratum[places] == stratum
        assert int(kept.sum()) == num_kept
        factor = 300 / num_kept if stratum < 2 else 1.0
        torch.testing.assert_close(thinned[kept], factor * weights[places[kept]])
    assert bins.thinned(700)[0].tolist() == list(range(700))


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
        ALL, views="pooled", penalties=0.1, drop_channels=0.0, threshold="zero",
        scene_weights={"arm_motion": 0.25},
    )  # fmt: skip
    fit = recipe.fit(bins, FAST_POOL)
    features, is_slip = together(bins)
    is_arm = torch.tensor([of.scene == "arm_motion" for of in bins for _ in of.is_slip])
    z, weights = fit.selection(features), torch.where(is_arm, 0.25, 1.0).double()
    u = standardised(z, weights)
    expected = machine(u, is_slip, weights, u, penalty=0.1)
    torch.testing.assert_close(fit.head(z), expected, rtol=1e-6, atol=1e-8)


def test_second_copies_lack_up_to_a_part_of_the_channels(rng):
    """They make another machine, and set how many channels must be alive."""
    bins = moving_slip(rng)
    single = replace(ALL, views="pooled", penalties=0.1)
    with_copies = single.fit(bins, FAST_POOL)
    without = replace(single, drop_channels=0.0).fit(bins, FAST_POOL)
    assert not torch.equal(with_copies.head.linear, without.head.linear)
    alive = [fit.sensing.min_alive for fit in (with_copies, without)]
    assert alive == [2, 2]
    assert replace(single, drop_channels=0.25).fit(bins, FAST_POOL).sensing.min_alive == 3
    assert replace(single, min_alive=4).fit(bins, FAST_POOL).sensing.min_alive == 4
