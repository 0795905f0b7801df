"""Every kind of input by every backend, alone and among others: the same flags and decisions."""

from functools import cache

import numpy as np
import pytest
import torch
from engine_bins import KINDS, bins_of
from extremes import EXTREMES, extreme_bins
from small_detector import HAND, alarming_detector, raw_bins, with_floors
from test_onnx import run_on

from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import score_stream
from tactslip_torch.onset.streaming import StreamingDetector

BROKEN = {"nan": torch.nan, "inf": torch.inf, "-inf": -torch.inf}
ALL = (*EXTREMES, *KINDS, *BROKEN)
HOSTILE = (
    *("tone without gain", "constant and dither", "synchronous", "mixed magnitudes"),
    *("offset 1e6, vibration 1e-6", "denormal", "nan"),
)
"""What is lost in rounding, and is flagged."""
SOME_SLOW = [k if k in HOSTILE else pytest.param(k, marks=pytest.mark.slow) for k in ALL]


@cache
def detectors(has_floors):
    """By the native engine, and the same by torch."""
    made = alarming_detector()
    if has_floors:
        with_floors(made, 3)
    parts = made.pool, made.channel_filter, made.selected, made.scaler, made.head
    return made, SlipDetector(*parts, sensing=made.sensing, backend="torch")


@cache
def margin():
    """Of scores, beyond which rounding turns no decision: far below what tells slip apart."""
    return 1e-4 * float(detectors(False)[0].predict_raw(raw_bins(200)).score.std())


def bins_by(kind, shape, dtype, beside):
    """Raw bins of a kind in every channel, or in two of them ``beside`` ordinary ones."""
    generator = torch.Generator().manual_seed(sum(map(ord, kind)))
    ordinary = 0.1 * torch.randn(shape, generator=generator, dtype=torch.float64)
    ordinary[:, :2] += 1.0
    if kind in EXTREMES:
        bins = extreme_bins(kind, shape, generator, dtype).double()
    elif kind in BROKEN:
        bins, place = ordinary.clone(), torch.randint(shape[2], (shape[0], 1), generator=generator)
        bins[:, 1].scatter_(-1, place, BROKEN[kind])
    else:
        bins = bins_of(kind, shape[0], HAND, shape[2], generator)
    if beside:
        bins[:, ::2] = ordinary[:, ::2]
    return bins.to(dtype)


def assert_agree(found, expected, what, rows=slice(None)):
    """Flags are the same, and decisions where they are valid and outside the margin."""
    score, is_valid, *flags = (np.asarray(each) for each in found)
    own, is_own_valid, *own_flags = (np.asarray(each)[rows] for each in expected)
    for each, wanted in zip((is_valid, *flags), (is_own_valid, *own_flags), strict=True):
        np.testing.assert_array_equal(each, wanted, err_msg=f"flags by {what}")
    is_clear = is_valid & (np.abs(own) > margin())
    turned = (score >= 0) != (own >= 0)
    assert not (turned & is_clear).any(), f"{what}: {score[turned & is_clear]}"
    np.testing.assert_array_equal(np.isfinite(score), is_valid)


def joined(parts):
    return [torch.cat(each) for each in zip(*parts, strict=True)]


@pytest.mark.onnx
@pytest.mark.parametrize("has_floors", [False, True])
@pytest.mark.parametrize("beside", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", SOME_SLOW)
def test_every_kind_of_input_is_decided_alike(kind, beside, has_floors):
    num, dtype = 24, torch.float64 if beside else torch.float32
    native, by_torch = detectors(has_floors)
    bins = bins_by(kind, (num, len(HAND), 150), dtype, beside)
    expected = native.predict_raw(bins)[:4]
    graph = run_on(native, str(dtype).removeprefix("torch."), bins)
    of_graph = [graph[name] for name in ("score", "valid", "in_range", "channels_lost")]
    assert_agree(of_graph, expected, "onnx")
    assert_agree(by_torch.predict_raw(bins)[:4], expected, "torch")
    few = range(0, num, num // 8)
    for name, made in (("native", native), ("torch", by_torch)):
        alone = joined(made.predict_raw(bins[i : i + 1])[:4] for i in few)
        assert_agree(alone, expected, f"{name}, alone", list(few))
    whole = bins_by(kind, (1, len(HAND), 1500), dtype, beside)[0]
    offline = score_stream(native, whole, 20)[:4]
    assert_agree(score_stream(by_torch, whole, 20)[:4], offline, "torch, offline")
    stream = StreamingDetector(native, dtype=dtype)
    parts = [*map(stream.push, whole.T.split(37)), stream.flush()]
    of_stream = joined((x.score, x.is_valid, x.in_range, x.channels_lost) for x in parts)
    assert_agree(of_stream, offline, "stream")
