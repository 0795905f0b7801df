"""A detector as ONNX files.

``model.onnx`` judges bins; ``stream.onnx``, of a detector with alarm settings, takes samples as
they come and raises alarms. Both hold no more than the selected features need, and facts for a
host, which stand in a sidecar ``<file>.json`` too. A file is left only if it passes the self-check
(``graph.check``).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, get_args

import onnx

import tactslip_torch
from tactslip_torch.graph.bins import bin_graph
from tactslip_torch.graph.check import check_file, check_model
from tactslip_torch.graph.facts import (
    CERTIFICATE_FORMAT,
    GraphKind,
    Origin,
    certificate_facts,
    detector_sha256,
    in_file,
    model_facts,
    sidecar_path,
    sidecar_text,
)
from tactslip_torch.graph.form import Form, Precision
from tactslip_torch.graph.stream import stream_graph
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.settings import KEY, AlarmSettings
from tactslip_torch.runtime import whole_file

FILES: dict[GraphKind, str] = {"bin": "model.onnx", "stream": "stream.onnx"}
"""What the file of each graph is called."""


def export_detector(
    detector: SlipDetector,
    folder: str | os.PathLike[str],
    graphs: Sequence[GraphKind] = ("bin", "stream"),
    precision: Precision = "float32",
    *,
    source: str | os.PathLike[str] | None = None,
    alone: bool = True,
) -> tuple[Path, ...]:
    """Write graphs of a detector, checked, each with its sidecar; all of them or none.

    Args:
        detector: as fitted.
        folder: for ``model.onnx`` and ``stream.onnx``.
        graphs: ``"bin"``, ``"stream"`` or both.
        precision: of samples and scores, ``"float32"`` or ``"float64"``.
        source: file that the detector is kept in; by it a host knows which it has, and a
            ``certificate.json`` beside it is handed on if it is this detector's.
        alone: whether the check runs each file in a process of its own, which takes a second.

    Returns:
        The models' paths, in the order of ``graphs``.

    Raises:
        ValueError: if there is no such graph, form or setting, or a model fails its check; what
            was in the folder is kept then.
    """
    form = Form(precision)
    if not graphs or not set(graphs) <= set(get_args(GraphKind)):
        wanted = " or ".join(get_args(GraphKind))
        raise ValueError(f"graphs must be {wanted}, or both, got {', '.join(graphs) or 'none'}")
    if "stream" in graphs:
        AlarmSettings.of(detector)  # says what is missing before there is anything to undo
    origin = _origin(detector, None if source is None else Path(source))
    paths = tuple(Path(folder) / FILES[kind] for kind in graphs)
    with ExitStack() as files:
        for kind, path in zip(graphs, paths, strict=True):
            sidecar = files.enter_context(whole_file(sidecar_path(path)))
            temporary = files.enter_context(whole_file(path))
            try:
                facts = _write(temporary, detector, form, kind, origin, alone)
            except ValueError as error:
                raise ValueError(f"{path} was not written: {error}") from error
            sidecar.write_text(sidecar_text(facts, path.name, temporary.read_bytes()))
    return paths


def sidecar_facts(path: Path) -> dict[str, Any]:
    """What the sidecar of a model says."""
    facts: dict[str, Any] = json.loads(sidecar_path(path).read_text())
    return facts


def stale_graphs(model: Path) -> tuple[Path, ...]:
    """Graphs beside a detector's file that are of another one, or do not say of which."""
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    paths = [model.with_name(name) for name in FILES.values()]
    return tuple(path for path in paths if path.is_file() and _detector_of(path) != digest)


def _detector_of(path: Path) -> str | None:
    try:
        return str(sidecar_facts(path)["detector_sha256"])
    except (OSError, ValueError, KeyError):
        return None


def worst_error(facts: dict[str, Any]) -> float:
    """The largest score error that a model's check measured, in standard deviations."""
    check = facts["check"]
    if facts["graph"] == "stream":
        return float(check["worst_sd"])
    return max(float(check[name]["worst_sd"]) for name in ("noise", "simulated_slip"))


def summary(path: Path) -> str:
    """One line about a model: size, error, certificate."""
    facts = sidecar_facts(path)
    certificate = facts["certificate"]
    if certificate is None:
        trust = "no certificate (python -m tactslip_torch certify makes one)"
    elif not certificate["holds"]:
        trust = "its certificate does not hold"
    else:
        trust = f"certified but where |score| is below {certificate['margin']:.1e}"
        trust += " (simulated data)" * bool(certificate["simulated"])
    return (
        f"{path}: {facts['onnx_bytes'] / 1000:.0f} kB, {facts['precision']}, within "
        f"{worst_error(facts):.1e} score deviations of torch in float64 (simulated slip), {trust}"
    )


def _write(
    path: Path,
    detector: SlipDetector,
    form: Form,
    kind: GraphKind,
    origin: Origin,
    alone: bool,
) -> dict[str, Any]:
    """Write and check a model; its facts, what the check measured among them."""
    graph = _graph(detector, form, kind)
    model = graph.model({})
    check = check_model(model, detector, form, kind)
    facts = {**model_facts(detector, form, origin, kind), "check": check}
    model = graph.model(in_file(facts))
    onnx.save(model, path)
    check_file(path, facts, model, detector, form, alone=alone)
    return facts


def _graph(detector: SlipDetector, form: Form, kind: GraphKind) -> Graph:
    if kind == "bin":
        return bin_graph(detector, form)
    return stream_graph(detector, AlarmSettings.of(detector), form)


def _origin(detector: SlipDetector, source: Path | None) -> Origin:
    if source is None:
        return Origin(tactslip_torch.__version__, detector_sha256(detector))
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    certificate = _certificate(source.with_name("certificate.json"), digest)
    return Origin(tactslip_torch.__version__, digest, certificate)


def _certificate(path: Path, digest: str) -> dict[str, Any] | None:
    """That of the detector with this digest, if it stands there."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != CERTIFICATE_FORMAT or content["detector"]["sha256"] != digest:
            return None
        return certificate_facts(content)
    except (OSError, ValueError, KeyError, TypeError):
        return None


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
