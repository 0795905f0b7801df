"""Reading and writing times beside the libraries: ``python -m benchmarks.formats``.

One simulated recording in every format: written, loaded whole, read in parts, and read by the
format's own library alone with the lines that anybody would write first. All are checked to read
what was written.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import torch

from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import Array
from benchmarks.tables import Table, limits, number, times
from benchmarks.timing import interleaved, on_threads, paired_ratio
from tactslip_torch.data.formats import FORMATS, Archived, pieces
from tactslip_torch.simulation.simulate import SimulatedRecordings

LOAD, IN_PARTS, SAVE, LIBRARY = "loaded whole", "read in parts", "written", "by its library"
SOURCES = ("tactslip_torch/data/formats/*.py",)
WAYS = (LOAD, IN_PARTS, SAVE, LIBRARY)
LIMITED = ("npz", "hdf5", "mcap")


@dataclass(frozen=True)
class Formats(Benchmark):
    """Every format, read and written in turns.

    Args:
        duration_s: of the recording.
        part_ms: read at a time where it is not read whole.
        rounds: of every call.
    """

    title = "Files"
    about = "a simulated recording of 24 channels at 2 kHz in float32, in every format on 1 thread"
    charts: ClassVar = {"": (("Reading", ("whole, ms", "in parts, ms", "by its library, ms")),)}
    quick = "duration_s=1.0 rounds=2"
    libraries = ("h5py", "mcap", "rosbags", "pyarrow")
    duration_s: float = 14.0
    part_ms: float = 100.0
    rounds: int = 15

    def measure(self, job: Job) -> dict[str, Any]:
        """Seconds of every way, each of which is checked first."""
        written = _recording(self.duration_s)
        samples = written.recording.samples
        part = round(self.part_ms * 1e-3 * written.recording.sample_rate_hz)
        with TemporaryDirectory() as folder, on_threads(1):
            calls: dict[str, Callable[[], Any]] = {}
            files = {name: Path(folder, f"a.{of.endings[0]}") for name, of in FORMATS.items()}
            for name, path in files.items():
                of = FORMATS[name]
                of.save(path, *written)
                ways: dict[str, Callable[[], Any]] = {
                    LOAD: partial(of.load, path),
                    IN_PARTS: partial(_in_parts, name, path, part),
                    LIBRARY: partial(_LIBRARIES[name][1], path),
                }
                for read in ways.values():
                    found = read()
                    read_samples = found.recording.samples if isinstance(found, Archived) else found
                    if not np.array_equal(np.asarray(read_samples), samples.numpy()):
                        raise ValueError(f"{name}: what was read is not what was written")
                ways[SAVE] = partial(of.save, path, *written)
                calls |= {f"{name} {way}": call for way, call in ways.items()}
            say(f"formats: {self.rounds} rounds of {len(calls)} calls")
            timings = interleaved(calls, self.rounds)
            bytes_of = {name: _bytes(path) for name, path in files.items()}
        reading, writing, goals = [], [], []
        for name, size in bytes_of.items():
            seconds = {way: timings[f"{name} {way}"]["seconds"] for way in WAYS}
            ms = {way: times(of, 1e3) for way, of in seconds.items()}
            file = FORMATS[name].endings[0]
            reading.append(
                {
                    "file": f".{file}",
                    "whole, ms": ms[LOAD],
                    "in parts, ms": ms[IN_PARTS],
                    "library": _LIBRARIES[name][0],
                    "by its library, ms": ms[LIBRARY],
                    "library / whole": paired_ratio(seconds[LIBRARY], seconds[LOAD]).median,
                }
            )
            row = {"file": f".{file}", "ms": ms[SAVE], "kB": f"{size / 1e3:,.0f}"}
            over = size / (samples.numel() * samples.element_size())
            writing.append(row | {"bytes / samples": number(over)})
            if name in LIMITED:
                for way in (LOAD, IN_PARTS):
                    goals.append((f".{file} {way}, median", median(ms[way]), 100, "ms"))
        tables = {"Limits": limits(goals), "Reading": Table(reading), "Writing": Table(writing)}
        return {"tables": tables}


def _recording(duration_s: float) -> Archived:
    source = SimulatedRecordings(cycles=1, materials=["M1"])
    whole = source.load(source.ids[0])
    count = round(duration_s * whole.sample_rate_hz)
    whole = replace(whole, samples=whole.samples[:, :count].float().contiguous())
    return Archived(whole, source.hand, dict(source.key(source.ids[0])))


def _in_parts(name: str, path: Path, part: int) -> torch.Tensor:
    with FORMATS[name].open(path) as opened:
        return torch.cat(list(pieces(opened.samples, part)), 1)


def _bytes(path: Path) -> int:
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)


# ------------------------------------------------------------------ samples by libraries alone
def _npz(path: Path) -> Array:
    with np.load(path) as content:
        return np.asarray(content["samples"])


def _text(path: Path) -> Array:
    return np.loadtxt(path, delimiter=",", skiprows=2, dtype=np.float32)[:, 1:].T


def _hdf5(path: Path) -> Array:
    import h5py  # type: ignore[import-untyped]

    with h5py.File(path) as file:
        return np.asarray(file["samples"][()])


def _mat(path: Path) -> Array:
    from scipy.io import loadmat

    return np.asarray(loadmat(path)["samples"])


def _parquet(path: Path) -> Array:
    from pyarrow import parquet  # type: ignore[import-untyped]

    columns = parquet.read_table(path, use_threads=False).columns[1:]
    return np.stack([column.to_numpy() for column in columns])


def _mcap(path: Path) -> Array:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        return _decoded([(message.data, schema.name) for schema, _, message in messages if schema])


def _decoded(messages: list[tuple[bytes, str]]) -> Array:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    blocks = []
    for raw, name in messages:
        kind = name if "/msg/" in name else name.replace("/", "/msg/")
        message: Any = store.deserialize_cdr(raw, kind)
        blocks.append(message.data.reshape([axis.size for axis in message.layout.dim]))
    return np.asarray(np.concatenate(blocks).T)


_LIBRARIES: dict[str, tuple[str, Callable[[Path], Array]]] = {
    "npz": ("numpy.load", _npz),
    "text": ("numpy.loadtxt", _text),
    "hdf5": ("h5py", _hdf5),
    "mat": ("scipy.io.loadmat", _mat),
    "mcap": ("mcap and rosbags", _mcap),
    "parquet": ("pyarrow.parquet", _parquet),
}
"""By the format: its library, and all samples ``[C, T]`` by it."""

if __name__ == "__main__":
    raise SystemExit(Formats().run())
