"""A new material in seconds: ``python -m tactslip_torch adapt model=MODEL recordings=FOLDER``.

Adds recordings to the sums that ``train statistics=true`` left beside a detector, solves again in
closed form, and puts detector and statistics in the place of the old ones if the old materials are
still known; else it writes what they would lose, and the exit status is 2. ``action=forget`` takes
recordings out, ``action=undo`` takes the last step back, bit for bit, ``action=list`` shows them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import entry_point, leave_results, save_config
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.deploy.export import export_detector, stale_graphs
from tactslip_torch.features.cache import versions
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import KEY as ALARM
from tactslip_torch.report.adaptation import adaptation_figure, adaptation_table, journal_table
from tactslip_torch.runtime import check_number, whole_file
from tactslip_torch.training.adaptation import (
    FILE,
    Change,
    RecordingBins,
    Statistics,
    add,
    checked_weight,
    detector_digest,
    forget,
    locked,
    recording_bins,
    refitted,
    solve,
    statistics_of,
)
from tactslip_torch.training.experiment import feature_cache, features_of

FORMAT = "tactslip_torch adaptation 1"


def adapt(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Do one action on a detector and its statistics.

    Args:
        config: composed from ``conf/adapt.yaml``.
        folder: where ``adaptation.json`` and its figure go.

    Returns:
        The content of ``adaptation.json``; of ``action=list`` the journal.

    Raises:
        ValueError: for bad input, or if the old materials would lose too much; detector and
            statistics are kept as they were then.
        FileNotFoundError: if there is no such detector, statistics or folder.
    """
    actions = ("add", "forget", "undo", "list")
    if config.action not in actions:
        raise ValueError(f"action must be one of {', '.join(actions)}, got {config.action!r}")
    model = Path(config.model)
    detector = SlipDetector.load(model)  # says what is amiss before anything is written
    if config.action == "list":
        journal = [dict(step.entry) for step in statistics_of(model, detector).steps]
        print(journal_table(journal))
        return {"steps": journal}
    with locked(model):
        detector = SlipDetector.load(model)  # as nobody else changes it any more
        if config.action == "undo":
            found = _undone(model, detector)
        else:
            found = _stepped(config, folder, detector, statistics_of(model, detector))
    if stale := stale_graphs(model):
        print(
            f"{', '.join(path.name for path in stale)} beside it: of another detector; "
            f"python -m tactslip_torch export model={model} writes anew"
        )
    return found


def _stepped(
    config: DictConfig, folder: Path, detector: SlipDetector, statistics: Statistics
) -> dict[str, Any]:
    """Add or forget, and write what came of it."""
    started = time.perf_counter()
    margin = config.margin
    check_number("margin", margin, least=0)
    if margin >= 1:
        raise ValueError(f"margin must be below 1, such as 0.005 for half a point, got {margin:g}")
    weight = checked_weight(config.weight)
    bins = _bins(config, detector, statistics)
    read = time.perf_counter()
    before = solve(statistics)
    if config.action == "add":
        change = add(statistics, before, bins, weight, margin)
    else:
        change = forget(statistics, before, bins)
    # what is to be taken out goes, whatever that costs
    problem = change.problem(margin) if config.action == "add" else None
    entry = _entry(config, bins, change) | {"forced": problem is not None and bool(config.force)}
    is_accepted = problem is None or bool(config.force)
    solved = time.perf_counter()
    if is_accepted:
        new = refitted(detector, change.statistics, change.solved, entry)
        _write(Path(config.model), new, statistics, change, entry, export=bool(config.export))
    content = {
        "format": FORMAT,
        "simulated": bool(detector.info.get("simulated")),
        "accepted": is_accepted,
        "problem": problem,
        "margin": margin,
        **entry,
        "seconds": {
            "recordings": read - started,
            "solve": solved - read,
            "write": time.perf_counter() - solved,
        },
        "versions": versions(),
    }
    save_config(config, folder)
    leave_results(folder, "adaptation", content, adaptation_figure, adaptation_table(content))
    if not is_accepted:
        raise ValueError(
            f"refused, nothing is changed: {problem}; lower weight, or force=true accepts it"
        )
    print(f"{config.model} and {FILE} beside it are new; action=undo takes it back")
    return content


def _undone(model: Path, detector: SlipDetector) -> dict[str, Any]:
    """Put the detector and the statistics before the last step back in their place."""
    try:
        statistics = statistics_of(model, detector)
    except ValueError:
        statistics = Statistics.load(model.with_name(FILE))
        last = statistics.steps[-1].detector if statistics.steps else None
        if last != detector_digest(detector):  # else writing was cut off behind the statistics
            raise
    back, file = statistics.undo()
    with ExitStack() as files:
        at_statistics = files.enter_context(whole_file(model.with_name(FILE)))
        at_model = files.enter_context(whole_file(model))
        at_model.write_bytes(bytes(file.numpy()))
        back.save(at_statistics)
    entry = dict(statistics.steps[-1].entry)
    print(f"{model} and {FILE} are as before {entry['action']} of {', '.join(entry['materials'])}")
    return {"undone": entry, "left": len(back.steps)}


def _write(
    model: Path,
    new: SlipDetector,
    before: Statistics,
    change: Change,
    entry: Mapping[str, Any],
    *,
    export: bool,
) -> None:
    """Detector, statistics and, if wanted, graphs: all of them or none."""
    file = torch.frombuffer(bytearray(model.read_bytes()), dtype=torch.uint8)
    after = before.with_step(change.statistics, entry, file, detector_digest(new))
    with ExitStack() as files:  # the last takes its place first: it holds the detector before
        at_model = files.enter_context(whole_file(model))
        at_statistics = files.enter_context(whole_file(model.with_name(FILE)))
        new.save(at_model)
        after.save(at_statistics)
        if export:
            kinds = ["bin", "stream"] if ALARM in new.info else ["bin"]
            export_detector(new, model.parent, kinds, source=at_model)  # type: ignore[arg-type]


def _bins(
    config: DictConfig, detector: SlipDetector, statistics: Statistics
) -> dict[str, RecordingBins]:
    """Bins of the recordings that are given or, to forget, of those named."""
    is_new, material = config.action == "add", config.material
    material = None if material is None else str(material)  # 3 is a number to Hydra
    if not is_new and config.recordings is None:
        return _remembered(material, statistics)
    if OmegaConf.is_missing(config.data, "root") or config.data.root is None:
        raise ValueError(
            "no value for recordings; give recordings=FOLDER, a folder with a manifest"
        )
    source: RecordingSource = instantiate(config.data, _convert_="all")
    units, trained = getattr(source, "units", "V"), detector.info.get("units", "V")
    if units != trained:
        raise ValueError(f"recordings are in {units}, the detector was trained on {trained}")
    rule = LabelRule(**statistics.labels)
    with feature_cache(config.cache) as cache:
        return recording_bins(
            detector,
            features_of(detector, source, rule, cache),
            statistics,
            material=material,
            slip_free=bool(config.slip_free),
            is_new=is_new,
        )


def _remembered(material: str | None, statistics: Statistics) -> dict[str, RecordingBins]:
    """Recordings of a material that were added and are in."""
    mine = {
        name: own
        for name, own in statistics.bins.items()
        if own.material == material and statistics.weight_of(name) > 0
    }
    if not mine:
        known = sorted({b.material for n, b in statistics.bins.items() if statistics.weight_of(n)})
        raise ValueError(
            f"action=forget needs material= one that was added ({', '.join(known) or 'none was'}), "
            f"or recordings=FOLDER, got {f'material={material}' if material else 'neither'}"
        )
    return mine


def _entry(config: DictConfig, bins: Mapping[str, RecordingBins], change: Change) -> dict[str, Any]:
    """What the journal says of a step."""
    return {
        "action": str(config.action),
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "materials": sorted({own.material for own in bins.values()}),
        "recordings": sorted(bins),
        "num_bins": sum(len(own.z) for own in bins.values()),
        "slip_free": bool(config.slip_free),
        "weight": change.weight,
        "factor": change.factor,
        "tried": [[factor, fall] for factor, fall in change.tried.items()],
        "old": asdict(change.old),
        "since_training": asdict(change.since_training),
        "new": dict(change.new),
    }


main = entry_point("adapt", adapt)
