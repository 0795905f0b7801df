"""The front door: every engine gives the reference's values, and the reference steps in in time."""

import copy
import pickle
import sys
from importlib import util

import numpy as np
import pytest
import torch
from engine_bins import assert_equals_reference, bins_of

from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch import runtime as engines
from tactslip_torch.features import extractor as module
from tactslip_torch.features.extractor import FeatureExtractor

HAND = HandLayout.paper24()
POOL = FeaturePool(HAND)
SELECTED = list(range(3, len(POOL.names), 97))
FAST = ["eager", "compiled"]
ENGINES = [*FAST, "reference"]


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(5)


def noise(num, generator, dtype=torch.float64):
    return bins_of("random", num, HAND, 100, generator).to(dtype)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("selected", [None, SELECTED])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_are_the_references(engine, selected, dtype, generator):
    bins = torch.cat([bins_of(k, 9, HAND, 100, generator) for k in ("random", "dead_channel")])
    bins = bins.to(dtype)
    found = FeatureExtractor(POOL, selected, engine)(bins, torch.float64)
    expected = POOL(bins.double())
    names = POOL.names
    if selected is not None:
        expected, names = expected[:, selected], [names[i] for i in selected]
    assert_equals_reference(found, expected, names, mixed=False)


@pytest.mark.parametrize("engine", FAST)
def test_native_float32_takes_statistics_in_float32_only(engine, generator):
    """A vibration on an offset, which the reference in float32 throughout cannot resolve."""
    bins = 1e3 + noise(12, generator, torch.float32)
    native = FeaturePool(HAND, arithmetic="native")
    found = FeatureExtractor(native, engine=engine)(bins)
    assert found.dtype == torch.float32
    # on the grid of float32 near 1e3, many values of a branch are nearly equal: no mode
    kept = [i for i, name in enumerate(POOL.names) if name.descriptor != "mode"]
    names = [POOL.names[i] for i in kept]
    assert_equals_reference(found[:, kept], POOL(bins.double())[:, kept], names, mixed=True)


@pytest.mark.parametrize("engine", FAST)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e300, 1e-200])
def test_bins_that_are_not_ordinary_are_the_references(engine, bad, generator):
    bins = noise(8, generator)
    bins[[2, 5], 4, 17] = bad
    bins[5, 20, :] = bad
    if bad == 1e-200:
        bins[2, 4], bins[5, 4] = bad, bad
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    found, expected = extractor(bins), POOL(bins)[:, SELECTED]
    strange = [2, 5]
    torch.testing.assert_close(
        found[strange], expected[strange], rtol=1e-12, atol=0, equal_nan=True
    )
    if bad in (torch.nan, torch.inf):
        assert found[5].isnan().any()
    rest = [0, 1, 3, 4, 6, 7]
    torch.testing.assert_close(found[rest], extractor(bins[rest]), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("engine", FAST)
def test_a_channel_that_is_not_read_may_hold_anything(engine, generator):
    selected = [i for i, name in enumerate(POOL.names) if name.channel == "PVDF3"]
    bins = noise(6, generator)
    broken = torch.full_like(bins, torch.nan)
    broken[:, HAND.names.index("PVDF3")] = bins[:, HAND.names.index("PVDF3")]
    extractor = FeatureExtractor(POOL, selected, engine)
    assert torch.equal(extractor(broken), extractor(bins))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("num", [0, 1, 3, 40, 131])
def test_threads_change_no_bit(engine, num, generator):
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    bins = noise(num, generator)
    found = {}
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found[threads] = extractor(bins)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[1], found[2])
    assert found[1].shape == (num, len(SELECTED))


@pytest.mark.parametrize("engine", ENGINES)
def test_leading_axes_are_kept_and_bins_left_alone(engine, generator):
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    bins = noise(6, generator, torch.float32)
    before = bins.clone()
    flat = extractor(bins)
    assert flat.dtype == torch.float32
    torch.testing.assert_close(extractor(bins.reshape(2, 3, 24, 100)).flatten(0, 1), flat)
    torch.testing.assert_close(extractor(bins[0]), flat[0])
    torch.testing.assert_close(extractor(bins.transpose(1, 2).contiguous().transpose(1, 2)), flat)
    assert torch.equal(bins, before)


@pytest.mark.parametrize("engine", FAST)
def test_float32_bins_are_computed_in_float64_and_rounded_once(engine, generator):
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    bins = noise(7, generator, torch.float32)
    assert torch.equal(extractor(bins), extractor(bins.double()).float())


@pytest.mark.parametrize("engine", ENGINES)
def test_after_a_warm_up_nothing_is_made_any_more(engine, generator, monkeypatch):
    extractor = FeatureExtractor(POOL, SELECTED, engine).warm_up()
    monkeypatch.setattr(extractor, "_made", lambda dtype: pytest.fail("an engine was made"))
    for dtype in (torch.float32, torch.float64):
        assert extractor(noise(2, generator, dtype)).isfinite().all()


def test_the_first_use_on_a_machine_is_announced(generator, monkeypatch, caplog):
    from tactslip_torch.features.compiled.engine import CompiledEngine

    monkeypatch.setattr(CompiledEngine, "is_ready", lambda engine: False)
    FeatureExtractor(POOL, SELECTED, "compiled")(noise(1, generator))
    assert "compiling kernels for features: some 20 s, once" in caplog.text


@pytest.mark.parametrize("engine", FAST)
def test_an_energy_beyond_float32_saturates(engine, generator):
    index = [i for i, name in enumerate(POOL.names) if str(name) == "SG1 raw time energy"]
    bins = 1e30 * noise(3, generator, torch.float32)
    found = FeatureExtractor(POOL, index, engine)(bins)
    assert (found == torch.finfo(torch.float32).max).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_gradients_flow_through_the_reference(engine, generator):
    bins = noise(2, generator).requires_grad_()
    FeatureExtractor(POOL, SELECTED, engine)(bins).sum().backward()
    expected = bins.detach().clone().requires_grad_()
    POOL(expected)[:, SELECTED].sum().backward()
    torch.testing.assert_close(bins.grad, expected.grad, rtol=1e-9, atol=1e-12)
    with torch.no_grad():
        assert not FeatureExtractor(POOL, SELECTED, engine)(bins).requires_grad


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")  # torch's own, in jvp
@pytest.mark.parametrize("engine", FAST)
def test_forward_mode_and_vmap_go_through_the_reference(engine, generator):
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    bins, direction = noise(2, generator), noise(2, generator)
    _, slope = torch.func.jvp(extractor, (bins,), (direction,))
    _, expected = torch.func.jvp(lambda x: POOL(x)[:, SELECTED], (bins,), (direction,))
    torch.testing.assert_close(slope, expected)
    torch.testing.assert_close(torch.func.vmap(extractor)(bins), POOL(bins)[:, SELECTED])


@pytest.mark.parametrize("engine", ENGINES)
def test_copies_and_pickles_work(engine, generator):
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    bins = noise(5, generator)
    found = extractor(bins)
    for again in (copy.deepcopy(extractor), pickle.loads(pickle.dumps(extractor))):
        assert torch.equal(again(bins), found)


@pytest.mark.parametrize("engine", FAST)
def test_a_stream_hands_on_batch_by_batch(engine, generator):
    batches = [noise(num, generator) for num in (1, 5, 0, 40)]
    asked = []

    def source():
        for batch in batches:
            asked.append(len(batch))
            yield batch

    extractor = FeatureExtractor(POOL, SELECTED, engine)
    for count, (found, batch) in enumerate(zip(extractor.stream(source()), batches, strict=True)):
        assert torch.equal(found, extractor(batch))
        assert len(asked) == count + 1  # nothing is read ahead


def test_auto_takes_numba_where_it_is_installed(monkeypatch, generator):
    assert module.resolved("auto") == ("compiled" if util.find_spec("numba") else "eager")
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    extractor = FeatureExtractor(POOL, SELECTED)
    assert extractor.engine == "eager"
    assert extractor(noise(3, generator)).isfinite().all()
    with pytest.raises(ValueError, match=r'not installed; pip install "tactslip_torch\[fast\]"'):
        FeatureExtractor(POOL, SELECTED, "compiled")


def test_a_numba_that_cannot_be_used_is_passed_over_in_words(monkeypatch):
    """As after an upgrade of NumPy."""
    monkeypatch.setitem(sys.modules, "tactslip_torch.features.compiled.engine", None)
    monkeypatch.delattr("tactslip_torch.features.compiled.engine", raising=False)
    with pytest.warns(
        UserWarning, match="numba cannot be used: .*; features are made by engine eager"
    ):
        assert FeatureExtractor(POOL, SELECTED).engine == "eager"
    with pytest.raises(ValueError, match="needs numba, which cannot be used"):
        FeatureExtractor(POOL, SELECTED, "compiled")


@pytest.mark.parametrize("engine", FAST)
@pytest.mark.parametrize("num", [1, 20])
def test_inference_mode_leaves_nothing_behind(engine, num, generator):
    """Neither in a detector's parts, nor in what engines keep."""
    bins = noise(num, generator)
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    with torch.inference_mode():
        first = extractor(bins)
    assert torch.equal(extractor(bins), first)
    with torch.inference_mode():
        assert torch.equal(extractor(bins), first)
    pool = FeaturePool(HAND)
    with torch.inference_mode():
        pool.validity(bins)
    moving = bins.clone().requires_grad_()
    assert pool.validity(moving).all()


@pytest.mark.parametrize("engine", FAST)
def test_the_callers_bins_are_left_alone(engine, generator):
    bins = noise(20, generator)
    bins[3, 2, 50], bins[7, 20, 10], bins[9, 20, 10] = torch.nan, 1e300, -torch.inf
    before = bins.clone()
    FeatureExtractor(POOL, None, engine)(bins)
    torch.testing.assert_close(bins, before, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("kind", [torch.tensor, np.array, tuple])
def test_a_selection_is_any_sequence_of_whole_numbers(kind):
    assert FeatureExtractor(POOL, kind([7, 3])).selected == (7, 3)
    with pytest.raises(TypeError):
        FeatureExtractor(POOL, [3.7])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"selected": []}, "empty selection"),
        ({"selected": [2582]}, r"must lie in 0..2581, the pool's 2582, got 2582"),
        ({"engine": "fast"}, "engine must be one of auto, compiled, eager, reference, got 'fast'"),
    ],
)
def test_what_is_refused_is_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        FeatureExtractor(POOL, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("engine", ENGINES)
def test_wrong_bins_are_refused_as_the_pool_does(engine):
    extractor = FeatureExtractor(POOL, SELECTED, engine)
    with pytest.raises(ValueError, match=r"expected bins \[\*, 24, 100\]"):
        extractor(torch.zeros(2, 23, 100))
    with pytest.raises(ValueError, match="expected float32 or float64 bins"):
        extractor(torch.zeros(2, 24, 100, dtype=torch.int32))
