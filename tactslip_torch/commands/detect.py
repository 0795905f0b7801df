"""Onsets of slip in recordings: ``python -m tactslip_torch detect model=detector.pt input=PLACE``.

The place is a file or a folder of what ``data.formats`` knows. Samples are read by stretches
and pushed through a ``StreamingDetector``, so a recording may be of any length. Leaves
``onsets.json``, ``onsets.csv`` and a figure of each recording. Where one cannot be read the others
are done all the same; the exit status is 2 then.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import (
    conf_dir,
    errors_in_one_line,
    fail,
    folder_problem,
    one_line,
    run_entry_point,
)
from tactslip_torch.data.file_recordings import HandFile, hand_file, stream_of
from tactslip_torch.data.folder import file_facts, has_truth, recording_files
from tactslip_torch.data.formats import Reading, open_file, pieces
from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import masked_names
from tactslip_torch.onset.decisions import Decisions, answer_of
from tactslip_torch.onset.events import (
    EventRules,
    LatencyParts,
    RecordingEvents,
    Watched,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.report.onset import (
    DecisionCounts,
    Traces,
    alarm_outcome,
    decisions_file,
    onset_figure,
    onset_rows,
    onsets_summary,
    onsets_table,
    onsets_title,
    plain,
    view_of,
    write_onsets,
)
from tactslip_torch.runtime import bar
from tactslip_torch.training.experiment import save_config, versions

FORMAT = "tactslip_torch onsets 1"
_PIECE_S = 1.0
_RULES = EventRules()


class Listener(NamedTuple):
    """What every recording is listened to with, and where results go."""

    detector: SlipDetector
    settings: AlarmSettings
    config: DictConfig
    folder: Path
    reading: Reading


def detect(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Listen to recordings and write what was heard.

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
    detector = SlipDetector.load(config.model, engine=config.engine)
    listener = Listener(detector, _settings(config, detector), config, folder, _reading(config))
    paths = recording_files(Path(str(config.input)))
    save_config(config, folder)
    content = _origin(listener) | {"events": None, "recordings": [], "failed": []}
    judged: list[RecordingEvents] = []
    total = sum(_num_pieces(path, listener) for path in paths)
    for _ in bar(_hear_all(paths, listener, content, judged), "onsets", "s of signal", total):
        pass
    if content["recordings"]:
        content["events"] = pooled_metrics(judged) if judged else None
        write_onsets(content, folder)
        print("\n" + onsets_table(onset_rows(content), simulated=content["simulated"]))
        print(f"\n{onsets_summary(content, time.perf_counter() - started)}\nonsets in {folder}")
    if failed := content["failed"]:
        if len(paths) == 1:
            raise ValueError(failed[0]["error"])
        kept = f"the others are in {folder}" if content["recordings"] else "there is no other"
        first = f"{len(failed)} of {len(paths)} recordings failed, first: {failed[0]['error']}"
        raise ValueError(f"{first}; {kept}")
    return content


def _hear_all(
    paths: Sequence[Path],
    listener: Listener,
    content: dict[str, Any],
    judged: list[RecordingEvents],
) -> Iterator[None]:
    """Listen to one after the other, a step being a piece; what was heard is written after each."""
    stems = [path.stem for path in paths]
    for path in paths:
        name = path.stem if stems.count(path.stem) == 1 else path.name
        try:
            entry, events = yield from _hear(path, name, listener)
        except (ValueError, OSError) as error:
            content["failed"].append({"file": path.name, "error": one_line(error)})
            continue
        content["recordings"].append(plain(entry))
        content["simulated"] |= entry["simulated"] is True
        judged += [events] if events else []
        write_onsets(content, listener.folder)


def _hear(
    path: Path, name: str, listener: Listener
) -> Generator[None, None, tuple[dict[str, Any], RecordingEvents | None]]:
    """Listen to a recording and draw it: its entry, and its events where the truth is known."""
    detector, settings, config, folder, _ = listener
    table = folder / f"{name}_decisions.csv"
    with (
        _opened(path, listener) as (samples, archived),
        decisions_file(table, (*Decisions._fields, "answer"), wanted=config.decisions) as keep,
    ):
        rate = detector.pool.sample_rate_hz
        entry = file_facts(path, archived) | {"duration_s": samples.num_samples / rate}
        stream = StreamingDetector(
            detector, settings, dtype=samples.dtype, masked_channels=config.masked_channels or ()
        )
        view = view_of(config.view, entry["duration_s"])
        drawn = _drawn(detector.pool.hand)
        traces = Traces(drawn, rate, stream.hop_s, view, units_of(detector))
        tally = DecisionCounts(archived.recording.onsets_s if archived else ())

        def take(decisions: Decisions) -> None:
            parts = decisions._asdict() | {"answer": answer_of(detector, decisions)}
            found = {name: part.numpy() for name, part in parts.items()}
            times, is_valid, is_on = (found[n] for n in ("available_s", "is_valid", "is_on"))
            alarms = [dataclasses.asdict(alarm) for alarm in decisions.alarms]
            tally.add(times, found["llr"], is_valid, is_on, alarms)
            traces.add_decisions(times, found["probability"], is_on, is_valid, found["answer"] < 0)
            keep(zip(*(part.tolist() for part in found.values()), strict=True))

        for piece in pieces(samples, _piece_samples(detector)):
            traces.add_samples(piece.numpy())
            take(stream.push(piece.T))
            yield
        take(stream.flush())
        if not tally.num_decisions:
            raise ValueError(f"{path} has {samples.num_samples} samples, too few for a decision")
    entry["decisions"] = {"number": tally.num_decisions, "invalid": tally.num_invalid}
    entry["alarms"], entry["truth"] = tally.alarms, None
    truth = archived.recording if archived and has_truth(archived.recording) else None
    events = _events(entry, truth, tally, stream) if truth else None
    if config.figure:
        alarms = [(alarm["alarm_s"], alarm["onset_s"]) for alarm in entry["alarms"]]
        onsets, slides = (truth.onsets_s, truth.sliding_s) if truth else ((), ())
        heard = traces.summary(alarms, onsets, slides, is_known=truth is not None)
        title = onsets_title(entry, of_simulated=bool(detector.info.get("simulated")))
        onset_figure(heard, folder / f"{name}_onsets.png", title=title)
    return entry, events


def _events(
    entry: dict[str, Any], truth: Recording, tally: DecisionCounts, stream: StreamingDetector
) -> RecordingEvents:
    """A recording's alarms against its truth; both into its entry."""
    alarms = entry["alarms"]
    ends = [alarm["end_s"] for alarm in alarms]
    watched = Watched(
        recording=entry["file"],
        material=entry["material"],
        scene=entry["scene"],
        duration_s=entry["duration_s"],
        alarms_s=tuple(alarm["alarm_s"] for alarm in alarms),
        onset_estimates_s=tuple(alarm["onset_s"] for alarm in alarms),
        onsets_s=truth.onsets_s,
        sliding_s=truth.sliding_s,
        speeds_mm_s=truth.speeds_mm_s,
        first_positive_s=tuple(tally.first_positive_s),
        alarm_ends_s=tuple(math.inf if end is None else end for end in ends),
    )
    events = recording_events(watched, _RULES, LatencyParts(stream.look_ahead_s, stream.bin_s))
    entry["truth"] = {
        "onsets": [onset._asdict() for onset in events.onsets],
        "sliding_s": [list(slide) for slide in truth.sliding_s],
        "false_alarms_s": list(events.false_alarms_s),
        "quiet_s": events.quiet_s,
        **dataclasses.asdict(_RULES),
    }
    entry["alarms"] = [alarm | alarm_outcome(alarm["alarm_s"], entry["truth"]) for alarm in alarms]
    return events


def _settings(config: DictConfig, detector: SlipDetector) -> AlarmSettings:
    settings = AlarmSettings.of(detector)
    if config.threshold is None:
        return settings
    if type(config.threshold) not in (int, float) or not math.isfinite(config.threshold):
        raise ValueError(f"threshold must be a finite number, got {config.threshold!r}")
    return dataclasses.replace(settings, threshold=float(config.threshold))


def _opened(path: Path, listener: Listener) -> AbstractContextManager[HandFile]:
    """A recording of the detector's hand, open."""
    pool, config = listener.detector.pool, listener.config
    units = units_of(listener.detector)
    return hand_file(path, pool.hand, pool.sample_rate_hz, listener.reading, units, config.tare_s)


def units_of(detector: SlipDetector) -> str:
    """Of the samples that a detector was trained on."""
    return str(detector.info.get("units", "V"))


def _drawn(hand: HandLayout) -> dict[str, int]:
    """The rows of its films, of a hand without any all rows, by name."""
    return {hand.names[i]: i for i in hand.fast or range(len(hand))}


def _piece_samples(detector: SlipDetector) -> int:
    return round(_PIECE_S * detector.pool.sample_rate_hz)


def _num_pieces(path: Path, listener: Listener) -> int:
    """For the bar; of a file that cannot be read, as will be said, none."""
    try:
        with open_file(path, listener.reading) as opened:
            return -(-opened.samples.num_samples // _piece_samples(listener.detector))
    except (ValueError, OSError):
        return 0


def _reading(config: DictConfig) -> Reading:
    """What is said of files that do not say it."""
    said = config.reading
    plain_said = OmegaConf.to_container(said, resolve=True) if OmegaConf.is_config(said) else said
    return stream_of({"reading": plain_said}).reading


def _origin(listener: Listener) -> dict[str, Any]:
    """What was listened with."""
    detector, settings, config, _, _ = listener
    pool, rate = detector.pool, detector.pool.sample_rate_hz
    facts = {
        "format": FORMAT,
        "simulated": False,
        "detector": {
            "file": Path(config.model).name,
            "sha256": hashlib.sha256(Path(config.model).read_bytes()).hexdigest(),
            "trained_on_simulated": detector.info.get("simulated"),
            "look_ahead_s": detector.look_ahead / rate,
            "bin_s": pool.bin_samples / rate,
        },
        "settings": settings.to_dict() | {"is_own_threshold": config.threshold is None},
        "masked_channels": list(masked_names(config.masked_channels or (), pool.hand.names)),
        "versions": versions(),
    }
    return dict(plain(facts))


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="detect")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        detect(config, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    if problem := folder_problem(sys.argv[1:]):
        fail(problem)
    run_entry_point(main)
