"""The measurement of ``benchmarks.formats``: seconds of reading and writing one recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks.clocks import Way, on_threads, say, shuffled_rounds
from benchmarks.formats.naive import NAIVE
from benchmarks.formats.sizes import Sizes
from tactslip_torch.data.formats import FORMATS, Archived, Format, pieces
from tactslip_torch.data.recording import Recording
from tactslip_torch.simulation.source import SimulatedRecordings

LOAD, STREAM, SAVE, PEER = "load", "stream", "save", "peer"


def subject(duration_s: float) -> Archived:
    """The beginning of a simulated recording, with everything that a file of it holds."""
    source = SimulatedRecordings(cycles=1, materials=["M1"])
    whole = source.load(source.ids[0])
    count = round(duration_s * whole.sample_rate_hz)
    samples = whole.samples[:, :count].float().contiguous()
    recording = Recording(
        samples,
        whole.sample_rate_hz,
        whole.material,
        whole.speeds_mm_s,
        whole.onsets_s,
        whole.sliding_s,
        whole.annotated_onsets_s,
        whole.non_slip_s,
        whole.provenance,
        slip_s=whole.slip_s,
        units=whole.units,
    )
    return Archived(recording, source.hand, dict(source.key(source.ids[0])))


def formats(sizes: Sizes) -> dict[str, Any]:
    """Every format in turns: written, loaded whole, read in pieces, read by another tool."""
    held = subject(sizes.duration_s)
    piece = round(sizes.piece_ms * 1e-3 * held.recording.sample_rate_hz)
    with TemporaryDirectory() as folder, on_threads(1):
        files = {name: Path(folder, f"a.{form.endings[0]}") for name, form in FORMATS.items()}
        ways: dict[tuple[str, str], Callable[[], object]] = {}
        for name, path in files.items():
            form = FORMATS[name]
            ways[name, SAVE] = partial(form.save, path, *held)
            form.save(path, *held)
            ways[name, LOAD] = partial(form.load, path)
            ways[name, STREAM] = partial(_stream, form, path, piece)
            ways[name, PEER] = partial(NAIVE[name][1], path)
        joined = {
            (name, STREAM): partial(_joined, FORMATS[name], files[name], piece) for name in files
        }
        _check(ways | joined, held.recording)
        say(f"formats: {sizes.rounds} rounds of {len(ways)} calls")
        named = {f"{name} {what}": Way(call) for (name, what), call in ways.items()}
        seconds = shuffled_rounds(named, sizes.rounds, sizes.seed)
        rows = [
            {
                "format": name,
                "ending": FORMATS[name].endings[0],
                "bytes": _bytes(path),
                "peer": NAIVE[name][0],
                "seconds": {what: seconds[f"{name} {what}"] for what in (LOAD, STREAM, SAVE, PEER)},
            }
            for name, path in files.items()
        ]
    samples = held.recording.samples
    return {"rows": rows, "sample_bytes": samples.numel() * samples.element_size()}


def _stream(form: Format, path: Path, piece: int) -> torch.Tensor:
    """Open a file and read it in pieces; the last of them."""
    with form.open(path) as opened:
        for part in pieces(opened.samples, piece):
            last = part
    return last


def _joined(form: Format, path: Path, piece: int) -> torch.Tensor:
    """All pieces as one."""
    with form.open(path) as opened:
        return torch.cat(list(pieces(opened.samples, piece)), 1)


def _check(ways: dict[tuple[str, str], Callable[[], object]], recording: Recording) -> None:
    """Hold every way against what was written, bit for bit: a fast wrong reader is no reader.

    Raises:
        ValueError: if one reads something else.
    """
    wanted = recording.samples.numpy()
    for (name, what), call in ways.items():
        for found in _samples_of(call()):
            if not np.array_equal(
                found.view(np.uint32), wanted[:, -found.shape[1] :].view(np.uint32)
            ):
                raise ValueError(f"{name}, {what}: what was read is not what was written")


def _samples_of(result: object) -> Iterator[Any]:
    if isinstance(result, Archived):
        yield result.recording.samples.numpy()
    elif isinstance(result, torch.Tensor):
        yield result.numpy()
    elif isinstance(result, np.ndarray):
        yield np.ascontiguousarray(result)


def _bytes(path: Path) -> int:
    """Of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)
