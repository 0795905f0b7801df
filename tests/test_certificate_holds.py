"""``certificate.py``: what makes a certificate hold, what refutes it, and what it refuses."""

import json
import math

import pytest
import torch
from small_detector import NUM_FEATURES, certified, lying_detector, raw_bins, small_detector

from tactslip_torch.analysis.certificate import (
    FACTOR,
    INSIDE_SHARE,
    LARGEST_RATIO,
    WORST_SD,
    certify,
    compare,
)
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.simulation.extremes import EXTREMES


def named(certificate, name):
    (row,) = [row for row in certificate.content["conditions"] if row["name"] == name]
    return row


def test_a_sound_detector_holds():
    found = certified(small_detector(), held_out={"test": raw_bins(40, seed=7)})
    assert found.holds
    assert [row["holds"] for row in found.content["conditions"]] == [True] * 9
    json.dumps(found.content, allow_nan=False)


def test_held_out_bins_that_turn_refute():
    """The lie is met beyond what calibration bins reach alone."""
    samples = raw_bins(200)
    detector = small_detector()
    first = compare(detector, samples).scaled[:, 0]
    known, new = samples[first <= 0], samples[first > 0]
    assert min(len(known), len(new)) > 5
    liar = lying_detector(0.0)
    found = certify(liar, known, {"test": new}, simulated=True, extremes=2)
    row = found.content["sets"]["test"]
    exact = liar.score_raw(new).detach().abs()
    assert row["flips"]["outside_margin"] == int((exact > row_margin(found)).sum()) > 0
    assert not found.holds
    assert named(found, "test: flips outside the margin")["holds"] is False
    assert named(found, "test: worst error, sd")["holds"] is False
    assert named(found, "calibration: flips outside the margin")["holds"] is True
    turned = [c.flips & c.is_valid & (c.exact.abs() > row_margin(found)) for c in kinds_of(found)]
    of_extremes = named(found, "valid extremes: flips outside the margin")
    assert of_extremes["found"] == int(torch.cat(turned).sum()) > 0
    assert of_extremes["holds"] is False


def kinds_of(found):
    return [found.sets[kind] for kind in EXTREMES]


def row_margin(found):
    return found.content["margin"]["score"]


def test_a_margin_that_swallows_the_scores_does_not_hold():
    found = certified(lying_detector(-2.0), held_out={"test": raw_bins(30, seed=2)})
    share = named(found, "test: share inside the margin")
    assert share["found"] == 1.0 >= INSIDE_SHARE
    assert share["holds"] is False


def test_errors_beyond_the_limit_do_not_hold():
    """In float32 throughout, a vibration on an offset loses its digits."""
    bins = raw_bins(48, offset=1e4)
    fine, coarse = (
        certify(small_detector(arithmetic=a), bins.float(), simulated=True, extremes=2)
        for a in ("double", "native")
    )
    name = "calibration: worst error, sd"
    assert named(fine, name)["found"] <= WORST_SD
    assert named(coarse, name)["found"] > WORST_SD
    assert (fine.holds, coarse.holds) == (True, False)


def test_a_kernel_sum_has_no_bound_and_says_so():
    facts = certified(small_detector(head="sum")).content
    assert facts["head"]["bound"] is None
    assert "no bound for this head" in facts["head"]["note"]
    worst = facts["sets"]["calibration"]["error"]["worst"]
    assert facts["margin"]["score"] == FACTOR * worst
    assert facts["conditions"][0]["holds"] is None
    assert facts["holds"]


def test_a_head_that_overflows_does_not_hold():
    found = certified(small_detector(gain=1e39))
    facts = found.content
    assert facts["head"]["overflows"]
    assert facts["margin"]["score"] == math.inf
    silent = sum(int((~c.rounded.isfinite()).sum()) for c in kinds_of(found))
    assert named(found, "extremes: scores that are not finite")["found"] == silent > 0
    assert named(found, "extremes: scores that are not finite")["holds"] is False
    assert facts["conditions"][0]["holds"] is False
    assert not found.holds


@pytest.mark.parametrize(
    ("bins", "message"),
    [
        (torch.zeros(0, 4, 150), "expected calibration .* at least one, got"),
        (torch.zeros(4, 150), "expected calibration"),
        (torch.full((2, 4, 150), math.nan), "bin 0, channel SG1, sample 0 is nan"),
        (raw_bins(1), "1 calibration bins have scores of standard deviation 0; give more bins"),
        (torch.zeros(3, 4, 150), "3 calibration bins have scores of standard deviation 0"),
    ],
)
def test_what_cannot_calibrate_is_refused(bins, message):
    with pytest.raises(ValueError, match=message):
        certify(small_detector(), bins, simulated=True, extremes=1)


def test_a_bound_far_above_the_worst_seen_does_not_hold():
    """So near 0 the bound is of underflow alone, which hardly any float32 sum meets."""
    found = certified(small_detector(gain=1e-40))
    head, row = found.content["head"], named(found, "bound of the head / worst seen")
    assert row["found"] == head["bound"] / head["worst_seen"] > LARGEST_RATIO
    assert row["wanted"] == "<= 10000"
    assert row["holds"] is False
    assert not found.holds


@pytest.mark.parametrize("head", ["sum", "exact"])
def test_the_ratio_is_open_without_a_bound_or_an_error_seen(head):
    detector = small_detector(head="sum")
    if head == "exact":  # the score is the first feature, and float32 changes nothing
        zero = torch.zeros(NUM_FEATURES, NUM_FEATURES, dtype=torch.float64)
        detector.head = QuadraticForm(zero, zero[0].index_fill(0, torch.tensor(0), 1.0), zero[0, 0])
    found = certified(detector)
    assert found.content["head"]["worst_seen"] == (0 if head == "exact" else None)
    row = named(found, "bound of the head / worst seen")
    assert (row["found"], row["holds"]) == (None, None)


@pytest.mark.parametrize("name", ["calibration", "plain", "huge"])
def test_a_held_out_set_does_not_replace_one_of_ours(name):
    with pytest.raises(ValueError, match=f"held-out set may not be named '{name}'"):
        certified(small_detector(), held_out={"test": raw_bins(2), name: raw_bins(2)})


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("constant", math.nan, "scores of 8 of 8 calibration bins are not finite in float64; "),
        ("quadratic", math.inf, "scores of 8 of 8 .* the head is broken, fit it again"),
        ("quadratic", 1e200, "8 .* scores of standard deviation inf; scale the head down"),
    ],
)
def test_a_broken_head_is_told_from_too_few_bins(part, value, message):
    detector = small_detector()
    getattr(detector.head, part).mul_(value)
    with pytest.raises(ValueError, match=message):
        certified(detector, num_bins=8)
