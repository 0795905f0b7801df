"""What slow files said when they were looked at, kept in the user's cache folder.

A text table must be read to its end to tell how many samples it has. What it said holds as long as
its size, the time of its last change, how it is read and this package's code for that stay.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from tactslip_torch.data.clock import Clock, Gap
from tactslip_torch.data.sets.stream import Found, Stream
from tactslip_torch.data.sets.truth import STRETCHES, Truth
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout

Looks = dict[str, tuple[Found, ...]]
"""Of each file, relative to the root of its set, what every stream of it said."""


def memory_of(root: Path, streams: Iterable[Stream]) -> Path:
    """Where looks at a set are kept, for one way of reading it."""
    readings = [stream.reading.key() for stream in streams]
    code = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        code.update(path.read_bytes())
    facts = json.dumps([str(root.resolve()), readings, code.hexdigest()], sort_keys=True)
    cache = os.environ.get("XDG_CACHE_HOME")
    folder = (Path(cache) if cache else Path.home() / ".cache") / "tactslip_torch" / "looks"
    return folder / f"{hashlib.sha256(facts.encode()).hexdigest()[:32]}.json"


def recall(memory: Path, root: Path, stated_hz: Mapping[str, float | None]) -> Looks:
    """What is known of files that are as they were; nothing if the memory is damaged.

    Args:
        memory: where looks are kept.
        root: of the set.
        stated_hz: the rate that is said of each file, if one is.
    """
    known: Looks = {}
    with contextlib.suppress(
        OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError
    ):
        for file, (stamp, founds) in json.loads(memory.read_text()).items():
            if file in stated_hz and stamp == _stamp(root / file, stated_hz[file]):
                known[file] = tuple(_found(plain) for plain in founds)
    return known


def keep(memory: Path, root: Path, stated_hz: Mapping[str, float | None], looks: Looks) -> None:
    """Keep looks beside those that are kept of other files; where nothing can be written, none."""
    kept: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError, TypeError, RecursionError):
        kept = dict(json.loads(memory.read_text()))
    with contextlib.suppress(OSError):
        for file, founds in looks.items():
            if (root / file).is_file():  # of a folder the time of change says little
                kept[file] = [_stamp(root / file, stated_hz[file]), [_plain(f) for f in founds]]
        with whole_file(memory) as temporary:
            temporary.write_text(json.dumps(kept))


def _stamp(path: Path, stated_hz: float | None) -> list[Any]:
    found = path.stat()
    return [found.st_size, found.st_mtime_ns, stated_hz]


def _plain(found: Found) -> dict[str, Any]:
    return {
        **found._asdict(),
        "dtype": str(found.dtype).removeprefix("torch."),
        "hand": found.hand and found.hand.to_rows(),
        "truth": found.truth and asdict(found.truth),
        "provenance": found.provenance and dict(found.provenance),
    }


def _found(plain: dict[str, Any]) -> Found:
    rate_hz, num_samples, gaps, jitter_s = plain["clock"]
    truth = plain["truth"] and {
        name: _tuples(value) if name in STRETCHES else _tuple(value)
        for name, value in plain["truth"].items()
    }
    return Found(
        **plain
        | {
            "clock": Clock(rate_hz, num_samples, tuple(Gap(*gap) for gap in gaps), jitter_s),
            "dtype": torch.float32 if plain["dtype"] == "float32" else torch.float64,
            "names": _tuple(plain["names"]),
            "hand": plain["hand"] and HandLayout.from_rows(plain["hand"]),
            "truth": truth and Truth(**truth),
        }
    )


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _tuples(value: list[list[float]]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(inner) for inner in value)
