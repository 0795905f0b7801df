"""No file of a model that is wrong anywhere: none is left, and the earlier ones are kept."""

import copy

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from small_detector import alarming_detector, small_detector

from tactslip_torch.graph import export
from tactslip_torch.graph.export import export_detector

pytestmark = pytest.mark.onnx


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


def test_a_detector_without_alarm_gives_no_stream(tmp_path):
    with pytest.raises(ValueError, match="this detector has no alarm threshold"):
        export_detector(small_detector(), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"graphs": ["both"]}, "graphs must be bin or stream, or both, got both"),
        ({"graphs": []}, "got none"),
        ({"precision": "float16"}, "precision must be one of float32, float64, got 'float16'"),
    ],
)
def test_another_choice_is_refused(detector, tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        export_detector(detector, tmp_path, **arguments)
    assert not list(tmp_path.iterdir())


class Broken:
    """A graph whose model somebody changed."""

    def __init__(self, graph, change):
        self.graph, self.change = graph, change

    def model(self, metadata):
        model = self.graph.model(metadata)
        self.change(model)
        return model


def node_before(model, output):
    return next(node for node in model.graph.node if output in node.output)


def denies(model):
    """``valid`` is its contrary."""
    node = node_before(model, "valid")
    node.CopyFrom(helper.make_node("Not", node.input[:1], ["valid"]))


def tensors_of(graph):
    """Constants, those of bodies too."""
    yield from graph.initializer
    for node in graph.node:
        for part in node.attribute:
            if part.HasField("g"):
                yield from tensors_of(part.g)


def other_numbers(model):
    """Every second column of the largest matrix is 1 % larger."""
    largest = max(tensors_of(model.graph), key=lambda tensor: np.prod(tensor.dims))
    numbers = numpy_helper.to_array(largest).copy()
    numbers[..., ::2] *= 1.01
    largest.CopyFrom(numpy_helper.from_array(numbers, largest.name))


def static(model):
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 7


def foreign(model):
    model.graph.node.append(helper.make_node("DFT", ["samples"], ["spectrum"]))


def heavy(model):
    numbers = np.zeros(400_000, np.float32)
    model.graph.initializer.append(numpy_helper.from_array(numbers, "ballast"))


def silent(model):
    """Scores are of no number where a sample is none."""
    node = node_before(model, "score")
    model.graph.node.remove(node)
    first = model.graph.node.add
    first(op_type="ReduceSum", input=["samples", "both"], output=["sum"]).attribute.append(
        helper.make_attribute("keepdims", 0)
    )
    first(op_type="Sub", input=["sum", "sum"], output=["none"])
    first(op_type="Add", input=[node.input[0], "none"], output=["score"])
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 2]), "both"))


def wide(model):
    node = node_before(model, "score")
    node.CopyFrom(helper.make_node("Cast", node.input[:1], ["score"], to=TensorProto.DOUBLE))
    output = next(value for value in model.graph.output if value.name == "score")
    output.type.tensor_type.elem_type = TensorProto.DOUBLE


BREAKS = {
    "valid is wrong": (denies, "valid differs from torch"),
    "a matrix is wrong": (other_numbers, "scores differ from torch in float64"),
    "batch is fixed": (static, "axis 0 of samples is 7 for ever"),
    "an operator is slow": (foreign, "it has the operators DFT"),
    "the file is large": (heavy, "its file has .* bytes, more than"),
    "a guard is gone": (silent, "scores are not finite"),
    "a score is wide": (wide, "expected .*score float32"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_bad_model_is_not_left_and_the_earlier_one_is_kept(detector, tmp_path, monkeypatch, name):
    change, message = BREAKS[name]
    earlier = {"model.onnx": b"yesterday's", "model.onnx.json": b"{}"}
    for file, content in earlier.items():
        (tmp_path / file).write_bytes(content)
    made = export._graph
    monkeypatch.setattr(export, "_graph", lambda *given: Broken(made(*given), change))
    with pytest.raises(ValueError, match=rf"model\.onnx was not written: .*{message}") as caught:
        export_detector(detector, tmp_path, ["bin"], alone=False)
    assert "\n" not in str(caught.value)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == earlier


def test_all_files_are_left_or_none(detector, tmp_path, monkeypatch):
    made = export._graph

    def graph(of, form, kind):
        return made(of, form, kind) if kind == "bin" else Broken(made(of, form, kind), denies)

    monkeypatch.setattr(export, "_graph", graph)
    with pytest.raises(ValueError, match=r"stream\.onnx was not written: .*valid differs"):
        export_detector(detector, tmp_path, alone=False)
    assert not list(tmp_path.iterdir())


def test_what_a_fresh_process_says_counts(detector, tmp_path, monkeypatch):
    """It is the file that is run there; here a changed one."""
    saved = onnx.save

    def save(model, path):
        model = copy.deepcopy(model)
        other_numbers(model)
        saved(model, path)

    monkeypatch.setattr(export.onnx, "save", save)
    with pytest.raises(ValueError, match="in a fresh process score is another"):
        export_detector(detector, tmp_path, ["bin"])
    assert not list(tmp_path.iterdir())
