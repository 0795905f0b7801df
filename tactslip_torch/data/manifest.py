"""Manifests: CSV tables of the files of a set, of what each is, and of when slip begins in it."""

from __future__ import annotations

import csv
import difflib
import io
import itertools
import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

from tactslip_torch.data.formats import is_there
from tactslip_torch.data.labels import label_of
from tactslip_torch.data.recording import MOMENTS, SPANS, TIMES, RecordingId, Stretch, Timeline
from tactslip_torch.runtime import whole_file

MANIFEST = "manifest.csv"
_MOST_BYTES = 64 * 2**20
"""Of a manifest; a larger file is none."""
_SEPARATORS = (",", ";", "\t")


class Problem(NamedTuple):
    """Something wrong with a set of recordings.

    Args:
        place: file and, where there is one, line, such as ``"manifest.csv:12"``.
        what: is wrong, and what to do.
    """

    place: str
    what: str

    def __str__(self) -> str:
        return " ".join(f"{self.place}: {self.what}".split())


# When slip begins and ends ----------------------------------------------------------------------

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SPAN = re.compile(rf"({_NUMBER})\s*(?:-|\N{{EN DASH}}|\.\.|to)\s*({_NUMBER}|end)")
_TOUCH_S = 1e-6  # by less than that stretches only touch


def truth_of(cells: Mapping[str, str]) -> tuple[Timeline | None, list[str]]:
    """The timeline that the cells of a line give, ``None`` if all are empty, and what is wrong.

    Example:
        >>> truth_of({"onsets_s": "2.0; 9.0", "non_slip_s": "0-1.5"})[0].onsets_s
        (2.0, 9.0)
        >>> truth_of({"onsets_s": "2,5"})[1]
        ["onsets_s: '2,5' is no number; write decimals with a point, and 2.0; 9.0 for several"]
    """
    given = {name: cells[name] for name in (*TIMES, "label") if cells.get(name)}
    if not given:
        return None, []
    values: dict[str, Any] = {}
    problems: list[str] = []
    for name, cell in given.items():
        try:
            if name == "label":
                if (label := label_of(cell)) is None:
                    raise ValueError(f"must be slip, non-slip or empty, got {cell[:40]!r}")
                values[name] = label
            else:
                parse = _number if name in MOMENTS else _stretch
                values[name] = tuple(map(parse, _items(cell)))
        except ValueError as error:
            problems.append(f"{name}: {error}")
    if problems:
        return None, problems
    truth = Timeline(**values)
    onsets = truth.onsets_s or truth.annotated_onsets_s  # or the starts of slides
    onsets = onsets or tuple(start for start, _ in truth.sliding_s)
    speeds = truth.speeds_mm_s
    speeds = speeds * len(onsets) if len(speeds) == 1 else speeds  # one for all
    truth = replace(truth, onsets_s=onsets, speeds_mm_s=speeds)
    return truth, _contradictions(truth)


def _contradictions(truth: Timeline) -> list[str]:
    """What cannot all be true, whatever the recording is."""
    found = []
    for name in MOMENTS[:2]:
        moments = getattr(truth, name)
        shown = "; ".join(f"{moment:g}" for moment in moments)
        if any(later <= earlier for earlier, later in pairwise(moments)):
            found.append(f"{name} must ascend, got {shown}")
        if any(moment < 0 for moment in moments):
            found.append(f"{name} must not lie before the start, got {shown}")
    if any(speed < 0 for speed in truth.speeds_mm_s):
        found.append("speeds_mm_s must not be negative")
    for name in ("annotated_onsets_s", "sliding_s", "speeds_mm_s", "released_s"):
        values = getattr(truth, name)
        if values and len(values) != len(truth.onsets_s):
            found.append(
                f"{len(values)} {name} for {len(truth.onsets_s)} onsets; give one for each"
            )
    for name in SPANS:
        for start, end in getattr(truth, name):
            is_moment = name == "released_s" and start == end  # all let go at once
            if not (0 <= start < end or is_moment):
                found.append(f"{name}: {start:g}-{end:g} must end behind its start, from 0 on")
    found = found or _overlaps(truth)
    if truth.label and truth.has_stretches:
        found.append(
            f"label {truth.label} says all of it, and onsets or stretches are given as well; "
            "give one of both"
        )
    return found


def _overlaps(truth: Timeline) -> list[str]:
    """Stretches that cannot both be, of a timeline whose numbers are fine one by one."""
    slip, non_slip = (*truth.sliding_s, *truth.slip_s), truth.non_slip_s
    pairs = [
        *(
            (f"{n}: {{}} overlap or stand in the wrong order", pairwise(getattr(truth, n)))
            for n in SPANS
        ),
        ("slip and non-slip overlap: {}", itertools.product(slip, non_slip)),
        ("sliding_s and slip_s overlap: {}", itertools.product(truth.sliding_s, truth.slip_s)),
    ]
    found = [
        what.format(f"{a[0]:g}-{a[1]:g} and {b[0]:g}-{b[1]:g}")
        for what, both in pairs
        for a, b in both
        if min(a[1], b[1]) - max(a[0], b[0]) > _TOUCH_S or (" order" in what and b < a)
    ]
    for onset, (first, last) in zip(truth.onsets_s, truth.released_s, strict=False):
        if not first <= onset <= last:
            found.append(
                f"the onset at {onset:g} s is not within its released_s, {first:g}-{last:g} s"
            )
    for onset, (_, end) in zip(truth.onsets_s, truth.sliding_s, strict=False):
        if onset >= end:
            found.append(f"the onset at {onset:g} s is not before the end of its slide, {end:g} s")
    return found


def _items(cell: str) -> list[Any]:
    """The parts of a cell; JSON is read to text, so that numbers are checked in one place."""
    if not cell.startswith("["):
        return [part.strip() for part in cell.split(";") if part.strip()]
    try:
        read: list[Any] = json.loads(cell, parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError):
        raise ValueError(f"{cell[:40]!r} is no list; write [2.0, 9.0] or 2.0; 9.0") from None
    return read


def _stretch(item: object) -> Stretch:
    if isinstance(item, str) and (span := _SPAN.fullmatch(item)):
        item = [span[1], span[2]]
    if not isinstance(item, list) or len(item) != 2:
        raise ValueError(f"{str(item)[:40]!r} is no stretch; write 2-7; 9-11.5 or [[2, 7], ...]")
    return _number(item[0]), math.inf if item[1] == "end" else _number(item[1])


def _number(item: object) -> float:
    if isinstance(item, str) and re.fullmatch(_NUMBER, item) and math.isfinite(float(item)):
        return float(item)
    raise ValueError(
        f"{str(item)[:40]!r} is no number; write decimals with a point, and 2.0; 9.0 for several"
    )


# Lists of recordings ----------------------------------------------------------------------------

_ALIASES = {"object": "material", "cycle": "trial"}
_PLAIN = ("file", "material", "trial", "scene", "session", "sample_rate_hz")
_KNOWN = (*_PLAIN, *TIMES, "label", *_ALIASES)
_IGNORED = ("simulated", "fidelity", "seed")
"""Further columns of what ``generate`` writes: files say this themselves."""


@dataclass(frozen=True)
class Entry:
    """A recording of a set, before its file is opened.

    Args:
        place: where it is listed, such as ``"manifest.csv:12"``.
        file: its file or folder, relative to the root of the set.
        recording: its name.
        truth: what is said of it; ``None`` if nothing is, so that the file itself has the word.
        sample_rate_hz: if it is said.
        is_nominal: whether the truth is a plan for all alike, so that a slide that its recording
            does not hold to the end is cut there.
    """

    place: str
    file: str
    recording: RecordingId
    truth: Timeline | None = None
    sample_rate_hz: float | None = None
    is_nominal: bool = False

    def problem(self, what: str) -> Problem:
        """Something wrong with it, its file named once."""
        text = what.removeprefix(self.file).lstrip(":, ")
        return Problem(self.place, text if self.place == self.file else f"{self.file}: {text}")


class Listing(NamedTuple):
    """The recordings of a set, what is wrong with the list, and what may be."""

    entries: tuple[Entry, ...]
    problems: tuple[Problem, ...] = ()
    warnings: tuple[Problem, ...] = ()


def manifest_of(root: Path, given: str | None = None) -> Path:
    """The manifest of a set: the one given, relative to the root or not, or ``manifest.csv``.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    if given is not None:
        return next((path for path in (root / given, Path(given)) if path.is_file()), root / given)
    if not (root / MANIFEST).is_file():
        raise FileNotFoundError(
            f"no {MANIFEST} in {root}; python -m tactslip_torch data "
            f"action=label_template root={root} writes one to fill in"
        )
    return root / MANIFEST


def read_manifest(path: Path, root: Path) -> Listing:
    """The recordings that a manifest lists, and every problem of every line.

    Trials that are not numbered are numbered in their order within material and scene.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no text, or its name does not end in ``.csv``.
    """
    columns, lines, problems = _read_csv(path)
    warnings = []
    for column in filter(None, columns):
        if column not in (*_KNOWN, *_IGNORED):
            if close := difflib.get_close_matches(column, _KNOWN, 1, cutoff=0.8):
                what = f"unknown column {column[:60]!r}; did you mean {close[0]!r}?"
                problems.append(Problem(f"{path.name}:1", what))
            else:
                warnings.append(Problem(f"{path.name}:1", f"column {column[:60]!r} is not read"))
    there = {_ALIASES.get(column, column) for column in columns}
    if missing := [column for column in ("file", "material") if column not in there]:
        what = f"no column {' and no '.join(missing)}"
        where = Problem(f"{path.name}:1", what)
        if not columns:
            where = Problem(path.name, "is empty; it must list file and material")
        return Listing((), (*problems, where), tuple(warnings))
    if not lines and not problems:
        problems.append(Problem(path.name, "lists no recording"))
    drafts = []
    for place, cells in lines:
        plain = {_ALIASES.get(column, column): cell for column, cell in cells.items()}
        draft, wrong_here = _draft(place, plain, root)
        problems += [Problem(place, wrong) for wrong in wrong_here]
        drafts += [draft] if draft else []
    entries = tuple(_numbered(drafts))
    problems += twice(entries)
    first: dict[str, Entry] = {}
    for entry in entries:
        material = entry.recording.material
        other = first.setdefault("".join(material.lower().split()), entry)
        if other.recording.material != material:
            what = f"material {material!r} is not the {other.recording.material!r} of {other.place}"
            warnings.append(Problem(entry.place, what))
    return Listing(entries, tuple(problems), tuple(warnings))


_Lines = list[tuple[str, dict[str, str]]]


def _read_csv(path: Path) -> tuple[list[str], _Lines, list[Problem]]:
    """Columns in small letters, where each line stands with its cells, and what is wrong.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no text at all, or no ``.csv``.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no manifest at {path}")
    if path.suffix.lower() != ".csv":
        raise ValueError(f"{path} must end in .csv to be read as a manifest; convert it to CSV")
    if (size := path.stat().st_size) > _MOST_BYTES:
        raise ValueError(f"{path} is no manifest: it has {size} bytes, at most {_MOST_BYTES} do")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ValueError(f"{path.name}:{line}: no UTF-8 text; save it as UTF-8") from None
    separator = max(_SEPARATORS, key=text.partition("\n")[0].count)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    columns: list[str] = []
    lines: _Lines = []
    problems: list[Problem] = []
    last = 0
    try:
        for row in rows:
            place, last = f"{path.name}:{last + 1}", rows.line_num
            if not any(cell.strip() for cell in row):
                continue
            if not columns:
                columns = ["_".join(cell.lower().split()) for cell in row]
                again = [c for c, count in Counter(filter(None, columns)).items() if count > 1]
                problems += [Problem(place, f"column {c[:60]!r} is there twice") for c in again]
            elif len(row) != len(columns):
                what = f"has {len(row)} cells, the header {len(columns)}; put in quotes what holds"
                problems.append(Problem(place, f"{what} a {separator!r}"))
            else:
                cells = zip(columns, map(str.strip, row), strict=True)
                lines.append((place, {column: cell for column, cell in cells if column}))
    except csv.Error as error:
        problems.append(Problem(f"{path.name}:{last + 1}", f"cannot be read as CSV: {error}"))
    return columns, lines, problems


def _draft(place: str, cells: Mapping[str, str], root: Path) -> tuple[Entry | None, list[str]]:
    """A line, its trial -1 if it was left empty, and all that is wrong with it."""
    file, material, trial, scene, session, rate = (cells.get(column, "") for column in _PLAIN)
    problems = []
    if problem := _file_problem(root, file):
        problems.append(problem)
    if not material:
        problems.append("no material")
    if trial and not (trial.isascii() and trial.isdigit() and len(trial) < 10):
        problems.append(
            f"trial must be a whole number from 0, got {trial[:40]!r}; empty ones are numbered in "
            "their order"
        )
    if rate and not (re.fullmatch(_NUMBER, rate) and 0 < float(rate) < math.inf):
        problems.append(f"sample_rate_hz must be a positive number, got {rate[:40]!r}")
    truth, wrong = truth_of(cells)
    problems += wrong
    if problems:
        return None, problems
    path = PurePosixPath(*PureWindowsPath(file).parts).as_posix()
    cycle = int(trial) if trial else -1
    recording = RecordingId(material, cycle, scene or RecordingId.scene, session)
    return Entry(place, path, recording, truth, float(rate) if rate else None), []


def _file_problem(root: Path, file: str) -> str | None:
    """Why a file that a manifest names cannot be taken: it is not there, or not inside the root."""
    path = PureWindowsPath(file)  # knows both kinds of slashes, and drives
    if path.anchor or ".." in path.parts:
        return f"file {file[:200]!r} must lie inside the folder; give it relative to that"
    place = root.joinpath(*path.parts)
    try:
        if file and is_there(place):
            is_inside = place.resolve().is_relative_to(root.resolve())
            what = f"file {file[:200]!r} is a link out of the folder; copy it there"
            return None if is_inside else what
    except (OSError, RuntimeError, ValueError) as error:  # a name too long, a loop, a NUL
        return f"file {file[:60]!r}... cannot be opened: {getattr(error, 'strerror', error)}"
    near = place.parent if place.parent.is_dir() else root
    close = difflib.get_close_matches(place.name, [p.name for p in near.iterdir()], 1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"no file {file[:200]!r} in the folder{hint}" if file else "no file"


def _numbered(drafts: Sequence[Entry]) -> Iterator[Entry]:
    """Entries; an empty trial gets the next number free for its material, scene and session."""
    taken = {draft.recording for draft in drafts}
    counts: dict[RecordingId, Iterator[int]] = defaultdict(itertools.count)
    for draft in drafts:
        name = draft.recording
        if name.cycle < 0:
            numbered = (replace(name, cycle=number) for number in counts[name])
            name = next(each for each in numbered if each not in taken)
        yield replace(draft, recording=name)


def twice(entries: Iterable[Entry]) -> list[Problem]:
    """Recordings and files that were listed before."""
    found = []
    first: dict[object, str] = {}
    for entry in entries:
        trial = entry.recording
        session = f", session {trial.session}" if trial.session else ""
        for key, what in (
            (trial, f"trial {trial.cycle} of {trial.material}, scene {trial.scene}{session},"),
            (entry.file, f"file {entry.file!r}"),
        ):
            if key in first:
                found.append(Problem(entry.place, f"{what} was listed in {first[key]}"))
            first.setdefault(key, entry.place)
    return found


def with_manifest(listing: Listing, manifest: Listing) -> Listing:
    """A listing in which files that a manifest annotates have its truth; the others keep theirs."""
    by_file = {entry.file: entry for entry in manifest.entries}
    entries = []
    for entry in listing.entries:
        other = by_file.pop(entry.file, None)
        if other is not None and other.truth is not None:
            entry = replace(entry, place=other.place, truth=other.truth, is_nominal=False)
        entries.append(entry)
    strangers = [
        Problem(other.place, f"file {file!r} has no name that says what it is")
        for file, other in by_file.items()
    ]
    return Listing(
        tuple(entries),
        (*listing.problems, *manifest.problems, *strangers),
        (*listing.warnings, *manifest.warnings),
    )


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write rows of these columns as CSV, whole or not at all."""
    with (
        whole_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
