"""Files of recordings as a source: a folder, a manifest, and how files are read.

The set is looked at as a whole when it is made: one file that cannot be read, or does not agree
with the others, is found before any work, with all the others that have something wrong.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from tactslip_torch.data.clock import GapRule
from tactslip_torch.data.formats import is_number
from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.data.sets.agreement import Part
from tactslip_torch.data.sets.digest import file_digest
from tactslip_torch.data.sets.manifest import Entry, Listing, manifest_of, read_manifest
from tactslip_torch.data.sets.manifest_lines import Problem
from tactslip_torch.data.sets.sampling import Treatment, recorded
from tactslip_torch.data.sets.stream import Stream, stream_of
from tactslip_torch.data.sets.survey import Plan, Surveyed, survey
from tactslip_torch.data.sets.timeline import FileTimeline
from tactslip_torch.hand import Adapting, HandLayout

log = logging.getLogger(__name__)
_MOST_SHOWN = 5


class FileRecordings:
    """A ``RecordingSource`` of the files of a folder.

    Times are seconds from a file's first sample. Streams of one file are taken to begin together.
    Where timestamps tell rates, those of all files are taken as one, as round as it can be, and
    the truth follows each file's own clock.

    Args:
        root: the folder.
        manifest: the list of its recordings, relative to the folder; ``None`` for
            ``manifest.csv`` or ``manifest.yaml`` there. Or a listing that was made otherwise.
        materials: those wanted; ``None`` for all.
        cycles: of each material and scene the first so many trials; ``None`` for all.
        channels: rows for ``HandLayout.from_rows``; ``None`` for what files say.
        kind: of channels of files that do not say it.
        adapting: of those; ``None`` as their kind does, if it is known, else slow.
        units: of samples of files that do not say it.
        reading: as ``Reading`` has it, of files that do not say it.
        gaps: ``refuse``, ``missing`` or ``bridge``, as ``Treatment`` has it.
        bridge_ms: the longest gap that is bridged.
        resample_hz: the rate that all files are brought to; ``None`` for their own.
        tare_s: start and end of the stretch whose mean is taken off each channel.
        skip_s: what a label of a whole recording leaves out at its start.
        slide_s: how long a slide lasts of which only the onset is known.
        streams: by name, sets of channels of each file that have a ``reading``, ``channels``,
            ``kind``, ``adapting`` or ``units`` of their own; ``None`` for one.
        skip_failed: leave out files that cannot be read or differ, with a warning each.
        strict: refuse a set with problems; else they are in ``problems``, and what is fine is
            in ``ids``.

    Attributes:
        problems: what was found wrong, each with its place.
        warnings: what is worth a look.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if a value cannot be, or the set has problems: the first few, and how many.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        manifest: str | Listing | None = None,
        materials: Sequence[str] | None = None,
        cycles: int | None = None,
        channels: Iterable[Mapping[str, str]] | None = None,
        kind: str = "electrode",
        adapting: Adapting | None = None,
        units: str = "V",
        reading: Mapping[str, Any] | None = None,
        gaps: GapRule = "refuse",
        bridge_ms: float = 10.0,
        resample_hz: float | None = None,
        tare_s: Sequence[float] | None = None,
        skip_s: float = 0.0,
        slide_s: float = 0.5,
        streams: Mapping[str, Mapping[str, Any]] | None = None,
        skip_failed: bool = False,
        strict: bool = True,
    ) -> None:
        self.root = Path(root)
        for name, value in (("skip_s", skip_s), ("slide_s", slide_s)):
            if not (is_number(value) and value >= 0):
                raise ValueError(f"data.{name} must be seconds from 0, got {value!r}")
        if not (reading is None or isinstance(reading, Mapping)):
            raise ValueError(f"data.reading must be what is said of files, got {reading!r}")
        if streams is not None and not _is_of_mappings(streams):
            raise ValueError(
                "data.streams must be sets of channels by name, each with a reading, channels, "
                f"kind, adapting or units of its own, got {streams!r}"
            )
        shared = {"channels": channels, "kind": kind, "adapting": adapting, "units": units}
        self._plan = Plan(
            self.root,
            tuple(
                stream_of(shared | dict(own) | {"reading": _joined(reading, own)}, name)
                for name, own in (streams or {"": {}}).items()
            ),
            Treatment(gaps, bridge_ms, resample_hz, tare_s),
            skip_s,
            slide_s,
        )
        if not isinstance(manifest, Listing):
            manifest = read_manifest(manifest_of(self.root, manifest), self.root)
        found = survey(self._plan, chosen(manifest.entries, materials, cycles))
        self.problems = (*manifest.problems, *found.problems)
        self.warnings = (*manifest.warnings, *found.warnings)
        if strict:
            self._refuse(manifest.problems if skip_failed else self.problems)
            for problem in found.problems:
                log.warning("left out: %s", problem)
            if not found.recordings:
                raise ValueError(f"no recording of {self.root} is left: {self.problems[0]}")
        self._recordings = {one.entry.recording: one for one in found.recordings}
        self.ids = tuple(self._recordings)

    @property
    def hand(self) -> HandLayout:
        """The channels of every recording: those of all streams, one after the other."""
        return HandLayout(tuple(c for part in self._any.parts for c in part.hand.channels))

    @property
    def sample_rate_hz(self) -> float:
        """Of every recording."""
        return float(self._plan.treatment.resample_hz or self._any.parts[0].rate_hz)

    @property
    def units(self) -> str:
        """Of every sample; of streams with several, all of them."""
        return ", ".join(dict.fromkeys(part.units for part in self._any.parts))

    @property
    def is_simulated(self) -> bool:
        """Whether any file says that it comes from a simulation."""
        return any(_is_simulated(one) for one in self._recordings.values())

    def entry(self, recording: RecordingId) -> Entry:
        """Where a recording is, and what was said of it."""
        return self._recordings[recording].entry

    def parts(self, recording: RecordingId) -> list[tuple[Stream, Part]]:
        """How each stream of a recording is read, and what its file says of it."""
        return list(zip(self._plan.streams, self._recordings[recording].parts, strict=True))

    def timeline(self, recording: RecordingId) -> FileTimeline:
        """When things happen in a recording; nothing is read for it."""
        return self._recordings[recording].times

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """What determines the samples: what the file holds, not its name, and how it is read."""
        one = self._recordings[recording]
        return {
            "sha256": file_digest(self.root / one.entry.file),
            "channels": self.hand.to_rows(),
            "treatment": asdict(self._plan.treatment),
            "streams": [
                {"reading": stream.reading.key(), "rows": part.rows, "rate_hz": part.rate_hz}
                for stream, part in zip(self._plan.streams, one.parts, strict=True)
            ],
        }

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Read a recording, or the stretches of it that are asked for.

        Raises:
            FileNotFoundError: if its file is gone.
            ValueError: if it is damaged, or has changed.
        """
        one = self._recordings[recording]
        path, how, times = self.root / one.entry.file, self._plan.treatment, one.times
        parts = [
            recorded(path, stream, part.found, part.rows, part.rate_hz, how, windows)
            for stream, part in zip(self._plan.streams, one.parts, strict=True)
        ]
        num_samples = round(times.duration_s * self.sample_rate_hz)
        origin = one.parts[0].found.provenance
        return Recording(
            torch.cat([part[:, :num_samples] for part in parts]),
            self.sample_rate_hz,
            recording.material,
            times.speeds_mm_s,
            times.onsets_s,
            times.sliding_s,
            times.annotated_onsets_s,
            times.non_slip_s,
            {"simulated": False, "file": one.entry.file} if origin is None else origin,
            slip_s=times.slip_s,
            units=self.units,
        )

    @property
    def _any(self) -> Surveyed:
        for one in self._recordings.values():
            return one
        raise ValueError(f"no recording of {self.root} can be read: {self.problems[0]}")

    def _refuse(self, problems: Sequence[Problem]) -> None:
        if problems:
            shown = "; ".join(map(str, problems[:_MOST_SHOWN]))
            more = len(problems) - _MOST_SHOWN
            rest = f"; and {more} more" if more > 0 else ""
            raise ValueError(
                f"{len(problems)} problem{'s' * (len(problems) > 1)} in {self.root}: {shown}{rest} "
                "(python -m tactslip_torch.data_tool action=check lists them by line)"
            )


def chosen(
    entries: Sequence[Entry], materials: Sequence[str] | None, cycles: int | None
) -> list[Entry]:
    """The entries of some materials and, of each in each scene and session, the first trials.

    Raises:
        ValueError: if a material is none of the set's, or the number is none.
    """
    known = list(dict.fromkeys(entry.recording.material for entry in entries))
    unknown = [material for material in materials or () if material not in known]
    if unknown and entries:
        raise ValueError(
            f"no recording of data.materials {', '.join(unknown)}; the set has {', '.join(known)}"
        )
    if cycles is not None and not (isinstance(cycles, int) and cycles > 0):
        raise ValueError(f"data.cycles must be a number of trials or null, got {cycles!r}")
    taken: dict[tuple[str, str, str], int] = {}
    kept = set()
    for entry in sorted(entries, key=lambda entry: entry.recording):
        name = entry.recording
        place = name.material, name.scene, name.session
        number = taken.get(place, 0)
        if (materials is None or name.material in materials) and number < (cycles or math.inf):
            taken[place] = number + 1
            kept.add(entry.place)
    return [entry for entry in entries if entry.place in kept]


def _joined(reading: Mapping[str, Any] | None, own: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of all streams, and over it what is said of one."""
    return {**(reading or {}), **(own.get("reading") or {})}


def _is_of_mappings(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(one, Mapping) for one in value.values())


def _is_simulated(one: Surveyed) -> bool:
    return any((part.found.provenance or {}).get("simulated") for part in one.parts)
