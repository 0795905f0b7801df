"""The compiled engine equals the reference, on bins of every kind and for any part of the pool."""

import os
import subprocess
import sys
import time
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
from tactslip_torch.features.descriptors import SPECTRUM_DESCRIPTORS, TIME_DESCRIPTORS
from tactslip_torch.features.guards import ordinary_sizes
from tactslip_torch.features.plan import make_plan

numba = pytest.importorskip("numba")
from tactslip_torch.features.compiled import engine as compiled_engine  # noqa: E402
from tactslip_torch.features.compiled import kept, numbering  # noqa: E402
from tactslip_torch.features.compiled.bins import describe_bins  # noqa: E402
from tactslip_torch.features.compiled.engine import CompiledEngine  # noqa: E402
from tactslip_torch.features.compiled.jit import kernel  # noqa: E402
from tactslip_torch.features.compiled.products import pick, shift  # noqa: E402
from tactslip_torch.features.compiled.ranked import describe_sorted  # noqa: E402
from tactslip_torch.features.compiled.read import read_bins  # noqa: E402
from tactslip_torch.features.compiled.steps import ADD, OWN, chain_of  # noqa: E402

STATISTICS = {"double": torch.float64, "mixed": torch.float32}
KERNELS = (read_bins, shift, pick, describe_bins, describe_sorted)
HAND = some_hand("GFF")
DESCRIPTORS = sorted({name.descriptor for name in FeaturePool(HAND).names})
RANKS = (51, 51, 27, 27, 15, 15, 10, 9)  # of A1, D1, A2, .. of 100 samples


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def engine_of(pool, names, statistics):
    return CompiledEngine(pool, make_plan(pool.hand, pool.level, names), STATISTICS[statistics])


def run(engine, bins, dtype=torch.float64):
    """Features of any number of bins, chunk by chunk."""
    parts = []
    for chunk in bins.split(engine.chunk_bins):
        x, scale, is_ordinary = engine.read(chunk)
        assert is_ordinary.all()
        out = torch.full((len(chunk), engine.num_features), torch.nan, dtype=dtype)
        engine(x, scale, out)
        parts.append(out)
    return torch.cat(parts)


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
    found = run(engine_of(pool, pool.names, statistics), bins)
    assert_equals_reference(found, pool(bins), pool.names, statistics == "mixed")
    if statistics == "mixed":
        assert_modes_are_fair(found[:6], bins[:6], pool, pool.names)


def taps_and_steps(kind, num, hand, n, noise):
    """Bins that are quiet but for a tap, or before and after a step; noise in parts of either."""
    made = generator(3)
    shape = (num, len(hand), n)
    place = torch.randint(1, n - 1, (*shape[:2], 1), generator=made)
    time = torch.arange(n)
    form = time == place if kind == "tap" else time >= place
    size = torch.randn(*shape[:2], 1, generator=made, dtype=torch.float64)
    return size * (form + noise * torch.randn(shape, generator=made, dtype=torch.float64))


@pytest.mark.parametrize("noise", [1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("kind", ["tap", "step"])
@pytest.mark.parametrize("num", [100, 65])
def test_quiet_but_for_a_tap_or_a_step(num, kind, noise):
    pool = FeaturePool(HAND, bin_samples=num, level=3)
    bins = taps_and_steps(kind, 40, HAND, num, noise)
    found = run(engine_of(pool, pool.names, "mixed"), bins)
    assert_equals_reference(found, pool(bins), pool.names, mixed=True)


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize(("num", "level"), [(50, 3), (64, 3), (101, 4), (20, 1)])
@pytest.mark.parametrize("spectrum", ["reference", "clean"])
def test_other_lengths_and_levels(num, level, spectrum, statistics):
    hand = some_hand("FG")
    pool = FeaturePool(hand, bin_samples=num, level=level, spectrum=spectrum)
    engine = engine_of(pool, pool.names, statistics)
    for kind in ("random", "tied", "impulses"):
        bins = bins_of(kind, 20, hand, num, generator())
        assert_equals_reference(run(engine, bins), pool(bins), pool.names, statistics == "mixed")


@pytest.mark.parametrize("kinds", ["F", "G", "GG", "FF", "FGFGF"])
def test_other_hands(kinds):
    pool = FeaturePool(some_hand(kinds))
    bins = bins_of("random", 20, pool.hand, 100, generator())
    found = run(engine_of(pool, pool.names, "double"), bins)
    assert_equals_reference(found, pool(bins), pool.names, mixed=False)


def test_the_papers_hand():
    pool = FeaturePool(HandLayout.paper24())
    bins = bins_of("tied", 40, pool.hand, 100, generator())
    found = run(engine_of(pool, pool.names, "double"), bins)
    assert_equals_reference(found, pool(bins), pool.names, mixed=False)


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize("descriptor", DESCRIPTORS)
def test_each_descriptor_alone(descriptor, statistics):
    pool = FeaturePool(HAND)
    names = [name for name in pool.names if name.descriptor == descriptor]
    engine = engine_of(pool, names, statistics)
    for kind in ("random", "near_constant", "zeros", "constants"):
        bins = bins_of(kind, 20, HAND, 100, generator())
        assert_equals_reference(
            run(engine, bins), reference(pool, bins, names), names, statistics == "mixed"
        )


@pytest.mark.parametrize("channel", HAND.names)
def test_one_channel(channel):
    pool = FeaturePool(HAND)
    names = [name for name in pool.names if name.channel == channel]
    bins = bins_of("random", 20, HAND, 100, generator())
    found = run(engine_of(pool, names, "double"), bins)
    assert_equals_reference(found, reference(pool, bins, names), names, mixed=False)


@pytest.mark.parametrize("size", [1, 2, 5, 20, 100])
@pytest.mark.parametrize("seed", range(4))
def test_random_parts_in_any_order(size, seed, rng):
    pool = FeaturePool(some_hand("GFFF"))
    names = [pool.names[i] for i in rng.integers(len(pool.names), size=size)]  # repeats too
    engine = engine_of(pool, names, "double")
    for kind in ("random", "dead_channel"):
        bins = bins_of(kind, 20, pool.hand, 100, generator(seed))
        assert_equals_reference(run(engine, bins), reference(pool, bins, names), names, mixed=False)


def test_spectra_alone_know_which_branches_are_rounding():
    pool = FeaturePool(some_hand("FFF"))
    in_frequency = [name for name in pool.names if name.domain == "freq"]
    noise = bins_of("random", 30, pool.hand, 100, generator())
    size = 10.0 ** -torch.arange(30)[:, None, None]  # of vibration; branches go one by one
    bins = 1 + size * noise
    alone = run(engine_of(pool, in_frequency, "double"), bins)
    among = run(engine_of(pool, pool.names, "double"), bins)
    columns = [pool.names.index(name) for name in in_frequency]
    torch.testing.assert_close(alone, among[:, columns], rtol=1e-9, atol=1e-9)


# Manners -------------------------------------------------------------------------------------


@pytest.mark.parametrize("statistics", STATISTICS)
@pytest.mark.parametrize("num", [1, 7, 70])
def test_any_number_of_bins(num, statistics):
    pool = FeaturePool(HAND)
    engine = engine_of(pool, pool.names, statistics)
    bins = bins_of("random", 70, HAND, 100, generator())
    found = run(engine, bins[:num])
    torch.testing.assert_close(found, run(engine, bins)[:num], rtol=1e-4, atol=1e-6)
    assert_equals_reference(run(engine, bins), pool(bins), pool.names, statistics == "mixed")


def test_same_bin_in_the_same_place_has_the_same_bits():
    pool = FeaturePool(HAND)
    engine = engine_of(pool, pool.names, "double")
    bins = bins_of("tied", engine.chunk_bins, HAND, 100, generator())
    first = run(engine, bins)
    run(engine, bins_of("constants", engine.chunk_bins, HAND, 100, generator()))
    assert torch.equal(run(engine, bins), first)


def test_float32_out_is_rounded_once_and_saturates():
    pool = FeaturePool(HAND)
    engine = engine_of(pool, pool.names, "double")
    bins = bins_of("random", 8, HAND, 100, generator())
    assert torch.equal(run(engine, bins, torch.float32), run(engine, bins).float())
    huge = run(engine, 1e30 * bins, torch.float32)
    of_energy = torch.tensor([name.descriptor == "energy" for name in pool.names])
    assert (huge[:, of_energy] == torch.finfo(torch.float32).max).all()
    assert huge.isfinite().all()


@pytest.mark.parametrize("exponent", [-300, 400])
def test_ordinary_sizes_need_no_guard(exponent):
    pool = FeaturePool(HAND)
    bins = bins_of("random", 20, HAND, 100, generator()) * 2.0**exponent
    for statistics in STATISTICS:
        found = run(engine_of(pool, pool.names, statistics), bins)
        assert_equals_reference(found, pool(bins), pool.names, statistics == "mixed")


def test_two_threads_at_once():
    pool = FeaturePool(HAND)
    engine = engine_of(pool, pool.names, "double")
    batches = [bins_of("random", 64, HAND, 100, generator(seed)) for seed in range(8)]
    expected = [run(engine, bins) for bins in batches]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda bins: run(engine, bins), batches * 3))
    for one, other in zip(found, expected * 3, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_read_takes_channels_and_finds_what_is_not_ordinary(dtype):
    pool = FeaturePool(some_hand("GFFG"))
    names = [name for name in pool.names if name.channel in ("SG1", "PVDF2")]
    engine = engine_of(pool, names, "double")
    bins = bins_of("random", 8, pool.hand, 100, generator()).to(dtype)
    bins[1, 0, 99], bins[2, 2, 50], bins[3, 0, 0] = torch.nan, torch.inf, -torch.inf
    bins[4, 2] = 0.0
    bins[5, 1, 3] = torch.nan  # a channel that is not read
    low, high = ordinary_sizes(torch.float64)
    expected = [True, False, False, False, True, True, True, True]
    if dtype == torch.float64:
        bins[6, 0] *= low / 100
        bins[7, 2, 17] = -2 * high
        expected[6:] = [False, False]
    x, scale, is_ordinary = engine.read(bins.transpose(0, 1).contiguous().transpose(0, 1))
    assert is_ordinary.tolist() == expected
    assert x.dtype == scale.dtype == torch.float64
    good = torch.tensor(expected)
    assert torch.equal(x[good], bins[good][:, [0, 2]].double())
    assert torch.equal(scale[good], bins[good][:, [0, 2]].double().abs().amax(-1))


@pytest.mark.parametrize("statistics", STATISTICS)
def test_modes_of_torch_leave_no_trace(statistics):
    pool = FeaturePool(HAND)
    bins = bins_of("tied", 9, HAND, 100, generator())

    def both_sizes(engine):
        return [run(engine, bins), run(engine, bins[:1])]

    plain = engine_of(pool, pool.names, statistics)
    expected = both_sizes(plain)
    with torch.inference_mode():
        inside = engine_of(pool, pool.names, statistics)
        found = both_sizes(inside) + both_sizes(plain)
        outs = [engine.read(bins[:1])[0] for engine in (inside, plain)]
    found += both_sizes(inside) + both_sizes(plain)
    for x in outs:
        x[0] = 0.0  # as the extractor does with strange bins
    with torch.device("meta"):
        elsewhere = engine_of(pool, pool.names, statistics)
        elsewhere.read(bins[:1])
    found += both_sizes(elsewhere)
    for one, other in zip(found, expected * 5, strict=True):
        assert torch.equal(one, other)


def test_chunks_shrink_with_rows_and_never_vanish():
    for num_films in (100, 256):
        pool = FeaturePool(some_hand("F" * num_films))
        plan = make_plan(pool.hand, pool.level, pool.names)
        engine = CompiledEngine(pool, plan, torch.float32)
        assert 1 <= engine.chunk_bins <= max(1, 3000 // len(plan.rows))


def test_a_dead_film_takes_no_product_of_its_own():
    pool = FeaturePool(HAND)
    names = [name for name in pool.names if name.domain == "freq"]
    engine = engine_of(pool, names, "double")
    engine._steps = engine._steps._replace(dense=torch.nan * engine._steps.dense)
    zeros = torch.zeros(3, len(HAND), 100, dtype=torch.float64)
    assert_equals_reference(run(engine, zeros), reference(pool, zeros, names), names, mixed=False)


# What the work is ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(40))
def test_chains_form_what_is_wanted(seed):
    chosen = np.random.default_rng(seed).random(8) < 0.4
    wanted = {int(b) for b in chosen.nonzero()[0]}
    chain, formed = chain_of(wanted, RANKS)
    assert {b for b in wanted if b % 2} <= formed
    parts = {3: {"A4"}, 2: {"A4", "D4"}, 1: {"A4", "D4", "D3"}, 0: {"A4", "D4", "D3", "D2"}}
    total, had = set(), {}
    for level in (3, 2, 1, 0):
        if chain[level] == OWN:
            assert 2 * level in formed
            total = set(parts[level])
        elif chain[level] == ADD:
            assert 2 * level + 3 in formed
            total = total | {f"D{level + 2}"}
        had[level] = total
    for branch in wanted:
        if branch % 2 == 0:
            assert had[branch // 2] == parts[branch // 2]
    alone = wanted  # each by its own product
    assert sum(RANKS[b] for b in formed) <= sum(RANKS[b] for b in alone)


@pytest.fixture
def fresh_folder():
    """``folder`` that looks anew."""
    kept.folder.cache_clear()
    yield kept.folder
    kept.folder.cache_clear()


def test_every_descriptor_has_a_number():
    assert {*numbering.DESCRIPTORS} == {*TIME_DESCRIPTORS, *SPECTRUM_DESCRIPTORS}
    assert len(numbering.DESCRIPTORS) == len({*numbering.DESCRIPTORS})


def test_compiled_code_is_kept_apart_for_each_state_of_the_sources(
    tmp_path, monkeypatch, fresh_folder
):
    before = fresh_folder("")
    assert before.parent.name == "__pycache__"
    assert fresh_folder(str(tmp_path)) == tmp_path / before.name
    source = tmp_path / "other.py"
    monkeypatch.setattr(kept, "__file__", str(source))
    source.write_text("a = 1")
    one = fresh_folder("")
    source.write_text("a = 2")
    fresh_folder.cache_clear()
    assert one.name != fresh_folder("").name


def test_compiled_code_goes_elsewhere_where_a_folder_is_refused(
    tmp_path, monkeypatch, fresh_folder
):
    taken = tmp_path / "file"
    taken.touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "mine"))
    found = fresh_folder(str(taken))
    assert found.parent == tmp_path / "mine" / "tactslip_torch" / "numba"
    fresh_folder.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(taken))
    assert fresh_folder(str(taken)) is None
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(taken))
    compiled = kernel(read_bins.py_func)
    assert compiled.stats.cache_path is None  # nowhere, rather than where it may be stale
    kept.note("anything")
    assert not kept.is_noted("anything")


def test_old_folders_of_other_digests_go(tmp_path, fresh_folder):
    old, new, foreign = (tmp_path / name for name in ("tactslip_torch-a", "tactslip_torch-b", "c"))
    for path in (old, new, foreign):
        (path / "within").mkdir(parents=True)
    month_ago = time.time() - 31 * 24 * 3600
    for path in (old, foreign):
        os.utime(path, (month_ago, month_ago))
    own = fresh_folder(str(tmp_path))
    assert set(tmp_path.iterdir()) == {own, new, foreign}


@pytest.mark.parametrize("statistics", STATISTICS)
def test_a_warm_engine_is_known_to_be(tmp_path, monkeypatch, fresh_folder, statistics):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiled_engine, "_WARM", set())
    pool = FeaturePool(HAND)
    engine = engine_of(pool, pool.names[:1], statistics)
    assert not engine.is_ready()
    engine.warm_up()
    assert engine.is_ready()
    num_before = [len(k.signatures) for k in KERNELS]
    whole = engine_of(pool, pool.names, statistics)
    assert whole.is_ready()
    run(whole, bins_of("random", 2, HAND, 100, generator()))
    run(whole, bins_of("random", 2, HAND, 100, generator()).float())
    assert [len(k.signatures) for k in KERNELS] == num_before, "something was left to compile"
    compiled_engine._WARM.clear()
    assert engine.is_ready(), "another process finds the note"


def test_kernels_work_where_they_cannot_be_kept():
    scope = {}
    exec("def more(x):\n    return x + 1", scope)  # numba keeps nothing without a file
    with pytest.raises(RuntimeError, match="cannot cache"):
        numba.njit(scope["more"], cache=True)
    assert kernel(scope["more"])(2) == 3


def test_the_package_works_without_numba():
    source = (
        "import sys; sys.modules['numba'] = None\n"
        "import tactslip_torch\n"
        "import tactslip_torch.features.extractor"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", source], check=True)
