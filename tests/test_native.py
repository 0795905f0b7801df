"""The native engine: values of the reference, limits, manners; built, found, and done without."""

import multiprocessing
import os
import shlex
import stat
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import torch
from small_detector import HAND, raw_bins, small_detector
from test_detector import noise as noisy_bins
from test_detector import random_detector

from tactslip_torch import FeaturePool, HandLayout, native
from tactslip_torch.features.bank import make_plan
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import build

POOL = FeaturePool(HAND, backend="torch")
NAMES = POOL.names
LEVELS = (
    ("v2", "v3", "v4")
    if not native.reason_unavailable() and native.instruction_set() != "v1"
    else ()
)
needs_engine = pytest.mark.skipif(
    bool(native.reason_unavailable()), reason=native.reason_unavailable()
)


def made(pool, selected=None, backend="auto"):
    """The pool, or some of it, by another backend."""
    return pool.select(range(len(pool.names)) if selected is None else selected, backend)


def noise(num, hand=HAND, dtype=torch.float64):
    shape = (num, len(hand), 100)
    return torch.randn(shape, generator=torch.Generator().manual_seed(5), dtype=dtype)


# Values --------------------------------------------------------------------------------------


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
def test_instruction_sets_agree_on_the_papers_hand(level, monkeypatch):
    pool, best = FeaturePool(HandLayout.paper24()), native.instruction_set()
    bins = noise(20, pool.hand).mul(900).round()  # counts of a converter, some of them equal
    plain = pool(bins)
    monkeypatch.setenv("TACTSLIP_NATIVE", level)
    assert native.instruction_set() == min(level, best)
    fresh = made(pool)
    for num in (1, 20):
        # v2 has no product and sum in one rounding, which a cv of a mean about 0 magnifies
        torch.testing.assert_close(fresh(bins[:num]), plain[:num], rtol=1e-11, atol=1e-11)


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("setting", [["mean", "std", "min", "max"], "sorted"], ids=str)
def test_a_bin_alone_has_exactly_the_columns_it_has_among_others(level, setting, rng, monkeypatch):
    """Lanes across families and columns do what lanes across bins do, lost channels included."""
    monkeypatch.setenv("TACTSLIP_NATIVE", level)
    hand = HandLayout.paper24()
    names = [n for n in FeaturePool(hand, level=1).names if "A1" not in str(n)]
    features = torch.from_numpy(rng.standard_normal((43, len(names))) * 10 ** rng.uniform(-3, 3))
    layer = ChannelPooling.fit(hand, names, features, setting).with_channels(names[:5])
    place = {name: index for index, name in enumerate(names)}
    inputs = features[:, [place[name] for name in layer.inputs]].numpy()
    columns = np.r_[: len(layer.names), 3:20, 3]
    low = rng.standard_normal(len(columns))
    width, compression = np.exp(rng.standard_normal((2, len(columns))))
    width[7] = 0
    of_channel = np.where(columns < 5, columns, -1)
    machine = layer.machine(
        scaling=(low, low + width, compression, columns),
        imputation=(np.full(len(columns), 0.4), of_channel),
    )
    is_lost = rng.uniform(size=(43, 24)) < 0.2
    is_lost[1] = True
    is_lost[2:9] = False
    inputs[4, ::7] = np.nan
    inputs[5, ::5] = 1e300
    found = machine.columns(inputs, is_lost)
    alone = [machine.columns(inputs[i : i + 1], is_lost[i : i + 1]) for i in range(43)]
    np.testing.assert_array_equal(np.concatenate(alone), found)
    assert np.isnan(found).any(1).nonzero()[0].tolist() == [4]
    assert (found[1, of_channel >= 0] == 0.4).all()


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("num_factors", [None, 3, 11])
def test_a_bin_alone_has_exactly_the_score_it_has_among_others(level, num_factors, monkeypatch):
    """More factors and columns than a vector holds, and than a multiple of vectors."""
    monkeypatch.setenv("TACTSLIP_NATIVE", level)
    heads = {"num_quadratic": 19, "num_factors": num_factors}
    detector, bins = random_detector(compress=True, num_repeated=12, **heads), noisy_bins(43)
    bins[2:9, detector.needed_index[1]] = torch.nan
    found = detector.score_raw(bins)
    alone = torch.cat([detector.score_raw(one) for one in bins.split(1)])
    assert torch.equal(alone, found)
    by_torch = detector.score_raw(bins.requires_grad_()).detach()
    torch.testing.assert_close(found, by_torch, rtol=1e-9, atol=1e-9)


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
def test_in_float32_throughout_scores_are_within_the_stated_margin(level, monkeypatch):
    monkeypatch.setenv("TACTSLIP_NATIVE", level)
    bins, in_float32 = raw_bins(203, seed=3).float(), small_detector(arithmetic="native")
    exact, found = small_detector().score_raw(bins.double()), in_float32.score_raw(bins)
    error = (found - exact).abs().max()
    assert 1e-9 < error < 1e-4 * exact.std()  # not 0: it is not the engine of float64
    alone = torch.cat([in_float32.score_raw(one) for one in bins.split(1)])
    assert torch.equal(alone, found)


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
def test_correlation_near_one_is_right_to_its_last_digit_in_float32(level, monkeypatch):
    """A sum in float32 leaves three digits of what is missing to 1, some 1e-4."""
    monkeypatch.setenv(native.SWITCH, level)
    rate = torch.linspace(1, 6, 40)[:, None, None]
    bins = (torch.sin(rate * torch.arange(100) / 100) + 0.01 * noise(40)).float()
    is_wanted = [name.descriptor == "correlation" and name.component == "A1" for name in NAMES]
    pool = FeaturePool(HAND, backend="native", arithmetic="native")
    found, exact = pool(bins)[:, is_wanted].double(), POOL(bins.double())[:, is_wanted]
    assert exact.min() > 0.99
    assert 1 - exact.max() < 1e-3
    torch.testing.assert_close(found, exact, rtol=0, atol=2.0**-24)


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("num", [1, 20])
def test_channels_that_lie_close_together_stay_apart_in_float32(level, num, rng, monkeypatch):
    """The standard deviation of compressed values that differ by 1e-4 of their size."""
    monkeypatch.setenv(native.SWITCH, level)
    wide = torch.from_numpy(rng.uniform(-1, 1, (43, len(NAMES))))
    layer = ChannelPooling.fit(HAND, NAMES, wide, ["std"])
    away = np.array([1e-4 if name.channel.endswith("1") else -1e-4 for name in layer.inputs])
    size = 10 ** rng.uniform(-3, 3, (num, 1))
    inputs = np.float32(size * (1 + away * rng.uniform(0.5, 1, (num, len(away)))))
    found = layer.machine(dtype=np.float32).columns(inputs)
    exact = layer(torch.from_numpy(inputs).double()).numpy()
    np.testing.assert_allclose(found, exact, 1e-6)


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("compression", [None, 1e-3, 1.0, 1e7])
@pytest.mark.parametrize("num", [1, 20])
def test_columns_of_a_narrow_range_keep_their_digits_in_float32(
    level, compression, num, rng, monkeypatch
):
    """Within 1e-5 of a range of 2, of which float32 rounds such a value to 1e-3."""
    monkeypatch.setenv(native.SWITCH, level)
    centre = np.float32(rng.choice([-1, 1], 33) * 10 ** rng.uniform(-6, 6, 33))
    scales = None if compression is None else compression * np.abs(centre).astype(np.float64)

    def compressed(x):
        x = x.astype(np.longdouble)
        return x if scales is None else np.sign(x) * scales * np.log1p(np.abs(x) / scales)

    ends = np.sort([compressed(centre * np.float32(f)) for f in (0.9999, 1.0002)], axis=0)
    values = centre * np.float32(1 + 1e-4 * rng.uniform(-0.9, 1.9, (num, 33)))
    values[:, 0], values[:, 1], values[:, 2] = -centre[0], 0.0, 1e3 * centre[2]
    machine = native.Machine(
        num_channels=1,
        num_inputs=33,
        num_columns=33,
        singles=[(i, i) for i in range(33)],
        scaling=(*ends.astype(np.float64), scales, None),
        dtype=np.float32,
    )
    # the ends are float64 in a file
    low, high = ends.astype(np.float64).astype(np.longdouble)
    expected = np.clip(2 * (compressed(values) - low) / (high - low) - 1, -1, 1)
    np.testing.assert_allclose(machine.columns(values), expected.astype(np.float64), 0, 1e-5)


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("num", [1, 20])
def test_wide_columns_are_scaled_as_well_and_alike_beside_a_narrow_one(
    level, num, rng, monkeypatch
):
    """Of values far below and far above the scale of their compression, in float32."""
    monkeypatch.setenv(native.SWITCH, level)
    size, scales = 10 ** rng.uniform(-25, 25, 33), np.ones(33)
    values = np.float32(size * rng.uniform(-1, 1, (num, 33)))

    def machine(low, high):
        return native.Machine(
            num_channels=1,
            num_inputs=33,
            num_columns=33,
            singles=[(i, i) for i in range(33)],
            scaling=(low, high, scales, None),
            dtype=np.float32,
        )

    high, x = np.log1p(size), values.astype(np.float64)
    alone = machine(-high, high)
    assert alone.of.centre is None  # which would be paid for by every column
    found = alone.columns(values)
    expected = np.sign(x) * np.log1p(np.abs(x)) / high
    np.testing.assert_allclose(found, expected, 0, 1e-6)
    low, high[-1] = -high, 10.001
    low[-1] = 9.999
    beside = machine(low, high)
    assert beside.of.centre
    np.testing.assert_array_equal(beside.columns(values)[:, :-1], found[:, :-1])


@pytest.mark.parametrize("num", [1, 20])
@pytest.mark.parametrize(
    ("wanted", "read"),
    [
        (["PVDF1 A1 freq mean", "PVDF2 A4 freq std"], "A1 D2 D3 D4 A4"),
        (["PVDF1 A3 freq mean", "PVDF2 A2 freq std", "PVDF2 D1 freq mean"], "D1 A2 D3 A3"),
        (["PVDF1 D2 freq mean", "PVDF2 A2 time std"], "D2"),
        (["PVDF1 A2 freq mean", "PVDF3 D4 freq band_energy_ratio"], "D1 A2 D2 D3 D4 A4"),
    ],
)
def test_spectra_that_nothing_reads_are_no_part_of_the_plan(wanted, read, num):
    """Channels of one group may want those of other branches."""
    pool = FeaturePool(HandLayout.paper24())
    names = [str(name) for name in pool.names]
    some = pool.select([names.index(name) for name in wanted])
    bins = noise(num, pool.hand)
    torch.testing.assert_close(some(bins), made(some, backend="torch")(bins))
    plan = some.engine(torch.float64).plan
    lines = (native._Matrix * plan.num_branches).from_address(plan.lines)
    kept = {f"{'AD'[b % 2]}{b // 2 + 1}" for b, matrix in enumerate(lines) if matrix.values}
    assert kept == set(read.split())


LONG = {
    (256, "reference"): 0,
    (300, "reference"): 1024,
    (999, "clean"): 0,
    (512, "clean"): 512,
    (1000, "clean"): 1000,
    (1000, "reference"): 2048,
    (1024, "reference"): 2048,
}


@needs_engine
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize(("num", "spectrum"), LONG, ids=str)
def test_spectra_of_long_bins_are_transforms_and_as_exact(num, spectrum, level, monkeypatch):
    monkeypatch.setenv(native.SWITCH, level)
    options = {"bin_samples": num, "spectrum": spectrum}
    whole = FeaturePool(HAND, **options)
    steady = [i for i, n in enumerate(whole.names) if n.descriptor not in ("mode", "entropy")]
    pool, bins = whole.select(steady), raw_bins(20, num_samples=num)
    assert pool.engine(torch.float64).plan.num_points == LONG[num, spectrum]
    exact = made(pool, backend="torch")(bins)
    for count in (1, 20):
        torch.testing.assert_close(pool(bins[:count]), exact[:count], rtol=1e-10, atol=1e-10)
    rounded = bins.float()
    exact = made(pool, backend="torch")(rounded.double())

    def error():
        in_float32 = FeaturePool(HAND, **options, arithmetic="native").select(steady)
        lines = [i for i, name in enumerate(pool.names) if name.domain == "freq"]
        return float(((in_float32(rounded) - exact) / exact.abs())[:, lines].abs().median())

    by_transform = error()
    monkeypatch.setattr(native, "_SHORT", num)
    assert by_transform < min(1e-6, 1.1 * error())


# Manners -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("backend", "num"), [("torch", 3), *(("auto", n) for n in (0, 1, 131))])
def test_threads_and_number_of_bins_change_nothing(backend, num):
    extractor, bins = made(POOL, backend=backend), noise(num)
    before, found = torch.get_num_threads(), {}
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found[threads] = extractor(bins)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[1], found[2])
    assert found[1].shape == (num, len(NAMES))
    if num:
        torch.testing.assert_close(found[1][:1], extractor(bins[:1]), rtol=1e-11, atol=1e-11)


def scores_of(seed):
    """By a detector of its own, in this thread or process."""
    samples = raw_bins(40, seed)
    return small_detector().score_raw(samples).numpy()


@pytest.mark.parametrize("how", ["threads", "fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_detectors_in_threads_and_processes_score_alike(how):
    expected = [scores_of(seed) for seed in range(4)]
    if how == "threads":
        pool = ThreadPoolExecutor(2)
    else:
        pool = ProcessPoolExecutor(2, multiprocessing.get_context(how))
    with pool:
        for found, one in zip(pool.map(scores_of, range(4)), expected, strict=True):
            np.testing.assert_allclose(found, one, rtol=1e-12, atol=1e-12)


# Built and found ---------------------------------------------------------------------------------


REFUSED = [
    ({"selected": []}, "empty selection"),
    ({"selected": [len(NAMES)]}, rf"must lie in 0..{len(NAMES) - 1}, the pool's {len(NAMES)}"),
    ({"backend": "fast"}, "backend must be one of auto, native, torch, got 'fast'"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED)
def test_what_is_refused_is_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        made(POOL, **arguments)
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="unknown feature 'PVDF3 A9 freq kurtosis', exp"):
        make_plan(HAND, 4, ["PVDF3 A9 freq kurtosis"])


def test_a_gradient_asked_for_after_use_is_given():
    detector, bins = small_detector(), raw_bins(2)
    detector.score_raw(bins)
    detector.head.linear.requires_grad_()
    detector.score_raw(bins).sum().backward()
    assert detector.head.linear.grad.abs().max() > 0


@pytest.fixture
def anew(monkeypatch):
    """The library is looked for again, here and afterwards."""
    native._loaded.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    native._loaded.cache_clear()


def script(path, text):
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def quick_compiler(folder):
    """The compiler, told last not to optimise: enough where the library is built, not used."""
    found = build.find_compiler()
    if found is None or "ziglang" in found:
        pytest.skip("no C++ compiler of the system")
    return str(script(folder / "c++", f'exec {shlex.join(found)} "$@" -O0'))


def test_switched_off_torch_carries_on_and_says_so(anew, caplog):
    anew.setenv(build.SWITCH, "0")
    pool = FeaturePool(HandLayout.paper24())
    extractor = pool.select([7])
    assert extractor.backend == "torch"
    assert extractor(torch.ones(2, 24, 100)).shape == (2, 1)
    assert caplog.messages == [
        "features and simulation are made by torch, which is slower: "
        "the native engine is switched off by TACTSLIP_NATIVE=0"
    ]
    with pytest.raises(ValueError, match=r'backend "native" cannot be used: .* TACTSLIP_NATIVE=0'):
        pool.select([7], "native")


def test_without_a_compiler_the_remedy_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setitem(sys.modules, "ziglang", None)
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(OSError, match=r"no C\+\+ compiler .*; install g\+\+ .* TACTSLIP_NATIVE=0"):
        build.build_library(tmp_path)


def test_a_compiler_that_fails_is_passed_over_or_quoted(monkeypatch, tmp_path):
    broken = script(tmp_path / "broken", "exit 1")
    monkeypatch.setenv("CXX", str(broken))
    found = build.find_compiler()
    assert found is None or found[0] != str(broken)
    small = script(tmp_path / "small", 'case "$*" in *line.cpp*) exit 0;; esac\n'
                   'echo "engine.cpp:1: error: out of ideas" >&2; exit 1')  # fmt: skip
    monkeypatch.setenv("CXX", str(small))
    with pytest.raises(OSError, match=r"error: out of ideas; .* set TACTSLIP_NATIVE=0"):
        build.build_library(tmp_path / "to")
    assert not list((tmp_path / "to").glob("library.*"))


@pytest.mark.slow
def test_a_first_use_builds_into_the_users_cache_once(tmp_path):
    """Where the package's folder has no library and may not be written to."""
    code = (
        "import logging, sys; logging.basicConfig(); from pathlib import Path\n"
        "from tactslip_torch import native\n"
        "native.__file__ = sys.argv[1]\n"
        "print(native.reason_unavailable() or native.instruction_set())"
    )
    taken = tmp_path / "file"
    taken.touch()
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), build.SWITCH: ""}
    environment["CXX"] = quick_compiler(tmp_path)
    said = []
    for _ in range(2):
        command = [sys.executable, "-c", code, str(taken / "__init__.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip().startswith("v"), done.stdout
        said.append(done.stderr)
    assert "building the native engine" in said[0]
    assert "building" not in said[1]
    kept = list((tmp_path / "tactslip_torch" / "native").iterdir())
    assert [path.name for path in kept] == [build.library_name()]


# Changes and kinds of tensors that the engine must notice ---------------------------------------


class HalfScaler(FeatureScaler):
    def forward(self, features):
        return super().forward(features) / 2


def of_half(detector):
    scaler = detector.scaler
    detector.scaler = HalfScaler(scaler.minimum, scaler.maximum, scaler.compression)


CHANGES = {
    "shared memory": lambda detector: detector.share_memory(),
    "bfloat16": lambda detector: detector.bfloat16(),
    "scaler of its own": of_half,
    "forward of its own": lambda detector: setattr(detector.head, "forward", lambda z: z.sum(-1)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_detector_that_is_changed_after_use_scores_as_torch_does(change):
    found, bins = [], raw_bins(6)
    for backend in ("auto", "torch"):
        detector = small_detector(backend=backend)
        detector.score_raw(bins)
        CHANGES[change](detector)
        _ = [np.full(12, 7.0) for _ in range(500)]  # takes memory that was given back
        found.append(detector.score_raw(bins))
    torch.testing.assert_close(*found, rtol=1e-9, atol=1e-9)
