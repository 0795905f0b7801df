import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import signed_log


def fit(rows, **options):
    return FeatureScaler.fit(torch.as_tensor(rows), **options)


def scaler_of(*ends):
    return FeatureScaler(*map(torch.as_tensor, ends))


ENDS = [0.0, 0.0], [1.0, 1.0]


REFUSED = [
    (lambda: scaler_of(torch.zeros(2), torch.ones(3)), r"\(2,\).*\(3,\)"),
    (lambda: scaler_of([0.0, 1.0], [1.0, 0.0]), r"feature 1.*1 and 0"),
    (lambda: scaler_of([-3e38], [3e38]), r"feature 0.*-3e\+38 and 3e\+38"),
    (lambda: scaler_of(*ENDS, torch.ones(3)), r"agree in shape, got \(2,\), \(2,\), \(3,\)"),
    (lambda: scaler_of(*ENDS, [1.0, 1.0], [0]), r"agree in shape, got .* \(2,\), \(1,\)$"),
    (lambda: scaler_of(*ENDS, [1.0, 1.0], [0, -1]), r"whole numbers from 0 on, got \[0, -1\]$"),
    (lambda: scaler_of(*ENDS, [1.0, 1.0], [0.0, 1.5]), r"whole numbers .*, got \[0\.0, 1\.5\]$"),
    (
        lambda: scaler_of(*ENDS, [1.0, -1.0]),
        "feature 1: compression .* positive and finite, got -1",
    ),
    (lambda: scaler_of(*ENDS, [1.0, 0.0]), "feature 1: compression .* positive and finite, got 0"),
    (lambda: scaler_of(*ENDS, [1.0, math.nan]), "feature 1: compression .* got nan"),
    (lambda: fit(torch.zeros(0, 2)), r"at least one bin, got \(0, 2\)"),
    (lambda: fit([[0.0, 1.0]], tail=-0.1), r"\[0, 0\.5\), got -0\.1"),
    (lambda: fit([[0.0, 1.0]], tail=0.5), r"\[0, 0\.5\), got 0\.5"),
    (lambda: fit([[0.0, 1.0]], tail=math.nan), r"\[0, 0\.5\), got nan"),
    (lambda: fit([[0.0, math.nan], [0.0, 2.0]]), "feature 1.*nan"),
    (lambda: fit([[0.0, math.inf], [0.0, 2.0]]), "feature 1.*inf"),
    (lambda: fit([[0.0, math.nan], [0.0, 2.0]], compress=True), "feature 1.*nan"),
    (lambda: fit([[0.0, math.inf], [0.0, 2.0]], compress=True, tail=0.1), "feature 1.*inf"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_errors_name_the_feature(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# -------------------------------------------------------------------------------- compression
TINY, HUGE = 1e-30, 1e30
DTYPES = [torch.float32, torch.float64]


def signed_log_of(features, scale):
    """The definition in float64, which holds every ratio of two float32 numbers."""
    features, scale = np.float64(features), np.float64(scale)
    return np.sign(features) * scale * np.log1p(np.abs(features) / scale)


MAGNITUDES = st.floats(math.log(TINY), math.log(HUGE)).map(math.exp)
SIGNED = st.one_of(st.just(0.0), MAGNITUDES, MAGNITUDES.map(lambda f: -f))


def heavy_tailed(rng, num_bins=301, num_features=7):
    """Cauchy, with a column of 0, one mostly 0, one constant, one tiny and one huge."""
    features = rng.standard_cauchy((num_bins, num_features))
    features[:, 1] = 0
    features[:, 2] = np.where(np.arange(num_bins) % 10 == 0, features[:, 2], 0)
    features[:, 3] = -0.3
    features[:, 4] *= 1e-28
    features[:, 5] *= 1e25
    return features


@pytest.mark.parametrize("dtype", DTYPES)
@given(features=st.lists(SIGNED, min_size=1, max_size=8), scale=MAGNITUDES)
def test_signed_log_equals_numpy_at_any_magnitude(dtype, features, scale):
    features, scale = torch.tensor(features, dtype=dtype), torch.tensor([scale], dtype=dtype)
    actual = signed_log(features[:, None], scale)[:, 0]
    expected = signed_log_of(features.numpy(), scale.numpy())
    eps, tiny = torch.finfo(dtype).eps, torch.finfo(dtype).tiny
    np.testing.assert_allclose(actual.numpy(), expected, rtol=8 * eps, atol=2 * tiny * float(scale))


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")  # torch's own, in jvp
def test_gradcheck_with_compression(rng):
    features = torch.from_numpy(rng.standard_normal((4, 3))).requires_grad_()
    scale = torch.tensor([0.1, 1.0, 30.0], dtype=torch.float64)
    edge = signed_log(torch.full((3,), 9.0, dtype=torch.float64), scale)
    columns = torch.tensor([2, 0, 2])
    for scaler in (FeatureScaler(-edge, edge, scale), FeatureScaler(-edge, edge, scale, columns)):
        assert torch.autograd.gradcheck(scaler, features, check_forward_ad=True)
        assert torch.autograd.gradgradcheck(scaler, features)


def test_a_column_that_is_scaled_twice_has_both_ranges(rng):
    """Also of bins with leading axes; a column that is not listed is not looked at."""
    first = scaler_of([0.0, 1.0], [1.0, 3.0], [0.5, 2.0])
    second = scaler_of([-1.0], [0.2], [1e-3])
    parts = ((first.minimum, second.minimum), (first.maximum, second.maximum))
    scale = torch.cat([first.compression, second.compression])
    scaler = FeatureScaler(*map(torch.cat, parts), scale, [3, 0, 3])
    features = torch.from_numpy(rng.standard_normal((2, 5, 4))).float()
    features[..., 1:3] = torch.nan
    found = scaler(features)
    assert torch.equal(found[..., :2], first(features[..., [3, 0]]))
    assert torch.equal(found[..., 2:], second(features[..., [3]]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("tail", [0.0, 0.02])
def test_fit_equals_numpy(dtype, compress, tail, rng):
    train = torch.from_numpy(heavy_tailed(rng)).to(dtype)
    scaler = FeatureScaler.fit(train, compress=compress, tail=tail)
    values = train.numpy().astype(np.float64)
    if compress:
        size = np.abs(values)
        scale = np.median(size, axis=0)
        scale = np.where(scale > 0, scale, size.max(0))
        scale = np.where(scale > 0, scale, 1.0)
        np.testing.assert_allclose(scaler.compression, scale, rtol=1e-6)
        values = signed_log_of(values, scale)
    else:
        assert scaler.compression is None
    low, high = np.quantile(values, [tail, 1 - tail], axis=0)
    low, high = np.where(low < high, [low, high], [values.min(0), values.max(0)])
    rtol = 1e-5 if dtype == torch.float32 else 1e-12
    np.testing.assert_allclose(scaler.minimum, low, rtol=rtol)
    np.testing.assert_allclose(scaler.maximum, high, rtol=rtol)
    assert scaler.minimum.dtype == scaler.maximum.dtype == dtype
    new = np.concatenate([train.numpy(), heavy_tailed(rng) * 3]).astype(np.float64)
    bent = signed_log_of(new, scale) if compress else new
    width = np.where(high > low, high - low, 1.0)
    expected = np.where(high > low, np.clip(2 * (bent - low) / width - 1, -1, 1), 0)
    actual = scaler(torch.from_numpy(new).to(dtype))
    assert actual.dtype == dtype
    np.testing.assert_allclose(actual.numpy(), expected, atol=10 * rtol)
    inside = scaler(train).abs() < 1
    clipped = 1 - inside.double().mean(0)
    assert (clipped[[0, 4, 5, 6]] <= 2 * tail + 2 / len(train) + 1e-9).all()


def test_a_tail_of_equal_values_falls_back_to_all_of_the_range():
    train = torch.zeros(100, 2)
    train[0, 0], train[1, 0] = -1.0, 3.0
    for compress in (False, True):
        scaler = FeatureScaler.fit(train, tail=0.1, compress=compress)
        assert scaler(train)[:2, 0].tolist() == [-1, 1]
        assert (scaler(train)[:, 1] == 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_scaled_values_are_finite_and_bounded_up_to_the_largest_float(dtype):
    largest = torch.finfo(dtype).max
    scaler = FeatureScaler(
        torch.tensor([-1e-29, -2.0, -1.0], dtype=dtype),
        torch.tensor([1e-29, 1.0, 5.0], dtype=dtype),
        torch.tensor([1e-30, 1.0, 1e30], dtype=dtype),
    )
    at = torch.tensor([[largest] * 3, [-largest] * 3], dtype=dtype, requires_grad=True)
    scaled = scaler(at)
    assert scaled.tolist() == [[1, 1, 1], [-1, -1, -1]]
    scaled.sum().backward()
    assert at.grad.tolist() == [[0, 0, 0], [0, 0, 0]]
    beyond = torch.tensor([[math.inf, -math.inf, math.nan]], dtype=dtype)
    assert scaler(beyond)[0, :2].tolist() == [1, -1]
    assert scaler(beyond)[0, 2].isnan()
