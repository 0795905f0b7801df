"""Hosts of an exported stream decide what the package decides, and refuse the same.

The page in a browser is asked in ``tests/test_host_all.py``.
"""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import hosts
import numpy as np
import pytest
import torch
from hosts import EXPORT, altered, copied, run_host, saved, sidecar_of, truncated, truth

from . import names
from .recordings import samples_of

pytestmark = pytest.mark.onnx

SAMPLES = samples_of("D", 1)[1500:5500]
EVERY, CHUNK, THRESHOLD, RATE = (
    names.HOST_OPTIONS[word] for word in ("every", "chunk", "threshold", "rate")
)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """What stands for the words in braces of the hosts' commands."""
    return {"python": sys.executable, "export": EXPORT, "build": tmp_path_factory.mktemp("c")}


@pytest.fixture(scope="module")
def build(places):
    """Runs ``make`` for the C host with more words of a command line; what it prints."""

    if not (shutil.which("gcc") and shutil.which("make")):
        pytest.skip("no gcc and make here")

    def run(*words):
        command = [*names.BUILD_C_HOST.format(**places).split(), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


SLOW_START = [pytest.param(name, marks=pytest.mark.slow) for name in ("python", "node")]
"""Hosts that take long to start, for what each must be started for anew."""


@pytest.fixture(scope="module", params=["python", "c", SLOW_START[1]])
def host(request, places):
    """The words of each host's command; built or installed before."""
    if request.param == "c":
        request.getfixturevalue("build")()
    if request.param == "node":
        hosts.installed(EXPORT / "node")
    return names.HOSTS[request.param].format(**places).split()


@pytest.fixture(scope="module")
def stream(graphs_of):
    return graphs_of("paper") / names.STREAM_GRAPH


@pytest.fixture(scope="module")
def fast_stream(tmp_path_factory):
    """Of a detector with an onset classifier, and of 24 channels."""
    return hosts.exported(tmp_path_factory, with_onset=True) / names.STREAM_GRAPH


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("recording") / "recording.npy", SAMPLES)


@pytest.fixture(scope="module")
def fast_recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.npy"
    return saved(path, hosts.slipping_stream())


# What is right ---------------------------------------------------------------------------------

THRESHOLDS = [
    ([THRESHOLD, "-1e3"], -1e3),
    ([f"{THRESHOLD}=4.5"], 4.5),
    ([f"{RATE}=2e3", f"{CHUNK}=0200", THRESHOLD, "+45E-1"], 4.5),
    ([THRESHOLD, "1e9"], 1e9),
]
"""Options in ways that every host reads, and the threshold they mean."""


@pytest.mark.parametrize(
    ("options", "threshold"),
    [([], None), ([CHUNK, "1"], None), ([CHUNK, "333"], None), *THRESHOLDS],
    ids=str,
)
def test_a_host_decides_what_the_package_decides(
    host, stream, paper, recording, options, threshold
):
    """However it is told, and the options before the files or behind."""
    expected = truth(SAMPLES, threshold, detector=paper.detector)
    ran = run_host(host, *options, stream, EVERY, recording)
    hosts.assert_same(ran, expected)
    assert ran.summary["seconds"] == len(SAMPLES) / 2000
    assert ran.stderr == ""
    if threshold is None:
        assert ran.summary["alarms"] > 0
    else:
        assert expected != truth(SAMPLES, detector=paper.detector)


@pytest.mark.parametrize("lost", hosts.LOST)
def test_lost_channels_are_named_and_raise_no_alarm(
    host, stream, paper, fast_stream, tmp_path, lost
):
    broken = hosts.without(SAMPLES, lost)
    ran = run_host(host, stream, saved(tmp_path / "recording.npy", broken), EVERY)
    hosts.assert_same(ran, truth(broken, detector=paper.detector))
    whole = sum(row["alarm"] for row in truth(SAMPLES, detector=paper.detector))
    assert ran.summary["alarms"] <= whole
    assert any(line["channels_lost"] for line in ran.lines)
    if not_valid_s := [line["time_s"] for line in ran.lines if not line["valid"]]:
        counts = f"{len(not_valid_s)} of {len(ran.lines)} decisions are not valid"
        pattern = rf"warning: {counts}, the first at (\S+) s: too few channels are alive\n"
        (first_s,) = re.fullmatch(pattern, ran.stderr).groups()
        assert float(first_s) == pytest.approx(not_valid_s[0], abs=1e-3)
    assert (not not_valid_s) == (lost == "a dead channel") == (not ran.stderr)
    broken = hosts.without(hosts.slipping_stream(), lost)
    ran = run_host(host, fast_stream, saved(tmp_path / "recording.npy", broken), EVERY)
    hosts.assert_same(ran, truth(broken, with_onset=True))


def test_names_of_channels_are_written_as_json(host, stream, paper, tmp_path):
    names_of_hand = ['a "b"', "c\\d", "\u00e9\t\x01", "\U0001f600"]
    model = copied(stream, tmp_path)
    told(channels=names_of_hand)(sidecar_of(model))
    missing = saved(tmp_path / "recording.npy", SAMPLES * np.nan)
    in_use = [names_of_hand[i] for i in paper.detector.needed_index.tolist()]
    lines = run_host(host, model, missing, EVERY).lines
    assert lines
    assert all(line["channels_lost"] == in_use for line in lines)


@pytest.mark.parametrize(
    ("options", "threshold"), [([CHUNK, 1], None), ([CHUNK, 333], None), ([THRESHOLD, 1e9], 1e9)]
)
def test_an_onset_classifier_raises_alarms_and_is_named(
    host, fast_stream, fast_recording, options, threshold
):
    """The threshold is that of the classifier."""
    expected = truth(hosts.slipping_stream(), threshold, with_onset=True)
    raised_by = [row["raised_by"] for row in expected if row["alarm"]]
    assert set(raised_by) == ({"onset"} if threshold is None else set())
    ran = run_host(host, fast_stream, fast_recording, EVERY, *options)
    hosts.assert_same(ran, expected)
    assert ran.stderr == ""  # nothing is known before the first bin, and nothing is dead
    alarms = run_host(host, fast_stream, fast_recording, *options).lines
    assert [list(line) for line in alarms] == [[*hosts.ALARM_KEYS, "raised_by"]] * len(raised_by)
    assert [line["raised_by"] for line in alarms] == raised_by


@pytest.mark.slow
def test_a_graph_in_double_precision_is_fed_in_it(host, graphs_of, paper, tmp_path):
    precise = graphs_of("paper", "float64") / names.STREAM_GRAPH
    samples = SAMPLES * (1 + 2.0**-40)  # no float32
    ran = run_host(host, precise, saved(tmp_path / "recording.npy", samples), EVERY)
    hosts.assert_same(ran, truth(samples, detector=paper.detector), exact=True)


# What is wrong ---------------------------------------------------------------------------------


def told(**facts):
    """Changes a sidecar to say other facts, or none of those given as None."""

    def change(path):
        content = json.loads(path.read_text()) | facts
        kept = {key: value for key, value in content.items() if value is not None}
        path.write_text(json.dumps(kept, indent=1))

    return change


def as_array(make):
    """Changes a recording to another array."""
    return lambda path: np.save(path, make(np.load(path)))


def negative_shape(path):
    content = path.read_bytes()
    assert b"(4000, 4), }  " in content
    path.write_bytes(content.replace(b"(4000, 4), }  ", b"(-4000, 4), } "))


WRONG_FILES = {
    # which file is changed and how, words of the line
    "no model": ("model", Path.unlink, "stream.onnx"),
    "truncated model": ("model", truncated, "stream.onnx.json again"),
    "altered model": ("model", altered, "stream.onnx.json again"),
    "no sidecar": ("sidecar", Path.unlink, "stream.onnx.json"),
    "truncated sidecar": ("sidecar", truncated, "stream.onnx.json"),
    "bin graph": ("sidecar", told(graph="bin"), "bin stream"),
    **{
        f"no {key}": ("sidecar", told(**{key: None}), f"stream.onnx.json {key} nothing again")
        for key in ("onnx_sha256", "channels", "sample_rate_hz", "state_size")
    },
    "half precision": (
        "sidecar",
        told(precision="float16"),
        "stream.onnx.json precision float16 float32 float64",
    ),
    "rate in words": ("sidecar", told(sample_rate_hz="2 kHz"), 'stream.onnx.json "2 kHz" positive'),
    "negative tail": (
        "sidecar",
        told(tail_samples=-1),
        "stream.onnx.json tail_samples -1 whole",
    ),
    "no recording": ("recording", Path.unlink, "recording.npy"),
    "truncated recording": ("recording", truncated, "recording.npy cut off"),
    "negative shape": ("recording", negative_shape, "recording.npy save"),
    "text": ("recording", lambda path: path.write_text("volts\n"), "recording.npy .npy"),
    "integers": (
        "recording",
        as_array(lambda x: (1000 * x).astype("<i2")),
        "recording.npy float32 <i2",
    ),
    "Fortran order": ("recording", as_array(np.asfortranarray), "Fortran"),
    "big-endian": ("recording", as_array(lambda x: x.astype(">f4")), ">f4 little-endian"),
    "three axes": ("recording", as_array(lambda x: x[None]), "4000 4"),
    "too few channels": ("recording", as_array(lambda x: x[:, :3].copy()), "recording.npy 3 4"),
}
WRONG_OPTIONS = {
    # options, words of the line
    "--rate 1000": "1000 2000",
    "--rate 0x7d0": "--rate 0x7d0",
    "--chunk 0": "--chunk 0",
    "--chunk 5000": "--chunk 5000 2000",
    "--chunk 999999999999999999999999999999": "--chunk 999",
    "--threshold high": "--threshold high",
    "--threshold 1e400": "--threshold 1e400",
    "--decisions=1": "--decisions",
    "--loud": "--loud",
}


def assert_refused(ran, words, status):
    assert (ran.status, ran.lines) == (status, []), ran.stderr
    (line,) = ran.stderr.splitlines()
    assert line.startswith("error: ")
    missing = [word for word in words.split() if word not in line]
    assert not missing, line


@pytest.mark.parametrize("host", ["c", *SLOW_START], indirect=True)
@pytest.mark.parametrize("wrong", WRONG_FILES)
def test_a_wrong_file_is_one_line_and_a_failing_exit(host, wrong, stream, recording, tmp_path):
    which, change, words = WRONG_FILES[wrong]
    model, own = copied(stream, tmp_path), Path(shutil.copy(recording, tmp_path))
    change({"model": model, "sidecar": sidecar_of(model), "recording": own}[which])
    assert_refused(run_host(host, model, own), words, 1)


@pytest.mark.parametrize("host", ["c", *SLOW_START], indirect=True)
@pytest.mark.parametrize("options", WRONG_OPTIONS)
def test_a_wrong_option_is_one_line_and_a_failing_exit(host, options, stream, recording):
    status = 1 if options == "--rate 1000" else 2
    ran = run_host(host, stream, recording, *options.split())
    assert_refused(ran, WRONG_OPTIONS[options], status)


def test_without_files_the_usage_is_told(host):
    assert_refused(run_host(host), "recording.npy", 2)


@pytest.mark.parametrize("options", [[EVERY], [THRESHOLD, "1e9"]], ids=len)
def test_lines_that_cannot_be_written_are_an_error(host, stream, recording, options):
    command = [str(word) for word in (*host, stream, recording, *options)]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=300
        )
    assert done.returncode == 1, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: the output cannot be written")


# C ---------------------------------------------------------------------------------------------


def test_parts_hold_chunks_agree_and_a_push_takes_no_memory(build, stream, fast_stream):
    for each in (stream, fast_stream):
        assert "parts and pushes hold" in build("test", f"MODEL={each}")


def test_the_example_of_the_page_compiles_and_feels_the_slips(places, build, fast_stream, tmp_path):
    build()
    source, folder = EXPORT / "c", places["build"]
    page = (source / "README.md").read_text(encoding="utf-8")
    example = page.split("<!-- example -->\n```c\n")[1].split("```")[0]
    raw = tmp_path / "samples.raw"
    raw.write_bytes(hosts.slipping_stream().tobytes())
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
    command = ["gcc", "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{source}"]
    command += [tmp_path / "loop.c", "-o", tmp_path / "loop"]
    command += [source / f"{name}.c" for name in ("slip", "model", "sidecar", "sha256")]
    command += [f"-L{folder}", "-lonnxruntime", f"-Wl,-rpath,{folder}"]
    subprocess.run(command, check=True)
    words = [tmp_path / "loop", fast_stream, raw]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found = [float(text) for text in re.findall(r"slip since ([\d.]+) s\n", done.stdout)]
    expected = truth(hosts.slipping_stream(), with_onset=True)
    onsets_s = [row["onset_s"] for row in expected if row["alarm"]]
    assert found == pytest.approx(onsets_s, abs=1e-3)


def test_a_program_in_cpp_links_with_the_host(places, build, tmp_path):
    build(library := f"{places['build']}/libslip.so")
    code = '#include "slip.h"\nint main() { slip_close(nullptr); return slip_push != nullptr; }\n'
    (tmp_path / "loop.cpp").write_text(code)
    command = ["g++", "-std=c++11", "-Wall", "-Werror", "-Wno-address", f"-I{EXPORT / 'c'}"]
    command += [tmp_path / "loop.cpp", library, f"-Wl,-rpath,{places['build']}"]
    subprocess.run([*command, "-o", tmp_path / "loop"], check=True)
    assert subprocess.run([tmp_path / "loop"], check=False).returncode == 1


# Python ----------------------------------------------------------------------------------------


def test_the_python_host_needs_no_torch(stream, recording):
    code = (
        "import runpy, sys; sys.modules |= dict.fromkeys(['torch', 'tactslip_torch']); "
        "sys.argv = sys.argv[1:]; sys.path.insert(0, sys.argv.pop(0)); "
        "runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    folder = EXPORT / "python"
    without = [sys.executable, "-c", code, folder, folder / "detect.py"]
    assert run_host(without, stream, recording).summary["alarms"] > 0


# Bins by themselves ----------------------------------------------------------------------------

SCORE = [sys.executable, EXPORT / "python" / "score.py"]


def test_bins_are_scored_as_the_package_scores_them(stream, paper, tmp_path):
    detector = paper.detector
    before, after = detector.context_before, detector.context_after
    broken = hosts.without(SAMPLES, "200 samples")
    broken[2500:2510, 1:3] = np.nan
    path = saved(tmp_path / "recording.npy", broken)
    ran = run_host(SCORE, stream.with_name(names.BIN_GRAPH), path)
    lines = [*ran.lines, ran.summary]  # there is no line of sums
    starts = [round(line["start_s"] * 2000) for line in lines]
    assert np.diff(starts).tolist() == [100] * (len(lines) - 1)
    assert starts[0] <= before
    assert len(broken) - 100 < starts[-1] + 100 + after <= len(broken)
    bins = np.stack([broken[s - before : s + 100 + after].T for s in starts[1:-1]])
    predicted = detector.predict_raw(torch.from_numpy(bins).double())
    assert [line["valid"] for line in lines[1:-1]] == predicted.is_valid.tolist()
    assert [line["in_range"] for line in lines[1:-1]] == predicted.in_range.tolist()
    names_lost = [
        [name for name, is_lost in zip(detector.pool.hand.names, row, strict=True) if is_lost]
        for row in predicted.channels_lost.tolist()
    ]
    assert [line["channels_lost"] for line in lines[1:-1]] == names_lost
    assert not predicted.is_valid.all()
    found = np.array([line["score"] for line in lines[1:-1]], float)  # null is NaN
    close = 1e-3 * np.nanstd(predicted.score)
    np.testing.assert_allclose(found, predicted.score, rtol=0, atol=close)


def test_a_recording_shorter_than_a_window_has_no_bins(stream, tmp_path):
    path = saved(tmp_path / "recording.npy", SAMPLES[:50])
    command = [*map(str, SCORE), stream.with_name(names.BIN_GRAPH), path]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


def test_a_stream_graph_is_refused_for_bins(stream, recording):
    assert_refused(run_host(SCORE, stream, recording), "give model.onnx", 1)
