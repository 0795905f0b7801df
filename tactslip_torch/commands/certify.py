"""What float32 does to a detector: ``python -m tactslip_torch certify model=detector.pt``.

Writes ``certificate.json`` and its figure ``certificate.png`` beside the detector: float32 against
float64 on training bins, on held-out bins and on generated extremes, with the margin within which a
decision may change. Exit status 0 if the certificate holds, 1 if it does not; the files are written
all the same. In a program, ``tactslip_torch.analysis.certificate.certify`` needs no configuration.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from tactslip_torch.analysis.certificate import certify as measure
from tactslip_torch.analysis.raw_bins import draw_bins
from tactslip_torch.commands.entry import entry_point
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import ROLES, Split
from tactslip_torch.deploy.export import CERTIFICATE_FORMAT
from tactslip_torch.features.cache import cache_key, versions
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report.certificate import certificate_figure, conclusion
from tactslip_torch.runtime import check_number, plain, write_json
from tactslip_torch.training.datamodule import FeatureMaker

_EXIT_DOES_NOT_HOLD = 1


def certify(config: DictConfig) -> dict[str, Any]:
    """Measure the detector of ``config.model``, and write its certificate.

    Args:
        config: composed from ``conf/certify.yaml``.

    Returns:
        The content of ``certificate.json``.

    Raises:
        ValueError: for bad input, in one line.
        FileNotFoundError: if there is no such detector.
    """
    for name in ("bins", "scored_bins", "extremes", "boundary"):
        check_number(name, config[name], whole=True)
    check_number("seed", config.seed, least=0, whole=True)
    detector = SlipDetector.load(config.model)
    folder = _folder(config)
    _refuse_place(folder)
    source: RecordingSource = instantiate(config.data, _convert_="all")
    rule = instantiate(config.labels)
    maker = FeatureMaker(source, detector.pool, detector.channel_filter, rule)
    fold = _fold(config, source)
    trained_on = set(detector.info.get("train_recordings", {}).values())
    drawn: dict[str, Tensor] = {}
    origins: dict[str, dict[str, Any]] = {}
    for role, number in _roles(config).items():
        name = "calibration" if not drawn else role
        drawn[name], _, recordings = draw_bins(maker, fold, role, number, config.seed)
        keys = {cache_key(source.key(recording)) for recording in recordings}
        origins[name] = {
            "role": role,
            "recordings": len(recordings),
            "recordings_of_training": len(keys & trained_on),
            "materials": sorted({recording.material for recording in recordings}),
        }
    found = measure(
        detector,
        drawn.pop("calibration"),
        drawn,
        simulated=source.is_simulated,
        extremes=config.extremes,
        boundary=config.boundary,
        seed=config.seed,
    )
    content: dict[str, Any] = plain(found.content) | {
        "format": CERTIFICATE_FORMAT,
        "detector": {
            "file": Path(config.model).name,
            "sha256": hashlib.sha256(Path(config.model).read_bytes()).hexdigest(),
            "features": len(detector.selected),
            "trained_on_simulated": detector.info.get("simulated"),
        },
        "data": {
            "source": OmegaConf.to_container(config.data, resolve=True),
            "labels": OmegaConf.to_container(config.labels, resolve=True),
            "split": fold.name,
            "drawn": origins,
        },
        "versions": versions(),
    }
    write_json(folder / "certificate.json", content)
    certificate_figure(content, found.sets, folder / "certificate.png")
    return content


def _roles(config: DictConfig) -> dict[str, int]:
    """How many bins of which role, those to calibrate on first."""
    roles = [str(config.calibrate), *map(str, config.evaluate)]
    if len(set(roles)) < len(roles) or not set(roles) <= set(ROLES):
        raise ValueError(
            f"calibrate and evaluate must be different roles of {', '.join(ROLES)}, got "
            f"calibrate={roles[0]} evaluate=[{','.join(roles[1:])}]"
        )
    return {roles[0]: config.bins} | dict.fromkeys(roles[1:], config.scored_bins)


def _fold(config: DictConfig, source: RecordingSource) -> Split:
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    names = [fold.name for fold in folds]
    if config.fold not in ((None, *names) if len(folds) == 1 else names):
        raise ValueError(f"fold must be one of {', '.join(names)}, got {config.fold}")
    return folds[names.index(config.fold) if config.fold else 0]


def _refuse_place(folder: Path) -> None:
    """Refuse a folder that cannot be one, or that holds a file this would replace."""
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    if not nearest.is_dir():
        raise ValueError(f"{nearest} is a file, out= must be a folder; give another")
    path = folder / "certificate.json"
    if path.exists() and CERTIFICATE_FORMAT not in path.read_text("utf-8", errors="replace"):
        raise ValueError(f"{path} is no certificate of ours; move it, or give another out=")


def _folder(config: DictConfig) -> Path:
    return Path(config.out) if config.out else Path(config.model).parent


def _certify_or_exit(config: DictConfig, _: Path) -> None:
    """As a command: a line on the result, and exit status 1 if the certificate does not hold."""
    content = certify(config)
    line = f"{conclusion(content)}; see {_folder(config) / 'certificate.json'}"
    if not content["holds"]:
        print(line, file=sys.stderr)
        raise SystemExit(_EXIT_DOES_NOT_HOLD)
    print(line)


main = entry_point("certify", _certify_or_exit)
