"""Folders of recordings that are written: one file each, found again by its key, and a manifest."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.formats import (
    Archived,
    Format,
    endings,
    find_format,
    format_of,
    named_format,
)
from tactslip_torch.data.manifest import MOMENTS, STRETCHES, write_table
from tactslip_torch.data.recording import Recording, RecordingId, RecordingSource

MANIFEST = "manifest.csv"


def recording_files(place: Path) -> list[Path]:
    """The file, or those of a folder that are of a known format, by name.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ValueError: if the ending is unknown, or the folder holds no such file.
    """
    if place.is_dir() and find_format(place) is None:
        found = [p for p in sorted(place.iterdir()) if p.name != MANIFEST and find_format(p)]
        if not found:
            known = " or ".join(f".{ending}" for ending in endings())
            raise ValueError(f"no recording in {place}; give a folder of {known} files")
        return found
    format_of(place)
    return [place]


def file_facts(path: Path, archived: Archived | None) -> dict[str, Any]:
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


def has_truth(recording: Recording) -> bool:
    """Whether it says where slip is and where not; one that nobody annotated does not."""
    is_told = recording.onsets_s or recording.non_slip_s or recording.slip_s
    return bool(is_told or recording.provenance.get("simulated"))


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

    Raises:
        ValueError: if there is no such format.
    """

    source: RecordingSource
    folder: Path
    ending: str
    made_by: Mapping[str, Any]
    given: str = "folder"

    def __post_init__(self) -> None:
        _ = self.format  # refuses an unknown one

    @property
    def format(self) -> Format:
        """How its files are written and read."""
        return named_format(self.ending)

    def path(self, recording: RecordingId) -> Path:
        """The recording's file: beside the others as the one it was read from, if there is one."""
        ending = self.ending if self.ending in self.format.endings else self.format.endings[0]
        if isinstance(self.source, FileRecordings):
            return (self.folder / self.source.entry(recording).file).with_suffix(f".{ending}")
        session = f"_session{recording.session}" if recording.session else ""
        name = f"{recording.material}_{recording.scene}_{recording.cycle:02d}{session}"
        return self.folder / f"{name}.{ending}"

    def key(self, recording: RecordingId) -> dict[str, Any]:
        """What determines the recording's file, as JSON gives it back."""
        facts: dict[str, Any] = {
            "recording": {"name": recording.scene, **self.source.key(recording)},
            "material": recording.material,
            **self.made_by,
        }
        times = self.source.timeline(recording)
        facts["truth"] = {name: getattr(times, name) for name in (*MOMENTS, *STRETCHES)}
        if isinstance(self.source, FileRecordings):
            facts["units"] = self.source.units
        plain: dict[str, Any] = json.loads(json.dumps(facts, allow_nan=False))
        return plain

    def check(self) -> None:
        """Refuse names that files cannot have, and to replace a file that is not ours.

        Raises:
            ValueError: if there is such a name or file.
        """
        if not self.source.ids:
            raise ValueError("no recording to write; give at least one of materials=[M1,...]")
        root = self.source.root if isinstance(self.source, FileRecordings) else None
        if root is not None and self.folder.resolve() == root.resolve():
            raise ValueError("output must be another folder than root, which stays as it is")
        first: dict[Path, RecordingId] = {}
        for recording in self.source.ids:
            path = self.path(recording)
            is_name = path.parent == self.folder and re.fullmatch(r"[\w.+-]+", path.name)
            if root is None and not is_name:
                raise ValueError(f"{path.name!r} cannot name a file; give the scene another name")
            if path in first:
                raise ValueError(
                    f"{first[path]} and {recording} would both become {path.name}; rename one"
                )
            first[path] = recording
            if path.exists():
                try:
                    self.format.key(path)
                except ValueError as error:
                    what = f"move it away, or give another {self.given}"
                    raise ValueError(f"{error}; {what}") from error

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
        except (FileNotFoundError, ValueError):  # not there, or ours but damaged: see check
            content = None
        made = content is None
        if content is None:
            content = self.source.load(recording)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.format.save(path, content, self.source.hand, key)
        inner = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
        times, origin = self.source.timeline(recording), content.provenance
        line = {
            "file": path.relative_to(self.folder).as_posix(),
            "material": recording.material,
            "trial": recording.cycle,
            "scene": recording.scene,
            "session": recording.session,
            **{name: json.dumps(getattr(times, name)) for name in (*MOMENTS, *STRETCHES)},
            "sample_rate_hz": content.sample_rate_hz,
            "simulated": str(bool(origin.get("simulated"))).lower(),
            "fidelity": origin.get("fidelity", ""),
            "seed": origin.get("seed", ""),
        }
        num_bytes = sum(file.stat().st_size for file in inner)
        return Written(line, made, content.duration_s, num_bytes)


def write_manifest(folder: Path, written: Sequence[Written]) -> None:
    """Write the lines of recordings to ``manifest.csv``, whole or not at all."""
    write_table(folder / MANIFEST, list(written[0].line), [one.line for one in written])
