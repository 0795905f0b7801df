"""A manifest to fill in: every recording of a folder, its material and trial guessed from its name.

A pattern says how names are made, such as ``{material}_{trial}`` or, with a stroke, how the whole
path below the folder is, such as ``{scene}/{material}{trial}``. A star stands for anything.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import NamedTuple

from tactslip_torch.data.formats import endings, find_format
from tactslip_torch.data.sets.manifest import NAMES
from tactslip_torch.files import whole_file

FIELDS = {"material": r"[^/]+?", "trial": r"\d+", "scene": r"[^/]+?", "label": r"[^/]+?"}
"""What a pattern may name, and what each stands for."""
COLUMNS = (
    *("file", "material", "trial", "scene"),
    *("onsets_s", "sliding_s", "slip_s", "non_slip_s", "label"),
)
_BETWEEN = "-_. "


class Template(NamedTuple):
    """A manifest that was written.

    Args:
        path: of it.
        num_files: it lists.
        num_guessed: of which the pattern told anything.
    """

    path: Path
    num_files: int
    num_guessed: int


def found_files(root: Path) -> list[str]:
    """Every recording in a folder and its folders, relative to it; of a bag the folder.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if there is no recording in it.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    found: list[str] = []
    folders = [root]
    while folders:
        for path in sorted(folders.pop().iterdir()):
            if path.name.startswith(".") or path.name in NAMES:
                continue
            if find_format(path) is not None:
                found.append(path.relative_to(root).as_posix())
            elif path.is_dir() and not path.is_symlink():
                folders.append(path)
    if not found:
        known = ", ".join(f".{ending}" for ending in endings())
        raise ValueError(f"no recording in {root}; files that can be read end in {known}")
    return sorted(found)


def guesser(pattern: str) -> re.Pattern[str]:
    """A pattern as an expression for names without their ending.

    Blanks, dots, strokes and underlines around a material or scene are no part of it.

    Raises:
        ValueError: if it names what is none of ``FIELDS``, or one twice, or nothing.

    Example:
        >>> guesser("{material}{trial}").fullmatch("oil paper-slip_07").groupdict()
        {'material': 'oil paper-slip', 'trial': '07'}
    """
    parts = re.split(r"\{(\w*)\}", pattern)
    names = parts[1::2]
    if not names or set(names) - set(FIELDS) or len(set(names)) < len(names):
        raise ValueError(
            f"pattern must name each of {', '.join(f'{{{name}}}' for name in FIELDS)} at most "
            f"once, as {{material}}_{{trial}}, got {pattern!r}"
        )
    expression = ""
    for place, part in enumerate(parts):
        if place % 2:
            between = f"[{re.escape(_BETWEEN)}]*" if part in ("material", "scene") else ""
            expression += f"(?P<{part}>{FIELDS[part]}){between}"
        else:
            expression += "[^/]*".join(re.escape(piece) for piece in part.split("*"))
    return re.compile(expression)


def guessed(file: str, pattern: str) -> dict[str, str]:
    """What a pattern tells of a file by its name, or by its path if the pattern has a stroke."""
    path = Path(file)
    name = path.with_suffix("").as_posix() if "/" in pattern else path.stem
    found = guesser(pattern).fullmatch(name)
    return found.groupdict() if found else {}


def write_template(root: Path, pattern: str, path: Path | None = None) -> Template:
    """Write a manifest of all recordings of a folder, its label columns empty.

    Args:
        root: the folder.
        pattern: of names.
        path: of the manifest; ``None`` for ``manifest.csv`` in the folder.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if there is a manifest already, no recording, or the pattern is none.
    """
    there = [root / name for name in NAMES] if path is None else [path]
    for other in there:
        if other.exists():
            raise ValueError(f"{other} is there already; move it away, or give output=FILE")
    path = root / NAMES[0] if path is None else path
    guesses = {file: guessed(file, pattern) for file in found_files(root)}
    with (
        whole_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as stream,
    ):
        table = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows({"file": file, **guess} for file, guess in guesses.items())
    return Template(path, len(guesses), sum(map(bool, guesses.values())))
