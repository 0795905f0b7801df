"""What a host must know of a model: in the file as metadata, and beside it as a sidecar."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.stream import Timing
from tactslip_torch.model.abstention import abstention_of
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.settings import AlarmSettings, calibration_of
from tactslip_torch.runtime import plain

FORMAT = "tactslip_torch onnx 1"
CERTIFICATE_FORMAT = "tactslip_torch certificate 1"
GraphKind = Literal["bin", "stream"]


class Origin(NamedTuple):
    """Where a model comes from.

    Attributes:
        version: of this package.
        detector_sha256: of the detector's file.
        certificate: what a host is told of its numeric certificate, ``None`` if there is none.
    """

    version: str
    detector_sha256: str
    certificate: Mapping[str, Any] | None = None


def model_facts(
    detector: SlipDetector, form: Form, origin: Origin, kind: GraphKind = "bin"
) -> dict[str, Any]:
    """All that a host must know, in JSON types; ``null`` for what is not known or not finite.

    Args:
        detector: that was exported.
        form: of its graph.
        origin: where it comes from.
        kind: of its graph.
    """
    hand, info = detector.pool.hand, detector.info
    window = Window.of(detector)
    calibrated, abstain = calibration_of(detector), abstention_of(detector)
    facts: dict[str, Any] = {
        "format": FORMAT,
        "version": origin.version,
        "graph": kind,
        "precision": form.precision,
        "channels": list(hand.names),
        "kinds": [channel.kind for channel in hand.channels],
        "unit": info.get("units", "V"),
        "sample_rate_hz": detector.pool.sample_rate_hz,
        "bin_samples": window.bin,
        "context_before_samples": window.before,
        "context_after_samples": window.after,
        "features": [str(name) for name in detector.selected_names],
        "slip_if_score_at_least": 0.0,
        "calibration": calibrated and calibrated[0].to_dict(),
        "slip_share": calibrated and calibrated[1],
        "abstain": abstain and abstain.to_dict(),
        "experiment": info.get("experiment"),
        "train_materials": list(info.get("train_materials", ())),
        "simulated": info.get("simulated"),
        "detector_sha256": origin.detector_sha256,
        "certificate": origin.certificate,
    }
    if kind == "stream":
        facts |= _stream_facts(detector, AlarmSettings.of(detector))
    metadata: dict[str, Any] = plain(facts)
    return metadata


def in_file(facts: Mapping[str, Any]) -> dict[str, str]:
    """The facts as a file's metadata holds them: JSON text by name."""
    return {name: json.dumps(value, allow_nan=False) for name, value in facts.items()}


def sidecar_path(model: Path) -> Path:
    """Where the facts of a model stand for hosts that do not read its metadata."""
    return model.with_name(f"{model.name}.json")


def sidecar_text(facts: Mapping[str, Any], name: str, content: bytes) -> str:
    """The facts with name, digest and length of the file: one JSON object, a line for each scalar.

    Args:
        facts: of the model.
        name: of its file.
        content: of it.
    """
    of_file = {
        "file": name,
        "onnx_sha256": hashlib.sha256(content).hexdigest(),
        "onnx_bytes": len(content),
    }
    return json.dumps({**facts, **of_file}, indent=1, allow_nan=False) + "\n"


def detector_sha256(detector: SlipDetector) -> str:
    """SHA-256 of the file that the detector is saved to: the same detector gives the same."""
    with tempfile.TemporaryDirectory(prefix="tactslip-") as folder:
        path = Path(folder) / "detector.pt"
        detector.save(path)
        return hashlib.sha256(path.read_bytes()).hexdigest()


def certificate_facts(content: Mapping[str, Any]) -> dict[str, Any]:
    """What a host is told of a ``certificate.json``: margin, and what the bins judged show of it.

    Raises:
        KeyError, TypeError: if it is no certificate.
    """
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


def _stream_facts(detector: SlipDetector, settings: AlarmSettings) -> dict[str, Any]:
    timing = Timing.of(detector, settings)
    return {
        "hop_samples": timing.hop,
        "first_samples": timing.first,
        "frame_samples": timing.frame,
        "tail_samples": timing.tail,
        "state_size": timing.state_size,
        "rule": settings.rule.to_dict(),
        "threshold": settings.threshold,
        "target_false_alarms_per_hour": settings.target_per_hour,
        "threshold_curve": settings.facts.get("threshold_curve", []),
    }
