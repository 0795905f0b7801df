"""Whole recordings as streams: which raise an alarm, and one of them through ``detect``.

Each recording is watched by the machine of the fold that left its object out, with an alarm that
was set on nothing (``onset=debounced``). Nobody knows when slip begins in this set, so there are no
delays: an alarm in a recording of slip counts as one, one in stable touch as false.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from benchmarks.real.method import Training
from benchmarks.real.ours import detector_of
from benchmarks.real.windows import Array, Windows
from tactslip_torch.commands.detect import detect
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.splits import Split
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.runtime import bar
from tactslip_torch.training.alarm import DebouncedAlarm
from tactslip_torch.training.recipe import Recipe

HOP_MS = 40.0


def watched(
    windows: Windows,
    folds: Sequence[Split],
    recipe: Recipe,
    rows: Array,
    config: DictConfig,
    folder: Path,
) -> dict[str, Any]:
    """Alarms in all recordings, by scene; JSON-able.

    Args:
        windows: all.
        folds: as every method's.
        recipe: of ours.
        rows: of ``pool_rows``.
        config: of the training, for ``detect``.
        folder: gets ``watched/``: a detector, and what ``detect`` leaves of one recording.

    Returns:
        ``by_scene``: recordings, and those with an alarm; ``hop_ms``, ``k``, ``n``; ``shown``, the
        recording that ``detect`` drew.
    """
    source = windows.maker.source
    assert isinstance(source, FileRecordings)
    alarm = DebouncedAlarm(HOP_MS)
    slips = dict(zip(windows.recording.tolist(), windows.is_slip.tolist(), strict=True))
    counts: dict[str, dict[str, int]] = {}
    shown = ""
    for fold in bar(folds, "watched as streams", "fold"):
        train = windows.of(fold.having("train"))
        every = (rows, windows.is_slip, windows.objects, windows.recording)
        detector = detector_of(windows, recipe, Training(*(part[train] for part in every)))
        alarm(detector)
        for recording in fold.having("unseen"):
            if recording not in windows.recordings:
                continue
            samples = source.load(recording).samples.T
            stream = StreamingDetector(detector, dtype=samples.dtype)
            alarms = len(stream.push(samples).alarms) + len(stream.flush().alarms)
            of = counts.setdefault(recording.scene, {"recordings": 0, "with_alarm": 0})
            of["recordings"] += 1
            of["with_alarm"] += alarms > 0
            if not shown and slips[windows.recordings.index(recording)]:
                shown = source.entry(recording).file
                _through_detect(detector, source.root / shown, config, folder / "watched")
    settings = {"hop_ms": HOP_MS, "k": alarm.k, "n": alarm.n}
    return {"by_scene": counts, "shown": shown, **settings}


def drawn(found: Mapping[str, Any], folder: Path) -> Path:
    """The figure that ``detect`` left."""
    return folder / "watched" / f"{Path(found['shown']).stem}_onsets.png"


def watched_figure(figure: Path) -> Path:
    """Where it is kept, beside the other."""
    return figure.with_name(f"{figure.stem}_watched.png")


def _through_detect(detector: SlipDetector, file: Path, config: DictConfig, folder: Path) -> None:
    """What ``python -m tactslip_torch detect`` does with that file."""
    folder.mkdir(parents=True, exist_ok=True)
    detector.info |= {"simulated": False, "units": config.data.units}
    detector.save(folder / "detector.pt")
    given = {
        "name": "detect",
        "model": str(folder / "detector.pt"),
        "input": str(file),
        "sample_rate_hz": None,
        "reading": OmegaConf.to_container(config.data.reading, resolve=True),
        "tare_s": list(config.data.tare_s) if config.data.tare_s else None,
        "threshold": None,
        "dead": [],
        "engine": "auto",
        "figure": True,
        "view": None,
        "decisions": False,
    }
    detect(OmegaConf.create(given), folder)
