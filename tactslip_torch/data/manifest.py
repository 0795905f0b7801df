"""Manifests: which files a set has, of what, and what is known of slip in each.

A manifest is CSV or YAML. Nothing in it is executed: of YAML only its nodes are read, as text and
lists of text.
"""

from __future__ import annotations

import csv
import difflib
import io
import itertools
import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple, cast

import yaml  # type: ignore[import-untyped]

from tactslip_torch.data.formats import is_there
from tactslip_torch.data.recording import (
    MOMENTS,
    SPANS,
    TIMES,
    Label,
    RecordingId,
    Stretch,
    Timeline,
)
from tactslip_torch.runtime import whole_file

_Cell = str | list["_Cell"]
"""What stands under a column: text or, in YAML, lists of text."""

_MOST_BYTES = 64 * 2**20
"""Of a manifest; a larger file is none."""
_MOST_YAML_BYTES = 4 * 2**20  # which takes a hundred times longer to read
_MOST_DEPTH = 16  # of lists and mappings in YAML; one in another takes a stack, and ever longer
_SEPARATORS = (",", ";", "\t")
_YAML = (".yaml", ".yml")


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


@dataclass
class _Lines:
    """All of a manifest as it is written.

    Args:
        name: of the file.
        columns: every column, small letters, with where it was met first.
        lines: of recordings, in order: where each stands, and its cells by column.
        problems: of what could not be read at all.
    """

    name: str
    columns: dict[str, str] = field(default_factory=dict)
    lines: list[tuple[str, dict[str, _Cell]]] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)

    def wrong(self, what: str, line: int | None = None) -> None:
        """Note a problem of the file or, counted from 0, of one of its lines."""
        place = self.name if line is None else f"{self.name}:{line + 1}"
        self.problems.append(Problem(place, what))


def _read_lines(path: Path) -> _Lines:
    """The lines of a CSV or YAML file; what is wrong with it is among the problems.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no text at all, or its name ends in neither.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no manifest at {path}")
    is_yaml = path.suffix.lower() in _YAML
    if not is_yaml and path.suffix.lower() != ".csv":
        raise ValueError(f"{path} must end in .csv, .yaml or .yml to be read as a manifest")
    most = _MOST_YAML_BYTES if is_yaml else _MOST_BYTES
    if (size := path.stat().st_size) > most:
        hint = "; write it as .csv" if most < size <= _MOST_BYTES else ""
        raise ValueError(f"{path} is no manifest: it has {size} bytes, at most {most} do{hint}")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ValueError(f"{path.name}:{line}: no UTF-8 text; save it as UTF-8") from None
    found = _Lines(path.name)
    (_read_yaml if is_yaml else _read_csv)(text, found)
    return found


def _read_csv(text: str, found: _Lines) -> None:
    """Rows of a table with a header, its separator found from that."""
    head = text.partition("\n")[0]
    separator = max(_SEPARATORS, key=head.count)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    columns: list[str] = []
    last = 0
    try:
        for row in rows:
            line, last = last, rows.line_num
            if not any(cell.strip() for cell in row):
                continue
            if not columns:
                columns = [_column(cell) for cell in row]
                for twice in sorted({c for c in columns if c and columns.count(c) > 1}):
                    found.wrong(f"column {twice[:60]!r} is there twice", line)
            elif len(row) != len(columns):
                what = f"has {len(row)} cells, the header {len(columns)}; put in quotes what holds"
                found.wrong(f"{what} a {separator!r}", line)
            else:
                cells = zip(columns, map(str.strip, row), strict=True)
                own: dict[str, _Cell] = {column: cell for column, cell in cells if column}
                found.lines.append((f"{found.name}:{line + 1}", own))
    except csv.Error as error:
        found.wrong(f"cannot be read as CSV: {error}", last)
    found.columns.update(dict.fromkeys(filter(None, columns), f"{found.name}:1"))


def _read_yaml(text: str, found: _Lines) -> None:
    """A list of mappings, alone or under ``recordings``."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MOST_DEPTH:
                return found.wrong("is nested too deeply")
            if isinstance(event, yaml.AliasEvent):  # a few stand for more than memory holds
                return found.wrong("aliases, as *name, are not read", event.start_mark.line)
        node = yaml.compose(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        what = getattr(error, "problem", None) or error
        return found.wrong(f"cannot be read as YAML: {what}", mark and mark.line)
    if isinstance(node, yaml.MappingNode) and len(node.value) == 1:
        key, inner = node.value[0]
        node = inner if key.value == "recordings" else node
    if not isinstance(node, yaml.SequenceNode):
        return found.wrong("must be a list of recordings, as - {file: a.csv, material: wood}", 0)
    for item in node.value:
        line = item.start_mark.line
        if not isinstance(item, yaml.MappingNode):
            found.wrong("must be a mapping, as {file: a.csv, material: wood}", line)
            continue
        cells: dict[str, _Cell] = {}
        for key, value in item.value:
            here = key.start_mark.line
            column, cell = _column(str(key.value)), _cell(value)
            found.columns.setdefault(column, f"{found.name}:{here + 1}")
            if column in cells:
                found.wrong(f"{column[:60]!r} is there twice", here)
            if cell is None:
                found.wrong(f"{column[:60]} must be a value or a list of values", here)
            cells[column] = cell or ""
        found.lines.append((f"{found.name}:{line + 1}", cells))
    return None


def _cell(node: yaml.Node) -> _Cell | None:
    """Text or lists of text; ``None`` for what is neither."""
    if isinstance(node, yaml.ScalarNode):
        return "" if node.tag == "tag:yaml.org,2002:null" else str(node.value).strip()
    if not isinstance(node, yaml.SequenceNode):
        return None
    cells = [_cell(item) for item in node.value]
    return None if None in cells else [cell for cell in cells if cell is not None]


def _column(text: str) -> str:
    return "_".join(text.lower().split())


_TRUTH_COLUMNS = (*TIMES, "label")
_LABELS: dict[str, Label] = {"slip": "slip", "nonslip": "non-slip", "noslip": "non-slip"}
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SPAN = re.compile(rf"({_NUMBER})\s*(?:-|\N{{EN DASH}}|\.\.|to)\s*({_NUMBER}|end)")
_TOUCH_S = 1e-6  # by less than that stretches only touch


def truth_of(cells: Mapping[str, _Cell]) -> tuple[Timeline | None, list[str]]:
    """The truth that the cells of a line tell, ``None`` if they are all empty, and what is wrong.

    Example:
        >>> truth_of({"onsets_s": "2.0; 9.0", "non_slip_s": "0-1.5"})[0].onsets_s
        (2.0, 9.0)
        >>> truth_of({"onsets_s": "2,5"})[1]
        ["onsets_s: '2,5' is no number; write decimals with a point, and 2.0; 9.0 for several"]
    """
    given = {name: cells[name] for name in _TRUTH_COLUMNS if cells.get(name)}
    if not given:
        return None, []
    told: dict[str, Any] = {}
    problems: list[str] = []
    for name, cell in given.items():
        parse = _label if name == "label" else _moments if name in MOMENTS else _stretches
        try:
            told[name] = parse(cell)
        except ValueError as error:
            problems.append(f"{name}: {error}")
    if problems:
        return None, problems
    truth = Timeline(**told)
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
        if any(later <= earlier for earlier, later in pairwise(moments)):
            found.append(f"{name} must ascend, got {_shown(moments)}")
        if any(moment < 0 for moment in moments):
            found.append(f"{name} must not lie before the start, got {_shown(moments)}")
    if any(speed < 0 for speed in truth.speeds_mm_s):
        found.append(f"speeds_mm_s must not be negative, got {_shown(truth.speeds_mm_s)}")
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
    if truth.label and (truth.onsets_s or truth.slip_s or truth.non_slip_s):
        found.append(
            f"label {truth.label} says all of it, and onsets or stretches are given as well; "
            "give one of both"
        )
    return found


def _overlaps(truth: Timeline) -> list[str]:
    """Stretches that cannot both be, of a truth whose numbers are fine one by one."""
    checks: list[tuple[str, Iterable[Stretch], Iterable[Stretch] | None]] = [
        (f"{name}: {{}} overlap or stand in the wrong order", getattr(truth, name), None)
        for name in SPANS
    ]
    slip = (*truth.sliding_s, *truth.slip_s)
    checks.append(("slip and non-slip overlap: {}", slip, truth.non_slip_s))
    checks.append(("sliding_s and slip_s overlap: {}", truth.sliding_s, truth.slip_s))
    found = [
        what.format(clash) for what, ones, others in checks for clash in _clashes(ones, others)
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


def _clashes(ones: Iterable[Stretch], others: Iterable[Stretch] | None = None) -> list[str]:
    """Stretches that overlap: neighbours of one list, or one of each of two."""
    pairs = pairwise(ones) if others is None else ((a, b) for a in ones for b in others)
    return [
        f"{a[0]:g}-{a[1]:g} and {b[0]:g}-{b[1]:g}"
        for a, b in pairs
        if min(a[1], b[1]) - max(a[0], b[0]) > _TOUCH_S or (others is None and b < a)
    ]


def _label(cell: _Cell) -> Label:
    text = cell if isinstance(cell, str) else str(cell)
    known = _LABELS.get(re.sub(r"[\s_-]", "", text.lower()))
    if known is None:
        raise ValueError(f"must be slip, non-slip or empty, got {text[:40]!r}")
    return known


def _moments(cell: _Cell) -> tuple[float, ...]:
    return tuple(_number(item) for item in _items(cell))


def _stretches(cell: _Cell) -> tuple[Stretch, ...]:
    found = []
    for item in _items(cell):
        if isinstance(item, list) and len(item) == 2:
            found.append((_number(item[0]), _end(item[1])))
        elif isinstance(item, str) and (span := _SPAN.fullmatch(item)):
            found.append((_number(span[1]), _end(span[2])))
        else:
            raise ValueError(
                f"{str(item)[:40]!r} is no stretch; write 2-7; 9-11.5 or [[2, 7], ...]"
            )
    return tuple(found)


def _items(cell: _Cell) -> list[_Cell]:
    """The parts of a cell; JSON is read to text, so that numbers are checked in one place."""
    if isinstance(cell, list):
        return cell
    if not cell.startswith("["):
        return [part.strip() for part in cell.split(";") if part.strip()]
    try:
        read = json.loads(cell, parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError):
        raise ValueError(f"{cell[:40]!r} is no list; write [2.0, 9.0] or 2.0; 9.0") from None
    return cast("list[_Cell]", read)


def _number(item: object) -> float:
    if isinstance(item, str) and re.fullmatch(_NUMBER, item) and math.isfinite(float(item)):
        return float(item)
    raise ValueError(
        f"{str(item)[:40]!r} is no number; write decimals with a point, and 2.0; 9.0 for several"
    )


def _end(item: object) -> float:
    return math.inf if item == "end" else _number(item)


def _shown(values: Iterable[float]) -> str:
    return "; ".join(f"{value:g}" for value in values)


NAMES = ("manifest.csv", "manifest.yaml", "manifest.yml")
_ALIASES = {"object": "material", "cycle": "trial"}
_PLAIN = ("file", "material", "trial", "scene", "session", "sample_rate_hz")
_COLUMNS = (*_PLAIN, *_TRUTH_COLUMNS)
_IGNORED = ("simulated", "fidelity", "seed")
"""Further columns of what ``generate`` writes: files say this themselves."""


@dataclass(frozen=True)
class Entry:
    """A recording of a set, before its file is opened.

    Args:
        place: where it is said, such as ``"manifest.csv:12"``.
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
        said = what.removeprefix(self.file).lstrip(":, ")
        return Problem(self.place, said if self.place == self.file else f"{self.file}: {said}")


class Listing(NamedTuple):
    """The recordings of a set, what is wrong with the list, and what may be."""

    entries: tuple[Entry, ...]
    problems: tuple[Problem, ...] = ()
    warnings: tuple[Problem, ...] = ()


def manifest_of(root: Path, given: str | None = None) -> Path:
    """The manifest of a set: the one given, relative to the root or not, or the one found there.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if there are several.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    if given is not None:
        return next((path for path in (root / given, Path(given)) if path.is_file()), root / given)
    found = [root / name for name in NAMES if (root / name).is_file()]
    if len(found) > 1:
        names = " and ".join(path.name for path in found)
        raise ValueError(f"{root} has {names}; say which, as manifest={found[0].name}")
    if not found:
        raise FileNotFoundError(
            f"no {' or '.join(NAMES)} in {root}; python -m tactslip_torch data "
            f"action=label_template root={root} writes one to fill in"
        )
    return found[0]


def read_manifest(path: Path, root: Path) -> Listing:
    """The recordings that a manifest lists, and every problem of every line.

    Trials that are not numbered are numbered in their order within material and scene.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no text.
    """
    found = _read_lines(path)
    problems, warnings = found.problems, []
    known = (*_COLUMNS, *_ALIASES)
    for column, place in found.columns.items():
        if column in known or column in _IGNORED:
            continue
        if close := difflib.get_close_matches(column, known, 1, cutoff=0.8):
            what = f"unknown column {column[:60]!r}; did you mean {close[0]!r}?"
            problems.append(Problem(place, what))
        else:
            warnings.append(Problem(place, f"column {column[:60]!r} is not read"))
    there = {_ALIASES.get(column, column) for column in found.columns}
    if missing := [column for column in ("file", "material") if column not in there]:
        if found.columns:
            problems.append(Problem(f"{path.name}:1", f"no column {' and no '.join(missing)}"))
        elif not problems:
            found.wrong("is empty; it must list file and material")
        return Listing((), tuple(problems), tuple(warnings))
    if not found.lines and not problems:
        found.wrong("lists no recording")
    drafts = []
    for place, cells in found.lines:
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


def _draft(place: str, cells: Mapping[str, _Cell], root: Path) -> tuple[Entry | None, list[str]]:
    """A line, its trial -1 if it was left empty, and all that is wrong with it."""
    plain = {column: cells.get(column, "") for column in _PLAIN}
    lists = [column for column, cell in plain.items() if isinstance(cell, list)]
    problems = [f"{column} must be one value, got a list" for column in lists]
    words = ["" if isinstance(cell, list) else cell for cell in plain.values()]
    file, material, trial, scene, session, rate = words
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
    if not file or "\0" in file:
        return "no file" if not file else f"file {file[:60]!r} holds a NUL"
    path = PureWindowsPath(file)  # knows both kinds of slashes, and drives
    if path.anchor or ".." in path.parts:
        return f"file {file[:200]!r} must lie inside the folder; give it relative to that"
    place = root.joinpath(*path.parts)
    try:
        real = place.resolve()
        exists = is_there(place)
    except (OSError, RuntimeError) as error:  # of a name too long, or a loop of links
        return f"file {file[:60]!r}... cannot be opened: {getattr(error, 'strerror', error)}"
    if not real.is_relative_to(root.resolve()):
        return f"file {file[:200]!r} is a link out of the folder; copy it there"
    if exists:
        return None
    near = place.parent if place.parent.is_dir() else root
    close = difflib.get_close_matches(place.name, [p.name for p in near.iterdir()], 1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"no file {file[:200]!r} in the folder{hint}"


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


def better_told(listing: Listing, told: Listing) -> Listing:
    """A listing in which files that another tells of have its truth; the others keep theirs."""
    by_file = {entry.file: entry for entry in told.entries}
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
        (*listing.problems, *told.problems, *strangers),
        (*listing.warnings, *told.warnings),
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
