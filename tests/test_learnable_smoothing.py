"""Kernels that are learned: where they start, what they may become, and the ends of a signal."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from torch.func import functional_call

from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.kernel_edges import edges_by
from tactslip_torch.signals.learnable import LearnableSmoothing, extended, filter_bins
from tactslip_torch.signals.savgol import edge_matrices
from tactslip_torch.signals.stream import FilterStream

ALIGNMENTS = ("centred", "causal", "trailing")
LENGTHS = [11, 1, 5, 11]
aligned = pytest.mark.parametrize("align", ALIGNMENTS)


def moved(channel_filter, seed=0, size=1.0):
    """Kernels as large as Savitzky-Golay's away from those."""
    smoothing, generator = LearnableSmoothing(channel_filter), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in smoothing.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(size * noise)
    return smoothing


def learned(align="centred", lengths=LENGTHS, seed=0):
    return ChannelFilter(lengths, 1, align, moved(ChannelFilter(lengths, 1, align), seed).frozen())


def recording(num_samples=80, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((4, num_samples)))


@aligned
@pytest.mark.parametrize("polyorder", [1, 2])
def test_it_starts_exactly_at_savitzky_golay(align, polyorder):
    plain = ChannelFilter(LENGTHS, polyorder, align)
    smoothing = LearnableSmoothing(plain)
    assert list(smoothing.kernels) == [11, 5]
    pos = None if align != "causal" else 10
    taps = signal.savgol_coeffs(11, polyorder, pos=pos, use="dot")
    np.testing.assert_allclose(smoothing.kernels[11].detach().numpy(), taps, rtol=0, atol=1e-14)
    for length, kernel in smoothing.kernels.items():
        assert torch.equal(kernel, plain.kernel(LENGTHS.index(length)))


@given(align=st.sampled_from(ALIGNMENTS), seed=st.integers(0, 2**31), size=st.sampled_from([1, 30]))
def test_whatever_was_learned_sums_to_one(align, seed, size):
    smoothing = moved(ChannelFilter(LENGTHS, align=align), seed, size)
    for kernel in smoothing.kernels.values():
        kernel = kernel.detach()
        assert float(kernel.sum()) == pytest.approx(1, abs=1e-14 * size * len(kernel))
        is_symmetric = bool((kernel - kernel.flip(0)).abs().max() < 1e-14 * size)
        assert is_symmetric == (align != "causal")


@aligned
def test_inside_it_is_the_convolution_with_the_kernel(align):
    layer, x = learned(align), recording()
    found = layer(x)
    for channel, length in enumerate(LENGTHS):
        expected = np.convolve(x[channel], layer.kernel(channel).flip(0), mode="valid")
        before, after = layer.reaches[channel]
        inside = found[channel, before : 80 - after].numpy()
        np.testing.assert_allclose(inside, expected, rtol=0, atol=1e-13)
        assert (length == 1) == torch.equal(found[channel], x[channel])
    assert not torch.allclose(found, ChannelFilter(LENGTHS, align=align)(x))


@aligned
@pytest.mark.parametrize("polyorder", [0, 1, 2])
def test_with_savitzky_golays_weights_the_ends_are_its_ends(align, polyorder):
    edges = edge_matrices(11, polyorder, align)
    found = edges_by(edges[1], polyorder, align)
    for part, expected in zip(found, edges, strict=True):
        torch.testing.assert_close(part, expected, rtol=0, atol=1e-11)


@aligned
def test_the_ends_keep_constants_and_lines(align):
    layer = learned(align)
    torch.testing.assert_close(
        layer(torch.full((4, 40), 3.0).double()), torch.full((4, 40), 3.0).double()
    )
    if align == "centred":  # the others delay a line, or are not symmetric
        line = torch.arange(40.0, dtype=torch.float64).expand(4, 40)
        torch.testing.assert_close(layer(line), line, rtol=0, atol=1e-11)


@aligned
@pytest.mark.parametrize("num_samples", [11, 80])
def test_bins_of_an_extended_recording_are_the_recording_filtered_whole(align, num_samples):
    plain, x = ChannelFilter(LENGTHS, align=align), recording(num_samples)
    smoothing = moved(plain)
    layer = ChannelFilter(LENGTHS, 1, align, smoothing.frozen())
    whole = extended(x, plain)
    assert torch.equal(whole[:, layer.context_before : layer.context_before + num_samples], x)
    torch.testing.assert_close(smoothing(whole), layer(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(layer.valid(whole), layer(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(plain.valid(whole), plain(x), rtol=0, atol=1e-12)


@aligned
@pytest.mark.parametrize("wanted", [None, (2,), (0, 1)])
def test_a_stream_in_pieces_is_the_recording_filtered_whole(align, wanted):
    layer, x = learned(align), recording()
    stream = FilterStream(layer, channels=wanted)
    parts = [stream.push(piece) for piece in x.split(7, dim=-1)] + [stream.flush()]
    torch.testing.assert_close(torch.cat(parts, -1), layer(x, wanted), rtol=0, atol=1e-12)


@aligned
def test_gradients_are_differences(align):
    smoothing = moved(ChannelFilter([5, 1, 3, 5], align=align))
    names, values = zip(*smoothing.named_parameters(), strict=True)
    samples = recording(12).requires_grad_()

    def filtered(samples, *values):
        return functional_call(smoothing, dict(zip(names, values, strict=True)), (samples,))

    assert torch.autograd.gradcheck(filtered, (samples, *values))
    assert torch.autograd.gradgradcheck(filtered, (samples, *values), fast_mode=True)


def test_kernels_left_out_are_the_filters_own():
    plain, x = ChannelFilter(LENGTHS), recording()
    found = filter_bins(x, plain, {5: torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0])})
    expected = plain.valid(x)
    expected[2] = x[2, 5:-5]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)
    assert torch.equal(ChannelFilter(LENGTHS, kernels={})(x), plain(x))


@aligned
def test_a_filter_comes_back_from_its_facts(align):
    layer, x = learned(align), recording()
    again = ChannelFilter(**json.loads(json.dumps(layer.facts())))
    assert again.facts() == layer.facts()
    assert torch.equal(again(x), layer(x))
    assert set(ChannelFilter(LENGTHS).facts()) == {"window_lengths", "polyorder", "align"}


@pytest.mark.parametrize(
    ("kernels", "message"),
    [
        ({7: [1 / 7] * 7}, r"a kernel of 7 samples fits none of the frames \[5, 11\]"),
        ({1: [1.0]}, "a kernel of 1 samples fits none"),
        ({5: [0.25] * 4}, "a frame of 5 samples needs as many weights, got 4"),
        ({5: [0.25] * 5}, r"must be finite and sum to 1, got 1\.25; divide"),
        ({5: [float("nan")] + [0.25] * 4}, "must be finite and sum to 1, got nan"),
    ],
)
def test_what_is_no_kernel_is_refused_in_one_line(kernels, message):
    with pytest.raises(ValueError, match=message) as error:
        ChannelFilter(LENGTHS, kernels=kernels)
    assert "\n" not in str(error.value)


def test_what_is_no_recording_is_refused():
    plain = ChannelFilter(LENGTHS)
    with pytest.raises(ValueError, match="10 samples is shorter than window_length 11"):
        extended(torch.zeros(4, 10), plain)
    with pytest.raises(ValueError, match=r"expected samples \[\*, 4, T\]"):
        extended(torch.zeros(3, 20), plain)
    with pytest.raises(ValueError, match="5 samples of context before and 5 behind, got 10"):
        LearnableSmoothing(plain)(torch.zeros(4, 10))


def test_it_follows_its_parameters_to_another_device():
    smoothing = LearnableSmoothing(ChannelFilter(LENGTHS)).to("meta")
    assert smoothing(torch.zeros(4, 80, device="meta", dtype=torch.float64)).shape == (4, 70)
    assert smoothing.kernels[11].device.type == "meta"
