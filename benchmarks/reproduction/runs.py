"""Runs of ``tactslip_torch.train``, and what is kept of each: counts, from which scores follow."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from benchmarks import ROOT
from tactslip_torch.features.cache import source_digest
from tactslip_torch.runtime import whole_file

GROUPS = ("per_material", "per_speed", "per_scene")
_MADE_BY = "made_by.txt"


def run(name: str, overrides: Sequence[str], folder: Path, cache: Path) -> dict[str, Any]:
    """The metrics of a run, from its folder if this code finished it there, else trained now.

    Args:
        name: for messages.
        overrides: of ``tactslip_torch.train``.
        folder: of its results.
        cache: of features.

    Raises:
        RuntimeError: if the training fails.
    """
    made_by = " ".join([code_digest(), *overrides])
    note = folder / _MADE_BY
    if not note.exists() or note.read_text(encoding="utf-8") != made_by:
        note.unlink(missing_ok=True)
        command = [sys.executable, "-m", "tactslip_torch.train", *overrides]
        command += ["export=false", f"cache={cache}", f"hydra.run.dir={folder}"]
        print(f"{name}: {' '.join(command[1:])}", file=sys.stderr, flush=True)
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)
        if done.returncode:
            raise RuntimeError(f"{name} failed; see above")
        with whole_file(note) as temporary:
            temporary.write_text(made_by, encoding="utf-8")
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return metrics


def code_digest() -> str:
    """Of everything that decides a result: sources, calibrated knobs, configuration."""
    digest = hashlib.sha256(source_digest(ROOT / "tactslip_torch").encode())
    others = [*(ROOT / "tactslip_torch").rglob("*.json"), *(ROOT / "conf").rglob("*.yaml")]
    for path in sorted(others):
        digest.update(path.relative_to(ROOT).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def kept(metrics: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What is kept of a run, JSON-able; of several folds, each, with the scenes trained on.

    Args:
        metrics: as the run left them.
        folder: where it did, with its resolved configuration.
    """
    row: dict[str, Any] = {name: metrics[name] for name in ("simulated", "seed")}
    row["seconds"] = metrics["timing_s"]["total"]
    if "folds" in metrics:
        config = OmegaConf.load(folder / "config.yaml")
        row["trained_scenes"] = list(OmegaConf.select(config, "split.trained_scenes"))
        return row | {"folds": {name: _of_fold(of) for name, of in metrics["folds"].items()}}
    return row | _of_fold(metrics)


def _of_fold(metrics: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "splits": {role: _counts(scores) for role, scores in metrics["splits"].items()},
        "baselines": {
            name: {
                "feature": found.get("feature"),
                "splits": {role: _counts(scores) for role, scores in found["splits"].items()},
            }
            for name, found in metrics["baselines"].items()
        },
        "penalty": metrics["penalty"],
        "validation": max((row["mean"] for row in metrics.get("validation", [])), default=None),
        "selected": metrics["selected"],
        "among": metrics.get("among"),
    }


def _counts(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Confusions of all bins and of groups; right and all bins of every place beside onsets."""
    groups = {
        kind: {label: of["confusion"] for label, of in scores[kind].items()}
        for kind in GROUPS
        if scores.get(kind)
    }
    places = {
        label: [of["num_right"], of["num_bins"]]
        for label, of in scores.get("per_position", {}).items()
    }
    return {"confusion": scores["confusion"], **groups, "per_position": places}
