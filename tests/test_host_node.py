"""The exported detector in Node, export/node, decides what the package decides."""

import fcntl
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from host_cases import (
    CASES,
    SPELLINGS,
    assert_loss_is_told,
    assert_read,
    assert_refused,
    assert_versions_are_read,
    assert_warned,
)
from hosts import (
    ALARM_KEYS,
    assert_same,
    exported,
    run_host,
    saved,
    slipping_stream,
    truth,
)

EXPORT = Path(__file__).parents[1] / "export"


def installed(folder: Path) -> None:
    """Install a folder's packages where its lock file is newer than what is there.

    Two test files may want the same folder in two processes: one of them waits.
    """
    if shutil.which("node") is None:
        pytest.skip("node is not installed: apt-get install nodejs npm")
    wanted, done = folder / "package-lock.json", folder / "node_modules" / ".package-lock.json"
    with wanted.open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if done.exists() and done.stat().st_mtime >= wanted.stat().st_mtime:
            return
        if shutil.which("npm") is None:
            pytest.skip("npm is not installed: apt-get install npm")
        ran = subprocess.run(["npm", "ci"], cwd=folder, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr


@pytest.fixture(scope="module")
def host():
    installed(EXPORT / "node")
    return ["node", EXPORT / "node" / "detect.mjs"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return exported(tmp_path_factory) / "stream.onnx"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("recording") / "recording.npy", slipping_stream())


@pytest.mark.onnx
@pytest.mark.parametrize("chunk", [7, 200, 2000])
def test_decisions_are_those_of_the_package_for_any_chunk(host, model, recording, chunk):
    ran = run_host(host, model, recording, "--decisions", "--chunk", chunk)
    assert_same(ran, truth(slipping_stream()))
    assert ran.summary["seconds"] == len(slipping_stream()) / 2000
    assert ran.stderr == ""


@pytest.mark.onnx
def test_a_model_in_float64_decides_exactly(host, tmp_path_factory, tmp_path):
    precise = exported(tmp_path_factory, "float64") / "stream.onnx"
    double = saved(tmp_path / "double.npy", slipping_stream().astype("<f8"))
    assert_same(
        run_host(host, precise, double, "--decisions"), truth(slipping_stream()), exact=True
    )


@pytest.mark.onnx
def test_alarms_alone_follow_the_threshold(host, model, recording):
    for threshold in (None, 0.5):
        given = [] if threshold is None else [f"--threshold={threshold}"]
        ran = run_host(host, model, recording, "--rate", "2000", *given)
        alarms = [row for row in truth(slipping_stream(), threshold) if row["alarm"]]
        assert alarms
        assert ran.summary["alarms"] == len(alarms)
        assert [line["time_s"] for line in ran.lines] == [row["time_s"] for row in alarms]
        assert {tuple(line) for line in ran.lines} == {ALARM_KEYS}
    assert len(alarms) != sum(row["alarm"] for row in truth(slipping_stream()))


@pytest.mark.onnx
def test_missing_samples_are_flagged_and_the_host_goes_on(host, model, tmp_path):
    broken = slipping_stream().copy()
    broken[1500:1540] = np.nan
    ran = run_host(host, model, saved(tmp_path / "broken.npy", broken), "--decisions")
    assert [line["valid"] for line in ran.lines] == [row["valid"] for row in truth(broken)]
    assert [line["alarm"] for line in ran.lines] == [row["alarm"] for row in truth(broken)]
    assert_warned(ran, truth(broken))


@pytest.mark.onnx
@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_said_in_one_line(host, model, tmp_path, case):
    assert_refused(host, case, tmp_path, model)


@pytest.mark.onnx
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_options_are_read_however_they_are_written(host, model, recording, spelling):
    assert_read(host, spelling, model, recording)


@pytest.mark.onnx
def test_later_versions_of_the_file_format_are_read(host, model, tmp_path):
    assert_versions_are_read(host, model, tmp_path)


@pytest.mark.onnx
def test_lines_that_cannot_be_written_are_an_error(host, model, recording):
    assert_loss_is_told(host, model, recording)


PROGRAM = """
import { readFileSync } from "node:fs";
import { SlipStream } from "./stream.mjs";

const volts = new Float64Array(JSON.parse(readFileSync(0)));
const stream = await SlipStream.open(process.argv[1]);
const width = stream.facts.channels.length;
const whole = await stream.push(volts);
await stream.reset();
const cuts = [0, 1, 1, 250, 3397].map((rows) => rows * width);
const pieces = cuts.map((cut, i) => stream.push(volts.subarray(cut, cuts[i + 1])));
const cut = (await Promise.all(pieces)).flat();
const refused = [];
for (const wrong of [volts.subarray(1), [0, 1]]) {
  await stream.push(wrong).catch((error) => refused.push(error.message));
}
await stream.reset();
const after = await stream.push(volts);
console.log(JSON.stringify({ whole, cut, after, refused }));
"""


@pytest.mark.onnx
def test_a_program_may_cut_and_begin_again_as_it_likes(host, model):
    volts = slipping_stream().astype(float)  # more than the graph is given at a time
    told = subprocess.run(
        ["node", "--input-type=module", "-e", PROGRAM, model],
        input=json.dumps(volts.ravel().tolist()),
        cwd=EXPORT / "node",
        capture_output=True,
        text=True,
        check=True,
    )
    said = json.loads(told.stdout)
    expected = truth(slipping_stream())
    for decisions in (said["whole"], said["cut"], said["after"]):
        for name in ("time_s", "valid", "alarm", "on"):
            assert [each[name] for each in decisions] == [row[name] for row in expected]
    rows, kind = said["refused"]
    assert "24 channels (SG1 to PVDF10)" in rows
    assert "Float32Array" in kind
