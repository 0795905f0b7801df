"""The table of seeds in README.md is the one that the stored results make."""

import json
import statistics

import pytest

from benchmarks import seeds
from tactslip_torch.features.cache import source_digest


def run(seed, balanced, role="test"):
    scores = {"accuracy": 0.9, "non_slip_recall": 0.8, "slip_recall": 1.0, "num_bins": 100}
    return {
        "simulated": True,
        "seed": seed,
        "splits": {role: {**scores, "balanced_accuracy": balanced}},
        "best_single_feature": {role: 0.75},
        "penalty": 0.1,
        "selected": [],
    }


def test_the_readme_shows_the_stored_results():
    rows = json.loads((seeds.RESULTS / "seeds.json").read_text())
    assert (
        f"<!-- seeds -->\n{seeds.table(rows)}\n<!-- /seeds -->"
        in (seeds.ROOT / "README.md").read_text()
    )
    for runs in rows.values():
        assert [row["seed"] for row in runs] == list(range(len(runs)))
        assert len(runs) >= 3
        assert all(row["simulated"] for row in runs)


def test_the_table_shows_mean_and_spread_and_calls_them_simulated():
    values = [0.91, 0.95, 0.93]
    lines = seeds.table({"seen": [run(i, value) for i, value in enumerate(values)]}).splitlines()
    assert len(lines) == 3
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    spread = 100 * statistics.stdev(values)
    assert cells[0] == "`seen` test, simulated, 3 seeds"
    assert cells[3] == f"93.00 ± {spread:.2f}"
    assert cells[2] == "90.00 ± 0.00"
    assert cells[-1] == "75.00 ± 0.00"


def test_the_papers_rows_stand_beside_what_they_compare_with():
    text = seeds.table({"random_bins": [run(0, 0.9)], "unseen4": [run(0, 0.9, "unseen")]})
    assert [line.split("|")[1].strip() for line in text.splitlines()[2:]] == [
        "`random_bins` test, simulated, 1 seeds",
        "paper, real hand, random bins",
        "`unseen4` unseen, simulated, 1 seeds",
        "paper, real hand, unseen",
    ]


def test_only_what_stands_between_the_markers_is_replaced():
    text = "before\n<!-- x -->\nold\n<!-- /x -->\nafter"
    assert seeds.between_markers(text, "x", "new") == "before\n<!-- x -->\nnew\n<!-- /x -->\nafter"
    with pytest.raises(ValueError, match="<!-- y -->"):
        seeds.between_markers(text, "y", "new")


def test_a_finished_run_is_not_trained_again(tmp_path, monkeypatch):
    folder = tmp_path / "unseen4-0"
    folder.mkdir()
    code = source_digest(seeds.ROOT / "tactslip_torch")
    metrics = {"seed": 0, "versions": {"code": code}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    monkeypatch.setattr(seeds.subprocess, "run", lambda *a, **k: pytest.fail("trained"))
    assert seeds.run("unseen4", 0, tmp_path) == metrics


def test_a_run_of_other_code_is_trained_again(tmp_path, monkeypatch):
    folder = tmp_path / "unseen4-0"
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps({"seed": 0, "versions": {"code": "other"}}))
    commands = []

    class Done:
        returncode = 0

    monkeypatch.setattr(seeds.subprocess, "run", lambda c, **k: commands.append(c) or Done)
    seeds.run("unseen4", 0, tmp_path)
    assert "+exp=unseen4" in commands[0]


def test_a_failed_training_is_an_error(tmp_path, monkeypatch):
    class Failed:
        returncode = 2

    monkeypatch.setattr(seeds.subprocess, "run", lambda *a, **k: Failed)
    with pytest.raises(RuntimeError, match="unseen4 with seed 3 failed"):
        seeds.run("unseen4", 3, tmp_path)
