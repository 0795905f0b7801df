"""Scores per bin, of groups, of folds together, and of prediction sets."""

import json

import numpy as np
import pytest
import torch
from sklearn.metrics import accuracy_score, balanced_accuracy_score, recall_score
from sklearn.metrics import confusion_matrix as oracle_confusion

from tactslip_torch.model.calibration import reliability
from tactslip_torch.report.metrics import (
    bin_metrics,
    confusion_matrix,
    merged_metrics,
    split_metrics,
    weights_at_share,
)


def random_bins(seed, num_bins=500):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(num_bins, generator=generator) < 0.75
    return truth, truth ^ (torch.rand(num_bins, generator=generator) < 0.1)


def test_scores_equal_scikit_learn():
    truth, predicted = random_bins(0)
    confusion = confusion_matrix(truth, predicted)
    assert confusion == oracle_confusion(truth.numpy(), predicted.numpy()).tolist()
    assert split_metrics(confusion) == {
        "accuracy": pytest.approx(accuracy_score(truth, predicted), abs=1e-14),
        "balanced_accuracy": pytest.approx(balanced_accuracy_score(truth, predicted), abs=1e-14),
        "non_slip_recall": pytest.approx(recall_score(truth, predicted, pos_label=False)),
        "slip_recall": pytest.approx(recall_score(truth, predicted, pos_label=True)),
        "confusion": confusion,
        "num_bins": 500,
    }


def test_groups_are_scores_of_their_own_bins():
    truth, predicted = random_bins(1)
    materials = [("iron", "ABS", "wood")[i * i % 7 % 3] for i in range(500)]
    speeds = [60.0, 40.0, 20.0, 100.0] * 125
    places = [None if i % 10 == 0 else i * 7 % 60 - 30 for i in range(500)]
    scores = bin_metrics(truth, predicted, materials, speeds, ["paper"] * 500, places)
    assert list(scores["per_material"]) == list(dict.fromkeys(materials))
    assert list(scores["per_speed"]) == ["20", "40", "60", "100"]
    for kind, given in (("per_material", materials), ("per_speed", [f"{s:g}" for s in speeds])):
        for name, found in scores[kind].items():
            rows = torch.tensor([label == name for label in given])
            assert found == split_metrics(confusion_matrix(truth[rows], predicted[rows]))
    bounds = {"<-20": (-99, -20), "20+": (20, 99)} | {str(p): (p, p + 1) for p in range(-20, 20)}
    for name, found in scores["per_position"].items():
        rows = [i for i, p in enumerate(places) if p is not None and p in range(*bounds[name])]
        assert found["num_bins"] == len(rows)
        assert found["num_right"] == int((truth == predicted)[rows].sum())
        assert found["recall"] == found["num_right"] / found["num_bins"]
    assert list(scores["per_position"]) == [name for name in ("<-20", *map(str, range(-20, 20)),
                                            "20+") if name in scores["per_position"]]  # fmt: skip
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    assert not {"per_scene", "per_position"} & set(bin_metrics(truth, predicted, materials, speeds))


@pytest.mark.parametrize("scenes", ["ppp ppp", "ppt ptt", "ppt ttt"])
def test_folds_merged_count_the_scenes_that_all_bins_together_would(scenes):
    """Of several kinds of scenes, tables of materials count the paper's alone, in folds as well."""
    names = {"p": "paper", "t": "taps"}
    of_fold, whole = [], ([], [], [], [])
    for seed, kinds in enumerate(scenes.split()):
        truth, predicted = random_bins(seed, 60)
        materials = ["iron" if i % 4 else "wood" for i in range(60)]
        own = [names[kinds[i % 3]] for i in range(60)]
        of_fold.append(bin_metrics(truth, predicted, materials, [20.0] * 60, own))
        for part, new in zip(whole, (truth, predicted, materials, own), strict=True):
            part.extend(new.tolist() if isinstance(new, torch.Tensor) else new)
    truth, predicted, materials, own = whole
    together = bin_metrics(
        torch.tensor(truth), torch.tensor(predicted), materials, [20.0] * 120, own
    )
    for number, scores in enumerate(of_fold):
        scores["num_not_valid"] = 3 + number
    assert merged_metrics(of_fold) == together | {"num_not_valid": 7}


@pytest.mark.parametrize("slip", [True, False])
def test_a_class_without_bins_has_no_recall(slip):
    scores = split_metrics(confusion_matrix(torch.full((8,), slip), torch.arange(8) < 6))
    present, absent = ("slip", "non_slip") if slip else ("non_slip", "slip")
    assert scores[f"{absent}_recall"] is scores["balanced_accuracy"] is None
    assert scores[f"{present}_recall"] == scores["accuracy"] == (0.75 if slip else 0.25)
    nothing = torch.zeros(0, dtype=torch.bool)
    empty = bin_metrics(nothing, nothing, [], [])
    assert (empty["confusion"], empty["accuracy"], empty["num_bins"]) == ([[0, 0], [0, 0]], None, 0)


FOUR = torch.tensor([True, False, True, True])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: confusion_matrix(FOUR, FOUR.float()), r"is_slip_predicted must be \[N\] bool.*fl"),
        (lambda: confusion_matrix(FOUR, FOUR[:3]), "got 4 and 3 bins"),
        (lambda: bin_metrics(FOUR, FOUR, ["a"], [2.0] * 4), "materials must have one.*, 4, got 1"),
        (lambda: bin_metrics(FOUR, FOUR, ["a"] * 4, [2.0]), "speeds_mm_s must have one.*, 4, got"),
        (lambda: bin_metrics(FOUR, FOUR, "abcd", [2] * 4, ["s"]), "scenes must have one.*got 1"),
        (lambda: bin_metrics(FOUR, FOUR, "abcd", [2] * 4, None, []), "positions must have.*got 0"),
        (lambda: weights_at_share(FOUR[2:], 0.5), "bins of slip and of non-slip"),
        (lambda: weights_at_share(FOUR, 0.0), "slip_share must lie between 0 and 1"),
    ],
)  # fmt: skip
def test_wrong_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# Weights ---------------------------------------------------------------------------------------


def test_weights_bring_bins_to_the_balance_of_a_stream(rng):
    """Probabilities that are right at 5 % slip are right on bins of 70 %, weighted so."""
    gap, share = 2.0, 0.05

    def stated(of_slip):
        is_slip = rng.uniform(size=60_000) < of_slip
        score = gap * is_slip + rng.normal(size=60_000)
        odds = np.exp(gap * score - gap**2 / 2) * share / (1 - share)  # two Gaussians
        return torch.from_numpy(odds / (1 + odds)), torch.from_numpy(is_slip)

    p, is_slip = stated(0.7)
    weights = weights_at_share(is_slip, share)
    assert weights.mean() == pytest.approx(1)
    assert weights[is_slip].sum() / weights.sum() == pytest.approx(share)
    assert len(weights.unique()) == 2
    weighted = reliability(p, is_slip, weights=weights)
    assert weighted["ece"] < 0.01
    assert weighted["brier"] == pytest.approx(reliability(*stated(share))["brier"], abs=0.005)
    assert reliability(p, is_slip)["ece"] > 0.2
