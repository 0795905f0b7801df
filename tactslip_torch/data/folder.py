"""A folder of recordings: one file each, found again by what determined it, and a manifest."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from tactslip_torch.data.formats import (
    Archived,
    Format,
    Opened,
    endings,
    find_format,
    format_of,
    named_format,
)
from tactslip_torch.data.recording import Recording, RecordingId, RecordingSource
from tactslip_torch.runtime import whole_file

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


def refuse_other_channels(path: Path, opened: Opened, rows: Sequence[Mapping[str, str]]) -> None:
    """Raise if a recording is not of the hand with these channels, in this order.

    Of samples alone only the number of channels is known.

    Raises:
        ValueError: if there are others, naming the first.
    """
    theirs = opened.archived.hand.to_rows() if opened.archived else rows
    if opened.samples.num_channels != len(rows):
        raise ValueError(f"{path} has {opened.samples.num_channels} channels, not {len(rows)}")
    for place, (found, wanted) in enumerate(zip(theirs, rows, strict=True), 1):
        if any(found[what] != wanted[what] for what in ("name", "kind")):
            raise ValueError(
                f"channel {place} of {path} is {found['name']} ({found['kind']}), not "
                f"{wanted['name']} ({wanted['kind']}); give recordings of the detector's hand"
            )


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


def as_kept(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Facts as JSON gives them back, to be held against the key in a file."""
    plain: dict[str, Any] = json.loads(json.dumps(facts, allow_nan=False))
    return plain


def refuse_to_replace(path: Path, form: Format, given: str) -> None:
    """Raise if there is a file that is not ours.

    Args:
        path: of the file that is to be written.
        form: its format.
        given: what else could be given, such as ``"folder"``.

    Raises:
        ValueError: naming it.
    """
    if path.exists():
        try:
            form.key(path)
        except ValueError as error:
            raise ValueError(f"{error}; move it away, or give another {given}") from error


def write_manifest(folder: Path, written: Sequence[Written]) -> None:
    """Write the lines of recordings to ``manifest.csv``, whole or not at all."""
    with (
        whole_file(folder / MANIFEST) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        table = csv.DictWriter(file, list(written[0].line), lineterminator="\n")
        table.writeheader()
        table.writerows(one.line for one in written)


@dataclass(frozen=True)
class RecordingFolder:
    """Recordings of a source as files in a folder, made where they are not there yet.

    Args:
        source: the recordings.
        folder: where the files are.
        ending: of the files, one that a format has.
        made_by: what determines the samples beside the source's keys: code and libraries.

    Raises:
        ValueError: if there is no such format.
    """

    source: RecordingSource
    folder: Path
    ending: str
    made_by: Mapping[str, Any]

    def __post_init__(self) -> None:
        _ = self.format  # refuses an unknown one

    @property
    def format(self) -> Format:
        """How its files are written and read."""
        return named_format(self.ending)

    def path(self, recording: RecordingId) -> Path:
        """The recording's file."""
        session = f"_session{recording.session}" if recording.session else ""
        name = f"{recording.material}_{recording.scene}_{recording.cycle:02d}{session}"
        return self.folder / f"{name}.{self.ending}"

    def key(self, recording: RecordingId) -> dict[str, Any]:
        """What determines the recording's file, as JSON gives it back."""
        return as_kept({"recording": dict(self.source.key(recording)), **self.made_by})

    def check(self) -> None:
        """Refuse names that files cannot have, and to replace a file that is not ours.

        Raises:
            ValueError: if there is such a name or file.
        """
        paths = [self.path(recording) for recording in self.source.ids]
        if not paths:
            raise ValueError("no recording to write; give at least one of materials=[M1,...]")
        for path in paths:
            if path.parent != self.folder or not re.fullmatch(r"[\w.+-]+", path.name):
                raise ValueError(f"{path.name!r} cannot name a file; give the scene another name")
        if len(set(paths)) < len(paths):
            raise ValueError("two recordings would have one file; give a scene another name")
        for path in paths:
            refuse_to_replace(path, self.format, "folder")

    def load(self, recording: RecordingId) -> Archived:
        """What the recording's file holds.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is damaged.
        """
        return self.format.load(self.path(recording))

    def write(self, recording: RecordingId) -> Written:
        """Make the recording's file, unless it is there, whole, and of the same key."""
        path, key = self.path(recording), self.key(recording)
        content = self._found(recording, key)
        made = content is None
        if content is None:
            content = self.source.load(recording)
            self.format.save(path, content, self.source.hand, key)
        line = manifest_line(path.name, recording, content)
        return Written(line, made, content.duration_s, path.stat().st_size)

    def _found(self, recording: RecordingId, key: Mapping[str, Any]) -> Recording | None:
        try:
            archived = self.load(recording)
        except (FileNotFoundError, ValueError):  # not there, or ours but damaged: see check
            return None
        return archived.recording if archived.key == key else None


def manifest_line(file: str, recording: RecordingId, content: Recording) -> dict[str, Any]:
    """A recording's line of the manifest; of what there may be several it holds a JSON list."""
    origin = content.provenance
    return {
        "file": file,
        "material": recording.material,
        "cycle": recording.cycle,
        "scene": recording.scene,
        "session": recording.session,
        "onsets_s": json.dumps(content.onsets_s),
        "annotated_onsets_s": json.dumps(content.annotated_onsets_s),
        "sliding_s": json.dumps(content.sliding_s),
        "non_slip_s": json.dumps(content.non_slip_s),
        "slip_s": json.dumps(content.slip_s),
        "speeds_mm_s": json.dumps(content.speeds_mm_s),
        "sample_rate_hz": content.sample_rate_hz,
        "simulated": str(bool(origin.get("simulated"))).lower(),
        "fidelity": origin.get("fidelity", ""),
        "seed": origin.get("seed", ""),
    }
