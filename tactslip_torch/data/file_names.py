"""What the names of recordings tell: a pattern that reads object, trial, session and label of each.

Names and folders are split into words, numbers and dates. Words that change together are one part.
The part that tells most words, each in two files or more, is the object.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Literal, NamedTuple

from tactslip_torch.data.folder import guessed

_Kind = Literal["word", "number", "date", "text"]
_TOKEN = re.compile(
    r"(?:(?<![^\W\d_])(?:no|non|not)[-_ .]?slip(?:ping)?(?![^\W\d_]))"
    r"|(?P<date>(?<!\d)(?:19|20)\d\d([-_.]?)[01]\d\2[0-3]\d(?!\d)(?:[-_T. ]\d\d(?!\d)){0,3})"
    r"|(?P<number>\d+)|[^\W\d_]+",
    re.IGNORECASE,
)
_SESSIONS = frozenset(["session", "sess", "day", "run", "mounting", "mount"])
"""Words in front of the number or word of a session."""
_OBJECTS = frozenset(["object", "obj", "material", "mat", "item"])
"""Words in front of the number of an object."""
_MOST_SCENES = 8
_FEW = 0.9  # of the files have a value that two files or more have


@dataclass(frozen=True)
class _Part:
    """A part of all names.

    Args:
        segment: 0 for the file, -1 for its folder, and so on.
        before: what stands between it and the part before it.
        kind: of its values.
        values: of each file.
    """

    segment: int
    before: str
    kind: _Kind
    values: tuple[str, ...]

    @property
    def counts(self) -> Counter[str]:
        return Counter(self.values)

    @property
    def is_fixed(self) -> bool:
        return len(set(self.values)) == 1

    @property
    def is_repeated(self) -> bool:
        """Whether it has several values, and nearly all files share theirs with another."""
        counts = self.counts
        shared = sum(count for count in counts.values() if count > 1)
        return len(counts) > 1 and shared >= _FEW * len(self.values)


class _NamePattern(NamedTuple):
    """How the names of a set are read.

    Args:
        pattern: that ``folder.guessed`` reads each name by, in one way.
        fields: what it gives of each file, in order.
        is_simple: whether names show no object, so that each file is its own.
    """

    pattern: str
    fields: tuple[Mapping[str, str], ...]
    is_simple: bool = False


def word_choices(files: Sequence[str]) -> list[tuple[str, ...]]:
    """Words that names and folders tell apart, those of one place together, the fewest first."""
    words = [part for part in _parts(files) if part.kind != "number" and part.is_repeated]
    found = [tuple(sorted(part.counts)) for part in words]
    return sorted(dict.fromkeys(found), key=len)


def name_pattern(files: Sequence[str], label_words: Sequence[str] = ()) -> _NamePattern:
    """The pattern that reads each name one way, as many of its parts as can be told.

    Args:
        files: relative to their folder, with ``/`` between folders, endings included.
        label_words: words that say what a recording is labelled; the part that holds all of them
            is the label.

    Example:
        >>> objects = ("soup_can", "cup")
        >>> files = [f"{name}_{side}_{n}.csv" for name in objects for side in "AB" for n in "12"]
        >>> name_pattern(files).pattern
        '{material}_{scene:A|B}_{trial}'
    """
    parts = _parts(files)
    fields = _fields(parts, {word.lower() for word in label_words})
    for pattern in _patterns(parts, fields):
        if (read := _read(files, pattern, parts, fields)) is not None:
            return _NamePattern(pattern, read)
    simple = "{material}"
    return _NamePattern(simple, tuple(guessed(file, simple) for file in files), True)


# Parts of names -----------------------------------------------------------------------------------


class _Token(NamedTuple):
    before: str
    kind: _Kind
    text: str


def _tokens(segment: str) -> list[_Token]:
    found, end = [], 0
    for match in _TOKEN.finditer(segment):
        kind: _Kind = "word"
        if match["date"] or match["number"]:
            kind = "date" if match["date"] else "number"
        found.append(_Token(segment[end : match.start()], kind, match.group()))
        end = match.end()
    return found


def _parts(files: Sequence[str]) -> list[_Part]:
    """The parts of names, from the outermost folder that all have to the end of the file's."""
    paths = [(*PurePosixPath(file).parts[:-1], PurePosixPath(file).stem) for file in files]
    depth = min(map(len, paths), default=0)
    parts: list[_Part] = []
    for segment in range(1 - depth, 1):
        parts += _aligned([path[segment - 1] for path in paths], segment)
    return _merged(parts)


def _aligned(segments: Sequence[str], segment: int) -> list[_Part]:
    """The parts of file names, or of folders at one depth; from the ends, if their number differs.

    What is the same at the start of all is apart, then as much as is alike at their ends; what
    is left in the middle is one part.
    """
    rows = [_tokens(text) for text in segments]
    least = min(map(len, rows))
    if not least:
        return [_Part(segment, "", "text", tuple(segments))]

    def are_alike(place: int) -> bool:
        return len({(row[place].before, row[place].kind) for row in rows}) == 1

    if len({len(row) for row in rows}) == 1 and all(map(are_alike, range(1, least))):
        first = {(row[0].before, row[0].kind) for row in rows}
        if len(first) == 1:
            return [_column(rows, place, segment) for place in range(least)]
    left = right = 0
    while left < least - 1 and are_alike(left) and len({row[left].text for row in rows}) == 1:
        left += 1
    while right < least - left - 1 and are_alike(-1 - right):
        right += 1
    middle = [row[left : len(row) - right] for row in rows]
    texts = ["".join(t.before + t.text for t in tokens) for tokens in middle]
    before = {tokens[0].before for tokens in middle}
    same = before.pop() if len(before) == 1 else ""
    whole = _Part(segment, same, "text", tuple(text.removeprefix(same) for text in texts))
    lefts = [_column(rows, place, segment) for place in range(left)]
    return [*lefts, whole, *(_column(rows, place, segment) for place in range(-right, 0))]


def _column(rows: Sequence[Sequence[_Token]], place: int, segment: int) -> _Part:
    token = rows[0][place]
    return _Part(segment, token.before, token.kind, tuple(row[place].text for row in rows))


def _merged(parts: Sequence[_Part]) -> list[_Part]:
    """The parts; neighbours of which one tells the other are one."""
    merged: list[_Part] = []
    for part in parts:
        if merged and _go_together(merged[-1], part):
            last = merged.pop()
            values = zip(last.values, part.values, strict=True)
            joined = tuple(f"{one}{part.before}{other}" for one, other in values)
            part = replace(last, kind="text", values=joined)
        merged.append(part)
    return merged


def _go_together(one: _Part, other: _Part) -> bool:
    """Whether two parts are words of one folder or name, and one of them tells the other."""
    are_words = not {one.kind, other.kind} & {"number", "date"}
    if one.segment != other.segment or one.is_fixed or other.is_fixed or not are_words:
        return False
    num = len(set(zip(one.values, other.values, strict=True)))
    return num == max(len(one.counts), len(other.counts))


# Fields -------------------------------------------------------------------------------------------


def _fields(parts: Sequence[_Part], label_words: set[str]) -> dict[int, str]:
    """What each part is, by its place; those that are nothing of it are left out."""
    found: dict[int, str] = {}
    varied = [place for place, part in enumerate(parts) if not part.is_fixed]

    def before(place: int) -> str:
        last = parts[place - 1] if place else None
        is_word = last is not None and last.is_fixed and last.segment == parts[place].segment
        return last.values[0].lower() if last is not None and is_word else ""

    def take(field: str, places: Sequence[int]) -> None:
        if places and field not in found.values():
            found[places[0]] = field

    def free() -> list[int]:
        return [place for place in varied if place not in found]

    if label_words:
        take(
            "label",
            [p for p in free() if label_words <= {value.lower() for value in parts[p].counts}],
        )
    repeated = [p for p in free() if parts[p].is_repeated]
    take(
        "session",
        [p for p in repeated if parts[p].kind == "date" or before(p) in _SESSIONS],
    )
    words = [p for p in free() if parts[p].is_repeated and parts[p].kind in ("word", "text")]
    most = sorted(words, key=lambda p: (-len(parts[p].counts), -parts[p].segment))  # names first
    take("material", most)
    take("material", [p for p in free() if parts[p].is_repeated and before(p) in _OBJECTS])
    take("scene", [p for p in free() if p in words and len(parts[p].counts) <= _MOST_SCENES])
    take("trial", [p for p in reversed(free()) if parts[p].kind == "number"])
    if "trial" in found.values():  # numbers of one object, whose name all files have
        alike = [p for p, part in enumerate(parts) if part.is_fixed and part.segment == 0]
        take("material", [p for p in alike if parts[p].kind in ("word", "text")])
    return found


def _patterns(parts: Sequence[_Part], fields: Mapping[int, str]) -> Iterator[str]:
    """Patterns, the plainest first: with few lists of values, and with the trial's number."""
    if "material" not in fields.values():
        return
    first = min(parts[place].segment for place in fields)
    for with_trial in (True, False):
        for listed in (("scene",), ("scene", "material"), ("scene", "material", "label")):
            yield _pattern(parts, fields, first, listed, with_trial)


def _pattern(
    parts: Sequence[_Part],
    fields: Mapping[int, str],
    first: int,
    listed: Sequence[str],
    with_trial: bool,
) -> str:
    text = ""
    for place, part in enumerate(parts):
        if part.segment < first:
            continue
        if place and parts[place - 1].segment != part.segment and text:
            text += "/"
        field = fields.get(place)
        if field == "trial" and not with_trial:
            field = None
        if field is not None and field in listed:
            field += f":{'|'.join(sorted(part.counts))}"
        literal = part.values[0] if part.is_fixed else "*"
        text += part.before + (f"{{{field}}}" if field else literal)
    return re.sub(r"\*(?:[-_. ]*\*)+", "*", text)


def _read(
    files: Sequence[str], pattern: str, parts: Sequence[_Part], fields: Mapping[int, str]
) -> tuple[Mapping[str, str], ...] | None:
    """What a pattern gives of each file, if that is what its parts are, and no two are the same."""
    wanted = {field: parts[place].values for place, field in fields.items()}
    found = []
    for number, file in enumerate(files):
        try:
            read = guessed(file, pattern)
        except ValueError:
            return None
        if not read or any(read[field] != wanted[field][number] for field in read):
            return None
        found.append(read)
    if "{trial}" in pattern:
        names = [
            (read["material"], int(read["trial"]), read.get("scene"), read.get("session"))
            for read in found
        ]
        if len(set(names)) < len(names):
            return None
    return tuple(found)
