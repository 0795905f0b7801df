"""Values and graphs: arithmetic as NumPy's, run by onnxruntime."""

import operator

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from tactslip_torch.deploy.value import BOOL, F32, F64, Graph
from tactslip_torch.features.ops import ascending, counted, looked_up, root, taken

X = np.array([-2.5, -1.0, 0.0, 0.5, 1.0, 3.0])


def run(graph, **inputs):
    """What onnxruntime makes of a graph, with its usual optimisations."""
    content = graph.model().SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return dict(
        zip([out.name for out in session.get_outputs()], session.run(None, inputs), strict=True)
    )


def applied(function, *arrays, num_axes=1):
    """A function of values, run on arrays."""
    graph = Graph()
    values = [
        graph.input(f"x{i}", array.dtype, [None] * array.ndim) for i, array in enumerate(arrays)
    ]
    graph.output("y", function(*values), [None] * num_axes)
    return run(graph, **{f"x{i}": array for i, array in enumerate(arrays)})["y"]


# Arithmetic ------------------------------------------------------------------------------------


CUBE = np.random.default_rng(0).integers(-3, 4, (2, 3, 8)) / 4.0


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x.clamp(-0.5, 0.25),
        lambda x: x.clamp(min=0.25),
        lambda x: x.clamp(max=0.25),
        lambda x: torch.minimum(x, x * x),
        lambda x: torch.maximum(x, x * x),
        lambda x: torch.where(x > 0.0, x, -1.0),
        lambda x: torch.cat([x, x * 2.0], dim=-2),
        lambda x: x.abs().sqrt(),
        lambda x: (x.abs() + 1.0).log(),
        lambda x: x.exp().floor(),
        lambda x: x.sigmoid(),
        lambda x: x.eq(0.5),
        lambda x: (1.0 / x).isfinite(),
        lambda x: x.float() if isinstance(x, torch.Tensor) else x.to(torch.float32),
        lambda x: (x > 0.0).double(),
        lambda x: (x > 0.0).type_as(x),
        lambda x: x.detach().sum(0, keepdim=True),
        lambda x: x.mean(-1),
        lambda x: x.amax(-1),
        lambda x: x.amin(-1, keepdim=True),
        lambda x: x[..., 1:],
        lambda x: x[..., :-1],
        lambda x: x[..., 2],
        lambda x: x[..., -1],
        lambda x: x[..., None].squeeze(-1),
        lambda x: x.unsqueeze(0).squeeze(0),
        lambda x: x.flatten(-2),
        lambda x: (x > 0.0).long().cumsum(-1),
        lambda x: x.argmax(-1, keepdim=True),
        lambda x: x.gather(-1, x.argmax(-1, keepdim=True)),
        lambda x: counted((x * x).floor().long(), 4),
        lambda x: x @ torch.eye(8).double()[:, :3],
        lambda x: ascending(x, 8),
        lambda x: root(x * x),
        lambda x: taken(x, torch.tensor([4, 0, 2]), -1),
        lambda x: taken(x, torch.tensor([1, 2]), -2),
        lambda x: looked_up(torch.arange(9).double(), (x > 0.0).long()),
    ],
)
def test_values_mean_what_tensors_mean(function):
    expected = function(torch.from_numpy(CUBE)).numpy()
    found = applied(function, CUBE, num_axes=expected.ndim)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_what_values_do_not_know_is_refused():
    value = Graph().input("x", F64, (2, 2))
    with pytest.raises(TypeError, match="median of torch is not known to values of a graph"):
        torch.median(value)


@pytest.mark.parametrize("number", [1 + 1e-9, 1 - 1e-9, 1.0, 2.0])
@pytest.mark.parametrize("function", [operator.mul, operator.truediv], ids=["times", "over"])
def test_a_factor_next_to_one_is_not_dropped(function, number):
    # onnxruntime takes it for 1 where the node is neither the first nor the last
    x = np.abs(X)
    found = applied(lambda value: function(value.abs(), number).maximum(-1.0), x)
    np.testing.assert_allclose(found, function(x, number), rtol=1e-15)


@pytest.mark.parametrize("function", [operator.add, operator.le, operator.matmul])
def test_values_of_two_dtypes_do_not_meet(function):
    graph = Graph()
    x, y = graph.input("x", F32, (2, 2)), graph.input("y", F64, (2, 2))
    with pytest.raises(TypeError, match="float32 meets float64; cast one of them"):
        function(x, y)


def test_two_numbers_are_no_choice():
    graph = Graph()
    with pytest.raises(TypeError, match="two numbers"):
        graph.where(graph.input("x", BOOL, ("k",)), 1.0, 0.0)


# The file --------------------------------------------------------------------------------------


def test_a_graph_that_is_not_well_formed_is_refused():
    graph = Graph()
    graph.input("x", F64, ("n",))
    graph.output("y", Graph().input("elsewhere", F64, ("n",)), ("n",))
    with pytest.raises(onnx.checker.ValidationError, match="elsewhere"):
        graph.model()


# Bodies ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", [True, False])
def test_if_makes_values_one_way_or_the_other(wanted):
    graph = Graph()
    x, flag = graph.input("x", F64, ("k",)), graph.input("flag", BOOL, (1,))
    made = graph.if_(
        flag,
        lambda: [x + 1.0, x > 0.0],
        lambda: [x, graph.constant([True], BOOL)],  # made outside, or by no node
    )
    graph.output("y", made[0], ("k",))
    graph.output("z", made[1], ("m",))
    found = run(graph, x=X, flag=np.array([wanted]))
    np.testing.assert_array_equal(found["y"], X + 1 if wanted else X)
    np.testing.assert_array_equal(found["z"], X > 0 if wanted else [True])
