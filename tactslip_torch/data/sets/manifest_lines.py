"""The lines of a manifest as a person wrote it, CSV or YAML, before anything is made of them.

Nothing in the file is executed: of YAML only its nodes are read, as text and lists of text.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

import yaml  # type: ignore[import-untyped]

Cell = str | list["Cell"]
"""What stands under a column: text or, in YAML, lists of text."""

MOST_BYTES = 64 * 2**20
"""Of a manifest; a larger file is none."""
MOST_YAML_BYTES = 4 * 2**20  # which takes a hundred times longer to read
MOST_DEPTH = 16  # of lists and mappings in YAML; one in another takes a stack, and ever longer
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


class Line(NamedTuple):
    """One recording as it is written: the cells by column, and where they stand."""

    place: str
    cells: dict[str, Cell]


class Lines(NamedTuple):
    """All of a manifest.

    Args:
        columns: every column, small letters, with where it was met first.
        lines: of recordings, in order.
        problems: of what could not be read at all.
    """

    columns: dict[str, str]
    lines: tuple[Line, ...]
    problems: tuple[Problem, ...]


def read_lines(path: Path) -> Lines:
    """The lines of a CSV or YAML file; what is wrong with it is among the problems.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no text at all, or its name ends in neither.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no manifest at {path}")
    if path.suffix.lower() not in (".csv", *_YAML):
        raise ValueError(f"{path} must end in .csv, .yaml or .yml to be read as a manifest")
    most = MOST_YAML_BYTES if path.suffix.lower() in _YAML else MOST_BYTES
    if (size := path.stat().st_size) > most:
        hint = "; write it as .csv" if most < size <= MOST_BYTES else ""
        raise ValueError(f"{path} is no manifest: it has {size} bytes, at most {most} do{hint}")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ValueError(f"{path.name}:{line}: no UTF-8 text; save it as UTF-8") from None
    read = _yaml_lines if path.suffix.lower() in _YAML else _csv_lines
    return read(text, path.name)


def _csv_lines(text: str, name: str) -> Lines:
    """Rows of a table with a header, its separator found from that."""
    head = text.partition("\n")[0]
    separator = max(_SEPARATORS, key=head.count)
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    columns: list[str] = []
    lines: list[Line] = []
    problems: list[Problem] = []
    last = 0
    while True:
        try:
            row = next(rows, None)
        except csv.Error as error:
            problems.append(Problem(f"{name}:{last + 1}", f"cannot be read as CSV: {error}"))
            break
        if row is None:
            break
        place, last = f"{name}:{last + 1}", rows.line_num
        if not any(cell.strip() for cell in row):
            continue
        if not columns:
            columns = [_column(cell) for cell in row]
            twice = {c for c in columns if c and columns.count(c) > 1}
            problems += [Problem(place, f"column {c[:60]!r} is there twice") for c in sorted(twice)]
        elif len(row) != len(columns):
            problems.append(
                Problem(
                    place,
                    f"has {len(row)} cells, the header {len(columns)}; put in quotes "
                    f"what holds a {separator!r}",
                )
            )
        else:
            pairs = zip(columns, row, strict=True)
            lines.append(Line(place, {column: cell.strip() for column, cell in pairs if column}))
    return Lines(dict.fromkeys(filter(None, columns), f"{name}:1"), tuple(lines), tuple(problems))


def _yaml_lines(text: str, name: str) -> Lines:
    """A list of mappings, alone or under ``recordings``."""
    found = Lines({}, (), ())
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_DEPTH:
                return found._replace(problems=(Problem(name, "is nested too deeply"),))
            if isinstance(event, yaml.AliasEvent):  # a few stand for more than memory holds
                what = "aliases, as *name, are not read"
                return found._replace(
                    problems=(Problem(f"{name}:{event.start_mark.line + 1}", what),)
                )
        node = yaml.compose(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        what = getattr(error, "problem", None) or error
        place = f"{name}:{mark.line + 1}" if mark else name
        return found._replace(problems=(Problem(place, f"cannot be read as YAML: {what}"),))
    if isinstance(node, yaml.MappingNode) and len(node.value) == 1:
        key, inner = node.value[0]
        node = inner if key.value == "recordings" else node
    if not isinstance(node, yaml.SequenceNode):
        what = "must be a list of recordings, as - {file: a.csv, material: wood}"
        return found._replace(problems=(Problem(f"{name}:1", what),))
    columns: dict[str, str] = {}
    lines: list[Line] = []
    problems: list[Problem] = []
    for item in node.value:
        place = f"{name}:{item.start_mark.line + 1}"
        if not isinstance(item, yaml.MappingNode):
            problems.append(Problem(place, "must be a mapping, as {file: a.csv, material: wood}"))
            continue
        cells: dict[str, Cell] = {}
        for key, value in item.value:
            here = f"{name}:{key.start_mark.line + 1}"
            column, cell = _column(str(key.value)), _cell(value)
            columns.setdefault(column, here)
            if column in cells:
                problems.append(Problem(here, f"{column[:60]!r} is there twice"))
            if cell is None:
                problems.append(Problem(here, f"{column[:60]} must be a value or a list of values"))
            cells[column] = cell or ""
        lines.append(Line(place, cells))
    return Lines(columns, tuple(lines), tuple(problems))


def _cell(node: yaml.Node) -> Cell | None:
    """Text or lists of text; ``None`` for what is neither."""
    if isinstance(node, yaml.ScalarNode):
        return "" if node.tag == "tag:yaml.org,2002:null" else str(node.value).strip()
    if not isinstance(node, yaml.SequenceNode):
        return None
    cells = [_cell(item) for item in node.value]
    return None if None in cells else [cell for cell in cells if cell is not None]


def _column(text: str) -> str:
    return "_".join(text.lower().split())
