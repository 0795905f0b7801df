"""The feature pool, on every backend, against the slow reference on every kind of bin.

Backends: torch (float64; float32 in double and in native arithmetic), the fastest there is, and
ONNX graphs of both precisions.
"""

import math
from functools import cache

import numpy as np
import onnxruntime
import oracles
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from tactslip_torch.deploy.bins import described
from tactslip_torch.deploy.value import Graph
from tactslip_torch.features.descriptors import DESCRIPTORS, FeatureName
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter

from .names import BACKENDS, FeaturePool, HandLayout, Scene, SlipDetector, simulate

KINDS = [("SG1", "SG"), ("SG2", "SG"), ("PVDF1", "PVDF"), ("PVDF2", "PVDF")]
HAND = HandLayout.from_rows(
    {"name": name, "kind": kind, "finger": "index", "segment": "distal"} for name, kind in KINDS
)
NUM_GAUGES = 2
NAMES = [" ".join(name) for name in oracles.pool_names(NUM_GAUGES, 2)]
TIME = np.arange(100)


def noise(rng, size=1.0):
    return size * rng.standard_normal((6, 4, 100))


def slip_like(rng):
    """Bins of the simulated hand around an onset of slip, filtered by the slow reference."""
    scene = Scene("M1", seed=1)
    onset_s = simulate(scene, windows=[]).onsets_s[0]
    recording = simulate(scene, windows=[(onset_s - 0.5, onset_s + 0.5)])
    first = round((onset_s - 0.3) * recording.sample_rate_hz)
    samples = recording.samples[[2, 9, 15, 20], first : first + 1200].double().numpy()
    rows = [oracles.savgol(x, 51 if i < NUM_GAUGES else 11) for i, x in enumerate(samples)]
    return np.stack(rows)[:, :1200].reshape(4, 12, 100).swapaxes(0, 1).copy()


def shapes(values):
    """The same row in every channel; and shifted by some samples in each of the others."""
    return np.stack([[np.roll(values, k * i) for i in range(4)] for k in (0, 3)])


def one_value(rng):
    """All samples of a bin are the same but for one."""
    bins = np.full((4, 4, 100), 0.25)
    bins[np.arange(4), :, [0, 37, 50, 99]] += np.array([1.0, -1.0, 1e-3, 5.0])[:, None]
    return bins


KINDS_OF_BIN = {
    "noise": noise,
    "few levels": lambda rng: oracles.integer_bins(rng, 6, 4, 100),
    "plausible": lambda rng: oracles.plausible_bins(rng, 8)[:, [2, 5, 15, 20]],
    "rails and dead channels": lambda rng: oracles.plausible_bins(rng, 6)[:, [0, 2, 16, 17]],
    "slip-like": slip_like,
    "constant": lambda rng: np.ones((3, 4, 100)) * np.array([0.1, -5.0, 3e-5])[:, None, None],
    "zero": lambda rng: np.zeros((2, 4, 100)),
    "one value away": one_value,
    "ramp": lambda rng: shapes(TIME / 100.0),
    "step": lambda rng: shapes(np.where(TIME < 50, 0.0, 5.0)),
    "rail to rail": lambda rng: shapes(np.where(TIME % 2 == 0, -5.0, 5.0)),
    "tone": lambda rng: shapes(np.sin(2 * math.pi * 125 / 2000 * TIME)),
    "small": lambda rng: noise(rng, 1e-12),
    "large": lambda rng: noise(rng, 1e12),
    "on an offset": lambda rng: 5 + noise(rng, 1e-3),
}
OPTIONS = [
    {},
    {"sample_rate_hz": 1000.0, "bin_samples": 99},
    {"bin_samples": 64, "level": 2},
    {"bin_samples": 101, "spectrum": "clean"},
    {"spectrum": "clean"},
    {"wavelet": "db2", "level": 3},
    {"bin_samples": 13, "level": 1},
]
TOLERANCES = {**dict.fromkeys(BACKENDS, 1e-10), "torch float32": 1e-6, "mixed float32": 2e-4}
TOLERANCES |= {"onnx float64": 1e-9, "onnx float32": 2e-4}
"""By backend the error it may have, of the larger of a value and its column's median."""


def features_by(backend, bins, **options):
    """Features ``[N, F]``, float64."""
    kind, *precision = backend.split()
    given = torch.from_numpy(bins).to(torch.float32 if precision == ["float32"] else torch.float64)
    if kind == "onnx":
        return through_onnx(FeaturePool(HAND, **options), given)
    backend = kind if kind in BACKENDS else "torch"
    arithmetic = "native" if kind == "mixed" else "double"
    found = FeaturePool(HAND, arithmetic=arithmetic, backend=backend, **options)(given)
    assert found.dtype == given.dtype
    return found.double().numpy()


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
    return session.run(None, {"samples": bins.numpy()})[0].astype(np.float64)


SIMPLE = ("mean", "std", "rms", "range", "mean_abs_change")
LINEAR = (*SIMPLE, "median", "mode", "mean_deviation", "iqr")
POWERS = {"energy": 2, **dict.fromkeys(LINEAR, 1)}
"""With which a factor of the bin is in a descriptor; 0: it is a ratio, or has a unit of its own."""


def columns(*parts):
    """Places of the features with these words in their names."""
    return [i for i, name in enumerate(NAMES) if set(parts) <= set(name.split())]


def assert_close(found, expected, bins, tolerance, names=NAMES):
    """Within a tolerance of a value or its column's scale, and the rounding of the channel's size.

    A cv is compared as mean by standard deviation where that is below 1 %: it carries the rounding
    of the mean, and its sign is that of the mean, which may be 0.
    """
    found, expected = found.copy(), expected.copy()
    assert np.isfinite(found).all()
    small = np.array([name.endswith("cv") for name in names]) & (np.abs(expected) > 100)
    for values in (found, expected):
        values[small] = 1 / values[small]
        values[small & (np.abs(values) < 1.001e-6)] = 1e-6
    power = np.array([POWERS.get(name.split()[-1], 0) for name in names])
    size = np.abs(bins).max(-1)[:, [HAND.names.index(name.split()[0]) for name in names]]
    rounding = np.where(power == 0, tolerance, 100 * oracles.EPS * size**power)
    scale = np.maximum(np.abs(expected), np.median(np.abs(expected), axis=0))
    scale[small] = 0.0
    excess = np.abs(found - expected) - np.maximum(tolerance * scale, rounding)
    wrong = [(i, names[j], found[i, j], expected[i, j]) for i, j in np.argwhere(~(excess <= 0))]
    assert not wrong, wrong[:5]


# Equal to the slow reference -------------------------------------------------------------------


def test_features_have_the_names_of_the_definitions():
    assert [str(name) for name in FeaturePool(HAND).names] == NAMES


def test_the_papers_features_come_first_and_every_channel_has_the_simple_ones():
    pool = FeaturePool(HandLayout.paper24())
    assert pool.is_paper.tolist() == [True] * 2582 + [False] * 78
    assert pool.paper().names == pool.names[:2582]
    simple = {(name.channel, name.descriptor) for name in pool.names if name.is_simple}
    assert simple == {(channel, descriptor) for channel in pool.hand.names for descriptor in SIMPLE}
    assert all(name.is_simple for name in pool.names[2582:])


@cache
def known(kind):
    """Bins of a kind and their features by the slow reference, for all backends."""
    bins = KINDS_OF_BIN[kind](np.random.default_rng(sum(map(ord, kind))))
    return bins, np.stack([oracles.pool(each, NUM_GAUGES) for each in bins])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", KINDS_OF_BIN)
def test_every_kind_of_bin_is_described_as_by_the_slow_reference(kind, backend):
    bins, expected = known(kind)
    assert_close(features_by(backend, bins), expected, bins, 1e-10)


@cache
def known_by(place, dtype):
    """Bins of a length, rounded to a dtype, and their features by the slow reference."""
    options, rng = OPTIONS[place], np.random.default_rng(place)
    num = options.get("bin_samples", 100)
    bins = rng.standard_normal((6, 4, num))
    bins[4:] = oracles.integer_bins(rng, 2, 4, num)  # ties, and an offset
    bins[4:] += [[3.0], [1.0], [2.0], [-5.0]]
    bins = bins.astype(dtype).astype(np.float64)
    given = {k: v for k, v in options.items() if k not in ("bin_samples", "spectrum")}
    method = options.get("spectrum", "reference")
    return bins, np.stack([oracles.pool(one, NUM_GAUGES, method=method, **given) for one in bins])


@pytest.mark.parametrize("backend", TOLERANCES)
@pytest.mark.parametrize("place", range(len(OPTIONS)), ids=map(str, OPTIONS))
def test_every_option_describes_as_the_slow_reference(place, backend):
    bins, expected = known_by(place, "float32" if "float32" in backend else "float64")
    found = features_by(backend, bins, **OPTIONS[place])
    names = [" ".join(n) for n in oracles.pool_names(NUM_GAUGES, 2, OPTIONS[place].get("level", 4))]
    assert_close(found, expected, bins, TOLERANCES[backend], names)


def test_channels_are_found_by_kind_wherever_they_lie(rng):
    """A hand that lists its films first has the same features in the pool's own order."""
    order, rows = [3, 0, 2, 1], HAND.to_rows()
    mixed = FeaturePool(HandLayout.from_rows([rows[i] for i in order]))
    bins, straight = torch.from_numpy(noise(rng)), FeaturePool(HAND)
    found = dict(zip(map(str, mixed.names), mixed(bins[:, order]).unbind(1), strict=True))
    found = torch.stack([found[name] for name in NAMES], 1)
    torch.testing.assert_close(found, straight(bins), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_chosen_features_are_those_of_the_whole_pool(backend, rng):
    bins = torch.from_numpy(noise(rng))
    pool = FeaturePool(HAND)
    wanted = [int(i) for i in rng.permutation(len(NAMES))[:40]]
    found = pool.select(wanted, backend=backend)(bins)
    torch.testing.assert_close(found, pool(bins)[:, wanted], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("num", [99, 100])
@pytest.mark.parametrize("wanted", [{"median"}, {"iqr"}, {"median", "mode"}])
def test_order_statistics_alone_sort_no_more_than_they_need(wanted, num, rng):
    pool = FeaturePool(HAND, bin_samples=num, level=1)
    bins = torch.from_numpy(rng.standard_normal((4, 4, num)))
    chosen = [i for i, name in enumerate(pool.names) if name.descriptor in wanted]
    found = through_onnx(pool, bins, chosen)
    np.testing.assert_allclose(found, pool(bins)[:, chosen].numpy(), rtol=1e-9, atol=1e-12)


def plain_statistics(bins):
    """Of ``[N, C, n]`` the simple statistics by channel, ``[N, C, 5]``, in NumPy's own words."""
    change = np.abs(np.diff(bins, axis=-1)).mean(-1)
    rms = np.sqrt((bins**2).mean(-1))
    found = [bins.mean(-1), bins.std(-1, ddof=1), rms, np.ptp(bins, axis=-1), change]
    return np.stack(found, -1)


@pytest.mark.parametrize("backend", [*BACKENDS, "onnx"])
@pytest.mark.parametrize("num", [13, 100, 101])
def test_simple_statistics_alone_are_numpys_and_need_nothing_but_the_bin(num, backend, rng):
    """A hand that lists a fast channel first, and another between slow ones."""
    rows = HAND.to_rows()
    hand = HandLayout.from_rows([rows[i] for i in (2, 0, 3, 1)])
    pool = FeaturePool(hand, bin_samples=num, level=1)
    names = [FeatureName(c, "raw", "time", d) for c in hand.names for d in SIMPLE]
    places = pool.places(names)
    assert {row.kind for row in pool.select(places).plan.rows} == {"raw"}
    bins = rng.standard_normal((40, 4, num)) * 10.0 ** rng.integers(-6, 6, (40, 4, 1))
    bins[::2] += rng.uniform(-5, 5, (20, 4, 1))
    bins[3], bins[4] = 0.0, 0.25
    given = torch.from_numpy(bins)
    if backend == "onnx":
        found = through_onnx(pool, given, places)
    else:
        found = pool.select(places, backend)(given).numpy()
    found, expected = found.reshape(40, 4, 5), plain_statistics(bins)
    rounding = 1e-13 * np.abs(bins).max(-1, keepdims=True)
    assert (np.abs(found - expected) <= 1e-10 * np.abs(expected) + rounding).all()
    assert not found[3].any()
    assert not found[4][:, [1, 3, 4]].any()


# Extremes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("exponent", [-900, -60, 60, 400, 990])
def test_a_scaled_bin_has_scaled_features_as_far_as_numbers_go(exponent, backend, rng):
    """Factors are powers of two, so nothing is rounded; beyond the largest number it is taken."""
    bins, largest = noise(rng), np.finfo(np.float64).max
    power = np.array([POWERS.get(name.split()[-1], 0) for name in NAMES])
    with np.errstate(over="ignore", under="ignore"):
        factor = np.ldexp(1.0, exponent * power).clip(0, largest)
        expected = np.ldexp(features_by("torch", bins), exponent * power)
        expected = expected.clip(-largest, largest)
        found = features_by(backend, np.ldexp(bins, exponent))
        close = np.abs(found - expected) <= 1e-9 * np.abs(expected) + 1e-12 * factor
    assert close.all(), [NAMES[j] for _, j in np.argwhere(~close)[:5]]


@pytest.mark.parametrize("backend", BACKENDS)
def test_features_of_denormal_samples_are_finite(backend, rng):
    assert np.isfinite(features_by(backend, noise(rng, 1e-310))).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_spoils_its_channel_alone(bad, backend, rng):
    bins = noise(rng)
    expected = features_by("torch", bins)
    bins[1, 2, 50] = bad
    expected[1, columns("PVDF1")] = np.nan
    found = features_by(backend, bins)
    found[np.isinf(found)] = np.nan
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


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
STILL += ("mean_abs_change",)


@pytest.mark.parametrize("level", [1.0, 0.1, -5.0, 3e-5, 0.0, 1e-30])
def test_a_constant_bin_has_the_stated_values(level):
    features = FeaturePool(HAND)(torch.full((4, 100), level, dtype=torch.float64))
    for descriptor in STILL:
        assert not features[columns("time", descriptor)].any(), descriptor
    assert (features[columns("time", "kurtosis")] == 3).all()
    for name, value in zip(NAMES, features.tolist(), strict=True):
        _, component, domain, descriptor = name.split()
        here = 0.0 if component[0] == "D" else level
        stated = {"mean": here, "median": here, "mode": here, "energy": 100 * here**2}
        stated |= {"peak_factor": np.sign(here), "rms": abs(here)}
        if domain == "time" and descriptor in stated:
            assert value == pytest.approx(stated[descriptor], rel=1e-13), name
        if level == 0 and domain == "freq":
            assert value == (3 if descriptor == "kurtosis" else 0), name
        elif domain == "freq" and component[0] == "A" and descriptor in KNOWN:
            assert value == pytest.approx(KNOWN[descriptor], abs=5.01e-4), name
        elif domain == "freq" and descriptor == "band_energy_ratio":
            assert value == pytest.approx(0.25 if component[0] == "A" else 0, abs=1e-12), name


# Manners and gradients -----------------------------------------------------------------------


def test_manners(device, rng):
    pool = FeaturePool(HAND).to(device)
    bins = torch.from_numpy(noise(rng)).to(device)
    normal = pool(bins).abs().mean(0) + 1e-12  # columns differ in size by many decades
    oracles.assert_manners(lambda bins: pool(bins) / normal.to(bins), bins, num_axes=2)
    assert list(pool.parameters()) == []


@pytest.mark.parametrize("num", [12, 13])
@pytest.mark.parametrize("descriptor", [*DESCRIPTORS, "band_energy_ratio"])
def test_first_and_second_derivatives(descriptor, num, rng):
    """Of bins without near ties, between which median, iqr and mode would choose."""
    hand = HandLayout.from_rows(HAND.to_rows()[1:3])
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
    bins, way = (torch.from_numpy(rng.standard_normal((2, 4, 100))) for _ in range(2))
    torch.testing.assert_close(torch.func.vmap(pool)(bins), pool(bins))
    x = bins.clone().requires_grad_()
    weights = torch.from_numpy(rng.standard_normal(len(NAMES)))
    _, slope = torch.func.jvp(lambda x: pool(x) @ weights, (bins,), (way,))
    (pull,) = torch.autograd.grad((pool(x) @ weights).sum(), x)
    torch.testing.assert_close(slope, (pull * way).sum((-2, -1)))


# Errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(4, 99), (2, 100), (5, 3, 100), (100,), (100, 4)])
def test_errors_name_shape_and_dtype(shape, backend):
    pool = FeaturePool(HAND, backend=backend)
    with pytest.raises(ValueError, match=rf"4, 100.*{', '.join(map(str, shape))}"):
        pool(torch.zeros(shape))
    with pytest.raises(ValueError, match=r"float32 or float64 .*int64"):
        pool(torch.zeros(4, 100, dtype=torch.int64))


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
