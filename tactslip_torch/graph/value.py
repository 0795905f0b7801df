"""Values of an ONNX graph, and ordinary arithmetic on them.

A ``Value`` is the output of a node; operators and methods on it add nodes to its graph. They have
the names and the meaning that they have on a ``torch.Tensor``, and torch's own functions take
values too (``torch.where``), so ``features.descriptors`` and ``features.bank`` write graphs.
Numbers and tensors are constants, of the dtype of the value they meet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import ArrayLike, NDArray
from onnx import helper, numpy_helper

F32, F64, I64, BOOL = (np.dtype(name) for name in ("float32", "float64", "int64", "bool"))
END = int(np.iinfo(np.int64).max)
"""Of an axis, in a slice."""
_FEW = 64  # as many ones and zeros are not worth a node


class Nodes:
    """Nodes and constants; what reads on is a ``Graph``.

    Args:
        parent: of a body: whose values it may use and whose names it avoids.
    """

    def __init__(self, parent: Nodes | None = None) -> None:
        self._top: Nodes = self if parent is None else parent._top
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], Value] = {}
        self._tensors: list[onnx.TensorProto] = []
        self._count = 0

    def constant(self, value: ArrayLike, dtype: np.dtype[Any]) -> Value:
        """A tensor, kept once in its graph however often it is asked for.

        A body has its own: what is around a body is handed over to it anew at each run.
        """
        array = np.ascontiguousarray(np.asarray(value, dtype)).reshape(np.shape(value))
        key = (array.dtype.name, array.shape, array.tobytes())
        wide = np.ascontiguousarray(np.asarray(value, F64)).tobytes() if dtype == F32 else b""
        if (kept := self._constants.get((F64.name, array.shape, wide))) and array.size > _FEW:
            return self._constants.setdefault(key, kept.cast(dtype))  # one copy in the file
        if key not in self._constants:
            name = self._name("c")
            bits = array.astype(BOOL)
            is_mask = array.size > _FEW and array.dtype != BOOL and np.array_equal(bits, array)
            self._tensors.append(numpy_helper.from_array(bits if is_mask else array, name))
            kept = Value(self, name, BOOL if is_mask else dtype)
            self._constants[key] = kept.cast(dtype)  # which a runtime does once, at load
        return self._constants[key]

    def axes(self, *numbers: int) -> Value:
        """Axes, lengths or places, as operators take them."""
        return self.constant(list(numbers), I64)

    def op(
        self,
        kind: str,
        *inputs: Value | None,
        dtype: np.dtype[Any] | None = None,
        name: str | None = None,
        **attributes: Any,
    ) -> Value:
        """The only output of a node; its dtype is that of the first input if not said."""
        return self.ops(kind, *inputs, dtypes=(dtype,), names=(name,), **attributes)[0]

    def ops(
        self,
        kind: str,
        *inputs: Value | None,
        dtypes: Sequence[np.dtype[Any] | None],
        names: Sequence[str | None] | None = None,
        **attributes: Any,
    ) -> tuple[Value, ...]:
        """The outputs of a node that has as many as there are dtypes."""
        outputs = [given or self._name() for given in names or [None] * len(dtypes)]
        fed = [each.name if each is not None else "" for each in inputs]
        self._nodes.append(helper.make_node(kind, fed, outputs, **attributes))
        first = inputs[0].dtype if inputs and inputs[0] is not None else F64
        return tuple(
            Value(self, output, dtype or first)
            for output, dtype in zip(outputs, dtypes, strict=True)
        )

    def concat(self, *parts: Value, axis: int) -> Value:
        """Values one behind the other along an axis; one alone as it is."""
        return parts[0] if len(parts) == 1 else self.op("Concat", *parts, axis=axis)

    def where(self, mask: Value, yes: Value | float, no: Value | float) -> Value:
        """Values of ``yes`` where the mask holds and of ``no`` elsewhere; one must be a value."""
        like = yes if isinstance(yes, Value) else no
        if not isinstance(like, Value):
            raise TypeError("where needs a value on one side, got two numbers")
        sides = (like._operand(side) for side in (yes, no))
        return self.op("Where", mask, *sides, dtype=like.dtype)

    def _name(self, prefix: str = "v") -> str:
        self._top._count += 1
        return f"{prefix}{self._top._count}"


class Value:
    """What a node gives, and arithmetic on it.

    Args:
        graph: to which operators add their nodes.
        name: in the file.
        dtype: float32, float64, int64 or bool.
    """

    def __init__(self, graph: Nodes, name: str, dtype: np.dtype[Any]) -> None:
        self.graph = graph
        self.name = name
        self.dtype = dtype

    def at(self, graph: Nodes) -> Value:
        """The same value, used in a body."""
        return Value(graph, self.name, self.dtype)

    def __add__(self, other: Value | float) -> Value:
        return self._with("Add", other)

    def __sub__(self, other: Value | float) -> Value:
        return self._with("Sub", other)

    def __rsub__(self, other: float) -> Value:
        return self._operand(other) - self

    def __mul__(self, other: Value | float) -> Value:
        if _is_taken_for_one(other):
            return self * (other / 2) * 2.0
        return self._with("Mul", other)

    def __rmul__(self, other: float) -> Value:
        return self * other

    def __truediv__(self, other: Value | float) -> Value:
        if _is_taken_for_one(other):
            return self / (other * 2) * 2.0
        return self._with("Div", other)

    def __rtruediv__(self, other: float) -> Value:
        return self._operand(other) / self

    def __matmul__(self, other: Value | NDArray[Any]) -> Value:
        return self._with("MatMul", other)

    def __neg__(self) -> Value:
        return self.graph.op("Neg", self)

    def __invert__(self) -> Value:
        return self.graph.op("Not", self)

    def __and__(self, other: Value) -> Value:
        return self.graph.op("And", self, other)

    def __or__(self, other: Value) -> Value:
        return self.graph.op("Or", self, other)

    def __lt__(self, other: Value | float) -> Value:
        return self._with("Less", other, BOOL)

    def __le__(self, other: Value | float) -> Value:
        return self._with("LessOrEqual", other, BOOL)

    def __gt__(self, other: Value | float) -> Value:
        return self._with("Greater", other, BOOL)

    def __ge__(self, other: Value | float) -> Value:
        return self._with("GreaterOrEqual", other, BOOL)

    def eq(self, other: Value | float) -> Value:
        """Where both are the same, bool."""
        return self._with("Equal", other, BOOL)

    def minimum(self, other: Value | float) -> Value:
        """The smaller of two."""
        return self._with("Min", other)

    def maximum(self, other: Value | float) -> Value:
        """The larger of two."""
        return self._with("Max", other)

    def clamp(self, min: float | None = None, max: float | None = None) -> Value:
        """Within bounds."""
        if max is None:
            assert min is not None
            return self.maximum(min)
        low = None if min is None else self._operand(min)
        return self.graph.op("Clip", self, low, self._operand(max))

    def abs(self) -> Value:
        """Magnitudes."""
        return self.graph.op("Abs", self)

    def sqrt(self) -> Value:
        """Square roots."""
        return self.graph.op("Sqrt", self)

    def log(self) -> Value:
        """Natural logarithms."""
        return self.graph.op("Log", self)

    def exp(self) -> Value:
        """Exponentials."""
        return self.graph.op("Exp", self)

    def floor(self) -> Value:
        """Whole numbers below."""
        return self.graph.op("Floor", self)

    def sigmoid(self) -> Value:
        """Logistic function."""
        return self.graph.op("Sigmoid", self)

    def sum(self, axis: int = -1, keepdim: bool = False) -> Value:
        """Sums along an axis."""
        return self._reduced("ReduceSum", axis, keepdim)

    def mean(self, axis: int = -1, keepdim: bool = False) -> Value:
        """Means along an axis."""
        return self._reduced("ReduceMean", axis, keepdim)

    def amax(self, axis: int = -1, keepdim: bool = False) -> Value:
        """Largest along an axis; in onnxruntime a NaN may be passed over."""
        return self._reduced("ReduceMax", axis, keepdim)

    def amin(self, axis: int = -1, keepdim: bool = False) -> Value:
        """Smallest along an axis; in onnxruntime a NaN may be passed over."""
        return self._reduced("ReduceMin", axis, keepdim)

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

    def __getitem__(self, place: tuple[Any, slice | int | None]) -> Value:
        """Of the last axis (``x[..., place]``) a slice or an entry; or one more, of length 1."""
        _, key = place
        if key is None:
            return self.unsqueeze(-1)
        if isinstance(key, int):
            return self.slice(key, END if key == -1 else key + 1, -1).squeeze(-1)
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
        """Entries along an axis, at places that were computed."""
        return self.graph.op("GatherElements", self, index, axis=axis)

    def scatter_add(self, axis: int, index: Value, values: Value) -> Value:
        """With values added to the entries at these places."""
        return self.graph.op("ScatterElements", self, index, values, axis=axis, reduction="add")

    def ascending(self, count: int) -> Value:
        """The smallest entries along the last axis, in ascending order."""
        k = self.graph.axes(count)
        return self.graph.ops("TopK", self, k, dtypes=(None, I64), largest=0)[0]

    def entries_of(self, table: torch.Tensor) -> Value:
        """Of a constant table of float64, at the places that are these values."""
        return self.graph.op("Gather", self.graph.constant(table, F64), self)

    def filled(self, number: int) -> Value:
        """That number in the shape and dtype of these values."""
        like = numpy_helper.from_array(np.array([number], self.dtype))
        shape = self.graph.op("Shape", self, dtype=I64)
        return self.graph.op("ConstantOfShape", shape, dtype=self.dtype, value=like)

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
        """A stretch of an axis, by constants or by values ``[1]``."""
        ends = (self.graph.axes(x) if isinstance(x, int) else x for x in (start, stop))
        return self.graph.op("Slice", self, *ends, self.graph.axes(axis))

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

    def _operand(self, other: Value | ArrayLike) -> Value:
        if not isinstance(other, Value):
            return self.graph.constant(other, self.dtype)
        if other.dtype != self.dtype:
            raise TypeError(f"{self.dtype} meets {other.dtype}; cast one of them")
        return other

    def _with(
        self, kind: str, other: Value | ArrayLike, dtype: np.dtype[Any] | None = None
    ) -> Value:
        return self.graph.op(kind, self, self._operand(other), dtype=dtype)

    def _reduced(self, kind: str, axis: int, keepdim: bool) -> Value:
        return self.graph.op(kind, self, self.graph.axes(axis), keepdims=int(keepdim))


def _is_taken_for_one(number: Value | float) -> bool:
    """Whether onnxruntime, which looks at it in float32, would drop a factor of it as 1."""
    return isinstance(number, int | float) and number != 1 and np.float32(number) == 1


def _where(mask: Value, yes: Value | float, no: Value | float) -> Value:
    return mask.graph.where(mask, yes, no)


def _cat(values: Sequence[Value], dim: int) -> Value:
    return values[0].graph.concat(*values, axis=dim)


_FUNCTIONS: dict[Callable[..., Any], Callable[..., Value]] = {
    torch.where: _where,
    torch.cat: _cat,
    torch.minimum: Value.minimum,
    torch.maximum: Value.maximum,
    torch.zeros_like: lambda x: x.filled(0),
    torch.ones_like: lambda x: x.filled(1),
}
"""Functions of torch that take values, and what they do."""
