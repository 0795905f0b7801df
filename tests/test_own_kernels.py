"""Kernels of one's own in a channel filter: inside, at the ends, in bins, streams and files."""

import json

import numpy as np
import pytest
import torch
from any_hands import own_kernels

from tactslip_torch.signals.filtering import ChannelFilter, _edges_by, edge_matrices, extended
from tactslip_torch.signals.stream import FilterStream

ALIGNMENTS = ("centred", "causal", "trailing")
LENGTHS = [11, 1, 5, 11]
aligned = pytest.mark.parametrize("align", ALIGNMENTS)


def own(align="centred", lengths=LENGTHS):
    return ChannelFilter(lengths, 1, align, own_kernels(ChannelFilter(lengths, 1, align)))


def recording(num_samples=80, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((4, num_samples)))


@aligned
def test_inside_it_is_the_convolution_with_the_kernel(align):
    layer, x = own(align), recording()
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
    found = _edges_by(edges[1], polyorder, align)
    for part, expected in zip(found, edges, strict=True):
        torch.testing.assert_close(part, expected, rtol=0, atol=1e-11)


@aligned
def test_the_ends_keep_constants_and_lines(align):
    layer = own(align)
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
    layer = own(align)
    whole = extended(x, plain)
    assert torch.equal(whole[:, layer.context_before : layer.context_before + num_samples], x)
    torch.testing.assert_close(layer.valid(whole), layer(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(plain.valid(whole), plain(x), rtol=0, atol=1e-12)


@aligned
@pytest.mark.parametrize("wanted", [None, (2,), (0, 1)])
def test_a_stream_in_pieces_is_the_recording_filtered_whole(align, wanted):
    layer, x = own(align), recording()
    stream = FilterStream(layer, channels=wanted)
    parts = [stream.push(piece) for piece in x.split(7, dim=-1)] + [stream.flush()]
    torch.testing.assert_close(torch.cat(parts, -1), layer(x, wanted), rtol=0, atol=1e-12)


@aligned
def test_a_filter_comes_back_from_its_facts(align):
    layer, x = own(align), recording()
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
