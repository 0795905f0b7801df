"""ONNX graphs, written node by node.

What is written is what the file holds: no tracer and no optimiser in between, which would delete
a guard. ``Value`` has the arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from tactslip_torch.graph.value import Nodes, Value

OPSET = 20
IR_VERSION = 10  # the oldest that has the opset; newer ones are refused by older runtimes
Shape = Sequence[int | str]


class Graph(Nodes):
    """Nodes, constants, inputs and outputs that become a model, or the body of an ``if_``.

    Args:
        parent: of a body: whose values it may use and whose names it avoids.
    """

    def __init__(self, parent: Graph | None = None) -> None:
        super().__init__(parent)
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def input(
        self,
        name: str,
        dtype: np.dtype[Any],
        shape: Shape,
        default: NDArray[Any] | None = None,
    ) -> Value:
        """An input; axes that are named may have any length. One with a default may be left out."""
        self._inputs.append(_info(name, dtype, shape))
        if default is not None:
            self._tensors.append(numpy_helper.from_array(default.astype(dtype), name))
        return Value(self, name, dtype)

    def output(self, name: str, value: Value, shape: Shape | None) -> None:
        """Hand a value out under a name; without a shape nothing is said of it."""
        named = self.op("Identity", value, name=name)
        self._outputs.append(_info(name, named.dtype, shape))

    def if_(
        self,
        condition: Value,
        then: Callable[[Graph], Sequence[Value]],
        otherwise: Callable[[Graph], Sequence[Value]],
    ) -> tuple[Value, ...]:
        """One of two ways to make values, of which only the one that is needed is run."""
        bodies, dtypes = [], list[np.dtype[Any]]()
        for make in (then, otherwise):
            body = Graph(self)
            values = [Value(body, value.name, value.dtype) for value in make(body)]
            body._hand_out(values, [None] * len(values))
            dtypes = [value.dtype for value in values]
            bodies.append(body.proto())
        branches = {"then_branch": bodies[0], "else_branch": bodies[1]}
        return self.ops("If", condition, dtypes=dtypes, **branches)

    def scan(
        self,
        body: Callable[[Graph, Sequence[Value], Sequence[Value]], tuple[list[Value], list[Value]]],
        state: Sequence[Value],
        rows: Sequence[Value],
        shapes: Sequence[Shape] | None = None,
    ) -> tuple[list[Value], list[Value]]:
        """Walk along the first axis of ``rows``: a state goes on, and results are put together.

        Args:
            body: of a graph, the state ``[]`` and an entry ``[]`` of each row makes the state after
                it and its results.
            state: before the first entry.
            rows: ``[k]`` each; onnxruntime refuses k = 0, so leave an empty walk out by ``if_``.
            shapes: of the parts of the state and of an entry of each row; by default scalars.

        Returns:
            The state after the last entry, and results ``[k]``.
        """
        inner = Graph(self)
        shapes = [()] * len((*state, *rows)) if shapes is None else shapes
        taken = [
            inner.input(self._name(), value.dtype, shape)
            for value, shape in zip((*state, *rows), shapes, strict=True)
        ]
        after, results = body(inner, taken[: len(state)], taken[len(state) :])
        inner._hand_out(after, shapes[: len(state)])
        inner._hand_out(results, [()] * len(results))
        dtypes = [value.dtype for value in (*after, *results)]
        made = self.ops(
            "Scan", *state, *rows, dtypes=dtypes, body=inner.proto(), num_scan_inputs=len(rows)
        )
        return list(made[: len(state)]), list(made[len(state) :])

    def proto(self) -> onnx.GraphProto:
        """The graph as it stands, without what no output needs."""
        needed = {output.name for output in self._outputs}
        nodes = list[onnx.NodeProto]()
        for node in reversed(self._nodes):
            if needed.intersection(node.output):
                needed.update(_read_by(node))
                nodes.insert(0, node)
        needed.update(given.name for given in self._inputs)  # those of inputs are their defaults
        tensors = [tensor for tensor in self._tensors if tensor.name in needed]
        return helper.make_graph(nodes, "tactslip_torch", self._inputs, self._outputs, tensors)

    def model(self, metadata: Mapping[str, str]) -> onnx.ModelProto:
        """The model, checked by onnx.

        Raises:
            onnx.checker.ValidationError: if the graph is not well formed.
        """
        model = helper.make_model(
            self.proto(),
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="tactslip_torch",
        )
        helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model)
        return model

    def _hand_out(self, values: Sequence[Value], shapes: Sequence[Shape | None]) -> None:
        """Make values the results of a body: as they are if it made them, once each."""
        made = {name for node in self._nodes for name in node.output}
        made -= {output.name for output in self._outputs}
        for value, shape in zip(values, shapes, strict=True):
            handed = value if value.name in made else self.op("Identity", value)
            made.discard(handed.name)
            self._outputs.append(_info(handed.name, handed.dtype, shape))


def _info(name: str, dtype: np.dtype[Any], shape: Shape | None) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(dtype), shape)


def _read_by(node: onnx.NodeProto) -> set[str]:
    """Names of the values that a node takes, in its bodies too."""
    names = set(node.input)
    for attribute in node.attribute:
        if attribute.type == onnx.AttributeProto.GRAPH:
            names.update(name for inner in attribute.g.node for name in _read_by(inner))
            names.update(output.name for output in attribute.g.output)
    return names
