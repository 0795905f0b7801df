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
from collections.abc import Mapping, Sequence
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
from tactslip_torch.own_files import SIDECAR as FORMAT
from tactslip_torch.own_files import read_json
from tactslip_torch.runtime import plain, whole_file

CERTIFICATE_FORMAT = "tactslip_torch certificate 1"
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
        source: file that the detector is kept in; by it a host knows which it has, and a
            ``certificate.json`` beside it is handed on if it is this detector's.

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
        AlarmSettings.of(detector)  # says what is missing before there is anything to undo
    origin = _origin(detector, source)
    paths = tuple(Path(folder) / FILES[kind] for kind in graphs)
    with ExitStack() as files:
        for kind, path in zip(graphs, paths, strict=True):
            beside = files.enter_context(whole_file(sidecar_path(path)))
            temporary = files.enter_context(whole_file(path))
            try:
                if kind == "bin":
                    model = bin_graph(detector, precision).model()
                else:
                    model = stream_graph(detector, AlarmSettings.of(detector), precision).model()
                check = check_model(model, detector, kind, precision)
            except ValueError as error:
                raise ValueError(f"{path} was not written: {error}") from error
            metadata = plain({**host_metadata(detector, kind, precision), "check": check}) | origin
            props = {name: json.dumps(value, allow_nan=False) for name, value in metadata.items()}
            helper.set_model_props(model, props)
            onnx.save(model, temporary)
            content = temporary.read_bytes()
            metadata["file"] = path.name
            metadata["onnx_sha256"] = hashlib.sha256(content).hexdigest()
            metadata["onnx_bytes"] = len(content)
            beside.write_text(json.dumps(metadata, indent=1, allow_nan=False) + "\n")
    return paths


def _origin(detector: SlipDetector, source: str | os.PathLike[str] | None) -> dict[str, Any]:
    """Digest of the detector's file, and what a host is told of its certificate."""
    if source is not None:
        digest = _digest(Path(source))
        certificate = _certificate(Path(source).with_name("certificate.json"), digest)
        return {"detector_sha256": digest, "certificate": certificate}
    with tempfile.TemporaryDirectory(prefix="tactslip-") as folder:
        path = Path(folder) / "detector.pt"
        detector.save(path)  # the same detector gives the same bytes
        return {"detector_sha256": _digest(path), "certificate": None}


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _certificate(path: Path, digest: str) -> dict[str, Any] | None:
    """What a host is told of the certificate of the detector with this digest, if it is there."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != CERTIFICATE_FORMAT or content["detector"]["sha256"] != digest:
            return None
        margin = content["margin"]
        return {
            "holds": content["holds"],
            "simulated": content["simulated"],
            "score_sd": content["score_sd"],
            "margin": margin["score"],
            "margin_sd": margin["sd"],
            "rule": margin["rule"],
            "head_bound": content["head"]["bound"],
            "sets": {
                name: {
                    "bins": found["bins"],
                    "worst_sd": found["error"]["worst_sd"],
                    "share_inside_margin": found["inside_margin"]["share"],
                    "flips_outside_margin": found["flips"]["outside_margin"],
                }
                for name, found in content["sets"].items()
            },
        }
    except (OSError, ValueError, KeyError, TypeError):
        return None


# Files that are there --------------------------------------------------------------------------


def sidecar_path(model: Path) -> Path:
    """Where the metadata of a model stand for hosts that do not read them in its file."""
    return model.with_name(f"{model.name}.json")


def read_sidecar(model: Path) -> dict[str, Any]:
    """Metadata of a model, with name, digest and length of its file.

    Raises:
        FileNotFoundError: if they are not there.
        ValueError: if they are damaged.
    """
    return read_json(sidecar_path(model), FORMAT)


def stale_graphs(source: Path) -> tuple[Path, ...]:
    """Graphs beside a detector's file that are of another one, or do not say of which."""
    digest = _digest(source)

    def is_stale(path: Path) -> bool:
        try:
            told = json.loads(sidecar_path(path).read_bytes())
            return bool(told["detector_sha256"] != digest)
        except (OSError, ValueError, LookupError, TypeError):
            return True

    paths = [source.with_name(name) for name in FILES.values()]
    return tuple(path for path in paths if path.is_file() and is_stale(path))


def summary(path: Path) -> str:
    """One line about a model: size, error, certificate."""
    metadata = read_sidecar(path)
    certificate: Mapping[str, Any] | None = metadata["certificate"]
    if certificate is None:
        trust = "no certificate (python -m tactslip_torch certify makes one)"
    elif not certificate["holds"]:
        trust = "its certificate does not hold"
    else:
        trust = f"certified but where |score| is below {certificate['margin']:.1e}"
        trust += " (simulated data)" * bool(certificate["simulated"])
    return (
        f"{path}: {metadata['onnx_bytes'] / 1000:.0f} kB, {metadata['precision']}, within "
        f"{metadata['check']['worst_sd']:.1e} score deviations of torch in float64 (simulated "
        f"slip), {trust}"
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
        raise ValueError(f"graph must be bin, stream or both, got {graph!r}")
    return choices[graph]
