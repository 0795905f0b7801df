"""Commands in the READMEs of export/, run as written: the hosts agree about one recording."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from hosts import (
    EXPORT,
    Ran,
    assert_same,
    copied,
    exported,
    installed,
    saved,
    slipping_stream,
    truth,
)
from PIL import Image
from test_host_web import BROWSER

pytestmark = [
    pytest.mark.onnx,
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc here to build the C host"),
    pytest.mark.skipif(not shutil.which("make"), reason="no make here to build the C host"),
]

ENVIRONMENT = os.environ | {
    "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    "CHROMIUM": str(BROWSER),
}


def command(folder: str, mark: str) -> str:
    """The command of a README behind its mark, without what would be installed before."""
    page = (EXPORT / folder / "README.md").read_text(encoding="utf-8")
    text = page.split(f"<!-- command: {mark} -->\n```bash\n")[1].split("\n```")[0]
    return text.split(" && ")[-1]


def run(folder: Path, text: str) -> str:
    """What a command prints that runs in a folder to its end, without a word of complaint."""
    done = subprocess.run(
        ["bash", "-ec", text],
        cwd=folder,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def ran(printed: str) -> Ran:
    *lines, summary = map(json.loads, printed.splitlines())
    return Ran(lines, summary, "", 0)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A copy of export/ where model and recording lie as the READMEs have them."""
    room = tmp_path_factory.mktemp("room")
    made = exported(tmp_path_factory)
    copied(made / "stream.onnx", room)
    leave = shutil.ignore_patterns("node_modules", "build", "__pycache__", "page.png")
    for folder in ("python", "c", "node", "web"):
        place = room / "export" / folder
        shutil.copytree(EXPORT / folder, place, ignore=leave)
        saved(place / "recording.npy", slipping_stream())
        np.savez(place / "recording.npz", samples=slipping_stream().T)
        for name in ("model.onnx", "stream.onnx"):
            copied(made / name, place)
    for folder in ("node", "web"):
        installed(EXPORT / folder)
        (room / "export" / folder / "node_modules").symlink_to(EXPORT / folder / "node_modules")
    run(room / "export" / "c", command("c", "build"))
    return room / "export"


@pytest.fixture(scope="module")
def shot(room):
    """What the page decided, once it has left its picture."""
    if not BROWSER.exists():
        pytest.skip(f"no browser {BROWSER}: apt-get install chromium, or set CHROMIUM")
    return run(room / "web", f"{command('web', 'shot')} --scheme=dark")


def test_the_hosts_agree_about_every_decision(room, shot):
    said = {
        host: ran(run(room / host, f"{command(host, 'detect')} --decisions"))
        for host in ("python", "c", "node")
    }
    said["page"] = ran(shot)
    expected = truth(slipping_stream())
    assert sum(row["alarm"] for row in expected) > 1
    for each in said.values():
        assert each.summary == said["page"].summary
        assert_same(each, expected)


def test_the_page_is_served_with_what_was_given(room):
    words = ["bash", "-c", f"exec {command('web', 'serve')}"]
    with subprocess.Popen(
        words, cwd=room / "web", env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            address = server.stdout.readline().strip()
            got = {}
            for path in ("", "model", "recording", "given.json"):
                with urlopen(address + path, timeout=60) as response:
                    got[path] = response.read()
        finally:
            server.kill()
    assert got[""] == (EXPORT / "web" / "index.html").read_bytes()
    assert got["model"] == (room / "web" / "stream.onnx").read_bytes()
    assert got["recording"] == (room / "web" / "recording.npz").read_bytes()
    told = {"model": "stream.onnx", "recording": "recording.npz", "simulated": False}
    assert json.loads(got["given.json"]) == told


def test_a_shot_leaves_a_picture_of_rest_slip_and_alarms(room, shot):
    with Image.open(room / "web" / "page.png") as image:
        pixels = image.convert("RGB").getcolors(maxcolors=1 << 24)
    num_pixels = {"#{:02x}{:02x}{:02x}".format(*colour): num for num, colour in pixels}
    dark = (EXPORT / "web" / "style.css").read_text().split("prefers-color-scheme: dark")[1]
    for name in ("page", "panel", "rest", "slip", "alarm"):  # it is dark, and both states are there
        assert num_pixels[dark.split(f"--{name}: ")[1][:7]] > 100, name
    assert [path.name for path in (room / "web").glob("page.png*")] == ["page.png"]
