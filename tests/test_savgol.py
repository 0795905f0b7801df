"""What was before a signal, so that its filter is one thing from end to end."""

import numpy as np
import pytest
import torch

from tactslip_torch.signals.filtering import (
    ChannelFilter,
    convolve_valid,
    edge_matrices,
    past_matrix,
    reach,
    savgol_filter,
)
from tactslip_torch.signals.stream import FilterStream

ALIGNMENTS = ("centred", "causal", "trailing")
FRAMES = [
    (1, 0),
    (1, 1),
    (1, 3),
    (3, 0),
    (3, 1),
    (3, 2),
    (5, 2),
    (5, 4),
    (11, 1),
    (11, 3),
    (51, 1),
    (51, 2),
]


def with_past(x, window_length, polyorder, align):
    frame = x[:window_length]
    past = x[0] + past_matrix(window_length, polyorder, align) @ (frame - x[0])
    return torch.cat([past, x])


@pytest.mark.parametrize("align", ALIGNMENTS)
@pytest.mark.parametrize(("window_length", "polyorder"), FRAMES)
@pytest.mark.parametrize("num_samples", [51, 300])
def test_the_plain_filter_of_past_and_signal_is_the_filter(
    window_length, polyorder, align, num_samples, rng
):
    x = torch.from_numpy(rng.standard_normal(num_samples) + rng.uniform(-5, 5))
    _, kernel, _ = edge_matrices(window_length, polyorder, align)
    found = convolve_valid(with_past(x, window_length, polyorder, align), kernel)
    _, after = reach(window_length, align)
    expected = savgol_filter(x, window_length, polyorder, align)[: num_samples - after]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("align", ALIGNMENTS)
@pytest.mark.parametrize(("window_length", "polyorder"), FRAMES)
def test_a_constant_was_the_same_before(window_length, polyorder, align):
    past = past_matrix(window_length, polyorder, align)
    assert past.dtype == torch.float64
    assert past.shape == (reach(window_length, align)[0], window_length)
    torch.testing.assert_close(past.sum(-1), torch.ones(len(past)).double(), rtol=0, atol=1e-11)
    still = torch.full((60,), 0.1, dtype=torch.float64)
    assert (with_past(still, window_length, polyorder, align) == 0.1).all()


def test_a_line_goes_on_behind_a_centred_frame():
    line = torch.from_numpy(np.linspace(3.0, 9.0, 51))
    found = with_past(line, 11, 1, "centred")
    expected = 3.0 + 0.12 * torch.arange(-5, 51, dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("align", ALIGNMENTS)
def test_a_hole_in_the_first_frame_is_in_all_of_the_past_and_a_later_one_in_none(align):
    x = torch.arange(60, dtype=torch.float64)
    x[51] = torch.nan
    assert with_past(x, 51, 1, align)[:-60].isfinite().all()
    for place in (0, 7, 50):
        broken = x.clone()
        broken[place] = torch.inf
        assert not with_past(broken, 51, 1, align)[:-60].isfinite().any()


@pytest.mark.parametrize("align", ALIGNMENTS)
@pytest.mark.parametrize("polyorder", [0, 1, 4])
def test_a_frame_of_one_sample_leaves_a_signal_as_it_is(polyorder, align):
    x = torch.tensor([1.0, -0.0, 3.0, torch.nan, torch.inf], dtype=torch.float64)
    found = savgol_filter(x, 1, polyorder, align)
    assert found.numpy().tobytes() == x.numpy().tobytes()
    assert found.data_ptr() != x.data_ptr()
    layer = ChannelFilter([1, 5, 1], polyorder, align)
    whole = torch.randn(3, 40, dtype=torch.float64)
    stream = FilterStream(layer)
    pieces = [stream.push(whole[:, :17]), stream.push(whole[:, 17:]), stream.flush()]
    bins = layer.valid(whole[:, :24])  # 20 samples in the context of the longest frame
    assert torch.equal(
        bins[[0, 2]], whole[[0, 2], layer.context_before : layer.context_before + 20]
    )
    for filtered in (layer(whole), torch.cat(pieces, dim=-1)):
        assert torch.equal(filtered[[0, 2]], whole[[0, 2]])
        torch.testing.assert_close(filtered[1], savgol_filter(whole[1], 5, polyorder, align))


@pytest.mark.parametrize(
    ("window_length", "polyorder", "align", "message"),
    [
        (10, 1, "centred", "odd and positive, got 10"),
        (3, 3, "centred", r"polyorder must lie in 0\.\.2"),
        (11, 1, "left", "align must be one of"),
    ],
)
def test_what_is_no_frame_has_no_past(window_length, polyorder, align, message):
    with pytest.raises(ValueError, match=message):
        past_matrix(window_length, polyorder, align)
