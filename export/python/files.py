"""Read an exported model, or a recording for it; a ``ValueError`` says in one line why not."""

import hashlib
import json
from pathlib import Path

import numpy as np
import onnxruntime

FORMAT = "tactslip_torch onnx 1"
USUAL = {"bin": "model.onnx", "stream": "stream.onnx"}  # which file holds which graph


def load_model(path, graph):
    """A session on one thread, and the facts that its sidecar ``<path>.json`` holds.

    Args:
        path: of the ``.onnx`` file.
        graph: the one wanted, ``"bin"`` or ``"stream"``.
    """
    path = Path(path)
    sidecar = path.with_name(f"{path.name}.json")
    for part in (path, sidecar):
        if not part.is_file():
            raise ValueError(f"no file {part}; give a model with its .onnx.json beside it")
    content = path.read_bytes()
    try:
        facts = json.loads(sidecar.read_text("utf-8"))
    except ValueError as error:
        raise ValueError(f"{sidecar} is damaged ({error}); copy it again") from None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise ValueError(f"{sidecar} is no sidecar of format {FORMAT!r}; export the model again")
    if hashlib.sha256(content).hexdigest() != facts["onnx_sha256"]:
        raise ValueError(
            f"{path} is cut off or altered: its SHA-256 is not the onnx_sha256 of {sidecar.name}; "
            "copy both again"
        )
    if facts["graph"] != graph:
        raise ValueError(
            f"{path} is a {facts['graph']} graph, no {graph} graph; give {USUAL[graph]}"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # a push is too small to be shared
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(content, options, ["CPUExecutionProvider"]), facts


def load_recording(path, facts, rate=None):
    """Volts ``[T, C]`` of a ``.npy`` file, left on disk until they are asked for.

    Args:
        path: of the file.
        facts: of the model: its channels and rate.
        rate: of the recording in Hz, if known.
    """
    wanted_rate, channels = facts["sample_rate_hz"], facts["channels"]
    if rate not in (None, wanted_rate):
        raise ValueError(f"{path} is at {rate:g} Hz, the model at {wanted_rate:g}; resample it")
    if not Path(path).is_file():
        raise ValueError(f"no file {path}; give a recording that numpy.save wrote")
    try:
        samples = np.lib.format.open_memmap(path, mode="r")
    except ValueError as error:
        raise ValueError(f"{path} is no .npy file, or cut off ({error}); save it again") from None
    if samples.dtype.str not in ("<f4", "<f8"):
        raise ValueError(
            f"{path} holds {samples.dtype.str}; give volts in little-endian float32 or float64"
        )
    if samples.ndim != 2 or samples.shape[1] != len(channels):
        raise ValueError(
            f"{path} is {list(samples.shape)}; give [T, {len(channels)}], a row an instant, a "
            f"column a channel, {channels[0]} to {channels[-1]}"
        )
    if not samples.flags.c_contiguous:
        raise ValueError(f"{path} is in Fortran order; save numpy.ascontiguousarray of it")
    return samples
