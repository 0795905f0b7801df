"""Files whose names say what they are, as a source: a pattern instead of a manifest.

Where a set is laid out as ``<class>/<object><trial>.csv``, a regular expression with named groups
reads material, trial, scene and label from each path.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
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
from tactslip_torch.data.sets.truth import Label, Truth

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
    folder = Path(root)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder at {folder}")
    listing = listed(folder, _checked(pattern), _known(labels), rename or {})
    if not listing.entries and not listing.problems:
        raise ValueError(f"no file in {folder} has a path that matches data.pattern={pattern!r}")
    if manifest is not None:
        listing = better_told(listing, read_manifest(manifest_of(folder, manifest), folder))
    return FileRecordings(folder, manifest=listing, **options)


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
    for path in sorted(root.rglob("*")):
        parts = path.relative_to(root).parts
        file = "/".join(parts)
        found = pattern.fullmatch(file)
        if found is None or any(part.startswith(".") for part in parts):
            continue
        if not path.resolve().is_relative_to(root.resolve()):
            problems.append(Problem(file, "is a link out of the folder; copy it there"))
            continue
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
