"""Models as onnxruntime runs them, here and in a process of their own."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from test_graph_structure import guarded

from tactslip_torch.graph import runs
from tactslip_torch.graph.runs import run_alone, runner, session_of

pytestmark = pytest.mark.onnx


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


def test_a_fresh_process_finds_packages_where_this_one_does(tmp_path, monkeypatch):
    (tmp_path / "onnxruntime.py").write_text("raise ImportError('found by PYTHONPATH')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    path = tmp_path / "model.onnx"
    onnx.save(guarded(), path)
    with pytest.raises(ValueError, match=r"a fresh process cannot run it: .*found by PYTHONPATH"):
        run_alone(path, {"samples": np.ones((2, 8))})


def test_what_lies_beside_the_script_shadows_nothing(tmp_path, monkeypatch):
    """A module of this package, or of the folder one is in, may be called as another package."""
    script = tmp_path / "alone.py"
    script.write_bytes(Path(runs.__file__).with_name("alone.py").read_bytes())
    (tmp_path / "numpy.py").write_text("raise ImportError('not NumPy')")
    path = tmp_path / "model.onnx"
    onnx.save(guarded(), path)
    monkeypatch.setattr(runs, "__file__", str(tmp_path / "runs.py"))
    monkeypatch.chdir(tmp_path)
    inputs = {"samples": np.ones((2, 8))}
    assert np.isfinite(run_alone(path, inputs)["score"]).all()
