"""The feature pool, and every engine, against the slow reference on every kind of bin."""

import math
from functools import cache

import numpy as np
import oracles
import pytest
import torch

from .names import ENGINES, FeatureExtractor, FeaturePool, HandLayout, Scene, simulate

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
BEYOND_THE_REFERENCE = {
    "denormal": lambda rng: noise(rng, 1e-310),
    "huge": lambda rng: noise(rng, 1e150),
    "almost the largest": lambda rng: noise(rng, 1e300),
}
"""Kinds whose squares or cubes are no float64; what scales is read from bins of order one."""


@cache
def known(kind):
    """Bins of a kind and their features by the slow reference, for all engines."""
    bins = KINDS_OF_BIN[kind](np.random.default_rng(sum(map(ord, kind))))
    return bins, np.stack([oracles.pool(each, NUM_GAUGES) for each in bins])


def features_by(engine, bins):
    """Features ``[N, F]`` by the pool itself or an engine."""
    pool = FeaturePool(HAND)
    if engine == "reference":
        return pool(torch.from_numpy(bins))
    return FeatureExtractor(pool, engine=engine)(torch.from_numpy(bins))


LINEAR = ("mean", "median", "mode", "range", "mean_deviation", "std", "iqr")
POWERS = {"energy": 2, **dict.fromkeys(LINEAR, 1)}
POWER = np.array([POWERS.get(name.split()[-1], 0) for name in NAMES])
"""With which a factor of the bin is in each feature; 0: it is a ratio, or has a unit of its own."""


def assert_close(actual, expected, bins):
    """Within 1e-10 of a value, its column's scale or one, and the rounding of the channel's size.

    A cv is compared as mean by standard deviation where that is below 1 %: it carries the rounding
    of the mean, and its sign is that of the mean, which may be 0.
    """
    actual, expected = actual.numpy().copy(), expected.copy()
    of_cv = np.array([name.endswith("cv") for name in NAMES])
    small = of_cv & (np.abs(expected) > 100)
    for values in (actual, expected):
        values[small] = 1 / values[small]
        values[small & (np.abs(values) < 1.001e-6)] = 1e-6
    size = np.abs(bins).max(-1)[:, [HAND.names.index(name.split()[0]) for name in NAMES]]
    rounding = np.where(POWER == 0, 1e-10, 100 * oracles.EPS * size**POWER)
    scale = np.maximum(np.abs(expected), np.median(np.abs(expected), axis=0))
    scale[small] = 0.0
    excess = np.abs(actual - expected) - np.maximum(1e-10 * scale, rounding)
    wrong = [(i, NAMES[j], actual[i, j], expected[i, j]) for i, j in np.argwhere(~(excess <= 0))]
    assert not wrong, wrong[:5]


def test_features_have_the_names_of_the_definitions():
    assert [str(name) for name in FeaturePool(HAND).names] == NAMES
    assert len(FeaturePool(HandLayout.paper24()).names) == 2582


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
@pytest.mark.parametrize("kind", KINDS_OF_BIN)
def test_every_feature_equals_the_slow_reference(kind, engine):
    bins, expected = known(kind)
    assert_close(features_by(engine, bins), expected, bins)


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
@pytest.mark.parametrize("exponent", [-900, -60, 60, 400, 900])
def test_a_scaled_bin_has_scaled_features_as_far_as_numbers_go(exponent, engine, rng):
    """Factors are powers of two, so nothing is rounded; beyond the largest number it is taken."""
    bins, largest = noise(rng), np.finfo(np.float64).max
    with np.errstate(over="ignore", under="ignore"):
        factor = np.ldexp(1.0, exponent * POWER).clip(0, largest)
        expected = np.ldexp(features_by("reference", bins).numpy(), exponent * POWER)
        expected = expected.clip(-largest, largest)
        found = features_by(engine, np.ldexp(bins, exponent)).numpy()
        close = np.abs(found - expected) <= 1e-9 * np.abs(expected) + 1e-12 * factor
    assert close.all(), [NAMES[j] for _, j in np.argwhere(~close)[:5]]


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
@pytest.mark.parametrize("kind", BEYOND_THE_REFERENCE)
def test_features_are_finite_where_squares_are_not(kind, engine, rng):
    bins = BEYOND_THE_REFERENCE[kind](rng)
    found = features_by(engine, bins)
    assert found.isfinite().all()
    if kind != "denormal":  # its own digits are few
        of_order_one = features_by("reference", bins / np.abs(bins).max(axis=(-1), keepdims=True))
        same = [i for i, name in enumerate(NAMES) if name.split()[-1] in ("skewness", "kurtosis")]
        torch.testing.assert_close(found[:, same], of_order_one[:, same], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_spoils_its_channel_alone_and_is_flagged(bad, engine, rng):
    bins = noise(rng)
    clean = features_by("reference", bins)
    bins[1, 2, 50] = bad
    found = features_by(engine, bins)
    own = torch.tensor([name.startswith("PVDF1 ") for name in NAMES])
    assert not found[1, own].isfinite().any()
    torch.testing.assert_close(found[1, ~own], clean[1, ~own], rtol=1e-9, atol=1e-9)
    others = torch.arange(6) != 1
    torch.testing.assert_close(found[others], clean[others], rtol=1e-9, atol=1e-9)
    valid = FeaturePool(HAND).validity(torch.from_numpy(bins))
    assert valid.sum() == 6 * 4 - 1
    assert not valid[1, 2]


@pytest.mark.parametrize("engine", ENGINES)
def test_chosen_features_are_those_of_the_whole_pool(engine, rng):
    bins = torch.from_numpy(noise(rng))
    pool = FeaturePool(HAND)
    wanted = [int(i) for i in rng.permutation(len(NAMES))[:40]]
    found = FeatureExtractor(pool, wanted, engine=engine)(bins)
    torch.testing.assert_close(found, pool(bins)[:, wanted], rtol=1e-9, atol=1e-11)
