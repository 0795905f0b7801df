"""Counts of answers, what is made of them, and how that is shown."""

from __future__ import annotations

import pytest
import torch
from PIL import Image

from tactslip_torch.report.metrics import (
    answer_counts,
    answer_metrics,
    covered_shares,
    merged_answers,
)
from tactslip_torch.report.results import answers_figure, answers_table

# truth by row (non-slip, slip), answer by column (unsure, non-slip, slip)
RECORDINGS = {
    "a/0": [[1, 3, 0], [2, 0, 2]],  # nothing wrong
    "a/1": [[0, 1, 1], [0, 1, 9]],  # half of non-slip, a tenth of slip
    "b/0": [[0, 0, 0], [1, 3, 0]],  # three quarters of slip; no non-slip
}


def metrics(**changes):
    found = {"unseen": answer_metrics(RECORDINGS, 0.8), "test": answer_metrics({}, 0.8)}
    return {"simulated": True, "answers": found} | changes


def test_counts_are_those_of_a_loop():
    generator = torch.Generator().manual_seed(0)
    is_slip = torch.rand(200, generator=generator) < 0.6
    answer = torch.randint(-1, 2, (200,), generator=generator, dtype=torch.int8)
    wanted = [[0, 0, 0], [0, 0, 0]]
    for truth, given in zip(is_slip.tolist(), answer.tolist(), strict=True):
        wanted[int(truth)][given + 1] += 1
    assert answer_counts(is_slip, answer) == wanted


def test_coverage_is_a_mean_over_recordings_that_have_the_class():
    found = answer_metrics(RECORDINGS, 0.8)
    slip, rest = found["slip"], found["non_slip"]
    assert slip["coverage"] == pytest.approx((1 + 0.9 + 0.25) / 3)
    assert rest["coverage"] == pytest.approx((1 + 0.5) / 2)
    assert (slip["num_recordings"], rest["num_recordings"]) == (3, 2)
    assert slip["reached"] == pytest.approx(2 / 3)
    assert rest["reached"] == pytest.approx(1 / 2)
    assert slip["unsure"] == pytest.approx(3 / 18)
    assert found["unsure"] == pytest.approx(4 / 24)
    assert found["sure_accuracy"] == pytest.approx((4 + 11) / 20)
    assert found["sure_balanced_accuracy"] == pytest.approx((4 / 5 + 11 / 15) / 2)
    assert found["counts"] == [[1, 4, 1], [3, 4, 11]]
    assert found["recordings"] == RECORDINGS


def test_a_share_of_exactly_what_was_asked_reaches_it():
    recordings = {str(i): [[0, 0, 0], [0, 1, 19]] for i in range(3)}
    assert answer_metrics(recordings, 0.95)["slip"]["reached"] == 1


def test_of_nothing_there_is_no_score():
    found = answer_metrics({}, 0.9)
    assert found["unsure"] is found["sure_accuracy"] is found["sure_balanced_accuracy"] is None
    assert found["slip"] == {"coverage": None, "reached": None, "unsure": None, "num_recordings": 0}
    all_unsure = answer_metrics({"a/0": [[4, 0, 0], [5, 0, 0]]}, 0.9)
    assert all_unsure["unsure"] == all_unsure["slip"]["coverage"] == 1
    assert all_unsure["sure_accuracy"] is None


def test_folds_are_pooled_by_recording():
    halves = [dict(list(RECORDINGS.items())[:2]), dict(list(RECORDINGS.items())[2:])]
    folds = {f"fold{i}": answer_metrics(half, 0.8) for i, half in enumerate(halves)}
    pooled, whole = merged_answers(folds), answer_metrics(RECORDINGS, 0.8)
    assert list(pooled["recordings"]) == ["fold0/a/0", "fold0/a/1", "fold1/b/0"]
    assert {**pooled, "recordings": None} == {**whole, "recordings": None}
    twice = merged_answers({"x": whole, "y": whole})
    assert twice["slip"]["num_recordings"] == 6
    assert merged_answers({"x": whole}) == whole


@pytest.mark.parametrize(
    ("is_slip", "answer", "message"),
    [
        (torch.ones(2, dtype=torch.bool), torch.ones(3), "of one N"),
        (torch.ones(2, dtype=torch.bool), torch.tensor([1, 2]), "answers are -1, 0 or 1"),
    ],
)
def test_what_are_no_answers_is_refused(is_slip, answer, message):
    with pytest.raises(ValueError, match=message):
        answer_counts(is_slip, answer)


def test_the_table_says_what_is_simulated_and_what_was_asked():
    lines = answers_table(metrics()).splitlines()
    assert lines[0].startswith("SIMULATED data")
    assert lines[2].split()[0] == "unseen"
    assert lines[2].split()[1:] == [
        *("16.67", "75.00", "76.67"),
        *("71.67", "66.67", "16.67", "75.00", "50.00", "16.67", "3"),
    ]
    assert set(lines[3].split()[1:-1]) == {"-"}
    assert lines[4].startswith("asked: 80 % covered")
    assert not answers_table(metrics(simulated=False)).startswith("SIMULATED")


def test_the_figure_is_drawn_of_roles_with_and_without_recordings(tmp_path):
    answers_figure(metrics(), tmp_path / "answers.png")
    with Image.open(tmp_path / "answers.png") as image:
        assert image.format == "PNG"
        assert image.width > 1000
    shares = covered_shares(torch.tensor(list(RECORDINGS.values())), 0)
    assert shares.tolist() == [1.0, 0.5]
