"""What float32 does to a detector: ``python -m tactslip_torch certify model=detector.pt``.

Writes ``certificate.json`` and its figure ``certificate.png`` beside the detector: float32 against
float64 on training bins, on held-out bins and on generated extremes, with the margin within which a
decision may turn. Exit status 0 if the certificate holds, 1 if it does not; the files are written
all the same. In a program, ``tactslip_torch.analysis.certificate.certify`` needs no configuration.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import tactslip_torch
from tactslip_torch.analysis.certificate import certify as measure
from tactslip_torch.commands.entry import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.data.labels import LabelRule, needed_windows
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import ROLES, Split
from tactslip_torch.features.cache import cache_key, source_digest
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report.certificate import certificate_figure, verdict
from tactslip_torch.runtime import bar, whole_file
from tactslip_torch.signals.binning import bins_at, refuse_nonfinite
from tactslip_torch.training.datamodule import FeatureMaker

FORMAT = "tactslip_torch certificate 1"
_EXIT_DOES_NOT_HOLD = 1
_PER_RECORDING = 40
"""Bins drawn from a recording, more where there are too few recordings."""
_PAST_LARGEST = 2**63


def certify(config: DictConfig) -> tuple[dict[str, Any], Path]:
    """Measure the detector of ``config.model`` and write its certificate.

    Args:
        config: composed from ``conf/certify.yaml``.

    Returns:
        The content of ``certificate.json``, and the folder that holds it.

    Raises:
        ValueError: for bad input, in one line.
        FileNotFoundError: if there is no such detector.
    """
    for name, least in (("bins", 1), ("judged_bins", 1), ("extremes", 1), ("seed", 0)):
        if type(config[name]) is not int or not least <= config[name] < _PAST_LARGEST:
            wanted = f"a whole number from {least} on, below 2^63"
            raise ValueError(f"{name} must be {wanted}, got {config[name]!r}")
    detector = SlipDetector.load(config.model)
    folder = Path(config.out) if config.out else Path(config.model).parent
    _refuse_unwritable(folder)
    _refuse_foreign(folder)
    source: RecordingSource = instantiate(config.data, _convert_="all")
    rule: LabelRule = instantiate(config.labels)
    maker = FeatureMaker(source, detector.pool, detector.channel_filter, rule)
    fold = _fold(config, source)
    drawn: dict[str, Tensor] = {}
    facts: dict[str, Any] = {}
    for role, number in _roles(config).items():
        name = "calibration" if not drawn else role
        drawn[name], facts[name] = draw_bins(maker, fold, role, number, config.seed)
        known = set(detector.info.get("train_recordings", {}).values())
        keys = facts[name].pop("keys")
        facts[name]["recordings_of_training"] = sum(key in known for key in keys)
    found = measure(
        detector,
        drawn.pop("calibration"),
        drawn,
        simulated=source.is_simulated,
        extremes=config.extremes,
        seed=config.seed,
        watch=bar,
    )
    content: dict[str, Any] = _plain(found.facts() | _origin(config, detector, fold, facts))
    points = {
        name: (compared.exact.abs().tolist(), compared.error.tolist(), compared.flips.tolist())
        for name, compared in found.sets.items()
    }
    with whole_file(folder / "certificate.json") as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    with whole_file(folder / "certificate.png") as temporary:
        certificate_figure(content, points).savefig(temporary, format="png", dpi=170)
    return content, folder


def draw_bins(
    maker: FeatureMaker, fold: Split, role: str, number: int, seed: int
) -> tuple[Tensor, dict[str, Any]]:
    """Raw bins of a role with the context that ``score_raw`` needs, drawn at random.

    Recordings are taken from the materials in turn, a few bins of each, so that few bins meet many
    recordings. A bin whose context leaves its recording is passed over.

    Shape:
        - first output: ``[N, C, n + 2 * context]``, ``N`` at most ``number``

    Returns:
        The bins, and where they come from: ``keys`` are those of the recordings.

    Raises:
        ValueError: if no recording has the role, none has a bin, or a sample is not finite.
    """
    generator = torch.Generator().manual_seed(seed)
    recordings = _in_turn(fold.having(role), generator)
    if not recordings:
        raise ValueError(f"no recording has the role {role!r} in {fold.name}; choose another split")
    each = max(_PER_RECORDING, math.ceil(number / len(recordings)))
    recordings = recordings[: math.ceil(number / each)]
    source = maker.source
    before, after = maker.channel_filter.context_before, maker.channel_filter.context_after
    parts: list[Tensor] = []
    for recording in bar(recordings, f"{role}, recordings", "recording"):
        times = source.timeline(recording)
        bins = maker.lay_bins(times)
        windows = needed_windows(bins, before, times.duration_s, source.sample_rate_hz)
        samples = source.load(recording, windows).samples
        first, last = bins.starts - before, bins.starts + bins.bin_samples
        may = fold.bin_roles(recording, len(first))[role] & (first >= 0)
        first = first[may & (last + after <= samples.shape[-1])]
        chosen = torch.randperm(len(first), generator=generator)[:each].sort().values
        length = before + bins.bin_samples + after
        parts.append(bins_at(samples, first[chosen], length))
        refuse_nonfinite(parts[-1], source.hand.names, f"repair or leave out {recording}")
    drawn = torch.cat(parts)[:number]
    if not len(drawn):
        raise ValueError(f"no bin of {role} lies far enough inside its recording; take longer ones")
    return drawn, {
        "role": role,
        "recordings": len(recordings),
        "keys": [cache_key(source.key(recording)) for recording in recordings],
        "materials": sorted({recording.material for recording in recordings}),
    }


def _in_turn(recordings: list[RecordingId], generator: torch.Generator) -> list[RecordingId]:
    """The same in random order, but one of each material before a second of any."""
    order = torch.randperm(len(recordings), generator=generator).tolist()
    met: dict[str, int] = {}
    places = []
    for index in order:
        material = recordings[index].material
        met[material] = met.get(material, 0) + 1
        places.append((met[material], index))
    turn = {index: count for count, index in places}
    return [recordings[index] for index in sorted(order, key=turn.__getitem__)]


def _roles(config: DictConfig) -> dict[str, int]:
    """How many bins of which role, those to calibrate on first."""
    judged = [config.judge] if isinstance(config.judge, str) else list(config.judge)
    roles = [str(config.calibrate), *map(str, judged)]
    for role in roles:
        if role not in ROLES or roles.count(role) > 1:
            raise ValueError(
                f"calibrate and judge must be different roles of {', '.join(ROLES)}, got "
                f"calibrate={roles[0]} judge=[{','.join(roles[1:])}]"
            )
    return {roles[0]: config.bins} | dict.fromkeys(roles[1:], config.judged_bins)


def _fold(config: DictConfig, source: RecordingSource) -> Split:
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    names = [fold.name for fold in folds]
    if config.fold not in ((None, *names) if len(folds) == 1 else names):
        raise ValueError(f"fold must be one of {', '.join(names)}, got {config.fold}")
    return folds[names.index(config.fold) if config.fold else 0]


def _origin(
    config: DictConfig, detector: SlipDetector, fold: Split, drawn: Mapping[str, Any]
) -> dict[str, Any]:
    """What the certificate is of."""
    return {
        "format": FORMAT,
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
            "drawn": drawn,
        },
        "versions": {
            "tactslip_torch": tactslip_torch.__version__,
            "torch": torch.__version__,
            "code": source_digest(Path(tactslip_torch.__file__).parent),
        },
    }


def _refuse_unwritable(folder: Path) -> None:
    """Raise if there is a file where the folder, or one around it, would be."""
    path = next(path for path in (folder, *folder.parents) if path.exists())
    if not path.is_dir():
        raise ValueError(f"{path} is a file, out= must be a folder; give another")


def _refuse_foreign(folder: Path) -> None:
    """Raise if a file that this would replace is none of ours."""
    path = folder / "certificate.json"
    if path.exists() and FORMAT not in path.read_text(encoding="utf-8", errors="replace"):
        raise ValueError(f"{path} is no certificate of ours; move it, or give another out=")


def _plain(value: Any) -> Any:
    """The same with ``None`` for every number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="certify")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        content, folder = certify(config)
        line = f"{verdict(content)}; see {folder / 'certificate.json'}"
        if not content["holds"]:
            print(line, file=sys.stderr)
            raise SystemExit(_EXIT_DOES_NOT_HOLD)
        print(line)


if __name__ == "__main__":
    run_entry_point(main)
