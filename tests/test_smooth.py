"""Smooth stand-ins: their stated errors on any bin there can be, their derivatives, their place."""

import copy
import math
import pickle
from itertools import pairwise

import generated
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_detector import HAND as SMALL_HAND
from small_detector import raw_bins, small_detector
from torch.autograd import gradcheck, gradgradcheck

from tactslip_torch.export import export_detector
from tactslip_torch.features.descriptors import HALF_SLACK, RUN_TOLERANCE, describe
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.features.guards import settle
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.smooth import stand_ins
from tactslip_torch.features.soft_order import smooth_order
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.scaling import FeatureScaler

NAMES = ("median", "iqr", "range", "peak_factor", "entropy", "mode")
TEMPERATURES = [0.3, 0.03, 0.003, 1e-4, 1e-7]
TWO = HandLayout.from_rows(
    {"name": f"{kind}1", "kind": kind, "finger": "index", "segment": "distal"}
    for kind in ("SG", "PVDF")
)


def smooth(x, names=NAMES, temperature=0.03):
    return describe(x, names, stand_ins=stand_ins(temperature))


def distinct(rng, num):
    return torch.from_numpy(rng.permutation(num) + rng.uniform(0.5, 1, num)).requires_grad_()


# --------------------------------------------------------------------------- the stated errors
def stated_errors(x, temperature):
    """The table of ``features.smooth``, for float64 samples ``[N, n]``; ``[N, 6]``."""
    num = x.shape[-1]
    size = x.abs().amax(-1)
    unit = x / torch.where(size == 0, 1.0, size)[:, None]
    span = unit.amax(-1) - unit.amin(-1)
    rms = unit.square().mean(-1).sqrt()
    of_peak = torch.where(rms > 0, temperature * span / rms, 0.0)
    in_bits = entropy_error(unit, span, temperature)
    of_mode = span * mode_error(unit, span, temperature, num)
    sizes = [temperature * span * size, 2 * temperature * span * size]
    return torch.stack([sizes[0], sizes[1], sizes[1], of_peak, in_bits, of_mode * size], dim=-1)


def entropy_error(unit, span, temperature):
    width = min(255 * temperature, 0.5)
    level = (unit - unit.amin(-1, keepdim=True)) / span.clamp(min=1e-300)[:, None] * 255
    level = level + 0.5 + HALF_SLACK[torch.float64]
    edge = level.round().clamp(1, 255)
    is_shared = (level - edge).abs() < width + 1e-9
    second = torch.where(level.floor() < 255, level.floor(), -1.0).amax(-1)
    decides = (is_shared & (edge >= second[:, None])).any(-1)
    part = is_shared.double().mean(-1) / 2
    bits = part * math.log2(255) - torch.special.xlogy(part, part) / math.log(2)
    bits = bits - torch.special.xlogy(1 - part, 1 - part) / math.log(2)
    return torch.where(span == 0, 0.0, bits + decides)


def mode_error(unit, span, temperature, num):
    """As a part of the span."""
    ordered, width = unit.sort(-1).values, temperature * span[:, None]
    gap = ordered.diff(dim=-1)
    is_equal = gap <= RUN_TOLERANCE[torch.float64]
    start = torch.nn.functional.pad(torch.where(is_equal, 0.0, 1.0).cumsum(-1), (1, 0))
    spans = [
        max(float(row[group == g].max() - row[group == g].min()) for g in group.unique())
        for row, group in zip(ordered, start, strict=True)
    ]
    is_apart = (is_equal | (gap >= width)).all(-1) & (torch.tensor(spans) <= width[:, 0] / 2)
    least = 2 * temperature * math.log(num) + (num - 1) * math.exp(-1 / (2 * temperature))
    return torch.where(is_apart, min(least, 1.0), 1.0)


@given(data=st.data(), temperature=st.sampled_from(TEMPERATURES))
def test_errors_are_no_larger_than_stated(data, temperature):
    batch = data.draw(generated.batches(12, torch.float64, channels=3))
    x = batch.bins.flatten(0, 1)
    x = x[x.isfinite().all(-1)]
    x = settle(x, x.abs().amax(-1))
    exact = describe(x, NAMES)
    error = (smooth(x, temperature=temperature) - exact).abs()
    rounding = 1e-12 * (x.abs().amax(-1, keepdim=True) + exact.abs()) + 1e-320
    rounding[:, 3:5] = 1e-9  # of order one, whatever the unit
    limit = stated_errors(x, temperature) * (1 + 1e-9) + rounding
    wrong = ~(error <= limit)
    assert not wrong.any(), [
        (row, NAMES[column], float(error[row, column]), float(limit[row, column]))
        for row, column in wrong.nonzero()[:5].tolist()
    ]


def test_errors_go_to_zero_with_the_temperature(rng):
    x = torch.from_numpy(rng.standard_normal((40, 100)))
    stated = [stated_errors(x, t).amax(0) for t in (0.01, 1e-4, 1e-7, 1e-9)]
    for wide, narrow in pairwise(stated):
        assert (narrow <= wide).all()
    assert (stated[-1] < 1e-6).all()
    torch.testing.assert_close(smooth(x, temperature=1e-9), describe(x, NAMES), atol=1e-6, rtol=0)


def test_what_is_far_from_every_step_is_exact(rng):
    """Integers meet levels in their middle, and differ by far more than the temperature."""
    x = torch.from_numpy(rng.integers(0, 256, (30, 100)).astype(float))
    x[:, :2] = torch.tensor([0.0, 255.0])
    x[:, 2:12] = x[:, 2:3]  # the mode, by far
    for name in ("entropy", "mode"):
        exact = describe(x, [name])
        assert exact.unique().numel() > 10
        torch.testing.assert_close(smooth(x, [name], 1e-4), exact, atol=1e-9, rtol=1e-12)


# --------------------------------------------------------------------------------- derivatives
@pytest.mark.parametrize("temperature", [0.3, 0.05])
@pytest.mark.parametrize("num", [2, 9, 10])
@pytest.mark.parametrize("name", NAMES)
def test_first_and_second_derivatives(name, num, temperature, rng):
    def operator(x):
        return smooth(x, [name], temperature)

    x = distinct(rng, num)
    assert gradcheck(operator, x)
    assert gradgradcheck(operator, x)


def test_derivatives_of_every_feature_of_a_pool(rng):
    """All 17 descriptors, in every domain they come in."""
    pool = FeaturePool(TWO, bin_samples=12, level=1, smooth=0.05)
    assert len({name.descriptor for name in pool.names}) == 17
    bins = torch.from_numpy(rng.standard_normal((2, 12))).requires_grad_()

    def bounded(bins):
        return torch.tanh(pool(bins) / 10)

    assert gradcheck(bounded, bins, eps=1e-7, atol=1e-5)
    assert gradgradcheck(bounded, bins, eps=1e-7, atol=1e-3, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize("name", ["mode", "entropy"])
def test_what_steps_has_a_slope_now(name, rng):
    x = torch.from_numpy(rng.standard_normal((20, 100))).requires_grad_()
    (exact,) = torch.autograd.grad(describe(x, [name]).sum() + 0 * x.sum(), x)
    (soft,) = torch.autograd.grad(smooth(x, [name], 0.01).sum(), x)
    assert int((exact != 0).sum()) <= 20  # at most the one value that the mode is
    assert ((soft != 0).sum(-1) > 10).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_where_all_is_equal_or_tied(name, dtype):
    flat = torch.full((8,), 3.0, dtype=dtype)
    tied = torch.tensor([1.0, 1, 1, 2, 2, 5, 5, 5], dtype=dtype)
    x = torch.stack([flat, 0 * flat, tied, 1e-30 * tied, 1e30 * tied]).requires_grad_()
    value = smooth(x, [name])
    assert value.isfinite().all()
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert gradient.isfinite().all()


def test_a_nan_makes_a_sample_nan_and_no_other():
    x = torch.randn(3, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    alone = smooth(x)
    x[1, 4], x[2, 4] = torch.nan, torch.inf
    value = smooth(x)
    assert torch.equal(value[0], alone[0])
    assert value[1:].isnan().all()


@pytest.mark.parametrize("factor", [1e-200, 1e-3, 1e200])
def test_nothing_depends_on_the_unit(factor, rng):
    x = torch.from_numpy(rng.standard_normal((6, 50)))
    unit = [1.0 if name in ("entropy", "peak_factor") else factor for name in NAMES]
    scaled = smooth(x * factor) / torch.tensor(unit, dtype=torch.float64)
    torch.testing.assert_close(scaled, smooth(x), rtol=1e-9, atol=1e-12)


# ---------------------------------------------------------------------------- order statistics
@given(drawn=st.integers(0, 2**40), width=st.sampled_from([1e-3, 0.1, 2.0]))
def test_smoothed_order_lies_within_its_width_and_rises(drawn, width):
    x = torch.randn(5, 23, generator=generated.generator(drawn), dtype=torch.float64)
    x = torch.where(x.abs() < 0.3, 0.25, x)  # ties
    ranks = list(range(23))
    found = smooth_order(x, ranks, width)
    assert ((found - x.sort(-1).values).abs() <= width * (1 + 1e-12)).all()
    assert (found.diff(dim=-1) > 0).all()  # ties are told apart


def test_what_stands_alone_is_itself():
    x = torch.tensor([[5.0, 1.0, 1.25, 9.0]], dtype=torch.float64)
    expected = torch.tensor([[9.0, 5.0]], dtype=torch.float64)
    torch.testing.assert_close(smooth_order(x, [3, 2], 0.5), expected, rtol=1e-14, atol=0)


def test_its_gradients_are_weights(rng):
    x = torch.from_numpy(rng.standard_normal(30)).requires_grad_()
    jacobian = torch.autograd.functional.jacobian(lambda x: smooth_order(x, range(30), 0.2), x)
    assert (jacobian >= 0).all()
    torch.testing.assert_close(jacobian.sum(-1), torch.ones(30).double())


def test_under_vmap(rng):
    x = torch.from_numpy(rng.standard_normal((3, 2, 9)))
    mapped = torch.vmap(lambda x: smooth_order(x, (0, 4), 0.3))(x)
    torch.testing.assert_close(mapped, smooth_order(x, (0, 4), 0.3), rtol=1e-12, atol=1e-15)


# -------------------------------------------------------------------------------- in the house
@pytest.mark.parametrize("temperature", [0.0, -0.1, 1.5, math.nan])
def test_a_temperature_that_is_none_is_refused(temperature):
    with pytest.raises(ValueError, match=r"smooth must be a temperature above 0 and at most 1"):
        FeaturePool(TWO, bin_samples=12, level=1, smooth=temperature)


def test_facts_hold_the_temperature_only_if_there_is_one():
    assert "smooth" not in FeaturePool(TWO).facts()
    facts = FeaturePool(TWO, smooth=0.02).facts()
    assert facts["smooth"] == 0.02
    assert FeaturePool(TWO, **facts).smooth == 0.02


def test_the_other_descriptors_are_as_they_were(rng):
    bins = torch.from_numpy(rng.standard_normal((4, 2, 100)))
    exact, soft = FeaturePool(TWO), FeaturePool(TWO, smooth=0.02)
    is_other = torch.tensor([name.descriptor not in NAMES for name in exact.names])
    assert torch.equal(exact(bins)[:, is_other], soft(bins)[:, is_other])
    assert (exact(bins) != soft(bins))[:, ~is_other].double().mean() > 0.5  # not where isolated


@pytest.mark.parametrize("engine", ["auto", "eager"])
def test_features_of_a_smooth_pool_are_the_references(engine, rng):
    bins = torch.from_numpy(rng.standard_normal((7, 2, 100)))
    pool = FeaturePool(TWO, smooth=0.02)
    extractor = FeatureExtractor(pool, [3, 11, 40], engine)
    assert extractor.engine == "reference"
    torch.testing.assert_close(extractor(bins), pool(bins)[:, [3, 11, 40]], rtol=1e-13, atol=0)
    for again in (copy.deepcopy(extractor), pickle.loads(pickle.dumps(extractor))):
        assert torch.equal(again(bins), extractor(bins))


@given(data=st.data(), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_a_smooth_pool_is_finite_on_any_bin_with_finite_gradients(data, dtype):
    bins = data.draw(generated.batches(4, dtype, channels=2)).bins
    pool = FeaturePool(TWO, smooth=0.01)
    is_whole = bins.isfinite().all(-1).all(-1)
    bins = bins[is_whole].requires_grad_()
    features = pool(bins)
    assert features.isfinite().all()
    (gradient,) = torch.autograd.grad(features.clamp(-1e6, 1e6).sum(), bins)
    assert not gradient.isnan().any()


def smooth_detector():
    exact = small_detector()
    pool = FeaturePool(SMALL_HAND, smooth=0.02)
    features = pool(exact.channel_filter.valid(raw_bins(64, seed=99)))[:, exact.selected]
    scaler = FeatureScaler.fit(features)
    return SlipDetector(pool, exact.channel_filter, exact.selected, scaler, exact.head)


def test_a_smooth_detector_comes_back_from_its_file(tmp_path):
    made = smooth_detector()
    made.save(tmp_path / "detector.pt")
    again = SlipDetector.load(tmp_path / "detector.pt")
    bins = raw_bins(9)
    assert again.pool.smooth == 0.02
    assert torch.equal(again.score_raw(bins), made.score_raw(bins))
    assert not torch.equal(small_detector().score_raw(bins), made.score_raw(bins))


@pytest.mark.onnx
def test_a_smooth_detector_is_not_exported(tmp_path):
    with pytest.raises(ValueError, match=r"model.onnx was not written.*smooth=0.02.*exact ones"):
        export_detector(smooth_detector(), tmp_path, ["bin"])
    assert not list(tmp_path.iterdir())
