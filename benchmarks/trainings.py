"""Detectors that benchmarks train, kept by the digest of the code that made them."""

from __future__ import annotations

import hashlib
import io
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from benchmarks.sources import ROOT
from tactslip_torch import SlipDetector
from tactslip_torch.__main__ import run
from tactslip_torch.commands.configuration import checked
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.features.cache import source_digest
from tactslip_torch.runtime import whole_file
from tactslip_torch.training.datamodule import RecordingFeatures, SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_maker

if TYPE_CHECKING:
    from benchmarks.harness import Job

SOURCES = ("tactslip_torch/commands/train.py",)


def say(text: str) -> None:
    """A progress line on standard error."""
    print(text, file=sys.stderr, flush=True)


def trained(overrides: Sequence[str], folder: Path, cache: Path) -> dict[str, Any]:
    """The metrics of a training, from its folder if this code finished it there, else made now.

    Args:
        overrides: of ``tactslip train``.
        folder: of its results.
        cache: of features.

    Raises:
        SystemExit: if the training fails, which has printed why.
    """
    given = ["train", *overrides, "export=false", f"cache={cache}"]

    def made() -> Any:
        say(" ".join(["tactslip", *given]))
        with redirect_stdout(io.StringIO()):
            run("train", [*given[1:], f"hydra.run.dir='{folder}'"])
        return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))

    found: dict[str, Any] = resumed(folder / "train.json", given, made)
    return found


def main_job_detector(job: Job) -> Path:
    """The file of the detector that README's main job makes by this code, trained once.

    Of a quick run it is the one that comes with the package.
    """
    folder = job.folder.parent / "main job"
    if job.is_quick:
        folder.mkdir(parents=True, exist_ok=True)
        SlipDetector.pretrained().save(folder / "detector.pt")
    else:
        trained(["+exp=unseen4", "baselines=false"], folder, folder / "cache")
    return folder / "detector.pt"


def code_digest() -> str:
    """Of everything that decides a result: sources, calibrated parameters, configuration."""
    digest = hashlib.sha256(source_digest().encode())
    others = [*(ROOT / "tactslip_torch").rglob("*.json"), *(ROOT / "conf").rglob("*.yaml")]
    for path in sorted(others):
        digest.update(path.relative_to(ROOT).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def resumed(path: Path, overrides: Sequence[str], make: Callable[[], Any]) -> Any:
    """What ``make`` gives, or the JSON file has from this code with these overrides; kept there."""
    made_by = [code_digest(), *overrides]
    if not path.exists() or (kept := json.loads(path.read_text()))["made_by"] != made_by:
        kept = {"made_by": made_by, "of": make()}
        write_text(path, json.dumps(kept) + "\n")
    return kept["of"]


def write_text(path: Path, content: str) -> None:
    """Write a file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def composed(command: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration of a command.

    Raises:
        ValueError: if an override names what does not exist.
    """
    config = checked(command, overrides).config
    del config.hydra
    return config


def features_of_some(
    config: DictConfig,
    cache: Path,
    keep: Callable[[RecordingSource], Sequence[RecordingId]],
) -> Iterator[RecordingFeatures]:
    """The features of some recordings of a set, made by processes and kept.

    Args:
        config: of ``tactslip train``.
        cache: of features.
        keep: which recordings.
    """
    source = instantiate(config.data, _convert_="all")
    maker = feature_maker(source, instantiate(config.labels), **config.features)
    chosen = keep(source)
    with feature_cache(str(cache)) as maker.cache:
        fold = Split("benchmark", dict.fromkeys(chosen, "unseen"))
        data = SlipDataModule(maker, [fold], config.num_workers)
        data.setup()
        yield from data.features("unseen")
