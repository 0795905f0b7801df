"""A recording filtered in pieces is the recording filtered whole; nothing to come plays a part."""

import copy
import pickle
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.stream import FilterStream, SampleClock

LENGTHS = [51, 11, 51, 5]
ALIGNS = ["centred", "causal", "trailing"]
DTYPES = [torch.float64, torch.float32]
WANTED = [None, (1,), (1, 3), (0, 3), (0, 1, 2, 3)]


def recording(num_samples, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((4, num_samples)))


def in_pieces(stream, samples, cuts):
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    pieces = [stream.push(samples[:, a:b]) for a, b in pairwise(places)]
    return torch.cat([*pieces, stream.flush()], dim=-1)


@given(
    num_samples=st.integers(51, 300),
    cuts=st.lists(st.integers(0, 300), max_size=40),
    frames=st.sampled_from([(LENGTHS, 1), (LENGTHS, 3), ([51, 1, 7, 1], 0), ([1, 1, 1, 1], 0)]),
    align=st.sampled_from(ALIGNS),
    dtype=st.sampled_from(DTYPES),
    wanted=st.sampled_from(WANTED),
)
def test_any_cut_gives_the_recording_filtered_whole(
    num_samples, cuts, frames, align, dtype, wanted
):
    layer = ChannelFilter(*frames, align)
    samples = recording(num_samples).to(dtype)
    found = in_pieces(FilterStream(layer, dtype, wanted), samples, cuts)
    whole = layer(samples, wanted)
    assert found.dtype == dtype
    inside = slice(layer.context_before, num_samples - layer.context_after)
    assert torch.equal(found[:, inside], whole[:, inside])
    close = 1e-12 if dtype == torch.float64 else 1e-5
    torch.testing.assert_close(found, whole, rtol=close, atol=close)


@pytest.mark.parametrize("align", ALIGNS)
@pytest.mark.parametrize("wanted", WANTED)
def test_a_sample_is_handed_on_as_soon_as_its_look_ahead_has_come(align, wanted):
    stream = FilterStream(ChannelFilter(LENGTHS, align=align), channels=wanted)
    longest = max(LENGTHS[c] for c in (wanted or range(4)))
    assert stream.frame == longest
    assert stream.look_ahead == (longest // 2 if align == "centred" else 0)
    settled = 0
    for num in range(1, 120):
        settled += stream.push(recording(1)).shape[-1]
        assert settled == (0 if num < longest else num - stream.look_ahead)
    assert settled + stream.flush().shape[-1] == 119


@pytest.mark.parametrize("align", ALIGNS)
def test_samples_to_come_change_nothing_before(align):
    layer = ChannelFilter(LENGTHS, align=align)
    one, other = recording(200, 1), recording(200, 2)
    other[:, :120] = one[:, :120]
    other[:, 130:] = torch.nan
    pushed = []
    for samples in (one, other):
        stream = FilterStream(layer)
        pushed.append([stream.push(part) for part in samples.split(40, dim=-1)])
    settled = torch.cat(pushed[0][:3], dim=-1)
    assert settled.shape[-1] == 120 - stream.look_ahead
    assert torch.equal(settled, torch.cat(pushed[1][:3], dim=-1))


def test_channels_not_wanted_come_as_they_are_and_in_time():
    layer = ChannelFilter(LENGTHS)
    samples = recording(100)
    found = FilterStream(layer, channels=[3]).push(samples)
    assert found.shape[-1] == 98  # the frame of 5 alone is waited for
    assert torch.equal(found[:3], samples[:3, :98])
    assert torch.equal(found[3], layer(samples)[3, :98])


def test_a_nan_reaches_as_far_as_its_frame():
    samples = recording(200)
    samples[0, 100], samples[1, 100] = torch.nan, torch.inf
    found = in_pieces(FilterStream(ChannelFilter(LENGTHS)), samples, range(0, 200, 7))
    is_bad = ~found.isfinite()
    assert is_bad.sum(-1).tolist() == [51, 11, 0, 0]
    assert is_bad[0, 75:126].all()
    assert is_bad[1, 95:106].all()


@pytest.mark.parametrize("align", ALIGNS)
@pytest.mark.parametrize("num_samples", [0, 1, 50])
def test_a_stream_shorter_than_its_frame_has_no_samples(align, num_samples):
    stream = FilterStream(ChannelFilter(LENGTHS, align=align))
    assert stream.push(recording(num_samples)).shape == (4, 0)
    assert stream.flush().shape == (4, 0)
    assert stream.num_pushed == 0


@pytest.mark.parametrize("end", ["reset", "flush"])
def test_it_begins_anew(end):
    stream = FilterStream(ChannelFilter(LENGTHS))
    stream.push(recording(123, 5))
    getattr(stream, end)()
    samples = recording(90)
    fresh = FilterStream(ChannelFilter(LENGTHS))
    assert torch.equal(in_pieces(stream, samples, [60]), in_pieces(fresh, samples, [60]))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_goes_on_by_itself(copied):
    stream = FilterStream(ChannelFilter(LENGTHS))
    samples = recording(200)
    stream.push(samples[:, :77])
    twin = copied(stream)
    expected = torch.cat([stream.push(samples[:, 77:]), stream.flush()], dim=-1)
    assert torch.equal(torch.cat([twin.push(samples[:, 77:]), twin.flush()], dim=-1), expected)


def test_what_was_pushed_may_be_overwritten():
    stream = FilterStream(ChannelFilter(LENGTHS))
    samples = recording(200)
    buffer, pieces = torch.empty(4, 10, dtype=torch.float64), []
    for part in samples.split(10, dim=-1):
        pieces.append(stream.push(buffer.copy_(part)))
        buffer.fill_(torch.nan)
    found = torch.cat([*pieces, stream.flush()], dim=-1)
    torch.testing.assert_close(found, ChannelFilter(LENGTHS)(samples), rtol=1e-12, atol=1e-12)


def test_it_remembers_no_more_than_a_frame():
    stream = FilterStream(ChannelFilter(LENGTHS))
    for num in (3, 4000, 1, 0, 500):
        stream.push(recording(num))
        assert stream.num_bytes <= 4 * 51 * 8
    assert stream.num_pushed == 4504


def test_errors_are_one_line_and_change_nothing():
    stream = FilterStream(ChannelFilter(LENGTHS))
    stream.push(recording(60))
    for shape in ((3, 10), (10,), (2, 4, 10)):
        with pytest.raises(ValueError, match=r"^expected samples \[4, n\].*got \(.*\)$"):
            stream.push(torch.zeros(shape))
    assert stream.num_pushed == 60
    with pytest.raises(ValueError, match=r"float32 or float64, got torch.float16"):
        FilterStream(ChannelFilter(LENGTHS), torch.float16)
    with pytest.raises(ValueError, match=r"no channel is wanted"):
        FilterStream(ChannelFilter(LENGTHS), channels=[])


def test_a_clock_is_exact_after_months():
    """Whole numbers are counted; a float that adds half a millisecond at a time would be off."""
    clock, month = SampleClock(2000.0), 30 * 24 * 3600 * 2000
    none = np.zeros(0, np.int64), np.zeros(0)
    for num in (1, month, 7):
        clock.take(num, *none)
    assert clock.end_s(np.array([month + 8]))[0] == (month + 8) / 2000
    clock.take(3, np.array([0]), np.array([1.7e9]))
    clock.take(month, *none)
    assert clock.missing(np.array([1.7e9 + 1.5e-3 + month / 2000])).tolist() == [0]
    assert clock.missing(np.array([1.7e9 + 2.5e-3 + month / 2000])).tolist() == [2]
    with pytest.raises(ValueError, match=r"goes back: sample 0 .* 1 samples before its turn"):
        clock.missing(np.array([1.7e9 + 1e-3 + month / 2000]))
    assert clock.num_samples == 2 * month + 11
