"""The certificate: what it measures against the pipeline itself, and what makes it hold."""

import copy
import json
import math

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from small_detector import HAND, NUM_FEATURES, certified, lying_detector, raw_bins, small_detector
from test_commands import TINY, composed, run_train

from tactslip_torch.analysis.certificate import (
    FACTOR,
    LARGEST_RATIO,
    MOST_MARGIN_SD,
    WORST_SD,
    certify,
    compare,
    pipelines,
)
from tactslip_torch.analysis.raw_bins import draw_bins
from tactslip_torch.deploy.check import EXTREMES
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.rounding import rounding_bound
from tactslip_torch.training.datamodule import FeatureMaker

# Certificate -----------------------------------------------------------------------------------


def test_the_numbers_are_those_of_the_errors():
    detector, held_out = small_detector(arithmetic="native"), raw_bins(30, seed=5)
    sets = {"calibration": raw_bins(48), "test": held_out}
    facts = certified(detector, held_out={"test": held_out}).content
    single = copy.deepcopy(detector).float()
    exact = {n: detector.predict_raw(b).score.detach().numpy() for n, b in sets.items()}
    rounded = {n: single.predict_raw(b.float()).score.double().detach() for n, b in sets.items()}
    errors = {n: np.abs(rounded[n].numpy() - exact[n]) for n in sets}
    sd = np.std(exact["calibration"], ddof=1)
    margin = rounding_bound(detector.head) + FACTOR * errors["calibration"].max()
    assert facts["score_sd"] == pytest.approx(sd, rel=1e-12)
    assert facts["margin"]["score"] == pytest.approx(margin, rel=1e-12)
    assert facts["margin"]["sd"] == pytest.approx(margin / sd, rel=1e-12)
    for name, row in facts["sets"].items():
        error = errors[name]
        assert row["bins"] == len(error)
        assert row["error"]["worst"] == error.max()
        assert row["error"]["median"] == np.quantile(error, 0.5, method="higher")
        assert row["error"]["p99"] == np.quantile(error, 0.99, method="higher")
        assert row["error"]["worst_sd"] == pytest.approx(error.max() / sd, rel=1e-12)
        assert row["inside_margin"]["bins"] == (np.abs(exact[name]) <= margin).sum()
        assert row["outside_range"] == outside_range(detector, sets[name])
    assert facts["sets"]["calibration"]["outside_range"] == 0
    raw = sets["calibration"].numpy()
    for kind in ("SG", "PVDF"):
        known, own = facts["range"]["kinds"][kind], raw[:, places_of(kind)]
        assert (known["low_v"], known["high_v"]) == (own.min(), own.max())
    assert list(facts["range"]["channels"]) == list(HAND.names)
    assert 0 < facts["sets"]["test"]["outside_range"] < 30


def places_of(kind):
    return [place for place, channel in enumerate(HAND.channels) if channel.kind == kind]


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
        least = ranges["known"][:, :, places_of(kind)].min((1, 2))
        for place in places_of(kind):
            if HAND.names[place] in used:
                is_out |= (ranges["own"][:, :, place] < least[:, None]).any(0)
    return is_out.sum()


def test_held_out_bins_and_extremes_set_nothing():
    detector = small_detector()
    one = certified(detector).content
    other = certified(detector, held_out={"x": raw_bins(9, 3, offset=50.0)}, extremes=2).content
    for part in ("margin", "head", "score_sd", "range", "condition_numbers"):
        assert one[part] == other[part]
    assert other["sets"]["x"]["outside_range"] == 9


def test_condition_numbers_are_those_of_finite_differences():
    detector, samples = small_detector(), raw_bins(7)
    detector.info["solve"] = {"condition": 12.5, "method": "Cholesky"}
    numbers = certify(detector, samples, simulated=True, extremes=1).content["condition_numbers"]
    assert numbers["solve"] == {"condition": 12.5, "method": "Cholesky"}
    scaled = compare(*pipelines(detector), samples).scaled
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


# What makes it hold ------------------------------------------------------------------------------
def named(certificate, name):
    (row,) = [row for row in certificate.content["conditions"] if row["name"] == name]
    return row


def test_a_sound_detector_holds():
    found = certified(small_detector(), held_out={"test": raw_bins(40, seed=7)})
    assert found.content["holds"]
    assert [row["holds"] for row in found.content["conditions"]] == [True] * 11
    json.dumps(found.content, allow_nan=False)


def test_held_out_bins_that_turn_refute():
    """The lie is met beyond what calibration bins reach alone."""
    samples = raw_bins(200)
    first = compare(*pipelines(small_detector()), samples).scaled[:, 0]
    known, new = samples[first <= 0], samples[first > 0]
    assert min(len(known), len(new)) > 5
    liar = lying_detector(0.0)
    found = certify(liar, known, {"test": new}, simulated=True, extremes=2)
    margin = found.content["margin"]["score"]
    exact = liar.predict_raw(new).score.detach().abs()
    num_turned = found.content["sets"]["test"]["flips"]["outside_margin"]
    assert num_turned == int((exact > margin).sum()) > 0
    assert not found.content["holds"]
    assert named(found, "test: flips outside the margin")["holds"] is False
    assert named(found, "test: worst error, sd")["holds"] is False
    assert named(found, "calibration: flips outside the margin")["holds"] is True
    kinds = [found.sets[kind] for kind in EXTREMES]
    turned = [c.flips & c.is_valid & (c.exact.abs() > margin) for c in kinds]
    of_extremes = named(found, "valid extremes: flips outside the margin")
    assert of_extremes["found"] == int(torch.cat(turned).sum()) > 0
    assert of_extremes["holds"] is False


def test_errors_beyond_the_limit_do_not_hold():
    """Volts of float32 lose the digits of a vibration on an offset, whatever they are made of."""
    fine, coarse = (
        certify(small_detector(), raw_bins(48, offset=offset).float(), simulated=True, extremes=2)
        for offset in (1e3, 2e4)
    )
    name = "calibration: worst error, sd"
    assert 1e-5 < named(fine, name)["found"] <= WORST_SD < named(coarse, name)["found"]
    assert (fine.content["holds"], coarse.content["holds"]) == (True, False)


@pytest.mark.parametrize("jumps", [False, True])
def test_a_margin_holds_where_float32_turns(jumps):
    found = certified(small_detector(2, jumps=jumps), 96, boundary=400).content
    margin, edge = found["margin"], found["boundary"]
    assert edge["valid_in_range"] > 300
    assert edge["flips"] > 100
    assert edge["outside_margin"] == 0
    assert (margin["sd"] <= MOST_MARGIN_SD) == (not jumps)
    assert bool(margin["jumping_columns"]) == jumps
    worst = edge["worst_margins"] * margin["score"]
    assert (worst > margin["score"] - margin["jump"]) == jumps  # so jumps have to be counted
    if jumps:
        row = next(row for row in found["conditions"] if row["name"] == "margin, sd")
        assert row["holds"] is False
        assert "train without mode, cv and entropy" in row["wanted"]


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["general", "robust"])
def test_a_trained_detector_does_not_turn_outside_its_margin(recipe, tmp_path):
    """1,000 bisected bins of each; only the default is steady enough for a small margin."""
    if recipe == "general":
        detector, told = SlipDetector.pretrained("paper24-sim"), ["+exp=quick"]
        assert detector.info["recipe"] == recipe
    else:
        told = [*TINY, "recipe=robust", "recipe.num_features=60", "baselines=false", "cache=off"]
        run_train(tmp_path, *told)
        detector = SlipDetector.load(tmp_path / "detector.pt")
    config = composed(*told)
    source = instantiate(config.data, _convert_="all")
    rule = instantiate(config.labels)
    maker = FeatureMaker(source, detector.pool, detector.channel_filter, rule)
    (fold,) = instantiate(config.split, _convert_="all")(source.ids)
    bins, *_ = draw_bins(maker, fold, "train", 200, 0)
    found = certify(detector, bins, simulated=True, extremes=2).content
    assert found["boundary"]["valid_in_range"] > 800
    assert found["boundary"]["outside_margin"] == 0
    assert (found["margin"]["sd"] < MOST_MARGIN_SD) == found["holds"] == (recipe == "general")


def test_a_kernel_sum_has_no_bound_and_says_so():
    found = certified(small_detector(head="sum"))
    facts = found.content
    assert facts["head"]["bound"] is None
    assert "no bound for this head" in facts["head"]["note"]
    worst = facts["sets"]["calibration"]["error"]["worst"]
    assert facts["margin"]["score"] == FACTOR * worst
    assert facts["conditions"][0]["holds"] is None
    ratio = named(found, "bound of the head / worst seen")
    assert (ratio["found"], ratio["holds"]) == (None, None)
    assert facts["holds"]


def test_a_head_that_overflows_does_not_hold():
    found = certified(small_detector(gain=1e39))
    facts = found.content
    assert facts["head"]["overflows"]
    assert facts["margin"]["score"] == math.inf
    kinds = [found.sets[kind] for kind in EXTREMES]
    silent = sum(int((c.is_enough & ~c.rounded.isfinite()).sum()) for c in kinds)
    row = named(found, "extremes: scores that are not finite")
    assert row["found"] == silent > 0
    assert facts["conditions"][0]["holds"] is row["holds"] is facts["holds"] is False


def test_a_bound_far_above_the_worst_seen_does_not_hold():
    """So near 0 the bound is of underflow alone, which hardly any float32 sum meets."""
    found = certified(small_detector(gain=1e-40))
    head, row = found.content["head"], named(found, "bound of the head / worst seen")
    assert row["found"] == head["bound"] / head["worst_seen"] > LARGEST_RATIO
    assert (row["wanted"], row["holds"], found.content["holds"]) == ("<= 10000", False, False)


REFUSED = [
    ({}, torch.zeros(0, 4, 150), {}, "expected calibration .* at least one, got"),
    ({}, torch.full((2, 4, 150), math.nan), {}, "bin 0, channel SG1, sample 0 is nan"),
    ({}, raw_bins(1), {}, "1 calibration bins have scores of standard deviation 0; give more"),
    ({}, raw_bins(8), {"plain": raw_bins(2)}, "held-out set may not be named 'plain'"),
    ({"constant": math.nan}, raw_bins(8), {}, "scores of 8 of 8 .* are not finite in float64"),
    ({"quadratic": 1e200}, raw_bins(8), {}, "8 .* deviation inf; scale the head down"),
]


@pytest.mark.parametrize(("broken", "bins", "held_out", "message"), REFUSED)
def test_what_cannot_be_certified_is_refused(broken, bins, held_out, message):
    detector = small_detector()
    for part, factor in broken.items():
        getattr(detector.head, part).mul_(factor)
    with pytest.raises(ValueError, match=message):
        certify(detector, bins, held_out, simulated=True, extremes=1)
