"""The self-check of bin graphs: every kind of wrong one is refused, a right one is not."""

import copy

import numpy as np
import pytest
import torch
from small_detector import HAND, alarming_detector, raw_bins, small_detector
from torch.nn.functional import pad

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.graph.bin_check import Judged, check_bins
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.trials import KINDS, degenerate_bins, noise_bins
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.signals.filtering import ChannelFilter

pytestmark = pytest.mark.onnx

SINGLE = Form("float32")


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


# A bin graph that is torch, and what may be wrong with it -------------------------------------


def bin_run(detector, change=lambda samples, out: out):
    """What a right bin graph in float32 gives, changed; ``change`` sees the samples."""
    single = copy.deepcopy(detector).float()
    window, settings = Window.of(detector), AlarmSettings.of(detector)
    before = detector.context_before - window.before
    after = detector.context_after - window.after

    def run(inputs):
        samples = torch.from_numpy(inputs["samples"])
        dead = torch.from_numpy(inputs["masked_channels"]) if "masked_channels" in inputs else None
        with torch.no_grad():
            score, is_valid, *_ = single.predict_raw(
                pad(samples, (before, after)), masked_channels=dead
            )
        stated = probability(settings.calibration.llr(score), settings.slip_share)
        out = {"score": score.numpy(), "probability": stated.numpy(), "valid": is_valid.numpy()}
        return change(samples, out)

    return run


def test_a_right_bin_graph_passes_and_is_measured(detector):
    facts = check_bins(bin_run(detector), detector, SINGLE)
    assert facts["simulated"] is True
    assert facts["score_sd"] > 0
    assert (facts["noise"]["bins"], facts["simulated_slip"]["bins"]) == (64, 256)
    for name in ("noise", "simulated_slip"):
        assert 0 < facts[name]["worst_sd"] < 1e-3
    assert set(facts["degenerate"]) == set(KINDS)
    assert [found["valid"] for found in facts["dead"].values()] == [0, 0, 0]
    assert facts["degenerate"]["constant"]["valid"] == 0
    assert facts["degenerate"]["ramp"]["valid"] == facts["degenerate"]["ramp"]["bins"] == 16
    assert facts["degenerate"]["plain"]["decided_by_rounding"] == 0


def at(is_there, **values):
    """Other outputs on bins that a predicate ``[B]`` of their samples picks."""

    def change(samples, out):
        mask = is_there(samples).numpy()
        for name, value in values.items():
            column = out[name].copy()
            column[mask] = value
            out = out | {name: column}
        return out

    return change


def one_bin(samples):
    return torch.arange(len(samples)) == 3


def constant(samples):
    return (samples == samples[..., :1]).all(-1).all(-1)


def holds_nan(samples):
    return samples.isnan().any(-1).any(-1)


def behind_nan(samples):
    """Whole bins in one batch with broken ones."""
    return ~holds_nan(samples) & holds_nan(samples).any()


def huge(samples):
    return (samples.abs() > 1e20).any(-1).any(-1)


def renamed(samples, out):
    return {"scores" if name == "score" else name: value for name, value in out.items()}


def widened(samples, out):
    return out | {"score": out["score"].astype(np.float64)}


def frozen(samples, out):
    """One batch size, whatever came."""
    return {name: np.resize(value, 7) for name, value in out.items()}


def mixed_up(samples, out):
    return out | {"score": out["score"][::-1]}


WRONG_BINS = {
    "another name": (
        renamed,
        r"it gives .*scores float32\[256\].*, expected .*score float32\[256\]",
    ),
    "another dtype": (widened, r"it gives .*score float64.*, expected .*score float32"),
    "frozen batch": (frozen, r"it gives .*\[7\].*, expected .*\[256\]"),
    "rows mixed up": (mixed_up, "scores differ from torch in float64"),
    "one score off": (at(one_bin, score=0.123), "scores differ from torch in float64"),
    "one flag wrong": (at(one_bin, valid=False), "valid differs from torch on 1 of 256 bins"),
    "one probability": (at(one_bin, probability=2.0), "probability is .* off that of its score"),
    "trusts the dead": (at(constant, valid=True), r"\(constant\): valid differs from torch on 16"),
    "nan of constants": (at(constant, score=np.nan), r"\(constant\): 16 scores are not finite"),
    "nan of nan": (at(holds_nan, score=np.nan), r"\(nan\): 16 scores are not finite"),
    "trusts the torn": (at(holds_nan, valid=True), r"\(nan\): valid differs"),
    "overflows": (at(huge, score=np.inf), r"\(huge\): 16 scores are not finite"),
    "one breaks others": (at(behind_nan, score=0.123), "simulated bins behind degenerate ones"),
}


@pytest.mark.parametrize("name", WRONG_BINS)
def test_a_wrong_bin_graph_is_refused(detector, name):
    change, message = WRONG_BINS[name]
    with pytest.raises(ValueError, match=message) as caught:
        check_bins(bin_run(detector, change), detector, SINGLE)
    assert "\n" not in str(caught.value)


def test_what_float32_may_float64_may_not(detector):
    def in_double(inputs):
        out = bin_run(detector)({"samples": inputs["samples"].astype(np.float32)})
        return {name: x.astype(np.float64) if x.dtype != bool else x for name, x in out.items()}

    with pytest.raises(ValueError, match="more than 1e-09"):
        check_bins(in_double, detector, Form("float64"))


def test_a_probability_comes_only_of_a_calibration(detector):
    plain = small_detector(backend="auto")
    with pytest.raises(ValueError, match="it gives probability"):
        check_bins(bin_run(detector), plain, SINGLE)

    def bare(samples, out):
        return {name: out[name] for name in ("score", "valid")}

    check_bins(bin_run(detector, bare), plain, SINGLE)
    with pytest.raises(ValueError, match="expected probability"):
        check_bins(bin_run(detector, bare), detector, SINGLE)


# What rounding decides ------------------------------------------------------------------------


def detector_of(feature):
    """Its score is one scaled feature."""
    pool, channel_filter = FeaturePool(HAND), ChannelFilter([51, 51, 11, 11])
    place = [str(name) for name in pool.names].index(feature)
    scaler = FeatureScaler.fit(pool(channel_filter.valid(raw_bins(64)))[:, [place]])
    one, zero = torch.ones(1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    head = QuadraticForm(zero, one, zero[0, 0])
    return SlipDetector(pool, channel_filter, [place], scaler, head, {"simulated": True})


def test_rounding_decides_where_it_moves_a_score():
    """Of a vibration of 1e-12 of its offset few digits are left: levels of entropy change."""
    judged = Judged(None, detector_of("PVDF1 D3 time entropy"), Form("float64"))
    kind, precision = "offset 1e6, vibration 1e-6", torch.float64
    bins = degenerate_bins(HAND, kind, 200, judged.window.length, precision)
    exact = judged.exact(bins).score.numpy()
    other = judged.exact(bins, judged.others[0]).score.numpy()
    is_rounding = judged.is_rounding(bins, exact, 1e-2)
    assert is_rounding.mean() > 0.5
    assert is_rounding[np.abs(other - exact) > 1e-2].all()
    noise = noise_bins(HAND, 50, judged.window.length, 0, precision)
    assert not judged.is_rounding(noise, judged.exact(noise).score.numpy(), 1e-6).any()
