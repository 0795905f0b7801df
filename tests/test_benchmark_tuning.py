"""The benchmark of tuning, as a user runs it, on very little."""

import json

import pytest

from benchmarks import tuning
from tactslip_torch.report.tuning import held_mean


@pytest.mark.slow
def test_quick_run_prints_and_keeps(tmp_path, capsys):
    kept, drawn = tmp_path / "tuning.json", tmp_path / "tuning.png"
    assert tuning.main(["--quick", "--json", str(kept), "--figure", str(drawn)]) == 0
    report = json.loads(kept.read_text())
    assert tuple(report["sections"]) == tuning.SECTIONS
    assert report["simulated"] is True
    printed = capsys.readouterr().out
    for name, found in report["sections"].items():
        assert f"{name} tuned" in printed
        assert f"{held_mean(found, 'tuned'):.4f}" in printed
        assert len(found["held"]) == 3
    everything = report["sections"][tuning.SECTIONS[-1]]
    assert everything["learned"] == ["penalty", "offset", "scales", "smoothing", "wavelet"]
    assert drawn.read_bytes().startswith(b"\x89PNG")


def test_limits_compare_with_both_choices_of_the_grid():
    def found(recipe, grid, tuned):
        losses = {"recipe": recipe, "grid": grid, "tuned": tuned}
        return {"held": [{way: {"loss": loss} for way, loss in losses.items()}]}

    rows = tuning.limit_rows({"one": found(0.4, 0.2, 0.3), "two": found(0.4, 0.2, 0.1)})
    assert [row["ok"] for row in rows] == [True, False, True, True]
    assert [row["measured"] for row in rows] == ["0.750", "1.500", "0.250", "0.500"]
