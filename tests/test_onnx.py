"""The graph of bins beside the pool and the detector it was made of, in torch and float64."""

import copy
import operator
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import onnxruntime
import pytest
import torch
from contract.names import STREAM_OUTPUTS
from extremes import slip_samples
from hypothesis import given
from hypothesis import strategies as st
from small_detector import HAND, alarming_detector, with_floors
from streams import detector_of, onset_of, signal
from test_detector import VARIANTS, noise, random_detector
from test_predictions import with_imputation

from tactslip_torch.deploy.bins import RawBin, Timing, bin_graph
from tactslip_torch.deploy.check import check_model, compare, runner, session_of
from tactslip_torch.deploy.stream import stream_graph
from tactslip_torch.deploy.value import F32, F64, Graph
from tactslip_torch.features.sensing import Sensing
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import KEY, AlarmSettings, score_stream
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.signals.filtering import ChannelFilter

pytestmark = pytest.mark.onnx
PRECISIONS = ("float32", "float64")
CLOSE = {"float32": 1e-4, "float64": 1e-9}  # of scores, in standard deviations
NAN, INF = float("nan"), float("inf")


def cut(detector, samples):
    """What of raw bins with the detector's full context the graph takes."""
    raw = RawBin.of(detector)
    start = detector.context_before - raw.before
    return samples[..., start : start + raw.length].contiguous()


def run_on(detector, precision, samples):
    """Outputs of onnxruntime for bins with full context."""
    feeds = {"samples": cut(detector, samples).to(getattr(torch, precision)).numpy()}
    return runner(session_of(bin_graph(detector, precision).model()))(feeds)


def assert_scores(detector, precision, samples):
    """Scores are those of torch in float64, flags those of torch in the graph's precision."""
    given = samples.to(getattr(torch, precision))
    expected = detector.predict_raw(given.double(), given=given.dtype)
    got = run_on(detector, precision, given)
    assert got["score"].dtype == precision
    spread = np.nanstd(expected.score)
    np.testing.assert_allclose(got["score"], expected.score, rtol=0, atol=CLOSE[precision] * spread)
    for found in (expected, detector.predict_raw(given)):
        np.testing.assert_array_equal(got["valid"], found.is_valid)
        np.testing.assert_array_equal(got["in_range"], found.in_range)
        np.testing.assert_array_equal(got["channels_lost"], found.channels_lost)
    return got


# Scores ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_head_and_scaler_comes_through(variant, precision):
    """Sensors that fail are replaced by imputation values."""
    detector, samples = random_detector(**VARIANTS[variant]), noise(36)
    values = torch.linspace(-0.9, 0.9, detector.head.num_features, dtype=torch.float64)
    of_signal = (detector.pool, detector.channel_filter, detector.selected, detector.scaler)
    detector = SlipDetector(*of_signal, detector.head, imputation=values)
    needed = detector.needed_index.tolist()
    for row, value in enumerate([NAN, INF, -INF] * 4):
        samples[row, needed[row % len(needed)], 30 + 7 * row] = value
    samples[20, needed[0]] = 1.0  # dead
    samples[21] = NAN
    got = assert_scores(detector, precision, samples)
    assert np.flatnonzero(~got["valid"]).tolist() == [21]
    assert np.flatnonzero(got["channels_lost"].any(-1)).tolist() == [*range(12), 20, 21]


# The file --------------------------------------------------------------------------------------

SLOW = {"DFT", "Conv", "AveragePool", "Einsum", "Det", "Unique", "Loop", "LayerNormalization"}
"""Slow or imprecise in onnxruntime, or missing there in float64."""


def operators(graph):
    for node in graph.node:
        yield node.op_type
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield from operators(attribute.g)


def loaded(model):
    """As a host loads a file that knows no options: onnxruntime says what it warns of."""
    return onnxruntime.InferenceSession(model.SerializeToString())


def test_a_file_has_operators_of_onnx_alone_and_one_input(capfd):
    model = bin_graph(with_imputation()).model()
    assert [each.domain for each in model.opset_import] == [""]
    assert not SLOW.intersection(operators(model.graph))
    session = loaded(model)
    assert not session.get_overridable_initializers()
    assert capfd.readouterr().err == ""  # no warning
    assert [each.name for each in session.get_inputs()] == ["samples"]
    assert session.get_inputs()[0].shape[0] == session.get_outputs()[0].shape[0] == "batch"


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


# The comparison at export ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def joint(detector):
    """With an alarm of fast evidence beside that of bins."""
    made, samples = copy.deepcopy(detector), slip_samples(HAND)
    onset = onset_of(torch.cat([samples] * 2, 1), quantile=0.999)
    settings = replace(AlarmSettings.of(detector), onset=replace(onset, threshold=1e9))
    made.info[KEY] = settings.to_dict()
    return made


def model_of(detector, kind, precision="float32"):
    if kind == "bin":
        return bin_graph(detector, precision).model()
    return stream_graph(detector, AlarmSettings.of(detector), precision).model()


def changed(name, by):
    return lambda samples, out: out | {name: by(out[name])}


def put(place, value):
    """Another value at one place."""

    def by(values):
        values = values.copy()
        values[place : place + 1] = value
        return values

    return by


def behind_nan(samples, out):
    """Other scores of whole bins in a batch with broken ones."""
    is_lost = ~np.isfinite(samples).all((1, 2))
    return out | {"score": np.where(is_lost | ~is_lost.any(), out["score"], 0.123)}


def without_on(samples, out):
    return {name: values for name, values in out.items() if name != "on"}


WRONG = [
    ("bin", lambda samples, out: {"scores": out["score"]}, r"channels_lost is missing, expected b"),
    ("bin", changed("score", lambda x: x[::-1]), "whole: score differs from torch by"),
    ("bin", changed("score", lambda x: x[:-1]), r"score is f\[127\], expected f\[128\]"),
    ("bin", changed("valid", put(3, False)), "differs from torch at 1 of 128, the first is num"),
    ("bin", changed("valid", np.ones_like), "losses: valid differs"),
    ("bin", changed("channels_lost", np.zeros_like), "losses: channels_lost differs"),
    ("bin", changed("in_range", np.zeros_like), "whole: in_range differs"),
    ("bin", changed("score", np.nan_to_num), "losses: score differs from torch by inf"),
    ("bin", behind_nan, "losses: score differs"),
    ("bin", changed("probability", lambda x: x + np.float32(1e-4)), "probability differs"),
    ("stream", without_on, "lacks on"),
    ("stream", changed("alarm", put(0, False)), "alarm differs from torch"),
    ("stream", changed("valid", np.ones_like), "losses: valid differs from torch"),
    ("stream", changed("channels_lost", np.zeros_like), "losses: channels_lost differs"),
    ("stream", changed("onset_s", lambda x: x - 0.01), "onset_s differs from torch by 1.0e-02"),
    ("stream", changed("score", lambda x: x * np.float32(1.01)), "score differs from torch"),
    ("joint", changed("onset_score", lambda x: x + 1e-8), "onset_score differs from torch by 1.0e"),
    ("joint", changed("by_onset", np.zeros_like), "losses: by_onset differs"),
]


@pytest.mark.parametrize(("kind", "change", "message"), WRONG, ids=[row[2] for row in WRONG])
def test_a_wrong_graph_is_refused(request, kind, change, message):
    made_of = request.getfixturevalue("joint" if kind == "joint" else "detector")
    graph = "bin" if kind == "bin" else "stream"
    run = runner(session_of(model_of(made_of, graph)))
    with pytest.raises(ValueError, match=message) as caught:
        compare(lambda given: change(given["samples"], run(given)), made_of, graph, "float32")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", ["bin", "stream"])
def test_a_model_of_other_imputation_values_is_refused_and_a_right_one_measured(
    detector, kind, precision
):
    other = copy.deepcopy(detector)
    other.imputation += 0.5
    worst = check_model(model_of(detector, kind, precision), detector, kind, precision)["worst_sd"]
    assert 0 <= worst < {"float32": 1e-3, "float64": 1e-9}[precision]
    with pytest.raises(ValueError, match=r"losses: .* differs from torch"):
        check_model(model_of(other, kind, precision), detector, kind, precision)


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("joint", {}),
        ("detector", {"rule": KOfN(2, 3)}),  # which knows nothing before the second decision
        ("detector", {"hop_samples": 70}),  # the last samples are of no whole hop
        ("detector", {"hop_samples": 3000}),  # longer than half of the recording
    ],
    ids=str,
)
def test_a_stream_graph_of_any_alarm_is_compared(request, kind, changes):
    other = copy.deepcopy(request.getfixturevalue(kind))
    other.info[KEY] = replace(AlarmSettings.of(other), **changes).to_dict()
    assert check_model(model_of(other, "stream"), other, "stream", "float32")["worst_sd"] < 1e-3


def test_a_model_that_cannot_be_run_is_told_in_one_line():
    graph = Graph()
    graph.output("score", graph.input("samples", F64, ("batch", 8)).sum(1), ("batch",))
    with pytest.raises(ValueError, match=r"cannot run it on samples \[3, 7\]: .*") as one:
        runner(session_of(graph.model()))({"samples": np.ones((3, 7))})
    assert "\n" not in str(one.value)
    broken = graph.model()
    broken.graph.node[0].input[0] = "nowhere"
    with pytest.raises(ValueError, match=r"onnxruntime cannot load it: .*nowhere"):
        session_of(broken)


# Streams ---------------------------------------------------------------------------------------

KINDS = ("all", "PVDF", "long")  # long: a frame that a causal bin does not hold
ALIGNMENTS = ("centred", "causal", "trailing")
RULES = {rule.name: rule for rule in (KOfN(2, 3), Cusum(0.5, 0.5, 2))}
ONSET = onset_of(signal(6000, 5))
STREAM_CLOSE = {"float64": 1e-9, "float32": 1e-3}  # of scores, in standard deviations


@cache
def watching(
    kind="all",
    align="centred",
    rule="k_of_n",
    hop=20,
    threshold=1.0,
    onset=None,
    floors=False,
    levels=False,
):
    """A detector, and settings by which about half of its decisions speak for slip."""
    detector = detector_of("all" if kind == "long" else kind, align)
    if kind == "long":
        detector.channel_filter = ChannelFilter([151, 51, 11, 3], align=align)
    if floors:
        with_floors(detector, int(detector.counted.sum()) - 1)
    scores = score_stream(detector, signal(900, 99), 20).score  # of no stream below
    middle, spread = float(scores.median()), float(scores.std())
    calibration = Platt(2 / spread, -2 * middle / spread)
    times = {"rearm_s": 0.02, "refractory_s": 0.05, "lead_s": 0.03}
    more = {"target_per_hour": 1.0, "slip_share": 0.3, "onset": onset, "hold_s": 0.05, **times}
    settings = AlarmSettings(hop, calibration, RULES[rule], threshold, **more)
    if levels:
        spans = 4.0 * score_stream(detector, signal(900, 99), 20).span
        settings = replace(settings, levels=Sensing.fit(spans, 1, 1))
    return detector, settings, spread


@cache
def graph_of(precision, **options):
    detector, settings, _ = watching(**options)
    return runner(session_of(stream_graph(detector, settings, precision).model()))


class Host:
    """What a program around the graph does: it keeps tail and state, and nothing else."""

    def __init__(self, precision="float64", **options):
        self.run, self.dtype = graph_of(precision, **options), np.dtype(precision)
        self.tail, self.state = np.zeros((0, 4), self.dtype), np.zeros(0)

    def push(self, samples):
        feeds = {"samples": np.ascontiguousarray(samples, self.dtype), "tail": self.tail}
        feeds |= {"state": self.state, "threshold": np.zeros(0)}
        found = self.run(feeds)
        self.tail, self.state = found.pop("next_tail"), found.pop("next_state")
        return found


def assert_same_stream(samples, cuts=(), precision="float64", **options):
    """Push pieces to both."""
    detector, settings, spread = watching(**options)
    dtype, host = getattr(torch, precision), Host(precision, **options)
    stream = StreamingDetector(detector, settings, dtype=dtype)
    timing, close = Timing.of(detector, settings), STREAM_CLOSE[precision]
    atol = {"score": close * spread, "probability": 9 * close, "statistic": 9 * close}
    atol |= {"onset_s": 1e-12, "onset_score": 1e-9}
    rtol = {"probability": close, "statistic": close, "onset_score": 1e-7}
    names = STREAM_OUTPUTS | {name: name for name in ("in_range", "channels_lost")}
    names |= {name: name for name in ("by_onset", "onset_score") if settings.onset}
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    for start, stop in pairwise(places):
        piece = samples[:, start:stop].T.to(dtype)
        expected, found = stream.push(piece), host.push(piece.numpy())
        for name, attribute in names.items():
            known = getattr(expected, attribute).numpy()
            bounds = {"rtol": rtol.get(name, 0), "atol": atol.get(name, 0)}
            np.testing.assert_allclose(found[name], known, **bounds, err_msg=name)
        assert {found[name].dtype for name in ("score", "probability")} == {host.dtype}
        assert (host.tail.shape, host.state.shape) == ((timing.tail, 4), (timing.state_size,))
        assert (host.tail.dtype, host.state.dtype) == (host.dtype, np.float64)


LOSSES = st.tuples(
    st.integers(0, 3999),  # begins
    st.sampled_from([1, 30, 160, 400]),  # samples; the hold is 100, a channel is stuck from 151 on
    st.sampled_from([(0,), (1, 2), (2,), (3,), (2, 3), (0, 1, 2, 3)]),
    st.sampled_from([NAN, INF, 0.25]),
)


def with_losses(samples, losses):
    samples = samples.clone()
    for start, num, channels, value in losses:
        samples[list(channels), start % samples.shape[1] :][:, :num] = value
    return samples


@given(
    num_samples=st.integers(0, 4000),
    cuts=st.lists(st.integers(0, 4000), max_size=30),
    kind=st.sampled_from(KINDS),
    align=st.sampled_from(ALIGNMENTS),
    rule=st.sampled_from(list(RULES)),
    hop=st.sampled_from([7, 20, 120]),
    floors=st.booleans(),
    levels=st.booleans(),
    onset=st.sampled_from([None, ONSET]),
    precision=st.sampled_from(list(STREAM_CLOSE)),
    losses=st.lists(LOSSES, max_size=4),
)
def test_any_cut_gives_what_the_detector_gives(
    num_samples, cuts, kind, align, rule, hop, floors, levels, onset, precision, losses
):
    samples = with_losses(signal(4000, 6), losses)[:, :num_samples]
    options = {"kind": kind, "align": align, "rule": rule, "hop": hop, "onset": onset}
    assert_same_stream(samples, cuts, precision, floors=floors, levels=levels, **options)


@pytest.mark.parametrize("onset", [None, ONSET])
@pytest.mark.parametrize("rule", RULES)
def test_a_stream_graph_is_loaded_without_a_warning(capfd, rule, onset):
    detector, settings, _ = watching(rule=rule, onset=onset, floors=True)
    assert loaded(stream_graph(detector, settings).model()).get_inputs()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("onset", [None, ONSET])
@pytest.mark.parametrize("rule", RULES)
def test_a_stream_that_ran_for_years_goes_on(rule, onset):
    young, old = Host(rule=rule, onset=onset), Host(rule=rule, onset=onset)
    samples = signal(3500, 5).T.numpy()
    young.push(samples[:700])
    num = 10**12  # decisions
    old.tail, old.state = young.tail, young.state.copy()
    old.state[[0, 1, 2]] += [num * 20, num, num]
    expected, found = young.push(samples[700:]), old.push(samples[700:])
    for name in ("score", "statistic", "valid", "alarm", "on"):
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    assert expected["alarm"].any()
    by_then = np.rint(expected["time_s"] * 2000.0) + num * 20
    np.testing.assert_array_equal(found["time_s"], by_then / 2000.0)


# Arithmetic ------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [1 + 1e-9, 1 - 1e-9, 1.0, 2.0])
@pytest.mark.parametrize("function", [operator.mul, operator.truediv], ids=["times", "over"])
def test_a_factor_next_to_one_is_not_dropped(function, number):
    # onnxruntime takes it for 1 where the node is neither the first nor the last
    x, graph = np.array([0.0, 0.5, 1.0, 3.0]), Graph()
    made = function(graph.input("x", F64, [None]).abs(), number).maximum(-1.0)
    graph.output("y", made, [None])
    content = graph.model().SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(session.run(None, {"x": x})[0], function(x, number), rtol=1e-15)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, y: torch.median(x), "median of torch is not known to values of a graph"),
        *((f, "float32 meets float64; cast") for f in (operator.add, operator.le, operator.matmul)),
    ],
)
def test_what_values_cannot_do_is_refused(function, message):
    graph = Graph()
    x, y = graph.input("x", F32, (2, 2)), graph.input("y", F64, (2, 2))
    with pytest.raises(TypeError, match=message):
        function(x, y)
