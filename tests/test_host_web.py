"""How the page of export/web reads recordings, in Node; its browser is asked in test_host_all."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hosts import EXPORT, RATE, alarming_detector, slipping_stream

from tactslip_torch import sample_recording
from tactslip_torch.data.formats import named_format
from tactslip_torch.hand import HandLayout
from tactslip_torch.pretrained import RECORDING

WEB = EXPORT / "web"
ROOT = Path(__file__).parents[1]


def recordings_in(folder: Path) -> dict[str, Path]:
    """The stream in files as the package writes them, channels in another order."""
    hand = HandLayout(alarming_detector().pool.hand.channels[::-1])
    samples = torch.from_numpy(slipping_stream().T.copy()).flip(0)
    recording = replace(sample_recording(), samples=samples)
    paths = {ending: folder / f"own.{ending}" for ending in ("npz", "csv")}
    for path in paths.values():
        named_format(path.suffix[1:]).save(path, recording, hand, {})
    return paths


READ = """
import { readFile } from "node:fs/promises";
import { readRecording } from "./files.mjs";
const { buffer } = new Uint8Array(await readFile(process.argv[1]));
const read = readRecording(buffer, process.argv[1].split("/").at(-1), JSON.parse(process.argv[2]));
const { volts, ...more } = await read.catch((error) => ({ volts: [], error: error.message }));
console.log(JSON.stringify({ volts: Array.from(volts), ...more }));
"""


def read_by_the_page(path: Path, **facts: object) -> dict[str, Any]:
    """What the page reads, of the packaged detector's hand; ``error`` where it refuses."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed: apt-get install nodejs npm")
    names = list(alarming_detector().pool.hand.names)
    wanted = json.dumps({"channels": names, "sample_rate_hz": RATE, "unit": "V"} | facts)
    command = ["node", "--input-type=module", "-e", READ, str(path), wanted]
    done = subprocess.run(command, cwd=WEB, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_the_page_reads_what_the_package_writes(tmp_path, ending):
    told = read_by_the_page(recordings_in(tmp_path)[ending])
    found = np.array(told["volts"], np.float32).reshape(-1, 24)
    np.testing.assert_array_equal(found, slipping_stream())  # in the detector's order
    assert (told["rate"], told["isSimulated"], told["onsetsS"]) == (
        RATE,
        True,
        list(sample_recording().onsets_s),
    )


def test_the_page_reads_the_packed_sample_recording():
    probe = ["node", "-e", "new DecompressionStream('deflate-raw')"]
    if shutil.which("node") and subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("node before 20.12 does not unpack deflate-raw, as browsers do")
    told = read_by_the_page(RECORDING)
    found = np.array(told["volts"], np.float32).reshape(-1, 24)
    np.testing.assert_array_equal(found, sample_recording().samples.T)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200_000])


@pytest.mark.parametrize(
    ("ending", "spoil", "facts", "words"),
    [
        ("npz", _cut, {}, "damaged end is missing"),
        ("csv", _cut, {}, "line cells 25"),
        ("csv", None, {"sample_rate_hz": 1000}, "2000 1000 resample"),
        ("npz", None, {"channels": ["a", "b"]}, "24 channels wants 2 a to b"),
        ("npz", None, {"channels": [f"e{i}" for i in range(24)]}, "no channel e0 PVDF10"),
    ],
)
def test_a_file_that_is_not_to_be_played_is_one_line(tmp_path, ending, spoil, facts, words):
    path = recordings_in(tmp_path)[ending]
    if spoil:
        spoil(path)
    said = read_by_the_page(path, **facts)["error"]
    assert path.name in said
    assert [word for word in words.split() if word not in said] == []
    assert len(said.splitlines()) == 1
