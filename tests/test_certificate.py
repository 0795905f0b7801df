"""``certificate.py``: what it measures against the pipeline itself, and what makes it hold."""

import copy

import numpy as np
import pytest
import torch
from small_detector import NUM_FEATURES, certified, lying_detector, raw_bins, small_detector

from tactslip_torch.analysis.certificate import FACTOR, certify, compare
from tactslip_torch.model.rounding import rounding_bound
from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins

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
        expected = single.predict_raw(samples.float())
    assert rounded.dtype == torch.float32
    assert torch.equal(compared.rounded, rounded.double())
    assert torch.equal(compared.error, (rounded.double() - compared.exact).abs())
    assert torch.equal(compared.is_valid, expected.is_valid)
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
    facts = found.content
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
        assert row["outside_range"] == outside_range(detector, bins_of(held_out)[name])
    assert facts["sets"]["calibration"]["outside_range"] == 0
    assert 0 < facts["sets"]["test"]["outside_range"] < 30


def outside_range(detector, bins):
    """Bins with a channel in use outside what all calibration channels of its kind cover."""
    ranges = {}
    for which, samples in (("known", raw_bins(48)), ("own", bins)):
        filtered = detector.channel_filter.valid(samples).numpy()
        span, raw = np.ptp(filtered, axis=-1), samples.numpy()
        relative = span / np.abs(filtered).max(-1)
        ranges[which] = np.stack([raw.min(-1), -raw.max(-1), span, relative])  # none may be less
    used = {name.channel for name in detector.selected_names}
    is_out = np.zeros(len(bins), dtype=bool)
    for kind in ("SG", "PVDF"):
        places = [i for i, c in enumerate(detector.pool.hand.channels) if c.kind == kind]
        least = ranges["known"][:, :, places].min((1, 2))
        for place in places:
            if detector.pool.hand.names[place] in used:
                is_out |= (ranges["own"][:, :, place] < least[:, None]).any(0)
    return is_out.sum()


def bins_of(held_out):
    return {"calibration": raw_bins(48), "test": held_out}


def test_held_out_bins_and_extremes_set_nothing():
    detector = small_detector()
    one = certified(detector).content
    other = certified(detector, held_out={"x": raw_bins(9, 3, offset=50.0)}, extremes=2).content
    for part in ("margin", "head", "score_sd", "range", "condition_numbers"):
        assert one[part] == other[part]
    assert other["sets"]["x"]["outside_range"] == 9


def test_extremes_are_scored_by_kind_and_flagged_as_the_pipeline_flags_them():
    detector = small_detector()
    found = certified(detector, seed=4)
    single = copy.deepcopy(detector).float()
    generator = torch.Generator().manual_seed(4)
    assert list(found.content["extremes"]) == list(EXTREMES)
    for kind, row in found.content["extremes"].items():
        drawn = extreme_bins(kind, (6, 4, 150), generator, torch.float32)
        with torch.no_grad():
            expected = single.predict_raw(drawn)
            error = (expected.score.double() - detector.score_raw(drawn.double())).abs()
        assert row["bins"] == 6
        assert row["invalid"] == int((~expected.is_valid).sum())
        assert row["error"]["worst"] == float(error.max())
        of_valid = error[expected.is_valid]
        assert row["error_of_valid"]["worst"] == (float(of_valid.max()) if len(of_valid) else None)
    flagged = {kind for kind, row in found.content["extremes"].items() if row["invalid"] == 6}
    assert {"constant", "zero", "offset 1e6, vibration 1e-6"} <= flagged
    assert not flagged & {"plain", "rails", "integers"}


def test_a_spike_is_flagged_where_the_filter_leaves_none_of_it():
    """As the note of the page has it."""
    detector = small_detector()
    spikes = extreme_bins("spike", (60, 4, 150), torch.Generator().manual_seed(0), torch.float32)
    filtered = detector.channel_filter.valid(spikes.double()).numpy()
    used = {name.channel for name in detector.selected_names}
    places = [i for i, name in enumerate(detector.pool.hand.names) if name in used]
    is_gone = (filtered[:, places] == 0).all(-1).any(-1)
    assert 0 < is_gone.sum() < 60
    assert (~compare(detector, spikes).is_valid.numpy() == is_gone).all()


def test_condition_numbers_are_those_of_finite_differences():
    detector, samples = small_detector(), raw_bins(7)
    detector.info["solve"] = {"condition": 12.5, "method": "Cholesky"}
    numbers = certify(detector, samples, simulated=True, extremes=1).content["condition_numbers"]
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
    assert certified(small_detector()).content["condition_numbers"]["solve"] == "not recorded"
