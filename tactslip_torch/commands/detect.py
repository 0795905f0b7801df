"""Onsets of slip in recordings: ``python -m tactslip_torch detect model=detector.pt input=PLACE``.

The place is a file or a folder of what ``data.formats`` knows. Samples are read piece by piece and
pushed through a ``StreamingDetector``, so a recording may be of any length. Leaves
``onsets.json``, ``onsets.csv``, and the figure of a file or, of a folder, an overview. Where a
recording cannot be read the others are done all the same; the exit status is 2 then.
"""

from __future__ import annotations

import hashlib
import logging
import math
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.file_recordings import hand_file
from tactslip_torch.data.folder import file_metadata, recording_files
from tactslip_torch.data.formats import Reading, pieces
from tactslip_torch.data.recording import Recording
from tactslip_torch.features.cache import versions
from tactslip_torch.live.mcap_log import McapLog
from tactslip_torch.live.sinks import Block, Sink
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.prediction import masked_names
from tactslip_torch.onset.decisions import AlarmSettings, Decisions
from tactslip_torch.onset.events import (
    EventRecord,
    EventRules,
    LatencyParts,
    RecordingEvents,
    first_releases,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.report.onset import (
    DecisionCounts,
    OverviewRow,
    Traces,
    alarm_outcome,
    onset_figure,
    onsets_summary,
    onsets_table,
    onsets_title,
    overview_figure,
    view_of,
    write_onsets,
)
from tactslip_torch.report.style import csv_writer
from tactslip_torch.runtime import plain, steps

_LOG = logging.getLogger(__name__)

FORMAT = "tactslip_torch onsets 1"
OVERVIEW = "overview.png"
_PIECE_S = 1.0
_KEPT_EVERY_S = 2.0  # so long what was detected may be in memory only
_MOST_NAMED = 8  # recordings in a message
_TRAINED = "trained"  # of a setting: as in the detector's training
_RULES = EventRules()


@dataclass(frozen=True)
class _DetectionContext:
    """What is the same for every recording; ``drawn`` names those with a figure of their own."""

    detector: SlipDetector
    settings: AlarmSettings
    reading: Reading
    config: DictConfig
    folder: Path
    drawn: frozenset[str]

    @property
    def units(self) -> str:
        return str(self.detector.info.get("units", "V"))

    @property
    def piece_samples(self) -> int:
        return round(_PIECE_S * self.detector.pool.sample_rate_hz)


def detect(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Look for slip in recordings and write what was detected.

    Args:
        config: composed from ``conf/detect.yaml``.
        folder: where results go.

    Returns:
        The content of ``onsets.json``.

    Raises:
        ValueError: for bad input, in one line; if a recording could not be read, behind the
            results of the others.
        FileNotFoundError: if there is no such detector or recording.
    """
    started = time.perf_counter()
    if type(config.mcap) is not bool:
        raise ValueError(
            f"mcap must be true or false, got {config.mcap!r}; files are called as their recordings"
        )
    detector = SlipDetector.load(config.model, backend=config.backend)
    reading = reading_of(config, detector)
    settings = settings_of(config, detector)
    paths = recording_files(Path(str(config.input)))
    stems = [path.stem for path in paths]
    names = [path.stem if stems.count(path.stem) == 1 else path.name for path in paths]
    drawn = _drawn(config.figure, names, paths)
    context = _DetectionContext(detector, settings, reading, config, folder, drawn)
    save_config(config, folder)
    content = _origin(context) | {"events": None, "recordings": [], "failed": []}
    known: list[RecordingEvents] = []
    overview: list[OverviewRow] = []
    kept_s = time.monotonic()
    is_one = len(paths) == 1
    try:
        with steps("onsets", "s of signal" if is_one else "recordings", len(paths)) as bar:
            for path, name in zip(paths, names, strict=True):
                try:
                    entry, events, row = _detect_in(path, name, context, bar if is_one else None)
                except (ValueError, OSError) as error:
                    content["failed"].append({"file": path.name, "error": one_line(error)})
                    continue
                content["recordings"].append(plain(entry))
                content["simulated"] |= entry["simulated"] is True
                known += [events] if events else []
                overview.append(row)
                if time.monotonic() - kept_s > _KEPT_EVERY_S:
                    write_onsets(content, folder)
                    kept_s = time.monotonic()
                if not is_one:
                    bar.update()
    finally:
        if content["recordings"]:  # what is done stays, whatever comes
            content["events"] = pooled_metrics(known) if known else None
            write_onsets(content, folder)
    if content["recordings"]:
        if config.figure != "none" and not is_one:
            of_simulated = bool(detector.info.get("simulated"))
            overview_figure(overview, folder / OVERVIEW, of_simulated=of_simulated)
        print("\n" + onsets_table(content))
        print(f"\n{onsets_summary(content, time.perf_counter() - started)}\nonsets in {folder}")
    if failed := content["failed"]:
        if len(paths) == 1:
            raise ValueError(failed[0]["error"])
        rest = f"the others are in {folder}" if content["recordings"] else "there is no other"
        first = f"{len(failed)} of {len(paths)} recordings failed, first: {failed[0]['error']}"
        raise ValueError(f"{first}; {rest}")
    return content


def _drawn(figure: Any, names: Sequence[str], paths: Sequence[Path]) -> frozenset[str]:
    """The names of the recordings that get a figure of their own.

    Raises:
        ValueError: if ``figure`` is neither ``auto``, ``all``, ``none`` nor a list of recordings.
    """
    of_words = {"auto": names if len(names) == 1 else (), "all": names, "none": ()}
    if isinstance(figure, str) and figure in of_words:
        return frozenset(of_words[figure])
    wanted = plain_section(figure)
    if not isinstance(wanted, list):
        raise ValueError(f"figure must be auto, all, none or a list of names, got {figure!r}")
    called = dict(zip((path.name for path in paths), names, strict=True))
    called |= {name: name for name in names}
    if unknown := [name for name in map(str, wanted) if name not in called]:
        there = ", ".join(names[:_MOST_NAMED]) + ", .." * (len(names) > _MOST_NAMED)
        raise ValueError(f"figure names {unknown[0]!r}, which is no recording; there are {there}")
    return frozenset(called[str(name)] for name in wanted)


def _detect_in(
    path: Path, name: str, context: _DetectionContext, bar: Any = None
) -> tuple[dict[str, Any], RecordingEvents | None, OverviewRow]:
    """One recording, drawn if that is wanted; ``bar`` counts its seconds.

    Returns:
        Its entry, its events where the truth is known, and its row of the overview.
    """
    detector, config, hand = context.detector, context.config, context.detector.pool.hand
    rate, table = detector.pool.sample_rate_hz, context.folder / f"{name}_decisions.csv"
    given = hand_file(path, hand, rate, context.reading, context.units)
    columns = Decisions._fields[:-1]
    written = csv_writer(table, columns) if config.decisions else nullcontext()
    with given as opened, written as write, ExitStack() as stack:
        samples, archived = opened.samples, opened.archived
        entry = file_metadata(path, archived) | {"duration_s": samples.num_samples / rate}
        masked = config.masked_channels or ()
        stream = StreamingDetector(
            detector, context.settings, dtype=samples.dtype, masked_channels=masked
        )
        kinds = [channel.kind for channel in hand.channels]
        view = view_of(config.view, entry["duration_s"])
        traces = Traces(hand.names, rate, stream.hop_s, view, context.units, kinds)
        is_drawn = name in context.drawn
        if bar is not None:
            bar.reset(-(-samples.num_samples // context.piece_samples))
        truth = archived.recording if archived else None
        counts = DecisionCounts(first_releases(truth.onsets_s, truth.released_s) if truth else ())
        logs: list[Sink] = []
        events: list[dict[str, Any]] = []
        if config.mcap:
            mcap = McapLog(
                context.folder / f"{name}.mcap",
                hand,
                rate,
                context.settings,
                recording=truth,
                units=context.units,
                dtype=samples.dtype,
            )
            logs.append(stack.enter_context(mcap))

        def take(decisions: Decisions) -> None:
            of = {column: getattr(decisions, column).numpy() for column in columns}
            score = of["onset_score"]
            of["onset_score"] = np.where(score > NOTHING_YET, score, math.nan)
            alarms = [
                {name: _cell(value) for name, value in asdict(alarm).items()}
                for alarm in decisions.alarms
            ]
            counts.add(of, alarms)
            traces.add_decisions(of)
            for log in logs if len(decisions.number) else ():
                log.decisions(decisions)
            if write:
                lost = [" ".join(decisions.names_lost(i)) for i in range(len(score))]
                named = of | {"channels_lost": np.array(lost, object)}
                write(zip(*(map(_cell, values.tolist()) for values in named.values()), strict=True))
            for event in stream.take_events():
                events.append(event._asdict())
                for log in logs:
                    log.event("hand", event.text)

        for first, piece in enumerate(pieces(samples, context.piece_samples)):
            if is_drawn:
                traces.add_samples(piece.numpy())
            for log in logs:
                log.samples(first * context.piece_samples, Block(piece.T.double().numpy()))
            take(stream.push(piece.T))
            if bar is not None:
                bar.update()
        take(stream.flush())
        if not counts.num_decisions:
            raise ValueError(f"{path} has {samples.num_samples} samples, too few for a decision")
    entry["decisions"] = {"number": counts.num_decisions, "invalid": counts.num_invalid}
    entry["alarms"], entry["truth"], entry["events"], known = counts.alarms, None, events, None
    for event in events:
        _LOG.warning("%s, %.3f s: %s", name, event["time_s"], event["text"])
    if archived and archived.recording.has_truth:
        entry, known = _with_truth(entry, archived.recording, counts, stream)
    if is_drawn:
        title = onsets_title(entry, of_simulated=bool(detector.info.get("simulated")))
        place, onset = context.folder / f"{name}_onsets.png", context.settings.onset
        threshold = None if onset is None else onset.threshold
        onset_figure(traces, entry, place, onset_threshold=threshold, title=title)
    return entry, known, OverviewRow.of(entry, traces)


def _cell(value: Any) -> Any:
    """What stands in a cell or in JSON: nothing for NaN and for a statistic that is none yet."""
    if isinstance(value, tuple):
        return " ".join(value)
    return None if isinstance(value, float) and not value > NOTHING_YET else value


def _with_truth(
    entry: dict[str, Any], truth: Recording, counts: DecisionCounts, stream: StreamingDetector
) -> tuple[dict[str, Any], RecordingEvents]:
    """The entry with what is true of its alarms, and the events."""
    alarms = entry["alarms"]
    ends = [alarm["end_s"] for alarm in alarms]
    watched = EventRecord.of(
        truth,
        recording=entry["file"],
        material=entry["material"],
        scene=entry["scene"],
        duration_s=entry["duration_s"],
        alarms_s=tuple(alarm["alarm_s"] for alarm in alarms),
        onset_estimates_s=tuple(alarm["onset_s"] for alarm in alarms),
        first_positive_s=tuple(counts.first_positive_s),
        alarm_ends_s=tuple(math.inf if end is None else end for end in ends),
    )
    events = recording_events(watched, _RULES, LatencyParts(stream.look_ahead_s, stream.bin_s))
    known = plain(
        {
            "onsets": [onset._asdict() for onset in events.onsets],
            "sliding_s": truth.sliding_s,
            "false_alarms_s": events.false_alarms_s,
            "quiet_s": events.quiet_s,
            **asdict(_RULES),
        }
    )
    alarms = [alarm | alarm_outcome(alarm["alarm_s"], known) for alarm in alarms]
    return entry | {"truth": known, "alarms": alarms}, events


def plain_section(section: Any) -> Any:
    """A section of a configuration in plain Python types; what is none is given back."""
    is_section = OmegaConf.is_config(section)
    return OmegaConf.to_container(section, resolve=True) if is_section else section


def reading_of(config: DictConfig, detector: SlipDetector) -> Reading:
    """How files are read: as in the detector's training, but for what is given.

    Raises:
        ValueError: for a key or value that is none.
    """
    section = plain_section(config.reading)
    if not isinstance(section, dict):
        return Reading.of(section)
    given = {key: value for key, value in section.items() if value != _TRAINED}
    trained = detector.info.get("reading") or {}
    known, wanted = Reading.of(trained), Reading.of(trained | given)
    for key in given if trained else ():
        if getattr(wanted, key) != (was := getattr(known, key)):
            print(f"note: reading.{key}={given[key]}; in training it was {was}", file=sys.stderr)
    return wanted


def settings_of(config: DictConfig, detector: SlipDetector) -> AlarmSettings:
    """The settings in a detector's file, with ``threshold``, if it is given.

    Raises:
        ValueError: if it is no number.
    """
    settings = AlarmSettings.of(detector)
    if config.threshold is None:
        return settings
    if type(config.threshold) not in (int, float) or not math.isfinite(config.threshold):
        raise ValueError(f"threshold must be a finite number, got {config.threshold!r}")
    return settings.at_threshold(float(config.threshold))


def _origin(context: _DetectionContext) -> dict[str, Any]:
    """What was detected with."""
    detector, config = context.detector, context.config
    pool, model = detector.pool, Path(context.config.model)
    origin = {
        "format": FORMAT,
        "simulated": False,
        "detector": {
            "file": model.name,
            "sha256": hashlib.sha256(model.read_bytes()).hexdigest(),
            "trained_on_simulated": detector.info.get("simulated"),
            "look_ahead_s": detector.look_ahead / pool.sample_rate_hz,
            "bin_s": pool.bin_samples / pool.sample_rate_hz,
        },
        "settings": context.settings.to_dict() | {"is_own_threshold": config.threshold is None},
        "masked_channels": list(masked_names(config.masked_channels or (), pool.hand.names)),
        "versions": versions(),
    }
    return dict(plain(origin))


def _saved(config: DictConfig, folder: Path, again: str) -> str:
    """What a stopped run leaves, and how to go on."""
    path = folder / "onsets.json"
    kept = f"{path} has the recordings that were done" if path.exists() else "none is done"
    return f"{kept}; start again: {again}"


main = entry_point("detect", detect, _saved)
