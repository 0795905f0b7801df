"""Exported streams in Python, C and Node decide what the package decides, and refuse the same."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import hosts
import numpy as np
import pytest
import torch
from hosts import (
    ALARM_KEYS,
    EXPORT,
    altered,
    assert_same,
    copied,
    installed,
    run_host,
    saved,
    sidecar_of,
    slipping_stream,
    truncated,
    truth,
)

pytestmark = pytest.mark.onnx

NEEDS_GCC = pytest.mark.skipif(
    not (shutil.which("gcc") and shutil.which("make")), reason="no gcc and make here"
)
PYTHON = [sys.executable, EXPORT / "python" / "detect.py"]


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Runs ``make`` with words of a command line, all it builds in a folder of this session."""
    build = tmp_path_factory.mktemp("c")

    def run(*words):
        folder = EXPORT / "c"
        command = ["make", "-C", folder, "CC=gcc", f"PYTHON={sys.executable}", f"BUILD={build}"]
        done = subprocess.run([*command, *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run.build = build
    return run


@pytest.fixture(
    scope="module",
    params=[
        "python",
        pytest.param("c", marks=NEEDS_GCC),
        pytest.param("node", marks=pytest.mark.slow),
    ],
)
def host(request):
    """The words of a host's command."""
    if request.param == "python":
        return PYTHON
    if request.param == "node":
        installed(EXPORT / "node")
        return ["node", EXPORT / "node" / "detect.mjs"]
    make = request.getfixturevalue("make")
    make()
    return [make.build / "detect"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return hosts.exported(tmp_path_factory) / "stream.onnx"


@pytest.fixture(scope="module")
def fast_model(tmp_path_factory):
    return hosts.exported(tmp_path_factory, with_onset=True) / "stream.onnx"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("recording") / "recording.npy", slipping_stream())


# What is right ---------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [1, 333])
def test_an_onset_classifier_raises_alarms_and_is_named(host, fast_model, recording, chunk):
    expected = truth(slipping_stream(), with_onset=True)
    assert {row["raised_by"] for row in expected} == {None, "onset", "status"}
    ran = run_host(host, fast_model, recording, "--decisions", "--chunk", chunk)
    assert_same(ran, expected)
    assert ran.stderr == ""  # nothing is known before the first bin, and nothing is dead
    alarms = run_host(host, fast_model, recording, "--chunk", chunk)
    assert [list(line) for line in alarms.lines] == [[*ALARM_KEYS, "raised_by"]] * len(alarms.lines)
    assert [line["raised_by"] for line in alarms.lines] == [
        row["raised_by"] for row in expected if row["alarm"]
    ]


def test_a_threshold_is_that_of_the_onset_classifier(host, fast_model, recording):
    expected = truth(slipping_stream(), 1e9, with_onset=True)
    assert {row["raised_by"] for row in expected} == {None, "status"}
    assert_same(run_host(host, fast_model, recording, "--decisions", "--threshold", 1e9), expected)


@pytest.mark.slow
def test_a_graph_in_double_precision_is_fed_in_it(host, tmp_path, tmp_path_factory):
    precise = hosts.exported(tmp_path_factory, "float64") / "stream.onnx"
    samples = slipping_stream()[2000:5000] * (1 + 2.0**-40)  # no float32
    ran = run_host(host, precise, saved(tmp_path / "recording.npy", samples), "--decisions")
    assert_same(ran, truth(samples), exact=True)


SPELLINGS = {
    "negative": (["--threshold", "-1e-3"], -1e-3),
    "behind =": (["--threshold=4.5"], 4.5),
    "exponent": (["--threshold", "+45E-1"], 4.5),
    "all of them": (["--rate=2e3", "--chunk=0200", "--threshold", "4.5"], 4.5),
}
"""Options in ways that every host reads, and the threshold they mean."""


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_options_are_read_however_they_are_written(host, model, recording, spelling):
    """The alarms are those of the threshold meant, the options before the files or behind."""
    options, threshold = SPELLINGS[spelling]
    expected = truth(slipping_stream(), threshold)
    assert [row["on"] for row in expected] != [row["on"] for row in truth(slipping_stream())]
    assert_same(run_host(host, *options, model, "--decisions", recording), expected)


# What is wrong ---------------------------------------------------------------------------------


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


NEEDED = ("onnx_sha256", "channels", "sample_rate_hz", "state_size")
SIDECAR = "stream.onnx.json"
BAD_OPTIONS = (
    ("--chunk", "5000", ("5000", "2000")),
    ("--chunk", "9" * 30, ("999",)),
    ("--threshold", "1e400", ("1e400",)),
    ("--rate", "0x7d0", ("0x7d0",)),
    ("--decisions=1", ()),
)
"""Words of a command line, and what beside the option's name stands in the message."""
CASES = {
    "truncated model": Case(_with_model(truncated), (SIDECAR, "again")),
    "altered model": Case(_with_model(altered), (SIDECAR, "again")),
    "truncated sidecar": Case(_with_model(lambda path: truncated(sidecar_of(path))), (SIDECAR,)),
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
    "rate in words": Case(_with_sidecar(sample_rate_hz="2 kHz"), (SIDECAR, '"2 kHz"', "positive")),
    "negative tail": Case(_with_sidecar(tail_samples=-1), (SIDECAR, "tail_samples -1", "whole")),
    "no recording": Case(_with_file(Path.unlink), ("recording.npy",)),
    "truncated recording": Case(_with_file(truncated), ("recording.npy", "cut off")),
    "negative shape": Case(_with_header(b"(600, 24)", b"(-60, 24)"), ("recording.npy", "save")),
    "text": Case(_with_file(lambda path: path.write_text("volts\n")), ("recording.npy", ".npy")),
    "Fortran order": Case(_with_array(np.asfortranarray), ("Fortran",)),
    "big-endian": Case(_with_array(lambda x: x.astype(">f4")), (">f4", "little-endian")),
    "three axes": Case(_with_array(lambda x: x[None]), ("600", "24")),
    "channels first": Case(_with_array(lambda x: x.T.copy()), ("600", "24")),
    **{
        " ".join(options): Case(_with_options(*options), (options[0].split("=")[0], *says), 2)
        for *options, says in BAD_OPTIONS
    },
    "no arguments": Case(lambda folder, model: [], ("recording.npy",), 2),
}
"""By name, beside those of ``contract/test_hosts.py``."""


SOME_SLOW = [
    name if place % 2 == 0 else pytest.param(name, marks=pytest.mark.slow)
    for place, name in enumerate(CASES)
]
"""Each starts a host: every second one is for the slow tests."""


@pytest.mark.parametrize("case", SOME_SLOW)
def test_what_is_wrong_is_said_in_one_line(host, model, tmp_path, case):
    ran = run_host(host, *CASES[case].arguments(tmp_path, model))
    assert ran.status == CASES[case].status, ran.stderr
    (line,) = ran.stderr.splitlines()
    assert line.startswith("error: ")
    for words in CASES[case].says:
        assert words in line
    assert ran.lines == []


# C ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [["--decisions"], ["--threshold", "1e9"]], ids=len)
def test_lines_that_cannot_be_written_are_an_error(host, model, recording, options):
    command = [str(word) for word in (*host, model, recording, *options)]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=300
        )
    assert done.returncode == 1, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: the output cannot be written")


@NEEDS_GCC
def test_parts_hold_chunks_agree_and_a_push_takes_no_memory(make, model, fast_model):
    for each in (model, fast_model):
        assert "parts and pushes hold" in make("test", f"MODEL={each}")


@NEEDS_GCC
def test_the_example_of_the_page_compiles_and_feels_the_slips(make, model, tmp_path):
    make()
    page = (EXPORT / "c" / "README.md").read_text(encoding="utf-8")
    example = page.split("<!-- example -->\n```c\n")[1].split("```")[0]
    raw = tmp_path / "samples.raw"
    raw.write_bytes(slipping_stream().tobytes())
    around = """
static FILE *file;
static size_t acquire(float *samples, size_t most) {
    return fread(samples, 24 * sizeof(float), most, file);
}
int main(int count, char **words) {
    return count == 3 && (file = fopen(words[2], "rb")) ? watch(words[1], acquire) : 2;
}
"""
    (tmp_path / "loop.c").write_text(example + around)
    parts = [EXPORT / "c" / f"{name}.c" for name in ("slip", "model", "sidecar", "sha256")]
    command = [
        "gcc",
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        f"-I{EXPORT / 'c'}",
        tmp_path / "loop.c",
    ]
    command += [*parts, f"-L{make.build}", "-lonnxruntime", f"-Wl,-rpath,{make.build}"]
    subprocess.run([*command, "-o", tmp_path / "loop"], check=True)
    words = [tmp_path / "loop", model, raw]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found = [float(text) for text in re.findall(r"slip since ([\d.]+) s\n", done.stdout)]
    expected = [row["onset_s"] for row in truth(slipping_stream()) if row["alarm"]]
    assert found == pytest.approx(expected, abs=1e-3)


# Python ----------------------------------------------------------------------------------------


def test_it_needs_no_torch(model, recording):
    code = (
        "import runpy, sys; sys.modules |= dict.fromkeys(['torch', 'tactslip_torch']); "
        "sys.argv = sys.argv[1:]; sys.path.insert(0, sys.argv.pop(0)); "
        "runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    without = [sys.executable, "-c", code, EXPORT / "python", PYTHON[1]]
    assert run_host(without, model, recording) == run_host(PYTHON, model, recording)


# Bins by themselves ----------------------------------------------------------------------------


def test_bins_are_scored_as_the_package_scores_them(model, tmp_path):
    samples = slipping_stream().copy()
    samples[3000] = np.nan
    detector = hosts.alarming_detector()
    before, after = detector.context_before, detector.context_after
    path = saved(tmp_path / "recording.npy", samples)
    ran = run_host(
        [sys.executable, EXPORT / "python" / "score.py"], model.with_name("model.onnx"), path
    )
    lines = [*ran.lines, ran.summary]  # there is no line of sums

    starts = [round(line["start_s"] * hosts.RATE) for line in lines]
    assert np.diff(starts).tolist() == [100] * (len(lines) - 1)
    assert starts[0] <= before
    assert len(samples) - 100 < starts[-1] + 100 + after <= len(samples)
    bins = torch.stack(
        [torch.from_numpy(samples[s - before : s + 100 + after].T.copy()) for s in starts[1:-1]]
    )
    judged = detector.predict_raw(bins.double())
    assert [line["valid"] for line in lines[1:-1]] == judged.is_valid.tolist()
    assert not judged.is_valid.all()
    found = torch.tensor([line["score"] for line in lines[1:-1]], dtype=torch.float64)
    torch.testing.assert_close(found, judged.score, rtol=0, atol=1e-3 * hosts.score_std())


def test_a_stream_graph_is_refused_for_bins(model, recording):
    ran = run_host([sys.executable, EXPORT / "python" / "score.py"], model, recording)
    assert ran.status == 1
    assert "give model.onnx" in ran.stderr
