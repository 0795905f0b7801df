"""The native backend gives the reference's values, and the reference steps in where it must."""

import copy
import pickle
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

from tactslip_torch import FeaturePool, HandLayout, native
from tactslip_torch.features.extractor import FeatureExtractor

HAND = some_hand("GFF")
POOL = FeaturePool(HAND)
NAMES = POOL.names
DESCRIPTORS = sorted({name.descriptor for name in NAMES})
LEVELS = ("v2", "v3", "v4") if not native.why_not() and native.instruction_set() != "v1" else ()
pytestmark = pytest.mark.skipif(bool(native.why_not()), reason=native.why_not())


def generator(seed=5):
    return torch.Generator().manual_seed(seed)


def noise(num, hand=HAND, dtype=torch.float64, seed=5):
    return bins_of("random", num, hand, 100, generator(seed)).to(dtype)


def assert_is_reference(bins, pool=POOL, selected=None, mixed=False):
    """Features in float64; ``mixed``: by statistics in float32, of bins that float32 holds."""
    maker = pool
    if mixed:
        maker = FeaturePool(**pool.facts() | {"hand": pool.hand, "arithmetic": "native"})
        bins = bins.float()
    found = FeatureExtractor(maker, selected, "native")(bins, torch.float64)
    columns = list(range(len(pool.names))) if selected is None else selected
    names = [pool.names[i] for i in columns]
    assert_equals_reference(found, pool(bins.double())[:, columns], names, mixed)
    return found


# Values --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("spectrum", ["reference", "clean"])
@pytest.mark.parametrize("kind", KINDS)
def test_whole_pool_on_bins_of_every_kind(kind, spectrum, mixed):
    if kind == "near_constant" and mixed:
        pytest.skip("float32 does not hold its vibration")
    pool = FeaturePool(HAND, spectrum=spectrum)
    bins = bins_of(kind, 30, HAND, 100, generator(0))
    found = assert_is_reference(bins, pool, mixed=mixed)
    if mixed:
        assert_modes_are_fair(found[:6], bins[:6].float().double(), pool, NAMES)


@pytest.mark.parametrize("noise", [1e-3, 1e-5])
@pytest.mark.parametrize("kind", ["tap", "step"])
@pytest.mark.parametrize("num", [100, 65])
def test_quiet_but_for_a_tap_or_a_step(num, kind, noise):
    """Where float32 crowds about the median and the quartiles."""
    made, shape = generator(3), (40, len(HAND), num)
    place, time = torch.randint(1, num - 1, (*shape[:2], 1), generator=made), torch.arange(num)
    form = time == place if kind == "tap" else time >= place
    size = torch.randn(*shape[:2], 1, generator=made, dtype=torch.float64)
    bins = size * (form + noise * torch.randn(shape, generator=made, dtype=torch.float64))
    assert_is_reference(bins, FeaturePool(HAND, bin_samples=num, level=3), mixed=True)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize(("num", "level"), [(50, 3), (64, 3), (101, 4), (20, 1), (300, 5)])
@pytest.mark.parametrize("spectrum", ["reference", "clean"])
def test_other_lengths_and_levels(num, level, spectrum, mixed):
    pool = FeaturePool(some_hand("FG"), bin_samples=num, level=level, spectrum=spectrum)
    for kind in ("random", "tied", "impulses"):
        assert_is_reference(bins_of(kind, 12, pool.hand, num, generator()), pool, mixed=mixed)


@pytest.mark.parametrize("kinds", ["F", "G", "GG", "FF", "FGFGF"])
def test_other_hands(kinds):
    pool = FeaturePool(some_hand(kinds))
    assert_is_reference(noise(20, pool.hand), pool)


@pytest.mark.parametrize("num", [1, 40])
@pytest.mark.parametrize("level", LEVELS)
def test_the_papers_hand_by_every_instruction_set(num, level, monkeypatch):
    pool, best = FeaturePool(HandLayout.paper24()), native.instruction_set()
    bins = bins_of("tied", num, pool.hand, 100, generator())
    plain = FeatureExtractor(pool)(bins)
    monkeypatch.setenv("TACTSLIP_NATIVE", level)
    assert native.instruction_set() == min(level, best)
    found = FeatureExtractor(pool)(bins)
    torch.testing.assert_close(found, plain, rtol=1e-12, atol=1e-12)
    if num > 1:
        assert_equals_reference(found, pool(bins), pool.names, mixed=False)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("descriptor", DESCRIPTORS)
def test_each_descriptor_alone(descriptor, mixed):
    selected = [i for i, name in enumerate(NAMES) if name.descriptor == descriptor]
    for kind in ("random", "tied", "zeros", "constants"):
        bins = bins_of(kind, 20, HAND, 100, generator())
        assert_is_reference(bins, selected=selected, mixed=mixed)


@pytest.mark.parametrize("size", [1, 5, 60])
@pytest.mark.parametrize("seed", range(4))
def test_random_parts_in_any_order_and_repeated(size, seed, rng):
    pool = FeaturePool(some_hand("GFFF"))
    selected = rng.integers(len(pool.names), size=size).tolist()
    for kind in ("random", "dead_channel", "near_constant"):
        bins = bins_of(kind, 20, pool.hand, 100, generator(seed))
        assert_is_reference(bins, pool, selected)


def test_spectra_alone_know_which_branches_are_rounding():
    size = 10.0 ** -torch.arange(30)[:, None, None]  # of vibration; branches go one by one
    bins = 1 + size * noise(30)
    in_frequency = [i for i, name in enumerate(NAMES) if name.domain == "freq"]
    alone = FeatureExtractor(POOL, in_frequency)(bins)
    among = FeatureExtractor(POOL)(bins)[:, in_frequency]
    torch.testing.assert_close(alone, among, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("exponent", [-300, 400])
@pytest.mark.parametrize("mixed", [False, True])
def test_magnitudes_in_range_need_no_reference(exponent, mixed):
    pool = FeaturePool(HAND, arithmetic="native" if mixed else "double")
    bins = noise(20)
    found = FeatureExtractor(pool)(torch.ldexp(bins, torch.tensor(exponent)), torch.float64)
    expected = POOL(torch.ldexp(bins, torch.tensor(exponent)))
    assert_equals_reference(found, expected, NAMES, mixed=False)


def test_float32_in_float64_statistics_is_rounded_once_and_saturates():
    extractor, bins = FeatureExtractor(POOL), noise(8, dtype=torch.float32)
    assert torch.equal(extractor(bins), extractor(bins.double()).float())
    of_energy = torch.tensor([name.descriptor == "energy" for name in NAMES])
    huge = extractor(1e30 * bins)
    assert (huge[:, of_energy] == torch.finfo(torch.float32).max).all()
    assert huge.isfinite().all()


def test_statistics_in_float32_resolve_a_vibration_on_an_offset():
    """Which the reference in float32 throughout cannot."""
    bins = 1e3 + noise(12, dtype=torch.float32)
    found = FeatureExtractor(FeaturePool(HAND, arithmetic="native"))(bins)
    assert found.dtype == torch.float32
    # on the grid of float32 near 1e3, many values of a branch are nearly equal: no mode
    kept = [i for i, name in enumerate(NAMES) if name.descriptor != "mode"]
    expected = POOL(bins.double())[:, kept]
    assert_equals_reference(found[:, kept], expected, [NAMES[i] for i in kept], mixed=True)


# The reference steps in ----------------------------------------------------------------------


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e300, 1e-200])
def test_strange_bins_are_the_references_and_change_no_other(bad):
    bins = noise(40)
    bins[[2, 35], 1, 17] = bad
    bins[35, 2, :] = bad
    if bad == 1e-200:
        bins[2, 1] = bad
    before = bins.clone()
    extractor = FeatureExtractor(POOL)
    found, expected = extractor(bins), torch.stack([POOL(bins[2]), POOL(bins[35])])
    torch.testing.assert_close(bins, before, rtol=0, atol=0, equal_nan=True)
    strange = torch.zeros(40, dtype=torch.bool)
    strange[[2, 35]] = True
    torch.testing.assert_close(found[strange], expected, rtol=1e-9, atol=1e-9,
                               equal_nan=True)  # fmt: skip
    bins[strange] = 1.0
    assert torch.equal(found[~strange], extractor(bins)[~strange])


def test_a_channel_that_is_not_read_may_hold_anything():
    selected = [i for i, name in enumerate(NAMES) if name.channel == "PVDF2"]
    bins = noise(6)
    broken = torch.full_like(bins, torch.nan)
    broken[:, 2] = bins[:, 2]
    extractor = FeatureExtractor(POOL, selected)
    assert torch.equal(extractor(broken), extractor(bins))


def test_gradients_tangents_and_vmap_are_the_references():
    extractor, bins = FeatureExtractor(POOL, [3, 70]), noise(2).requires_grad_()
    extractor(bins).sum().backward()
    expected = bins.detach().clone().requires_grad_()
    POOL(expected)[:, [3, 70]].sum().backward()
    torch.testing.assert_close(bins.grad, expected.grad)
    with torch.no_grad():
        assert not extractor(bins).requires_grad
    bins = bins.detach()
    torch.testing.assert_close(torch.func.vmap(extractor)(bins), POOL(bins)[:, [3, 70]])


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")  # torch's own, in jvp
def test_forward_mode_is_the_references():
    pool = FeaturePool(some_hand("F"), bin_samples=20, level=1)
    bins, direction = torch.randn(2, 2, 1, 20, generator=generator()).double()
    _, slope = torch.func.jvp(FeatureExtractor(pool), (bins,), (direction,))
    _, expected = torch.func.jvp(pool, (bins,), (direction,))
    torch.testing.assert_close(slope, expected)


# Manners -------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["native", "torch"])
@pytest.mark.parametrize("num", [0, 1, 3, 131])
def test_threads_and_number_of_bins_change_nothing(backend, num):
    extractor, bins = FeatureExtractor(POOL, backend=backend), noise(num)
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


def test_two_callers_at_once():
    extractor = FeatureExtractor(POOL)
    batches = [noise(64, seed=seed) for seed in range(8)]
    expected = [extractor(bins) for bins in batches]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(extractor, batches * 3))
    assert all(torch.equal(a, b) for a, b in zip(found, expected * 3, strict=True))


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_leading_axes_strides_copies_and_modes(backend):
    extractor, bins = FeatureExtractor(POOL, [5, 90, 17], backend), noise(6, dtype=torch.float32)
    flat = extractor(bins)
    assert flat.dtype == torch.float32
    torch.testing.assert_close(extractor(bins.reshape(2, 3, *bins.shape[1:])).flatten(0, 1), flat)
    torch.testing.assert_close(extractor(bins[0]), flat[0])
    strided = bins.transpose(1, 2).contiguous().transpose(1, 2)
    for other in (extractor, copy.deepcopy(extractor), pickle.loads(pickle.dumps(extractor))):
        assert torch.equal(other(strided), flat)
    with torch.inference_mode():
        inside = FeatureExtractor(POOL, [5, 90, 17], backend)
        assert torch.equal(inside(bins), flat)
    assert torch.equal(inside(bins), flat)
    with torch.device("meta"):
        assert torch.equal(FeatureExtractor(POOL, [5, 90, 17])(bins), flat)


@pytest.mark.parametrize("kind", [torch.tensor, np.array, tuple])
def test_a_selection_is_any_sequence_of_whole_numbers(kind):
    assert FeatureExtractor(POOL, kind([7, 3])).selected == (7, 3)
    with pytest.raises(TypeError):
        FeatureExtractor(POOL, [3.7])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"selected": []}, "empty selection"),
        ({"selected": [len(NAMES)]}, rf"must lie in 0..{len(NAMES) - 1}, the pool's {len(NAMES)}"),
        ({"backend": "fast"}, "backend must be one of auto, native, torch, got 'fast'"),
    ],
)
def test_what_is_refused_is_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        FeatureExtractor(POOL, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_wrong_bins_are_refused_as_the_pool_does(backend):
    extractor = FeatureExtractor(POOL, backend=backend)
    with pytest.raises(ValueError, match=r"expected bins \[\*, 3, 100\]"):
        extractor(torch.zeros(2, 4, 100))
    with pytest.raises(ValueError, match="expected float32 or float64 bins"):
        extractor(torch.zeros(2, 3, 100, dtype=torch.int32))
