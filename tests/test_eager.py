"""The eager engine equals the reference, on bins of every kind and for any part of the pool."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from engine_bins import (
    KINDS,
    assert_equals_reference,
    assert_modes_are_fair,
    bins_of,
    some_hand,
)

from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.features.eager.engine import EagerEngine
from tactslip_torch.features.eager.linear import linear_of
from tactslip_torch.features.eager.order import quantile_weights, rank_in_run
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import make_plan
from tactslip_torch.signals.spectrum import amplitude_spectrum
from tactslip_torch.signals.wavelet import branch_names, wavelet_branches

STATISTICS = {"double": torch.float64, "mixed": torch.float32}
HAND = some_hand("GFF")
DESCRIPTORS = sorted({name.descriptor for name in FeaturePool(HAND).names})


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


class Running:
    """An engine, its plan, and bins of any number cut into chunks for it."""

    def __init__(self, pool, names, statistics="double"):
        self.plan = make_plan(pool.hand, pool.level, names)
        self.engine = EagerEngine(pool, self.plan, STATISTICS[statistics])

    def __call__(self, bins, dtype=torch.float64):
        x = bins[:, list(self.plan.channels)].contiguous()
        out = torch.full((len(bins), self.plan.num_features), torch.nan, dtype=dtype)
        size = self.engine.chunk_bins
        for chunk, part in zip(x.split(size), out.split(size), strict=True):
            self.engine(chunk, chunk.abs().amax(-1), part)
        return out


def reference(pool, bins, names):
    columns = [pool.names.index(name) for name in names]
    return pool(bins)[:, columns]


# Equal to the reference ----------------------------------------------------------------------


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize("spectrum", ["reference", "clean"])
@pytest.mark.parametrize("kind", KINDS)
def test_whole_pool_on_bins_of_every_kind(kind, spectrum, statistics):
    pool = FeaturePool(HAND, spectrum=spectrum)
    bins = bins_of(kind, 30, HAND, 100, generator())
    found = Running(pool, pool.names, statistics)(bins)
    assert_equals_reference(found, pool(bins), pool.names, statistics == "mixed")
    if statistics == "mixed":
        assert_modes_are_fair(found[:6], bins[:6], pool, pool.names)


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize(("num", "level"), [(50, 3), (64, 3), (101, 4), (20, 1)])
@pytest.mark.parametrize("spectrum", ["reference", "clean"])
def test_other_lengths_and_levels(num, level, spectrum, statistics):
    hand = some_hand("FG")
    pool = FeaturePool(hand, bin_samples=num, level=level, spectrum=spectrum)
    run = Running(pool, pool.names, statistics)
    for kind in ("random", "tied", "impulses"):
        bins = bins_of(kind, 20, hand, num, generator())
        assert_equals_reference(run(bins), pool(bins), pool.names, statistics == "mixed")


def test_rows_too_long_to_be_counted_in_bytes():
    pool = FeaturePool(some_hand("FG"), bin_samples=400, level=2)
    run = Running(pool, pool.names)
    for kind in ("tied", "square", "constants"):
        bins = bins_of(kind, 12, pool.hand, 400, generator())
        assert_equals_reference(run(bins), pool(bins), pool.names, mixed=False)


@pytest.mark.parametrize("kinds", ["F", "G", "GG", "FF", "FGFGF"])
def test_other_hands(kinds):
    pool = FeaturePool(some_hand(kinds))
    bins = bins_of("random", 20, pool.hand, 100, generator())
    found = Running(pool, pool.names)(bins)
    assert_equals_reference(found, pool(bins), pool.names, mixed=False)


@pytest.mark.parametrize("statistics", STATISTICS)
def test_the_papers_hand(statistics):
    pool = FeaturePool(HandLayout.paper24())
    bins = bins_of("tied", 40, pool.hand, 100, generator())
    run = Running(pool, pool.names, statistics)
    assert run.engine.chunk_bins < len(bins)
    assert_equals_reference(run(bins), pool(bins), pool.names, statistics == "mixed")


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize("descriptor", DESCRIPTORS)
def test_each_descriptor_alone(descriptor, statistics):
    pool = FeaturePool(HAND)
    names = [name for name in pool.names if name.descriptor == descriptor]
    run = Running(pool, names, statistics)
    for kind in ("random", "near_constant", "zeros", "constants"):
        bins = bins_of(kind, 20, HAND, 100, generator())
        expected = reference(pool, bins, names)
        assert_equals_reference(run(bins), expected, names, statistics == "mixed")


@pytest.mark.parametrize("channel", HAND.names)
def test_one_channel(channel):
    pool = FeaturePool(HAND)
    names = [name for name in pool.names if name.channel == channel]
    bins = bins_of("random", 20, HAND, 100, generator())
    found = Running(pool, names)(bins)
    assert_equals_reference(found, reference(pool, bins, names), names, mixed=False)


@pytest.mark.parametrize("spectrum", ["reference", "clean"])
@pytest.mark.parametrize("size", [1, 2, 5, 20, 100])
@pytest.mark.parametrize("seed", range(3))
def test_random_parts_in_any_order(size, seed, spectrum, rng):
    pool = FeaturePool(some_hand("GFFF"), spectrum=spectrum)
    names = [pool.names[i] for i in rng.integers(len(pool.names), size=size)]  # repeats too
    run = Running(pool, names)
    for kind in ("random", "dead_channel"):
        bins = bins_of(kind, 20, pool.hand, 100, generator(seed))
        assert_equals_reference(run(bins), reference(pool, bins, names), names, mixed=False)


def test_spectra_alone_know_which_branches_are_rounding():
    pool = FeaturePool(some_hand("FFF"))
    in_frequency = [name for name in pool.names if name.domain == "freq"]
    noise = bins_of("random", 30, pool.hand, 100, generator())
    size = 10.0 ** -torch.arange(30)[:, None, None]  # of vibration; branches go one by one
    bins = 1 + size * noise
    alone = Running(pool, in_frequency)(bins)
    among = Running(pool, pool.names)(bins)
    columns = [pool.names.index(name) for name in in_frequency]
    torch.testing.assert_close(alone, among[:, columns], rtol=1e-9, atol=1e-9)
    energies = [name for name in in_frequency if name.descriptor == "band_energy_ratio"]
    columns = [pool.names.index(name) for name in energies]
    torch.testing.assert_close(
        Running(pool, energies)(bins), among[:, columns], rtol=1e-9, atol=0.0
    )


@pytest.mark.parametrize(("num", "level"), [(100, 4), (50, 3), (20, 1)])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_small_values_beside_a_spike_keep_their_digits_in_float32(offset, num, level):
    pool = FeaturePool(HAND, bin_samples=num, level=level)
    bins = bins_of("impulses", 60, HAND, num, generator())
    bins[::2] *= 1e3  # volts; the others are noise of one volt, which says what is usual
    bins += offset
    found, expected = Running(pool, pool.names, "mixed")(bins), pool(bins)
    assert_equals_reference(found, expected, pool.names, mixed=True)


@pytest.mark.parametrize("descriptor", ["median", "iqr"])
def test_a_spike_for_each_descriptor_alone(descriptor):
    pool = FeaturePool(HAND)
    names = [name for name in pool.names if name.descriptor == descriptor]
    spikes = 1e3 * bins_of("impulses", 20, HAND, 100, generator())
    among = Running(pool, pool.names, "mixed")(spikes)
    columns = [pool.names.index(name) for name in names]
    found = Running(pool, names, "mixed")(spikes)
    torch.testing.assert_close(found, among[:, columns], rtol=1e-4, atol=1e-10)
    for seed in range(8):  # parts of rows, in any order
        pick = torch.randperm(len(names), generator=generator(seed))[:5].tolist()
        found = Running(pool, [names[i] for i in pick], "mixed")(spikes)
        torch.testing.assert_close(
            found, among[:, [columns[i] for i in pick]], rtol=1e-4, atol=1e-10
        )


# Manners -------------------------------------------------------------------------------------


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize("num", [1, 7, 200])
def test_any_number_of_bins(num, statistics):
    pool = FeaturePool(HAND)
    run = Running(pool, pool.names, statistics)
    bins = bins_of("random", 200, HAND, 100, generator())
    assert 7 < run.engine.chunk_bins < 200
    found = run(bins[:num])
    expected = pool(bins)
    padded = torch.cat([found, expected[num:]])  # the usual spread of a column is that of many bins
    assert_equals_reference(padded, expected, pool.names, statistics == "mixed")


def test_same_bin_in_the_same_place_has_the_same_bits():
    pool = FeaturePool(HAND)
    run = Running(pool, pool.names)
    num = run.engine.chunk_bins
    bins = bins_of("tied", num, HAND, 100, generator())
    first = run(bins)
    for kind in ("constants", "zeros", "near_constant"):
        run(bins_of(kind, num, HAND, 100, generator()))
    assert torch.equal(run(bins), first)
    torch.empty(12345).fill_(torch.nan)
    assert torch.equal(Running(pool, pool.names)(bins), first)


def test_input_stays_as_it_is():
    pool = FeaturePool(HAND)
    run = Running(pool, pool.names)
    x = bins_of("constants", 5, HAND, 100, generator())
    scale = x.abs().amax(-1)
    before, size = x.clone(), scale.clone()
    run.engine(x, scale, torch.empty(5, len(pool.names)))
    assert torch.equal(x, before)
    assert torch.equal(scale, size)


def test_float32_out_is_rounded_once_and_saturates():
    pool = FeaturePool(HAND)
    run = Running(pool, pool.names)
    bins = bins_of("random", 8, HAND, 100, generator())
    assert torch.equal(run(bins, torch.float32), run(bins).float())
    huge = run(1e30 * bins, torch.float32)
    of_energy = torch.tensor([name.descriptor == "energy" for name in pool.names])
    assert (huge[:, of_energy] == torch.finfo(torch.float32).max).all()
    assert huge.isfinite().all()


@pytest.mark.parametrize("exponent", [-300, 400])
def test_ordinary_sizes_need_no_guard(exponent):
    pool = FeaturePool(HAND)
    bins = bins_of("random", 20, HAND, 100, generator()) * 2.0**exponent
    for statistics in STATISTICS:
        found = Running(pool, pool.names, statistics)(bins)
        assert_equals_reference(found, pool(bins), pool.names, statistics == "mixed")


def test_small_lines_beside_an_offset_keep_their_digits_in_float32():
    pool = FeaturePool(some_hand("F"), spectrum="clean")
    names = [n for n in pool.names if n.domain == "freq" and n.descriptor in ("median", "iqr")]
    bins = 1 + 1e-4 * bins_of("random", 40, pool.hand, 100, generator())
    found = Running(pool, names, "mixed")(bins)
    torch.testing.assert_close(found, reference(pool, bins, names), rtol=1e-5, atol=0)


@pytest.mark.parametrize("statistics", STATISTICS)
def test_two_threads_at_once_on_batches_of_any_size(statistics):
    pool = FeaturePool(HAND)
    run = Running(pool, pool.names, statistics)
    sizes = (64, 1, 33, 7, 64, 2, 90, 1)
    batches = [
        bins_of(("random", "tied", "impulses", "constants")[seed % 4], size, HAND, 100, generator())
        for seed, size in enumerate(sizes)
    ]
    expected = [Running(pool, pool.names, statistics)(bins) for bins in batches]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(run, batches * 3))
    for one, other in zip(found, expected * 3, strict=True):
        assert torch.equal(one, other)


def test_another_dtype_of_statistics_is_refused():
    pool = FeaturePool(HAND)
    plan = make_plan(HAND, pool.level, pool.names[:1])
    with pytest.raises(ValueError, match=r"float32 or float64, got torch\.float16"):
        EagerEngine(pool, plan, torch.float16)


# What it is made of --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_ranks_count_within_runs(kind, rng):
    continues = (rng.random((40, 100)) < rng.random((40, 1))).astype(kind)
    continues[0], continues[:, 0] = 1, 0
    continues[0, 0] = 0
    expected = np.zeros_like(continues)
    for row, flags in enumerate(continues):
        for place in range(1, 100):
            expected[row, place] = (expected[row, place - 1] + 1) * flags[place]
    flat = continues.ravel()
    found = rank_in_run(flat, np.empty_like(flat), np.empty_like(flat))
    np.testing.assert_array_equal(found, expected.ravel())


@pytest.mark.parametrize("num", [2, 3, 50, 100, 101])
def test_quantiles_are_those_of_numpy(num, rng):
    places, weights = quantile_weights(num)
    x = np.sort(rng.standard_normal(num))
    low, high = np.quantile(x, [0.25, 0.75], method="hazen")
    np.testing.assert_allclose(weights @ x[places], [np.median(x), high - low], rtol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_blocks_form_branches_and_spectra(seed):
    pool = FeaturePool(some_hand("FFFF"))
    rng = np.random.default_rng(seed)
    names = [pool.names[i] for i in rng.integers(len(pool.names), size=(2, 8, 30)[seed % 3])]
    plan = make_plan(pool.hand, pool.level, names)
    linear = linear_of(plan, LinearMaps.of(pool))
    bins = torch.randn(4, 100, generator=generator(seed), dtype=torch.float64)
    bins[:, 1:] += 3 - bins[:, :1]  # an offset
    films = bins[list(plan.channels)]
    relative = films - films[:, :1]
    relative[:, 0] = films[:, 0]
    small = relative @ linear.into
    branches = wavelet_branches(films)
    of_first = torch.tensor([name[0] == "A" for name in branch_names(pool.level)])
    from_first = branches - torch.where(of_first[:, None], films[:, None, :1], 0.0)
    lines = torch.fft.rfft(branches, n=256)[..., :100] / 198
    lines[..., 1:99] *= 2
    torch.testing.assert_close(lines.abs(), amplitude_spectrum(branches))
    for blocks, expected in (
        (linear.time, from_first),
        (linear.freq, torch.cat([lines.real, lines.imag], -1)),
    ):
        formed = []
        for block in blocks:
            if block.parts is not None:
                found = formed[block.parts[0]] + formed[block.parts[1]]
            else:
                source = relative if block.columns is None else small[:, block.columns]
                found = source[list(block.films)] @ block.matrix
            formed.append(found)
            torch.testing.assert_close(
                found, expected[list(block.films), block.branch], rtol=1e-9, atol=1e-9
            )


def test_how_numpy_treats_errors_is_the_callers_business():
    bins = bins_of("random", 3, HandLayout.paper24(), 100, torch.Generator().manual_seed(0))
    extractor = FeatureExtractor(FeaturePool(HandLayout.paper24()), None, "eager")
    expected = extractor(bins * 2.0**-310)
    with np.errstate(all="raise"):
        assert torch.equal(extractor(bins * 2.0**-310), expected)
