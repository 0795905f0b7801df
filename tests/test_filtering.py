"""The filter of whole recordings, of bins, and of recordings that come in pieces."""

import json

import numpy as np
import oracles
import pytest
import torch
from any_hands import own_kernels
from scipy import signal

from tactslip_torch.signals.filtering import ChannelFilter, extended, largest_in_frames

FRAMES = [(1, 0), (3, 1), (5, 2), (11, 1), (51, 1), (51, 3), (11, 0), (7, 6)]
LENGTHS = [51, 11, 51, 5]
ALIGNS = ["centred", "causal", "trailing"]
aligned = pytest.mark.parametrize("align", ALIGNS)


# --- one frame ----------------------------------------------------------------------------------


def causal(x, window, order=1):
    """The trailing frame's polynomial at its last sample; the first frame's before it is full."""
    taps = signal.savgol_coeffs(window, order, pos=window - 1, use="dot")
    rest = np.lib.stride_tricks.sliding_window_view(x, window, axis=-1) @ taps
    position = np.arange(window)
    fits = [np.polynomial.Polynomial.fit(position, row, order) for row in x[:, :window]]
    head = np.stack([fit(position[:-1]) for fit in fits])
    return np.concatenate([head, rest], axis=-1)


def trailing(x, window, order=1):
    """The centred filter half a frame late; the first half frame holds what it begins with."""
    centred, half = oracles.savgol(x, window, order), window // 2
    inside = centred[..., : x.shape[-1] - half]
    return np.concatenate([np.repeat(inside[..., :1], half, axis=-1), inside], axis=-1)


def filtered(x, window, order=1, align="centred"):
    """Signals ``[*, T]``, each as a hand of one channel."""
    return ChannelFilter([window], order, align)(x[..., None, :])[..., 0, :]


ORACLES = {"centred": oracles.savgol, "causal": causal, "trailing": trailing}


@aligned
@pytest.mark.parametrize(("window", "order"), FRAMES)
@pytest.mark.parametrize("num_samples", [51, 200])
def test_equals_scipy(window, order, num_samples, align, rng):
    tolerance = 1e-10 if align == "centred" else 1e-9
    for make in (oracles.random_bins, oracles.integer_bins):
        x = make(rng, 20, num_samples)
        actual = filtered(torch.from_numpy(x), window, order, align)
        oracles.assert_columns_close(actual, ORACLES[align](x, window, order), tolerance)


@pytest.mark.parametrize(
    ("window", "align", "corner_hz"),
    [(11, "centred", 81.0), (51, "centred", 17.0), (11, "causal", 200.0), (51, "causal", 44.0)],
)
def test_a_tone_at_the_stated_corner_loses_three_decibels(window, align, corner_hz):
    t = torch.arange(4000, dtype=torch.float64) / 2000.0
    tone, inside = torch.sin(2 * torch.pi * corner_hz * t), slice(200, -200)
    gain = filtered(tone, window, align=align)[inside].std() / tone[inside].std()
    assert 20 * torch.log10(gain) == pytest.approx(-3, abs=0.2)


@pytest.mark.parametrize(
    ("num_samples", "window", "order", "align", "message"),
    [
        (80, 10, 1, "centred", r"odd and positive, got 10"),
        (80, 5, 5, "centred", r"polyorder must lie in 0\.\.4.*5"),
        (50, 51, 1, "centred", r"50 samples.*51"),
        (50, 11, 1, "left", r"one of centred, causal, trailing, got 'left'"),
    ],
)
def test_errors_name_the_value(num_samples, window, order, align, message):
    with pytest.raises(ValueError, match=message):
        filtered(torch.zeros(num_samples), window, order, align)


# --- a frame for every channel ------------------------------------------------------------------


@aligned
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("num_samples", [1, 100, 101])
def test_each_channel_gets_its_own_frame_and_bins_are_parts_of_the_whole(
    num_samples, order, align, rng
):
    layer = ChannelFilter(LENGTHS, order, align)
    before, after = (25, 25) if align == "centred" else (50, 0)
    assert (layer.context_before, layer.context_after, layer.context) == (before, after, 25)
    x = oracles.random_bins(rng, 3, 4, 20 + 50 + num_samples)  # 20 samples that nobody needs
    expected = np.stack([ORACLES[align](x[:, c], w, order) for c, w in enumerate(LENGTHS)], 1)
    np.testing.assert_allclose(layer(torch.from_numpy(x)), expected, rtol=1e-9, atol=1e-9)
    bins = layer.valid(torch.from_numpy(x[..., 20:].copy()))
    assert bins.shape == (3, 4, num_samples)
    inside = expected[..., 20 + before : 20 + before + num_samples]
    np.testing.assert_allclose(bins, inside, rtol=1e-9, atol=1e-9)


def test_channel_filter_errors():
    layer = ChannelFilter(LENGTHS)
    for call in (layer, layer.valid):
        with pytest.raises(ValueError, match=r"4.*\(3, 100\)"):
            call(torch.zeros(3, 100))
    with pytest.raises(ValueError, match=r"25 samples of context before and 25 behind.* 50"):
        layer.valid(torch.zeros(4, 50))
    with pytest.raises(ValueError, match=r"50 samples of context before and 0 behind.* 50"):
        ChannelFilter(LENGTHS, align="causal").valid(torch.zeros(4, 50))
    for call in (layer, lambda x: extended(x, layer)):
        with pytest.raises(ValueError, match=r"50 samples.*51"):
            call(torch.zeros(4, 50))
    with pytest.raises(ValueError, match=r"odd.*10"):
        ChannelFilter([11, 10])


# --- kernels of one's own -----------------------------------------------------------------------


@aligned
def test_own_kernels_are_convolutions_that_keep_constants_and_come_back(align, rng):
    plain = ChannelFilter([11, 1, 5, 11], 1, align)
    layer = ChannelFilter(plain.window_lengths, 1, align, own_kernels(plain))
    x = torch.from_numpy(rng.standard_normal((4, 80)))
    ours = layer(x)
    for channel, (before, after) in enumerate(layer.reaches):
        expected = np.convolve(x[channel], layer.kernel(channel).flip(0), mode="valid")
        inside = ours[channel, before : 80 - after].numpy()
        np.testing.assert_allclose(inside, expected, rtol=0, atol=1e-13)
    assert not torch.allclose(ours, plain(x))
    still = torch.full((4, 40), 3.0, dtype=torch.float64)
    torch.testing.assert_close(layer(still), still)
    again = ChannelFilter(**json.loads(json.dumps(layer.config())))
    assert again.config() == layer.config()
    assert torch.equal(again(x), ours)
    assert set(ChannelFilter([3]).config()) == {"window_lengths", "polyorder", "align"}


@pytest.mark.parametrize(
    ("kernels", "message"),
    [
        ({7: [1 / 7] * 7}, r"a kernel of 7 samples fits none of the frames \[5, 11\]"),
        ({5: [0.25] * 4}, "a frame of 5 samples needs as many weights, got 4"),
        ({5: [0.25] * 5}, r"must be finite and sum to 1, got 1\.25; divide"),
    ],
)
def test_what_is_no_kernel_is_refused_in_one_line(kernels, message):
    with pytest.raises(ValueError, match=message):
        ChannelFilter([11, 1, 5, 11], kernels=kernels)


@aligned
def test_the_largest_sample_of_a_bins_frames_is_what_its_filtered_samples_depend_on(align):
    layer, generator = ChannelFilter([51, 11, 1], align=align), torch.Generator().manual_seed(0)
    x = torch.rand(3, 400, generator=generator, dtype=torch.float64)
    starts = torch.tensor([60, 61, 200, 290, 340])
    found = largest_in_frames(x, starts, 10, layer.reaches)
    expected = torch.zeros_like(found)
    for sample in range(400):
        other = x.clone()
        other[:, sample] += 1.0
        changed = (layer(other) != layer(x)).numpy()
        for row, start in enumerate(starts):
            uses = torch.from_numpy(changed[:, start : start + 10].any(1))
            expected[row] = expected[row].maximum(torch.where(uses, x[:, sample], 0.0))
    assert torch.equal(found, expected)
    whole = torch.tensor([0, 390])  # frames that would leave the recording end with it
    assert torch.equal(largest_in_frames(x, whole, 400, [(0, 0)] * 3)[0], x.amax(-1))
    assert largest_in_frames(x, starts[:0], 10, layer.reaches).shape == (0, 3)
