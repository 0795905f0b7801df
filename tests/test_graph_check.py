"""The self-check of exported models: every kind of wrong model is refused."""

import copy
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from small_detector import HAND, small_detector
from torch.nn.functional import pad

from tactslip_torch.graph.bin_check import check_bins
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.runs import run_alone, runner, session_of
from tactslip_torch.graph.stream_check import (
    broken_stream,
    check_stream,
    cuts,
    memory_of,
    middle_threshold,
)
from tactslip_torch.graph.structure import (
    check_free_axes,
    check_guards,
    check_operators,
    guards_of,
    size_limit,
)
from tactslip_torch.graph.trials import KINDS, degenerate_bins, simulated_bins, simulated_stream
from tactslip_torch.graph.value import F32, F64
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.calibration import Platt, probability
from tactslip_torch.onset.scoring import score_stream
from tactslip_torch.onset.sequential import Cusum
from tactslip_torch.onset.settings import KEY, AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

pytestmark = pytest.mark.onnx

SINGLE = Form("float32")


def alarming():
    """The small detector, with settings by which the simulated slip raises alarms."""
    made = small_detector(engine="eager")
    scores = score_stream(made, simulated_stream(HAND, 2000.0, torch.float64), 20).score
    rise = 2.0 / float(scores.std())
    settings = AlarmSettings(
        20,
        Platt(rise, -rise * float(scores.mean())),
        Cusum(0.5, 0.4, 8.0),
        threshold=2.0,
        target_per_hour=1.0,
        rearm_s=0.03,
        refractory_s=0.1,
    )
    made.info[KEY] = settings.to_dict()
    return made


@pytest.fixture(scope="module")
def detector():
    return alarming()


# A bin graph that is torch, and what may be wrong with it -------------------------------------


def bin_run(detector, change=lambda samples, out: out):
    """What a right bin graph in float32 gives, changed; ``change`` sees the samples."""
    single = copy.deepcopy(detector).float()
    window, settings = Window.of(detector), AlarmSettings.of(detector)
    before = detector.context_before - window.before
    after = detector.context_after - window.after

    def run(inputs):
        samples = torch.from_numpy(inputs["samples"])
        with torch.no_grad():
            score, is_valid, _ = single.judge_raw(pad(samples, (before, after)))
        stated = probability(settings.calibration.llr(score), settings.slip_share)
        out = {"score": score.numpy(), "probability": stated.numpy(), "valid": is_valid.numpy()}
        return change(samples, out)

    return run


def test_a_right_bin_graph_passes_and_is_measured(detector):
    facts = check_bins(bin_run(detector), detector, SINGLE)
    assert facts["simulated"] is True
    assert facts["score_sd"] > 0
    assert (facts["noise"]["bins"], facts["recorded"]["bins"]) == (64, 256)
    for name in ("noise", "recorded"):
        assert 0 < facts[name]["worst_sd"] < 1e-3
    assert set(facts["degenerate"]) == set(KINDS)
    assert facts["degenerate"]["constant"]["valid"] == 0
    assert facts["degenerate"]["ramp"]["valid"] == facts["degenerate"]["ramp"]["bins"] == 16
    assert facts["degenerate"]["ramp"]["decided_by_rounding"] == 16  # of the sign of a mean of 0
    assert facts["degenerate"]["plain"]["decided_by_rounding"] == 0


def at(is_there, **values):
    """Other outputs on bins that a predicate ``[B]`` of their samples picks."""

    def change(samples, out):
        mask = is_there(samples).numpy()
        for name, value in values.items():
            column = out[name].copy()
            column[mask] = value
            out = out | {name: column}
        return out

    return change


def one_bin(samples):
    return torch.arange(len(samples)) == 3


def constant(samples):
    return (samples == samples[..., :1]).all(-1).all(-1)


def holds_nan(samples):
    return samples.isnan().any(-1).any(-1)


def behind_nan(samples):
    """Whole bins in one batch with broken ones."""
    return ~holds_nan(samples) & holds_nan(samples).any()


def huge(samples):
    return (samples.abs() > 1e20).any(-1).any(-1)


def renamed(samples, out):
    return {"scores" if name == "score" else name: value for name, value in out.items()}


def widened(samples, out):
    return out | {"score": out["score"].astype(np.float64)}


def frozen(samples, out):
    """One batch size, whatever came."""
    return {name: np.resize(value, 7) for name, value in out.items()}


def mixed_up(samples, out):
    return out | {"score": out["score"][::-1]}


WRONG_BINS = {
    "another name": (
        renamed,
        r"it gives .*scores float32\[256\].*, expected .*score float32\[256\]",
    ),
    "another dtype": (widened, r"it gives .*score float64.*, expected .*score float32"),
    "frozen batch": (frozen, r"it gives .*\[7\].*, expected .*\[256\]"),
    "rows mixed up": (mixed_up, "scores differ from torch in float64"),
    "one score off": (at(one_bin, score=0.123), "scores differ from torch in float64"),
    "one flag wrong": (at(one_bin, valid=False), "valid differs from torch on 1 of 256 bins"),
    "one probability": (at(one_bin, probability=2.0), "probability is .* off that of its score"),
    "trusts the dead": (at(constant, valid=True), r"\(constant\): valid differs from torch on 16"),
    "nan of constants": (at(constant, score=np.nan), r"\(constant\): 16 scores are not finite"),
    "nan of nan": (at(holds_nan, score=np.nan), r"\(nan\): 16 scores are not finite"),
    "trusts the torn": (at(holds_nan, valid=True), r"\(nan\): valid differs"),
    "overflows": (at(huge, score=np.inf), r"\(huge\): 16 scores are not finite"),
    "one breaks others": (at(behind_nan, score=0.123), "simulated bins behind degenerate ones"),
}


@pytest.mark.parametrize("name", WRONG_BINS)
def test_a_wrong_bin_graph_is_refused(detector, name):
    change, message = WRONG_BINS[name]
    with pytest.raises(ValueError, match=message) as caught:
        check_bins(bin_run(detector, change), detector, SINGLE)
    assert "\n" not in str(caught.value)


def test_what_float32_may_float64_may_not(detector):
    def in_double(inputs):
        out = bin_run(detector)({"samples": inputs["samples"].astype(np.float32)})
        return {name: x.astype(np.float64) if x.dtype != bool else x for name, x in out.items()}

    with pytest.raises(ValueError, match="more than 1e-09"):
        check_bins(in_double, detector, Form("float64"))


def test_a_probability_comes_only_of_a_calibration(detector):
    plain = small_detector(engine="eager")
    with pytest.raises(ValueError, match="it gives probability"):
        check_bins(bin_run(detector), plain, SINGLE)

    def bare(samples, out):
        return {name: out[name] for name in ("score", "valid")}

    check_bins(bin_run(detector, bare), plain, SINGLE)
    with pytest.raises(ValueError, match="expected probability"):
        check_bins(bin_run(detector, bare), detector, SINGLE)


# A stream graph that is torch, and what may be wrong with it ----------------------------------


class StreamRun:
    """A right stream graph: its memory hides in a ``StreamingDetector``, the state is a counter."""

    def __init__(self, detector, change=lambda out: out, remembers=True):
        self.detector, self.change, self.remembers = detector, change, remembers

    def __call__(self, inputs):
        samples = inputs["samples"]
        if not len(inputs["state"]) or not self.remembers:
            settings = AlarmSettings.of(self.detector)
            if len(inputs["threshold"]):
                settings = replace(settings, threshold=float(inputs["threshold"][0]))
            self.stream = StreamingDetector(self.detector, settings)
        made = self.stream.push(samples)
        out = {
            "score": made.score,
            "probability": made.probability,
            "statistic": made.statistic,
            "valid": made.is_valid,
            "alarm": made.is_alarm,
            "on": made.is_on,
            "time_s": made.available_s,
            "onset_s": made.onset_s,
        }
        out = {name: column.numpy() for name, column in out.items()}
        out |= {"next_tail": np.zeros((110, 4), np.float32), "next_state": np.zeros(7)}
        return self.change(out)


def test_a_right_stream_graph_passes_and_is_measured(detector):
    run = StreamRun(detector)
    memory = memory_of(run, 4, SINGLE)
    assert memory == (110, 7)
    facts = check_stream(run, detector, SINGLE, memory)
    assert facts["simulated"] is True
    assert facts["decisions"] > 100
    assert facts["alarms"] > 0
    assert facts["alarms_at_another_threshold"] > 0
    assert 0 < facts["worst_sd"] < 1e-3
    assert 0 < facts["broken"]["not_valid"] < facts["decisions"]


def changed(name, by):
    """A column that is changed where it has entries."""
    return lambda out: out | {name: by(out[name])}


def never_early(alarms):
    """No alarm by the first decision of a push: one that forgets its latch."""
    return np.where(np.arange(len(alarms)) == 0, False, alarms)


def growing(out):
    return out | {"next_tail": np.zeros((110 + len(out["score"]), 4), np.float32)}


WRONG_STREAMS = {
    "no column": (lambda out: {n: x for n, x in out.items() if n != "on"}, "outputs .*: on"),
    "grows": (growing, "hands on .* samples .*, expected 110 and 7 always"),
    "drops an alarm": (changed("alarm", never_early), "alarm differs from torch at .*, the first"),
    "always on": (changed("on", np.ones_like), "on differs from torch"),
    "trusts all": (changed("valid", np.ones_like), "broken sensors: valid differs from torch"),
    "late": (changed("time_s", lambda x: x + 5e-4), "time_s differs from torch by 5.0e-04 s"),
    "onset": (changed("onset_s", lambda x: x - 0.01), "onset_s differs from torch by 1.0e-02 s"),
    "score": (changed("score", lambda x: x * np.float32(1.01)), "score differs from torch"),
    "statistic": (changed("statistic", lambda x: x * np.float32(1.01)), "statistic differs"),
    "probability": (changed("probability", lambda x: x / 2), "probability differs"),
    "wide score": (changed("score", np.float64), r"score is float64.*expected float32"),
    "one too few": (changed("on", lambda x: x[:-1]), r"on is bool\[\d+\], expected bool\[\d+\]"),
}


@pytest.mark.parametrize("name", WRONG_STREAMS)
def test_a_wrong_stream_graph_is_refused(detector, name):
    change, message = WRONG_STREAMS[name]
    run = StreamRun(detector, change)
    with pytest.raises(ValueError, match=message) as caught:
        check_stream(run, detector, SINGLE, (110, 7))
    assert "\n" not in str(caught.value)


def test_a_stream_that_forgets_between_pushes_is_refused(detector):
    run = StreamRun(detector, remembers=False)
    with pytest.raises(ValueError, match=r"cut by hop: \w+ is \w+\[0\], expected"):
        check_stream(run, detector, SINGLE, (110, 7))


def test_a_threshold_that_is_not_listened_to_is_refused(detector):
    right = StreamRun(detector)

    def deaf(inputs):
        return right(inputs | {"threshold": np.empty(0)})

    with pytest.raises(ValueError, match="another threshold: alarm differs"):
        check_stream(deaf, detector, SINGLE, (110, 7))


def test_memory_of_another_shape_is_refused(detector):
    flat = StreamRun(detector, changed("next_tail", np.ravel))
    with pytest.raises(ValueError, match=r"next_tail is float32\[440\], expected \[R, 4\]"):
        memory_of(flat, 4, SINGLE)
    single = StreamRun(detector, changed("next_state", np.float32))
    with pytest.raises(ValueError, match=r"next_state is float32\[7\], expected float64 \[S\]"):
        memory_of(single, 4, SINGLE)


@pytest.mark.parametrize("num", [0, 1, 299, 300, 301, 2999, 3000])
def test_every_cut_is_of_the_whole_stream(num):
    for name, sizes in cuts(num, 20).items():
        assert sum(sizes) == num, name
        assert min(sizes, default=0) >= 0, name
    if num > 300:
        ways = cuts(num, 20)
        assert 0 in ways["anyhow"]
        assert ways["by sample"][:300] == [1] * 300


def test_a_middle_threshold_is_crossed_with_room():
    statistic = np.array([0, 0, 0, 0, 1, 2, 3, 6, 7, 8, 9.0, 9.5])
    assert middle_threshold(statistic) == 4.5
    assert middle_threshold(np.zeros(5)) == 0.0


def test_a_broken_stream_is_broken_where_it_is_looked_at(rng):
    samples = torch.from_numpy(rng.standard_normal((600, 4)))
    broken = broken_stream(samples, [1, 3])
    assert broken[100:200, 1].unique().numel() == 1
    assert broken[300:400, 3].isinf().all()
    assert broken[500:530].isnan().all()
    same = torch.ones(600, 4, dtype=torch.bool)
    same[100:200, 1] = same[300:400, 3] = same[500:530] = False
    assert torch.equal(broken[same], samples[same])


# What it is tried on --------------------------------------------------------------------------


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
    bins = simulated_bins(HAND, 2000.0, 56, 110, torch.float64)
    assert torch.equal(bins[0], stream[:, :110])
    assert torch.equal(bins[-1], stream[:, -110:])


# Structure ------------------------------------------------------------------------------------


def guarded(eps=1e-12, double=True):
    """``log(max(x, 1e-30) + eps) / max(amax, 1)`` where x is positive, else 0."""
    graph = Graph()
    dtype = F64 if double else F32
    x = graph.input("samples", dtype, ("batch", 8))
    largest = x.amax(1, keep=True).max(1.0)
    y = (x.max(1e-30) + eps).log() / largest
    graph.output("score", graph.where(x > 0.0, y, 0.0).sum(), ("batch",))
    return graph.model({})


def test_guards_are_counted_once_however_often_they_are_written():
    assert guards_of(guarded().graph) == {
        ("Max", (1.0,)): 1,
        ("Max", (1e-30,)): 1,
        ("Add", (1e-12,)): 1,
        ("Greater", (0.0,)): 1,
        ("Where", (0.0,)): 1,
    }
    graph = Graph()
    x = graph.input("samples", F64, ("batch",))
    twice = x.max(1.0) + x.max(1.0)
    x.max(3.0)  # goes nowhere
    graph.output("score", twice, ("batch",))
    assert guards_of(graph.model({}).graph) == {("Max", (1.0,)): 1}


def test_guards_in_bodies_are_seen():
    graph = Graph()
    x = graph.input("samples", F64, ("batch",))
    is_large = x.amax(0) > 1.0
    (y,) = graph.if_(is_large, lambda g: [x.at(g).max(2.0)], lambda g: [x.at(g).min(3.0)])
    graph.output("score", y, ("batch",))
    assert guards_of(graph.model({}).graph) == {
        ("Greater", (1.0,)): 1,
        ("Max", (2.0,)): 1,
        ("Min", (3.0,)): 1,
    }


@pytest.mark.parametrize("eps", [1e-8, 1e-30])
@pytest.mark.parametrize("double", [True, False])
def test_onnxruntime_keeps_guards(eps, double):
    assert check_guards(guarded(eps, double)) == 5


def test_a_sum_with_what_float32_does_not_hold_is_seen_to_go():
    """onnxruntime 1.31 takes 1e-50 in float64 for 0, and the addition out."""
    graph = Graph()
    x = graph.input("samples", F64, ("batch",))
    graph.output("score", (x + 1e-50).log(), ("batch",))
    model = graph.model({})
    score = runner(session_of(model))({"samples": np.zeros(1)})["score"]
    if np.isfinite(score).all():
        assert check_guards(model) == 1
    else:
        with pytest.raises(ValueError, match="drops a guard: 1 x Add with 1e-50"):
            check_guards(model)


@pytest.mark.parametrize("kind", ["Max", "Add", "Where", "Greater"])
def test_a_guard_that_is_dropped_is_seen(kind):
    """As optimisers drop them: what came in goes on in its place."""
    model = guarded()
    run = copy.deepcopy(model)
    node = next(node for node in run.graph.node if node.op_type == kind)
    first = node.input[1] if kind == "Where" else node.input[0]
    node.CopyFrom(helper.make_node("Identity", [first], node.output))
    with pytest.raises(ValueError, match=f"drops a guard: 1 x ({kind}|Greater)"):
        check_guards(model, run)


def test_a_guard_of_another_size_is_seen():
    run = guarded(eps=1e-6)
    with pytest.raises(ValueError, match="drops a guard: 1 x Add with 1e-12"):
        check_guards(guarded(), run)


def one_node(kind, shape=("batch", 4, 8), domain="", **attributes):
    x = helper.make_tensor_value_info("samples", TensorProto.FLOAT, shape)
    y = helper.make_tensor_value_info("score", TensorProto.FLOAT, None)
    weight = numpy_helper.from_array(np.ones((4, 4, 1), np.float32), "w")
    node = helper.make_node(kind, ["samples", "w"], ["score"], domain=domain, **attributes)
    graph = helper.make_graph([node], "g", [x], [y], [weight])
    opsets = [helper.make_opsetid("", 20)] + [helper.make_opsetid(domain, 1)] * bool(domain)
    return helper.make_model(graph, opset_imports=opsets, ir_version=10)


def test_operators_that_are_slow_or_foreign_are_refused():
    check_operators(guarded())
    with pytest.raises(ValueError, match="it has the operators Conv, which none"):
        check_operators(one_node("Conv"))
    with pytest.raises(ValueError, match=r"it has operators of com\.microsoft"):
        check_operators(one_node("FusedMatMul", domain="com.microsoft"))


def test_a_forbidden_operator_in_a_body_is_seen():
    graph = Graph()
    x = graph.input("samples", F64, (2, 2))
    (y,) = graph.if_(
        (x.amax(0).amax(0) > 1.0),
        lambda g: [g.op("Det", x.at(g))],
        lambda g: [x.at(g).amax(0).amax(0)],
    )
    graph.output("score", y, ())
    with pytest.raises(ValueError, match="it has the operators Det"):
        check_operators(graph.model({}))


def test_what_onnxruntime_fuses_to_a_forbidden_operator_is_seen():
    """A deviation with an epsilon under the root becomes a LayerNormalization."""
    graph = Graph()
    x = graph.input("samples", F32, ("batch", 8))
    centred = x - x.mean(1, keep=True)
    two = graph.constant(2.0, F32)
    spread = (graph.op("Pow", centred, two).mean(1, keep=True) + 1e-5).sqrt()
    weight, bias = (graph.constant(np.full(8, v), F32) for v in (2.0, 1.0))
    graph.output("score", centred / spread * weight + bias, ("batch", 8))
    with pytest.raises(ValueError, match="onnxruntime makes LayerNormalization of it"):
        check_guards(graph.model({}))


def test_an_axis_that_is_not_free_is_refused():
    check_free_axes(one_node("MatMul"), {"samples": 0})
    with pytest.raises(ValueError, match="axis 0 of samples is 7 for ever"):
        check_free_axes(one_node("MatMul", (7, 4, 8)), {"samples": 0})


def test_a_file_of_a_usual_head_has_700_kb():
    assert size_limit("float32", 120 * 120) == 700_000
    assert size_limit("float64", 120 * 120) == 1_400_000
    assert size_limit("float32", 1_025_000) == 4_700_000
    assert size_limit("float32", 0, frames=2) == 1_400_000
    assert size_limit("float32", 0, shares=1) == 700_000
    assert size_limit("float64", 0, shares=3) == 1_700_000


# Running --------------------------------------------------------------------------------------


def test_a_model_that_cannot_be_run_is_told_in_one_line(tmp_path):
    run = runner(session_of(guarded()))
    assert run({"samples": np.full((3, 8), np.e)})["score"] == pytest.approx(8 / np.e * np.ones(3))
    with pytest.raises(ValueError, match=r"cannot run it on samples \[3, 7\]: .*dimensions") as one:
        run({"samples": np.ones((3, 7))})
    assert "\n" not in str(one.value)
    broken = guarded()
    broken.graph.node[0].input[0] = "nowhere"
    with pytest.raises(ValueError, match=r"onnxruntime cannot load it: .*nowhere"):
        session_of(broken)


def test_a_fresh_process_runs_a_file_or_says_why_not(tmp_path):
    path = tmp_path / "model.onnx"
    onnx.save(guarded(), path)
    inputs = {"samples": np.exp(np.arange(16.0).reshape(2, 8))}
    alone, here = run_alone(path, inputs), runner(session_of(guarded()))(inputs)
    assert alone.keys() == here.keys() == {"score"}
    assert np.array_equal(alone["score"], here["score"])
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"a fresh process cannot run it: .*model\.onnx"):
        run_alone(path, inputs)
