"""The benchmark of sensors: both ways of selection, and what BENCHMARKS.md shows of them."""

import json
from pathlib import Path

import pytest
from test_commands import TINY
from test_commands import composed as composed_train
from test_sensors import composed

from benchmarks import report as page
from benchmarks import sensors as bench
from tactslip_torch.report.sensors import percent
from tactslip_torch.sensors import sensors
from tactslip_torch.train import train


def here(module, *arguments):
    """The commands of the benchmark, in this process and on a tiny set."""
    rest = [a for a in arguments if not a.startswith("hydra.run.dir=")]
    folder = Path(next(a for a in arguments if a not in rest).partition("=")[2])
    if module == "tactslip_torch.train":
        folder.mkdir()
        train(composed_train(*TINY, "recipe=robust", "cache=off"), folder)
    else:
        sensors(composed(*rest, "cache=off"), folder)


@pytest.fixture(scope="module")
def made():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "_run", here)
        return bench.measure(None, ["most_channels=2"])


def test_both_ways_are_measured_on_the_same_detector(made):
    ranked, shared = (made["sections"][name] for name in ("ranked", "shared"))
    assert ranked["settings"]["anew"] == "ranked"
    assert shared["settings"]["anew"] == "shared"
    assert ranked["with_all"]["as_selected"] == shared["with_all"]["as_selected"]
    assert len(ranked["best"]["channel"]) == 2
    json.dumps(made, allow_nan=False)


def test_the_page_has_a_row_for_every_channel_and_step_of_both(made, tmp_path):
    (tmp_path / "sensors.json").write_text(json.dumps(made))
    reports = page.load_reports(tmp_path)
    text = page.markdown(reports, "results")
    assert "## Which sensors matter" in text
    assert "![Which sensors matter](results/sensors.png)" in text
    assert text.count("\n| SG1 | ") == text.count("\n| PVDF2 | ") == 2
    for content in made["sections"].values():
        first = content["best"]["channel"][0]
        row = f"| 1 | {first['joins']} | {first['num_features']} | "
        assert row + percent(first["balanced_accuracy"]["held_out"]) in text
    bench.figure(made, tmp_path / "sensors.png")
    assert (tmp_path / "sensors.png").stat().st_size > 10_000


def test_what_was_measured_names_its_data(made):
    assert "recorded, 10 features of 4 channels" in bench.about(made)
    content = made["sections"]["ranked"] | {"simulated": True}
    assert "simulated" in bench.about({"sections": {"ranked": content}})


def test_a_command_that_fails_ends_the_benchmark_with_its_status(capfd):
    with pytest.raises(SystemExit) as stop:
        bench.measure(Path("nothing.pt"), [])
    assert stop.value.code == 2
    assert "nothing.pt" in capfd.readouterr().err
