"""The definitions of features, on every backend, against the slow oracle.

One suite for torch (float64; float32 in double and in native arithmetic) and for ONNX graphs of
both
precisions. Kinds of bins at 100 samples, and engines, stand in ``contract/test_features.py``.
"""

from functools import cache

import numpy as np
import onnxruntime
import oracles
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.deploy.bins import described
from tactslip_torch.deploy.value import Graph
from tactslip_torch.features.descriptors import DESCRIPTORS
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter

HAND = HandLayout.from_rows(
    {"name": name, "kind": kind, "finger": "index", "segment": "distal"}
    for name, kind in [("SG1", "SG"), ("PVDF1", "PVDF"), ("PVDF2", "PVDF")]
)
NAMES = oracles.pool_names(1, 2)
OPTIONS = [
    {},
    {"sample_rate_hz": 1000.0, "bin_samples": 99},
    {"bin_samples": 64, "level": 2},
    {"bin_samples": 101, "spectrum": "clean"},
    {"spectrum": "clean"},
    {"wavelet": "db2", "level": 3},
    {"bin_samples": 13, "level": 1},
]
BACKENDS = {"torch": 1e-10, "native float64": 1e-9, "torch float32": 1e-6, "mixed float32": 2e-4}
BACKENDS |= {"onnx float64": 1e-9, "onnx float32": 2e-4}
"""Each with the error it may have, of the larger of a value and its column's median."""


def columns(names, *parts):
    """Places of the features with these words in their names."""
    return [i for i, name in enumerate(names) if set(parts) <= set(name)]


def features_by(backend, bins, **options):
    """Features ``[N, F]`` of the small hand, and the bins as the backend was given them."""
    kind, *rest = backend.split()
    dtype = torch.float32 if rest == ["float32"] else torch.float64
    given = torch.from_numpy(bins).to(dtype)
    if kind == "onnx":
        return through_onnx(FeaturePool(HAND, **options), given), given.double().numpy()
    arithmetic = "native" if kind == "mixed" else "double"
    backend = "native" if kind == "native" else "torch"
    pool = FeaturePool(HAND, arithmetic=arithmetic, backend=backend, **options)
    found = pool(given)
    assert found.dtype == dtype
    return found.double().numpy(), given.double().numpy()


def through_onnx(pool, bins, selected=None):
    """Features by a graph whose filter passes everything."""
    selected = range(len(pool.names)) if selected is None else selected
    num = len(selected)
    ones, flat = torch.ones(num, dtype=torch.float64), torch.zeros(num, num, dtype=torch.float64)
    head = QuadraticForm(flat, flat[0], flat[0, 0])
    channel_filter = ChannelFilter([1] * len(HAND), polyorder=0)
    detector = SlipDetector(pool, channel_filter, selected, FeatureScaler(-ones, ones), head)
    graph = Graph()
    shape = ("batch", len(HAND), pool.bin_samples)
    samples = graph.input("samples", bins.numpy().dtype, shape)
    graph.output("features", described(samples, detector)[0], ("batch", num))
    model = graph.model().SerializeToString()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return session.run(None, {"samples": bins.numpy()})[0]


def assert_close(found, expected, names, tolerance, least=0.0):
    """Within a tolerance of the larger of value and column's median, and of ``least``.

    A cv whose mean is small is compared as mean by deviation, which has the rounding of the mean.
    """
    found, expected = np.array(found), expected.copy()
    assert np.isfinite(found).all()
    small = np.array([name[-1] == "cv" for name in names]) & (np.abs(expected) > 100)
    error = np.abs(1 / found[small]) - np.abs(1 / expected[small])
    assert (np.abs(error) <= 10 * tolerance).all()
    found[small] = expected[small]
    scale = np.maximum(np.abs(expected), np.median(np.abs(expected), axis=0)).clip(least)
    wrong = np.argwhere(np.abs(found - expected) > tolerance * scale)
    assert not [(names[j], found[i, j], expected[i, j]) for i, j in wrong[:5]]


# Equal to the oracle -------------------------------------------------------------------------


@cache
def oracle_of(place, dtype):
    """Bins of a length, rounded to a dtype, and their features by the oracle: of all backends."""
    options, rng = OPTIONS[place], np.random.default_rng(place)
    num = options.get("bin_samples", 100)
    bins = rng.standard_normal((6, 3, num))
    bins[4:] = oracles.integer_bins(rng, 2, 3, num)  # ties, and an offset
    bins[4:] += [[3.0], [2.0], [-5.0]]
    bins = bins.astype(dtype).astype(np.float64)
    given = {k: v for k, v in options.items() if k not in ("bin_samples", "spectrum")}
    method = options.get("spectrum", "reference")
    return bins, np.stack([oracles.pool(one, 1, method=method, **given) for one in bins])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_feature_equals_the_oracle(options, backend):
    bins, expected = oracle_of(
        OPTIONS.index(options), backend.split()[-1].replace("torch", "float64")
    )
    found, given = features_by(backend, bins, **options)
    assert np.array_equal(given, bins)
    names = oracles.pool_names(1, 2, options.get("level", 4))
    assert_close(found, expected, names, BACKENDS[backend])


def test_channels_are_found_by_kind_wherever_they_lie(rng):
    """A hand that lists its films first has the same features in the pool's own order."""
    rows = HAND.to_rows()
    mixed = FeaturePool(HandLayout.from_rows([rows[1], rows[0], rows[2]]))
    bins = torch.from_numpy(rng.standard_normal((4, 3, 100)))
    straight = FeaturePool(HAND)
    assert mixed.names == straight.names
    torch.testing.assert_close(mixed(bins[:, [1, 0, 2]]), straight(bins), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("num", [99, 100])
@pytest.mark.parametrize("wanted", [{"median"}, {"iqr"}, {"median", "mode"}])
def test_order_statistics_alone_sort_no_more_than_they_need(wanted, num, rng):
    pool = FeaturePool(HAND, bin_samples=num, level=1)
    bins = torch.from_numpy(rng.standard_normal((4, 3, num)))
    chosen = [i for i, name in enumerate(pool.names) if name.descriptor in wanted]
    found = through_onnx(pool, bins, chosen)
    np.testing.assert_allclose(found, pool(bins)[:, chosen].numpy(), rtol=1e-9, atol=1e-12)


# Constants and other extremes ----------------------------------------------------------------

KNOWN = {
    "cv": 2.736,
    "skewness": 5.908,
    "kurtosis": 41.133,
    "peak_factor": 7.566,
    "spectral_centroid": 321.391,
    "spectral_spread": 479.107,
    "entropy": 3.866,
}
STILL = ("range", "mean_deviation", "std", "cv", "iqr", "skewness", "entropy", "correlation")


@pytest.mark.parametrize("level", [1.0, 0.1, -5.0, 3e-5, 0.0, 1e-30])
def test_a_constant_bin_has_the_stated_values(level):
    features = FeaturePool(HAND)(torch.full((3, 100), level, dtype=torch.float64))
    for descriptor in STILL:
        assert not features[columns(NAMES, "time", descriptor)].any(), descriptor
    assert (features[columns(NAMES, "time", "kurtosis")] == 3).all()
    for name, value in zip(NAMES, features.tolist(), strict=True):
        _, component, domain, descriptor = name
        here = 0.0 if component[0] == "D" else level
        stated = {"mean": here, "median": here, "mode": here, "energy": 100 * here**2}
        stated["peak_factor"] = np.sign(here)
        if domain == "time" and descriptor in stated:
            assert value == pytest.approx(stated[descriptor], rel=1e-13), name
        if level == 0 and domain == "freq":
            assert value == (3 if descriptor == "kurtosis" else 0), name
        elif domain == "freq" and component[0] == "A" and descriptor in KNOWN:
            assert value == pytest.approx(KNOWN[descriptor], abs=5.01e-4), name
        elif domain == "freq" and descriptor == "band_energy_ratio":
            assert value == pytest.approx(0.25 if component[0] == "A" else 0, abs=1e-12), name


@pytest.mark.parametrize(
    ("dtype", "arithmetic", "least"),
    [
        (torch.float64, "double", 64 * 2.0**-52),
        (torch.float32, "double", 64 * 2.0**-23),
        (torch.float32, "native", 2.0**-10),
    ],
)
def test_a_film_is_dead_where_its_span_is_too_small_for_the_dtype(dtype, arithmetic, least):
    pool = FeaturePool(HAND, arithmetic=arithmetic)
    for factor, is_valid in ((0.6, False), (2.0, True)):
        bins = torch.ones(3, 100, dtype=dtype)
        bins[1, 50] += factor * least
        assert pool.validity(bins).tolist() == [False, is_valid, False]


# Manners and gradients -----------------------------------------------------------------------


def test_manners(device, rng):
    pool = FeaturePool(HAND).to(device)
    bins = torch.from_numpy(rng.standard_normal((4, 3, 100))).to(device)
    normal = pool(bins).abs().mean(0) + 1e-12  # columns differ in size by many decades
    oracles.assert_manners(lambda bins: pool(bins) / normal.to(bins), bins, num_axes=2)
    assert list(pool.parameters()) == []


@pytest.mark.parametrize("num", [12, 13])
@pytest.mark.parametrize("descriptor", [*DESCRIPTORS, "band_energy_ratio"])
def test_first_and_second_derivatives(descriptor, num, rng):
    """Of bins without near ties, between which median, iqr and mode would choose."""
    hand = HandLayout.from_rows(HAND.to_rows()[:2])
    pool = FeaturePool(hand, bin_samples=num, level=1)
    own = [i for i, name in enumerate(pool.names) if name.descriptor == descriptor]
    extractor = pool.select(own, "torch")
    bins = torch.from_numpy(rng.standard_normal((2, num))).requires_grad_()

    def values(bins):
        return torch.tanh(extractor(bins) / 10)

    if descriptor == "entropy":
        assert not values(bins).requires_grad
        return
    assert gradcheck(values, bins, eps=1e-7, atol=1e-5)
    if descriptor not in ("median", "iqr", "mode", "range", "mean"):  # these are linear
        assert gradgradcheck(values, bins, eps=1e-6, atol=1e-4, fast_mode=True)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")  # torch's own, in jvp
def test_forward_mode_and_vmap(rng):
    pool = FeaturePool(HAND)
    bins, way = (torch.from_numpy(rng.standard_normal((2, 3, 100))) for _ in range(2))
    torch.testing.assert_close(torch.func.vmap(pool)(bins), pool(bins))
    x = bins.clone().requires_grad_()
    weights = torch.from_numpy(rng.standard_normal(len(NAMES)))
    _, slope = torch.func.jvp(lambda x: pool(x) @ weights, (bins,), (way,))
    (pull,) = torch.autograd.grad((pool(x) @ weights).sum(), x)
    torch.testing.assert_close(slope, (pull * way).sum((-2, -1)))


# Errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("shape", [(3, 99), (2, 100), (5, 4, 100), (100,), (100, 3)])
def test_errors_name_shape_and_dtype(shape, backend):
    pool = FeaturePool(HAND, backend=backend)
    for method in (pool, pool.validity):
        with pytest.raises(ValueError, match=rf"3, 100.*{', '.join(map(str, shape))}"):
            method(torch.zeros(shape))
        with pytest.raises(ValueError, match=r"float32 or float64 .*int64"):
            method(torch.zeros(3, 100, dtype=torch.int64))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sample_rate_hz": -1.0}, r"sample_rate_hz.*-1"),
        ({"bin_samples": 50}, r"1\.\.3.*50 samples.*4"),
        ({"arithmetic": "half"}, r"arithmetic must be one of double, native, got 'half'"),
    ],
)
def test_errors_at_construction(options, message):
    with pytest.raises(ValueError, match=message):
        FeaturePool(HAND, **options)
