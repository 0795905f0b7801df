"""Simulated recordings as files: ``python -m tactslip_torch generate``.

    python -m tactslip_torch generate materials=[M1,M6] cycles=3 hydra.run.dir=recordings

One file per recording, whole or absent, and behind the last of them ``manifest.csv``, which lists
exactly the recordings of this run. In a folder that holds some already, those of the same scene
and code are kept and the others made. Two figures show a recording of each material: whole, and
around an onset as in the paper's signal figure.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.folder import RecordingFolder, Written, write_manifest
from tactslip_torch.data.manifest import MANIFEST
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.features.cache import source_digest
from tactslip_torch.report.recordings import signals_figure, view_around, written_table
from tactslip_torch.runtime import bar, in_processes, num_processes
from tactslip_torch.signals.filtering import ChannelFilter, frame_lengths

BEFORE_S, AFTER_S = 2.0, 3.0  # of the onset drawn close up: five seconds, as in the paper


def generate(config: DictConfig, folder: Path) -> list[Written]:
    """Write the recordings of a configuration, their manifest and figures.

    Args:
        config: composed from ``conf/generate.yaml``.
        folder: where they go.

    Returns:
        What was written or found, in the order of the manifest.

    Raises:
        ValueError: for bad input, in one line; no file is touched then.
    """
    started = time.perf_counter()
    if not isinstance(config.materials, ListConfig):
        raise ValueError(f"materials must be a list such as [M1,M6], got {config.materials!r}")
    num_processes(config.num_workers)  # refused before anything is made
    source: RecordingSource = instantiate(config.data, _convert_="all")
    made_by = {
        "code": source_digest(),
        "libraries": {"numpy": np.__version__, "torch": torch.__version__},
    }
    files = RecordingFolder(source, folder, config.format, made_by)
    shown = _shown(config, source) if config.figure else {}
    smooth = _filter(config, source)
    files.check()
    save_config(config, folder)
    (folder / MANIFEST).unlink(missing_ok=True)  # it must not speak of files that are replaced
    written = list(
        in_processes(files.write, source.ids, "recordings", "recording", config.num_workers)
    )
    write_manifest(folder, written)
    seconds = time.perf_counter() - started
    for scene in bar(shown, "figures", "scene") if shown else ():
        _draw(files, shown[scene], smooth, scene, config.stroke)
    print("\n" + written_table([one._asdict() for one in written], seconds))
    print(f"\nrecordings in {folder}")
    return written


def _shown(config: DictConfig, source: RecordingSource) -> dict[str, list[RecordingId]]:
    """The recordings to draw, by scene: of the first session."""
    first = [recording for recording in source.ids if not recording.session]
    of_cycle = [recording for recording in first if recording.cycle == config.cycle]
    if source.ids and not of_cycle:
        most = max(recording.cycle for recording in source.ids)
        raise ValueError(f"cycle must lie in 0..{most} to be drawn, got {config.cycle}")
    if not (isinstance(config.stroke, int) and config.stroke >= 1):
        raise ValueError(f"stroke counts from 1, got {config.stroke!r}")
    scenes = dict.fromkeys(recording.scene for recording in of_cycle)
    return {scene: [r for r in of_cycle if r.scene == scene] for scene in scenes}


def _filter(config: DictConfig, source: RecordingSource) -> ChannelFilter:
    """The filter of the ``features`` section."""
    features = config.features
    lengths = frame_lengths(source.hand, features.frames)
    return ChannelFilter(lengths, features.polyorder, features.align)


def _draw(
    files: RecordingFolder,
    recordings: Sequence[RecordingId],
    channel_filter: ChannelFilter,
    scene: str,
    stroke: int,
) -> None:
    """Both figures of a scene, from the files."""
    rows = []
    for recording in recordings:
        content, hand, _ = files.load(recording)
        volts = channel_filter(content.samples.double())
        rows.append((recording.material, replace(content, samples=volts)))
    origin = content.provenance
    known = [f"{name} {origin[name]}" for name in ("fidelity", "seed") if name in origin]
    what = "SIMULATED recordings" if origin.get("simulated") else "Recordings"
    title = ", ".join([f"{what}: scene {scene}", f"cycle {recordings[0].cycle}", *known])
    views = [view_around(row, stroke, BEFORE_S, AFTER_S) for _, row in rows]
    for name, seen in ((f"recordings_{scene}.png", None), (f"onset_{scene}.png", views)):
        signals_figure(rows, hand.to_rows(), files.folder / name, title=title, views=seen)


def _saved(config: DictConfig, folder: Path, again: str) -> str:
    """What a stopped run leaves, and how to go on."""
    place = "" if "hydra.run.dir=" in again else f" hydra.run.dir={folder}"
    return f"the recordings in {folder} are whole; make the others: {again}{place}"


main = entry_point("generate", generate, _saved)
