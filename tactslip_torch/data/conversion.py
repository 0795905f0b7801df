"""A set of recordings in another format: one file each, and a manifest that says all again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tactslip_torch.data.file_recordings import FileRecordings
from tactslip_torch.data.folder import Written, as_kept, refuse_to_replace
from tactslip_torch.data.formats import Format, named_format
from tactslip_torch.data.manifest import MOMENTS, STRETCHES
from tactslip_torch.data.recording import RecordingId


@dataclass(frozen=True)
class Conversion:
    """Recordings as files of another format, beside each other as the files they come from.

    A file that is there is kept if what it was made of is the same: what the file before held, how
    that was read, and what is known of the recording.

    Args:
        source: the recordings.
        folder: to write to.
        ending: or name of the format.
        made_by: what determines the files beside that, such as the version of this package.

    Raises:
        ValueError: if there is no such format.
    """

    source: FileRecordings
    folder: Path
    ending: str
    made_by: str

    def __post_init__(self) -> None:
        _ = self.format  # refuses an unknown one

    @property
    def format(self) -> Format:
        """Of the files that are written."""
        return named_format(self.ending)

    def path(self, recording: RecordingId) -> Path:
        """The file of a recording."""
        path = self.folder / self.source.entry(recording).file
        form = self.format
        ending = self.ending if self.ending in form.endings else (*form.endings, "")[0]
        return path.with_suffix(f".{ending}" if ending else "")

    def key(self, recording: RecordingId) -> dict[str, Any]:
        """What determines a file, as JSON gives it back."""
        facts = {
            "recording": {"name": recording.scene, **self.source.key(recording)},
            "material": recording.material,
            "truth": asdict(self.source.timeline(recording)),
            "units": self.source.units,
            "made_by": self.made_by,
        }
        return as_kept(facts)

    def check(self) -> None:
        """Refuse to write over the recordings themselves, or over what is not ours.

        Raises:
            ValueError: naming the file.
        """
        inside = self.folder.resolve()
        if inside == self.source.root.resolve():
            raise ValueError("output must be another folder than root, which stays as it is")
        first: dict[Path, str] = {}
        for recording in self.source.ids:
            path, file = self.path(recording), self.source.entry(recording).file
            if path in first:
                raise ValueError(
                    f"{first[path]} and {file} would both become {path.name}; rename one of them"
                )
            first[path] = file
            refuse_to_replace(path, self.format, "output")

    def convert(self, recording: RecordingId) -> Written:
        """Write the file of a recording, unless it is there and of the same key.

        Raises:
            ValueError: if the recording cannot be read.
        """
        path, key = self.path(recording), self.key(recording)
        made = not (path.exists() and self.format.key(path) == key)
        if made:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.format.save(path, self.source.load(recording), self.source.hand, key)
        inner = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
        return Written(
            self._line(path, recording),
            made,
            self.source.timeline(recording).duration_s,
            sum(file.stat().st_size for file in inner),
        )

    def _line(self, path: Path, recording: RecordingId) -> dict[str, Any]:
        """A recording's line of the manifest; of what there may be several it holds a JSON list."""
        times = self.source.timeline(recording)
        return {
            "file": path.relative_to(self.folder).as_posix(),
            "material": recording.material,
            "trial": recording.cycle,
            "scene": recording.scene,
            "session": recording.session,
            **{name: json.dumps(getattr(times, name)) for name in (*MOMENTS, *STRETCHES)},
            "sample_rate_hz": self.source.sample_rate_hz,
            "simulated": str(self.source.is_simulated).lower(),
        }
