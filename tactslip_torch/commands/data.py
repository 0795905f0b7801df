"""Sets of recordings in files: ``python -m tactslip_torch data action=check root=FOLDER``.

``check`` lists every problem and everything worth a look, with file and line, and shows what
training would use of each file, and for what; exit status 2 where there is a problem. ``convert
to=h5 output=FOLDER`` writes the set in another format; what was finished before is kept.
``label_template`` writes a manifest to fill in. ``data=authors_raw`` does the first two for the
authors' own files.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import get_object, instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from tactslip_torch.commands.entry import entry_point
from tactslip_torch.commands.stopping import fail, one_line
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.folder import RecordingFolder, Written, write_manifest, write_template
from tactslip_torch.data.labels import LabelledBins, LabelRule, bins_of, whole_samples
from tactslip_torch.data.manifest import MANIFEST, Problem
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.features.sensing import level_message, level_ratio
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import score_stream
from tactslip_torch.report.recordings import use_figure, use_table, written_table
from tactslip_torch.report.style import SIMULATED_LINE
from tactslip_torch.runtime import __version__, in_processes, runs_of
from tactslip_torch.signals.filtering import ChannelFilter, frame_lengths

_SHOWN = 5  # rows of a template, warnings of a kind
_WITH_DIGITS = re.compile(r"\S*\d\S*")  # names and numbers, by which warnings of a kind differ
_LEVELS_S = 30.0  # of a recording, from which levels are taken
_FEWEST = 8  # samples that a bin should have
_CHECK = Path("outputs/check.png")
_MOST_ROWS = 60  # of a table or picture of recordings


def check(config: DictConfig) -> int:
    """Print every problem, some warnings of each kind, and what training would use.

    Returns:
        How many problems there are.

    Raises:
        ValueError: if the set cannot be looked at at all.
        FileNotFoundError: if there is no folder or manifest.
    """
    _check_flags(config)
    if config.output is not None and Path(str(config.output)).suffix.lower() != ".png":
        raise ValueError(f"output of action=check must be a picture, FILE.png, got {config.output}")
    source = _source(config, strict=False)
    problems, warnings = list(source.problems), list(source.warnings)
    if config.samples and source.ids:
        for recording, found in _inspect_all(config, source):
            entry = source.entry(recording)
            if isinstance(found, str):
                problems.append(entry.problem(found))
            else:
                warnings += map(entry.problem, found)
    if config.model is not None and source.ids:
        warnings += _levels(config, source)
    for problem in problems:
        print(f"problem: {problem}")
    is_named = "named_recordings" in config.data._target_
    if is_named and config.data.manifest is None and (source.root / MANIFEST).exists():
        print(f"warning: {MANIFEST} is not read; write manifest: {MANIFEST} under data: to read it")
    alike: dict[str, list[Problem]] = {}
    for warning in warnings:
        alike.setdefault(_WITH_DIGITS.sub("#", warning.what), []).append(warning)
    for several in alike.values():
        for warning in several[:_SHOWN]:
            print(f"warning: {warning}")
        if more := len(several[_SHOWN:]):
            print(f"warning: the same in {more} more recordings")
    if source.ids:
        print(f"channels: {', '.join(source.hand.names)}")
        _show_use(config, source)
    print(_headline(source, problems, warnings))
    return len(problems)


def check_manifest(folder: Path) -> None:
    """Refuse to replace a manifest that this package did not write.

    Raises:
        ValueError: if there is one in the folder.
    """
    path = folder / MANIFEST
    if path.exists() and "fidelity" not in path.read_text(encoding="utf-8").partition("\n")[0]:
        raise ValueError(f"{path} is of recordings of your own; give another folder")


def _check_flags(config: DictConfig) -> None:
    for name in ("samples", "skip_failed"):
        if type(config[name]) is not bool:
            raise ValueError(f"{name} must be true or false, got {config[name]!r}")


def convert(config: DictConfig) -> list[Written]:
    """Write a set in another format; what was written or found finished.

    Raises:
        ValueError: if the set has problems, or a recording cannot be read: what was finished
            before stays.
        FileNotFoundError: if there is no folder or manifest.
    """
    started = time.perf_counter()
    _check_flags(config)
    for name in ("to", "output"):
        if config[name] is None:
            raise ValueError(f"no value for {name}; give to=FORMAT and output=FOLDER")
    source = _source(config, skip_failed=bool(config.skip_failed or config.data.get("skip_failed")))
    output = Path(str(config.output))
    if output.resolve() == source.root.resolve():
        raise ValueError("output must be another folder than root, which stays as it is")
    if output.resolve().is_relative_to(source.root.resolve()):
        raise ValueError("output must not lie in root, whose recordings would be there twice")
    if output.exists() and not output.is_dir():
        raise ValueError(f"output must be a folder, and {output} is a file")
    check_manifest(output)
    made_by = {"made_by": __version__, "units": source.units}
    files = {recording: source.entry(recording).file for recording in source.ids}
    job = RecordingFolder(source, output, str(config.to), made_by, "output", files)
    job.check()

    def one(recording: RecordingId) -> Written | str:
        try:
            return job.write(recording)
        except (ValueError, OSError) as error:
            what = str(source.entry(recording).problem(one_line(error)))
            if config.skip_failed:
                return what
            raise ValueError(
                f"{what}; those that were finished are kept in {job.folder}, skip_failed=true "
                "goes on without this one"
            ) from error

    found = list(in_processes(one, source.ids, "converting", "recording", config.num_workers))
    done = [each for each in found if isinstance(each, Written)]
    failed = [*map(str, source.problems), *(each for each in found if isinstance(each, str))]
    for what in failed:
        print(f"left out: {what}")
    if not done:
        raise ValueError(f"no recording could be converted, first: {failed[0]}")
    write_manifest(job.folder, done)
    print("\n" + written_table([one._asdict() for one in done], time.perf_counter() - started))
    print(f"\nrecordings in {job.folder}")
    return done


def label_template(config: DictConfig) -> Path:
    """Write a manifest of all that can be read in a folder, to be filled in."""
    output = None if config.output is None else Path(str(config.output))
    path, guesses = write_template(Path(str(config.root)), str(config.pattern), output)
    print(f"file, and what pattern={config.pattern} tells of it:")
    for file, fields in list(guesses.items())[:_SHOWN]:
        print(f"  {file}: {', '.join(f'{n}={v}' for n, v in fields.items() if v) or 'nothing'}")
    print(
        f"{path} lists {len(guesses)} recordings, {sum(map(bool, guesses.values()))} of them with "
        "what the pattern tells; fill in onsets_s, sliding_s, slip_s and non_slip_s "
        "(as 2.0; 9.0 and 2-7; 9-11.5) or label (slip, non-slip), then action=check"
    )
    return path


ACTIONS: dict[str, Callable[[DictConfig], object]] = {
    "check": check,
    "convert": convert,
    "label_template": label_template,
}


def _source(config: DictConfig, **options: bool) -> FileRecordings:
    """The set of the ``data`` section, which must be one of files."""
    if getattr(get_object(config.data._target_), "is_simulated", False) is True:
        raise ValueError("data must be a set of files, such as data=files or data=authors_raw")
    source: FileRecordings = instantiate(config.data, _convert_="all", **options)
    return source


def _constant_channels(source: FileRecordings, recording: RecordingId) -> list[str]:
    """A line for each channel whose finite samples are all the same."""
    lines = []
    for row, name in zip(source.load(recording).samples.double(), source.hand.names, strict=True):
        finite = row[row.isfinite()]
        if len(finite) and finite.min() == finite.max():
            lines.append(f"{name} never changes, it is {finite[0]:g} throughout")
    return lines


def _inspect_all(
    config: DictConfig, source: FileRecordings
) -> list[tuple[RecordingId, list[str] | str]]:
    """What is worth a look in every recording's samples, or why they cannot be read."""

    def one(recording: RecordingId) -> list[str] | str:
        try:
            return _constant_channels(source, recording)
        except (ValueError, OSError) as error:
            return one_line(error)

    found = in_processes(one, source.ids, "reading samples", "recording", config.num_workers)
    return list(zip(source.ids, found, strict=True))


# What training would use -------------------------------------------------------------------------


def _show_use(config: DictConfig, source: FileRecordings) -> None:
    """Print what of each file training would use, and draw it."""
    rule: LabelRule = instantiate(config.labels, _convert_="all")
    rate_hz = source.sample_rate_hz
    try:
        num = whole_samples(rule.bin_ms, rate_hz, "labels.bin_ms")
        if rule.hop_ms is not None:
            whole_samples(rule.hop_ms, rate_hz, "labels.hop_ms")
    except ValueError as error:
        print(f"bins: {error}")
        return
    if num < _FEWEST:
        least_ms = math.ceil(1000 * _FEWEST / rate_hz)
        print(
            f"bins: {rule.bin_ms:g} ms are {num:g} samples at {rate_hz:g} Hz, fewer than "
            f"{_FEWEST}; train with labels.bin_ms={least_ms} or more"
        )
    given = config.features.frames
    if not isinstance(given, DictConfig):
        kinds = ", ".join(f"{kind}: null" for kind in source.hand.kinds)
        raise ValueError(f"features.frames must be of kinds, such as {{{kinds}}}, got {given!r}")
    frames = {kind: given.get(kind) for kind in source.hand.kinds}
    smooth = ChannelFilter(
        frame_lengths(source.hand, frames), config.features.polyorder, config.features.align
    )
    before, after = (max(reach) for reach in zip(*smooth.reaches, strict=True))
    rows: list[dict[str, Any]] = []
    for recording in source.ids:
        times = source.timeline(recording)
        try:
            use = _use_of(rule, times, rate_hz, before, after)
        except ValueError as error:
            print(f"bins: {source.entry(recording).problem(one_line(error))}")
            return
        file = source.entry(recording).file
        rows.append({"file": file, "duration_s": times.duration_s, **use})
    print("\n" + use_table(rows, _MOST_ROWS))
    path = _CHECK if config.output is None else Path(str(config.output))
    what = "SIMULATED recordings" if source.is_simulated else "Recordings"
    title = f"{what} in {source.root.resolve().name}: what training would use"
    use_figure(rows[:_MOST_ROWS], len(rows), path, title=title)
    print(f"\npicture in {path}")


def _use_of(
    rule: LabelRule, times: Timeline, rate_hz: float, before: int, after: int
) -> dict[str, Any]:
    """What training would use of a recording, by its labels and what is missing.

    Returns:
        ``num_slip`` and ``num_rest`` bins; ``left_s``, seconds in no bin, by the reason; ``spans``,
        the stretches of each kind in seconds.
    """
    num_samples = round(times.duration_s * rate_hz)
    whole = replace(times, missing_s=())
    one = replace(rule, assign="last", bin_ms=1000 / rate_hz, hop_ms=None)  # sample by sample
    labelled = bins_of(one, whole, rate_hz, 0, 0)
    state = np.full(num_samples, -1)
    state[labelled.starts.numpy()] = labelled.is_slip.numpy()
    is_missing = np.zeros(num_samples, dtype=bool)
    for start_s, end_s in times.missing_s:
        is_missing[round(start_s * rate_hz) : round(end_s * rate_hz)] = True

    def covered(bins: LabelledBins) -> NDArray[np.bool_]:
        is_in = np.zeros(num_samples, dtype=bool)
        is_in[bins.starts.numpy()[:, None] + np.arange(bins.bin_samples)] = True
        return is_in

    bins = bins_of(rule, times, rate_hz, before, after)
    is_used, would_be = covered(bins), covered(bins_of(rule, whole, rate_hz, before, after))
    is_left, is_labelled = ~is_used & ~is_missing, state >= 0
    reasons = {
        "not labelled": is_left & ~is_labelled,
        "missing": is_missing,
        "next to missing": is_left & is_labelled & would_be,
        "no whole bin": is_left & is_labelled & ~would_be,
    }
    kinds = {
        "slip": is_used & (state == 1),
        "slip, left out": is_left & (state == 1),
        "non-slip": is_used & (state == 0),
        "non-slip, left out": is_left & (state == 0),
        "not labelled": ~is_missing & ~is_labelled,
        "missing": is_missing,
    }
    num_slip = int(bins.is_slip.sum())
    return {
        "num_slip": num_slip,
        "num_rest": len(bins.starts) - num_slip,
        "left_s": {reason: int(mask.sum()) / rate_hz for reason, mask in reasons.items()},
        "spans": {kind: (runs_of(mask) / rate_hz).tolist() for kind, mask in kinds.items()},
    }


def _levels(config: DictConfig, source: FileRecordings) -> list[Problem]:
    """Recordings whose levels at rest are far from those that a detector was trained on.

    Raises:
        ValueError: if the detector is of another hand or rate.
    """
    detector = SlipDetector.load(str(config.model))
    pool = detector.pool
    if pool.hand.names != source.hand.names or pool.sample_rate_hz != source.sample_rate_hz:
        raise ValueError(
            f"{config.model} is of {len(pool.hand)} channels {pool.hand.names[0]} to "
            f"{pool.hand.names[-1]} at {pool.sample_rate_hz:g} Hz, {config.root} has "
            f"{len(source.hand)}, {source.hand.names[0]} to {source.hand.names[-1]}, at "
            f"{source.sample_rate_hz:g} Hz; give the detector of this hand"
        )

    def one(recording: RecordingId) -> str:
        samples = source.load(recording).samples[:, : round(_LEVELS_S * pool.sample_rate_hz)]
        found = score_stream(detector, samples, pool.bin_samples)
        return level_message(level_ratio(found.span, detector.sensing), source.units)

    messages = in_processes(one, source.ids, "comparing levels", "recording", config.num_workers)
    return [
        source.entry(recording).problem(text)
        for recording, text in zip(source.ids, messages, strict=True)
        if text
    ]


def _headline(
    source: FileRecordings, problems: Sequence[Problem], warnings: Sequence[Problem]
) -> str:
    """What there is, in a line."""
    counts = f"{_number(problems, 'problem')}, {_number(warnings, 'warning')}"
    if not source.ids:
        return f"no recording can be read: {counts}"
    seconds = sum(source.timeline(recording).duration_s for recording in source.ids)
    materials = list(dict.fromkeys(recording.material for recording in source.ids))
    head = f"{SIMULATED_LINE}\n" if source.is_simulated else ""
    return (
        f"{head}{_number(source.ids, 'recording')} of {_number(materials, 'material')}, "
        f"{seconds:.1f} s, {_number(source.hand.channels, 'channel')} at "
        f"{source.sample_rate_hz:g} Hz in {source.units}: {counts}"
    )


def _number(of: Sequence[object], what: str) -> str:
    return f"{len(of)} {what}{'' if len(of) == 1 else 's'}"


def _act(config: DictConfig, _: Path) -> None:
    """Do what ``action`` says; problems that ``check`` found end in exit status 2."""
    if config.action not in ACTIONS:
        known = ", ".join(ACTIONS)
        raise ValueError(f"action must be one of {known}, got {config.action!r}")
    found = ACTIONS[config.action](config)
    if config.action == "check" and found:
        fail(f"{found} problems in {config.root}, listed above")


main = entry_point("data", _act)
