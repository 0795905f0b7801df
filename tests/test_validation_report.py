"""The table and the figure of what was chosen from."""

from matplotlib.image import imread

from tactslip_torch.report.results import validation_figure, validation_table

KERNEL = {"kind": "polynomial", "degree": 2, "offset": 0.5}


def row(size, penalty, **scores):
    known = [score for score in scores.values() if score is not None]
    return {
        "num_features": size,
        "kernel": KERNEL,
        "penalty": penalty,
        "mean": sum(known) / len(known),
        "balanced_accuracy": scores,
    }


ROWS = [
    row(60, 0.1, M1=0.9, M2=0.7, M3=None),
    row(60, 1.0, M1=0.8, M2=0.9, M3=None),
    row(120, 0.1, M1=0.95, M2=0.75, M3=None),
]


def test_the_first_of_the_best_is_marked_and_the_worst_group_named():
    lines = validation_table(ROWS, simulated=True).splitlines()
    assert lines[0].startswith("SIMULATED")
    cells = [line.split() for line in lines[2:]]
    assert cells[0] == ["60", "degree", "2,", "c", "0.5", "0.1", "80.00", "70.00", "M2"]
    assert cells[1] == ["*", "60", "degree", "2,", "c", "0.5", "1", "85.00", "80.00", "M1"]
    assert cells[2][0] == "120"
    assert "SIMULATED" not in validation_table(ROWS, simulated=False)


def test_the_figure_is_a_picture_of_some_size(tmp_path):
    rbf = {**row(60, 0.3, M1=0.5, M2=None, M3=0.4), "kernel": {"kind": "radial basis", "gamma": 1}}
    validation_figure([*ROWS, rbf], tmp_path / "validation.png", simulated=True)
    height, width, _ = imread(tmp_path / "validation.png").shape
    assert height > 500
    assert width > 900
