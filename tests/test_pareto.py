"""A deadline in, a detector that keeps it out."""

import json
import re
import time

import pytest
from contract.names import settings
from contract.recordings import of_set, split_of_set

from tactslip_torch import SlipDetector
from tactslip_torch.commands.configuration import compose_config
from tactslip_torch.commands.pareto import pareto
from tactslip_torch.pareto import (
    Candidate,
    Timing,
    _time_detector,
    choose,
    decision_cost,
    nondominated,
    pareto_table,
)


def candidate(accuracy, p99_us, hop_ms=10.0, m7=2e6):
    timing = Timing(1, p99_us)
    return Candidate("general", 5, "float64", hop_ms, accuracy, 10.0, 50.0, timing, m7, "")


def test_the_most_accurate_that_keeps_the_limits_is_chosen():
    slow, quick, poor = candidate(0.99, 900.0), candidate(0.95, 300.0), candidate(0.9, 100.0)
    every = [poor, slow, quick]
    assert choose(every, 1000.0, None) is slow
    assert choose(every, 500.0, None) is quick
    assert choose(every, 50.0, None) is None
    near, far = candidate(0.9, 100.0, hop_ms=5.0), candidate(0.9, 100.0, hop_ms=25.0)
    assert choose([near, far], 500.0, None) is far  # less to compute
    assert choose([near, far], 500.0, 70.0) is near
    assert far.worst_ms == pytest.approx(10 + 50 + 25 + 0.1)
    assert choose([candidate(0.9, 6000.0, hop_ms=5.0)], 1e5, None) is None  # never in time
    assert "latency_ms=70" in far.misses(500.0, 70.0)[0]


def test_what_another_beats_is_not_on_the_front():
    assert nondominated([(1, 5), (2, 2), (3, 2), (4, 1), (2, 2)]) == [0, 1, 3]


def test_the_table_has_instructions_of_a_microcontroller_and_their_front():
    rows = [candidate(0.9, 300.0, m7=1.25e6).row(), candidate(0.8, 200.0, m7=3e6).row()]
    content = {"candidates": rows, "front": [0, 1], "m7_front": [0], "chosen": rows[0]}
    table = pareto_table({**content, "simulated": False})
    names, *lines = [re.split(r"\s{2,}", line.strip()) for line in table.splitlines()]
    cells = [dict(zip(names, line, strict=True)) for line in lines]
    assert [each["M7 M instr."] for each in cells] == ["1.25", "3.00"]
    assert cells[0]["M7 front"] != cells[1]["M7 front"]
    assert cells[0]["front"] == cells[1]["front"]


def test_a_detector_is_timed_by_its_calls(paper, monkeypatch):
    detector = paper.detector
    monkeypatch.setattr(detector, "predict_raw", lambda samples: time.sleep(0.002))
    timing = _time_detector(detector, 10)
    assert 2000 <= timing.p50_us <= timing.p99_us < 50_000


def of(recordings, cache, *overrides):
    small = ["recipes.paper.num_features=8", "calls=5", "sizes=[null,4]", "hops_ms=[25]"]
    data = [*of_set(recordings), *split_of_set(), *settings(workers=0, cache=cache)]
    given = ["~recipe@recipes.general", "~recipes.cheap", "precisions=[float64]"]
    return compose_config("pareto", [*given, *small, *data, *overrides])


@pytest.mark.slow
def test_the_detector_that_is_left_keeps_its_deadline(recordings, cache, tmp_path, capsys):
    found = pareto(of(recordings, cache, "deadline_us=1e6"), tmp_path)
    assert json.loads((tmp_path / "pareto.json").read_text()) == found
    assert [row["size"] for row in found["candidates"]] == [8, 4]
    best = max(row["accuracy"] for row in found["candidates"])
    assert found["chosen"]["accuracy"] == best
    detector = SlipDetector.load(tmp_path / "detector.pt")
    assert found["chosen"]["m7_instructions"] == decision_cost(detector, "m7")
    assert len(detector.selected_names) == found["chosen"]["size"]
    assert "chosen" in capsys.readouterr().out
    again = tmp_path / "again"
    again.mkdir()
    (again / "detector.pt").touch()  # of an earlier run
    assert pareto(of(recordings, cache, "deadline_us=0.001"), again)["chosen"] is None
    assert not (again / "detector.pt").exists()
    assert "deadline_us=0.001" in capsys.readouterr().err


@pytest.mark.slow
def test_recordings_of_ones_own_and_hops_that_are_no_samples(recordings, cache, tmp_path, capsys):
    config = of(recordings, cache, "deadline_us=1e6", "sizes=[4]", "hops_ms=[25,0.3]")
    groups = "tactslip_torch.data.splits.leave_groups_out"  # as with a folder
    config.split = {"_target_": groups, "_partial_": True, "by": None, "folds": 10}
    found = pareto(config, tmp_path)
    assert [row["hop_ms"] for row in found["candidates"]] == [25]
    assert SlipDetector.load(tmp_path / "detector.pt").info["split"] == "all"
    assert "left out: hops_ms 0.3: no whole number of samples at 2000 Hz" in capsys.readouterr().out


BAD = {
    "deadline_us=0": "deadline_us",
    "hops_ms=[-1]": "hops_ms",
    "hops_ms=[0.3]": r"no whole number of samples .*; give hops_ms=\[1\]",
    "sizes=[]": "sizes",
}


@pytest.mark.parametrize("override", BAD)
def test_limits_that_are_none_are_refused_before_any_training(override, tmp_path):
    (tmp_path / "detector.pt").touch()  # of an earlier run
    with pytest.raises(ValueError, match=BAD[override]):
        pareto(compose_config("pareto", [override]), tmp_path)
    assert (tmp_path / "detector.pt").exists()
