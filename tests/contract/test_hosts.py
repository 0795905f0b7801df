"""The four hosts of an exported stream decide what the package decides, and refuse the same."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from . import names
from .recordings import samples_of
from .running import ROOT

pytestmark = pytest.mark.onnx

EXPORT = ROOT / "export"
BROWSER = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))
NEEDS = {"python": [], "c": ["gcc", "make"], "node": ["node", "npm"], "web": ["node", "npm"]}
COMMAND_LINE_HOSTS = ["python", "c", pytest.param("node", marks=pytest.mark.slow)]
ALL_HOSTS = [*COMMAND_LINE_HOSTS, pytest.param("web", marks=pytest.mark.slow)]
SAMPLES = samples_of("D", 1)[1500:5500]
BROKEN = SAMPLES.copy()
BROKEN[2500:2510, 1:3] = np.nan


def run(words, folder=None):
    return subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=os.environ | {"CHROMIUM": str(BROWSER)},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


@pytest.fixture(scope="module")
def host_of(tmp_path_factory):
    """By name the words of a host's command; built or installed when first asked for."""
    made = {}
    places = {"python": sys.executable, "export": EXPORT, "build": tmp_path_factory.mktemp("c")}

    def host(name):
        missing = [program for program in NEEDS[name] if shutil.which(program) is None]
        if name == "web" and not BROWSER.exists():
            missing.append(f"the browser {BROWSER}")
        if missing:
            pytest.skip(f"not installed: {', '.join(missing)}")
        if name not in made:
            if name == "c":
                done = run(names.BUILD_C_HOST.format(**places).split())
                assert done.returncode == 0, done.stderr
            if name in ("node", "web") and not (EXPORT / name / "node_modules").exists():
                done = run(names.INSTALL_HOST.split(), EXPORT / name)
                assert done.returncode == 0, done.stderr
            made[name] = names.HOSTS[name].format(**places).split()
        return made[name]

    return host


@pytest.fixture(scope="module")
def stream(graphs_of):
    return graphs_of("selected") / names.STREAM_GRAPH


def saved(folder, samples):
    path = folder / "recording.npy"
    np.save(path, samples)
    return path


def no_constant(word):
    raise AssertionError(f"{word} is not JSON")


def decided_by(host, name, stream, recording, *options):
    """All decisions a host prints, and its summary."""
    words = [*host, stream, recording, names.HOST_OPTIONS["every"], *options]
    if name == "web":
        output = recording.with_name("page.png")
        pairs = zip(names.WEB_OPTIONS, (stream, recording, output), strict=True)
        words = [*host, *(word for pair in pairs for word in pair)]
    done = run(words)
    assert done.returncode == 0, done.stderr
    *lines, summary = [
        json.loads(line, parse_constant=no_constant) for line in done.stdout.splitlines()
    ]
    return lines, summary, done.stderr


def assert_decided(lines, summary, detector, samples):
    """Flags and times are those of the package; scores to single precision."""
    expected = names.StreamingDetector(detector, dtype=torch.float64).push(samples)
    assert summary["decisions"] == len(lines) == len(expected.score) > 50
    assert summary["alarms"] == int(expected.is_alarm.sum())
    assert summary["seconds"] == len(samples) / 2000
    for name, field in names.STREAM_OUTPUTS.items():
        truth = getattr(expected, field)
        found = [line[name] for line in lines]
        if truth.dtype == torch.bool:
            assert found == truth.tolist(), name
        else:
            spread = 1e-6 if name.endswith("_s") else 1e-3 * max(1.0, float(truth.std()))
            np.testing.assert_allclose(found, truth.numpy(), rtol=0, atol=spread, err_msg=name)


@pytest.mark.parametrize("name", ALL_HOSTS)
def test_a_host_decides_what_the_package_decides(name, host_of, stream, selected, tmp_path):
    recording = saved(tmp_path, SAMPLES)
    lines, summary, _ = decided_by(host_of(name), name, stream, recording)
    assert summary["alarms"] > 0
    assert_decided(lines, summary, selected.detector, SAMPLES)


@pytest.mark.parametrize("name", COMMAND_LINE_HOSTS)
@pytest.mark.parametrize("chunk", [1, 333])
def test_any_chunk_decides_the_same(name, chunk, host_of, stream, selected, tmp_path):
    options = (names.HOST_OPTIONS["chunk"], chunk)
    found = decided_by(host_of(name), name, stream, saved(tmp_path, SAMPLES), *options)
    assert_decided(*found[:2], selected.detector, SAMPLES)


@pytest.mark.parametrize("name", COMMAND_LINE_HOSTS)
def test_missing_samples_are_flagged_and_told_once(name, host_of, stream, selected, tmp_path):
    found = decided_by(host_of(name), name, stream, saved(tmp_path, BROKEN))
    assert_decided(*found[:2], selected.detector, BROKEN)
    assert sum(not line["valid"] for line in found[0]) > 0
    (warning,) = found[2].splitlines()
    assert warning.startswith("warning: ")


@pytest.mark.parametrize("name", COMMAND_LINE_HOSTS)
def test_another_threshold_raises_other_alarms(name, host_of, stream, tmp_path):
    recording, option = saved(tmp_path, SAMPLES), names.HOST_OPTIONS["threshold"]
    given = [(), (option, 1e9), (option, -1e9)]
    found = [decided_by(host_of(name), name, stream, recording, *words)[1] for words in given]
    assert found[1]["alarms"] == 0
    assert found[2]["alarms"] == 1
    assert found[0]["alarms"] >= 1


def whole(folder, stream):
    """A copy of the stream's graph and sidecar, which may be spoilt."""
    for path in (stream, stream.with_name(names.SIDECAR.format(stream.name))):
        shutil.copy(path, folder)
    return folder / stream.name


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def without_sidecar(path):
    path.with_name(names.SIDECAR.format(path.name)).unlink()


WRONG = {
    # what is done to the model, what the recording is, options, words of the line, exit status
    "no model": (Path.unlink, SAMPLES, (), "stream.onnx", 1),
    "half a model": (cut, SAMPLES, (), "stream.onnx.json again", 1),
    "no sidecar": (without_sidecar, SAMPLES, (), "stream.onnx.json", 1),
    "too few channels": (None, SAMPLES[:, :3].copy(), (), "recording.npy 3 4", 1),
    "integers": (None, (1000 * SAMPLES).astype("<i2"), (), "recording.npy float32 <i2", 1),
    "another rate": (None, SAMPLES, (names.HOST_OPTIONS["rate"], 1000), "1000 2000", 1),
    "no chunk": (None, SAMPLES, (names.HOST_OPTIONS["chunk"], 0), "--chunk 0", 2),
    "no number": (None, SAMPLES, (names.HOST_OPTIONS["threshold"], "high"), "--threshold high", 2),
    "no option": (None, SAMPLES, ("--loud",), "--loud", 2),
}


@pytest.mark.parametrize("name", COMMAND_LINE_HOSTS)
@pytest.mark.parametrize("wrong", WRONG)
def test_a_mistake_is_one_line_and_a_failing_exit(name, wrong, host_of, stream, tmp_path):
    spoil, samples, options, words, status = WRONG[wrong]
    model = whole(tmp_path, stream)
    if spoil is not None:
        spoil(model)
    done = run([*host_of(name), model, saved(tmp_path, samples), *options])
    assert done.returncode == status, done.stderr
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    missing = [word for word in words.split() if word not in line]
    assert not missing, line
