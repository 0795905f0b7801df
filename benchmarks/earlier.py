"""The alarm of 0.2.0 on recordings of ``benchmarks.alarms``: run once, its numbers are kept.

    python -m benchmarks.earlier store FOLDER             # here: recordings of seed 0
    python benchmarks/earlier.py hear FOLDER DETECTOR     # in an environment of 0.2.0
    python -m benchmarks.earlier count FOLDER             # here: what became of slips

DETECTOR is what ``python -m tactslip_torch.train +exp=onset`` of that version left
(docs/migrating.md names its commit). ``count`` writes benchmarks/kept/alarms_0_2_0.json, which
``benchmarks.alarms`` shows beside its own numbers. All recordings are simulated.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

SLIP = "slip"  # as in simulation.worlds, which 0.2.0 does not have
_QUIET = 8  # recordings of each kind without slip, with imperfections and without
KEPT = Path(__file__).parent / "kept" / "alarms_0_2_0.json"


def store(folder: Path) -> None:
    """Write samples of slips in all worlds, and of a few recordings without slip of each kind."""
    from benchmarks.alarms import Alarms, quiet_name, quiet_recordings, world_recordings
    from tactslip_torch.runtime import bar

    sizes = Alarms()
    given = [f"seed={sizes.seeds[0]}", *sizes.overrides]
    quiet_source, groups, materials = quiet_recordings(["+exp=onset", *given])
    wanted: list[tuple[str, str, bool, Any, Any]] = [
        (world, SLIP, False, source, recording)
        for world in sizes.worlds
        for source in [world_recordings(world, materials, sizes.sessions, sizes.seeds[0])]
        for recording in source.ids
    ]
    wanted += [
        (quiet_name(kind, is_imperfect), kind, is_imperfect, quiet_source, recording)
        for (kind, is_imperfect), own in groups.items()
        for recording in own[:_QUIET]
    ]
    folder.mkdir(parents=True, exist_ok=True)
    index = list[dict[str, Any]]()
    for name, kind, is_imperfect, source, recording in bar(wanted, "store", "recording"):
        times, file = source.timeline(recording), f"{len(index):05d}.npy"
        np.save(folder / file, source.load(recording).samples.float().T.numpy())
        index.append(
            {
                "file": file,
                "group": name,
                "kind": kind,
                "is_imperfect": is_imperfect,
                "onsets_s": times.onsets_s,
                "released_s": times.released_s,
                "hours": times.duration_s / 3600,
                "strokes": len(times.arm_s),
            }
        )
    made = {"digests": sizes.digests(given), "recordings": index}
    (folder / "index.json").write_text(json.dumps(made), encoding="utf-8")


def hear(folder: Path, detector: Path) -> None:
    """Keep what a detector decides of each file, by the package of this environment."""
    import torch

    from tactslip_torch import SlipDetector, StreamingDetector

    torch.set_num_threads(1)
    loaded = SlipDetector.load(detector)
    for own in json.loads((folder / "index.json").read_text(encoding="utf-8"))["recordings"]:
        samples = torch.from_numpy(np.load(folder / own["file"]))
        stream = StreamingDetector(loaded)
        parts = [stream.push(samples), stream.flush()]
        kept = {
            name: np.concatenate([getattr(part, name).numpy() for part in parts])
            for name in ("available_s", "is_alarm", "is_on")
        }
        np.savez(folder / own["file"].replace(".npy", ".npz"), **kept)


def count(folder: Path) -> None:
    """Write what became of each slip, and false alarms of each kind."""
    import torch

    from benchmarks.alarms import delays

    slips, quiet = dict[str, list[float | str]](), dict[str, dict[str, Any]]()
    index = json.loads((folder / "index.json").read_text(encoding="utf-8"))
    for own in index["recordings"]:
        found = np.load(folder / own["file"].replace(".npy", ".npz"))
        made = SimpleNamespace(**{name: torch.from_numpy(found[name]) for name in found.files})
        if own["kind"] == SLIP:
            slips.setdefault(own["group"], []).extend(delays(SimpleNamespace(**own), made))
            continue
        row = quiet.setdefault(own["group"], {"alarms": 0, "hours": 0.0, "strokes": 0})
        row |= {name: own[name] for name in ("kind", "is_imperfect")}
        row["alarms"] += int(made.is_alarm.sum())
        row["hours"] += own["hours"]
        row["strokes"] += own["strokes"]
    kept = {"digests": index["digests"], "slips": slips, "quiet": quiet}
    KEPT.write_text(json.dumps(kept) + "\n", encoding="utf-8")


if __name__ == "__main__":
    step, *paths = sys.argv[1:]
    steps: dict[str, Any] = {"store": store, "hear": hear, "count": count}
    steps[step](*map(Path, paths))
