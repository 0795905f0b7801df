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

from tactslip_torch.data.formats._arrays import Array, ArraySamples, ArrayTimes
from tactslip_torch.data.formats._header import DTYPES, header_of, opened_from
from tactslip_torch.data.formats._limits import MOST_WHOLE, Refused
from tactslip_torch.data.formats._reading import Opened, Reading

_STRETCH = 2**16  # samples at a time
_LIBRARIES = ("scipy.io", "h5py", "pyarrow.parquet", "mcap.reader", "rosbags.rosbag2")
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
            f"took more than {how.isolate_s:g} s to read; raise reading.isolate_s if it may"
        ) from None
    answer = folder / "answer.json"
    if done.returncode or not answer.exists():
        name = signal.Signals(-done.returncode).name if done.returncode < 0 else done.returncode
        raise Refused(
            f"ended the process that read it ({name}), within {how.isolate_gib:g} GiB of "
            "memory; raise reading.isolate_gib if it may take more"
        )
    found = json.loads(answer.read_text())
    if found.get("refused"):
        raise Refused(found["refused"])
    dtype = found["dtype"]
    values = np.memmap(folder / "samples", dtype, "r") if found["size"] else np.empty(0, dtype)
    table = Array(path, "samples", values.reshape(-1, found["num_channels"]))
    samples = ArraySamples(table, 0, dtype=DTYPES[dtype])
    if found["header"] is not None:
        return opened_from(found["header"], samples)
    times = None
    if found["has_times"]:
        column = Array(path, "times", np.memmap(folder / "times", "f8", "r"))
        times = ArrayTimes(ArraySamples([column]), "s")
    names = None if found["names"] is None else tuple(found["names"])
    return Opened(samples, None, names, times, found["sample_rate_hz"])


def child(open_file: Callable[..., AbstractContextManager[Opened]]) -> None:
    """Read the file that standard input names, within the limits it states."""
    folder, asked = Path(sys.argv[1]), json.loads(sys.stdin.read())
    path, how = Path(asked["path"]), Reading(**asked["how"])
    for name in _LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(name)
    _limit(how)
    try:
        with open_file(path, how) as opened:
            answer = _written(opened, folder)
    except (OSError, ValueError, MemoryError) as error:
        answer = {"refused": str(error) or f"{path} needs more memory than reading.isolate_gib"}
    (folder / "answer.json").write_text(json.dumps(answer))


def _limit(how: Reading) -> None:
    """Limits of memory beyond what is in use, of computing time, and of files written."""
    import resource  # of Unix alone

    torch.set_num_threads(1)
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limits = {
        resource.RLIMIT_AS: in_use + int(how.isolate_gib * 2**30),
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
            file.write(samples.read(first, first + _STRETCH).T.contiguous().numpy().data)
            if opened.times is not None:
                times.write(opened.times.read(first, first + _STRETCH).numpy().data)
    header = None
    if archived is not None:
        header = header_of(archived.recording, archived.hand, archived.key)
        header["shape"] = [samples.num_channels, samples.num_samples]
    return {
        "dtype": str(samples.dtype).removeprefix("torch."),
        "size": samples.num_samples,
        "num_channels": samples.num_channels,
        "names": opened.names,
        "sample_rate_hz": opened.sample_rate_hz,
        "has_times": opened.times is not None and samples.num_samples > 0,
        "header": header,
    }
