"""The authors' raw files as a source (REFERENCE.md section 1): ``<stem>-slip<trial>.txt``.

One text table a cycle: a column of times, then the 24 channels. The names say material and trial.
Nothing in the files says when the contact slid; unless a manifest does, onsets and slides are the
nominal ones of the protocol, which the arm follows and the contact a little later.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.sets.datasets import FileRecordings
from tactslip_torch.data.sets.manifest import (
    Entry,
    Listing,
    better_told,
    manifest_of,
    read_manifest,
)
from tactslip_torch.data.sets.manifest_lines import Problem
from tactslip_torch.data.sets.truth import Truth
from tactslip_torch.hand import HandLayout

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
_NAME = re.compile(r"(.+)-slip(\d{1,9})\.txt", re.IGNORECASE)


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
    folder = Path(root)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder at {folder}")
    listing = named_files(folder, stems, nominal(speeds_mm_s, distance_mm, pause_s))
    if not listing.entries and not listing.problems:
        raise ValueError(
            f"no file in {folder} is named as the authors' are, such as {next(iter(stems))}-slip1"
            ".txt; for other names use data=files"
        )
    if manifest is not None:
        listing = better_told(listing, read_manifest(manifest_of(folder, manifest), folder))
    rows = HandLayout.paper24().to_rows() if channels is None else channels
    return FileRecordings(folder, manifest=listing, channels=rows, **options)


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
    for path in sorted(root.rglob("*.[tT][xX][tT]")):
        file = path.relative_to(root).as_posix()
        found = _NAME.fullmatch(path.name)
        if found is None or any(part.startswith(".") for part in path.relative_to(root).parts):
            continue
        if not path.resolve().is_relative_to(root.resolve()):
            problems.append(Problem(file, "is a link out of the folder; copy it there"))
            continue
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
