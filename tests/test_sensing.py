"""Which channels are alive, silent or missing, and which decisions count: by the rule, by all."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from any_hands import HANDS, detector_of
from extremes import batches, generator
from hypothesis import given, settings
from hypothesis import strategies as st
from small_detector import HAND, small_detector, with_floors
from test_onnx import run_on

from tactslip_torch.features.sensing import Sensing
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings, score_stream
from tactslip_torch.onset.streaming import StreamingDetector

BACKENDS = ("auto", "torch")
LEAST_RAW = {torch.float32: 2.0**-17, torch.float64: 2.0**-22}


def by_rule(bins, sensing, counted):
    """In longdouble: channels that are lost, whether decisions count, and are in range."""
    exact = bins.numpy().astype(np.longdouble)
    with np.errstate(invalid="ignore"):
        span, size = np.ptp(exact, axis=-1), np.abs(exact).max(-1)
    eps = np.longdouble(torch.finfo(bins.dtype).eps)
    alive = np.isfinite(size) & (span > 64 * eps * size) & (span >= np.array(sensing.floor))
    low, high = map(np.array, sensing.bounds)
    num = (alive & counted).sum(-1)
    num_fits = (alive & counted & (span >= low) & (span <= high)).sum(-1)
    is_valid = num >= sensing.min_alive
    return ~alive, is_valid, is_valid & (2 * num_fits >= num)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("floors", [None, 3])
@settings(max_examples=5)
@given(data=st.data())
def test_a_channel_is_alive_and_a_decision_counts_by_the_rule(floors, dtype, backend, data):
    detector = small_detector(backend=backend)
    if floors is not None:
        with_floors(detector, floors)
    bins = data.draw(batches((16, len(HAND), 100), dtype)).clone()
    bins[0, 1, 3], bins[1, 2, 99], bins[2, 0, 0] = torch.nan, torch.inf, -torch.inf
    bins[:, 3] = 1  # with spans of 56 to 71 eps
    bins[:, 3, 50] = 1 - torch.arange(56, 72) * torch.finfo(dtype).eps
    bins[5:8, 2] = torch.randn(3, 100, generator=generator(1)).to(dtype)
    used = detector.needed_index
    found = detector.predict(bins)
    is_lost, is_valid, in_range = by_rule(bins, detector.sensing, detector.counted.numpy() > 0)
    assert np.array_equal(found.channels_lost[:, used], is_lost[:, used])
    assert np.array_equal(found.is_valid, is_valid)
    assert np.array_equal(found.in_range, in_range)
    assert torch.equal(found.score.isfinite(), found.is_valid)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", list(LEAST_RAW))
def test_what_the_filter_leaves_must_stand_above_the_rounding_of_raw_samples(dtype, backend):
    detector = small_detector(backend=backend)
    t = torch.arange(150, dtype=torch.float64)
    for factor in (0.5, 2.0):
        ramp = 1000.0 * (1.0 + factor * LEAST_RAW[dtype] * (t / 99.0 - 0.5))
        raw = ramp.expand(1, 4, 150).clone()
        found = detector.predict_raw(raw, given=dtype)  # filters of order 1 keep a line
        assert found.channels_lost[:, detector.needed_index].all() == (factor < 1)
        assert found.is_valid.item() == (factor > 1)


def test_silence_is_not_judged_in_few_samples_and_missing_is():
    detector, hand = detector_of("bins of 5 samples"), HANDS["bins of 5 samples"]
    samples, _ = hand.noise(3, 5 + 2 * detector.channel_filter.context, seed=4)
    samples[0], samples[1, 0], samples[2] = 1.0, torch.nan, torch.nan
    found = detector.predict_raw(samples)
    assert found.channels_lost.tolist() == [[False] * 3, [True, False, False], [True] * 3]
    assert found.is_valid.tolist() == [True, True, False]


def lossy(hand, num_bins, seed):
    """A recording with channels that are missing, stuck, too quiet, far too loud, or all gone."""
    num = num_bins * hand.bin_samples
    x = torch.cat(list(hand.noise(num_bins, hand.bin_samples, seed)[0]), -1)
    place, half = len(x) - 1, max(len(x) // 2, 1)
    cuts = [num * i // 12 for i in range(13)]
    quiet = hand.offset + 1e-3 * (x - hand.offset)
    x[0, cuts[1] : cuts[2]] = torch.nan
    x[place, cuts[2] : cuts[4]] = 0.5  # stuck
    x[:half, cuts[4] : cuts[5]] = torch.inf
    x[place, cuts[5] : cuts[6]] = quiet[place, cuts[5] : cuts[6]]
    x[:, cuts[7] : cuts[8]] = quiet[:, cuts[7] : cuts[8]]
    x[:, cuts[9] : cuts[10]] = torch.nan
    x[:, cuts[11] : cuts[12]] *= 1e3
    return x


@pytest.mark.onnx
@pytest.mark.parametrize("name", HANDS)
def test_lost_channels_are_the_same_to_engine_torch_graph_and_stream(name):
    hand, made = HANDS[name], detector_of(name)
    context = made.channel_filter.context
    usual, _ = hand.noise(200, hand.bin_samples + 2 * context, seed=8)
    num = int(made.counted.sum())
    stuck = 3 * hand.bin_samples
    sensing = Sensing.fit(made.predict_raw(usual).span, max(1, num // 2 + num % 2), stuck)
    parts = made.pool, made.channel_filter, made.selected, made.scaler, made.head, made.info
    native, by_torch = (
        SlipDetector(*parts, made.imputation, sensing=sensing, backend=b) for b in BACKENDS
    )
    samples = lossy(hand, 48, seed=6)
    expected = score_stream(by_torch, samples, hand.hop)
    spread = float(expected.score[expected.in_range].std())
    close = {"rtol": 0, "atol": 1e-8 * max(spread, 1.0), "equal_nan": True}

    def assert_same(found, expected, **how):
        torch.testing.assert_close(found[0], expected[0], **(close | how))
        for own, other in zip(found[1:4], expected[1:4], strict=True):
            assert torch.equal(own, other)

    assert_same(score_stream(native, samples, hand.hop), expected)
    alarm = replace(AlarmSettings.of(native), hop_samples=hand.hop)
    stream = StreamingDetector(native, alarm, dtype=torch.float64)
    places = [*range(0, samples.shape[-1], 37), samples.shape[-1]]
    pushed = [stream.push(samples[:, a:b].T) for a, b in pairwise(places)] + [stream.flush()]
    streamed = [
        torch.cat([getattr(part, field) for part in pushed])
        for field in ("score", "is_valid", "in_range", "channels_lost")
    ]
    assert_same(streamed, expected)
    length = hand.bin_samples + 2 * context
    bins = samples.unfold(-1, length, hand.hop).transpose(0, 1)
    for precision, atol in (("float64", 1e-8), ("float32", 1e-3)):
        given = bins.to(getattr(torch, precision))
        wanted = by_torch.predict_raw(given.double(), given=given.dtype)
        graph = run_on(native, precision, given)
        outputs = ("score", "valid", "in_range", "channels_lost")
        found = [torch.from_numpy(graph[output]) for output in outputs]
        found[0] = found[0].double()
        wanted = wanted._replace(score=wanted.score.double())
        assert_same(found, wanted, atol=atol * max(spread, 1.0))
    is_lost = expected.channels_lost[:, made.needed_index]
    assert is_lost.any()
    assert (~is_lost).any()
    assert expected.is_valid.any()
    assert not expected.is_valid.all()
    assert (expected.is_valid & ~expected.in_range).any()
