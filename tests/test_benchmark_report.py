import json
import re
from pathlib import Path
from typing import Any

import pytest
from test_benchmark_latency import row
from test_benchmarks import report_of

from benchmarks import report
from benchmarks.latency import report as latency
from benchmarks.latency.ways import LOOP
from benchmarks.selection import kept_selection


def latency_report(seconds: float = 1e-3) -> dict[str, Any]:
    rows = [row(LOOP, 0.25), row("eager, float32", seconds), row("filter", 1e-5, is_whole=False)]
    return {
        "simulated": True,
        "quick": False,
        "machine": {"processor": "abacus"},
        "versions": {"torch": "2.13.0"},
        "selection": kept_selection(),
        "training_bins": 99,
        "sections": {"latency": {"rows": rows}},
        "limits": latency.limit_rows(rows),
    }


def write(folder: Path, **reports: dict[str, Any]) -> None:
    for name, of in reports.items():
        (folder / f"{name}.json").write_text(json.dumps(of))


def test_what_was_measured_is_shown_and_what_was_not_is_named(tmp_path: Path) -> None:
    results = tmp_path / "results"
    results.mkdir()
    write(results, latency=latency_report())
    out = tmp_path / "B.md"
    assert report.main(["--results", str(results), "--out", str(out)]) == 0
    text = out.read_text()
    rest = len(report.SECTIONS)  # all but this one, which has one such row
    assert f"1 of 1 limits that were measured are met; rows not measured: {rest}." in text
    assert "![Latency](results/latency.png)" in text
    assert (results / "latency.png").stat().st_size > 0
    assert "| eager, float32 | 120 | 1,000 |" in text
    assert "abacus; torch 2.13.0" in text
    assert "simulated" in text
    for name in set(report.SECTIONS) - {"latency"}:
        assert f"| {name}: every limit | not measured |" in text
        assert f"Not measured; `python -m benchmarks.{name}` does." in text


def test_a_missed_limit_is_counted_and_named(tmp_path: Path) -> None:
    text = report.markdown({"latency": latency_report(seconds=0.1)}, "results")
    assert "0 of 1 limits" in text
    assert re.search(r"^\| latency: p50.*\| MISSED \|$", text, re.MULTILINE)


def test_training_is_text(tmp_path: Path) -> None:
    text = report.markdown({"train": report_of([12.0], [10.0])}, "results")
    assert "process total" in text
    assert "train.png" not in text


def test_quick_numbers_are_named_so() -> None:
    made = latency_report() | {"quick": True}
    text = report.markdown({"latency": made}, "results")
    assert text.startswith("# Benchmarks, QUICK: numbers mean nothing\n\n**QUICK runs: latency.**")
    assert "0 of 0 limits" in text
    assert "| met |" not in text
    assert "QUICK" not in report.markdown({"latency": latency_report()}, "results")
    trained = report_of([12.0], [10.0]) | {"experiment": "quick"}
    assert "QUICK runs: train" in report.markdown({"train": trained}, "results")


@pytest.mark.parametrize("name", report.SECTIONS)
def test_a_file_that_lacks_a_section_is_refused(name: str, tmp_path: Path) -> None:
    section = report.SECTIONS[name]
    keys = ("machine", "versions", "limits", *section.keys)
    whole = {"sections": dict.fromkeys(section.needs, 0), **dict.fromkeys(keys, 0)}
    write(tmp_path, **{name: whole})
    assert report.load_reports(tmp_path) == {name: whole}
    for key in keys:
        write(tmp_path, **{name: {of: whole[of] for of in whole if of != key}})
        with pytest.raises(ValueError, match=f'has no "{key}"; python -m benchmarks.{name}'):
            report.load_reports(tmp_path)
    for lacking in section.needs:
        rest = {of: 0 for of in section.needs if of != lacking}
        write(tmp_path, **{name: whole | {"sections": rest}})
        with pytest.raises(ValueError, match=f"has no section {lacking};"):
            report.load_reports(tmp_path)


@pytest.mark.parametrize("content", [None, "{", "[]", '{"sections": {"solve": {}}}'])
def test_without_numbers_one_line_says_so(
    content: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content:
        (tmp_path / "features.json").write_text(content)
    assert report.main(["--results", str(tmp_path), "--out", str(tmp_path / "B.md")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "B.md").exists()
