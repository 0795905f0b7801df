"""The structure of a model: guards that onnxruntime keeps, operators, free axes, its size."""

import copy

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from tactslip_torch.graph.runs import runner, session_of
from tactslip_torch.graph.structure import (
    check_free_axes,
    check_guards,
    check_operators,
    guards_of,
    size_limit,
)
from tactslip_torch.graph.value import F32, F64
from tactslip_torch.graph.writer import Graph

pytestmark = pytest.mark.onnx


def guarded(eps=1e-12, double=True):
    """``log(max(x, 1e-30) + eps) / max(amax, 1)`` where x is positive, else 0."""
    graph = Graph()
    dtype = F64 if double else F32
    x = graph.input("samples", dtype, ("batch", 8))
    largest = x.amax(1, keepdim=True).clamp(min=1.0)
    y = (x.maximum(1e-30) + eps).log() / largest
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
    twice = x.maximum(1.0) + x.maximum(1.0)
    x.maximum(3.0)  # goes nowhere
    graph.output("score", twice, ("batch",))
    assert guards_of(graph.model({}).graph) == {("Max", (1.0,)): 1}


def test_guards_in_bodies_are_seen():
    graph = Graph()
    x = graph.input("samples", F64, ("batch",))
    is_large = x.amax(0) > 1.0
    (y,) = graph.if_(is_large, lambda g: [x.at(g).maximum(2.0)], lambda g: [x.at(g).minimum(3.0)])
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
    centred = x - x.mean(1, keepdim=True)
    two = graph.constant(2.0, F32)
    spread = (graph.op("Pow", centred, two).mean(1, keepdim=True) + 1e-5).sqrt()
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
    assert size_limit("float32", 0, blocks=9) == 700_000
    assert size_limit("float32", 0, blocks=16) == 1_200_000
    assert size_limit("float32", 0, bin_samples=64) == 700_000
    assert size_limit("float32", 0, bin_samples=200) == 2_800_000
