"""A manifest: which files are recordings, of what, and what is known of each.

A table (CSV) or list (YAML) of ``file``, ``material`` (or ``object``), ``trial`` (or ``cycle``),
``scene``, ``session``, what ``truth.py`` reads, and ``sample_rate_hz`` of files that do not say
it. What ``generate`` writes is one.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.sets.manifest_lines import Line, Problem, read_lines
from tactslip_torch.data.sets.truth import TRUTH_COLUMNS, Truth, truth_of

NAMES = ("manifest.csv", "manifest.yaml", "manifest.yml")
ALIASES = {"object": "material", "cycle": "trial"}
COLUMNS = ("file", "material", "trial", "scene", "session", *TRUTH_COLUMNS, "sample_rate_hz")
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
    truth: Truth | None = None
    sample_rate_hz: float | None = None
    is_nominal: bool = False


class Listing(NamedTuple):
    """The recordings of a set, what is wrong with the list, and what may be."""

    entries: tuple[Entry, ...]
    problems: tuple[Problem, ...] = ()
    warnings: tuple[Problem, ...] = ()


def manifest_of(root: Path, given: str | None = None) -> Path:
    """The manifest of a set: the one given, relative to the root or not, or one of ``NAMES``.

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
            f"no {' or '.join(NAMES)} in {root}; python -m tactslip_torch.data_tool "
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
    columns, lines, unreadable = read_lines(path)
    problems, warnings = list(unreadable), []
    for column, place in columns.items():
        if wrong := _misspelt(column):
            problems.append(Problem(place, wrong))
        elif ALIASES.get(column, column) not in (*COLUMNS, *_IGNORED):
            warnings.append(Problem(place, f"column {column[:60]!r} is not read"))
    known = {ALIASES.get(column, column) for column in columns}
    if missing := [column for column in ("file", "material") if column not in known]:
        if columns:
            problems.append(Problem(f"{path.name}:1", f"no column {' and no '.join(missing)}"))
        elif not problems:
            problems.append(Problem(path.name, "is empty; it must list file and material"))
        return Listing((), tuple(problems), tuple(warnings))
    if not lines and not problems:
        problems.append(Problem(path.name, "lists no recording"))
    drafts = []
    for line in lines:
        draft, wrong_here = _draft(line, root)
        problems += [Problem(line.place, wrong) for wrong in wrong_here]
        drafts += [draft] if draft else []
    entries = tuple(_numbered(drafts))
    problems += _twice(entries)
    warnings += _alike(entries)
    return Listing(entries, tuple(problems), tuple(warnings))


class _Draft(NamedTuple):
    """A line that can be read, its trial not yet numbered if it was left empty."""

    place: str
    file: str
    material: str
    trial: int | None
    scene: str
    session: str
    truth: Truth | None
    rate: float | None


def _draft(line: Line, root: Path) -> tuple[_Draft | None, list[str]]:
    """A line as far as it can be read, and all that is wrong with it."""
    cells = {ALIASES.get(column, column): cell for column, cell in line.cells.items()}
    problems = []
    words = {}
    for column in ("file", "material", "trial", "scene", "session", "sample_rate_hz"):
        cell = cells.get(column, "")
        if not isinstance(cell, str):
            problems.append(f"{column} must be one value, got a list")
            cell = ""
        words[column] = cell
    file = words["file"]
    if problem := file_problem(root, file):
        problems.append(problem)
    if not words["material"]:
        problems.append("no material")
    trial, rate = words["trial"], words["sample_rate_hz"]
    if trial and not (trial.isascii() and trial.isdigit() and len(trial) < 10):
        problems.append(
            f"trial must be a whole number from 0, got {trial[:40]!r}; empty ones are numbered in "
            "their order"
        )
    if rate and not _is_rate(rate):
        problems.append(f"sample_rate_hz must be a positive number, got {rate[:40]!r}")
    truth, wrong = truth_of(cells)
    problems += wrong
    if problems:
        return None, problems
    return _Draft(
        line.place,
        PurePosixPath(*PureWindowsPath(file).parts).as_posix(),
        words["material"],
        int(trial) if trial else None,
        words["scene"] or RecordingId.scene,
        words["session"],
        truth,
        float(rate) if rate else None,
    ), []


def file_problem(root: Path, file: str) -> str | None:
    """Why a file that a manifest names cannot be taken: it is not there, or not inside the root."""
    if not file or "\0" in file:
        return "no file" if not file else f"file {file[:60]!r} holds a NUL"
    path = PureWindowsPath(file)  # knows both kinds of slashes, and drives
    if path.anchor or ".." in path.parts:
        return f"file {file[:200]!r} must lie inside the folder; give it relative to that"
    place = root.joinpath(*path.parts)
    try:
        real = place.resolve()
        exists = place.exists()
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


def _numbered(drafts: list[_Draft]) -> Iterator[Entry]:
    """Entries; an empty trial gets the next number free for its material, scene and session."""
    used: dict[tuple[str, str, str], set[int]] = {}
    for draft in drafts:
        own = used.setdefault((draft.material, draft.scene, draft.session), set())
        own |= {draft.trial} if draft.trial is not None else set()
    for place, file, material, trial, scene, session, truth, rate in drafts:
        if trial is None:
            own = used[material, scene, session]
            trial = next(number for number in range(len(own) + 1) if number not in own)
            own.add(trial)
        yield Entry(place, file, RecordingId(material, trial, scene, session), truth, rate)


def _twice(entries: Iterable[Entry]) -> list[Problem]:
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


def _alike(entries: Iterable[Entry]) -> list[Problem]:
    """Materials that differ in case or blanks alone."""
    found: dict[str, Entry] = {}
    doubts = []
    for entry in entries:
        material = entry.recording.material
        other = found.setdefault("".join(material.lower().split()), entry)
        if other.recording.material != material:
            what = f"material {material!r} is not the {other.recording.material!r} of {other.place}"
            doubts.append(Problem(entry.place, what))
    return doubts


def _misspelt(column: str) -> str | None:
    known = (*COLUMNS, *ALIASES)
    close = difflib.get_close_matches(column, known, 1, cutoff=0.8)
    if column in (*known, *_IGNORED) or not close:
        return None
    return f"unknown column {column[:60]!r}; did you mean {close[0]!r}?"


def _is_rate(text: str) -> bool:
    try:
        return 0 < float(text) < math.inf
    except ValueError:
        return False


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
