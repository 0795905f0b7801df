"""The runs of ``-m`` beside each other."""

import csv

from tactslip_torch.report.sweep import sweep_table, write_sweep

RUNS = [
    ("seed=0", {"test/accuracy": 0.9, "test/balanced_accuracy": 0.8}),
    ("seed=1", {"test/accuracy": 0.7, "test/balanced_accuracy": 0.6}),
]


def test_runs_stand_beside_each_other_with_mean_and_deviation(tmp_path):
    lines = sweep_table(RUNS, simulated=True).splitlines()
    assert "SIMULATED" in lines[0]
    assert lines[2].split() == ["seed=0", "90.00", "80.00"]
    assert lines[4].split() == ["mean", "80.00", "70.00"]
    assert lines[5].split() == ["standard", "deviation", "10.00", "10.00"]
    write_sweep(RUNS, tmp_path, simulated=True)
    assert (tmp_path / "runs.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "runs.csv").open() as file:
        assert list(csv.reader(file))[2] == ["seed=1", "0.7", "0.6"]
