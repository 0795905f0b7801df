"""Hosts as a user runs them: the commands of the READMEs in export/, and the page in a browser."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
from hosts import (
    EXPORT,
    RATE,
    Ran,
    alarming_detector,
    altered,
    assert_same,
    copied,
    exported,
    installed,
    saved,
    sidecar_of,
    slipping_stream,
    truncated,
    truth,
    without,
)
from PIL import Image
from test_host_web import WEB, recordings_in

from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.data.formats import named_format
from tactslip_torch.live.sinks import decision_columns
from tactslip_torch.onset.decisions import KEY
from tactslip_torch.pretrained import NAME, RECORDING

pytestmark = [pytest.mark.onnx, pytest.mark.slow]
ROOT = Path(__file__).parents[1]
BROWSER = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))

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


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A copy of export/ where model and recording lie as the READMEs have them."""
    if not (shutil.which("gcc") and shutil.which("make")):
        pytest.skip("no gcc and make here to build the C host")
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
        host: ran(run(room / host, f"{command(host, 'detect')} --decisions").splitlines())
        for host in ("python", "c", "node")
    }
    said["page"] = ran(shot.splitlines())
    expected = truth(slipping_stream())
    assert any(row["alarm"] for row in expected)
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


# The page in a browser --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def script():
    """Runs a script of the page, gives what it prints."""
    if not BROWSER.exists():
        pytest.skip(f"no browser {BROWSER}: apt-get install chromium, or set CHROMIUM")
    installed(WEB)

    def run(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = ["node", WEB / name, *arguments]
        return subprocess.run(
            [str(part) for part in command],
            capture_output=True,
            text=True,
            check=False,
            timeout=300 + LIVE_S,
        )

    return run


def ran(lines: list[str]) -> Ran:
    """What the page decided, as if a host had printed it."""
    *decisions, summary = [json.loads(line) for line in lines]
    return Ran(decisions, summary, "", 0)


def broken_streams() -> dict[str, np.ndarray]:
    """With lost samples and, at the end, another level; with a dead channel; without all."""
    faint = without(slipping_stream()[:2000], "200 samples")
    faint[1200:] *= 0.2
    dead = without(slipping_stream()[:2000], "a dead channel")
    return {"faint": faint, "dead": dead, "missing": dead * np.nan}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return exported(tmp_path_factory) / "stream.onnx"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("recording") / "recording.npy", slipping_stream())


@pytest.fixture(scope="module")
def seen(script, model, recording, tmp_path_factory):
    """What ``check.mjs`` saw: one browser for all that is asked below."""
    folder = tmp_path_factory.mktemp("dropped")
    (folder / "notes.npy").write_text("volts\n")
    seven = saved(folder / "seven.npy", slipping_stream()[:600, :7].copy())
    broken = [saved(folder / f"{name}.npy", x) for name, x in broken_streams().items()]
    good = recordings_in(folder)
    cut = folder / "cut.npz"
    cut.write_bytes(good["npz"].read_bytes()[:50_000])
    changed = []
    for name, change in {
        "altered": altered,
        "truncated": truncated,
        "lone": lambda path: sidecar_of(path).unlink(),
        "slower": lambda path: _says(path, sample_rate_hz="1 kHz"),
        "bin": lambda path: _says(path, graph="bin"),
    }.items():
        changed.append(copied(model, tmp_path_factory.mktemp(name)))
        change(changed[-1])
    files = ["--simulated", "--model", model, "--recording", recording]
    dropped = [
        f"--drop={path}" for path in (folder / "notes.npy", seven, cut, *good.values(), *broken)
    ]
    done = script("check.mjs", *files, *dropped, *[f"--altered={path}" for path in changed])
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def _says(model: Path, **facts: object) -> None:
    """Change what a sidecar says."""
    sidecar = sidecar_of(model)
    sidecar.write_text(json.dumps(json.loads(sidecar.read_text()) | facts))


def test_the_page_decides_what_the_package_decides_and_sends_nothing_out(seen):
    assert_same(ran(seen["lines"]), truth(slipping_stream()))
    assert seen["errors"] == []
    assert "recording" in seen["simulated"]
    assert [fault for fault in seen["accessibility"] if fault[1] in ("serious", "critical")] == []
    assert any(url.endswith("/model") for url in seen["requests"])
    assert {urlsplit(url).hostname for url in seen["requests"]} == {"127.0.0.1"}


def test_an_onset_classifier_is_drawn_and_named(script, recording, tmp_path_factory):
    folder = exported(tmp_path_factory, with_onset=True)
    picture = folder / "page.png"
    files = ["--model", folder / "stream.onnx", "--recording", recording, "--output", picture]
    done = script("shot.mjs", *files)
    assert done.returncode == 0, done.stderr
    assert_same(ran(done.stdout.splitlines()), truth(slipping_stream(), with_onset=True))
    assert picture.stat().st_size > 10_000


def test_it_plays_at_load_and_is_used_by_keyboard_alone(seen):
    assert seen["keyboard"]["playing"] == "Pause"
    assert seen["keyboard"]["paused"] == seen["keyboard"]["after"] > 0
    controls = {each["id"]: each for each in seen["tabbed"]}
    alarms = [row for row in truth(slipping_stream()) if row["alarm"]]
    assert {"play", "restart", "speed", "file", "seek", "threshold", "reset"} < set(controls)
    assert len(controls) == 7 + len(alarms)
    assert all(each["label"] and each["isRinged"] for each in controls.values())


def test_moments_are_sought_by_keys_mouse_and_the_list_of_alarms(seen):
    sought, seconds = seen["seeking"], len(slipping_stream()) / RATE
    alarms = [row["time_s"] for row in truth(slipping_stream()) if row["alarm"]]
    assert sought["alarms"] == [f"{alarm_s:.3f} s" for alarm_s in reversed(alarms)]
    expected = {"end": seconds, "Home": 0, "ArrowRight": 0.1, "PageUp": 1.1, "ArrowLeft": 1.0}
    expected["alarm"] = min(alarms[0] + 1.0, seconds)
    for name, at_s in expected.items():
        assert sought[name] == pytest.approx(at_s, abs=2 / RATE), name
    assert sought["middle"] == pytest.approx(seconds / 2, rel=0.02)
    assert f"{sought['alarm']:.1f} of {seconds:.1f} s" in sought["value"]


def test_the_slider_judges_again_by_another_threshold(seen):
    slider = {name: ran(told["lines"]) for name, told in seen["slider"].items()}
    assert slider["own"] == ran(seen["lines"])
    ceiling = alarming_detector().info[KEY]["rule"]["ceiling"]
    for name, threshold in {"least": 0.0, "most": ceiling}.items():  # no rates are known here
        assert_same(slider[name], truth(slipping_stream(), threshold))
    assert len({slider[name].summary["alarms"] for name in ("least", "own", "most")}) > 1
    standing = {name: sum(line["on"] for line in told.lines) for name, told in slider.items()}
    assert standing["least"] > standing["own"] > standing["most"]
    pixels = {name: told["pixels"] for name, told in seen["slider"].items()}
    assert pixels["least"] > pixels["own"] > pixels["most"]  # the picture follows
    assert seen["slider"]["stepped"]["step"] == seen["slider"]["most"]["step"] - 1  # by an arrow


def test_a_file_that_is_no_recording_is_one_line_and_the_page_goes_on(seen):
    wrong = {"notes.npy": ("no .npy",), "seven.npy": ("7", "24"), "cut.npz": ("damaged",)}
    for name, words in wrong.items():
        told = seen[name]
        assert name in told["said"]
        assert all(word in told["said"] for word in words)
        assert len(told["said"].splitlines()) == 1
        assert told["lines"] == seen["lines"]


@pytest.mark.parametrize("name", broken_streams())
def test_lost_channels_are_named_and_the_page_goes_on(seen, name):
    told, expected = seen[f"{name}.npy"], truth(broken_streams()[name])
    assert_same(ran(told["lines"]), expected)
    assert told["invalid"] == sum(not row["valid"] for row in expected)
    assert (told["invalid"] > 0) == (name != "dead")
    assert told["said"] == ""
    *_, last = expected
    assert bool(last["channels_lost"]) == (name != "faint")
    assert all(channel in told["channels"] for channel in last["channels_lost"])
    assert ("levels far" in told["channels"]) == (name == "faint")
    assert (
        ("too few" in told["channels"])
        == (told["probability"] == "\N{EN DASH}")
        == (name == "missing")
    )


@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_files_of_the_package_are_played_with_what_they_say_of_themselves(seen, ending):
    told = seen[f"own.{ending}"]
    assert told["said"] == ""
    assert "recording" in told["simulated"]
    assert_same(ran(told["lines"]), truth(slipping_stream()))


def test_a_model_that_is_not_what_it_should_be_is_one_line(seen):
    changed, cut, lone, slower, of_bins = seen["altered"]
    assert "stream.onnx.json" in changed
    assert "stream.onnx.json" in cut
    assert "stream.onnx.json" in lone
    assert "sample_rate_hz" in slower
    assert "1 kHz" in slower
    assert "bin graph" in of_bins
    assert all(len(line.splitlines()) == 1 for line in seen["altered"])


LIVE_S = float(os.environ.get("TACTSLIP_LIVE_S", "15"))
"""Seconds of a live stream that are looked at."""


def test_a_live_stream_is_drawn_whole_and_as_the_package_decides(script, tmp_path):
    """At 2 kHz and 24 channels, from ``tactslip stream`` over its socket."""
    detector, sample = SlipDetector.pretrained(NAME), named_format("npz").load(RECORDING)
    recording = replace(sample.recording, samples=sample.recording.samples.repeat(1, 100))
    model, source = tmp_path / "detector.pt", tmp_path / "long.npz"
    detector.save(model)
    named_format("npz").save(source, recording, sample.hand, {})
    words = [f"model={model}", f"source={source}", "serve=true", "port=0", "output=null"]
    command = [sys.executable, "-m", "tactslip_torch", "stream", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as server:
        assert server.stderr is not None
        try:
            said = next(line for line in server.stderr if line.startswith("page: "))
            done = script("check.mjs", f"--live={said.split()[1]}", f"--seconds={LIVE_S:g}")
        finally:
            server.kill()
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    live, shown = seen["live"], seen["live"]["shown"]
    assert (seen["errors"], live["numMissing"]) == ([], 0)
    assert live["end"] - live["first"] > (LIVE_S - 5) * RATE
    assert (shown["stream-state"], shown["dropped"], shown["dropped_to_page"]) == (
        "connected",
        "0",
        "0",
    )
    assert live["busy"] < 0.5  # of a core
    assert live["slip"] > 0
    assert not [url for url in seen["requests"] if "ort" in Path(url).name or "/node" in url]
    assert [fault for fault in seen["accessibility"] if fault[1] in ("serious", "critical")] == []
    samples = recording.samples[:, : live["end"]].T
    np.testing.assert_array_equal(np.array(live["last"], np.float32), samples[-1])
    stream = StreamingDetector(detector, dtype=samples.dtype)
    expected = decision_columns(stream.push(samples), has_onset=False)
    held = live["decisions"]
    skipped = expected["time_s"].index(held[0]["time_s"])
    assert len(held) > (LIVE_S - 5) * RATE / detector.info[KEY]["hop_samples"]
    for name, column in expected.items():
        drawn = [decision[name] for decision in held]
        wanted = column[skipped : skipped + len(held)]
        if name == "channels_lost":
            assert drawn == wanted
            continue
        np.testing.assert_allclose(drawn, wanted, rtol=1e-5, atol=1e-6, err_msg=name)


SCALE = """
import { thresholdScale } from "./alarm.mjs";
const scale = thresholdScale(JSON.parse(process.argv[1]));
const shares = Array.from({ length: 101 }, (_, i) => i / 100);
const own = scale.toThreshold(scale.own);
const thresholds = shares.map(scale.toThreshold);
console.log(JSON.stringify({ thresholds, own, title: scale.title, ownText: scale.ownText }));
"""


def scale_of(facts):
    """Thresholds from the left end of the slider to its right end, and at the file's own mark."""
    installed(WEB)
    command = ["node", "--input-type=module", "-e", SCALE, json.dumps(facts)]
    done = subprocess.run(command, cwd=WEB, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_the_slider_goes_by_false_alarms_where_the_model_knows_them():
    curve = [[9.0, 0.0], [8.0, 0.5], [7.0, 0.5], [6.0, 2.0], [3.0, 90.0], [1.0, 700.0]]
    cusum = {"name": "cusum", "ceiling": 10.0}
    told = scale_of({"threshold_curve": curve, "threshold": 5.0, "rule": cusum})
    assert told["title"] == "False alarms allowed"
    assert told["thresholds"] == sorted(told["thresholds"], reverse=True)
    assert told["thresholds"][0] == 8.0  # a rate of 0 has no logarithm
    assert told["thresholds"][-1] == 1.0
    assert told["own"] == pytest.approx(5.0)
    assert told["ownText"] == "7.1 an hour"  # 2 (90 / 2)^(1/3): a third of the way, by logarithm


@pytest.mark.parametrize(
    ("arguments", "says", "status"),
    [
        ([], "--model", 2),
        (["--model", "no.onnx", "--recording", "no.npy"], "no.onnx", 1),
        (["--model", "no.onnx", "--port", "many"], "many", 1),
    ],
)
def test_the_server_says_in_one_line_what_is_wrong(script, arguments, says, status):
    done = script("serve.mjs", *arguments)
    assert done.returncode == status
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert says in line
