"""The C host, built here with gcc, says what ``StreamingDetector`` says, and survives as much."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import hosts
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
from hosts import assert_same, run_host, saved, truth

pytestmark = [
    pytest.mark.onnx,
    pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc here to build the C host"),
    pytest.mark.skipif(not shutil.which("make"), reason="no make here to build the C host"),
]

FOLDER = Path(__file__).parents[1] / "export" / "c"


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Runs ``make`` with words of a command line, all it builds in a folder of this session."""
    build = tmp_path_factory.mktemp("c")

    def run(*words):
        command = ["make", "-C", FOLDER, "CC=gcc", f"PYTHON={sys.executable}", f"BUILD={build}"]
        done = subprocess.run([*command, *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run.build = build
    return run


@pytest.fixture(scope="module")
def host(make):
    make()
    return [make.build / "detect"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return hosts.exported(tmp_path_factory) / "stream.onnx"


@pytest.fixture
def recording(tmp_path):
    return saved(tmp_path / "recording.npy", hosts.slipping_stream())


@pytest.mark.parametrize("chunk", [1, 200, 1999])
def test_every_decision_is_that_of_the_package(host, model, recording, chunk):
    ran = run_host(host, model, recording, "--decisions", "--chunk", chunk, "--rate", 2000)
    assert_same(ran, truth(hosts.slipping_stream()))
    assert ran.summary["seconds"] == len(hosts.slipping_stream()) / hosts.RATE
    assert ran.stderr == ""


def test_it_prints_what_the_host_in_python_prints(host, model, recording):
    """Both run the same library: not a bit may be lost on the way out."""
    python = [sys.executable, FOLDER.parent / "python" / "detect.py"]
    found, expected = (run_host(h, model, recording, "--decisions") for h in (host, python))
    single = {"score", "probability", "statistic"}
    for ran in (found, expected):
        for line in ran.lines:
            line.update({name: float(np.float32(line[name])) for name in single})
    assert found == expected


def test_alarms_alone_are_printed_unless_asked(host, model, recording):
    ran = run_host(host, model, recording)
    expected = [row for row in truth(hosts.slipping_stream()) if row["alarm"]]
    assert len(expected) > 1
    assert [list(line) for line in ran.lines] == [list(hosts.ALARM_KEYS)] * len(expected)
    assert [line["time_s"] for line in ran.lines] == [row["time_s"] for row in expected]


def test_another_threshold_raises_other_alarms(host, model, recording):
    ran = run_host(host, model, recording, "--decisions", "--threshold", 4.5)
    expected = truth(hosts.slipping_stream(), threshold=4.5)
    usual = truth(hosts.slipping_stream())
    assert [row["alarm"] for row in expected] != [row["alarm"] for row in usual]
    assert_same(ran, expected)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_graph_in_double_precision_is_fed_in_it(host, tmp_path, tmp_path_factory, dtype):
    model = hosts.exported(tmp_path_factory, "float64") / "stream.onnx"
    samples = hosts.slipping_stream()[2000:5000] * (1 + 2.0**-40)  # no float32
    samples = samples.astype(dtype)
    ran = run_host(host, model, saved(tmp_path / "recording.npy", samples), "--decisions")
    assert_same(ran, truth(samples), exact=True)


def test_a_graph_in_single_precision_takes_a_recording_in_double(host, model, tmp_path):
    samples = hosts.slipping_stream().astype(np.float64)
    ran = run_host(host, model, saved(tmp_path / "recording.npy", samples), "--decisions")
    assert_same(ran, truth(samples))


def test_a_broken_sensor_is_flagged_and_survived(host, model, tmp_path):
    samples = hosts.slipping_stream().copy()
    samples[1000:1010] = np.nan
    ran = run_host(host, model, saved(tmp_path / "recording.npy", samples), "--decisions")
    assert_same(ran, truth(samples))
    assert_warned(ran, truth(samples))


def test_a_recording_of_nothing_has_no_decision(host, model, tmp_path):
    ran = run_host(host, model, saved(tmp_path / "nothing.npy", hosts.slipping_stream()[:0]))
    assert ran == ([], {"decisions": 0, "alarms": 0, "seconds": 0}, "", 0)


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_one_line(host, model, tmp_path, case):
    assert_refused(host, case, tmp_path, model)


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_options_are_read_however_they_are_written(host, model, recording, spelling):
    assert_read(host, spelling, model, recording)


def test_later_versions_of_the_file_format_are_read(host, model, tmp_path):
    assert_versions_are_read(host, model, tmp_path)


def test_lines_that_cannot_be_written_are_an_error(host, model, recording):
    assert_loss_is_told(host, model, recording)


def test_parts_hold_chunks_agree_and_a_push_takes_no_memory(make, model):
    assert "parts and pushes hold" in make("test", f"MODEL={model}")


def test_a_program_may_write_numbers_with_a_comma(make, model, tmp_path):
    if shutil.which("localedef") is None:
        pytest.skip("no localedef here to make a locale")
    ascii_map = "".join(f"<U{i:04X}> /x{i:02x}\n" for i in range(128))
    head = "<code_set_name> ANSI_X3.4-1968\n<comment_char> %\n<escape_char> /\n"
    (tmp_path / "ascii").write_text(f"{head}CHARMAP\n{ascii_map}END CHARMAP\n")
    mark = 'decimal_point ","\nthousands_sep ""\ngrouping -1\n'
    (tmp_path / "comma.txt").write_text(f"LC_NUMERIC\n{mark}END LC_NUMERIC\n")
    command = ["localedef", "-c", "-f", "./ascii", "-i", "./comma.txt", "./comma"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)  # 1: it is no whole one
    make(f"{make.build}/check")
    done = subprocess.run(
        [make.build / "check", model],
        env={"LOCPATH": str(tmp_path), "LC_NUMERIC": "comma"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["parts and pushes hold", "a half is written 0,5 here"]


def test_the_example_of_the_page_compiles_and_feels_the_slips(make, host, model, tmp_path):
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
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
    parts = [FOLDER / f"{name}.c" for name in ("slip", "model", "sidecar", "sha256")]
    command = ["gcc", "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{FOLDER}", tmp_path / "loop.c"]
    command += [*parts, f"-L{make.build}", "-lonnxruntime", f"-Wl,-rpath,{make.build}"]
    subprocess.run([*command, "-o", tmp_path / "loop"], check=True)
    words = [tmp_path / "loop", model, raw]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found = [float(text) for text in re.findall(r"slip since ([\d.]+) s\n", done.stdout)]
    expected = [row["onset_s"] for row in truth(hosts.slipping_stream()) if row["alarm"]]
    assert found == pytest.approx(expected, abs=1e-3)
