"""What a graph is tried on: degenerate bins, and a simulated slip on any hand."""

import pytest
import torch
from small_detector import HAND

from tactslip_torch.graph.trials import KINDS, degenerate_bins, simulated_bins, simulated_stream

pytestmark = pytest.mark.onnx


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_bins_are_what_they_are_called(kind, dtype):
    bins = degenerate_bins(HAND, kind, 8, 110, dtype)
    assert (bins.shape, bins.dtype) == ((8, 4, 110), dtype)
    bad = (~bins.isfinite()).flatten(1).sum(1)
    wanted = {"nan": 1, "inf": 1, "-inf": 1, "all nan": 440}.get(kind, 0)
    assert bad.tolist() == [wanted] * 8
    if kind == "step":
        assert bins.unique().tolist() == [0.0, 5.0]
        assert (bins.diff() >= 0).all()


def test_simulated_bins_are_of_each_channel_its_kind():
    stream = simulated_stream(HAND, 2000.0, torch.float64)
    assert stream.shape[0] == 4
    assert 2990 <= stream.shape[1] <= 3000
    assert stream.isfinite().all()
    assert (stream[:2].std(1) > 0).all()
    assert not torch.equal(stream[0], stream[1])
    assert torch.equal(simulated_stream(HAND, 2000.0, torch.float64, 2900), stream)
    bins = simulated_bins(HAND, 2000.0, 56, 110, torch.float64)
    assert torch.equal(bins[0], stream[:, :110])
    assert torch.equal(bins[-1], stream[:, -110:])


@pytest.mark.parametrize("rate_hz", [1.0, 20.0, 92.3])
def test_a_slow_hand_is_tried_on_a_slip_that_fills_its_bins(rate_hz):
    stream = simulated_stream(HAND, rate_hz, torch.float64, 400)
    assert 400 <= stream.shape[1] <= 420
    bins = simulated_bins(HAND, rate_hz, 56, 100, torch.float64)
    assert bins.shape == (56, 4, 100)
    assert len(bins.unique(dim=0)) == 56
