"""Values of an ONNX graph, and ordinary arithmetic on them.

A ``Value`` is the output of a node; operators and methods on it add nodes to its graph. Numbers
take the dtype of the value they meet, so nothing is widened or narrowed unasked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from onnx import helper

if TYPE_CHECKING:
    from tactslip_torch.graph.writer import Graph

F32, F64, I64, BOOL = (np.dtype(name) for name in ("float32", "float64", "int64", "bool"))


class Value:
    """What a node gives, and arithmetic on it.

    Args:
        graph: to which operators add their nodes.
        name: in the file.
        dtype: float32, float64, int64 or bool.
    """

    def __init__(self, graph: Graph, name: str, dtype: np.dtype[Any]) -> None:
        self.graph = graph
        self.name = name
        self.dtype = dtype

    def at(self, graph: Graph) -> Value:
        """The same value, used in a body."""
        return Value(graph, self.name, self.dtype)

    def __add__(self, other: Value | float) -> Value:
        return self._with("Add", other)

    def __sub__(self, other: Value | float) -> Value:
        return self._with("Sub", other)

    def __rsub__(self, other: float) -> Value:
        return self._operand(other) - self

    def __mul__(self, other: Value | float) -> Value:
        return self._with("Mul", other)

    def __rmul__(self, other: float) -> Value:
        return self * other

    def __truediv__(self, other: Value | float) -> Value:
        return self._with("Div", other)

    def __rtruediv__(self, other: float) -> Value:
        return self._operand(other) / self

    def __matmul__(self, other: Value | NDArray[Any]) -> Value:
        right = other if isinstance(other, Value) else self.graph.constant(other, self.dtype)
        return self.graph.op("MatMul", self, right)

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

    def equals(self, other: Value | float) -> Value:
        """Where both are the same, bool."""
        return self._with("Equal", other, BOOL)

    def min(self, other: Value | float) -> Value:
        """The smaller of two."""
        return self._with("Min", other)

    def max(self, other: Value | float) -> Value:
        """The larger of two."""
        return self._with("Max", other)

    def clip(self, low: float, high: float) -> Value:
        """Within bounds."""
        return self.graph.op("Clip", self, self._operand(low), self._operand(high))

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

    def sum(self, axis: int = -1, keep: bool = False) -> Value:
        """Sums along an axis."""
        return self._reduced("ReduceSum", axis, keep)

    def mean(self, axis: int = -1, keep: bool = False) -> Value:
        """Means along an axis."""
        return self._reduced("ReduceMean", axis, keep)

    def amax(self, axis: int = -1, keep: bool = False) -> Value:
        """Largest along an axis; in onnxruntime a NaN may be passed over."""
        return self._reduced("ReduceMax", axis, keep)

    def amin(self, axis: int = -1, keep: bool = False) -> Value:
        """Smallest along an axis; in onnxruntime a NaN may be passed over."""
        return self._reduced("ReduceMin", axis, keep)

    def cast(self, dtype: np.dtype[Any]) -> Value:
        """In another dtype; itself if it has it."""
        if dtype == self.dtype:
            return self
        to = helper.np_dtype_to_tensor_dtype(dtype)
        return self.graph.op("Cast", self, dtype=dtype, to=to)

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

    def expand(self, axis: int) -> Value:
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

    def is_finite(self) -> Value:
        """Neither NaN nor Inf, bool: a difference with itself is 0."""
        return (self - self).equals(0.0)

    def _operand(self, other: Value | float) -> Value:
        if not isinstance(other, Value):
            return self.graph.constant(other, self.dtype)
        if other.dtype != self.dtype:
            raise TypeError(f"{self.dtype} meets {other.dtype}; cast one of them")
        return other

    def _with(self, kind: str, other: Value | float, dtype: np.dtype[Any] | None = None) -> Value:
        return self.graph.op(kind, self, self._operand(other), dtype=dtype)

    def _reduced(self, kind: str, axis: int, keep: bool) -> Value:
        return self.graph.op(kind, self, self.graph.axes(axis), keepdims=int(keep))
