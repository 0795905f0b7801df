"""A detector as ONNX files, each with its metadata beside it.

``model.onnx`` scores bins; ``stream.onnx``, of a detector with alarm settings, takes samples as
they come and raises alarms. Both hold no more than the selected features need, and metadata for a
host, which stand in a sidecar ``<file>.json`` too. A file is left only if it passes its check
(``deploy.check``).
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, get_args

import onnx
from onnx import helper

from tactslip_torch.deploy.bins import Precision, bin_graph, dtype_of, host_metadata
from tactslip_torch.deploy.check import GraphKind, check_model
from tactslip_torch.deploy.stream import stream_graph
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.package_files import SIDECAR as FORMAT
from tactslip_torch.package_files import read_json
from tactslip_torch.runtime import plain, whole_file

FILES: dict[GraphKind, str] = {"bin": "model.onnx", "stream": "stream.onnx"}
"""What the file of each graph is called."""


def export_detector(
    detector: SlipDetector,
    folder: str | os.PathLike[str],
    graphs: Sequence[GraphKind] = ("bin", "stream"),
    precision: Precision = "float32",
    *,
    source: str | os.PathLike[str] | None = None,
) -> tuple[Path, ...]:
    """Write graphs of a detector, checked, each with its sidecar; all of them or none.

    Args:
        detector: as fitted.
        folder: for ``model.onnx`` and ``stream.onnx``.
        graphs: ``"bin"``, ``"stream"`` or both.
        precision: of samples and scores, ``"float32"`` or ``"float64"``.
        source: file that the detector is kept in; by it a host knows which it has.

    Returns:
        The models' paths, in the order of ``graphs``.

    Raises:
        ValueError: if there is no such graph, precision or setting, or a model fails its check;
            what was in the folder is kept then.
    """
    dtype_of(precision)
    if not graphs or not set(graphs) <= set(get_args(GraphKind)):
        wanted = " or ".join(get_args(GraphKind))
        raise ValueError(f"graphs must be {wanted}, or both, got {', '.join(graphs) or 'none'}")
    if "stream" in graphs:
        AlarmSettings.of(detector)  # the error comes before there is anything to undo
    detector_sha256 = _detector_digest(detector, source)
    paths = tuple(Path(folder) / FILES[kind] for kind in graphs)
    with ExitStack() as files:
        for kind, path in zip(graphs, paths, strict=True):
            beside = files.enter_context(whole_file(_sidecar_path(path)))
            temporary = files.enter_context(whole_file(path))
            try:
                if kind == "bin":
                    model = bin_graph(detector, precision).model()
                else:
                    model = stream_graph(detector, AlarmSettings.of(detector), precision).model()
                check = check_model(model, detector, kind, precision)
            except ValueError as error:
                raise ValueError(f"{path} was not written: {error}") from error
            metadata = plain({**host_metadata(detector, kind, precision), "check": check})
            metadata["detector_sha256"] = detector_sha256
            props = {name: json.dumps(value, allow_nan=False) for name, value in metadata.items()}
            helper.set_model_props(model, props)
            onnx.save(model, temporary)
            content = temporary.read_bytes()
            metadata["file"] = path.name
            metadata["onnx_sha256"] = hashlib.sha256(content).hexdigest()
            metadata["onnx_bytes"] = len(content)
            beside.write_text(json.dumps(metadata, indent=1, allow_nan=False) + "\n")
    return paths


def _detector_digest(detector: SlipDetector, source: str | os.PathLike[str] | None) -> str:
    """Digest of the detector's file; without one, of the file that it would be saved as."""
    if source is not None:
        return _digest(Path(source))
    with tempfile.TemporaryDirectory(prefix="tactslip-") as folder:
        path = Path(folder) / "detector.pt"
        detector.save(path)  # the same detector gives the same bytes
        return _digest(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# Files that are there --------------------------------------------------------------------------


def _sidecar_path(model: Path) -> Path:
    """Where the metadata of a model stand for hosts that do not read them in its file."""
    return model.with_name(f"{model.name}.json")


def read_sidecar(model: Path) -> dict[str, Any]:
    """Metadata of a model, with name, digest and length of its file.

    Raises:
        FileNotFoundError: if they are not there.
        ValueError: if they are damaged.
    """
    return read_json(_sidecar_path(model), FORMAT)


def summary(path: Path) -> str:
    """One line about a model: size and error."""
    metadata = read_sidecar(path)
    return (
        f"{path}: {metadata['onnx_bytes'] / 1000:.0f} kB, {metadata['precision']}, scores "
        f"within {metadata['check']['worst_sd']:.1e} standard deviations of those that torch "
        "computes in float64, on a simulated slip"
    )


def wanted_graphs(graph: str | None, detector: SlipDetector) -> tuple[GraphKind, ...]:
    """The graphs that ``graph=`` asks for; by default all that the detector can give."""
    choices: dict[str | None, tuple[GraphKind, ...]] = {
        "bin": ("bin",),
        "stream": ("stream",),
        "both": ("bin", "stream"),
        None: ("bin", "stream") if KEY in detector.info else ("bin",),
    }
    if graph not in choices:
        raise ValueError(f"graph must be bin, stream, both or native, got {graph!r}")
    return choices[graph]
