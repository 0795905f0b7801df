"""Each benchmark runs in its smallest form, and writes where it is asked to."""

import json
import subprocess
import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_real_sets import write_osu

from benchmarks import train
from benchmarks.harness import Benchmark, between_markers
from benchmarks.native_c import BOARD_TOOLS, TOOLS, missing_tools
from benchmarks.real_sets import RealSet
from benchmarks.tables import Table
from benchmarks.timing import interleaved, paired_ratio

ROOT = Path(__file__).parents[1]
SUBJECTS = [
    path.stem
    for path in sorted((ROOT / "benchmarks").glob("*.py"))
    if "(Benchmark)" in path.read_text(encoding="utf-8")
]
"""Benchmarks of the harness, one a file."""


def _subject(name: str) -> type[Benchmark]:
    module = import_module(f"benchmarks.{name}")
    (subject,) = (
        of
        for of in vars(module).values()
        if isinstance(of, type) and issubclass(of, Benchmark) and of.__module__ == module.__name__
    )
    return subject


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_subject_runs_in_its_smallest_form(name: str, tmp_path: Path, monkeypatch, drawn) -> None:
    """In this process, as most commands that a subject runs; figures are small."""
    monkeypatch.chdir(ROOT)
    if name == "closed_loop":
        pytest.importorskip("mujoco")
    needed = {"native_c": TOOLS, "per_cost": BOARD_TOOLS}.get(name, ())
    if missing := missing_tools(needed):
        pytest.skip(f"not installed: {', '.join(missing)}; run .ci/boards")
    arguments = ["--quick", "--out", str(tmp_path)]
    if name == "real":
        arguments.append(str(_real_sets(tmp_path / "sets")))
    if name == "real_onsets":
        arguments.append(str(_trials(tmp_path / "trials")))
    subject = _subject(name)()
    assert subject.run(arguments) == 0
    assert json.loads((tmp_path / f"{name}.json").read_text())["quick"]
    assert (tmp_path / f"{name}.md").read_text().count("|") > 10
    assert (tmp_path / f"{name}.png").stat().st_size > 2_000
    assert subject.run(["--render", *arguments]) == 0


@pytest.mark.parametrize("name", SUBJECTS)
def test_a_section_has_its_place_in_a_page(name: str) -> None:
    subject = _subject(name)
    page = (ROOT / subject.page).read_text(encoding="utf-8")
    marker = subject.markers or subject.name
    assert f"<!-- {marker} -->" in page
    assert f"<!-- /{marker} -->" in page


def test_calls_are_timed_in_turns_and_ratios_are_those_of_rounds() -> None:
    made: list[str] = []
    calls = {name: partial(made.append, name) for name in "ab"}
    timings = interleaved(calls, rounds=3, block_s=0)
    assert sorted(timings) == ["a", "b"]
    assert [len(of["seconds"]) for of in timings.values()] == [3, 3]
    assert made[-6:].count("a") == 3
    assert paired_ratio([1.0, 6.0, 3.0], [1.0, 3.0, 2.0]).median == 1.5


def test_a_table_has_numbers_to_the_right_and_words_to_the_left() -> None:
    rows = [
        {"what": "a", "us": "1.5 (1 to 2)", "why": "so"},
        {"what": "b", "us": None, "why": "so"},
    ]
    table = Table(rows)
    assert table.markdown().split("\n")[1] == "| --- | ---: | --- |"


def test_names_in_a_chart_leave_out_results_and_what_all_rows_have() -> None:
    rows = [
        {"method": "a", "slips": "116", "test %": "98.8 ± 0.1", "found %": "40 [30, 50]"},
        {"method": "b", "slips": "116", "test %": "96.0 ± 0.2", "found %": "60 [50, 70]"},
    ]
    assert Table(rows).columns("found") == (["a", "b"], {"found %": [40.0, 60.0]})
    rows[1]["slips"] = "99"
    assert Table(rows).columns("found")[0] == ["a, slips 116", "b, slips 99"]


def test_only_what_stands_between_the_markers_is_replaced() -> None:
    text = "before\n<!-- a -->\nold\n<!-- /a -->\nbehind"
    assert between_markers(text, "a", "new") == text.replace("old", "new")
    with pytest.raises(ValueError, match="not both there"):
        between_markers(text, "b", "new")


def test_seconds_of_features_are_counted_in_one_stage_of_a_training_alone(tmp_path, monkeypatch):
    # of the features, some are made before the fit and some in the test
    seconds = {"features": 3.0, "fit": 2.0, "test": 4.0, "total": 7.0}
    metrics = {"timing_s": seconds, "splits": {"test": {"num_bins": 30}}}
    (tmp_path / "cold").mkdir()
    (tmp_path / "cold" / "metrics.json").write_text(json.dumps(metrics))

    def ended(command, **options):
        return subprocess.Popen([sys.executable, "-c", ""], **options)

    monkeypatch.setattr(train, "subprocess", SimpleNamespace(Popen=ended))
    run = train._training([], tmp_path, "cold", 0.01)
    assert run["stages"] == {"start-up": run["wall_s"] - 7, "fit": 2.0, "test": 4.0, "other": 1.0}
    assert (run["features_s"], run["bins_a_second"]) == (3.0, 10.0)


def _trials(folder: Path) -> Path:
    """Six trials of three objects that shake while they slip, for two of twelve seconds."""
    generator = np.random.default_rng(5)
    folder.mkdir()
    is_slip = (np.arange(300) >= 200) & (np.arange(300) < 250)
    for number, name in enumerate(["bottle", "brush", "pen"] * 2):
        rows = generator.standard_normal((300, 12)) * (1 + 20 * is_slip[:, None])
        write_osu(folder / f"{name}_C_1_{number}.csv", rows, is_slip.astype(int))
    return folder


def _real_sets(folder: Path) -> Path:
    """Two sets: slip is a vibration; and its pitch, which is one of three words."""
    generator = np.random.default_rng(5)
    folder.mkdir()
    rows = [(f"e{place}", "electrode", "finger", "distal", "fast") for place in range(3)]
    pitch = np.tile([0.0, 0.9, 1.4], 24)
    wave = np.sin(pitch[:, None, None] * np.arange(32)) * np.ones((1, 3, 1))
    x = (wave + 0.1 * generator.standard_normal(wave.shape)).astype(np.float32)
    group, recording = np.repeat(["bottle", "brush", "pen"], 24), np.tile(["a", "b"], 36)
    for name, y in (("slip", pitch > 0), ("pitch", np.tile(["none", "low", "high"], 24))):
        numbers = np.array(100.0), np.array(rows), np.array("made here")
        np.savez(folder / f"{name}.npz", **RealSet(x, y, group, recording, *numbers)._asdict())
    return folder
