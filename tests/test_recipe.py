"""The recipe's choices, on what a first pass learned of random bins."""

import json

import numpy as np
import pytest
import torch
from small_set import SMALL_HAND, SmallSet, small_maker, small_recipe
from test_learning import learn, unseen_c

from tactslip_torch.analysis.pareto import Workshop
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.groups import matching
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.hand import HandLayout
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.recipe import (
    Recipe,
    bin_weights,
    choose_frame,
    kept_shares,
    recalls_mean,
    stand_for,
)
from tactslip_torch.training.selection import Plan, plan_detector

NUM = 30


def make_parts(rng, materials="abc", cycles=2, bins=40, share=0.5):
    """Recordings of random bins; features 0..4 tell the classes apart, more so for later ones."""
    parts = []
    for material in materials:
        for cycle in range(cycles):
            is_slip = torch.from_numpy(rng.random(bins) < share)
            features = torch.from_numpy(rng.standard_normal((bins, NUM)))
            features[:, :5] += torch.arange(1, 6) * 0.4 * is_slip[:, None]
            parts.append((RecordingId(material, cycle), features.float(), is_slip))
    return parts


def surveyed(recipe, parts):
    survey = Survey(NUM, recipe.sample_bins)
    for recording, features, is_slip in parts:
        survey.update(str(recording), recipe.group(recording), features, is_slip)
    return survey


def together(parts):
    return torch.cat([p[1] for p in parts]).double(), torch.cat([p[2] for p in parts])


def test_ranking_is_by_the_t_statistic_of_all_bins_together(rng):
    from scipy.stats import ttest_ind

    parts = make_parts(rng)
    features, is_slip = together(parts)
    scores = np.abs(ttest_ind(features[is_slip], features[~is_slip]).statistic)
    frame = choose_frame(Recipe(num_features=4), surveyed(Recipe(), parts))
    assert list(frame.selected) == np.argsort(-scores)[:4].tolist()


def test_the_papers_scaler_has_the_exact_range_of_every_training_bin(rng):
    parts = make_parts(rng)
    recipe = Recipe(num_features=3, sample_bins=2)  # far fewer than there are
    frame = choose_frame(recipe, surveyed(recipe, parts))
    features = together(parts)[0][:, list(frame.selected)]
    assert torch.equal(frame.scaler.maximum, features.amax(0))
    assert torch.equal(frame.scaler.minimum, features.amin(0))
    scaled = frame(together(parts)[0])
    assert scaled.amax(0).tolist() == [1, 1, 1]
    assert scaled.amin(0).tolist() == [-1, -1, -1]


def test_tails_are_compressed_and_clipped_on_request(rng):
    parts = make_parts(rng)
    parts[0][1][0, :5] = 1e6  # an outlier in one bin
    recipe = Recipe(num_features=3, compress=True, tail=0.05)
    frame = choose_frame(recipe, surveyed(recipe, parts))
    features = together(parts)[0][:, list(frame.selected)]
    bent = features.sign() * (features.abs() / frame.scaler.knee).log1p() * frame.scaler.knee
    share = (bent > frame.scaler.maximum).double().mean(0)
    assert ((share > 0.02) & (share <= 0.05)).all()
    assert frame(together(parts)[0]).abs().amax() == 1
    assert (frame.scaler.maximum < 10).all()


def test_near_duplicates_are_passed_over(rng):
    parts = make_parts(rng)
    for _, features, _ in parts:  # feature 10 says what feature 4 says
        features[:, 10] = features[:, 4] + 1e-3 * torch.from_numpy(rng.standard_normal(40)).float()
    with_both = choose_frame(Recipe(num_features=3), surveyed(Recipe(), parts)).selected
    recipe = Recipe(num_features=3, most_correlation=0.9)
    without = choose_frame(recipe, surveyed(recipe, parts)).selected
    assert {4, 10} <= set(with_both)
    assert len({4, 10} & set(without)) == 1
    assert {3, 2} <= set(without)


def test_the_first_features_of_a_frame(rng):
    recipe = Recipe(num_features=[2, 5], compress=True)
    parts = make_parts(rng)
    frame = choose_frame(recipe, surveyed(recipe, parts))
    assert len(frame.selected) == 5
    features = together(parts)[0]
    assert torch.equal(frame.first(2)(features), frame(features)[:, :2])


@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_both_balances_give_the_classes_one_weight(balance, rng):
    recipe = Recipe(balance=balance)
    _, is_slip = together(make_parts(rng, share=0.8))
    counts = [int((~is_slip).sum()), int(is_slip.sum())]
    weights = bin_weights(recipe, counts, is_slip)
    totals = [float(weights[is_slip == value].sum()) for value in (False, True)]
    assert totals[0] == pytest.approx(totals[1], rel=1e-12)
    expected = 2 * min(counts) if balance == "undersample" else sum(counts)
    assert sum(totals) == pytest.approx(expected)
    assert kept_shares(recipe, counts)[0] == 1.0  # non-slip is the smaller class


def test_a_sample_stands_for_all_bins(rng):
    recipe = Recipe(sample_bins=7, balance="weights")
    survey = surveyed(recipe, make_parts(rng, share=0.8))
    sample = survey.sample.bins()
    assert len(sample.is_slip) == 3 * 2 * 7
    weights = stand_for(sample, recipe, survey.moments.count.tolist())
    assert float(weights.sum()) == pytest.approx(240)


def test_an_absent_class_is_named(rng):
    parts = [(r, f, torch.ones_like(s)) for r, f, s in make_parts(rng)]
    with pytest.raises(ValueError, match="no non-slip bin"):
        choose_frame(Recipe(num_features=3), surveyed(Recipe(), parts))
    with pytest.raises(ValueError, match="no non-slip bin"):
        bin_weights(Recipe(), [0, 5], torch.ones(5, dtype=torch.bool))


def test_recalls_mean_by_hand():
    truth = torch.tensor([False, False, True, True, True, True])
    says = torch.tensor([False, True, True, True, True, False])
    assert recalls_mean(says, truth) == pytest.approx((1 / 2 + 3 / 4) / 2)
    weights = torch.tensor([3.0, 1.0, 1.0, 1.0, 1.0, 3.0], dtype=torch.float64)
    assert recalls_mean(says, truth, weights) == pytest.approx((3 / 4 + 3 / 6) / 2)
    assert recalls_mean(says[:2], truth[:2]) is None


def test_facts_are_json_even_of_an_infinite_penalty():
    among = {"kind": "SG", "descriptor": ["mean", "std"]}
    recipes = [Recipe(), Recipe(penalties=float("inf")), Recipe(num_features=[3, 5])]
    for recipe in [*recipes, Recipe(among=among)]:
        again = Recipe(**json.loads(json.dumps(recipe.facts(), allow_nan=False)))
        assert again.among == recipe.among
        assert again.penalties_ascending == recipe.penalties_ascending
        assert again.sizes == recipe.sizes


def test_groups_are_materials_or_fifths_of_the_cycles():
    assert Recipe().group(RecordingId("M1", 7)) == "M1"
    assert Recipe(group_by="cycle").group(RecordingId("M1", 7)) == "2"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"balance": "none"}, r"recipe.balance must be one of undersample, weights, got 'none'"),
        ({"score_variance": "x"}, r"recipe.score_variance must be one of pooled, welch"),
        ({"group_by": "x"}, r"recipe.group_by must be one of material, cycle"),
        ({"kernel": "x"}, r"recipe.kernel must be one of polynomial, rbf"),
        ({"kernel": "rbf"}, r"recipe.kernel=rbf needs recipe.gamma"),
        ({"penalties": ()}, r"recipe.penalties must be positive, got \[\]"),
        ({"penalties": (0.1, 0.0)}, r"recipe.penalties must be positive"),
        ({"penalties": float("nan")}, r"recipe.penalties must be positive"),
        ({"penalties": (0.1, float("inf"))}, r"validation needs finite values"),
        ({"num_features": 1.5}, r"recipe.num_features must be whole numbers, got \[1.5\]"),
        ({"num_features": 0}, r"recipe.num_features must be at least 1"),
        ({"offsets": -1.0}, r"recipe.offsets must not be negative"),
        ({"tail": 0.5}, r"recipe.tail must lie in \[0, 0.5\)"),
        ({"most_correlation": 0.0}, r"recipe.most_correlation must lie in \(0, 1\]"),
        ({"sample_bins": 1}, r"recipe.sample_bins must be at least 2"),
        ({"degree": 0}, r"degree of the kernel must be a whole number"),
        ({"among": {"kinds": "SG"}}, r"recipe.among: unknown 'kinds', expected some of kind, f"),
        ({"among": {"kind": []}}, r"recipe.among.kind must be a name or several, got \[\]"),
        ({"among": {"kind": 3}}, r"recipe.among.kind must be a name or several, got 3"),
        ({"among": {}}, r"recipe.among must be like .*, got {}"),
        ({"among": "SG"}, r"recipe.among must be like .*, got 'SG'"),
    ],
    ids=str,
)
def test_bad_recipes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Recipe(**change)


# ------------------------------------------------------------------------- recipes with among
POOL = FeaturePool(HandLayout.paper24())


def told_apart(rng, pool):
    """A survey of bins of a pool's features, some of which tell the classes apart."""
    survey = Survey(len(pool.names), 50)
    for group in "ab":
        is_slip = torch.arange(60) % 2 == 0
        features = torch.from_numpy(rng.standard_normal((60, len(pool.names))))
        features += torch.from_numpy(rng.random(len(pool.names))) * is_slip[:, None]
        survey.update(group, group, features.float(), is_slip)
    return survey


@pytest.mark.parametrize(
    ("wanted", "does", "num"),
    [
        ({"kind": "SG"}, lambda n: n.channel.startswith("SG"), 14 * 13),
        ({"kind": "PVDF"}, lambda n: n.channel.startswith("PVDF"), 10 * 240),
        ({"kind": "SG", "descriptor": "mean"}, lambda n: str(n).endswith("raw time mean"), 14),
        ({"finger": "thumb"}, lambda n: n.channel in ("SG13", "SG14", "PVDF9", "PVDF10"), 26 + 480),
        ({"channel": ["SG2", "PVDF3"]}, lambda n: n.channel in ("SG2", "PVDF3"), 13 + 240),
        ({"component": "D1", "domain": "time"}, lambda n: " D1 time " in str(n), 10 * 14),
        ({"descriptor": ["mean", "std"], "component": ["A1", "A2"]}, None, 10 * 2 * 2 * 2),
    ],
    ids=lambda value: "rule" if callable(value) else str(value),  # no address: as in any process
)
def test_what_matches_has_every_attribute_that_is_asked_for(wanted, does, num):
    mask = matching(POOL.hand, POOL.names, wanted)
    assert int(mask.sum()) == num
    if does is not None:
        assert mask.tolist() == [does(name) for name in POOL.names]


def test_a_recipe_without_among_allows_everything():
    assert Recipe().allowed(POOL) is None


@pytest.mark.parametrize("most_correlation", [1.0, 0.995])
def test_only_what_matches_is_ranked_and_in_the_order_of_the_whole_ranking(most_correlation, rng):
    pool = FeaturePool(SMALL_HAND)
    survey = told_apart(rng, pool)
    recipe = Recipe(
        num_features=9, among={"domain": "freq"}, most_correlation=most_correlation, penalties=0.1
    )
    plan = plan_detector(recipe, survey, lambda items, what: items, allowed=recipe.allowed(pool))
    every = choose_frame(Recipe(num_features=len(pool.names)), survey).selected
    of_spectra = [index for index in every if pool.names[index].domain == "freq"]
    assert list(plan.frame.selected) == of_spectra[:9]
    expected = {"wanted": {"domain": ["freq"]}, "matching": len(of_spectra), "num_features": [9]}
    assert plan.among == expected
    assert Plan.of(json.loads(json.dumps(plan.facts())), plan.frame.scaler).among == expected


def test_more_features_than_match_are_cut_and_the_facts_say_so(rng, caplog):
    pool = FeaturePool(SMALL_HAND)
    recipe = Recipe(num_features=[2, 60, 120], among={"kind": "SG"}, penalties=(0.1, 1.0))
    plan = plan_detector(
        recipe, told_apart(rng, pool), lambda items, what: items, allowed=recipe.allowed(pool)
    )
    assert plan.among == {"wanted": {"kind": ["SG"]}, "matching": 13, "num_features": [2, 13]}
    assert [row["num_features"] for row in plan.validation] == [2, 2, 13, 13]
    assert {pool.names[index].channel for index in plan.frame.selected} == {"SG1"}
    assert "recipe.num_features=120 is cut to 13" in caplog.text


@pytest.mark.parametrize(
    ("among", "message"),
    [
        ({"descriptor": "meen"}, "no feature has descriptor='meen', expected some of mean, median"),
        ({"kind": "SG", "domain": "freq"}, "no feature has kind=SG, domain=freq together"),
        ({"finger": ["thumb", "toe"]}, "no feature has finger='toe', expected some of little, r"),
    ],
    ids=str,
)
def test_what_nothing_matches_is_refused_in_one_line(among, message):
    with pytest.raises(ValueError, match=f"^recipe.among: {message}") as caught:
        Recipe(among=among).allowed(POOL)
    assert "\n" not in str(caught.value)


def test_among_is_never_silently_ignored(rng):
    recipe = Recipe(num_features=3, among={"kind": "SG"})
    with pytest.raises(ValueError, match=r"hand over recipe.allowed\(pool\)"):
        plan_detector(recipe, told_apart(rng, FeaturePool(SMALL_HAND)), lambda items, what: items)
    with pytest.raises(ValueError, match=r"recipe.among is not for a search"):
        Workshop({}, None, None, recipe)


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec.*")
def test_a_learner_takes_features_that_match_and_refuses_early_what_none_matches():
    source = SmallSet()
    wanted = {"kind": "SG", "descriptor": ["mean", "std"]}
    learner = learn(source, unseen_c(source), recipe=small_recipe(among=wanted))
    assert {str(name) for name in learner.detector.selected_names} == {
        "SG1 raw time mean",
        "SG1 raw time std",
    }
    assert learner.facts["among"]["matching"] == 2
    maker = small_maker(SmallSet())
    with pytest.raises(ValueError, match=r"^recipe.among: no feature has finger='toe'"):
        SlipLearner(maker.pool, maker.channel_filter, small_recipe(among={"finger": "toe"}))
