"""What every host of an exported stream is to refuse or to warn of, and in which words."""

import json
import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hosts import (
    Ran,
    altered,
    assert_same,
    copied,
    run_host,
    saved,
    sidecar_of,
    slipping_stream,
    truncated,
    truth,
)


class Case(NamedTuple):
    """Something wrong, and what a host is to say of it.

    Attributes:
        arguments: made of a fresh folder and a whole ``stream.onnx``.
        says: all of them stand in the one line on stderr.
        status: of the exit.
    """

    arguments: Callable[[Path, Path], list[object]]
    says: tuple[str, ...]
    status: int = 1


def _recording(folder: Path) -> Path:
    return saved(folder / "recording.npy", slipping_stream()[:600])


def _with_model(change: Callable[[Path], object]) -> Callable[[Path, Path], list[object]]:
    """Arguments with a model that was changed behind its export."""

    def arguments(folder: Path, model: Path) -> list[object]:
        mine = copied(model, folder)
        change(mine)
        return [mine, _recording(folder)]

    return arguments


def _with_array(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path, Path], list[object]]:
    """Arguments with another array in the recording's file."""

    def arguments(folder: Path, model: Path) -> list[object]:
        return [model, saved(folder / "recording.npy", make(slipping_stream()[:600]))]

    return arguments


def _with_file(change: Callable[[Path], object]) -> Callable[[Path, Path], list[object]]:
    """Arguments with a recording whose file was changed."""

    def arguments(folder: Path, model: Path) -> list[object]:
        path = _recording(folder)
        change(path)
        return [model, path]

    return arguments


def _with_options(*options: object) -> Callable[[Path, Path], list[object]]:
    return lambda folder, model: [model, _recording(folder), *options]


def _with_sidecar(**facts: object) -> Callable[[Path, Path], list[object]]:
    """Arguments with a sidecar that says other facts, or none of those given as None."""

    def change(model: Path) -> None:
        told = json.loads(sidecar_of(model).read_text()) | facts
        kept = {key: value for key, value in told.items() if value is not None}
        sidecar_of(model).write_text(json.dumps(kept, indent=1))

    return _with_model(change)


def _with_header(old: bytes, new: bytes) -> Callable[[Path, Path], list[object]]:
    """Arguments with a recording whose header has other bytes; the blanks behind it make room."""

    def change(path: Path) -> None:
        head, body = path.read_bytes().split(b"\n", 1)
        assert old in head
        changed = head.replace(old, new)
        path.write_bytes(changed[: len(head)].ljust(len(head)) + b"\n" + body)

    return _with_file(change)


def _folder_as_recording(path: Path) -> None:
    path.unlink()
    path.mkdir()


NEEDED = (
    "onnx_sha256",
    "graph",
    "precision",
    "channels",
    "sample_rate_hz",
    "hop_samples",
    "first_samples",
    "frame_samples",
    "tail_samples",
    "state_size",
)
SIDECAR = "stream.onnx.json"
CASES = {
    "no model": Case(_with_model(Path.unlink), ("stream.onnx",)),
    "truncated model": Case(_with_model(truncated), (SIDECAR, "again")),
    "altered model": Case(_with_model(altered), (SIDECAR, "again")),
    "no sidecar": Case(_with_model(lambda path: sidecar_of(path).unlink()), (SIDECAR, "beside")),
    "truncated sidecar": Case(_with_model(lambda path: truncated(sidecar_of(path))), (SIDECAR,)),
    "sidecar of something else": Case(
        _with_model(lambda path: sidecar_of(path).write_text("{}")), (SIDECAR, "format")
    ),
    "bin graph": Case(
        lambda folder, model: [model.with_name("model.onnx"), _recording(folder)],
        ("model.onnx", "bin", "stream"),
    ),
    **{
        f"no {key}": Case(_with_sidecar(**{key: None}), (SIDECAR, key, "nothing", "again"))
        for key in NEEDED
    },
    "half precision": Case(
        _with_sidecar(precision="float16"), (SIDECAR, "precision", "float16", "float32 or float64")
    ),
    "no channel": Case(_with_sidecar(channels=[]), (SIDECAR, "channels []", "names")),
    "rate of zero": Case(
        _with_sidecar(sample_rate_hz=0), (SIDECAR, "sample_rate_hz 0", "positive")
    ),
    "rate in words": Case(_with_sidecar(sample_rate_hz="2 kHz"), (SIDECAR, '"2 kHz"', "positive")),
    "half a hop": Case(_with_sidecar(hop_samples=0.5), (SIDECAR, "hop_samples 0.5", "whole")),
    "negative tail": Case(_with_sidecar(tail_samples=-1), (SIDECAR, "tail_samples -1", "whole")),
    "no recording": Case(_with_file(Path.unlink), ("recording.npy",)),
    "truncated recording": Case(_with_file(truncated), ("recording.npy", "cut off")),
    "truncated header": Case(_with_file(lambda path: truncated(path, 0.001)), ("recording.npy",)),
    "folder": Case(_with_file(_folder_as_recording), ("recording.npy", "save")),
    "negative shape": Case(_with_header(b"(600, 24)", b"(-60, 24)"), ("recording.npy", "save")),
    "endless shape": Case(_with_header(b"(600, 24)", b"(%d, 24)" % 10**30), ("recording.npy",)),
    "later version": Case(_with_header(b"NUMPY\1", b"NUMPY\4"), ("recording.npy", "version", "4")),
    "text": Case(_with_file(lambda path: path.write_text("volts\n")), ("recording.npy", ".npy")),
    "Fortran order": Case(_with_array(np.asfortranarray), ("Fortran",)),
    "integers": Case(
        _with_array(lambda x: (1000 * x).astype("<i2")), ("recording.npy", "<i2", "float32")
    ),
    "big-endian": Case(_with_array(lambda x: x.astype(">f4")), (">f4", "little-endian")),
    "one axis": Case(_with_array(np.ravel), ("14400", "24")),
    "three axes": Case(_with_array(lambda x: x[None]), ("600", "24")),
    "seven channels": Case(_with_array(lambda x: x[:, :7].copy()), ("7", "24")),
    "channels first": Case(_with_array(lambda x: x.T.copy()), ("600", "24")),
    "another rate": Case(_with_options("--rate", 1000), ("1000", "2000")),
    "no chunk": Case(_with_options("--chunk", 0), ("--chunk", "0"), 2),
    "too large a chunk": Case(_with_options("--chunk", 5000), ("--chunk", "5000", "2000"), 2),
    "half a chunk": Case(_with_options("--chunk", 2.5), ("--chunk", "2.5"), 2),
    "no number": Case(_with_options("--threshold", "high"), ("--threshold", "high"), 2),
    "threshold that is NaN": Case(_with_options("--threshold", "nan"), ("--threshold", "nan"), 2),
    "endless threshold": Case(_with_options("--threshold", "1e400"), ("--threshold", "1e400"), 2),
    "infinite threshold": Case(
        _with_options("--threshold=-Infinity"), ("--threshold", "-Infinity"), 2
    ),
    "threshold in hexadecimal": Case(_with_options("--threshold", "0x1"), ("0x1",), 2),
    "threshold with an underscore": Case(_with_options("--threshold", "1_0"), ("1_0",), 2),
    "empty threshold": Case(_with_options("--threshold="), ("--threshold",), 2),
    "threshold left out": Case(_with_options("--threshold"), ("--threshold",), 2),
    "option as threshold": Case(
        _with_options("--threshold", "--decisions"), ("--threshold", "--decisions"), 2
    ),
    "chunk with a point": Case(_with_options("--chunk", "200.0"), ("--chunk", "200.0"), 2),
    "chunk with an exponent": Case(_with_options("--chunk=2e2"), ("--chunk", "2e2"), 2),
    "chunk with a sign": Case(_with_options("--chunk", "+200"), ("--chunk", "+200"), 2),
    "chunk beyond any integer": Case(_with_options("--chunk", "9" * 30), ("--chunk", "999"), 2),
    "rate in hexadecimal": Case(_with_options("--rate", "0x7d0"), ("--rate", "0x7d0"), 2),
    "rate behind a blank": Case(_with_options("--rate", " 2000"), ("--rate", " 2000"), 2),
    "value for a flag": Case(_with_options("--decisions=1"), ("--decisions",), 2),
    "short option": Case(_with_options("-d"), ("-d",), 2),
    "unknown option": Case(_with_options("--verbose"), ("--verbose",), 2),
    "no arguments": Case(lambda folder, model: [], ("recording.npy",), 2),
}
"""By name; ``pytest.mark.parametrize("case", CASES)``."""


def assert_refused(host: Sequence[object], case: str, folder: Path, model: Path) -> None:
    """A host says in one line what is wrong, prints nothing else, and ends as it should."""
    ran = run_host(host, *CASES[case].arguments(folder, model))
    assert ran.status == CASES[case].status, ran.stderr
    (line,) = ran.stderr.splitlines()
    assert line.startswith("error: ")
    for words in CASES[case].says:
        assert words in line
    assert ran.lines == []


def assert_warned(ran: Ran, expected: list[dict[str, Any]]) -> None:
    """A host went on where decisions are not valid, and said so in one line at the end."""
    times_s = [row["time_s"] for row in expected if not row["valid"]]
    assert times_s
    (line,) = ran.stderr.splitlines()
    found = re.fullmatch(
        r"warning: (\d+) of (\d+) decisions are not valid, the first at ([\d.]+) s: "
        r"a channel in use is dead or broken",
        line,
    )
    assert found, line
    assert [int(found[1]), int(found[2])] == [len(times_s), len(expected)]
    assert abs(float(found[3]) - times_s[0]) <= 1e-3


# What is no fault ------------------------------------------------------------------------------


SPELLINGS = {
    "negative": (["--threshold", "-1e-3"], -1e-3),
    "negative behind =": (["--threshold=-.5"], -0.5),
    "behind =": (["--threshold=4.5"], 4.5),
    "exponent": (["--threshold", "+45E-1"], 4.5),
    "the last counts": (["--threshold=1", "--threshold", "4.5"], 4.5),
    "all of them": (["--rate=2e3", "--chunk=0200", "--threshold", "4.5"], 4.5),
}
"""Options in ways that every host reads, and the threshold they mean."""


def assert_read(host: Sequence[object], spelling: str, model: Path, recording: Path) -> None:
    """A host raises the alarms of the threshold meant, the options before the files or behind."""
    options, threshold = SPELLINGS[spelling]
    expected = truth(slipping_stream(), threshold)
    assert [row["on"] for row in expected] != [row["on"] for row in truth(slipping_stream())]
    ran = run_host(host, *options, model, "--decisions", recording)
    assert_same(ran, expected)


def assert_versions_are_read(host: Sequence[object], model: Path, folder: Path) -> None:
    """A host reads later versions of ``.npy``, which differ in how the header is kept."""
    for version in ((2, 0), (3, 0)):
        path = folder / "recording.npy"
        with path.open("wb") as file:
            np.lib.format.write_array(file, slipping_stream(), version=version)
        assert_same(run_host(host, model, path, "--decisions"), truth(slipping_stream()))


def assert_loss_is_told(host: Sequence[object], model: Path, recording: Path) -> None:
    """A host whose lines cannot be written says so, be they many or one."""
    for options in (["--decisions"], ["--threshold", "1e9"]):
        command = [str(part) for part in (*host, model, recording, *options)]
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=300
            )
        assert done.returncode == 1, done.stderr
        (line,) = done.stderr.splitlines()
        assert line.startswith("error: the output cannot be written")
