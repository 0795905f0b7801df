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

from tactslip_torch.commands.data import check_manifest
from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.folder import RecordingFolder, Written, write_manifest
from tactslip_torch.data.manifest import MANIFEST
from tactslip_torch.data.recording import Recording, RecordingId, RecordingSource
from tactslip_torch.features.cache import source_digest
from tactslip_torch.report.recordings import signals_figure, written_table
from tactslip_torch.runtime import bar, in_processes, num_processes
from tactslip_torch.signals.filtering import ChannelFilter, frame_lengths

_BEFORE_S, _AFTER_S = 2.0, 3.0  # of the onset drawn close up: five seconds, as in the paper


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
    if type(config.figure) is not bool:
        raise ValueError(f"figure must be true or false, got {config.figure!r}")
    if type(config.seed) is not int:
        raise ValueError(f"seed must be a whole number, got {config.seed!r}")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    made_by = {
        "code": source_digest(),
        "libraries": {"numpy": np.__version__, "torch": torch.__version__},
    }
    files = RecordingFolder(source, folder, config.format, made_by)
    smooth = _filter(config, source)
    files.check()
    check_manifest(folder)
    save_config(config, folder)
    (folder / MANIFEST).unlink(missing_ok=True)  # it must not speak of files that are replaced
    written = list(
        in_processes(files.write, source.ids, "recordings", "recording", config.num_workers)
    )
    write_manifest(folder, written)
    seconds = time.perf_counter() - started
    shown: dict[str, list[RecordingId]] = {}
    for recording in source.ids if config.figure else ():
        if not recording.session and not recording.cycle:
            shown.setdefault(recording.scene, []).append(recording)
    for scene in bar(shown, "figures", "scene") if shown else ():
        _draw(files, shown[scene], smooth, scene)
    print("\n" + written_table([one._asdict() for one in written], seconds))
    print(f"\nrecordings in {folder}")
    return written


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
    title = ", ".join([f"{what}: scene {scene}", *known])
    views = [_close_up(row) for _, row in rows]
    for name, seen in ((f"recordings_{scene}.png", None), (f"onset_{scene}.png", views)):
        signals_figure(rows, hand.to_rows(), files.folder / name, title=title, views=seen)


def _close_up(recording: Recording) -> tuple[float, float]:
    """Around the second onset or the last before; where nothing slips, around such a start."""
    begins = recording.onsets_s or tuple(start for start, _ in recording.non_slip_s)
    if not begins:
        return 0.0, recording.duration_s
    centre_s = begins[:2][-1]
    return max(0.0, centre_s - _BEFORE_S), min(recording.duration_s, centre_s + _AFTER_S)


def _saved(config: DictConfig, folder: Path, again: str) -> str:
    """What a stopped run leaves, and how to go on."""
    place = "" if "hydra.run.dir=" in again else f" hydra.run.dir={folder}"
    return f"the recordings in {folder} are whole; make the others: {again}{place}"


main = entry_point("generate", generate, _saved)
