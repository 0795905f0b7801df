"""``certificate.py``: what it measures against the pipeline itself, and what makes it hold."""

import copy
import json
import math

import numpy as np
import pytest
import torch
from small_detector import NUM_FEATURES, raw_bins, small_detector

from tactslip_torch.certificate import FACTOR, INSIDE_SHARE, WORST_SD, certify, compare
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.rounding import rounding_bound
from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins


class Lying(QuadraticForm):
    """Its float32 score has the other sign where the first feature is above ``threshold``."""

    threshold = 0.0

    def forward(self, z):
        score = super().forward(z)
        lies = (z[..., 0] > self.threshold) & (z.dtype == torch.float32)
        return torch.where(lies, -score, score)


def lying_detector(threshold):
    detector = small_detector()
    head = detector.head
    detector.head = Lying(head.quadratic, head.linear, head.constant)
    detector.head.threshold = threshold
    return detector


def named(certificate, name):
    (row,) = [row for row in certificate.facts()["conditions"] if row["name"] == name]
    return row


def certified(detector, num_bins=48, held_out=None, **options):
    options = {"simulated": True, "extremes": 6} | options
    return certify(detector, raw_bins(num_bins), held_out, **options)


# Comparison ------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", ["quadratic", "sum"])
@pytest.mark.parametrize("arithmetic", ["double", "native"])
def test_both_scores_are_those_of_the_pipelines(head, arithmetic):
    detector, samples = small_detector(head=head, arithmetic=arithmetic), raw_bins(16)
    samples[3] = 2.0  # dead sensors
    compared = compare(detector, samples)
    single = copy.deepcopy(detector).float()
    with torch.no_grad():
        assert torch.equal(compared.exact, detector.score_raw(samples))
        rounded = single.score_raw(samples.float())
        judged = single.judge_raw(samples.float())
    assert rounded.dtype == torch.float32
    assert torch.equal(compared.rounded, rounded.double())
    assert torch.equal(compared.error, (rounded.double() - compared.exact).abs())
    assert torch.equal(compared.is_valid, judged.is_valid)
    assert compared.is_valid.sum() == 15
    assert torch.equal(compared.flips, (rounded >= 0) != (compared.exact >= 0))
    total = sum(compared.stages.values())
    torch.testing.assert_close(total, compared.rounded - compared.exact, rtol=0, atol=1e-12)


def test_an_error_is_laid_to_the_stage_that_makes_it():
    samples = raw_bins(32).float()
    double, native = (compare(small_detector(arithmetic=a), samples) for a in ("double", "native"))
    assert double.stages["features"].abs().max() == 0
    assert native.stages["features"].abs().max() > 1e-7
    detector = lying_detector(-2.0)  # whatever the feature
    lied = compare(detector, samples)
    torch.testing.assert_close(lied.stages["head"], -2 * lied.exact, rtol=1e-4, atol=1e-5)
    assert lied.flips.all()


def test_scaled_features_and_their_errors():
    detector, samples = small_detector(arithmetic="native"), raw_bins(20)
    compared = compare(detector, samples)
    with torch.no_grad():
        filtered = detector.channel_filter.valid(samples)
        scaled = detector.scaler(detector.pool(filtered)[:, list(detector.selected)])
        coarse = detector.channel_filter.valid(samples.float())
        features = detector.pool(coarse)[:, list(detector.selected)]
        rounded = detector.scaler(features.double()).float()
    torch.testing.assert_close(compared.scaled, scaled, rtol=0, atol=1e-12)
    torch.testing.assert_close(
        compared.scaled_error, (rounded.double() - scaled).abs(), rtol=0, atol=3e-7
    )
    assert compared.scaled_error.shape == (20, NUM_FEATURES)


def test_bins_do_not_depend_on_their_number():
    detector, samples = small_detector(), raw_bins(37)
    whole, part = compare(detector, samples), compare(detector, samples[32:])
    torch.testing.assert_close(whole.exact[32:], part.exact, rtol=1e-12, atol=1e-12)
    assert torch.equal(whole.covers.low_v, samples.amin(-1))
    assert torch.equal(whole.covers.high_v, samples.amax(-1))


def test_neither_detector_nor_samples_change():
    detector, samples = small_detector(), raw_bins(5)
    before, state = samples.clone(), copy.deepcopy(detector.state_dict())
    certify(detector, samples, simulated=False, extremes=2)
    assert torch.equal(samples, before)
    for name, value in detector.state_dict().items():
        assert torch.equal(value, state[name])
        assert value.dtype == state[name].dtype


# Certificate -----------------------------------------------------------------------------------


def test_the_numbers_are_those_of_the_errors():
    detector, held_out = small_detector(arithmetic="native"), raw_bins(30, seed=5)
    found = certified(detector, held_out={"test": held_out})
    facts = found.facts()
    with torch.no_grad():
        exact = {n: detector.score_raw(b).numpy() for n, b in bins_of(held_out).items()}
        single = copy.deepcopy(detector).float()
        rounded = {
            n: single.score_raw(b.float()).double().numpy() for n, b in bins_of(held_out).items()
        }
    sd = np.std(exact["calibration"], ddof=1)
    worst = np.abs(rounded["calibration"] - exact["calibration"]).max()
    margin = rounding_bound(detector.head).error + FACTOR * worst
    assert facts["score_sd"] == pytest.approx(sd, rel=1e-12)
    assert facts["margin"]["score"] == pytest.approx(margin, rel=1e-12)
    assert facts["margin"]["sd"] == pytest.approx(margin / sd, rel=1e-12)
    for name, row in facts["sets"].items():
        error = np.abs(rounded[name] - exact[name])
        assert row["bins"] == len(error)
        assert row["error"]["worst"] == error.max()
        assert row["error"]["median"] == np.quantile(error, 0.5, method="higher")
        assert row["error"]["p99"] == np.quantile(error, 0.99, method="higher")
        assert row["error"]["worst_sd"] == pytest.approx(error.max() / sd, rel=1e-12)
        assert row["inside_margin"]["bins"] == (np.abs(exact[name]) <= margin).sum()
        assert row["outside_range"] == (0 if name == "calibration" else row["outside_range"])


def bins_of(held_out):
    return {"calibration": raw_bins(48), "test": held_out}


def test_a_sound_detector_holds():
    found = certified(small_detector(), held_out={"test": raw_bins(40, seed=7)})
    assert found.holds
    assert [row["holds"] for row in found.facts()["conditions"]] == [True] * 8
    json.dumps(found.facts(), allow_nan=False)


def test_held_out_bins_and_extremes_set_nothing():
    detector = small_detector()
    one = certified(detector).facts()
    other = certified(detector, held_out={"x": raw_bins(9, 3, offset=50.0)}, extremes=2).facts()
    for part in ("margin", "head", "score_sd", "range", "condition_numbers"):
        assert one[part] == other[part]
    assert other["sets"]["x"]["outside_range"] == 9


def test_the_same_seed_gives_the_same_facts():
    detector = small_detector()
    assert certified(detector).facts() == certified(detector).facts()
    assert certified(detector).facts() != certified(detector, seed=1).facts()


def test_extremes_are_judged_by_kind_and_flagged_as_the_pipeline_flags_them():
    detector = small_detector()
    found = certified(detector, seed=4)
    single = copy.deepcopy(detector).float()
    generator = torch.Generator().manual_seed(4)
    assert list(found.facts()["extremes"]) == list(EXTREMES)
    for kind, row in found.facts()["extremes"].items():
        drawn = extreme_bins(kind, (6, 4, 150), generator, torch.float32)
        with torch.no_grad():
            judged = single.judge_raw(drawn)
            error = (judged.score.double() - detector.score_raw(drawn.double())).abs()
        assert row["bins"] == 6
        assert row["invalid"] == int((~judged.is_valid).sum())
        assert row["error"]["worst"] == float(error.max())
        of_valid = error[judged.is_valid]
        assert row["error_of_valid"]["worst"] == (float(of_valid.max()) if len(of_valid) else None)
    flagged = {kind for kind, row in found.facts()["extremes"].items() if row["invalid"] == 6}
    assert {"constant", "zero", "offset 1e6, vibration 1e-6"} <= flagged
    assert not flagged & {"plain", "rails", "integers"}


def test_held_out_bins_that_turn_refute():
    """The lie is met beyond what calibration bins reach alone."""
    samples = raw_bins(200)
    detector = small_detector()
    first = compare(detector, samples).scaled[:, 0]
    known, new = samples[first <= 0], samples[first > 0]
    assert min(len(known), len(new)) > 5
    liar = lying_detector(0.0)
    found = certify(liar, known, {"test": new}, simulated=True, extremes=2)
    row = found.facts()["sets"]["test"]
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
    return found.facts()["margin"]["score"]


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
    facts = certified(small_detector(head="sum")).facts()
    assert facts["head"]["bound"] is None
    assert "no bound for this head" in facts["head"]["note"]
    worst = facts["sets"]["calibration"]["error"]["worst"]
    assert facts["margin"]["score"] == FACTOR * worst
    assert facts["conditions"][0]["holds"] is None
    assert facts["holds"]


def test_a_head_that_overflows_does_not_hold():
    found = certified(small_detector(gain=1e39))
    facts = found.facts()
    assert facts["head"]["overflows"]
    assert facts["margin"]["score"] == math.inf
    silent = sum(int((~c.rounded.isfinite()).sum()) for c in kinds_of(found))
    assert named(found, "extremes: scores that are not finite")["found"] == silent > 0
    assert named(found, "extremes: scores that are not finite")["holds"] is False
    assert facts["conditions"][0]["holds"] is False
    assert not found.holds


def test_condition_numbers_are_those_of_finite_differences():
    detector, samples = small_detector(), raw_bins(7)
    detector.info["solve"] = {"condition": 12.5, "method": "Cholesky"}
    numbers = certify(detector, samples, simulated=True, extremes=1).facts()["condition_numbers"]
    assert numbers["solve"] == {"condition": 12.5, "method": "Cholesky"}
    scaled = compare(detector, samples).scaled
    norms = []
    for z in scaled:
        steps = 1e-6 * torch.eye(NUM_FEATURES, dtype=torch.float64)
        rises = (detector.head(z + steps) - detector.head(z - steps)) / 2e-6
        norms.append(float(rises.square().sum().sqrt()))
    found = numbers["score"]["per_scaled_feature"]
    assert found["largest"] == pytest.approx(max(norms), rel=1e-6)
    assert found["median"] == pytest.approx(np.median(norms), rel=1e-6)
    assert numbers["score"]["per_volt"]["bins"] == found["bins"] == 7
    assert certified(small_detector()).facts()["condition_numbers"]["solve"] == "not recorded"


def test_the_size_per_volt_is_the_steepest_rise():
    """A step along the gradient raises the score by its norm."""
    detector, samples = small_detector(), raw_bins(1)
    given = samples.clone().requires_grad_()
    (slope,) = torch.autograd.grad(detector.score_raw(given).sum(), given)
    step = 1e-7 * slope / slope.norm()
    with torch.no_grad():
        rise = detector.score_raw(samples + step) - detector.score_raw(samples - step)
    bins = torch.cat([samples, raw_bins(1, seed=4)])
    numbers = certify(detector, bins, simulated=True, extremes=1).facts()["condition_numbers"]
    sizes = numbers["score"]["per_volt"]
    candidates = (sizes["largest"], sizes["median"])  # of two bins, the median is the smaller
    assert min(abs(c / (float(rise) / 2e-7) - 1) for c in candidates) < 1e-3


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
