"""The graph of a stream against ``StreamingDetector``, push by push."""

from functools import cache
from itertools import pairwise

import numpy as np
import onnxruntime
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import detector_of, signal

from tactslip_torch.graph.bins import Judged
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.stream import stream_graph
from tactslip_torch.graph.value import F64
from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.judgement import Judgement
from tactslip_torch.onset.sequential import BayesFilter, Cusum, Hysteresis, KOfN
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

RATE = 2000.0
KINDS = ("all", "PVDF")
ALIGNMENTS = ("centred", "causal", "trailing")
RULES = {
    rule.name: rule
    for rule in (KOfN(2, 3), Hysteresis(0.5), BayesFilter(1.0, 0.3, 0.01, 0.2), Cusum(0.5, 0.5, 2))
}
# Scores of the stand-in lie about 0.3; these make half of them speak for slip.
CALIBRATIONS = {
    "platt": Platt(6.0, -1.5),
    "isotonic": Isotonic((0.05, 0.1, 0.2, 0.4, 0.8), (-3.0, -2.0, -0.5, 1.0, 2.5)),
}


def loudness(bins, *, given):
    """Stands in for a detector's ``judge``: mean square of its channels, those missing apart."""
    is_missing = ~bins.isfinite().all(-1)
    loud = bins.square().mean(-1).masked_fill(is_missing, 0.0).mean(-1)
    return Judgement(loud.to(given), ~is_missing.any(-1), is_missing)


def judge_loudness(graph, detector, windows, form):
    """The same of raw windows, as nodes; samples beyond a channel's frame may be anything."""
    window, layer = Window.of(detector), detector.channel_filter
    parts = []
    for place, channel in enumerate(window.channels):
        before, after = layer.reaches[channel]
        start = window.before - before
        own = windows.slice(place, place + 1, 1).slice(start, start + before + 100 + after, 2)
        kernel = layer.kernel(channel)
        matrix = torch.zeros(before + 100 + after, 100, dtype=torch.float64)
        for i in range(100):
            matrix[i : i + len(kernel), i] = kernel
        parts.append(own.cast(F64) @ matrix.numpy())
    filtered = graph.concat(*parts, axis=1)
    loud = (filtered * filtered).mean(2)
    is_there = loud.is_finite()
    total = graph.where(is_there, loud, 0.0).sum(1) / float(len(detector.pool.hand))
    num_there = is_there.cast(F64).sum(1)
    is_valid = num_there.equals(float(len(window.channels)))
    return Judged(total.cast(form.dtype), is_valid, num_there > 0.0)


@cache
def loud_detector(kind="all", align="centred"):
    detector = detector_of(kind, align)
    unused = torch.ones(len(detector.pool.hand), dtype=torch.bool)
    unused[detector.needed_index] = False

    def judge(bins, *, given):
        judged = loudness(bins.masked_fill(unused[:, None], 0.0), given=given)
        return judged._replace(is_missing=judged.is_missing)

    detector.judge = judge
    return detector


def settings_of(rule="k_of_n", calibration="platt", hop=20, threshold=1.0, share=0.3):
    return AlarmSettings(
        hop,
        CALIBRATIONS[calibration],
        RULES[rule],
        threshold,
        target_per_hour=1.0,
        slip_share=share,
        rearm_s=0.02,
        refractory_s=0.05,
        lead_s=0.03,
    )


class Host:
    """What a program around the graph does: it keeps tail and state, and no more."""

    def __init__(self, session, num_channels, dtype):
        self.session, self.dtype = session, dtype
        self.tail, self.state = np.zeros((0, num_channels), dtype), np.zeros(0)

    def push(self, samples, threshold=None):
        given = [] if threshold is None else [threshold]
        names = [output.name for output in self.session.get_outputs()]
        inputs = {
            "samples": np.ascontiguousarray(samples, self.dtype),
            "tail": self.tail,
            "state": self.state,
            "threshold": np.array(given, np.float64),
        }
        found = dict(zip(names, self.session.run(names, inputs), strict=True))
        self.tail, self.state = found.pop("next_tail"), found.pop("next_state")
        return found


@cache
def session_of(kind, align, rule, calibration, hop, precision, threshold=1.0):
    settings = settings_of(rule, calibration, hop, threshold)
    detector = loud_detector(kind, align)
    graph = stream_graph(detector, settings, Form(precision), judge_loudness)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(graph.model({}).SerializeToString(), options)


def pair_of(kind="all", align="centred", rule="k_of_n", calibration="platt", hop=20, double=True):
    """A host with the graph, and the detector in torch."""
    detector = loud_detector(kind, align)
    settings = settings_of(rule, calibration, hop)
    dtype = torch.float64 if double else torch.float32
    precision = "float64" if double else "float32"
    session = session_of(kind, align, rule, calibration, hop, precision)
    host = Host(session, len(detector.pool.hand), np.dtype(precision))
    return host, StreamingDetector(detector, settings, dtype=dtype)


EXACT = {"valid": "is_valid", "alarm": "is_alarm", "on": "is_on", "time_s": "available_s"}


def assert_same(found, expected):
    """Scores and what follows from them to rounding, everything else exactly."""
    is_double = expected.score.dtype == torch.float64
    for name in ("score", "probability", "statistic"):
        wanted = getattr(expected, name).numpy()
        assert found[name].dtype == wanted.dtype
        close = 1e-9 if is_double else 1e-5
        np.testing.assert_allclose(found[name], wanted, rtol=close, atol=close, err_msg=name)
    for name, torch_name in [*EXACT.items(), ("onset_s", "onset_s")]:
        wanted = getattr(expected, torch_name).numpy()
        np.testing.assert_array_equal(found[name], wanted, err_msg=name)


def assert_same_stream(host, stream, samples, cuts):
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    num = 0
    for start, stop in pairwise(places):
        piece = samples[:, start:stop].T
        expected = stream.push(piece)
        assert_same(host.push(piece.numpy()), expected)
        num += len(expected.alarms)
    return num


@given(
    num_samples=st.integers(0, 900),
    cuts=st.lists(st.integers(0, 900), max_size=30),
    kind=st.sampled_from(KINDS),
    align=st.sampled_from(ALIGNMENTS),
    rule=st.sampled_from(list(RULES)),
    calibration=st.sampled_from(list(CALIBRATIONS)),
    hop=st.sampled_from([5, 7, 20, 100, 120]),
    double=st.booleans(),
    bad=st.lists(st.tuples(st.integers(0, 899), st.sampled_from([np.nan, np.inf])), max_size=3),
)
def test_any_cut_gives_what_the_detector_gives(
    num_samples, cuts, kind, align, rule, calibration, hop, double, bad
):
    host, stream = pair_of(kind, align, rule, calibration, hop, double)
    samples = signal(900, 5, stream.dtype)
    for place, value in bad:
        samples[place % 4, place] = value
    assert_same_stream(host, stream, samples[:, :num_samples], cuts)
