"""What a folder of recordings is: its channels, rate, labels and groups, each with the reason.

``look`` reads some of the files, ``propose`` decides. What neither tells is a ``Question``; a
person's answers go in as ``Answers``. Nothing is written here.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import detrend

from tactslip_torch.data.clock import even_clock, nominal_rate
from tactslip_torch.data.file_names import name_pattern, word_choices
from tactslip_torch.data.folder import guessed, interval_rows, recording_files
from tactslip_torch.data.formats import Reading, find_format, open_file
from tactslip_torch.data.formats._inference import (
    NUMBER,
    SECONDS,
    TimeUnit,
    is_time,
    no_channels,
    number_in,
    seconds_and_nanoseconds,
    text_layout,
    time_unit_in,
    without_comment,
)
from tactslip_torch.data.formats._reading import FORM
from tactslip_torch.data.formats._text import _opened_text
from tactslip_torch.data.labels import label_of
from tactslip_torch.data.manifest import MANIFEST, Entry, read_manifest
from tactslip_torch.signals.wavelet import highest_level

_Numbers = NDArray[np.float64]
_MOST_FILES = 24  # that are read
_MOST_BYTES = 200e6  # of files that are read, beside the first three
_HEAD = 2**16  # characters that show the layout of a text
_SAME_RATE = 0.01  # rates of files that differ by less are one
_SAME_STEP = 0.05  # between mean and median step
_EDGE_HZ, _SLOWEST_HZ = 5.0, 50.0
_CLEARLY = 0.75  # of the variance on one side: channels of one name that disagree are two kinds
_BIN_S, _LEAST_BIN, _MOST_BIN = 0.05, 32, 1024
_FRAMES_S: Mapping[str, float] = {"slow": 0.0255, "fast": 0.0055}
_LEAST_FRAME = 5
_MOST_STATES = 12  # different numbers of a column of labels; more are a speed or the like
_MOST_TOLD = 5
_FOLDS, _FEWEST_GROUPS = 10, 3
_SLIP_NAMES = re.compile(r"slip|slid", re.IGNORECASE)
_LABEL_NAMES = re.compile(
    r"label|state|class|target|annotation|truth|event|contact|grasp|phase", re.IGNORECASE
)
_SPEED_UNITS = {"mm_s": "mm/s", "cm_s": "cm/s", "um_s": "um/s", "m_s": "m/s"}
_UNIT_IN_NAME = re.compile(r"[(\[]\s*([^()\[\]]+?)\s*[)\]]\s*$")


@dataclass(frozen=True)
class Answers:
    """What a person says of a set; ``None`` where it is to be found.

    Args:
        rate_hz: samples a second.
        units: of the samples.
        time: the column of times.
        time_unit: of them.
        pattern: of the names of files, as ``folder.guessed`` reads it.
        column: that has a label for each sample; ``"none"``: no column has.
        over: slip is where that column is above it.
        words: of names, folders or the column, and whether each is slip; where words of one side
            alone are given, all others that are not known are the other.
    """

    rate_hz: float | None = None
    units: str | None = None
    time: str | None = None
    time_unit: TimeUnit | None = None
    pattern: str | None = None
    column: str | None = None
    over: float | None = None
    words: Mapping[str, bool] = field(default_factory=dict)


class Question(NamedTuple):
    """What a set does not tell.

    Args:
        name: the field of ``Answers`` that answers it.
        text: what is asked, with what is known.
        flag: of the command ``setup`` that answers it.
        default: what is likely, if anything is.
    """

    name: str
    text: str
    flag: str
    default: str = ""


class _Finding(NamedTuple):
    """What was found, and why it is taken to be so."""

    what: str
    value: str
    reason: str


@dataclass
class Proposal:
    """How a set is read, labelled and split.

    Args:
        settings: sections ``data``, ``labels``, ``features`` and ``split`` of a configuration.
        reasons: of settings, by their keys, such as ``"labels.bin_ms"``.
        findings: for people, in order.
        questions: that are open; the first must be answered before more can be found.
        manifest: rows of a manifest that is to be written, where a table of intervals was found.
        example: a recording that shows what is labelled.
    """

    settings: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {name: {} for name in ("data", "labels", "features", "split")}
    )
    reasons: dict[str, str] = field(default_factory=dict)
    findings: list[_Finding] = field(default_factory=list)
    questions: list[Question] = field(default_factory=list)
    manifest: list[dict[str, str]] = field(default_factory=list)
    example: str = ""

    def set(self, key: str, value: Any, reason: str) -> None:
        """A setting, such as ``labels.bin_ms`` or ``data.reading.time``."""
        section, *inner, last = key.split(".")
        place = self.settings[section]
        for name in inner:
            place = place.setdefault(name, {})
        place[last] = value
        self.reasons[key] = reason

    def tell(self, what: str, value: str, reason: str) -> None:
        """A finding."""
        self.findings.append(_Finding(what, value, reason))

    def ask(self, name: str, text: str, flag: str, default: str = "") -> None:
        """A question."""
        self.questions.append(Question(name, text, flag, default))


# Looking ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Table:
    """A file that was read.

    Args:
        file: relative to the folder.
        names: of its columns but the times, by what ``Reading.channels`` takes.
        samples: of the columns of numbers, by name, ``[T]`` each.
        words: cells of the columns that hold words, by name.
        times_s: of the samples, if the file has any.
        time: the column of them.
        time_unit: of them.
        rate_hz: that the file states.
        delimiter: of a text.
        is_native: whether this package wrote it.
        row_number: what is called a time and counts the rows, in words; ``""``: nothing.
    """

    file: str
    names: tuple[str | int, ...]
    samples: Mapping[str | int, _Numbers]
    words: Mapping[str | int, Sequence[str]] = field(default_factory=dict)
    times_s: _Numbers | None = None
    time: str | int | None = None
    time_unit: TimeUnit | None = None
    rate_hz: float | None = None
    delimiter: str | None = None
    is_native: bool = False
    row_number: str = ""

    @property
    def own_rate_hz(self) -> float | None:
        """As the file states it, or by the median step of its times."""
        if self.times_s is None or len(self.times_s) < 2:
            return self.rate_hz
        step_s = float(np.median(np.diff(self.times_s)))
        return 1 / step_s if step_s > 0 else None


@dataclass(frozen=True)
class Look:
    """The files of a folder, and what some of them hold.

    Args:
        folder: the set.
        files: all of them, relative to it, but for those that were read and are not like others.
        tables: those that were read.
        problems: by file, why it is not like the others.
        table_of_intervals: the file that says when slip is, ``""`` if there is none.
        intervals: its rows.
    """

    folder: Path
    files: tuple[str, ...]
    tables: tuple[_Table, ...]
    problems: Mapping[str, str]
    table_of_intervals: str
    intervals: Sequence[Mapping[str, str]]


def look(folder: Path, answers: Answers | None = None) -> Look:
    """Read some of the recordings of a folder and of its folders, evenly chosen, at most 24.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if it holds no recording, or none that can be read.
    """
    if folder.is_file():
        raise ValueError(f"{folder} is a file; give the folder that holds it")
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder at {folder}")
    paths = sorted(recording_files(folder, in_folders=True))
    name, intervals = _intervals(folder, paths)
    tables: list[_Table] = []
    problems: dict[str, str] = {}
    num_bytes = 0
    places = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _MOST_FILES)).astype(int))
    for place in places:
        path = paths[place]
        num_bytes += path.stat().st_size if path.is_file() else 0
        if len(tables) >= _FEWEST_GROUPS and num_bytes > _MOST_BYTES:
            break
        try:
            tables.append(_table_of(folder, path, answers or Answers()))
        except (ValueError, OSError) as error:
            file = path.relative_to(folder).as_posix()
            problems[file] = str(error).removeprefix(str(path)).lstrip(": ")
    if not tables:
        raise ValueError(f"{paths[0]} {next(iter(problems.values()))}")
    short = [t for t in tables if t.times_s is not None and len(t.times_s) < 3]
    if len(short) < len(tables):  # they tell nothing of the clock
        problems |= {t.file: "has fewer than 3 rows" for t in short}
        tables = [t for t in tables if t.file not in problems]
    common = Counter(table.names for table in tables).most_common(1)[0][0]
    alike = tuple(table for table in tables if table.names == common)
    unlike = {t.file: _wrong_cell(t, alike[0]) for t in tables if t.names != common}
    apart = problems.keys() | {file for file, cell in unlike.items() if not cell}
    problems |= {file: cell or "has other columns" for file, cell in unlike.items()}
    files = [path.relative_to(folder).as_posix() for path in paths]
    files = [file for file in files if file not in apart]
    return Look(folder, tuple(files), alike, problems, name, intervals)


def _wrong_cell(table: _Table, other: _Table) -> str:
    """What to say of a word in a column that holds numbers elsewhere; else ``""``."""
    column = next((name for name in table.words if name in other.samples), None)
    if column is None or {*table.names} != {*other.names}:
        return ""
    cells = (cell for cell in table.words[column] if not NUMBER.fullmatch(cell.replace(",", ".")))
    return f"has {next(filter(None, cells))!r} in column {column}; mend it"


def _table_of(folder: Path, path: Path, answers: Answers) -> _Table:
    """What a file holds; of a text all columns, of others what is taken for channels or labels."""
    words: dict[str | int, Sequence[str]] = {}
    delimiter = None
    how = Reading(time=answers.time or "auto", time_unit=answers.time_unit)
    form = find_format(path)
    is_text = form is not None and form.name == "text"
    if is_text and not _is_of_package(path):
        names, cells, delimiter = _cells(path)
        words = {
            name: column
            for name, column in zip(names, cells, strict=True)
            if any(cell and not NUMBER.fullmatch(cell.replace(",", ".")) for cell in set(column))
        }
        texts = list(map(str, names))
        of_time = {names[place] for place in seconds_and_nanoseconds(texts) or ()}
        of_time |= {name for name in words if is_time(str(name))}  # dates
        numbers = [name for name in names if name not in {*words, *of_time}]
        words = {name: column for name, column in words.items() if name not in of_time}
        how = replace(how, channels=numbers)
        if names[0] == 0:  # without names
            how = replace(how, time=answers.time)
    with ExitStack() as stack:
        opened = stack.enter_context(open_file(path, how))
        if opened.archived is None and not is_text and opened.left_out and opened.names:
            labels = [n for n in opened.left_out if _SLIP_NAMES.search(n) or _LABEL_NAMES.search(n)]
            wider = replace(how, channels=(*opened.names, *labels))
            opened = stack.enter_context(open_file(path, wider))
        own, times, unit = opened.archived, opened.times(), opened.time_unit
        values = opened.samples.read(0, opened.samples.num_samples).double().numpy()
        channels = own.hand.names if own else opened.names or range(len(values))
        rate_hz = own.recording.sample_rate_hz if own else opened.sample_rate_hz
    samples: dict[str | int, _Numbers] = dict(zip(channels, values, strict=True))
    time: str | int | None = answers.time
    if time not in samples:
        time = next((name for name in samples if isinstance(name, str) and is_time(name)), None)
    row_number = ""
    if times is not None and unit is None and len(times) > 2 and (np.diff(times) == 1).all():
        row_number, times = "the times" if time is None else f"column {time}", None
    if time is not None:
        samples.pop(time)
        is_told = answers.time_unit is not None or time_unit_in(str(time)) is not None
        if times is not None and unit in (None, "s") and not is_told and _steps_are_ms(times):
            times, unit = times * SECONDS["ms"], "ms"
    elif times is None and rate_hz is None and own is None:
        time, unit = _times_by_values(samples)
        if time is not None and unit is not None:
            times = samples.pop(time) * SECONDS[unit]
    file, kept = path.relative_to(folder).as_posix(), (*samples, *words)
    is_native = own is not None
    return _Table(
        file,
        kept,
        samples,
        words,
        times,
        time,
        unit,
        rate_hz,
        delimiter,
        is_native,
        row_number,
    )


def _steps_are_ms(times: _Numbers) -> bool:
    """Whether times without a unit have steps of 1 or more, and are no numbers of rows."""
    steps = np.diff(times)
    return len(steps) > 0 and float(np.median(steps)) >= 1 and not (steps == 1).all()


def _is_of_package(path: Path) -> bool:
    """Whether a text begins as those that this package writes."""
    mark = f"# {FORM[:-1]}".encode()
    with path.open("rb") as file:
        return file.read(len(mark)) == mark


def _cells(path: Path) -> tuple[list[str | int], list[list[str]], str]:
    """Names, columns of cells and the delimiter of a text table."""
    with _opened_text(path) as text:
        head = text.read(_HEAD)
        layout = text_layout(head.rpartition("\n")[0] if len(head) == _HEAD else head)
        text.seek(0)
        lines = text.read().split("\n")[layout.first_line - 1 :]
    lines = [without_comment(line) for line in lines if line.strip()]
    if layout.delimiter == " ":
        rows = [line.split() for line in lines]
    else:
        rows = list(csv.reader(lines, delimiter=layout.delimiter, skipinitialspace=True))
    rows = [row[: layout.num_columns] for row in rows if len(row) >= layout.num_columns]
    columns = [list(map(str.strip, column)) for column in zip(*rows, strict=True)]
    return list(layout.names or range(layout.num_columns)), columns, layout.delimiter


def _times_by_values(
    samples: Mapping[str | int, _Numbers],
) -> tuple[str | int | None, TimeUnit | None]:
    """The first column that rises at nearly even steps, and the unit its name or size tells."""
    for name, values in samples.items():
        steps = np.diff(values)
        if len(steps) < 8 or not (steps > 0).all() or (steps == 1).all():
            continue
        if np.quantile(steps, 0.9) > 3 * np.median(steps):
            continue
        ending = re.split(r"[\W_]+", str(name).strip("()[] "))[-1]
        unit = time_unit_in(f"t_{ending}")
        return name, unit or ("s" if np.median(steps) < 1 else "ms")
    return None, None


# Tables of intervals ------------------------------------------------------------------------------


def _intervals(folder: Path, paths: Sequence[Path]) -> tuple[str, list[Mapping[str, str]]]:
    """The table of intervals of a folder, and its rows with times in seconds.

    Raises:
        ValueError: if a time is no number, or starts are of another unit than ends.
    """
    name, rows = interval_rows(folder, paths)
    table: list[Mapping[str, str]] = []
    for row in rows:
        if row["unit"] not in ("s", "ms"):
            raise ValueError(f"{folder / name}: times are in {row['unit']}; give all in one unit")
        times = {}
        for end in ("start", "end"):
            cell = row[end].replace(",", ".")
            seconds = number_in(cell) if NUMBER.fullmatch(cell) else math.nan
            if not math.isfinite(seconds):
                raise ValueError(
                    f"{folder / name}: line {row['line']}: {end} {row[end][:40]!r} is no number; "
                    "give seconds, or name the columns start_ms and end_ms"
                )
            times[end] = f"{seconds * (1e-3 if row['unit'] == 'ms' else 1.0):.10g}"
        table.append({**row, **times})
    return name, table


def _check_intervals(table: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Raise ValueError if one ends before it starts, or two of a file overlap."""
    latest: dict[str, Mapping[str, str]] = {}
    for row in sorted(rows, key=lambda one: float(one["start"])):
        if float(row["end"]) <= float(row["start"]):
            raise ValueError(
                f"{table}: line {row['line']}: the end, {row['end']} s, is not after the start, "
                f"{row['start']} s; correct the line"
            )
        before = latest.get(row["file"])
        if before is not None and float(row["start"]) < float(before["end"]):
            lines = " and ".join(sorted((before["line"], row["line"]), key=int))
            raise ValueError(
                f"{table}: lines {lines} overlap, of {row['file']}; give intervals one after the "
                "other"
            )
        latest[row["file"]] = row


def _manifest_rows(
    rows: Sequence[Mapping[str, str]], fields: Mapping[str, Mapping[str, str]]
) -> list[dict[str, str]]:
    """Rows of a manifest: of each file its intervals; what lies between slips is non-slip.

    If intervals of non-slip are given as well, what lies between is not labelled. The start of a
    slip is an onset where non-slip ends. Files without an interval have no label.
    """
    spans_of: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        spans_of[row["file"], row["label"]].append((float(row["start"]), float(row["end"])))
    has_both = {row["label"] for row in rows} == {"slip", "non-slip"}
    found = []
    for file, known in fields.items():
        slips, rest = sorted(spans_of[file, "slip"]), sorted(spans_of[file, "non-slip"])
        if slips and not has_both:
            rest = _between(slips)
        starts = {end for _, end in rest}
        sliding = [span for span in slips if span[0] in starts]  # the others began unseen
        slip = [span for span in slips if span not in sliding]
        unknown = _between([*slips, *rest]) if sliding else []  # else a second before is non-slip
        spans = {"sliding_s": sliding, "slip_s": slip, "non_slip_s": rest, "unlabelled_s": unknown}
        texts = {name: "; ".join(map(_span_text, each)) for name, each in spans.items()}
        columns = {name: known.get(name, "") for name in ("material", "trial", "scene", "session")}
        found.append({"file": file, **columns, **texts})
    return found


def _between(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """What lies before, between and behind spans."""
    edges = [0.0, *(edge for span in sorted(spans) for edge in span), math.inf]
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [(start, end) for start, end in pairs if start < end]


def _span_text(span: tuple[float, float]) -> str:
    start, end = span
    return f"{start:.10g}-{'end' if end == math.inf else format(end, '.10g')}"


# Proposing ----------------------------------------------------------------------------------------


def propose(found: Look, answers: Answers | None = None) -> Proposal:
    """How a set is read, labelled and split, and what a person must say of it.

    Args:
        found: the set.
        answers: what a person has said so far.
    """
    given, draft = answers or Answers(), Proposal()
    first = found.tables[0]
    endings = Counter(Path(file).suffix for file in found.files)
    reason = f"{len(found.tables)} of them were read"
    draft.tell("recordings", f"{len(found.files)} ({', '.join(endings)})", reason)
    for file, problem in list(found.problems.items())[:_MOST_TOLD]:
        draft.tell("look", f"{file} {problem}", "move it away if it is no recording")
    rate_hz = _propose_rate(found, given, draft)
    label = _label_column(found, given)
    channels = _channels(found, label, draft)
    if not channels:
        raise ValueError(
            f"{found.folder}: no column of {first.file} can be a channel; it has "
            f"{', '.join(map(str, first.names))}"
        )
    _propose_gaps(found, channels, draft)
    kinds = _propose_kinds(found, channels, rate_hz, draft)
    _propose_units(channels, given, draft)
    if rate_hz:
        _propose_bins(kinds, rate_hz, draft)
    classes = _propose_labels_and_groups(found, label, given, draft)
    draft.example = max(classes, key=lambda file: len(classes[file]), default=first.file)
    return draft


# Rate and times -----------------------------------------------------------------------------------


def _propose_rate(found: Look, given: Answers, draft: Proposal) -> float:
    """The rate as recordings will be read; 0 if it must be asked."""
    table, reading = found.tables[0], "data.reading"
    if all(one.is_native for one in found.tables):
        rate_hz = float(table.rate_hz or 0.0)
        draft.tell("rate", f"{rate_hz:g} Hz", "the files say it")
        return rate_hz
    rates, gaps, wrong = [], 0, ""
    for one in found.tables:
        if one.times_s is None:
            rates += [one.rate_hz] if one.rate_hz else []
            continue
        try:
            clock = even_clock(one.times_s, None, one.file)
            rates.append(clock.sample_rate_hz)
            gaps += sum(gap.missing for gap in clock.gaps)
        except ValueError as error:
            wrong = wrong or str(error)
    if table.delimiter not in (None, ","):
        draft.set(f"{reading}.delimiter", table.delimiter, "between the columns of the files")
    has_times = table.times_s is not None and not wrong
    if has_times and table.time is not None:
        name = table.time
        draft.set(f"{reading}.time", name, "the column of times")
        if table.time_unit is not None:
            draft.set(f"{reading}.time_unit", table.time_unit, "of the times")
        unit = f" in {table.time_unit}" if table.time_unit else ""
        how = "stated" if given.time else "by its name" if is_time(str(name)) else "it rises evenly"
        draft.tell("time", f"column {name}{unit}", how)
    if not has_times:
        no_times = "the files have no times"
        if table.row_number:
            no_times = f"{table.row_number} counts rows, by 1; if in seconds, add --time-unit s"
        if wrong or table.row_number or not table.rate_hz:
            why = "the times are uneven; samples are taken as even"
            draft.set(f"{reading}.time", None, why if wrong else no_times)
        rate_hz = given.rate_hz or (rates[0] if rates and not wrong else 0.0)
        if not rate_hz:
            default, told = _likely_rate(found.tables)
            why = f"the times are uneven ({wrong})" if wrong else no_times
            text = f"How many samples a second does each channel have? ({why}{told})"
            draft.ask("rate_hz", text, "--rate HZ", default)
            return 0.0
        reason = "stated" if given.rate_hz else "the files say it"
        draft.set(f"{reading}.sample_rate_hz", rate_hz, reason)
        draft.tell("rate", f"{rate_hz:g} Hz", reason)
        return rate_hz
    common = float(np.median(rates))
    off = max(abs(rate / common - 1) for rate in rates)
    rate_hz = given.rate_hz or nominal_rate(common, min(max(off, 1e-4), _SAME_RATE))
    if max(abs(rate_hz / rate - 1) for rate in rates) > _SAME_RATE:  # train refuses such files
        each = sorted({nominal_rate(rate, _SAME_RATE) for rate in rates})
        rate_hz = given.rate_hz or each[-1]
        shown = ", ".join(f"{rate:g}" for rate in each)
        which = "the one stated" if given.rate_hz else "the highest"
        reason = f"the files have {shown} Hz: all are resampled to {which}"
        draft.set(f"{reading}.resample_hz", rate_hz, reason)
    else:
        reason = "by the times"
        draft.set(f"{reading}.sample_rate_hz", rate_hz, reason)
    missing = f"; {gaps} rows are missing in the files that were read" if gaps else ""
    draft.tell("rate", f"{rate_hz:g} Hz", reason + missing)
    return rate_hz


def _likely_rate(tables: Sequence[_Table]) -> tuple[str, str]:
    """The rate of files without even times, or ``""`` and how mean and median steps differ."""
    own = []
    for one in tables:
        rate_hz = one.own_rate_hz
        if not rate_hz:
            continue
        own.append(rate_hz)
        times = one.times_s
        if times is None or times[-1] <= times[0] or (np.diff(times) < 0).any():
            continue
        mean_hz = (len(times) - 1) / float(times[-1] - times[0])
        if abs(mean_hz / rate_hz - 1) > _SAME_STEP:
            mean, median = f"{mean_hz:.4g} Hz in the mean", f"{rate_hz:.4g} Hz by its median step"
            return "", f"; {one.file} has {mean}, {median}"
    return (f"{nominal_rate(float(np.median(own)), _SAME_RATE):g}" if own else ""), ""


def _propose_gaps(found: Look, channels: Sequence[str | int], draft: Proposal) -> None:
    """What is done where samples are missing."""
    if found.tables[0].is_native:
        return
    num = sum(int((~np.isfinite(t.samples[name])).sum()) for t in found.tables for name in channels)
    what = "bins that would need missing samples are left out"
    draft.set("data.reading.gaps", "missing", what)
    if num:
        draft.tell("empty cells", f"{num}", f"in the files that were read; {what}")


# Columns ------------------------------------------------------------------------------------------


class _Label(NamedTuple):
    """The column of labels: its different values, words or numbers, and why it is one."""

    name: str | int
    words: tuple[str, ...]
    numbers: tuple[float, ...]
    reason: str


def _label_column(found: Look, given: Answers) -> _Label | None:
    """The column that says of each sample whether it is slip, if one does."""
    names = found.tables[0].names
    if given.column == "none":
        return None
    if given.column is not None:
        wanted: str | int = int(given.column) if given.column.isdecimal() else given.column
        if wanted not in names:
            raise ValueError(
                f"{found.tables[0].file} has no column {given.column!r}; it has "
                f"{', '.join(map(str, names))}"
            )
        return _label_values(found, wanted, "stated")
    candidates = []
    for name in names:
        label = _label_values(found, name, "by its name")
        points = 2 * bool(_SLIP_NAMES.search(str(name))) + bool(_LABEL_NAMES.search(str(name)))
        num = len(label.words) or len(label.numbers)
        is_told = all(map(label_of, label.words)) if label.words else num == 2
        if num < 2:
            continue
        if not points and is_told:
            what = "words of slip and non-slip" if label.words else "two values"
            points, label = 1, label._replace(reason=f"it holds {what}")
        if points and (num <= _MOST_STATES or _SLIP_NAMES.search(str(name))):
            candidates.append((points + is_told / 2, label))
    return max(candidates, key=lambda one: one[0])[1] if candidates else None


def _label_values(found: Look, name: str | int, reason: str) -> _Label:
    words: set[str] = set()
    numbers: set[float] = set()
    for table in found.tables:
        if name in table.words:
            words.update(filter(None, table.words[name]))
        elif name in table.samples:
            values = table.samples[name]
            numbers.update(np.unique(values[np.isfinite(values)]).tolist())
    if words:
        numbers = set()
    return _Label(name, tuple(sorted(words)), tuple(sorted(numbers)), reason)


def _channels(found: Look, label: _Label | None, draft: Proposal) -> list[str | int]:
    """The columns that are channels; those that are not are told, each with its reason."""
    table = found.tables[0]
    if table.is_native:
        return list(table.samples)
    names = list(map(str, table.names))
    beside = {table.names[place] for place in no_channels(names)}
    left: dict[str | int, str] = dict.fromkeys(table.words, "holds words")
    channels: list[str | int] = []
    for name in table.samples:
        columns = [one.samples[name] for one in found.tables if name in one.samples]
        values = [column[np.isfinite(column)] for column in columns]
        if label is not None and name == label.name:
            left[name] = "has the labels"
        elif name in beside:
            left[name] = "by its name"
        elif all(len(column) > 2 and (np.diff(column) == 1).all() for column in columns):
            left[name] = "counts the rows"
        elif len({value for column in values for value in np.unique(column)[:2]}) < 2:
            left[name] = "never changes"
        else:
            channels.append(name)
    if {*left} - beside:
        draft.set("data.reading.channels", channels, "the columns of channels; others hold none")
    if label is not None:
        left.pop(label.name, None)
    for name, reason in left.items():
        draft.tell("no channel", f"column {name}", reason)
    return channels


def _stems(names: Sequence[str]) -> list[str] | None:
    """The kind of each name, where each has two channels or more; ``None`` if names show none."""
    for ending in (r"[\W_]*(\d.*|[xyzXYZ])?$", r"[\W_][^\W_]+$"):
        stems = [re.sub(ending, "", name) for name in names]
        counts = Counter(stems)
        if all(stems) and min(counts.values()) > 1:
            return [re.sub(r"\W+", "_", stem) for stem in stems]
    return None


def _fast_part(found: Look, name: str | int, rate_hz: float) -> float:
    """How much of a channel's variance lies above 5 Hz, a line taken off: the median over files.

    0 where no file tells.
    """
    parts = []
    for table in found.tables:
        values, own_rate_hz = table.samples[name], table.own_rate_hz or rate_hz
        is_there = np.isfinite(values)
        if not own_rate_hz or is_there.sum() < _LEAST_BIN:
            continue
        ticks = np.arange(len(values))
        even = detrend(np.interp(ticks, ticks[is_there], values[is_there]))
        power = np.abs(np.fft.rfft(even * np.hanning(len(even)))) ** 2
        is_above = np.fft.rfftfreq(len(even), 1 / own_rate_hz) > _EDGE_HZ
        parts += [power[is_above].sum() / power.sum()] if power.sum() > 0 else []
    return float(np.median(parts)) if parts else 0.0


def _propose_kinds(
    found: Look, channels: Sequence[str | int], rate_hz: float, draft: Proposal
) -> dict[str, str]:
    """Rows of channels; how each kind adapts."""
    if found.tables[0].is_native:
        draft.tell("channels", f"{len(channels)}", "the files say what they are")
        return {}
    names = [f"ch{name + 1}" if isinstance(name, int) else name for name in channels]
    is_known = rate_hz >= _SLOWEST_HZ
    parts = [_fast_part(found, name, rate_hz) for name in channels]
    speeds = ["fast" if is_known and part > 0.5 else "slow" for part in parts]
    stems = _stems(names)
    kinds = stems or speeds
    for kind in set(kinds) if stems and is_known else ():
        own = [part for part, other in zip(parts, kinds, strict=True) if other == kind]
        if min(own) < 1 - _CLEARLY and max(own) > _CLEARLY:
            pairs = zip(kinds, speeds, strict=True)
            kinds = [f"{other}_{speed}" if other == kind else other for other, speed in pairs]
    adapting = {}
    for kind in dict.fromkeys(kinds):
        places = [place for place, other in enumerate(kinds) if other == kind]
        part = float(np.median([parts[place] for place in places]))
        adapting[kind] = "fast" if is_known and part > 0.5 else "slow"
        reason = f"{100 * part:.0f} % of the variance is above {_EDGE_HZ:g} Hz"
        if not is_known:
            reason = f"below {_SLOWEST_HZ:g} Hz all channels are slow"
        shown = [names[place] for place in places]
        listed = ", ".join(shown if len(shown) < 7 else [*shown[:3], "...", shown[-1]])
        value = f"{kind}: {len(shown)} {adapting[kind]} channel{'s' * (len(shown) > 1)} ({listed})"
        draft.tell("kind", value, reason)
        draft.reasons[f"kind.{kind}"] = f"{adapting[kind]}: {reason}"
    rows = [
        {"name": name, "kind": kind, "adapting": adapting[kind]}
        for name, kind in zip(names, kinds, strict=True)
    ]
    reason = "kinds by the names" if stems else "kinds by the spectrum; names do not tell any"
    draft.set("data.channels", rows, f"{reason}. Fast: more than half of the variance above 5 Hz")
    return adapting


def _propose_units(channels: Sequence[str | int], given: Answers, draft: Proposal) -> None:
    """The unit of samples, as names say it in brackets, or as it is stated, or volts."""
    told = [found[1] if (found := _UNIT_IN_NAME.search(str(name))) else "" for name in channels]
    units, reason = given.units, "stated"
    if units is None and len(set(told)) == 1 and told[0]:
        units, reason = told[0], "by the names of channels"
    if units is None:
        units, reason = "V", "assumed; it names the axis of figures, --units states another"
    draft.set("data.units", units, reason)
    draft.tell("units", units, reason)


# Bins ---------------------------------------------------------------------------------------------


def bin_samples(rate_hz: float) -> int:
    """The length of a bin: 50 ms or more, an even number of samples from 32 to 1024.

    Of lengths up to a quarter longer the first is taken that is a whole number of microseconds.

    Example:
        >>> bin_samples(1000.0), bin_samples(100.0), bin_samples(24.0)
        (50, 32, 36)
    """
    least = max(2 * round(_BIN_S * rate_hz / 2), _LEAST_BIN)
    least = min(least, _MOST_BIN)
    lengths = range(least, min(least + least // 4, _MOST_BIN) + 1, 2)
    return next((n for n in lengths if (1e6 * n / rate_hz).is_integer()), least)


def _filter_frame(adapting: str, rate_hz: float) -> int | None:
    """The filter's frame in samples: 25.5 ms of slow channels, 5.5 ms of fast ones, odd.

    ``None``, no filter, where that is fewer than 5 samples.

    Example:
        >>> [_filter_frame(a, rate) for rate in (2000.0, 1000.0, 100.0) for a in ("slow", "fast")]
        [51, 11, 25, 5, None, None]
    """
    num = 2 * round((_FRAMES_S[adapting] * rate_hz - 1) / 2) + 1
    return num if num >= _LEAST_FRAME else None


def _propose_bins(kinds: Mapping[str, str], rate_hz: float, draft: Proposal) -> None:
    """Length and distance of bins, and the filters of kinds."""
    num = bin_samples(rate_hz)
    bin_ms, hop_ms = 1000 * num / rate_hz, 500 * num / rate_hz
    reason = f"{num} samples" + (", the fewest that are described well" if num < 40 else "")
    draft.set("labels.bin_ms", bin_ms, f"{reason} at {rate_hz:g} Hz")
    draft.set("labels.hop_ms", hop_ms, "half a bin: a decision every so many ms")
    draft.set("labels.assign", "majority", "a bin is slip if most of its samples are")
    draft.tell("bins", f"{bin_ms:.4g} ms, a hop of {hop_ms:.4g} ms", reason)
    frames = {kind: _filter_frame(adapting, rate_hz) for kind, adapting in kinds.items()}
    if frames:
        rule = "filter of each kind in samples: 25.5 ms if slow, 5.5 ms if fast; null: not filtered"
        draft.set("features.frames", frames, rule)
        texts = [f"{kind} {num or 'none'}" for kind, num in frames.items()]
        draft.tell("filters", ", ".join(texts), "25.5 ms of slow, 5.5 ms of fast channels")
    level = min(highest_level(num), 4)
    draft.set("features.level", None, f"wavelet levels: as many as {num} samples allow, {level}")


# Labels and groups --------------------------------------------------------------------------------


def _propose_labels_and_groups(
    found: Look, label: _Label | None, given: Answers, draft: Proposal
) -> dict[str, set[bool]]:
    """What says where slip is, what is an object, and what is left out in evaluation.

    Returns:
        Of files whether they hold slip, none, or both.
    """
    has_manifest = (found.folder / MANIFEST).is_file()
    intervals = () if has_manifest or label is not None else found.intervals
    fields: Mapping[str, Mapping[str, str]]
    by_name: dict[str, bool] = {}
    classes: dict[str, set[bool]] = {}
    if label is not None:
        classes = _propose_label_column(found, label, given, draft)
    elif intervals:
        _check_intervals(found.folder / found.table_of_intervals, intervals)
        told = f"it names recordings; {MANIFEST} is made of it"
        draft.tell("labels", f"intervals of {found.table_of_intervals}", told)
        for row in intervals:
            classes.setdefault(row["file"], {False}).add(row["label"] == "slip")
    elif not (has_manifest or found.tables[0].is_native):
        by_name = _words_of_names(found, given, draft)
        if not by_name:
            return classes
    if has_manifest:
        listing = read_manifest(found.folder / MANIFEST, found.folder)
        fields = {
            entry.file: {"material": entry.recording.material, "session": entry.recording.session}
            for entry in listing.entries
        }
        classes = {file: states for file, states in classes.items() if file in fields}
        classes |= {entry.file: _states_of(entry) for entry in listing.entries if entry.truth}
        classes = classes or {entry.file: set() for entry in listing.entries}
        if not classes:
            manifest = found.folder / MANIFEST
            raise ValueError(f"{manifest} lists no recording; list one, or remove it")
        if found.table_of_intervals and label is None:
            unread = f"{found.table_of_intervals} is not read, as {MANIFEST} is there"
            draft.tell("look", unread, f"remove {MANIFEST} to read it")
        draft.tell("labels and objects", MANIFEST, "it lists the recordings")
    else:
        fields = _propose_pattern(found, by_name, given, draft)
        if by_name:
            lower = {word.lower(): slips for word, slips in by_name.items()}
            classes = {file: {lower[each["label"].lower()]} for file, each in fields.items()}
    if fields:
        _propose_split(fields, classes, draft)
    if fields and intervals:
        del draft.settings["data"]["pattern"]
        draft.manifest = _manifest_rows(intervals, fields)
    return classes


def _states_of(entry: Entry) -> set[bool]:
    """Whether a manifest says slip, non-slip or both of a recording."""
    truth = entry.truth
    if truth is None:
        return set()
    slips = truth.onsets_s or truth.sliding_s or truth.slip_s or truth.label == "slip"
    rests = truth.onsets_s or truth.non_slip_s or truth.label == "non-slip"
    return {state for state, is_there in ((True, slips), (False, rests)) if is_there}


def _propose_label_column(
    found: Look, label: _Label, given: Answers, draft: Proposal
) -> dict[str, set[bool]]:
    """Slip by a column; which of the files that were read hold slip and non-slip."""
    draft.set(
        "labels.column", label.name, f"says of each sample whether it is slip; {label.reason}"
    )
    classes: dict[str, set[bool]] = {}
    if label.words:
        known = {word: _is_slip(word, given.words) for word in label.words}
        there = {word.lower() for word in label.words}
        if no_words := [word for word in given.words if word.lower() not in there]:
            raise ValueError(
                f"column {label.name} has no word {', '.join(no_words)}; it holds "
                f"{', '.join(label.words)}: give these, or --column NAME of another column"
            )
        if unknown := [word for word, slips in known.items() if slips is None]:
            text = (
                f"Which words of column {label.name} mean slip, with commas between? It holds "
                f"{', '.join(label.words)}; not known: {', '.join(unknown)}"
            )
            draft.ask("slip", text, "--label WORD=slip or --label WORD=non-slip for each")
        slips = [word for word, is_slip in known.items() if is_slip]
        if not unknown and len(slips) in (0, len(known)):
            raise ValueError(_one_side(f"the words of column {label.name}", known))
        if given.words and not unknown:
            draft.set("labels.slip", slips, "words of that column that mean slip; others do not")
        value = f"column {label.name}, slip where it says {' or '.join(slips) or '?'}"
        draft.tell("labels", value, label.reason)
        for table in found.tables:
            words = set(filter(None, table.words.get(label.name, ())))
            classes[table.file] = {bool(known.get(word)) for word in words}
        return classes
    numbers, over = label.numbers, given.over
    if not numbers or (over is None and len(numbers) == 1):
        held = f"holds only {numbers[0]:g}" if numbers else "is empty"
        raise ValueError(f"column {label.name} {held}; give --column NAME of another column")
    if given.words:
        raise ValueError(
            f"column {label.name} holds numbers, {numbers[0]:g} to {numbers[-1]:g}, no words; give "
            "--over NUMBER in place of --label and --non-slip, or --column NAME"
        )
    sizes = sorted({abs(number) for number in numbers})
    if over is None and len(numbers) == 2:
        is_inverted = label_of(str(label.name)) == "non-slip"  # such as no_slip
        if is_inverted or -numbers[0] == numbers[1]:  # slip goes by the magnitude otherwise
            slip = min(numbers, key=abs) if is_inverted else numbers[1]
            reason = "by its name" if is_inverted else label.reason
            draft.set("labels.slip", [slip], "numbers of that column that are slip")
            draft.tell("labels", f"column {label.name}, slip where it is {slip:g}", reason)
            return _states_by_file(found, label.name, lambda values: values == slip)
        over = sum(sizes) / 2
    if over is None:
        values, default = f"numbers from {numbers[0]:g} to {numbers[-1]:g}", ""
        if len(numbers) <= _MOST_STATES:
            values = ", ".join(f"{number:g}" for number in numbers)
            default = f"{(sizes[0] + sizes[1]) / 2:g}"
        text = f"Above which value of column {label.name} is it slip? It holds {values}"
        draft.ask("over", text, "--over NUMBER", default)
        over = float(default or "nan")
    if len(numbers) > 1 and (over < sizes[0] or over >= sizes[-1]):  # neither if it is asked
        raise ValueError(
            f"--over {over:g}: the magnitudes of column {label.name} are {sizes[0]:g} to "
            f"{sizes[-1]:g}, so all of it is {'slip' if over < sizes[0] else 'non-slip'}; leave "
            "--over out, or give a number between them"
        )
    draft.set("labels.over", over, "slip is where the magnitude of that column is above it")
    lower = str(label.name).lower()
    unit = next((unit for end, unit in _SPEED_UNITS.items() if lower.endswith(end)), None)
    if unit is not None and len(numbers) > _MOST_STATES:
        draft.set("labels.unit", unit, "of that column, a speed")
    draft.tell(
        "labels", f"column {label.name}, slip above {over:g}, whatever the sign", label.reason
    )
    return _states_by_file(found, label.name, lambda values: np.abs(values) > over)


def _states_by_file(
    found: Look, name: str | int, is_slip: Callable[[_Numbers], NDArray[np.bool_]]
) -> dict[str, set[bool]]:
    """Whether the files that were read hold slip, non-slip or both, by a column of numbers."""
    columns = {table.file: table.samples[name] for table in found.tables}
    return {
        file: set(map(bool, np.unique(is_slip(values[np.isfinite(values)]))))
        for file, values in columns.items()
    }


def _is_slip(word: str, words: Mapping[str, bool]) -> bool | None:
    """Whether a word means slip: as stated, else as people spell it, else the other side."""
    stated = {one.lower(): slips for one, slips in words.items()}
    if word.lower() in stated:
        return stated[word.lower()]
    if label := label_of(word):
        return label == "slip"
    is_one_side = stated and len(set(stated.values())) == 1
    return not next(iter(stated.values())) if is_one_side else None


def _constant_label(found: Look) -> str:
    """That there is no column of labels, or the one whose value never changes."""
    for name in found.tables[0].names:
        if _SLIP_NAMES.search(str(name)):
            label = _label_values(found, name, "")
            held = label.words or tuple(f"{number:g}" for number in label.numbers)
            return f"column {name} holds only {held[0]}" if held else f"column {name} is empty"
    return "no column"


def _one_side(where: str, known: Mapping[str, bool | None]) -> str:
    """What to say of words that are all slip, or all non-slip."""
    side, other = ("slip", "non-slip") if all(known.values()) else ("non-slip", "slip")
    return f"{where}, {', '.join(known)}, would all mean {side}; give --label WORD={other}"


def _words_of_names(found: Look, given: Answers, draft: Proposal) -> dict[str, bool]:
    """The words of names or folders that are labels; asks where there is none that is known."""
    files = found.files
    choices = word_choices(files)
    if given.pattern is not None and "{label" in given.pattern:
        read = [guessed(file, given.pattern).get("label") for file in files]
        choices = [tuple(sorted({word for word in read if word}))]
    for words in choices:
        stated = {one.lower() for one in given.words}
        if stated and not stated <= {word.lower() for word in words}:
            continue
        known = {word: _is_slip(word, given.words) for word in words}
        both = {slips for slips in known.values() if slips is not None}
        if stated and None not in known.values() and len(both) == 1:
            raise ValueError(_one_side("the words of names", known))
        if both == {True, False} and None not in known.values():
            labels = {word: "slip" if slips else "non-slip" for word, slips in known.items()}
            reason = "stated, and by known words" if stated else "by the words in names"
            draft.set("data.labels", labels, "what the words in names and folders mean")
            rest = ", ".join(word for word, slips in known.items() if not slips)
            draft.tell("labels", f"by names: {rest} is non-slip", reason)
            return {word: bool(slips) for word, slips in known.items()}
    if given.words:
        raise ValueError(
            f"no part of all names holds the words {', '.join(given.words)}; names tell apart "
            f"{' or '.join('|'.join(words) for words in choices) or 'nothing'}"
        )
    others = [file for file in found.problems if file.endswith(".csv") and "/" not in file]
    no_table = f"; {others[0]} is none, or names a file that is no recording" if others else ""
    no_column = "no column" if given.column == "none" else _constant_label(found)
    nothing = (
        f"Nothing tells where slip is: {no_column}, no table of intervals (a CSV with "
        f"the columns file, which names a recording, start and end{no_table})"
    )
    if not choices:
        text = f"{nothing}, no words in names. Which column says it?"
        draft.ask("column", text, "--column NAME")
        return {}
    listed = "; or ".join(", ".join(words[:12]) for words in choices)
    text = (
        f"{nothing}. Which word in the names of files or folders, or which words with commas "
        f"between, mean that nothing slips? They have {listed}"
    )
    draft.ask("non_slip", text, "--non-slip WORD, or --column NAME")
    return {}


def _propose_pattern(
    found: Look, by_name: Mapping[str, bool], given: Answers, draft: Proposal
) -> Mapping[str, Mapping[str, str]]:
    """How names are read; what they tell of each file."""
    fields: dict[str, Mapping[str, str]]
    if given.pattern is not None:
        for part in ("{material", *(["{label"] if by_name else [])):
            if part not in given.pattern:
                what = "objects" if part == "{material" else "what is slip"
                raise ValueError(
                    f"--pattern {given.pattern!r} has no {part}}}, which tells {what}; add it"
                )
        draft.set("data.pattern", given.pattern, "how names are read; stated")
        read = {file: guessed(file, given.pattern) for file in found.files}
        fields = {file: each for file, each in read.items() if each}
        if not fields:
            raise ValueError(f"no file has a name that matches --pattern {given.pattern!r}")
        reason = "stated"
    else:
        pattern = name_pattern(found.files, tuple(by_name))
        if pattern.is_simple and by_name:
            text = (
                "How are the names made, such as {label}/{material}_{trial}? The first is "
                f"{found.files[0]}"
            )
            draft.ask("pattern", text, "--pattern PATTERN")
            return {}
        draft.set("data.pattern", pattern.pattern, "how the names of files and folders are read")
        fields = dict(zip(found.files, pattern.fields, strict=True))
        reason = (
            "no part of the names repeats" if pattern.is_simple else "each name has one reading"
        )
    shown = draft.settings["data"]["pattern"]
    draft.tell("names", shown, reason)
    counts = Counter(each["material"] for each in fields.values())
    if len(counts) < len(fields):
        listed = ", ".join(f"{name} ({num})" for name, num in list(counts.items())[:8])
        more = f" and {len(counts) - 8} more" if len(counts) > 8 else ""
        draft.tell("objects", f"{len(counts)}: {listed}{more}", "by the names, with their files")
        for name in (name for name, num in counts.items() if num == 1):
            others = [other for other, num in counts.items() if num > 1]
            if near := get_close_matches(name, others, 1):
                renaming = f"data.rename: {{{name}: {near[0]}}}"
                draft.tell("look", f"object {name} has one file", f"if misspelt, add {renaming}")
    return fields


def _propose_split(
    fields: Mapping[str, Mapping[str, str]], classes: Mapping[str, set[bool]], draft: Proposal
) -> None:
    """What is left out, one after the other, to estimate how good a detector is on new ones."""
    for by in ("material", "session"):
        groups: dict[str, set[bool]] = defaultdict(set)
        for file, known in classes.items():
            if (value := fields.get(file, {}).get(by)) is not None:
                groups[value] |= known
        num = sum(states == {True, False} for states in groups.values())
        is_grouped = len({known.get(by) for known in fields.values()}) < len(fields)
        what = "object" if by == "material" else by
        if num >= _FEWEST_GROUPS and is_grouped:
            reason = f"{num} {what}s have slip and non-slip"
            break
    else:
        by = what = "recording"
        reason = f"fewer than {_FEWEST_GROUPS} objects or sessions have slip and non-slip"
    draft.set("split.by", by, f"what is left out for the estimate; {reason}")
    draft.set("split.folds", _FOLDS, "groups are joined to at most so many, each left out once")
    draft.tell("estimate", f"one {what} after the other is left out", reason)
