"""Gradients from the score and the alarm's statistic back to raw volts, through a fit as well.

Here: all of it at once, volt by volt to C, the kernel's c and weights of bins; along random
directions, which is quick. Parts have theirs in their own tests. The features in use are
those without steps: mode and entropy are left out by name.
"""

import pytest
import torch
from streams import detector_of, signal
from torch.autograd import gradcheck

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.fit import fit_quadratic
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import (
    AlarmSettings,
    Decider,
    is_usable,
    score_stream,
    stream_statistic,
)
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.signals.filtering import ChannelFilter

SAMPLES, HOP = 12, 4
HAND = HandLayout.from_rows(
    {"name": f"{kind}1", "kind": kind, "finger": "index", "segment": "distal"}
    for kind in ("SG", "PVDF")
)
POOL = FeaturePool(HAND, bin_samples=SAMPLES, level=1)
FILTER = ChannelFilter([5, 3])
IN_USE = (
    "SG1 raw time median",
    "SG1 raw time iqr",
    "SG1 raw time range",
    "SG1 raw time mean_deviation",
    "PVDF1 A1 time cv",
    "PVDF1 A1 time peak_factor",
    "PVDF1 D1 time kurtosis",
    "PVDF1 D1 time correlation",
    "PVDF1 D1 freq median",
    "PVDF1 A1 freq spectral_spread",
    "PVDF1 D1 freq band_energy_ratio",
)
SELECTED = [[str(name) for name in POOL.names].index(name) for name in IN_USE]
RULES = [Cusum(drift=-1.0, evidence=0.5), Cusum(drift=-0.5, evidence=0.4)]


# ------------------------------------------------------------------------------------ end to end
@pytest.fixture
def volts():
    generator = torch.Generator().manual_seed(0)
    raw = torch.randn(6, 2, SAMPLES + 2 * FILTER.context, generator=generator, dtype=torch.float64)
    stream = torch.randn(2, SAMPLES + 3 * HOP, generator=generator, dtype=torch.float64)
    return raw.requires_grad_(), stream.requires_grad_()


@pytest.mark.parametrize("route", ["dual", "primal"])
def test_from_training_volts_and_settings_of_the_fit_to_the_statistic(route, volts):
    weights = torch.linspace(0.5, 2, len(volts[0]), dtype=torch.float64)
    settings = torch.tensor(8.0).double(), torch.tensor(0.7).double(), weights

    def chain(raw, stream, penalty, offset, weights):
        features = POOL(FILTER.valid(raw))[:, SELECTED]
        scaler = FeatureScaler.fit(features, compress=True)
        targets = torch.tensor([1.0, -1.0], dtype=raw.dtype).repeat(len(raw) // 2)
        form = fit_quadratic(scaler(features), targets, penalty, offset, weights, route)
        bins = FILTER(stream).unfold(-1, SAMPLES, HOP).movedim(-3, -2)
        llr = Platt(1.5, 0.2).llr(form(scaler(POOL(bins)[..., SELECTED])))
        return RULES[1].scan(llr, RULES[1].start(llr[..., 0]))[0]

    inputs = (*volts, *(each.requires_grad_() for each in settings))
    assert all(bool(pull.any()) for pull in torch.autograd.grad(chain(*inputs)[-1], inputs))
    assert gradcheck(chain, inputs, atol=1e-5, fast_mode=True)


# ------------------------------------------------------------------------------ a detector's stream
DETECTOR = detector_of()
USUAL = score_stream(DETECTOR, signal(8000, 7), 20).score
CALIBRATION = Platt(0.5, -0.5 * float(USUAL.median()))


def settings_of(rule, hop=20, calibration=CALIBRATION):
    return AlarmSettings(hop, calibration, rule, 1.0, target_per_hour=1.0, slip_share=0.3)


def decided(detector, settings, samples):
    scores = score_stream(detector, samples, settings.hop_samples)
    decider = Decider(settings, 2000.0, 100, detector.look_ahead)
    tells = is_usable(scores.score, scores.is_missing, detector.needed_index)
    return decider.decide(scores.score, scores.is_valid, tells)


@pytest.mark.parametrize("kind", ["all", "PVDF"])
@pytest.mark.parametrize("align", ["centred", "causal"])
@pytest.mark.parametrize("rule", [*RULES, KOfN(2, 3)])
def test_values_are_those_of_a_stream(kind, align, rule):
    detector, settings, samples = detector_of(kind, align), settings_of(rule), signal(700, 3)
    samples[2, 450:455] = torch.nan
    found = stream_statistic(detector, settings, samples.clone().requires_grad_())
    expected = decided(detector, settings, samples)
    assert found.score.shape == (31,)
    for name, value in found._asdict().items():
        close = {"rtol": 1e-8, "atol": 1e-8 * float(USUAL.std())}
        torch.testing.assert_close(value.detach(), getattr(expected, name), **close)


def test_gradients_of_a_stream_are_slopes(rng):
    """Along random directions of some volts each, against a central difference."""
    settings = settings_of(Cusum(drift=-0.5, evidence=0.4))
    samples = signal(300, 5).requires_grad_()

    def statistic(samples):
        return stream_statistic(DETECTOR, settings, samples).statistic[-1]

    (pull,) = torch.autograd.grad(statistic(samples), samples)
    for _ in range(3):
        way = torch.from_numpy(rng.standard_normal(samples.shape))
        step = 1e-7
        with torch.no_grad():
            slope = (statistic(samples + step * way) - statistic(samples - step * way)) / (2 * step)
        torch.testing.assert_close((pull * way).sum(), slope, rtol=1e-4, atol=1e-6)


def test_what_is_no_recording_is_refused():
    settings = settings_of(RULES[0])
    with pytest.raises(ValueError, match=r"at least 100 samples.*got 99"):
        stream_statistic(DETECTOR, settings, signal(99))
    with pytest.raises(ValueError, match=r"expected samples \[\*, 4, T\]"):
        stream_statistic(DETECTOR, settings, signal(300)[:3])
