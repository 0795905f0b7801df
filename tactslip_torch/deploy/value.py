"""Graphs of ONNX, written node by node, and the values that nodes give.

A ``Value`` has the operators and methods of a ``torch.Tensor`` and takes part in torch's own
functions (``torch.where``), so the definitions in ``features`` write graphs. What is written is
what the file holds: no tracer and no optimiser stands in between, which could delete a guard.
Numbers and tensors are constants, of the dtype of the value that they meet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeGuard, Union

import numpy as np
import onnx
import torch
from numpy.typing import ArrayLike
from onnx import helper, numpy_helper
from torch import Tensor

F32, F64, I64, BOOL = (np.dtype(name) for name in ("float32", "float64", "int64", "bool"))
END = int(np.iinfo(np.int64).max)
"""The end of an axis, in a slice."""
OPSET = 20
IR_VERSION = 10  # the oldest that has the opset; newer ones are refused by older runtimes
Shape = Sequence[int | str]
Operand = Union["Value", Tensor, ArrayLike]
_FEW = 64  # numbers that are not worth a Cast


@dataclass
class _Body:
    """Nodes of a graph, or of a branch or loop in it."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    tensors: list[onnx.TensorProto] = field(default_factory=list)
    constants: dict[tuple[str, tuple[int, ...], bytes], Value] = field(default_factory=dict)
    inputs: list[onnx.ValueInfoProto] = field(default_factory=list)
    outputs: list[onnx.ValueInfoProto] = field(default_factory=list)

    def proto(self) -> onnx.GraphProto:
        """The body without what no output needs."""
        needed = {output.name for output in self.outputs}
        nodes = list[onnx.NodeProto]()
        for node in reversed(self.nodes):
            if needed.intersection(node.output):
                needed |= _read_by(node)
                nodes.insert(0, node)
        tensors = [tensor for tensor in self.tensors if tensor.name in needed]
        return helper.make_graph(nodes, "tactslip_torch", self.inputs, self.outputs, tensors)


class Graph:
    """A graph under construction; nodes are added by what is done with its values."""

    def __init__(self) -> None:
        self._bodies = [_Body()]
        self._count = 0

    def input(self, name: str, dtype: np.dtype[Any], shape: Shape) -> Value:
        """An input; axes that are named may have any length. None may be left out.

        One with a default could, but onnxruntime warns of it whenever such a file is loaded.
        """
        self._bodies[-1].inputs.append(_info(name, dtype, shape))
        return Value(self, name, dtype)

    def output(self, name: str, value: Value, shape: Shape | None) -> None:
        """Hand a value out under a name; without a shape any will do."""
        self._bodies[-1].nodes.append(helper.make_node("Identity", [value.name], [name]))
        self._bodies[-1].outputs.append(_info(name, value.dtype, shape))

    def constant(self, value: ArrayLike | Tensor, dtype: np.dtype[Any]) -> Value:
        """A tensor, kept once however often it is asked for.

        A table that is there in float64 already is cast to float32, which a runtime does once, when
        it loads the file. The body of a branch or loop has constants of its own: what is around it
        is handed over to it at each run.
        """
        body, array = self._bodies[-1], np.asarray(value, dtype)
        key = (array.dtype.name, array.shape, array.tobytes())
        if key not in body.constants:
            wide = (F64.name, array.shape, np.asarray(value, F64).tobytes())
            if dtype == F32 and array.size > _FEW and wide in body.constants:
                body.constants[key] = body.constants[wide].cast(dtype)
            else:
                body.constants[key] = Value(self, self._new_name(), dtype)
                tensor = numpy_helper.from_array(array, body.constants[key].name)
                body.tensors.append(tensor)
        return body.constants[key]

    def axes(self, *numbers: int) -> Value:
        """Axes, lengths or places, as operators take them."""
        return self.constant(list(numbers), I64)

    def op(
        self,
        kind: str,
        *inputs: Value | None,
        dtype: np.dtype[Any] | None = None,
        **attributes: Any,
    ) -> Value:
        """The only output of a node; its dtype is that of the first input by default."""
        return self.ops(kind, *inputs, dtypes=(dtype,), **attributes)[0]

    def ops(
        self,
        kind: str,
        *inputs: Value | None,
        dtypes: Sequence[np.dtype[Any] | None],
        **attributes: Any,
    ) -> list[Value]:
        """The outputs of a node that has as many as there are dtypes."""
        names = [self._new_name() for _ in dtypes]
        given = ["" if each is None else each.name for each in inputs]
        self._bodies[-1].nodes.append(helper.make_node(kind, given, names, **attributes))
        first = inputs[0].dtype if inputs and inputs[0] is not None else F64
        made = zip(names, dtypes, strict=True)
        return [Value(self, name, dtype or first) for name, dtype in made]

    def concat(self, *values: Value, axis: int) -> Value:
        """Values one behind the other along an axis; one alone as it is."""
        return values[0] if len(values) == 1 else self.op("Concat", *values, axis=axis)

    def where(self, mask: Value, yes: Value | float, no: Value | float) -> Value:
        """Values of ``yes`` where the mask holds and of ``no`` elsewhere; one must be a value."""
        like = yes if isinstance(yes, Value) else no
        if not isinstance(like, Value):
            raise TypeError("where needs a value on one side, got two numbers")
        return self.op("Where", mask, like.meet(yes), like.meet(no), dtype=like.dtype)

    def if_(
        self,
        condition: Value,
        then: Callable[[], Sequence[Value]],
        otherwise: Callable[[], Sequence[Value]],
    ) -> list[Value]:
        """One of two ways to make values, of which only the one that is needed is run."""
        branches = []
        for make in (then, otherwise):
            self._bodies.append(_Body())
            values = make()
            self._hand_out(values, [None] * len(values))
            branches.append(self._bodies.pop().proto())
        dtypes = [value.dtype for value in values]
        return self.ops(
            "If", condition, dtypes=dtypes, then_branch=branches[0], else_branch=branches[1]
        )

    def scan(
        self,
        step: Callable[[list[Value], list[Value]], tuple[Sequence[Value], Sequence[Value]]],
        state: Sequence[Value],
        rows: Sequence[Value],
        shape: Shape = (),
    ) -> tuple[list[Value], list[Value]]:
        """Walk along the first axis of ``rows``: a state goes on, and results are put together.

        Args:
            step: of the state and an entry of each row makes the next state and results.
            state: before the first entry.
            rows: ``[k, *shape]`` each; onnxruntime refuses k = 0, so leave an empty walk out by
                ``if_``.
            shape: of all that is walked.

        Returns:
            The state after the last entry, and results ``[k, *shape]``.
        """
        self._bodies.append(_Body())
        given = [self.input(self._new_name(), value.dtype, shape) for value in (*state, *rows)]
        after, results = step(given[: len(state)], given[len(state) :])
        self._hand_out([*after, *results], [shape] * (len(after) + len(results)))
        body = self._bodies.pop().proto()
        dtypes = [value.dtype for value in (*after, *results)]
        made = self.ops("Scan", *state, *rows, dtypes=dtypes, body=body, num_scan_inputs=len(rows))
        return made[: len(state)], made[len(state) :]

    def model(self) -> onnx.ModelProto:
        """The model, checked by onnx.

        Raises:
            onnx.checker.ValidationError: if the graph is not well formed.
        """
        model = helper.make_model(
            self._bodies[0].proto(),
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="tactslip_torch",
        )
        onnx.checker.check_model(model)
        return model

    def _hand_out(self, values: Sequence[Value], shapes: Sequence[Shape | None]) -> None:
        """Make values the results of a body, under names of its own."""
        for value, shape in zip(values, shapes, strict=True):
            self.output(self._new_name(), value, shape)

    def _new_name(self) -> str:
        self._count += 1
        return f"v{self._count}"


def _of_itself(kind: str) -> Callable[[Value], Value]:
    """A method that is an operator of one input."""
    return lambda value: value.graph.op(kind, value)


def _with_operand(
    kind: str, dtype: np.dtype[Any] | None = None
) -> Callable[[Value, Operand], Value]:
    """A method that is an operator of two inputs of one dtype; the output has it by default."""
    return lambda value, other: value.graph.op(kind, value, value.meet(other), dtype=dtype)


def _along_axis(kind: str) -> Callable[..., Value]:
    """A method that reduces an axis."""

    def reduced(value: Value, axis: int = -1, keepdim: bool = False) -> Value:
        return value.graph.op(kind, value, value.graph.axes(axis), keepdims=int(keepdim))

    return reduced


@dataclass(frozen=True, eq=False)
class Value:
    """What a node gives, an input, or a constant; its methods are those of a ``Tensor``.

    Args:
        graph: that it is of.
        name: in the file.
        dtype: float32, float64, int64 or bool.
    """

    graph: Graph
    name: str
    dtype: np.dtype[Any]

    __add__ = _with_operand("Add")
    __sub__ = _with_operand("Sub")
    __matmul__ = _with_operand("MatMul")
    __lt__ = _with_operand("Less", BOOL)
    __le__ = _with_operand("LessOrEqual", BOOL)
    __gt__ = _with_operand("Greater", BOOL)
    __ge__ = _with_operand("GreaterOrEqual", BOOL)
    eq = _with_operand("Equal", BOOL)
    minimum = _with_operand("Min")
    maximum = _with_operand("Max")

    __neg__ = _of_itself("Neg")
    __invert__ = _of_itself("Not")
    abs = _of_itself("Abs")
    sqrt = _of_itself("Sqrt")
    log = _of_itself("Log")
    exp = _of_itself("Exp")
    floor = _of_itself("Floor")
    sign = _of_itself("Sign")
    sigmoid = _of_itself("Sigmoid")

    sum = _along_axis("ReduceSum")
    mean = _along_axis("ReduceMean")
    amax = _along_axis("ReduceMax")  # in onnxruntime a NaN may be passed over
    amin = _along_axis("ReduceMin")  # likewise

    def __rsub__(self, other: Operand) -> Value:
        return self.meet(other) - self

    def __mul__(self, other: Operand) -> Value:
        if _is_taken_for_one(other):
            return self * (other / 2) * 2.0
        return self.graph.op("Mul", self, self.meet(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> Value:
        if _is_taken_for_one(other):
            return self / (other * 2) * 2.0
        return self.graph.op("Div", self, self.meet(other))

    def __rtruediv__(self, other: Operand) -> Value:
        return self.meet(other) / self

    def __and__(self, other: Value) -> Value:
        return self.graph.op("And", self, other)

    def __or__(self, other: Value) -> Value:
        return self.graph.op("Or", self, other)

    def clamp(self, min: float | None = None, max: float | None = None) -> Value:
        """Within bounds."""
        if max is None:
            assert min is not None
            return self.maximum(min)
        low = None if min is None else self.meet(min)
        return self.graph.op("Clip", self, low, self.meet(max))

    def all(self, axis: int) -> Value:
        """Whether a mask holds everywhere along an axis."""
        return self.cast(I64).amin(axis).cast(BOOL)

    def any(self, axis: int, keepdim: bool = False) -> Value:
        """Whether a mask holds somewhere along an axis."""
        return self.cast(I64).amax(axis, keepdim).cast(BOOL)

    def cast(self, dtype: np.dtype[Any]) -> Value:
        """In another dtype; itself if it has it."""
        if dtype == self.dtype:
            return self
        to = helper.np_dtype_to_tensor_dtype(dtype)
        return self.graph.op("Cast", self, dtype=dtype, to=to)

    def double(self) -> Value:
        """In float64."""
        return self.cast(F64)

    def long(self) -> Value:
        """In int64."""
        return self.cast(I64)

    def to(self, dtype: torch.dtype) -> Value:
        """In another dtype, by torch's name."""
        return self.cast(np.dtype(str(dtype).removeprefix("torch.")))

    def type_as(self, other: Value) -> Value:
        """In the dtype of another."""
        return self.cast(other.dtype)

    def detach(self) -> Value:
        """Itself: a graph has no gradients."""
        return self

    contiguous = detach

    def __getitem__(self, place: tuple[Any, slice | int | list[int] | None]) -> Value:
        """Of the last axis (``x[..., place]``) entries or one; or one more axis, of length 1."""
        _, key = place
        if key is None:
            return self.unsqueeze(-1)
        if isinstance(key, list):
            return self.take(key, -1)
        if isinstance(key, int):  # a scalar index takes its axis away
            return self.graph.op("Gather", self, self.graph.constant(key, I64), axis=-1)
        return self.slice(key.start or 0, END if key.stop is None else key.stop, -1)

    def flatten(self, start: int) -> Value:
        """Of three axes the last two as one."""
        if start != -2:
            raise TypeError(f"values are flattened from axis -2 on, got {start}")
        return self.reshape(0, -1)

    def cumsum(self, axis: int) -> Value:
        """Sums of all entries up to each."""
        return self.graph.op("CumSum", self, self.graph.constant(axis, I64))

    def argmax(self, axis: int, keepdim: bool = False) -> Value:
        """Place of the first of the largest."""
        return self.graph.op("ArgMax", self, dtype=I64, axis=axis, keepdims=int(keepdim))

    def gather(self, axis: int, index: Value) -> Value:
        """Entries along an axis, at places that were computed, as many axes as these have."""
        return self.graph.op("GatherElements", self, index, axis=axis)

    def counted(self, num: int) -> Value:
        """How often each of the numbers 0 to ``num - 1`` occurs along the last axis."""
        graph, shape = self.graph, self.graph.op("Shape", self)
        zero, one = (numpy_helper.from_array(np.array([number], self.dtype)) for number in (0, 1))
        rows = graph.concat(graph.op("Shape", self, end=-1), graph.axes(num), axis=0)
        none = graph.op("ConstantOfShape", rows, value=zero)
        ones = graph.op("ConstantOfShape", shape, value=one)
        return graph.op("ScatterElements", none, self, ones, axis=-1, reduction="add")

    def ascending(self, count: int) -> Value:
        """The smallest entries along the last axis, in ascending order."""
        return self.graph.ops("TopK", self, self.graph.axes(count), dtypes=(None, I64), largest=0)[
            0
        ]

    def ranked(self, first: int, count: int) -> Value:
        """The values at ``count`` places from ``first`` on, the largest first, along the last axis.

        Selected, then these few sorted, which takes half the time of sorting all.
        """
        kinds, num = (None, I64), self.graph.axes(first + count)
        low = self.graph.ops("TopK", self, num, dtypes=kinds, largest=0, sorted=0)[0]
        return self.graph.ops("TopK", low, self.graph.axes(count), dtypes=kinds)[0]

    def entries_of(self, table: ArrayLike | Tensor) -> Value:
        """Of a constant table of float64, at the places that are these values."""
        return self.graph.op("Gather", self.graph.constant(table, F64), self)

    @classmethod
    def __torch_function__(
        cls,
        function: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """What torch's own functions do with values."""
        if function not in _FUNCTIONS:
            raise TypeError(f"{function.__name__} of torch is not known to values of a graph")
        return _FUNCTIONS[function](*args, **(kwargs or {}))

    def take(self, places: Sequence[int], axis: int) -> Value:
        """Entries at constant places along an axis, in that order; a slice where that will do."""
        places = list(places)
        if places == list(range(places[0], places[-1] + 1)):
            return self.slice(places[0], places[-1] + 1, axis)
        return self.graph.op("Gather", self, self.graph.axes(*places), axis=axis)

    def slice(self, start: int | Value, stop: int | Value, axis: int) -> Value:
        """Consecutive entries of an axis, by constants or by values ``[1]``."""
        ends = (self.graph.axes(x) if isinstance(x, int) else x for x in (start, stop))
        return self.graph.op("Slice", self, *ends, self.graph.axes(axis))

    def split(self, sizes: Sequence[int], axis: int) -> list[Value]:
        """Parts of so many entries along an axis."""
        kinds = [self.dtype] * len(sizes)
        return self.graph.ops("Split", self, self.graph.axes(*sizes), dtypes=kinds, axis=axis)

    def unsqueeze(self, axis: int) -> Value:
        """With another axis of length 1."""
        return self.graph.op("Unsqueeze", self, self.graph.axes(axis))

    def squeeze(self, axis: int) -> Value:
        """Without an axis of length 1."""
        return self.graph.op("Squeeze", self, self.graph.axes(axis))

    def reshape(self, *lengths: int) -> Value:
        """In another shape; 0 keeps the length of that axis, an empty one too."""
        return self.graph.op("Reshape", self, self.graph.axes(*lengths))

    def transpose(self, *order: int) -> Value:
        """With its axes in another order."""
        return self.graph.op("Transpose", self, perm=list(order))

    def length(self, axis: int) -> Value:
        """Length of an axis, ``[1]``, int64."""
        return self.graph.op("Shape", self, dtype=I64, start=axis, end=axis + 1)

    def isfinite(self) -> Value:
        """Neither NaN nor Inf, bool: a difference with itself is 0."""
        return (self - self).eq(0.0)

    def meet(self, other: Operand) -> Value:
        """Another operand: a value of the same dtype, or a constant in it.

        Raises:
            TypeError: for a value of another dtype.
        """
        if not isinstance(other, Value):
            return self.graph.constant(other, self.dtype)
        if other.dtype != self.dtype:
            raise TypeError(f"{self.dtype} meets {other.dtype}; cast one of them")
        return other


_FUNCTIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    torch.where: lambda mask, yes, no: mask.graph.where(mask, yes, no),
    torch.cat: lambda values, dim: values[0].graph.concat(*values, axis=dim),
    torch.split: lambda value, sizes, dim: value.split(sizes, dim),
    torch.matmul: lambda matrix, value: value.graph.constant(matrix, value.dtype) @ value,
    torch.minimum: Value.minimum,
    torch.maximum: Value.maximum,
}
"""Functions of torch that take values, and what they do."""


def _is_taken_for_one(number: Operand) -> TypeGuard[float]:
    """Whether onnxruntime, which looks at it in float32, would drop a factor of it as 1."""
    return isinstance(number, int | float) and number != 1 and np.float32(number) == 1


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
