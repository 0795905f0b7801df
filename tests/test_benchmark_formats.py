import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.formats import __main__ as bench
from benchmarks.formats import measure, report
from benchmarks.formats.measure import LOAD, PEER, SAVE, STREAM
from benchmarks.formats.naive import NAIVE
from benchmarks.formats.sizes import Sizes
from benchmarks.outcome import QUICK_LINE
from tactslip_torch.data.formats.registry import FORMATS

TINY = Sizes(duration_s=0.3, rounds=2)


def row(name: str, load: float, stream: float = 0.01) -> dict[str, Any]:
    taken = {LOAD: load, STREAM: stream, SAVE: 0.02, PEER: 0.5}
    return {
        "format": name,
        "ending": FORMATS[name].endings[0],
        "bytes": 3_000_000,
        "peer": "another",
        "seconds": {what: [of, of, 2 * of] for what, of in taken.items()},
    }


def test_what_is_read_is_the_beginning_of_a_simulated_recording() -> None:
    recording, hand, _ = measure.subject(TINY.duration_s)
    assert recording.samples.shape == (24, 600)
    assert recording.samples.dtype == torch.float32
    assert len(hand) == 24
    assert recording.provenance["simulated"] is True


@pytest.mark.parametrize("name", FORMATS)
def test_another_tool_reads_what_was_written(name: str, tmp_path: Path) -> None:
    held = measure.subject(TINY.duration_s)
    path = tmp_path / f"a.{FORMATS[name].endings[0]}"
    FORMATS[name].save(path, *held)
    found = np.ascontiguousarray(NAIVE[name][1](path))
    assert found.dtype == np.float32
    assert found.tobytes() == held.recording.samples.numpy().tobytes()


def test_a_reader_that_is_wrong_is_not_timed() -> None:
    recording = measure.subject(TINY.duration_s).recording
    wrong = recording.samples.clone()
    wrong[3, 599] += 1
    measure._check({("npz", STREAM): lambda: recording.samples}, recording)
    for found in (wrong, wrong.numpy(), wrong[:, 400:]):
        with pytest.raises(ValueError, match="npz, stream: what was read is not what was written"):
            measure._check({("npz", STREAM): lambda found=found: found}, recording)


@pytest.mark.parametrize(("load", "is_ok"), [(0.099, True), (0.101, False)])
def test_the_limit_is_on_the_median(load: float, is_ok: bool) -> None:
    rows = [row("npz", 0.01), row("hdf5", load), row("text", 9.0)]
    found = {of["what"]: of for of in report.limit_rows(rows)}
    assert len(found) == 6
    assert found["ms, .h5 loaded whole"]["ok"] is is_ok
    assert found["ms, .h5 opened and read in pieces"]["ok"] is True
    assert found["ms, .mcap loaded whole"]["measured"] == "not measured"
    assert not any("csv" in what for what in found)


def test_ratios_are_to_npz_and_to_the_other_tool() -> None:
    section = {"rows": [row("npz", 0.01), row("text", 0.25)], "sample_bytes": 1_500_000}
    made = {
        "sections": {"formats": section},
        "settings": {"piece_ms": 100.0},
        "limits": report.limit_rows(section["rows"]),
    }
    tables = report.tables(made)
    cells = tables["Reading"][0].rows[1]
    assert [cells[place] for place in (0, 2, 4, 7)] == [".csv", "25", "1", "2"]
    assert tables["Writing"][0].rows[1][2:] == ["1", "3", "2"]


def test_quick_run_measures_every_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "QUICK", TINY)
    path, drawing = tmp_path / "numbers.json", tmp_path / "figure.png"
    assert bench.main(["--quick", "--json", str(path), "--figure", str(drawing)]) == 0
    made = json.loads(path.read_text())
    assert made["quick"] is made["simulated"] is True
    rows = made["sections"]["formats"]["rows"]
    assert [of["format"] for of in rows] == list(FORMATS)
    for of in rows:
        assert of["bytes"] > 0
        assert {what: len(taken) for what, taken in of["seconds"].items()} == dict.fromkeys(
            (LOAD, STREAM, SAVE, PEER), TINY.rounds
        )
    shown = capsys.readouterr().out
    assert QUICK_LINE in shown
    assert report.report_text(made) in shown
    assert drawing.stat().st_size > 0
