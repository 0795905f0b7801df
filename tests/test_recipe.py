"""Recipes, plans and passes: what is chosen, and that neither order nor workers matter."""

from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from scipy.stats import ttest_ind
from small_set import SMALL_HAND, SmallSet, refitted_scores, small_maker, small_recipe

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.groups import matching
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import calibration_from_dict, fit_platt
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.training import plan as planning
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.recipe import (
    FREE_CONSTANT,
    Recipe,
    balanced_accuracy,
    class_fractions,
    sample_weight,
    scene_weights,
    select_features,
)

NUM = 30
FEW = {"num_features": 4, "penalties": (0.1, 3.0), "sample_bins": 500}
POOL, SMALL_POOL = FeaturePool(HandLayout.paper24()), FeaturePool(SMALL_HAND)


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


def statistics_from(recipe, parts):
    statistics = TrainingStatistics(NUM, recipe.sample_bins)
    for recording, features, is_slip in parts:
        statistics.update(str(recording), recipe.group(recording), features, is_slip)
    return statistics


def selected(recipe, parts):
    return select_features(recipe, statistics_from(recipe, parts))


def planned(recipe, parts):
    return planning.plan_detector(recipe, statistics_from(recipe, parts))


def passed(plan, parts):
    gathered = planning.TrainingPass(plan)
    for recording, features, is_slip in parts:
        gathered.update(str(recording), features, is_slip)
    return gathered


def together(parts):
    return torch.cat([p[1] for p in parts]).double(), torch.cat([p[2] for p in parts])


def balanced(plan, parts):
    """All bins as training bins, both classes weighing the same."""
    features, is_slip = together(parts)
    weights = (len(is_slip) / (2 * torch.bincount(is_slip.long()).double()))[is_slip.long()]
    return TrainingBins(plan.selection(features), is_slip, weights)


# Ranking, scaling, weights ---------------------------------------------------------------------


def test_ranking_is_by_the_t_statistic_and_the_scaler_has_the_range_of_all_bins(rng):
    parts = make_parts(rng)
    features, is_slip = together(parts)
    scores = np.abs(ttest_ind(features[is_slip], features[~is_slip]).statistic)
    found = selected(Recipe(num_features=4, sample_bins=2), parts)  # far fewer than there are
    assert list(found.selected) == np.argsort(-scores)[:4].tolist()
    scaled = found(features)
    assert scaled.amax(0).tolist() == [1] * 4
    assert scaled.amin(0).tolist() == [-1] * 4
    torch.testing.assert_close(found.first(2)(features), scaled[:, :2])


@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_a_sample_stands_for_all_bins_with_both_classes_of_one_weight(balance, rng):
    recipe, parts = Recipe(sample_bins=7, balance=balance), make_parts(rng, share=0.8)
    sample = statistics_from(recipe, parts).sample.bins()
    assert len(sample.is_slip) == 3 * 2 * 7
    weights, num_rest = sample_weight(recipe, sample), int((~together(parts)[1]).sum())
    totals = [float(weights[mine].sum()) for mine in (sample.is_slip, ~sample.is_slip)]
    wanted = num_rest if balance == "undersample" else 120
    assert totals == pytest.approx([wanted, wanted], rel=1e-12)
    assert class_fractions(recipe, sample)[0] == 1.0  # non-slip is the smaller class


BAD_RECIPES = [
    ({"balance": "none"}, r"recipe.balance must be one of undersample, weights, got 'none'"),
    ({"penalties": ()}, r"recipe.penalties must be positive, got \[\]"),
    ({"penalties": (0.1, float("inf"))}, r"validation needs finite values"),
    ({"num_features": 1.5}, r"num_features must be whole numbers of at least 1, got \[1.5\]"),
    ({"offsets": -1.0}, r"recipe.offsets must not be negative"),
    ({"tail": "0.1"}, r"recipe.tail must lie in \[0, 0.5\), got '0.1'"),  # text is no number
    ({"most_correlation": 0.0}, r"recipe.most_correlation must lie in \(0, 1\]"),
    ({"sample_bins": 1}, r"recipe.sample_bins must be at least 2"),
    ({"degree": 0}, r"degree of the kernel must be 1 or 2, got 0"),
    ({"degree": 3}, r"degree of the kernel must be 1 or 2, got 3"),
    ({"use": "pooled", "pooling": None}, "needs statistics over channels"),
    ({"num_features": None}, "num_features=null needs recipe.validation=nested"),
    ({"tolerance": 1.0}, r"recipe.tolerance must lie in \[0, 1\), got 1.0"),
    ({"scene_weights": {"taps": 0.0}}, "scene_weights must be positive, got {'taps': 0.0}"),
    ({"feature_filter": {"kinds": "SG"}}, r"recipe.feature_filter: unknown 'kinds', expected"),
    ({"feature_filter": {"kind": 3}}, r"feature_filter.kind must be a name or several, got 3"),
    ({"feature_filter": "SG"}, r"recipe.feature_filter must be like .*, got 'SG'"),
]


@pytest.mark.parametrize(("change", "message"), BAD_RECIPES, ids=str)
def test_bad_recipes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Recipe(**change)


# Plans -----------------------------------------------------------------------------------------


def test_validation_and_calibration_equal_refits_without_the_group(rng):
    parts = make_parts(rng)
    plan = planned(Recipe(**FEW, balance="weights"), parts)
    bins = balanced(plan, parts)
    material = torch.tensor([ord(r.material) for r, _, is_slip in parts for _ in is_slip])
    assert [row["penalty"] for row in plan.validation] == [0.1, 3.0]
    for row in plan.validation:
        scores = refitted_scores(bins, material, row["penalty"])
        for name, found in row["balanced_accuracy"].items():
            mine = material == ord(name)
            assert found == balanced_accuracy(scores[mine] >= 0, bins.is_slip[mine])
        assert row["mean"] == pytest.approx(sum(row["balanced_accuracy"].values()) / 3)
        expected = astuple(fit_platt(scores, bins.is_slip, bins.weights))
        found = astuple(calibration_from_dict(row["calibration"]))
        assert found == pytest.approx(expected, rel=1e-6)
    best = max(row["mean"] for row in plan.validation)
    chosen = next(row for row in plan.validation if row["mean"] == best)
    assert (plan.penalty, plan.calibration) == (chosen["penalty"], chosen["calibration"])


def test_what_cannot_be_validated_is_taken_from_the_middle(rng, caplog):
    recipe = Recipe(num_features=[2, 3], offsets=[0.5, 2.0], penalties=(3.0, 0.1, 0.2))
    plan = planned(recipe, make_parts(rng, "a"))  # one group
    assert (plan.selection.size, plan.penalty, plan.validation) == (3, 0.2, [])
    assert "K=3" in caplog.text
    assert "unvalidated" in caplog.text
    plan = planned(Recipe(num_features=3, penalties=float("inf")), make_parts(rng))
    assert (plan.penalty, plan.metadata["penalty"], plan.validation) == (float("inf"), "inf", [])


def test_an_absent_class_is_named(rng):
    parts = [(r, f, torch.ones_like(s)) for r, f, s in make_parts(rng)]
    with pytest.raises(ValueError, match="no non-slip bin"):
        planned(Recipe(num_features=3), parts)
    parts = [(r, f, torch.full_like(s, r.material in "ab")) for r, f, s in make_parts(rng, "abcd")]
    with pytest.raises(ValueError, match="no validation group has bins of both classes"):
        planned(Recipe(**FEW), parts)


def test_what_stands_for_missing_channels_is_of_the_selected_features(rng):
    parts = make_parts(rng, share=0.2)
    plan = planned(Recipe(**FEW), parts)
    features, is_slip = together(parts)
    z = plan.selection(features)
    torch.testing.assert_close(plan.imputation, (z[is_slip].mean(0) + z[~is_slip].mean(0)) / 2)


# Passes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bins", [10, 60], ids=["bins kept", "sums"])
@pytest.mark.parametrize("balance", ["undersample", "weights"])
def test_neither_order_nor_sums_change_the_machine(bins, balance, rng):
    parts = make_parts(rng, bins=bins, share=0.7)
    recipe = Recipe(**FEW | {"num_features": 12}, balance=balance)
    plan, other = planned(recipe, parts), planned(recipe, parts[::-1])
    assert plan.validation == other.validation
    assert plan.uses_normal_equations == (bins == 60)  # 91 monomials of 12 features
    gathered, turned = passed(plan, parts), passed(other, parts[::-1])
    heads = [each.solve().state_dict() for each in (gathered, turned)]
    torch.testing.assert_close(heads[0], heads[1], rtol=1e-9, atol=1e-11)
    if balance == "weights":
        whole = balanced(plan, parts)
        expected = fit_machine(whole, plan.penalty, plan.kernel)(whole.features)
        found = gathered.solve()(whole.features)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="already"):
        gathered.update(str(parts[0][0]), parts[0][1], parts[0][2])


# A recipe that restricts the ranking -------------------------------------------------------------


def told_apart(rng, pool):
    """Statistics of bins of a pool's features, some of which tell the classes apart."""
    statistics = TrainingStatistics(len(pool.names), 50)
    for group in "ab":
        is_slip = torch.arange(60) % 2 == 0
        features = 10.0 + torch.from_numpy(rng.standard_normal((60, len(pool.names))))  # spans too
        features += torch.from_numpy(rng.random(len(pool.names))) * is_slip[:, None]
        statistics.update(group, group, features.float(), is_slip)
    return statistics


FILTERS = [
    ({"kind": "SG"}, lambda n: n.channel.startswith("SG"), 14 * 13),
    ({"kind": "SG", "descriptor": "mean"}, lambda n: str(n).endswith("raw time mean"), 14),
    ({"finger": "thumb"}, lambda n: n.channel in ("SG13", "SG14", "PVDF9", "PVDF10"), 26 + 480),
    ({"channel": ["SG2", "PVDF3"]}, lambda n: n.channel in ("SG2", "PVDF3"), 13 + 240),
    ({"component": "D1", "domain": "time"}, lambda n: " D1 time " in str(n), 10 * 14),
]


@pytest.mark.parametrize(("wanted", "does", "num"), FILTERS, ids=[str(row[0]) for row in FILTERS])
def test_what_matches_has_every_attribute_that_is_asked_for(wanted, does, num):
    mask = matching(POOL.hand, POOL.names, wanted)
    assert int(mask.sum()) == num
    assert mask.tolist() == [does(name) for name in POOL.names]
    assert Recipe().allowed(POOL) is None


@pytest.mark.parametrize("most_correlation", [1.0, 0.995])
def test_only_what_matches_is_ranked_and_in_the_order_of_the_whole_ranking(most_correlation, rng):
    statistics, wanted = told_apart(rng, SMALL_POOL), {"domain": "freq"}
    options = {"num_features": 9, "most_correlation": most_correlation, "penalties": 0.1}
    plan = planning.plan_detector(Recipe(feature_filter=wanted, **options), statistics, SMALL_POOL)
    every = select_features(Recipe(num_features=len(SMALL_POOL.names)), statistics).selected
    of_spectra = [index for index in every if SMALL_POOL.names[index].domain == "freq"]
    assert list(plan.selection.selected) == of_spectra[:9]
    numbers = {"matching": len(of_spectra), "num_features": [9]}
    assert plan.feature_filter == {"wanted": {"domain": ["freq"]}, **numbers}


def test_more_features_than_match_are_cut_and_that_is_said(rng, caplog):
    options = {"feature_filter": {"kind": "SG"}, "penalties": (0.1, 1.0)}
    recipe, statistics = Recipe(num_features=[2, 60, 120], **options), told_apart(rng, SMALL_POOL)
    plan = planning.plan_detector(recipe, statistics, SMALL_POOL)
    numbers = {"matching": 13, "num_features": [2, 13]}
    assert plan.feature_filter == {"wanted": {"kind": ["SG"]}, **numbers}
    assert [row["num_features"] for row in plan.validation] == [2, 2, 13, 13]
    assert {SMALL_POOL.names[index].channel for index in plan.selection.selected} == {"SG1"}
    assert "recipe.num_features=120 is cut to 13" in caplog.text


def test_a_filter_is_never_silently_ignored(rng):
    recipe = Recipe(num_features=3, feature_filter={"kind": "SG"})
    with pytest.raises(ValueError, match=r"needs the names of features; hand over the pool"):
        planning.plan_detector(recipe, told_apart(rng, SMALL_POOL))
    maker = small_maker(SmallSet())
    for wanted, message in (
        ({"descriptor": "meen"}, "no feature has descriptor='meen', expected some of mean, median"),
        ({"kind": "SG", "domain": "freq"}, "no feature has kind=SG, domain=freq together"),
        ({"finger": ["index", "toe"]}, "no feature has finger='toe', expected some of index"),
    ):
        with pytest.raises(ValueError, match=f"^recipe.feature_filter: {message}") as caught:
            SlipLearner(maker.pool, maker.channel_filter, small_recipe(feature_filter=wanted))
        assert "\n" not in str(caught.value)


HAND = HandLayout.from_rows(
    {"name": f"PVDF{i}", "kind": "PVDF", "finger": f"f{i}", "segment": "distal"} for i in range(4)
)
FILM_POOL = FeaturePool(HAND, level=1)
GROUPS = ("M1", "M2", "M3", "M4")


NESTED = {
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
    features = FILM_POOL(torch.from_numpy(np.concatenate(bins))).float()
    num = len(is_slip)
    recordings = torch.arange(num) // 5, tuple(f"r{i}" for i in range(num // 5))
    weight = torch.full((num,), 2.0, dtype=torch.float64)
    of_bins = features, torch.tensor(is_slip), torch.tensor(group), tuple(groups)
    return SampledBins(*of_bins, *recordings, torch.arange(num), weight)


def chosen(sample, **changes):
    return planning.choose_model(Recipe(**NESTED | changes), FILM_POOL, sample)


@pytest.fixture(scope="module")
def drawn():
    sample = sample_of(np.random.default_rng(0))
    return sample, chosen(sample)


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
    everything = chosen(drawn[0], tolerance=0.99)
    assert everything.structure == ("pooled", None, Polynomial(1, FREE_CONSTANT))
    assert everything.penalty == min(row["penalty"] for row in everything.rows)


def test_a_grid_that_ends_at_its_edge_is_extended_and_says_so(drawn, caplog):
    few = {"use": "pooled", "num_features": None, "degree": 1, "tolerance": 0.2}
    with caplog.at_level("INFO"):
        choice = chosen(drawn[0], **few)
    assert "ended at its edge and was extended by 0.0001" in caplog.text
    assert min(row["penalty"] for row in choice.rows) < 0.001


def test_what_is_done_to_a_group_does_not_reach_machines_without_it(drawn):
    """Features and labels of a group change: its nested score alone does."""
    sample, before = drawn
    mine = sample.group == 2
    flipped = torch.where(mine, ~sample.is_slip, sample.is_slip)
    after = chosen(replace(sample, is_slip=flipped))
    accuracy = before.nested["balanced_accuracy"]["M3"]
    # the others' labels are as they were, so the machine is the same and every answer turns
    assert after.nested["balanced_accuracy"]["M3"] == pytest.approx(1 - accuracy)
    spoilt = sample.features.clone()
    spoilt[mine] = 1e6 * torch.rand(spoilt[mine].shape)
    single = {"use": "both", "num_features": 10, "degree": 2, "penalties": 0.1}
    scores = [
        chosen(replace(sample, features=x), **single).rows[0]["balanced_accuracy"]
        for x in (sample.features, spoilt)
    ]
    assert scores[0]["M3"] != scores[1]["M3"]


def test_scenes_have_the_weight_that_is_asked_for(rng):
    names = ("M1|arm_motion", "M1|paper", "M2|arm_motion", "M2|paper")
    sample = sample_of(rng, names)
    is_quiet = ~(sample.is_slip & torch.isin(sample.group, torch.tensor([0, 2])))
    per_bin = ("features", "is_slip", "group", "recording", "bin_index", "sample_weight")
    kept = {name: getattr(sample, name)[is_quiet] for name in per_bin}
    quiet_arm = replace(sample, **kept)  # an arm that moves without slip
    how = Recipe(**NESTED, scene_weights={"arm_motion": 0.5})
    weights = sample_weight(how, quiet_arm)
    is_arm = torch.isin(quiet_arm.group, torch.tensor([0, 2]))
    no_slip = ~quiet_arm.is_slip
    assert float(weights[is_arm].sum() / weights[~is_arm & no_slip].sum()) == pytest.approx(0.5)
    assert float(weights[no_slip].sum()) == pytest.approx(float(weights[~no_slip].sum()))
    assert set(scene_weights(how, quiet_arm)) == {"arm_motion", "paper"}
    with pytest.raises(ValueError, match="scene_weights names 'taps', of which there is no"):
        sample_weight(replace(how, scene_weights={"taps": 1.0}), quiet_arm)


def test_one_group_cannot_be_left_out(rng):
    with pytest.raises(ValueError, match="needs two with bins of both classes, got 1"):
        chosen(sample_of(rng, ("M1",)))
