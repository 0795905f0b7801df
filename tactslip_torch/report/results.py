"""What a run leaves behind: ``metrics.json``, figures, and tables in the terminal."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactslip_torch.report.abstaining import answers_figure, answers_table
from tactslip_torch.report.alarm import alarm_figure, alarm_table, scenes_table
from tactslip_torch.report.confound import by_detector, confound_figure, confound_table
from tactslip_torch.report.events import events_figure, events_table, has_events
from tactslip_torch.report.figures import confusion_figure
from tactslip_torch.report.reliability import reliability_figure, reliability_table
from tactslip_torch.report.selected import selected_features_figure
from tactslip_torch.report.tables import (
    materials_table,
    selected_table,
    solve_line,
    splits_table,
    timing_table,
    trained_on_lines,
)
from tactslip_torch.report.tuning import tuning_tables
from tactslip_torch.report.validation import validation_figure, validation_table
from tactslip_torch.runtime import whole_file


def write_results(
    folder: Path, metrics: Mapping[str, Any], selected: Sequence[Mapping[str, str]]
) -> None:
    """Write ``metrics.json`` and the figures of a run into a folder.

    Results on several kinds of scenes also get ``confound.png``, those with events ``events.png``,
    those of a detector that may be unsure ``answers.png``, those that set an alarm ``alarm.png``
    and ``reliability.png``.

    Args:
        folder: made if it is not there.
        metrics: JSON-able, with ``simulated`` and ``splits``.
        selected: one mapping per selected feature, as ``selected_features_figure`` takes them.
    """
    with whole_file(folder / "metrics.json") as temporary:
        temporary.write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n")
    confusion_figure(metrics, folder / "confusion.png")
    simulated = metrics["simulated"]
    if selected:
        selected_features_figure(selected, folder / "selected_features.png", simulated=simulated)
    if by_detector(metrics):
        confound_figure(metrics, folder / "confound.png")
    if has_events(metrics):
        events_figure(metrics, folder / "events.png")
    if metrics.get("answers"):
        answers_figure(metrics, folder / "answers.png")
    if alarm := metrics.get("alarm"):
        alarm_figure(metrics, folder / "alarm.png")
        if alarm["reliability"]:
            reliability_figure(
                alarm["reliability"], folder / "reliability.png", simulated=simulated
            )
    if metrics.get("validation"):
        validation_figure(metrics["validation"], folder / "validation.png", simulated=simulated)


def print_results(metrics: Mapping[str, Any], selected: Sequence[Mapping[str, str]]) -> None:
    """Print the tables of a run."""
    parts = [splits_table(metrics), *trained_on_lines(metrics), materials_table(metrics)]
    if metrics.get("events"):
        parts.append(events_table(metrics))
    if metrics.get("answers"):
        parts.append(answers_table(metrics))
    if alarm := metrics.get("alarm"):
        parts += [alarm_table(metrics), scenes_table(metrics)]
        parts.append(reliability_table(alarm["reliability"], simulated=metrics["simulated"]))
    if by_detector(metrics):
        parts.append(confound_table(metrics))
    if selected:
        parts.append(selected_table(selected))
    if metrics.get("validation"):
        simulated, nested = metrics["simulated"], metrics.get("nested_validation")
        parts.append(validation_table(metrics["validation"], simulated=simulated, nested=nested))
    parts += tuning_tables(metrics)
    if metrics.get("solve"):
        parts.append(solve_line(metrics["solve"]))
    if metrics.get("timing_s"):
        parts.append(timing_table(metrics["timing_s"]))
    print("\n" + "\n\n".join(parts))
