"""The graph of a stream against ``StreamingDetector``, push by push; rules, latch, calibration."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from engine_bins import some_hand
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from streams import detector_of, onset_of, signal

from tactslip_torch.deploy.bins import Timing
from tactslip_torch.deploy.check import runner, session_of
from tactslip_torch.deploy.stream import onset_memory, onset_scores, stream_graph
from tactslip_torch.deploy.value import F32, F64, I64, Graph
from tactslip_torch.model.calibration import LARGEST_LLR, Isotonic, Platt, probability
from tactslip_torch.onset.decisions import AlarmSettings, score_stream
from tactslip_torch.onset.evidence import OnsetStream
from tactslip_torch.onset.rules import Cusum, KOfN
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.signals.filtering import ChannelFilter

pytestmark = pytest.mark.onnx
KINDS = ("all", "PVDF", "long")  # long: a frame that a causal bin does not hold
ALIGNMENTS = ("centred", "causal", "trailing")
RULES = {rule.name: rule for rule in (KOfN(2, 3), Cusum(0.5, 0.5, 2))}
ONSET = onset_of(signal(6000, 5))
EXACT = {"valid": "is_valid", "alarm": "is_alarm", "on": "is_on", "time_s": "available_s"}
CLOSE = {"float64": 1e-9, "float32": 1e-3}  # of scores, in standard deviations


@cache
def watching(
    kind="all", align="centred", rule="k_of_n", hop=20, threshold=1.0, isotonic=False, onset=None
):
    """A detector, and settings by which about half of its decisions speak for slip."""
    detector = detector_of("all" if kind == "long" else kind, align)
    if kind == "long":
        detector.channel_filter = ChannelFilter([151, 51, 11, 3], align=align)
    scores = score_stream(detector, signal(900, 99), 20).score  # of no stream below
    middle, spread = float(scores.median()), float(scores.std())
    calibration = Platt(2 / spread, -2 * middle / spread)
    if isotonic:
        knots = tuple(middle + spread * x for x in (-2.0, -0.5, 0.0, 0.5, 1.0))
        calibration = Isotonic(knots, (-3.0, -2.0, -0.5, 1.0, 2.5))
    settings = AlarmSettings(
        hop,
        calibration,
        RULES[rule],
        threshold,
        target_per_hour=1.0,
        slip_share=0.3,
        rearm_s=0.02,
        refractory_s=0.05,
        lead_s=0.03,
        onset=onset,
    )
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

    def push(self, samples, threshold=()):
        found = self.run(
            {
                "samples": np.ascontiguousarray(samples, self.dtype),
                "tail": self.tail,
                "state": self.state,
                "threshold": np.array(threshold, np.float64),
            }
        )
        self.tail, self.state = found.pop("next_tail"), found.pop("next_state")
        return found


def assert_same_stream(samples, cuts=(), precision="float64", **options):
    """Push pieces to both; returns how many alarms there were."""
    detector, settings, spread = watching(**options)
    dtype, host = getattr(torch, precision), Host(precision, **options)
    stream = StreamingDetector(detector, settings, dtype=dtype)
    timing, num, close = Timing.of(detector, settings), 0, CLOSE[precision]
    raised = set[str]()
    places = [0, *sorted(min(cut, samples.shape[-1]) for cut in cuts), samples.shape[-1]]
    for start, stop in pairwise(places):
        piece = samples[:, start:stop].T.to(dtype)
        expected, found = stream.push(piece), host.push(piece.numpy())
        joined = {"by_onset": "by_onset"} if settings.onset else {}
        for name, attribute in (EXACT | joined).items():
            wanted = getattr(expected, attribute).numpy()
            np.testing.assert_array_equal(found[name], wanted, err_msg=name)
        np.testing.assert_allclose(found["onset_s"], expected.onset_s, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found["score"], expected.score, rtol=0, atol=close * spread)
        for name in ("probability", "statistic"):
            wanted = getattr(expected, name)
            np.testing.assert_allclose(found[name], wanted, rtol=close, atol=9 * close)
            assert found[name].dtype == host.dtype
        if settings.onset:
            np.testing.assert_allclose(found["onset_score"], expected.onset_score, atol=1e-9)
            assert found["onset_score"].dtype == np.float64
        assert (host.tail.shape, host.state.shape) == ((timing.tail, 4), (timing.state_size,))
        assert (host.tail.dtype, host.state.dtype) == (host.dtype, np.float64)
        num += len(expected.alarms)
        raised.update(alarm.raised_by for alarm in expected.alarms)
    if settings.onset and len(places) > 100:
        assert len(raised) == 2
    return num


@given(
    num_samples=st.integers(0, 900),
    cuts=st.lists(st.integers(0, 900), max_size=30),
    kind=st.sampled_from(KINDS),
    align=st.sampled_from(ALIGNMENTS),
    rule=st.sampled_from(list(RULES)),
    isotonic=st.booleans(),
    hop=st.sampled_from([7, 20, 120]),
    seed=st.integers(0, 20),
    bad=st.lists(st.tuples(st.integers(0, 899), st.sampled_from([np.nan, np.inf])), max_size=3),
)
def test_any_cut_gives_what_the_detector_gives(
    num_samples, cuts, kind, align, rule, isotonic, hop, seed, bad
):
    samples = signal(900, seed)
    for place, value in bad:
        samples[place % 4, place] = value
    options = {"kind": kind, "align": align, "rule": rule, "isotonic": isotonic, "hop": hop}
    assert_same_stream(samples[:, :num_samples], cuts, **options)


@given(
    num_samples=st.integers(0, 4000),
    cuts=st.lists(st.integers(0, 4000), max_size=30),
    kind=st.sampled_from(KINDS),
    rule=st.sampled_from(list(RULES)),
    hop=st.sampled_from([7, 20, 120]),
    precision=st.sampled_from(list(CLOSE)),
    bad=st.lists(st.tuples(st.integers(0, 3999), st.sampled_from([np.nan, np.inf])), max_size=2),
)
@settings(max_examples=20)
def test_fast_evidence_in_any_cut_is_that_of_the_detector(
    num_samples, cuts, kind, rule, hop, precision, bad
):
    samples = signal(4000, 6)
    for place, value in bad:
        samples[place % 4, place] = value
    options = {"kind": kind, "rule": rule, "hop": hop, "onset": ONSET}
    assert_same_stream(samples[:, :num_samples], cuts, precision, **options)


@pytest.mark.parametrize("kinds", ["F", "FF", "GF", "GGF"])
def test_onset_scores_of_any_hand_with_channels_missing(kinds):
    hand = some_hand(kinds)
    names = [{"G": 0, "F": 2}[kind] + i % 2 for i, kind in enumerate(kinds)]
    samples = signal(4000, 6)[names]
    samples[-1, 3500:] = samples[-1, 3500]  # stuck
    classifier = onset_of(samples[:, :3400], hand)
    for masked in ([False] * len(hand), [False, *[True] * (len(hand) - 1)]):
        graph = Graph()
        x, memory = graph.input("x", F64, ("n", len(hand))), graph.input("memory", F64, ("m",))
        places = graph.input("places", I64, ("k",))
        known = onset_memory(memory, 0, classifier.evidence)
        score, after = onset_scores(x, places, known, classifier)
        for name, value in zip("sm", (score, graph.concat(*after, axis=0)), strict=True):
            graph.output(name, value, ("j",))
        run, evidence = runner(session_of(graph.model())), classifier.evidence
        memory = np.empty(0)
        before = np.full((evidence.context, len(hand)), np.nan)
        held, found = np.concatenate([before, samples.T.numpy()]), []
        held[:, masked] = np.nan
        for start, stop in pairwise([0, 1, 2, 100, 350, 398, 400]):
            piece = held[10 * start : 10 * stop + evidence.context]
            made = run({"x": piece, "places": np.arange(stop - start), "memory": memory})
            found.append(made["s"])
            memory = made["m"]
        expected = OnsetStream(classifier).push(samples, torch.tensor(masked))
        np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("align", ALIGNMENTS)
def test_the_start_of_a_stream_is_filtered_as_a_recording(kind, align):
    samples = signal(300, 3) + torch.linspace(0, 5, 300, dtype=torch.float64)
    assert_same_stream(samples, [120, 180], kind=kind, align=align, hop=7)
    still = torch.full((4, 300), 0.1, dtype=torch.float64)  # 0.1 has no exact mean
    assert_same_stream(still, kind=kind, align=align, hop=7)


def test_a_threshold_that_is_given_counts_for_that_push():
    host, samples = Host(), signal(1200, 8).T.numpy()
    for threshold in (0.3, 2.0, -np.inf, np.inf):
        own = Host(threshold=threshold)
        own.tail, own.state = host.tail, host.state
        expected, found = own.push(samples), host.push(samples, [threshold])
        for name, value in expected.items():
            np.testing.assert_array_equal(found[name], value, err_msg=name)


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


# Calibration -----------------------------------------------------------------------------------

CALIBRATIONS = (
    Platt(2.0, -0.7),
    Platt(0.0, 0.3),
    Platt(1 + 1e-9, 0.0),
    Platt(1e12, -3.0),
    Isotonic((-1.0, -0.25, 0.0, 0.1, 3.0), (-4.0, -4.0, -0.5, 0.0, 5.0)),
    Isotonic((-1e300, 1e300), (-1e30, 1e30)),
    Isotonic((0.5,), (0.0,)),
)


def scores_of(dtype):
    """Any finite score, and often one of a few."""
    largest, width = float(np.finfo(dtype).max), dtype.itemsize * 8
    usual = st.floats(-4, 4, width=width) | st.sampled_from([0.0, -0.25, 0.1, 3.0])
    any_ = st.floats(-largest, largest, width=width, allow_nan=False)
    return arrays(dtype, st.integers(1, 30), elements=usual | any_)


@cache
def calibrating(calibration, dtype, slip_share):
    graph = Graph()
    llr = calibration.llr(graph.input("score", dtype, ("k",)))
    graph.output("llr", llr, ("k",))
    graph.output("probability", probability(llr, slip_share), ("k",))
    return runner(session_of(graph.model()))


@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
@pytest.mark.parametrize("calibration", CALIBRATIONS)
@settings(max_examples=12)
@given(data=st.data(), slip_share=st.sampled_from([0.5, 0.02]))
def test_scores_become_the_same_ratios_and_probabilities(calibration, dtype, data, slip_share):
    ends = np.array([np.finfo(dtype).min, np.finfo(dtype).max, 0.0], dtype)
    knots = np.array(getattr(calibration, "scores", ())).clip(*ends[:2]).astype(dtype)
    score = np.concatenate([data.draw(scores_of(dtype)), ends, knots])
    expected = calibration.llr(torch.from_numpy(score))
    found = calibrating(calibration, dtype, slip_share)({"score": score})
    assert found["llr"].dtype == found["probability"].dtype == dtype
    assert np.abs(found["llr"]).max() <= LARGEST_LLR
    tiny = 4 * np.finfo(dtype).eps
    largest = max(1.0, *map(abs, (*getattr(calibration, "llrs", ()), 0.0)))
    np.testing.assert_allclose(found["llr"], expected, rtol=tiny, atol=tiny * largest)
    close = 1e-12 if dtype == F64 else 2e-7
    stated = probability(expected, slip_share)
    np.testing.assert_allclose(found["probability"], stated, rtol=0, atol=close)


# Rules and latch -------------------------------------------------------------------------------
