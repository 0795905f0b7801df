"""Sets whose file names say what they are, of any layout or of the authors' raw files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from tactslip_torch.data.file_names import name_pattern, word_choices
from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.folder import guessed, recording_files
from tactslip_torch.data.labels import label_of
from tactslip_torch.data.manifest import (
    Entry,
    Listing,
    Problem,
    manifest_of,
    read_manifest,
    twice,
    with_manifest,
)
from tactslip_torch.data.recording import RecordingId, Timeline
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
"""What stands in names of the authors' files for each material; capitals do not matter."""


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
        pattern: of a file's name, or of the end of its path, as ``folder.guessed`` reads it; it
            names ``{material}``, and may name ``{trial}``, ``{scene}``, ``{session}`` and
            ``{label}``; ``"auto"``: what ``tactslip setup`` would propose.
        labels: ``slip`` or ``non-slip`` for each text of ``{label}``, or of ``{scene}`` if
            the pattern has no label; ``None``: the text is one of the two, or nothing is known.
        rename: materials that names spell otherwise, in capitals or not.
        manifest: a file that says of some or all files what names do not, relative to the folder;
            ``None`` for none.
        options: further ones of ``FileRecordings``.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if the pattern is none or no path matches it, or as ``FileRecordings``.
    """
    listing = _listed(Path(root), pattern, labels, rename or {})
    return _set_of(listing, root, manifest, options)


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
    truth = nominal(speeds_mm_s, distance_mm, pause_s)
    found = _listed(Path(root), "{material}-slip{trial}", None, stems)
    entries, problems = [], list(found.problems)
    for entry in found.entries:
        if entry.recording.material in stems.values():
            entries.append(replace(entry, truth=truth, is_nominal=True))
        else:
            what = f"its name begins with none of {', '.join(stems)}; data.stems names more"
            problems.append(Problem(entry.file, what))
    listing = Listing(tuple(entries), tuple(problems))
    rows = HandLayout.paper24().to_rows() if channels is None else channels
    return _set_of(listing, root, manifest, {"channels": rows, **options})


def nominal(speeds_mm_s: Sequence[float], distance_mm: float, pause_s: float) -> Timeline:
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
    slides: list[tuple[float, float]] = []
    for speed in speeds_mm_s:
        start = (slides[-1][1] if slides else 0.0) + pause_s
        slides.append((start, start + distance_mm / speed))
    onsets = tuple(start for start, _ in slides)
    return Timeline(onsets, speeds_mm_s=tuple(map(float, speeds_mm_s)), sliding_s=tuple(slides))


def _listed(
    root: Path, pattern: str, labels: Mapping[str, str] | None, rename: Mapping[str, str]
) -> Listing:
    """The recordings below a folder that a pattern names, by path, and what is wrong with names.

    Arguments and errors as of ``named_recordings``.
    """
    files = {p.relative_to(root).as_posix(): p for p in recording_files(root, in_folders=True)}
    if pattern == "auto":
        names = sorted(files)
        both = {"slip", "non-slip"}
        choices = (words for words in word_choices(names) if set(map(label_of, words)) == both)
        pattern = name_pattern(names, next(choices, ())).pattern
    if "{material" not in pattern:
        raise ValueError(f"data.pattern must name {{material}}, got {pattern!r}")
    if wrong := [word for word in (labels or {}).values() if label_of(word) is None]:
        raise ValueError(f"data.labels must be of slip and non-slip, got {wrong[0]!r}")
    renamed = {old.lower(): new for old, new in rename.items()}
    entries: list[Entry] = []
    problems: list[Problem] = []
    counts: Counter[tuple[str, str, str]] = Counter()
    for file, path in sorted(files.items(), key=itemgetter(1)):
        found = guessed(file, pattern)
        if not found:
            continue
        material = renamed.get(found["material"].lower(), found["material"])
        scene = found.get("scene", RecordingId.scene)
        session = found.get("session", "")
        trial = found.get("trial", str(counts[material, scene, session]))
        counts[material, scene, session] += 1
        word = found.get("label", scene)
        label = label_of(word if labels is None else labels.get(word, ""))
        if not path.resolve().is_relative_to(root.resolve()):
            problems.append(Problem(file, "is a link out of the folder; copy it there"))
        elif not trial.isdecimal():
            problems.append(Problem(file, f"trial {trial!r} is no number"))
        elif labels is not None and label is None:
            known = ", ".join(labels)
            problems.append(Problem(file, f"{word!r} is none of data.labels: {known}"))
        else:
            truth = Timeline(label=label) if label else None
            recording = RecordingId(material, int(trial), scene, session)
            entries.append(Entry(file, file, recording, truth))
    if not entries and not problems:
        raise ValueError(f"no file in {root} has a path that matches data.pattern={pattern!r}")
    return Listing(tuple(entries), tuple(problems))


def _set_of(
    listing: Listing, root: str | Path, manifest: str | None, options: Mapping[str, Any]
) -> FileRecordings:
    """The recordings of a listing, with what a manifest says if there is one."""
    listing = listing._replace(problems=(*listing.problems, *twice(listing.entries)))
    if manifest is not None:
        listing = with_manifest(
            listing, read_manifest(manifest_of(Path(root), manifest), Path(root))
        )
    return FileRecordings(root, manifest=listing, **options)
