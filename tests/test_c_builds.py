"""libtactslip as C programs: built here, with sanitizers, for aarch64 and for emulated boards."""

import json
import shutil
import subprocess

import hosts
import numpy as np
import pytest
import small_detector
import torch
from hosts import EXPORT, alarming_detector, run_host, saved, slipping_stream, truth

from benchmarks.native_c import BOARDS, make, missing_tools, on_board, sample_counts
from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.commands.hosts import copy_host
from tactslip_torch.deploy.native import SOURCE, NativeFile

pytestmark = pytest.mark.slow
HOST = EXPORT / "native"
QUICK = "LEVELS=1", "OPTIMISE=-O1"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    if not (shutil.which("g++") and shutil.which("make")):
        pytest.skip("no g++ and make here")
    folder = tmp_path_factory.mktemp("built")
    make(folder, "all", *QUICK)
    return folder


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files of detectors, by whether there is an onset classifier and by precision."""
    folder = tmp_path_factory.mktemp("files")
    made = {}
    for with_onset in (False, True):
        for precision in ("float64", "float32"):
            path = folder / f"{with_onset}-{precision}.tslip"
            path.write_bytes(NativeFile.of(alarming_detector(with_onset), precision).content)
            made[with_onset, precision] = path
    return made


@pytest.mark.parametrize("with_onset", [False, True], ids=["bins", "onset"])
@pytest.mark.parametrize("lost", [None, *hosts.LOST])
def test_the_program_decides_what_the_package_decides(built, files, tmp_path, with_onset, lost):
    samples = slipping_stream() if lost is None else hosts.without(slipping_stream(), lost)
    recording = saved(tmp_path / "recording.npy", samples.astype(np.float64))
    ran = run_host([built / "detect"], files[with_onset, "float64"], recording, "--decisions")
    hosts.assert_same(ran, truth(samples, with_onset=with_onset), exact=True)


def test_a_wrong_file_ends_the_program_in_one_line(built, files, tmp_path):
    recording = saved(tmp_path / "recording.npy", slipping_stream())
    content = files[False, "float32"].read_bytes()
    for name, bad, words in (
        ("cut", content[:5000], "damaged"),
        ("text", b"volts\n", "not a .tslip file"),
    ):
        (tmp_path / name).write_bytes(bad)
        ran = run_host([built / "detect"], tmp_path / name, recording)
        assert (ran.status, ran.lines) == (1, [])
        (line,) = ran.stderr.splitlines()
        assert line.startswith("error: ")
        assert words in line
    assert "cannot be read" in run_host([built / "detect"], tmp_path / "no", recording).stderr


def test_the_library_asks_for_no_memory_and_no_system(built):
    """What it takes from elsewhere is copying and mathematics, so nothing can allocate."""
    done = subprocess.run(
        ["nm", "-u", built / "libtactslip.so"], capture_output=True, text=True, check=True
    )
    taken = {line.split()[-1].split("@")[0] for line in done.stdout.splitlines()}
    known = {"memcpy", "memmove", "memset", "memcmp", "strlen"}
    known |= {f"{name}{kind}" for name in ("exp", "log", "sqrt", "pow") for kind in ("", "f")}
    known |= {"__cxa_finalize", "__gmon_start__", "_ITM_deregisterTMCloneTable"}
    known |= {"_ITM_registerTMCloneTable", "__stack_chk_fail"}
    assert taken <= known
    assert {"memcpy", "log"} <= taken


def test_no_wrong_access_on_damaged_files_and_odd_samples(files, tmp_path):
    """6,250 files, of which most have their right checksum; one kind has long bins."""
    long = tmp_path / "long.tslip"
    long.write_bytes(NativeFile.of(small_detector.alarming_detector(bin_samples=300)).content)
    make(tmp_path, "sanitized")
    opened = 0
    for number, path in enumerate([*files.values(), long]):
        command = [tmp_path / "sanitized" / "check", path, "1250", str(number)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[:3000]
        opened += json.loads(done.stdout)["opened"]
    assert 500 < opened < 5750  # both branches are seen


def test_the_example_of_the_page_compiles_and_detects_the_slips(built, files, tmp_path):
    page = (HOST / "README.md").read_text(encoding="utf-8")
    example = page.split("<!-- example -->\n```c\n")[1].split("```")[0]
    raw = tmp_path / "samples.raw"
    raw.write_bytes(slipping_stream().tobytes())
    around = """
#include <stdlib.h>
static FILE *recording;
static size_t acquire(float *samples, size_t most) {
    return fread(samples, 24 * sizeof(float), most, recording);
}
int main(int count, char **words) {
    static uint64_t content[1 << 17];
    FILE *file = count == 3 ? fopen(words[1], "rb") : NULL;
    recording = fopen(words[2], "rb");
    return file ? watch(content, fread(content, 1, sizeof content, file), acquire) : 2;
}
"""
    (tmp_path / "loop.c").write_text(example + around)
    command = ["gcc", "-std=c11", "-Wall", "-Wextra", "-Werror"]
    command += [f"-I{EXPORT.parent / 'tactslip_torch' / 'native'}", tmp_path / "loop.c"]
    command += [built / "libtactslip.a", "-lm", "-o", tmp_path / "loop"]
    subprocess.run(command, check=True)
    words = [tmp_path / "loop", files[False, "float64"], raw]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    wanted = [row["onset_s"] for row in truth(slipping_stream()) if row["alarm"]]
    found = [float(line.split()[2]) for line in done.stdout.splitlines()]
    assert found == pytest.approx(wanted, abs=1e-3)


def test_a_copied_host_is_built_and_found_by_cmake(tmp_path):
    if not shutil.which("cmake"):
        pytest.skip("no cmake here")
    host, place = copy_host("native", tmp_path), tmp_path / "installed"
    flags = f"-DCMAKE_INSTALL_PREFIX={place}", "-DCMAKE_CXX_FLAGS=-O0"
    for words in (
        ["-S", host, "-B", tmp_path / "cmake", *flags],
        ["--build", tmp_path / "cmake"],
        ["--install", tmp_path / "cmake"],
    ):
        subprocess.run(["cmake", *words], check=True, capture_output=True)
    user = tmp_path / "user"
    user.mkdir()
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.18)\nproject(user C)\nfind_package(tactslip REQUIRED)\n"
        "add_executable(user user.c)\ntarget_link_libraries(user tactslip::tactslip)\n"
    )
    (user / "user.c").write_text(
        '#include <stdio.h>\n#include "tactslip.h"\n'
        'int main(void) { return puts(tactslip_error(tactslip_open("", 0, 0))) < 0; }\n'
    )
    for words in (
        ["-S", user, "-B", user / "build", f"-DCMAKE_PREFIX_PATH={place}"],
        ["--build", user / "build"],
    ):
        subprocess.run(["cmake", *words], check=True, capture_output=True)
    done = subprocess.run([user / "build" / "user"], capture_output=True, text=True, check=True)
    assert "not a .tslip file" in done.stdout


# Other machines -----------------------------------------------------------------------------------

needs_tools = pytest.mark.skipif(bool(missing_tools()), reason="run .ci/boards")


@needs_tools
def test_aarch64_decides_what_the_package_decides(files, tmp_path):
    cross = "CC=aarch64-linux-gnu-gcc", "CXX=aarch64-linux-gnu-g++", "LINK=-static", "OPTIMISE=-O1"
    make(tmp_path, str(tmp_path / "detect"), *cross)
    recording = saved(tmp_path / "recording.npy", slipping_stream().astype(np.float64))
    for with_onset in (False, True):
        host = ["qemu-aarch64", tmp_path / "detect"]
        ran = run_host(host, files[with_onset, "float64"], recording, "--decisions")
        hosts.assert_same(ran, truth(slipping_stream(), with_onset=with_onset), exact=True)


@needs_tools
@pytest.mark.parametrize("board", BOARDS)
def test_a_board_raises_the_alarms_of_the_package(board, tmp_path):
    """Of the shipped detector on the sample recording, simulated, as counts of 16 bits."""
    detector, (counts, scale) = SlipDetector.pretrained(), sample_counts()
    content = NativeFile.of(detector, scale=scale)
    (tmp_path / SOURCE).write_bytes(content.as_constants())
    found = on_board(board, tmp_path, counts)
    samples = counts.astype(np.float32) * np.float32(scale)
    decisions = StreamingDetector(detector, dtype=torch.float32).push(samples)
    wanted = [(alarm.alarm_s, alarm.onset_s) for alarm in decisions.alarms]
    assert len(wanted) == 1
    np.testing.assert_allclose(found["alarms"], wanted, rtol=0, atol=2e-6)
    assert found["decisions"] == len(decisions.number)
    assert found["instructions"] < 5.5e6
    assert found["ram"] < 64e3
    assert found["flash"] < 350e3


@needs_tools
def test_the_program_with_a_ring_compiles_for_a_microcontroller(tmp_path):
    source = HOST / "arduino" / "src" / "main.cpp"
    command = ["arm-none-eabi-g++", "-mcpu=cortex-m7", "-mthumb", "-std=c++17", "-Wall", "-Wextra"]
    command += ["-Werror", f"-I{EXPORT.parent / 'tactslip_torch' / 'native'}"]
    subprocess.run([*command, "-c", source, "-o", tmp_path / "main.o"], check=True)
