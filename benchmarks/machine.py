"""What a benchmark ran on: the processor, the cores, the load, the libraries."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

import torch


def machine_facts() -> dict[str, str]:
    """Processor, cores this process may use, and how busy the machine is already."""
    every = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else every
    facts = {"processor": processor_name(), "cores": f"{usable} of {every} cores"}
    if hasattr(os, "getloadavg"):
        facts["load"] = f"load {os.getloadavg()[0]:.1f} before the runs"
    return facts


def processor_name() -> str:
    """The processor's name for people, else the architecture."""
    try:
        content = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        content = ""
    for line in content.splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.processor() or platform.machine()


PEERS = ("numba", "PyWavelets", "ptwt", "onnxruntime", "tsfel", "aeon")
"""Libraries that ``benchmarks.features`` and those after it use besides."""


def versions(more: Sequence[str] = ()) -> dict[str, str]:
    """Of the libraries that do the work, of more of them, and of the BLAS in them."""
    from threadpoolctl import threadpool_info  # type: ignore[import-untyped]  # comes with [bench]

    names = ("torch", "numpy", "scipy", "scikit-learn", "tactslip_torch", *more)
    found = {"python": platform.python_version()} | {name: metadata.version(name) for name in names}
    own = re.search(r"BLAS_INFO=(\w+)", torch.__config__.show())
    blas = {
        f"{info['internal_api']} {info['version']}"
        for info in threadpool_info()
        if info["user_api"] == "blas"
    }
    known = [f"{own[1]} in torch"] if own else []
    return found | {"BLAS": " and ".join([*known, *sorted(blas)])}


def threads_text(number: int | str) -> str:
    """How many threads, in words.

    Example:
        >>> threads_text(1)
        '1 thread'
    """
    return f"{number} thread" + ("" if int(number) == 1 else "s")
