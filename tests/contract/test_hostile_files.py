"""No file of the package crashes its reader, runs code, takes memory or says more than a line."""

import itertools
import json
import math
import os
import random
import resource
import shutil
import time
import warnings
from collections import Counter
from pathlib import Path

import generated
import pytest
import torch

from tactslip_torch.commands.stopping import BAD_INPUT as ONE_LINE
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.deploy.export import export_detector, read_sidecar, summary
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.package_files import (
    DETECTOR,
    SUMS,
    load_table,
    save_table,
)

from . import names
from .names import SlipDetector, StreamingDetector

FORM = "tactslip_torch recording 1"
MOST_BYTES = 2**33
"""Of address space beyond what is in use; libraries reserve gigabytes that they never touch."""
MOST_TAKEN = 300 * 2**20
"""Of memory really touched by one file."""
LONGEST_S = 5
LONGEST = 1000  # characters of a line for people, beside the path


@pytest.fixture(autouse=True)
def _limited(own_files):
    """Memory, once the whole files are there."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    most = pages * resource.getpagesize() + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def is_read(use, path):
    """Whether a file is read; else what is said must be one line."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.thread_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            use(path)
            return True
        except ONE_LINE as error:
            said = one_line(error)
        finally:
            taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
            assert taken * 1024 < MOST_TAKEN, f"{path} took {taken >> 10} MiB"
            assert time.thread_time() - began < LONGEST_S
    assert "\n" not in said
    assert len(said) < LONGEST + len(str(path))
    return False


# Damage ---------------------------------------------------------------------------------------

_NUMBERS = [b"\0", b"\xff", b"\x7f", b"\x80", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"]
_NUMBERS += [b"\0\0\0\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0\0\0\0\1\0\0\0", b"\1\0\0\0"]
_WORDS = [b"nan", b"-inf", b"1e999", b"", b"0x1p3", b"1_0", b"N/A", b'"', b"#", b",", b"\t", b"\n"]
_WORDS += [b"\r", b"\0", b"\xb0", b"\xef\xbb\xbf", b"\xff\xfe", "\u0663".encode(), b"9" * 400]
_WORDS += [b"{", b"}", b"[", b"../", b"%n", b"!!python/object:os.system", b"&a", b"*a"]


def damaged(content, draw):
    """The bytes with up to three of the things that befall files."""
    for _ in range(draw.randint(1, 3)):
        size = len(content)
        end = draw.randint(max(size - 600, 0), size)
        where = draw.choice([draw.randint(0, min(size, 600)), end, draw.randint(0, size)])
        length = draw.choice([draw.randint(1, 64), draw.randint(1, max(size // 2, 1))])
        head, tail = content[:where], content[where:]
        word = draw.choice([*_NUMBERS, *_WORDS, draw.randbytes(draw.randint(0, 20))])
        content = {
            "cut": head,
            "over": head + word + tail[len(word) :],
            "in": head + word + tail,
            "drop": head + tail[length:],
            "twice": head + tail[:length] + tail,
        }[draw.choice(["cut", "over", "in", "drop", "twice"])]
    return content


def one_byte(content, draw):
    """The bytes with one that is another."""
    place = draw.randrange(draw.choice([len(content), min(len(content), 600)]))
    value = draw.choice([0, 255, content[place] ^ (1 << draw.randrange(8))])
    return content[:place] + bytes([value]) + content[place + 1 :]


@pytest.fixture
def place(tmp_path_factory):
    """Where the next file goes; of the last one nothing is left there."""
    folder = tmp_path_factory.mktemp("fuzzed")
    numbers = itertools.count()

    def empty():
        for path in folder.iterdir():
            shutil.rmtree(path)
        path = folder / str(next(numbers))
        path.mkdir()
        return path

    return empty


# Files of ours, forged: whole, so that every digest fits, but for one value ----------------------

_VALUES = [None, True, 0, 1, -1, 3, 99_999, 2**31, -(2**63), 10**30, 10**400, 0.5, -1e308, 1e-308]
_VALUES += [math.nan, math.inf, -math.inf, "", "nan", "../x", "a" * 10_000, [], {}, [[]], [1e400]]
_VALUES += [{"name": "cusum"}, {"tensor": "/x"}, [0] * 5000, ["a", 1], "polynomial", "float32"]


def forged(value, draw):
    """A tree of JSON with one of its values replaced, left out, doubled or put among others."""
    if isinstance(value, dict | list) and value and draw.random() < 0.9:
        place = draw.choice(list(value) if isinstance(value, dict) else range(len(value)))
        changed = value.copy()
        if draw.random() < 0.1:
            del changed[place]
        elif draw.random() < 0.05 and isinstance(value, list):
            changed += changed[:1] * draw.choice([1, 1000])
        else:
            changed[place] = forged(value[place], draw)
        return changed
    if isinstance(value, dict) and draw.random() < 0.3:
        return value | {draw.choice(["", "x", "kernel", "metadata"]): draw.choice(_VALUES)}
    if type(value) in (int, float) and draw.random() < 0.4:
        return draw.choice([value + 1, -value, value * 1000, value / 3, float(value), str(value)])
    return draw.choice(_VALUES)


def forged_tensor(x, draw):
    """The tensor in another shape, dtype or with values that it should not have."""
    values = [0.0, 1e308, -1e308, math.nan, math.inf, 1e-320, -1.0]
    flat = x.flatten().clone()
    if len(flat) and draw.random() < 0.5:
        value = draw.choice(values)
        flat[draw.randrange(len(flat))] = value if x.is_floating_point() else -(2**40)
        return flat.reshape(x.shape)
    dtypes = [torch.float32, torch.int64, torch.bool, torch.float16, torch.uint8]
    return draw.choice(
        [x[..., :-1] if x.ndim else x[None], x[None], flat, x.to(draw.choice(dtypes))]
    )


def forged_table(form):
    def write(path, draw):
        metadata, tensors = load_table(path, form)
        if draw.random() < 0.7:
            metadata = forged(metadata, draw)
        else:
            name = draw.choice(sorted(tensors))
            tensors = {**tensors, name: forged_tensor(tensors[name], draw)}
        save_table(path, form, metadata, tensors)

    return write


def forged_json(path, draw):
    path.write_text(json.dumps(forged(json.loads(path.read_text()), draw)))


def detect(path):
    detector = SlipDetector.load(path)
    num = detector.context_before + detector.pool.bin_samples + detector.context_after
    noise = torch.randn(2, len(detector.pool.hand), num, dtype=torch.float64)
    assert detector.predict_raw(noise).score.isfinite().all()
    if names.ALARM_INFO in detector.info:
        stream = StreamingDetector(detector)
        stream.push(torch.randn(400, len(detector.pool.hand)))


def solve(path):
    SufficientStats.load(path).solve(1.0)


def told(path):
    read_sidecar(path.with_suffix(""))
    summary(path.with_suffix(""))


OWN = {  # what is forged, and what is done with it
    "detector.pt": (forged_table(DETECTOR), detect),
    "sums.pt": (forged_table(SUMS), solve),
    "model.onnx.json": (forged_json, told),
}


@pytest.fixture(scope="module")
def own_files(paper, tmp_path_factory):
    """A whole file of each kind."""
    folder = tmp_path_factory.mktemp("own")
    for name in (names.DETECTOR,):
        shutil.copy(paper.folder / name, folder)
    z = torch.linspace(-1, 1, 480, dtype=torch.float64).view(40, 12)
    sums = SufficientStats(12)
    sums.update("M1/0", z, torch.arange(40) % 2 == 0)
    sums.save(folder / "sums.pt")
    export_detector(paper.detector, folder, ["bin"])
    for name, (_, use) in OWN.items():
        use(folder / name)
    return folder


NUM = int(os.environ.get("TACTSLIP_HOSTILE_FILES", "40"))
"""Cases of a kind; as many as you like, each draws by its own number."""


def content_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", OWN)
def test_hostile_files(name, own_files, place):
    """Every second one is whole but for one value, all others are damaged."""
    forge, use = OWN[name]
    counts = Counter()
    for number in range(NUM):
        draw, path = random.Random(f"{generated.SEED} {name} {number}"), place() / name
        shutil.copy(own_files / name, path)
        if number % 2 == 0:
            forge(path, draw)
        else:
            change = damaged if number % 4 < 2 else one_byte
            path.write_bytes(change(path.read_bytes(), draw))
        before = content_of(path.parent)
        counts[is_read(use, path)] += 1
        assert content_of(path.parent) == before, f"{number}: what was there is lost"
    assert counts[False]
