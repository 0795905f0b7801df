"""One table: every kind of bin by every backend and dtype has the same flags and decisions."""

from typing import NamedTuple

import numpy as np
import onnx
import pytest
import torch
from contract.recordings import NAMES, bins_of, samples_of
from extremes import EXTREMES, extreme_bins
from test_detector import repeated

from tactslip_torch.deploy.bins import RawBin, bin_graph
from tactslip_torch.deploy.check import runner, session_of
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.onset.decisions import score_stream
from tactslip_torch.onset.streaming import StreamingDetector

pytestmark = pytest.mark.onnx
BROKEN = {"nan": torch.nan, "inf": torch.inf, "-inf": -torch.inf}
FLAGS = ("valid", "in_range", "channels_lost")
CASES = [
    ("general", "float32"),
    ("paper", "float64"),
    pytest.param(("general", "float64"), marks=pytest.mark.slow),
    pytest.param(("paper", "float32"), marks=pytest.mark.slow),
    ("general, several views", "float32"),
    pytest.param(("general, several views", "float64"), marks=pytest.mark.slow),
    pytest.param(("general, several views in factors", "float32"), marks=pytest.mark.slow),
]


class Backends(NamedTuple):
    """A trained detector by the native engine, where there is one, by torch, and as a graph."""

    native: SlipDetector
    torch: SlipDetector
    graph: object
    dtype: torch.dtype
    spread: float

    def onnx(self, bins):
        raw = RawBin.of(self.native)
        start = self.native.context_before - raw.before
        found = self.graph({"samples": bins[..., start : start + raw.length].contiguous().numpy()})
        return [found[name] for name in ("score", *FLAGS)]


def several_views(detector, in_factors=False):
    """The detector with some of its columns scaled once more, and a quadratic part on others."""
    again = range(3, len(detector.scaler.minimum), 2)
    scaler, head, chosen = repeated(detector.scaler, again), detector.head, list(again)
    rng = np.random.default_rng(0)
    size = float(head.linear.abs().mean())
    bend = size * torch.from_numpy(rng.standard_normal((17, 17)))
    linear = torch.cat([head.linear, -head.linear[chosen]])
    views = QuadraticForm(bend + bend.T, linear, head.constant)
    if in_factors:
        signs = torch.tensor([1.0, -1.0, 1.0])
        views = QuadraticForm(bend[:3] / size**0.5, linear, head.constant, signs)
    parts = detector.pool, detector.channel_filter, detector.selected, scaler, views, detector.info
    imputation = torch.cat([detector.imputation, 0.5 * detector.imputation[chosen]])
    return SlipDetector(*parts, imputation, detector.pooling, sensing=detector.sensing)


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def backends(request, graphs_of, tmp_path_factory):
    name, precision = request.param
    recipe, _, views = name.partition(", ")
    file = request.getfixturevalue(recipe).file
    if views:
        made = several_views(SlipDetector.load(file), "factors" in views)
        file = tmp_path_factory.mktemp("views") / "detector.pt"
        made.save(file)
        model = bin_graph(made, precision).model()
    else:
        model = onnx.load(graphs_of(recipe, precision) / "model.onnx")
    graph = runner(session_of(model))
    native, by_torch = (SlipDetector.load(file, backend=name) for name in ("auto", "torch"))
    score = native.predict_raw(bins_of(native, samples_of("D", 1))).score
    return Backends(native, by_torch, graph, getattr(torch, precision), float(score.std()))


def test_ordinary_bins_have_the_scores_of_float64(backends):
    native, by_torch, _, dtype, spread = backends
    bins = bins_of(native, samples_of("D", 2), 211).to(dtype)
    absent = bins.clone()
    absent[:, NAMES.index(native.pool.hand.names[native.needed_index[0]])] = torch.nan
    for given in (bins, absent, bins[:1], bins[:0]):
        expected = native.predict_raw(given.double(), given=dtype)
        assert expected.is_valid.all()
        close = {torch.float32: 1e-4, torch.float64: 1e-9}[dtype] * spread
        for found in (by_torch.predict_raw(given), native.predict_raw(given)):
            torch.testing.assert_close(found.score, expected.score, rtol=0, atol=close)
        score, *flags = backends.onnx(given)
        np.testing.assert_allclose(score, expected.score, rtol=0, atol=close)
        for got, wanted in zip(flags, expected[1:4], strict=True):
            np.testing.assert_array_equal(got, wanted)


def bins_by(kind, shape, dtype, beside):
    """Raw bins of a kind in every channel, or in two of them ``beside`` ordinary ones."""
    generator = torch.Generator().manual_seed(sum(map(ord, kind)))
    ordinary = 0.1 * torch.randn(shape, generator=generator, dtype=torch.float64)
    ordinary[:, :2] += 1.0
    if kind in BROKEN:
        bins, place = ordinary.clone(), torch.randint(shape[2], (shape[0], 1), generator=generator)
        bins[:, 1].scatter_(-1, place, BROKEN[kind])
    else:
        bins = extreme_bins(kind, shape, generator, dtype).double()
    if beside:
        bins[:, ::2] = ordinary[:, ::2]
    return bins.to(dtype)


def assert_agree(found, expected, margin, what, rows=slice(None)):
    """Flags are the same, and decisions where they are valid and outside the margin."""
    score, is_valid, *flags = (np.asarray(each) for each in found)
    own, is_own_valid, *own_flags = (np.asarray(each)[rows] for each in expected)
    for each, wanted in zip((is_valid, *flags), (is_own_valid, *own_flags), strict=True):
        np.testing.assert_array_equal(each, wanted, err_msg=f"flags by {what}")
    turned = ((score >= 0) != (own >= 0)) & is_valid & (np.abs(own) > margin)
    assert not turned.any(), f"{what}: {score[turned]}"
    np.testing.assert_array_equal(np.isfinite(score), is_valid)


def joined(parts):
    return [torch.cat(each) for each in zip(*parts, strict=True)]


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("kind", [*EXTREMES, *BROKEN])
def test_every_kind_of_bin_is_decided_alike(backends, kind, beside):
    native, by_torch, _, dtype, spread = backends
    num, margin = 24, 1e-4 * spread
    length = native.context_before + native.pool.bin_samples + native.context_after
    bins = bins_by(kind, (num, len(NAMES), length), dtype, beside)
    expected = native.predict_raw(bins)[:4]
    assert_agree(backends.onnx(bins), expected, margin, "onnx")
    assert_agree(by_torch.predict_raw(bins)[:4], expected, margin, "torch")
    few = range(0, num, num // 8)
    for name, made in (("native", native), ("torch", by_torch)):
        alone = joined(made.predict_raw(bins[i : i + 1])[:4] for i in few)
        assert_agree(alone, expected, margin, f"{name}, alone", list(few))
    whole = bins_by(kind, (1, len(NAMES), 1500), dtype, beside)[0]
    offline = score_stream(native, whole, 20)[:4]
    assert_agree(score_stream(by_torch, whole, 20)[:4], offline, margin, "torch, offline")
    stream = StreamingDetector(native, dtype=dtype)
    parts = [*map(stream.push, whole.T.split(37)), stream.flush()]
    of_stream = joined((x.score, x.is_valid, x.in_range, x.channels_lost) for x in parts)
    offline = score_stream(native, whole, stream.settings.hop_samples)[:4]
    assert_agree(of_stream, offline, margin, "stream")
