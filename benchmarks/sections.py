"""The sections of BENCHMARKS.md: which benchmark says what, in their order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import sensors, train, tuning
from benchmarks.abstaining import figure as abstaining_figure
from benchmarks.abstaining import report as abstaining
from benchmarks.adapting import figure as adapting_figure
from benchmarks.adapting import report as adapting
from benchmarks.dead_sensors import figure as dead_sensors_figure
from benchmarks.dead_sensors import report as dead_sensors
from benchmarks.deployment import figure as deployment_figure
from benchmarks.deployment import report as deployment
from benchmarks.features import figure as features_figure
from benchmarks.features import report as features
from benchmarks.features.guards import measure as guards
from benchmarks.formats import figure as formats_figure
from benchmarks.formats import report as formats
from benchmarks.gradients import figure as gradients_figure
from benchmarks.gradients import report as gradients
from benchmarks.latency import figure as latency_figure
from benchmarks.latency import report as latency
from benchmarks.model import measure as model_measure
from benchmarks.model import report as model
from benchmarks.onset import figure as onset_figure
from benchmarks.onset import report as onset
from benchmarks.precision import report as precision
from benchmarks.simulation import figure as simulation_figure
from benchmarks.simulation import report as simulation
from benchmarks.streaming import figure as streaming_figure
from benchmarks.streaming import measure as streaming_measure
from benchmarks.streaming import report as streaming
from benchmarks.tables import Table
from benchmarks.throughput import figure as throughput_figure
from benchmarks.throughput import measure as throughput_measure
from benchmarks.throughput import report as throughput

Report = Mapping[str, Any]


class Section(NamedTuple):
    """A benchmark in the file.

    Attributes:
        title: heads it.
        tables: of its report, by title, the limits first; ``None`` where it prints text alone.
        text: what it prints.
        draw: draws its figure; ``None`` where the benchmark itself leaves one.
        about: a line on what was measured.
        needs: every section of its report.
        keys: what its report has besides ``_KEYS``.
    """

    title: str
    tables: Callable[[Report], Mapping[str, Sequence[Table]]] | None
    text: Callable[[Report], str]
    draw: Callable[[Report, Path], None] | None = None
    about: Callable[[Report], str] | None = None
    needs: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()


SECTIONS = {
    "features": Section(
        "Features",
        features.tables,
        features.report_text,
        features_figure.figure,
        needs=("pool", "roofline", *guards.SECTIONS),
    ),
    "latency": Section(
        "Latency",
        latency.tables,
        latency.report_text,
        latency_figure.figure,
        latency.about,
        needs=("latency",),
    ),
    "throughput": Section(
        "Throughput",
        throughput.tables,
        throughput.report_text,
        throughput_figure.figure,
        throughput.about,
        needs=tuple(throughput_measure.SECTIONS),
    ),
    "streaming": Section(
        "Streams",
        streaming.tables,
        streaming.report_text,
        streaming_figure.figure,
        streaming.about,
        needs=streaming_measure.SECTIONS,
    ),
    "deployment": Section(
        "Deployed: files in onnxruntime",
        deployment.tables,
        deployment.report_text,
        deployment_figure.figure,
        deployment.about,
        needs=deployment.SECTIONS,
    ),
    "onset": Section(
        "Alarms: hops, filters and rivals",
        onset.tables,
        onset.report_text,
        onset_figure.figure,
        onset.about,
        needs=onset.SECTIONS,
    ),
    "formats": Section(
        "Files",
        formats.tables,
        formats.report_text,
        formats_figure.figure,
        formats.about,
        needs=("formats",),
    ),
    "abstaining": Section(
        "Answers that may be unsure",
        abstaining.tables,
        abstaining.report_text,
        abstaining_figure.figure,
        abstaining.about,
        needs=abstaining.SECTIONS,
    ),
    "dead_sensors": Section(
        "Dead sensors",
        dead_sensors.tables,
        dead_sensors.report_text,
        dead_sensors_figure.figure,
        dead_sensors.about,
        needs=dead_sensors.SECTIONS,
    ),
    "adapting": Section(
        "A new material from a few recordings",
        adapting.tables,
        adapting.report_text,
        adapting_figure.figure,
        adapting.about,
        needs=adapting.SECTIONS,
    ),
    "tuning": Section(
        "Tuned by gradient",
        tuning.tables,
        tuning.report_text,
        tuning.figure,
        tuning.about,
        needs=tuning.SECTIONS,
    ),
    "train": Section("Training", None, train.report_text, keys=("experiment", "stages", "wholes")),
    "model": Section(
        "Kernel machine at any size", None, model.report_text, needs=tuple(model_measure.SECTIONS)
    ),
    "gradients": Section(
        "Gradients through the fit",
        gradients.tables,
        gradients.report_text,
        gradients_figure.figure,
        gradients.about,
        needs=("gradients",),
    ),
    "precision": Section(
        "Precision", None, precision.report_text, keys=("variants", "solves", "ratios")
    ),
    "simulation": Section(
        "The simulated hand",
        simulation.tables,
        simulation.report_text,
        simulation_figure.figure,
        simulation.about,
        needs=simulation.SECTIONS,
    ),
    "sensors": Section(
        "Which sensors matter",
        sensors.tables,
        sensors.report_text,
        sensors.figure,
        sensors.about,
        needs=sensors.SECTIONS,
    ),
}
"""By the name of the benchmark and of its file."""
