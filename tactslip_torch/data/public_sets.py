"""Sets whose layout is known: file names that say what they are, and the authors' raw files.

Where a set is laid out as ``<class>/<object><trial>.csv``, a regular expression with named groups
reads material, trial, scene and label from each path.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.manifest import (
    Entry,
    Label,
    Listing,
    Problem,
    Truth,
    better_told,
    manifest_of,
    read_manifest,
)
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.hand import HandLayout

_Match = tuple[str, re.Match[str]]
GROUPS = ("material", "trial", "scene", "label")
_LABELS: Mapping[str, Label] = {"slip": "slip", "non-slip": "non-slip"}


def named_recordings(
    root: str | Path,
    *,
    pattern: str,
    labels: Mapping[str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    manifest: str | None = None,
    **options: Any,
) -> FileRecordings:
    """The recordings of a folder and its folders whose paths match a pattern.

    Args:
        root: the folder.
        pattern: a regular expression that a path relative to the folder, with ``/`` between its
            parts, must match as a whole. Its group ``material`` must be there; ``trial`` (a
            number), ``scene`` and ``label`` may be.
        labels: ``slip`` or ``non-slip`` for each text of the group ``label``, or of ``scene`` if
            there is no such group; ``None``: the text is one of the two, or nothing is known.
        rename: materials that names spell otherwise.
        manifest: a file that says of some or all files what names do not, relative to the folder;
            ``None`` for none.
        options: further ones of ``FileRecordings``.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if the pattern is none or no path matches it, or as ``FileRecordings``.
    """
    listing = listed(Path(root), _checked(pattern), _known(labels), rename or {})
    if not listing.entries and not listing.problems:
        raise ValueError(f"no file in {root} has a path that matches data.pattern={pattern!r}")
    return _set_of(listing, root, manifest, options)


def _set_of(
    listing: Listing, root: str | Path, manifest: str | None, options: Mapping[str, Any]
) -> FileRecordings:
    """The recordings of a listing, better told by a manifest if there is one."""
    if manifest is not None:
        told = read_manifest(manifest_of(Path(root), manifest), Path(root))
        listing = better_told(listing, told)
    return FileRecordings(root, manifest=listing, **options)


def _matching(root: Path, pattern: re.Pattern[str], problems: list[Problem]) -> Iterator[_Match]:
    """The files below a folder whose paths match as a whole, sorted; none that is hidden.

    Raises:
        FileNotFoundError: if there is no such folder.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"no folder at {root}")
    for path in sorted(root.rglob("*")):
        file = path.relative_to(root).as_posix()
        found = pattern.fullmatch(file)
        if found is None or any(part.startswith(".") for part in file.split("/")):
            continue
        if path.resolve().is_relative_to(root.resolve()):
            yield file, found
        else:
            problems.append(Problem(file, "is a link out of the folder; copy it there"))


def listed(
    root: Path,
    pattern: re.Pattern[str],
    labels: Mapping[str, Label] | None,
    rename: Mapping[str, str],
) -> Listing:
    """The files below a folder that match, sorted by path, and what is wrong with their names."""
    told = next((name for name in ("label", "scene") if name in pattern.groupindex), None)
    entries: list[Entry] = []
    problems: list[Problem] = []
    taken: dict[RecordingId, str] = {}
    counts: dict[tuple[str, str], int] = {}
    for file, found in _matching(root, pattern, problems):
        groups = found.groupdict()
        material = rename.get(groups["material"], groups["material"])
        scene = groups.get("scene") or RecordingId.scene
        number = counts[material, scene] = counts.get((material, scene), -1) + 1
        trial = groups.get("trial") or str(number)
        if not trial.isdecimal():
            problems.append(Problem(file, f"trial {trial!r} is no number"))
            continue
        recording = RecordingId(material, int(trial), scene)
        if recording in taken:
            problems.append(Problem(file, f"is {recording}, as {taken[recording]} is"))
            continue
        taken[recording] = file
        word = groups.get(told) if told else None
        label = (labels if labels is not None else _LABELS).get(word or "")
        if labels is not None and label is None:
            known = ", ".join(labels)
            problems.append(Problem(file, f"{told} {word!r} is none of data.labels: {known}"))
            continue
        entries.append(Entry(file, file, recording, Truth(label=label) if label else None))
    return Listing(tuple(entries), tuple(problems))


def _checked(pattern: str) -> re.Pattern[str]:
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise ValueError(f"data.pattern={pattern!r} is no regular expression: {error}") from None
    unknown = sorted(set(compiled.groupindex) - set(GROUPS))
    if unknown or "material" not in compiled.groupindex:
        raise ValueError(
            f"data.pattern must have a group (?P<material>...) and may have {', '.join(GROUPS[1:])}"
            f", got {', '.join(compiled.groupindex) or 'none'}"
        )
    return compiled


def _known(labels: Mapping[str, str] | None) -> Mapping[str, Label] | None:
    if labels is None:
        return None
    wrong = [word for word in labels.values() if word not in _LABELS]
    if wrong:
        raise ValueError(f"data.labels must be of slip and non-slip, got {wrong[0]!r}")
    return {text: _LABELS[word] for text, word in labels.items()}


STEMS: Mapping[str, str] = {
    "abs": "M1",
    "lb": "M2",
    "bxlb": "M3",
    "ypz": "M4",
    "ykl": "M5",
    "dg": "M6",
    "Iron": "iron",
    "bj": "cloth",
    "Cu": "copper",
    "wood": "wood",
}
"""What stands in names for each material; small and capital letters are alike."""
_NAME = re.compile(r"(?:.*/)?([^/]+)-slip(\d{1,9})\.txt", re.IGNORECASE)


def authors_raw(
    root: str | Path,
    *,
    manifest: str | None = None,
    stems: Mapping[str, str] = STEMS,
    speeds_mm_s: Sequence[float] = (20.0, 40.0, 60.0),
    distance_mm: float = 100.0,
    pause_s: float = 2.0,
    channels: Iterable[Mapping[str, str]] | None = None,
    **options: Any,
) -> FileRecordings:
    """The recordings of a folder and its folders that are named as the authors' are.

    Args:
        root: the folder.
        manifest: a file that says onsets or slides of some or all files better than the protocol
            does, relative to the folder; ``None`` for none.
        stems: what stands in names for each material.
        speeds_mm_s: of the strokes.
        distance_mm: of each stroke.
        pause_s: before each stroke.
        channels: rows for ``HandLayout.from_rows``; ``None`` for the paper's hand.
        options: further ones of ``FileRecordings``.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if no file is named so, or as ``FileRecordings``.
    """
    listing = named_files(Path(root), stems, nominal(speeds_mm_s, distance_mm, pause_s))
    if not listing.entries and not listing.problems:
        raise ValueError(
            f"no file in {root} is named as the authors' are, such as {next(iter(stems))}-slip1"
            ".txt; for other names use data=files"
        )
    rows = HandLayout.paper24().to_rows() if channels is None else channels
    return _set_of(listing, root, manifest, {"channels": rows, **options})


def nominal(speeds_mm_s: Sequence[float], distance_mm: float, pause_s: float) -> Truth:
    """Strokes one behind the other, a pause before each.

    Example:
        >>> nominal((20.0, 40.0, 60.0), 100.0, 2.0).onsets_s
        (2.0, 9.0, 13.5)
    """
    if not speeds_mm_s or not all(v > 0 for v in (*speeds_mm_s, distance_mm, pause_s)):
        raise ValueError(
            "data.speeds_mm_s, data.distance_mm and data.pause_s must be positive, got "
            f"{list(speeds_mm_s)}, {distance_mm} and {pause_s}"
        )
    slides = []
    end = 0.0
    for speed in speeds_mm_s:
        start = end + pause_s
        end = start + distance_mm / speed
        slides.append((start, end))
    onsets = tuple(start for start, _ in slides)
    return Truth(onsets, speeds_mm_s=tuple(map(float, speeds_mm_s)), sliding_s=tuple(slides))


def named_files(root: Path, stems: Mapping[str, str], truth: Truth) -> Listing:
    """The files below a folder that are named so, by material and trial, all with one truth."""
    materials = {stem.lower(): material for stem, material in stems.items()}
    order = list(dict.fromkeys(stems.values()))
    entries: list[Entry] = []
    problems: list[Problem] = []
    first: dict[RecordingId, str] = {}
    for file, found in _matching(root, _NAME, problems):
        material = materials.get(found[1].lower())
        if material is None:
            close = difflib.get_close_matches(found[1], stems, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            what = f"its name begins with none of {', '.join(stems)}{hint}; data.stems names more"
            problems.append(Problem(file, what))
            continue
        recording = RecordingId(material, int(found[2]))
        if recording in first:
            what = f"is trial {recording.cycle} of {material}, as {first[recording]} is"
            problems.append(Problem(file, what))
            continue
        first[recording] = file
        entries.append(Entry(file, file, recording, truth, is_nominal=True))
    entries.sort(key=lambda entry: (order.index(entry.recording.material), entry.recording))
    return Listing(tuple(entries), tuple(problems))
