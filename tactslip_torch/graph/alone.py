"""Run a model once, as a host without this package does: by onnxruntime and NumPy alone.

    python alone.py model.onnx < inputs.npz > outputs.npz

Not imported: ``check`` starts it, by its path, in a process of its own.
"""

import io
import sys

import numpy as np
import onnxruntime

if __name__ == "__main__":
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(sys.argv[1], options, ["CPUExecutionProvider"])
    inputs = dict(np.load(io.BytesIO(sys.stdin.buffer.read())))
    names = [output.name for output in session.get_outputs()]
    outputs = dict(zip(names, session.run(names, inputs), strict=True))
    np.savez(sys.stdout.buffer, **outputs)
