"""Reading in a process of its own, for files from strangers.

Libraries that read HDF5, MAT or Parquet files are large and written in C: a file made on purpose
may keep them busy for ever, take all memory, or end the process. The process here has a limit of
memory and of time, and hands over samples as plain numbers in a temporary folder. It costs the
start of a Python with torch, a few seconds a file.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tactslip_torch.data.formats._arrays import Array, ArraySamples, ArrayTimes, Vector
from tactslip_torch.data.formats._faults import MOST_WHOLE, Refused
from tactslip_torch.data.formats._header import DTYPES, facts_of, ours
from tactslip_torch.data.formats._reading import Opened, Reading

_GIB = 2**30
_STRETCH = 2**16  # samples at a time
_LIBRARIES = {
    ".mat": ("scipy.io", "h5py"),
    ".parquet": ("pyarrow.parquet",),
    ".mcap": ("mcap.reader", "rosbags.typesys"),
    "": ("rosbags.rosbag2", "rosbags.typesys"),
} | dict.fromkeys((".h5", ".hdf5", ".he5"), ("h5py",))
"""By ending what is imported before memory is limited."""
_PROGRAM = (
    "from tactslip_torch.data.formats import _isolation, open_file; _isolation.child(open_file)"
)


def isolated(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A file as a process of its own reads it, all samples in a temporary folder (``TMPDIR``).

    Args:
        path: of the file.
        how: to read it; ``isolate_gib`` and ``isolate_s`` are the limits.
        stack: closes it.

    Raises:
        FileNotFoundError: if there is no such file.
        Refused: if it is refused there, or the process goes beyond a limit or dies.
    """
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    asked = {"path": str(path), "how": asdict(replace(how, isolate=False))}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM, folder],
            input=json.dumps(asked).encode(),
            capture_output=True,
            timeout=how.isolate_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise Refused(
            f"{path} took more than {how.isolate_s:g} s to read; raise reading.isolate_s if it may"
        ) from None
    told = folder / "told.json"
    if done.returncode or not told.exists():
        name = signal.Signals(-done.returncode).name if done.returncode < 0 else done.returncode
        raise Refused(
            f"{path} ended the process that read it ({name}), within {how.isolate_gib:g} GiB of "
            "memory; raise reading.isolate_gib if it may take more"
        )
    return _opened(path, folder, json.loads(told.read_text()))


def _opened(path: Path, folder: Path, told: dict[str, Any]) -> Opened:
    if told.get("missing"):
        raise FileNotFoundError(told["missing"])
    if told.get("refused"):
        raise Refused(told["refused"])
    values = np.memmap(folder / "samples", told["dtype"], "r") if told["size"] else np.empty(0)
    samples = ArraySamples(
        Array(path, "samples", values.reshape(-1, told["num_channels"])),
        0,
        dtype=DTYPES[told["dtype"]],
    )
    if told["facts"] is not None:
        return ours(told["facts"], samples)
    times = None
    if told["has_times"]:
        times = ArrayTimes(
            Vector(Array(path, "times", np.memmap(folder / "times", "f8", "r"))), "s"
        )
    names = None if told["names"] is None else tuple(told["names"])
    return Opened(samples, None, names, times, told["sample_rate_hz"])


def child(open_file: Callable[..., AbstractContextManager[Opened]]) -> None:
    """Read the file that standard input names, within the limits it states."""
    folder, asked = Path(sys.argv[1]), json.loads(sys.stdin.read())
    path, how = Path(asked["path"]), Reading(**asked["how"])
    for name in _LIBRARIES.get(path.suffix.lower(), ()):
        with suppress(ImportError):
            importlib.import_module(name)
    _limit(how)
    told: dict[str, Any] = {}
    try:
        with open_file(path, how) as opened:
            told = _written(opened, folder)
    except FileNotFoundError as error:
        told = {"missing": str(error)}
    except (ValueError, MemoryError) as error:
        told = {"refused": str(error) or f"{path} needs more memory than reading.isolate_gib"}
    (folder / "told.json").write_text(json.dumps(told))


def _limit(how: Reading) -> None:
    """Limits of memory beyond what is in use, of computing time, and of files written."""
    import resource  # of Unix alone

    torch.set_num_threads(1)
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limits = {
        resource.RLIMIT_AS: in_use + int(how.isolate_gib * _GIB),
        resource.RLIMIT_CPU: int(how.isolate_s) + 1,
        resource.RLIMIT_FSIZE: 16 * MOST_WHOLE,
        resource.RLIMIT_CORE: 0,
    }
    for limit, most in limits.items():
        resource.setrlimit(limit, (most, most))


def _written(opened: Opened, folder: Path) -> dict[str, Any]:
    """Samples and times as plain numbers in files, and the rest as plain values."""
    samples, archived = opened.samples, opened.archived
    with (folder / "samples").open("wb") as file, (folder / "times").open("wb") as times:
        for first in range(0, samples.num_samples, _STRETCH):
            part = samples.read(first, first + _STRETCH)
            file.write(part.T.contiguous().numpy().data)
            if opened.times is not None:
                times.write(opened.times.read(first, first + _STRETCH).numpy().data)
    facts = None
    if archived is not None:
        facts = facts_of(archived.recording, archived.hand, archived.key)
        facts |= {"shape": [samples.num_channels, samples.num_samples]}
    return {
        "dtype": str(samples.dtype).removeprefix("torch."),
        "size": samples.num_samples,
        "num_channels": samples.num_channels,
        "names": opened.names,
        "sample_rate_hz": opened.sample_rate_hz,
        "has_times": opened.times is not None and samples.num_samples > 0,
        "facts": facts,
    }
