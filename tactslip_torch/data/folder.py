"""Folders of recordings: their files, one each and found again by its key, and their manifest."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from tactslip_torch.data.formats import (
    Archived,
    Format,
    endings,
    episodes_of,
    find_format,
    format_of,
    named_format,
)
from tactslip_torch.data.formats._inference import cells_of
from tactslip_torch.data.labels import label_of
from tactslip_torch.data.manifest import MANIFEST, write_table
from tactslip_torch.data.recording import TIMES, RecordingId, RecordingSource

_STARTS = re.compile(r"(start|begin|from|onset)(?P<unit>(_?(s|ms|sec|seconds|time))*)", re.I)
_ENDS = re.compile(r"(end|stop|to|until)(?P<unit>(_?(s|ms|sec|seconds|time))*)", re.I)
_MOST_BYTES = 2**20  # of a table of intervals


def recording_files(place: Path, *, in_folders: bool = False) -> list[Path]:
    """The file, bag or episode, or those of a folder that are of a known format, by name.

    A manifest and a table of intervals are none.

    Args:
        place: a recording, or a folder.
        in_folders: whether to look in the folders of a folder as well.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ValueError: if the ending is unknown, or the folder holds no such file.
    """
    if not place.is_dir() or find_format(place) is not None:
        format_of(place)
        return [place]
    found: list[Path] = []
    folders = [place]
    while folders:
        folder = folders.pop()
        if (episodes := episodes_of(folder)) is not None:
            found += episodes
            continue
        for path in sorted(folder.iterdir()):
            if path.name.startswith(".") or path.name == MANIFEST:
                continue
            if find_format(path) is not None:
                found.append(path)
            elif in_folders and path.is_dir() and not path.is_symlink():
                folders.append(path)
    table, _ = interval_rows(place, found)
    found = [path for path in found if path != place / table]
    if not found:
        known = " or ".join(f".{ending}" for ending in endings())
        inside = "" if in_folders else " itself (folders inside it were not looked into)"
        inside = inside if any(path.is_dir() for path in place.iterdir()) else ""
        raise ValueError(f"no recording in {place}{inside}; give a folder of {known} files")
    return found


def interval_rows(folder: Path, paths: Sequence[Path]) -> tuple[str, list[dict[str, str]]]:
    """A table in the folder that names recordings, with starts and ends; ``""`` if none is there.

    Returns:
        Its name, and of each row ``file``, ``line``, ``start`` and ``end`` as they stand there,
        ``unit`` (``s`` or ``ms``; ``ms and s`` if they differ) and ``label``, which is ``slip``
        where no column says it.
    """
    known = {name: path for path in paths for name in (path.stem, path.name)}
    known |= {path.relative_to(folder).as_posix(): path for path in paths}
    for path in sorted(folder.glob("*.csv")):
        try:
            if path.name == MANIFEST or not path.is_file() or path.stat().st_size > _MOST_BYTES:
                continue
            names, starts, ends, numbered = _interval_cells(path)
        except OSError:
            continue  # which is told where the file is read
        rows = list(numbered.values())
        named = [n for n in range(len(names)) if rows and all(row[n] in known for row in rows)]
        if not named:
            continue
        used = (starts[0], ends[0], named[0])
        others = [n for n in range(len(names)) if n not in used]
        labels = [n for n in others if all(label_of(row[n]) for row in rows)]
        units = {_unit_of(_STARTS, names[starts[0]]), _unit_of(_ENDS, names[ends[0]])} - {""}
        unit = " and ".join(sorted(units)) or "s"
        table = []
        for number, row in numbered.items():
            start, end, name = (row[n] for n in used)
            label = (label_of(row[labels[0]]) if labels else None) or "slip"
            place = known[name].relative_to(folder).as_posix()
            times = {"line": str(number), "start": start, "end": end, "unit": unit}
            table.append({"file": place, **times, "label": label})
        return path.name, table
    return "", []


def _interval_cells(path: Path) -> tuple[list[str], list[int], list[int], dict[int, list[str]]]:
    """The names of a table, the places of starts and of ends, and its rows by line.

    There are no rows if there is no start or no end: then only the names are read.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = ((number, line) for number, line in enumerate(file, 1) if line.strip())
        _, first = next(lines, (0, ""))
        delimiter = max(";,\t", key=first.count)
        names = cells_of(first.rstrip("\n"), delimiter)
        starts = [n for n, name in enumerate(names) if _STARTS.fullmatch(name)]
        ends = [n for n, name in enumerate(names) if _ENDS.fullmatch(name)]
        if not (starts and ends):
            return names, starts, ends, {}
        rows = {number: cells_of(line.rstrip("\n"), delimiter) for number, line in lines}
    return names, starts, ends, {n: row for n, row in rows.items() if len(row) == len(names)}


def _unit_of(column: re.Pattern[str], name: str) -> str:
    """The unit of times that the name of their column says: ``s``, ``ms`` or ``""``."""
    match = column.fullmatch(name)
    said = match["unit"].lower() if match else ""
    if "ms" in said:
        return "ms"
    return "s" if re.search(r"_s(ec|econds)?(_|$)", said) else ""


def file_metadata(path: Path, archived: Archived | None) -> dict[str, Any]:
    """What a file says of itself, in plain values; of samples alone nothing is known."""
    recording = archived.recording if archived else None
    key = archived.key.get("recording") if archived else None
    scene = str(key.get("name", "paper")) if isinstance(key, dict) else "paper"
    return {
        "file": path.name,
        "material": recording.material if recording else None,
        "scene": scene if recording else None,
        "simulated": bool(recording.provenance.get("simulated")) if recording else None,
    }


class Written(NamedTuple):
    """A recording that has its file.

    Args:
        line: of the manifest.
        made: whether it was made now, or found finished.
        duration_s: of the recording.
        num_bytes: of the file.
    """

    line: dict[str, Any]
    made: bool
    duration_s: float
    num_bytes: int


@dataclass(frozen=True)
class RecordingFolder:
    """Recordings of a source as files in a folder, made where they are not there yet.

    A file that is there is kept if it is whole and what it was made of is the same: what the
    source says of its samples, when things happen in it, and ``made_by``.

    Args:
        source: the recordings.
        folder: where the files are.
        ending: of the files, or the name of a format.
        made_by: what determines the samples beside the source's keys: code and libraries.
        given: what could be given in place of the folder, for messages.
        files: the file each recording was read from, relative to its set; its new one is called so
            but for the ending. ``None``: called by material, scene, cycle and session.

    Raises:
        ValueError: if there is no such format.
    """

    source: RecordingSource
    folder: Path
    ending: str
    made_by: Mapping[str, Any]
    given: str = "folder"
    files: Mapping[RecordingId, str] | None = None

    def __post_init__(self) -> None:
        _ = self.format  # refuses an unknown one

    @property
    def format(self) -> Format:
        """How its files are written and read."""
        return named_format(self.ending)

    def path(self, recording: RecordingId) -> Path:
        """The recording's file."""
        ending = self.ending if self.ending in self.format.endings else self.format.endings[0]
        if self.files is not None:
            return (self.folder / self.files[recording]).with_suffix(f".{ending}")
        session = f"_session{recording.session}" if recording.session else ""
        name = f"{recording.material}_{recording.scene}_{recording.cycle:02d}{session}"
        return self.folder / f"{name}.{ending}"

    def key(self, recording: RecordingId) -> dict[str, Any]:
        """What determines the recording's file, as JSON gives it back."""
        content: dict[str, Any] = {
            "recording": {"name": recording.scene, **self.source.key(recording)},
            "material": recording.material,
            **self.made_by,
            "truth": self._truth(recording),
        }
        plain: dict[str, Any] = json.loads(json.dumps(content, allow_nan=False))
        return plain

    def _truth(self, recording: RecordingId) -> dict[str, Any]:
        times = self.source.timeline(recording)
        return {name: getattr(times, name) for name in TIMES}

    def check(self) -> None:
        """Refuse names that files cannot have, and to replace a file that is none of this package.

        Raises:
            ValueError: if there is such a name or file.
        """
        if not self.source.ids:
            raise ValueError("no recording to write; give at least one of materials=[M1,...]")
        first: dict[Path, RecordingId] = {}
        for recording in self.source.ids:
            path = self.path(recording)
            is_name = path.parent == self.folder and re.fullmatch(r"[\w.+-]+", path.name)
            if self.files is None and not is_name:
                raise ValueError(f"{path.name!r} cannot name a file; give the scene another name")
            if (other := first.setdefault(path, recording)) is not recording:
                raise ValueError(
                    f"{other} and {recording} would both become {path.name}; rename one"
                )
            if path.exists() and not self.format.is_native(path):
                what = f"move it away, or give another {self.given}"
                raise ValueError(f"{path} is no recording of this package; {what}")

    def load(self, recording: RecordingId) -> Archived:
        """What the recording's file holds.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is damaged.
        """
        return self.format.load(self.path(recording))

    def write(self, recording: RecordingId) -> Written:
        """Make the recording's file, unless it is there, whole, and of the same key.

        Raises:
            ValueError: if the recording cannot be read.
        """
        path, key = self.path(recording), self.key(recording)
        try:
            archived = self.load(recording)
            content = archived.recording if archived.key == key else None
        except (FileNotFoundError, ValueError):  # not there, or damaged: see check
            content = None
        made = content is None
        if content is None:
            content = self.source.load(recording)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.format.save(path, content, self.source.hand, key)
        origin = content.provenance
        line = {
            "file": path.relative_to(self.folder).as_posix(),
            "material": recording.material,
            "trial": recording.cycle,
            "scene": recording.scene,
            "session": recording.session,
            **{name: json.dumps(value) for name, value in self._truth(recording).items()},
            "sample_rate_hz": content.sample_rate_hz,
            "simulated": str(bool(origin.get("simulated"))).lower(),
            "fidelity": origin.get("fidelity", ""),
            "seed": origin.get("seed", ""),
        }
        return Written(line, made, content.duration_s, path.stat().st_size)


def write_manifest(folder: Path, written: Sequence[Written]) -> None:
    """Write the lines of recordings to ``manifest.csv``, whole or not at all."""
    write_table(folder / MANIFEST, list(written[0].line), [one.line for one in written])


# Manifests to fill in ---------------------------------------------------------------------------

_FIELDS = ("material", "trial", "scene", "session", "label")
"""What a pattern may name."""
_TEMPLATE_COLUMNS = (
    *("file", "material", "trial", "scene", "session"),
    *("onsets_s", "sliding_s", "slip_s", "non_slip_s", "label"),
)
_BETWEEN = r"[-_. ]"


def guessed(file: str, pattern: str) -> dict[str, str]:
    """What a pattern tells of a file by its name, and by its folders if the pattern has strokes.

    As many folders are looked at as the pattern has strokes. Capitals do not matter. A trial is a
    whole number. A material, scene, session or label is any text, or one of those listed:
    ``{scene:taps|held}``. A ``*`` stands for any text, and the ending is no part of a name. Blanks,
    dots, strokes and underlines around a material, scene or session are no part of it.

    Raises:
        ValueError: if the pattern names nothing, one twice, or something else than material,
            trial, scene, session and label; or if it can read the name in two ways.

    Example:
        >>> guessed("oil paper-slip_07.csv", "{material}{trial}")
        {'material': 'oil paper-slip', 'trial': '07'}
        >>> guessed("plastic_cup_C_1.csv", "{material}_{scene:A|B|C}_*")
        {'material': 'plastic_cup', 'scene': 'C'}
    """
    parts = re.split(r"\{(\w*)(?::([^{}]*))?\}", pattern)
    names, fixed = parts[1::3], parts[::3]
    words = {n: t.split("|") if t else None for n, t in zip(names, parts[2::3], strict=True)}
    if not names or set(names) - set(_FIELDS) or len(words) < len(names):
        raise ValueError(
            f"pattern must name each of {', '.join(f'{{{name}}}' for name in _FIELDS)} at most "
            f"once, as {{material}}_{{trial}}, got {pattern!r}"
        )
    path = Path(file)
    text = Path(*path.parts[-1 - pattern.count("/") : -1], path.stem).as_posix()
    expression = "(?i)" + _literal(fixed[0])
    for name, behind in zip(names, fixed[1:], strict=True):
        expression += _field(name, words[name]) + _literal(behind)
    read = re.fullmatch(expression, text)
    found = read.groupdict() if read else {}
    for name, value in found.items():  # read again, with another value: no path holds two strokes
        if again := re.fullmatch(f"{expression}//(?!(?P={name})//).*", f"{text}//{value}//"):
            another = again.groupdict()
            one, two = (
                ", ".join(f"{name}={value!r}" for name, value in each.items())
                for each in (found, another)
            )
            raise ValueError(
                f"{file}: pattern={pattern!r} can mean {one} or {two}; list the texts that can "
                f"stand there, as {{{name}:{value}|{another[name]}}}, or rename the file"
            )
    return found


def _literal(text: str) -> str:
    return "[^/]*?".join(re.escape(piece) for piece in text.split("*"))


def _field(name: str, words: Sequence[str] | None) -> str:
    """The expression of a field: one of the words, if given."""
    free = r"\d+?" if name == "trial" else "[^/]+?"
    inner = free if words is None else "|".join(map(re.escape, words))
    if name == "trial":
        return rf"(?<!\d)(?P<trial>{inner})(?!\d)"
    between = f"{_BETWEEN}*" if name in ("material", "scene", "session") else ""
    return f"{between}(?P<{name}>(?!{_BETWEEN})(?:{inner})(?<!{_BETWEEN})){between}"


def write_template(
    root: Path, pattern: str, path: Path | None = None
) -> tuple[Path, dict[str, dict[str, str]]]:
    """Write a manifest of all recordings of a folder, its label columns empty.

    Returns:
        Its path, and what the pattern gives of each file.

    Args:
        root: the folder.
        pattern: of names.
        path: of the manifest; ``None`` for ``manifest.csv`` in the folder.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if there is a manifest already, no recording, or the pattern is none or can
            read a name in two ways.
    """
    path = root / MANIFEST if path is None else path
    if path.exists():
        raise ValueError(f"{path} is there already; move it away, or give output=FILE")
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    found = recording_files(root, in_folders=True)
    files = sorted(one.relative_to(root).as_posix() for one in found)
    guesses = {file: guessed(file, pattern) for file in files}
    rows = [dict.fromkeys(_TEMPLATE_COLUMNS, "") | {"file": f, **own} for f, own in guesses.items()]
    write_table(path, _TEMPLATE_COLUMNS, rows)
    return path, guesses
