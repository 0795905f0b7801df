import pytest
import torch

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.selection import ClassMoments, rank_features, t_scores
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.recipe import (
    CollectedBins,
    GroupedMoments,
    Recipe,
    chosen_penalty,
    fit_detector,
    validate,
)

NUM = 30


def quiet(items, what):
    return items


def make_parts(rng, materials="abc", cycles=2, bins=40):
    """Recordings of random bins; features 0..4 tell the classes apart, more so for later ones."""
    parts = []
    for material in materials:
        for cycle in range(cycles):
            is_slip = torch.from_numpy(rng.random(bins) < 0.5)
            features = torch.from_numpy(rng.standard_normal((bins, NUM)))
            features[:, :5] += torch.arange(1, 6) * 0.4 * is_slip[:, None]
            parts.append((RecordingId(material, cycle), features, is_slip))
    return parts


def gathered(recipe, parts):
    moments = GroupedMoments(recipe, NUM)
    for part in parts:
        moments.update(*part)
    columns = moments.columns()
    picked = [(recording, features[:, columns], s) for recording, features, s in parts]
    return moments, CollectedBins.of(recipe, columns, picked)


def test_ranking_is_that_of_all_bins_together(rng):
    parts = make_parts(rng)
    recipe = Recipe(num_features=4)
    whole = ClassMoments(NUM)
    whole.update(torch.cat([p[1] for p in parts]), torch.cat([p[2] for p in parts]))
    expected = rank_features(t_scores(whole), 4).tolist()
    assert gathered(recipe, parts)[0].ranking() == expected
    assert set(expected) <= {1, 2, 3, 4, 0}


def test_a_fold_is_ranked_without_its_group(rng):
    parts = make_parts(rng)
    for recording, features, is_slip in parts:
        if recording.material == "b":  # only material b knows feature 20
            features[:, 20] += 4.0 * is_slip
    moments, bins = gathered(Recipe(num_features=6), parts)
    assert 20 in moments.ranking()
    assert 20 not in moments.ranking(without="b")
    assert set(moments.ranking(without="a")) <= set(bins.columns)


def test_the_order_of_recordings_does_not_matter(rng):
    parts = make_parts(rng)
    recipe = Recipe(num_features=5, penalties=(0.1, 1.0))
    forward = fit_detector(recipe, *gathered(recipe, parts), quiet)
    backward = fit_detector(recipe, *gathered(recipe, parts[::-1]), quiet)
    assert forward.selected == backward.selected
    assert forward.facts == backward.facts
    torch.testing.assert_close(forward.head.quadratic, backward.head.quadratic, rtol=0, atol=1e-12)


def test_validation_equals_a_fold_done_by_hand(rng):
    parts = make_parts(rng)
    recipe = Recipe(num_features=3, penalties=(0.1, 3.0), balance="weights")
    moments, bins = gathered(recipe, parts)
    found = validate(recipe, moments, bins, quiet)
    assert sorted(found) == ["a", "b", "c"]

    train = [p for p in parts if p[0].material != "b"]
    held = [p for p in parts if p[0].material == "b"]
    x, s = torch.cat([p[1] for p in train]), torch.cat([p[2] for p in train])
    own = ClassMoments(NUM)
    own.update(x, s)
    selected = rank_features(t_scores(own), 3)
    low, high = x[:, selected].amin(0), x[:, selected].amax(0)

    def scale(features):
        return (2 * (features[:, selected] - low) / (high - low) - 1).clamp(-1, 1)

    weights = torch.where(s, len(s) / (2 * s.sum()), len(s) / (2 * (~s).sum())).double()
    y, t = torch.cat([p[1] for p in held]), torch.cat([p[2] for p in held])
    for penalty, score in zip((0.1, 3.0), found["b"], strict=True):
        head = fit_machine(TrainingBins(scale(x), s, weights), penalty)
        says = head(scale(y)) >= 0
        recalls = says[t].double().mean() + (~says[~t]).double().mean()
        assert score == pytest.approx(float(recalls / 2))


def test_the_best_mean_wins_and_the_smaller_of_equals():
    recipe = Recipe(penalties=(1.0, 0.1, 0.5))
    assert chosen_penalty(recipe, {"a": [0.9, 0.8, 0.9], "b": [0.7, 0.9, 0.7]}) == 0.1
    assert chosen_penalty(recipe, {"a": [0.9, 0.8, 0.9]}) == 0.5


def test_one_group_leaves_nothing_to_validate(rng, caplog):
    recipe = Recipe(num_features=3, penalties=(0.1, 0.2, 3.0))
    fitted = fit_detector(recipe, *gathered(recipe, make_parts(rng, "a")), quiet)
    assert fitted.facts["penalty"] == 0.2
    assert "unvalidated" in caplog.text


def test_cycles_can_be_the_groups(rng):
    recipe = Recipe(num_features=3, group_by="cycle")
    moments, _ = gathered(recipe, make_parts(rng, "a", cycles=7))
    assert moments.folds() == ["0", "1", "2", "3", "4"]


def test_the_scaler_sees_all_training_bins_and_the_machine_a_balanced_draw(rng):
    parts = make_parts(rng)
    recipe = Recipe(num_features=3, penalties=(1.0,))
    moments, bins = gathered(recipe, parts)
    fitted = fit_detector(recipe, moments, bins, quiet)
    features = torch.cat([p[1] for p in parts])[:, fitted.selected]
    assert torch.equal(fitted.scaler.maximum, features.amax(0))
    assert torch.equal(fitted.scaler.minimum, features.amin(0))
    slips = int(bins.is_slip.sum())
    assert fitted.facts["num_training_bins"] == 2 * min(slips, len(bins.is_slip) - slips)


def test_a_class_that_is_absent_is_named(rng):
    parts = [(r, f, torch.ones_like(s)) for r, f, s in make_parts(rng)]
    moments = GroupedMoments(Recipe(num_features=3), NUM)
    for part in parts:
        moments.update(*part)
    with pytest.raises(ValueError, match="no non-slip bin"):
        moments.columns()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"balance": "none"}, r"detector.balance must be one of undersample, weights, got 'none'"),
        ({"score_variance": "x"}, r"detector.score_variance must be one of pooled, welch"),
        ({"group_by": "x"}, r"detector.group_by must be one of material, cycle"),
        ({"penalties": ()}, r"detector.penalties must be positive, got \[\]"),
        ({"penalties": (0.1, 0.0)}, r"detector.penalties must be positive"),
        ({"num_features": 0}, r"detector.num_features must be at least 1"),
        ({"offset": -1.0}, r"detector.offset must not be negative"),
    ],
    ids=str,
)
def test_bad_recipes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Recipe(**change)
