"""The graph of a stream against ``StreamingDetector``, push by push."""

from functools import cache
from itertools import pairwise

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from streams import detector_of, signal

from tactslip_torch.graph.bins import Judged
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.stream import Timing, stream_graph
from tactslip_torch.graph.value import F64
from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.onset.decisions import score_stream
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.signals.filtering import ChannelFilter

RATE = 2000.0
KINDS = ("all", "PVDF", "long")  # long: a frame that a causal bin does not hold
ALIGNMENTS = ("centred", "causal", "trailing")
RULES = {rule.name: rule for rule in (KOfN(2, 3), Cusum(0.5, 0.5, 2))}
# Scores of the stand-in lie about 0, so that half of them speak for slip.
CALIBRATIONS = {
    "platt": Platt(1.0, 0.0),
    "isotonic": Isotonic((-4.0, -1.0, 0.0, 1.0, 2.0), (-3.0, -2.0, -0.5, 1.0, 2.5)),
}
USUAL = {"all": -6.0, "PVDF": -8.0, "long": -6.0}  # log of the mean variance of channels in use
FLOOR = 1e-9  # of a variance, volts squared: what does not move has one score in any arithmetic


def judge_loudness(graph, detector, windows, form, dead):
    """The same of raw windows, as nodes; what lies beyond a channel's frame is not looked at."""
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
    moved = filtered - filtered.mean(2, keepdim=True)
    loud = (moved * moved).mean(2)
    is_there = loud.isfinite() & ~dead.take(window.channels, 0)
    total = graph.where(is_there, loud, 0.0).sum(1)
    total = (total + FLOOR).log() - detector.usual
    num_there = is_there.cast(F64).sum(1)
    is_valid = num_there.eq(float(len(window.channels)))
    return Judged(total.cast(form.dtype), is_valid, num_there > 0.0)


@cache
def loud_detector(kind="all", align="centred"):
    """A detector whose score is the logarithm of what its channels move, those missing apart."""
    detector = detector_of("all" if kind == "long" else kind, align)
    if kind == "long":
        detector.channel_filter = ChannelFilter([151, 51, 11, 3], align=align)
    detector.usual = USUAL[kind]
    used = detector.needed_index

    def judge(bins, *, given):
        is_missing = ~bins.isfinite().all(-1)
        loud = bins.var(-1, correction=0).masked_fill(is_missing, 0.0)[:, used].sum(-1)
        score = (loud + FLOOR).log() - detector.usual
        score = score.to(given)
        return Prediction(score, ~is_missing[:, used].any(-1), is_missing, torch.zeros_like(score))

    detector.predict = judge
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
    """What a program around the graph does: it keeps tail and state, and nothing else."""

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


def assert_same_stream(host, stream, samples, cuts=()):
    """Push pieces to both; returns how many alarms there were."""
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
    seed=st.integers(0, 20),
    bad=st.lists(st.tuples(st.integers(0, 899), st.sampled_from([np.nan, np.inf])), max_size=3),
)
def test_any_cut_gives_what_the_detector_gives(
    num_samples, cuts, kind, align, rule, calibration, hop, double, seed, bad
):
    host, stream = pair_of(kind, align, rule, calibration, hop, double)
    samples = signal(900, seed, stream.dtype)
    for place, value in bad:
        samples[place % 4, place] = value
    assert_same_stream(host, stream, samples[:, :num_samples], cuts)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("double", [True, False])
def test_small_pieces_raise_the_same_alarms(rule, double):
    host, stream = pair_of(rule=rule, double=double)
    samples = signal(3000, 5, stream.dtype)
    cuts = [*range(300), *range(300, 3000, 7)]
    assert assert_same_stream(host, stream, samples, cuts) >= 3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("align", ALIGNMENTS)
def test_the_start_of_a_stream_is_filtered_as_a_recording(kind, align):
    host, stream = pair_of(kind, align, hop=5)
    samples = signal(300, 3) + torch.linspace(0, 5, 300, dtype=torch.float64)
    assert_same_stream(host, stream, samples, [120, 180])
    host, stream = pair_of(kind, align, hop=5)
    still = torch.full((4, 300), 0.1, dtype=torch.float64)  # 0.1 has no exact mean
    assert_same_stream(host, stream, still)


@pytest.mark.parametrize("align", ALIGNMENTS)
@pytest.mark.parametrize("place", [0, 4, 5, 10, 11, 25, 50, 51, 99])
def test_a_hole_at_the_start_reaches_as_far_as_in_the_detector(align, place):
    for channel in (0, 3):
        host, stream = pair_of(align=align, hop=5)
        samples = signal(300, 3)
        samples[channel, place] = torch.nan
        assert_same_stream(host, stream, samples, [60, 140])


@pytest.mark.parametrize("rule", RULES)
def test_a_decision_that_nothing_reaches_says_nothing(rule):
    host, stream = pair_of(rule=rule)
    samples = torch.from_numpy(np.random.default_rng(0).standard_normal((4, 900)))
    samples[:, 400:410] = torch.nan
    expected = stream.push(samples.T)
    says_nothing = expected.llr == 0
    assert says_nothing.any()
    assert (expected.llr[~says_nothing] > 0).all()  # so the hole alone ends the run
    assert_same(host.push(samples.T.numpy()), expected)


def test_a_threshold_that_is_given_counts_for_that_push():
    host, own = pair_of(rule="k_of_n")[0], pair_of(rule="k_of_n")[0]
    samples = signal(1200, 8).T.numpy()
    for threshold in (0.3, 2.0, -np.inf, np.inf):
        at_it, _ = pair_of(rule="k_of_n")
        at_it.session = session_of("all", "centred", "k_of_n", "platt", 20, "float64", threshold)
        at_it.tail, at_it.state = host.tail, host.state
        expected, found = at_it.push(samples), host.push(samples, threshold)
        for name, value in expected.items():
            np.testing.assert_array_equal(found[name], value, err_msg=name)
    usual, found = own.push(samples), pair_of(rule="k_of_n")[0].push(samples, 1.0)
    np.testing.assert_array_equal(found["alarm"], usual["alarm"])


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("double", [True, False])
def test_what_is_kept_has_one_size_and_nothing_else_is(rule, double):
    settings, detector = settings_of(rule), loud_detector()
    timing = Timing.of(detector, settings)
    host, stream = pair_of(rule=rule, double=double)
    other, other_stream = pair_of(rule=rule, double=double)
    other.session = host.session
    samples, others = (signal(900, seed, stream.dtype) for seed in (1, 2))
    for start, stop in pairwise([0, 0, 1, 50, 124, 125, 126, 400, 400, 900]):
        for one, torch_one, given_samples in (
            (host, stream, samples),
            (other, other_stream, others),
        ):
            piece = given_samples[:, start:stop].T
            assert_same(one.push(piece.numpy()), torch_one.push(piece))
            assert one.tail.shape == (timing.tail, 4)
            assert one.state.shape == (timing.state_size,)
            assert one.tail.dtype == one.dtype
    np.testing.assert_array_equal(host.tail, samples[:, -timing.tail :].T.numpy())


@pytest.mark.parametrize("rule", RULES)
def test_a_stream_that_ran_for_years_goes_on(rule):
    young, _ = pair_of(rule=rule)
    samples = signal(2000, 5).T.numpy()
    young.push(samples[:700])
    old, _ = pair_of(rule=rule)
    num = 10**12  # decisions
    old.tail, old.state = young.tail, young.state.copy()
    old.state[[0, 1, 2]] += [num * 20, num, num]
    expected, found = young.push(samples[700:]), old.push(samples[700:])
    for name in ("score", "statistic", "valid", "alarm", "on"):
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    assert expected["alarm"].any()
    samples_by_then = np.rint(expected["time_s"] * RATE) + num * 20
    np.testing.assert_array_equal(found["time_s"], samples_by_then / RATE)


# With the detector's own judgement --------------------------------------------------------------


@pytest.mark.parametrize("kind", ["all", "PVDF"])
@pytest.mark.parametrize("align", ALIGNMENTS)
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_detector_that_judges_for_itself_raises_the_same_alarms(kind, align, precision):
    detector, dtype = detector_of(kind, align), getattr(torch, precision)
    samples = signal(2000, 5, dtype)
    samples[2, 1500] = torch.nan
    usual = score_stream(detector, samples[:, :1400], 20).score
    middle, spread = float(usual.median()), float(usual.std())
    calibration, rule = Platt(2 / spread, -2 * middle / spread), KOfN(1, 2)
    times = {"rearm_s": 0.02, "refractory_s": 0.05}
    settings = AlarmSettings(20, calibration, rule, 0.5, target_per_hour=1.0, **times)
    graph = stream_graph(detector, settings, Form(precision))
    session = onnxruntime.InferenceSession(graph.model({}).SerializeToString())
    host = Host(session, 4, np.dtype(precision))
    stream = StreamingDetector(detector, settings, dtype=dtype)
    alarms, close = 0, 1e-9 if precision == "float64" else 1e-3
    for piece in samples.T.split([1, 299, 700, 3, 997]):
        found, expected = host.push(piece.numpy()), stream.push(piece)
        for name, attribute in EXACT.items():
            wanted = getattr(expected, attribute).numpy()
            np.testing.assert_array_equal(found[name], wanted, err_msg=name)
        np.testing.assert_allclose(found["score"], expected.score, rtol=0, atol=close * spread)
        alarms += len(expected.alarms)
    assert alarms >= 3
    assert not expected.is_valid.all()
