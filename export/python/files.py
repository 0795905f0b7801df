"""Read an exported model, or a recording for it; a ``ValueError`` says in one line why not."""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import onnxruntime

FORMAT = "tactslip_torch onnx 2"
USUAL = {"bin": "model.onnx", "stream": "stream.onnx"}  # which file holds which graph
COUNTS = {
    "bin": ("bin_samples", "context_before_samples", "context_after_samples"),
    "stream": ("hop_samples", "first_samples", "frame_samples", "tail_samples", "state_size"),
}
POSITIVE = ("bin_samples", "hop_samples", "onset_hop_samples")


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
    check_facts(sidecar, facts)
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


def is_count(value, least):
    """A whole number; in JSON true is none."""
    return type(value) is int and value >= least


def is_names(value):
    """A list of texts, not empty."""
    return isinstance(value, list) and value and all(isinstance(name, str) for name in value)


def check_facts(sidecar, facts):
    """Refuse a sidecar that lacks something a host needs, or has it wrong."""
    graph, names, rate = (facts.get(key) for key in ("graph", "channels", "sample_rate_hz"))
    checks = [
        ("graph", graph in ("bin", "stream"), "bin or stream"),
        ("onnx_sha256", isinstance(facts.get("onnx_sha256"), str), "64 hexadecimal digits"),
        ("precision", facts.get("precision") in ("float32", "float64"), "float32 or float64"),
        ("channels", is_names(names), "a list of names"),
        (
            "sample_rate_hz",
            type(rate) in (int, float) and math.isfinite(rate) and rate > 0,
            "a positive number",
        ),
    ]
    optional = [key for key in ("onset_hop_samples",) if key in facts]
    for key in (*COUNTS.get(graph, ()), *optional):
        least = int(key in POSITIVE)
        wanted = "a positive whole number" if least else "a whole number"
        checks.append((key, is_count(facts.get(key), least), wanted))
    for key, is_right, wanted in checks:
        if not is_right:
            said = json.dumps(facts[key]) if key in facts else "nothing"
            raise ValueError(
                f"{sidecar} says {key} {said}, wanted {wanted}; export the model again"
            )


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
    except (ValueError, OverflowError) as error:  # the other for a shape that no file can have
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
