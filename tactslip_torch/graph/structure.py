"""What a model is made of: its operators, its free axes, its size, and whether it keeps its guards.

A guard (a largest or smallest, a bound, a choice, a tiny term against division by zero) changes
nothing on ordinary samples. So an optimiser that drops one is not noticed by scores; it is looked
for here, in the graph as onnxruntime runs it.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
from onnx import numpy_helper

FORBIDDEN = frozenset(
    {
        # slow or imprecise in onnxruntime, or missing there in float64
        *("DFT", "STFT", "MelWeightMatrix", "Conv", "ConvTranspose", "AveragePool", "Einsum"),
        # linear algebra, orders that nobody asked for, loops without end
        *("Det", "Unique", "Loop"),
        # what a deviation is fused to, with an epsilon of its own
        *("LayerNormalization", "SimplifiedLayerNormalization", "InstanceNormalization"),
    }
)
"""Operators that no model may have, neither as written nor as run."""

_CHOICES = {"Where", "Clip", "Max", "Min", "Equal", "Less", "LessOrEqual", "Not"}
_CHOICES |= {"Greater", "GreaterOrEqual", "And", "Or", "IsNaN", "IsInf"}
_COMMUTE = {"Max", "Min", "Equal", "And", "Or", "Add", "Mul"}
_TINY = 1e-3  # an added term, or a factor's distance from 1, below which it guards

Guard = tuple[str, tuple[float, ...]]
"""An operator, and the numbers that it is given as constants."""


def size_limit(
    precision: str,
    head_numbers: int,
    frames: int = 1,
    shares: int = 0,
    blocks: int = 0,
    bin_samples: int = 100,
    missing_numbers: int = 0,
) -> int:
    """Bytes that a file may have: 700 kB in float32 where films alone are in use, or gauges alone.

    As much again for each further length of filter, as branches and spectra are fused with it; for
    each film but one of whose energy the detector wants shares, 75 kB; for the numbers of a head
    beyond the first 25 000, their own. Where one film has to give all, its branches and spectra
    take up to 75 kB each. All but the head grows with the square of the bin's length beyond the
    paper's. Twice that in float64.

    Args:
        precision: of the graph.
        head_numbers: that the head is made of.
        frames: different lengths of filter among the channels in use.
        shares: films of whose energy shares are wanted.
        blocks: different branches, and spectra of branches, in use.
        bin_samples: length of a bin.
        missing_numbers: in float64, of what is known where channels are missing; their own bytes.
    """
    head = 4 * max(0, head_numbers - 25_000) + 8 * missing_numbers
    growth = max(1.0, (bin_samples / 100) ** 2)
    front = max(700_000, 75_000 * blocks) * frames + 75_000 * max(0, shares - 1)
    single = round(growth * front) + head
    return single if precision == "float32" else 2 * single


def check_operators(model: onnx.ModelProto) -> None:
    """Refuse operators that are slow, missing, not of ONNX itself, or kept elsewhere.

    Raises:
        ValueError: naming them.
    """
    nodes = list(_all_nodes(model.graph))
    if found := sorted({node.op_type for node in nodes} & FORBIDDEN):
        raise ValueError(f"it has the operators {', '.join(found)}, which none of ours may have")
    domains = {node.domain for node in nodes} | {entry.domain for entry in model.opset_import}
    if foreign := sorted(domains - {"", "ai.onnx"}):
        raise ValueError(
            f"it has operators of {', '.join(foreign)}; only those of ONNX are allowed"
        )
    if model.functions:
        raise ValueError(f"it has functions of its own, such as {model.functions[0].name}")
    if any(tensor.external_data for tensor in model.graph.initializer):
        raise ValueError("it keeps numbers in another file")


def check_free_axes(model: onnx.ModelProto, free: dict[str, int]) -> None:
    """Refuse a model that fixes the length of an axis that hosts choose.

    Args:
        model: to look at.
        free: the axis of each input and output by name.

    Raises:
        ValueError: naming the axis.
    """
    shapes = {
        value.name: value.type.tensor_type.shape.dim
        for value in (*model.graph.input, *model.graph.output)
    }
    for name, axis in free.items():
        if name in shapes and shapes[name][axis].HasField("dim_value"):
            length = shapes[name][axis].dim_value
            raise ValueError(f"axis {axis} of {name} is {length} for ever; it must be free")


def check_guards(model: onnx.ModelProto, run: onnx.ModelProto | None = None) -> int:
    """Refuse a model of which onnxruntime drops a guard; how many there are.

    Args:
        model: as written.
        run: as it is run; by default what onnxruntime makes of it.

    Raises:
        ValueError: naming a guard that is gone.
    """
    written = guards_of(model.graph)
    run = optimised(model) if run is None else run
    if found := sorted({node.op_type for node in _all_nodes(run.graph)} & FORBIDDEN):
        raise ValueError(f"onnxruntime makes {', '.join(found)} of it, which none of ours may have")
    for (kind, numbers), count in (written - guards_of(run.graph)).items():
        given = f" with {', '.join(f'{number:g}' for number in numbers)}" if numbers else ""
        raise ValueError(f"onnxruntime drops a guard: {count} x {kind}{given}")
    return written.total()


def optimised(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model as onnxruntime runs it."""
    with tempfile.TemporaryDirectory(prefix="tactslip-") as folder:
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # it warns that the file is of this machine
        options.optimized_model_filepath = str(Path(folder) / "run.onnx")
        content = model.SerializeToString()
        onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        return onnx.load(options.optimized_model_filepath)


def guards_of(graph: onnx.GraphProto) -> Counter[Guard]:
    """Guards on what comes from the inputs, each once however often it is written.

    A node counts if its outputs are needed. Two nodes are one if kind, inputs and attributes are
    the same.
    """
    return _guards(graph, {}, {})


def _guards(
    graph: onnx.GraphProto, around: dict[str, str], constants: dict[str, tuple[float, ...]]
) -> Counter[Guard]:
    """Those of a graph; names stand for values: equal ones get the same."""
    names, numbers = dict(around), dict(constants)
    for tensor in graph.initializer:
        numbers[tensor.name] = _numbers(tensor)
    live = _live(graph)
    found: Counter[Guard] = Counter()
    seen: dict[tuple[object, ...], tuple[str, ...]] = {}
    for node in graph.node:
        if not live & set(node.output):
            continue
        if node.op_type == "Constant":
            numbers[node.output[0]] = _numbers(node.attribute[0].t)
        fed = [names.get(name, name) for name in node.input]
        bodies = [part.g for part in node.attribute if part.HasField("g")]
        for body in bodies:
            found += _guards(body, names, numbers)
        if node.input and all(name in numbers for name in fed) and not bodies:
            numbers |= dict.fromkeys(node.output, ())  # it is folded
            continue
        order = sorted(fed) if node.op_type in _COMMUTE else fed
        given = tuple(sorted(part.SerializeToString() for part in node.attribute))
        key = (node.op_type, *order, given)
        if key in seen and not bodies:
            names |= dict(zip(node.output, seen[key], strict=True))
            continue
        seen[key] = tuple(node.output)
        values = tuple(x for name in fed for x in numbers.get(name, ()))
        if _is_guard(node.op_type, values):
            found[node.op_type, values] += 1
    return found


def _is_guard(kind: str, values: tuple[float, ...]) -> bool:
    if kind in ("Add", "Sub"):
        return any(0 < abs(value) < _TINY for value in values)
    if kind in ("Mul", "Div"):
        return any(0 < abs(value - 1) < _TINY for value in values)
    return kind in _CHOICES


def _numbers(tensor: onnx.TensorProto) -> tuple[float, ...]:
    """The number that a constant holds, if it is one alone."""
    if int(np.prod(tensor.dims)) != 1:
        return ()
    return (float(numpy_helper.to_array(tensor).reshape(-1)[0]),)


def _live(graph: onnx.GraphProto) -> set[str]:
    """Names that an output depends on."""
    live = {value.name for value in graph.output}
    for node in reversed(graph.node):
        if live & set(node.output):
            live |= set(node.input)
            for part in node.attribute:
                if part.HasField("g"):
                    live |= {name for inner in _all_nodes(part.g) for name in inner.input}
                    live |= {value.name for value in part.g.output}
    return live


def _all_nodes(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    """Nodes, those of bodies too."""
    for node in graph.node:
        yield node
        for part in node.attribute:
            if part.HasField("g"):
                yield from _all_nodes(part.g)
