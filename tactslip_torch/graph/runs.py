"""A model as onnxruntime runs it: arrays by name in, arrays by name out."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
Run = Callable[[Arrays], dict[str, NDArray[Any]]]


def session_of(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    """A session on one thread, optimised as onnxruntime does by default.

    Raises:
        ValueError: if onnxruntime cannot load the model.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong is raised
    content = model.SerializeToString()
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no other base in common
        raise ValueError(f"onnxruntime cannot load it: {_first_line(error)}") from error


def runner(session: onnxruntime.InferenceSession) -> Run:
    """The model as a function.

    Raises:
        ValueError: by the function, if the model cannot be run on what it is given.
    """
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Arrays) -> dict[str, NDArray[Any]]:
        try:
            return dict(zip(names, session.run(names, dict(inputs)), strict=True))
        except Exception as error:
            shapes = ", ".join(f"{name} {list(x.shape)}" for name, x in inputs.items())
            raise ValueError(
                f"onnxruntime cannot run it on {shapes}: {_first_line(error)}"
            ) from error

    return run


def run_alone(path: Path, inputs: Arrays) -> dict[str, NDArray[Any]]:
    """What a file gives in a fresh process that has onnxruntime and NumPy alone.

    Raises:
        ValueError: if it cannot be loaded or run there.
    """
    given = io.BytesIO()
    np.savez(given, **dict(inputs))  # type: ignore[arg-type]  # takes arrays by any name
    script = Path(__file__).with_name("alone.py")
    # -P: no module beside the script stands in for another of its name. Not -I, by which neither
    # PYTHONPATH nor the packages of the user are seen, where onnxruntime may be.
    command = [sys.executable, "-P", str(script), str(path)]
    done = subprocess.run(command, input=given.getvalue(), capture_output=True, check=False)
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["it ended"]
        raise ValueError(f"a fresh process cannot run it: {lines[-1]}")
    return dict(np.load(io.BytesIO(done.stdout)))


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
