"""An even clock through timestamps: what is late, what is missing, and what cannot be."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch.data.clock import even_clock, nominal_rate, snapped_rate
from tactslip_torch.data.file_recordings import EvenSamples
from tactslip_torch.data.formats import Samples

RATE = 2000.0
RATES = (92.31, 98.0, 101.0, 700.0, 900.0, 1000.0, 1024.0, 1300.0, 2000.0)
UNITS = (0.0, 1e-6, 1e-3, 1e-2)
ROUNDED = [(r, u) for r in RATES for u in UNITS if u * r <= (2.2 if u < 1e-2 else 1.2)]


def ticks(num, dropped=(), rate=RATE):
    """Times of ``num`` ticks without the dropped ones, and the ticks that are left."""
    left = torch.tensor([tick for tick in range(num) if tick not in set(dropped)])
    return (left - left[0]).double() / rate, left


def rounded(rate, unit, left, seed=0):
    """Times of ticks, from any moment on, rounded down to a unit."""
    start = torch.rand(1, generator=torch.Generator().manual_seed(seed)).double() / 100
    seconds = left.double() / rate + start
    return (seconds / unit).floor() * unit if unit else seconds


def clock_of(seconds, stated_hz=None):
    return even_clock(np.asarray(seconds, np.float64), stated_hz, "a.csv")


def missing_ticks(clock):
    return [tick for gap in clock.gaps for tick in range(gap.start, gap.start + gap.missing)]


drops = st.lists(
    st.tuples(st.integers(20, 900), st.integers(1, 30)), max_size=4, unique_by=lambda gap: gap[0]
)


@settings(max_examples=40)
@given(drops, st.sampled_from([0.0, 0.05, 0.2]), st.integers(0, 99))
def test_what_was_dropped_is_found_and_filled(gaps, jitter, seed):
    dropped = {tick for start, count in gaps for tick in range(start, start + count)}
    seconds, left = ticks(1000, dropped)
    generator = torch.Generator().manual_seed(seed)
    late = torch.rand(len(seconds), generator=generator).double() * jitter / RATE
    found = clock_of(seconds + late - late[0], RATE)
    assert (found.num_samples, missing_ticks(found)) == (1000, sorted(dropped))
    assert found.jitter_s <= jitter / RATE + 1e-12
    kept = Samples("a.csv", np.stack([left, -left]).astype(float), time_axis=1)
    ramp = torch.arange(1000).double().expand(2, -1) * torch.tensor([[1.0], [-1.0]])
    holed = ramp.clone()
    holed[:, sorted(dropped)] = torch.nan
    torch.testing.assert_close(EvenSamples(kept, found).read(0, 1000), holed, equal_nan=True)
    bridged = EvenSamples(kept, found, most_bridged=1000)  # a ramp is its own bridge
    for first, stop in ((0, 1000), (17, 333), (500, 501), (990, 2000), (40, 40)):
        torch.testing.assert_close(bridged.read(first, stop), ramp[:, first:stop])


@settings(max_examples=60)
@given(drops, st.integers(0, 40), st.integers(1, 400), st.integers(0, 99))
def test_any_pieces_of_a_file_put_together_are_the_whole(gaps, most_bridged, length, seed):
    """With gaps and samples that are not finite, some of them bridged."""
    dropped = {tick for start, count in gaps for tick in range(start, start + count)}
    found = clock_of(ticks(1000, dropped)[0], RATE)
    source = np.random.default_rng(seed)
    stored = source.normal(size=(3, 1000 - len(dropped)))
    for row, place, num in zip(
        *source.integers([[0], [0], [1]], [[3], [960], [50]], (3, 9)), strict=True
    ):
        stored[row, place : place + num] = np.nan
    kept = Samples("a.csv", stored, time_axis=1)
    even = EvenSamples(kept, found, most_bridged, rows=[2, 0])
    whole = even.read(0, 1000)
    cut = [even.read(first, first + length) for first in range(0, 1000, length)]
    torch.testing.assert_close(torch.cat(cut, 1), whole, rtol=0, atol=1e-12, equal_nan=True)
    on_clock = np.full((3, 1000), np.nan)
    on_clock[:, [tick for tick in range(1000) if tick not in dropped]] = stored
    for row, of_file in zip(whole.numpy(), on_clock[[2, 0]], strict=True):
        np.testing.assert_array_equal(row[np.isfinite(of_file)], of_file[np.isfinite(of_file)])
        for is_nan, run in itertools.groupby(range(1000), key=np.isnan(of_file).__getitem__):
            places = list(run)
            is_edge = places[0] == 0 or places[-1] == 999
            is_bridged = len(places) <= most_bridged and not is_edge
            assert np.isnan(row[places]).all() == (is_nan and not is_bridged)


@pytest.mark.parametrize(("rate", "unit"), ROUNDED)
def test_stamps_neither_round_the_rate_nor_lose_or_invent_samples(rate, unit):
    num = int(12 * rate)
    stamps = rounded(rate, unit, torch.arange(num))
    for stated in (None, rate):
        found = clock_of(stamps, stated)
        assert (found.num_samples, found.gaps) == (num, ())
        # least squares of evenly spread rounding: 3 sigma of the slope
        error = max(3 * unit * (num**-0.5) / 12, 1e-9)
        assert found.sample_rate_hz == pytest.approx(rate, rel=error)


@settings(max_examples=40)
@given(
    st.sampled_from([(r, u) for r, u in ROUNDED if u * r < 0.45]),
    st.sampled_from([0.005, 0.02, 0.05]),
    st.integers(1, 6),
    st.booleans(),
    st.integers(0, 999),
)
def test_random_losses_are_all_found(kind, fraction, longest, stated, seed):
    rate, unit = kind
    generator = torch.Generator().manual_seed(seed)
    is_left = torch.rand(3000, generator=generator) > fraction / longest
    for place in (~is_left).nonzero().flatten().tolist():
        length = int(torch.randint(1, longest + 1, (1,), generator=generator))
        is_left[place : place + length] = False
    is_left[0] = is_left[-1] = True
    stamps = rounded(rate, unit, is_left.nonzero().flatten(), seed)
    found = clock_of(stamps, rate if stated else None)
    assert missing_ticks(found) == (~is_left).nonzero().flatten().tolist()
    assert found.sample_rate_hz == pytest.approx(rate, rel=1e-5)


@pytest.mark.parametrize("rate", [700.0, 1024.0, 2000.0])
def test_coarse_stamps_that_do_not_tell_what_is_missing_are_refused(rate):
    is_left = torch.rand(12_288, generator=torch.Generator().manual_seed(1)) > 0.01
    stamps = rounded(rate, 1e-3, is_left.nonzero().flatten())
    with pytest.raises(ValueError, match=r"rounded so coarsely .* reading\.sample_rate_hz=\.\.\."):
        clock_of(stamps, rate)


def test_a_clock_that_runs_otherwise_or_drifts_loses_nothing_and_says_how_far_it_is_off():
    num, most = 400_000, 20.0  # steps off a straight line, at the middle
    assert clock_of(torch.arange(num).double() / 2000.7, RATE).num_samples == num
    place = torch.linspace(0, 1, num).double()
    seconds = (torch.arange(num) + 4 * most * place * (1 - place)).double() / RATE
    found = clock_of(seconds - seconds[0])
    assert (found.num_samples, found.gaps) == (num, ())
    assert 0.3 * most / RATE < found.jitter_s < most / RATE


def test_jitter_does_not_contradict_the_rate_that_is_stated():
    for seed in range(8):
        late = np.random.default_rng(seed).uniform(-0.3, 0.3, 400)
        found = clock_of((np.arange(400) + late) / RATE, RATE)
        assert (found.sample_rate_hz, found.num_samples) == (RATE, 400)
        with pytest.raises(ValueError, match=r"its times are (1999|200\d)\S* Hz, but 1000 Hz"):
            clock_of((np.arange(400) + late) / RATE, 1000.0)


def at_random(times):
    late = torch.rand(4000, generator=torch.Generator().manual_seed(0)).double() * 4
    return (torch.arange(4000) + late).sort().values / RATE


NO_CLOCKS = [
    (lambda t: t.flip(0), None, "time goes back at sample 1"),
    (lambda t: t.index_fill(0, torch.tensor([7]), torch.nan), None, "time of sample 7 is nan"),
    (lambda t: t, 1000.0, r"are 2000 Hz, but 1000 Hz .*reading\.sample_rate_hz \(null"),
    (lambda t: (t * RATE / 32).floor() * 32 / RATE, None, "32 samples share a time"),
    (lambda t: t[:2], None, "has 2 times, too few"),
    (lambda t: torch.cat([t[:100], t[99:]]), None, "samples 100 and before come 1 steps clos"),
    (lambda t: t * 1e3, RATE, r"reading\.time_unit=ms"),
    (
        lambda t: torch.cat([0 * t[:3], 1.7e9 + t[3:]]),
        None,
        "time jumps at sample 3, from 0 to 1.7e",
    ),
    (
        lambda t: torch.cat([t[:90], t[90:] + 1e3]),
        None,
        "jumps at sample 90, from 0.0445 to 1000.04",
    ),
    (at_random, None, "come so unevenly|steps closer than"),
]


@pytest.mark.parametrize(("change", "stated", "said"), NO_CLOCKS)
def test_times_that_tell_no_clock_are_refused(change, stated, said):
    with pytest.raises(ValueError, match=said):
        clock_of(change(ticks(200)[0]), stated)


def test_a_rate_is_called_by_its_round_number_only_if_it_may_be_that():
    measured = (1999.97, 92.31, 0.25, 1024.0, 2048.0, 1017.25, 999.0, 48_000.02)
    said = [2000.0, 92.31, 0.25, 1024.0, 2048.0, 1017.25, 999.0, 48_000.0]
    assert [nominal_rate(rate) for rate in measured] == said
    assert [nominal_rate(199.6, 0.003), nominal_rate(1023.0, 0.004)] == [200.0, 1024.0]
    assert [snapped_rate(rate) for rate in (24.00000322, 92.31)] == [24.0, 92.31]
