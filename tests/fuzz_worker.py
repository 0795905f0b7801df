"""Reads files in a process of its own, in little memory, and tells what came of each.

A request is a line of JSON, and so is its answer: for everything that was tried, ``read``,
``refused`` with the line that a person would see, or ``raised`` with what must not happen.
"""

import itertools
import json
import os
import resource
import sys
import traceback
import warnings
import zlib
from pathlib import Path

import torch

from tactslip_torch.data.formats import FORMATS, pieces
from tactslip_torch.data.manifest import read_manifest

MOST_PIECES = 40


def look(form, path):
    """Open a file and walk through its samples and times, as far as a large one allows."""
    with form.open(path) as opened:
        samples, size = opened.samples, opened.samples.num_samples
        held = [samples.read(0, 3), samples.read(max(size - 3, 0), size), samples.read(size, size)]
        held += itertools.islice(pieces(samples, 999), MOST_PIECES)
        for piece in held:
            assert (len(piece), piece.dtype) == (samples.num_channels, samples.dtype)
        assert [piece.shape[1] for piece in held[:3]] == [min(size, 3), min(size, 3), 0]
        assert opened.names is None or len(opened.names) == samples.num_channels
        if opened.times is not None:
            times = opened.times.read(0, min(size, 999))
            assert (times.shape, times.dtype) == ((min(size, 999),), torch.float64)


def summed(archived):
    """A sum of all that was loaded."""
    return zlib.crc32(archived.recording.samples.numpy().tobytes() + repr(archived).encode())


def listed(path, root):
    """Read a manifest; what it lists must lie in the root, what is wrong must be single lines."""
    listing = read_manifest(path, root)
    for entry in listing.entries:
        assert (root / entry.file).resolve().is_relative_to(root.resolve())
    for problem in (*listing.problems, *listing.warnings):
        assert "\n" not in str(problem), str(problem)
        assert len(str(problem)) < 1000, str(problem)[:2000]
    if listing.problems:
        raise ValueError(f"{path}: {len(listing.problems)} problems")


def outcome(what):
    """What comes of a call: ``[kind, text]``."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = ["read", str(what())]
        except (ValueError, FileNotFoundError) as error:
            found = ["refused", str(error)]
        except BaseException:
            found = ["raised", traceback.format_exc(limit=-6)[-3000:]]
    return ["raised", f"warned: {said[0].message}"] if said else found


def answer(request):
    """One request, of a file of some format or of a manifest."""
    path = Path(request["path"])
    if request["format"] == "manifest":
        return {"read": outcome(lambda: listed(path, path.parent))}
    form = FORMATS[request["format"]]
    return {
        "load": outcome(lambda: summed(form.load(path))),
        "key": outcome(lambda: form.key(path)),
        "open": outcome(lambda: look(form, path)),
    }


def allow(num_bytes):
    """Of address space, no more than this beyond what is in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + num_bytes
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def main():
    torch.set_num_threads(1)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints is no answer
    for line in sys.stdin:
        request = json.loads(line)
        if "allow" in request:
            allow(request["allow"])
        reply = {} if "allow" in request else answer(request)
        reply["peak"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(json.dumps(reply), file=answers, flush=True)


if __name__ == "__main__":
    main()
