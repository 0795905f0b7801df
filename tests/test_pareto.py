"""A deadline in, a detector that keeps it out."""

import json
import time

import pytest
from contract.names import settings
from contract.recordings import of_set, split_of_set

from tactslip_torch import SlipDetector
from tactslip_torch.commands.configuration import compose_config
from tactslip_torch.commands.pareto import pareto
from tactslip_torch.pareto import Candidate, Timing, _time_detector, choose, nondominated


def candidate(accuracy, p99_us, hop_ms=10.0):
    return Candidate("general", 5, "float64", hop_ms, accuracy, 10.0, 50.0, Timing(1, p99_us), "")


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


def test_a_detector_is_timed_by_its_calls(paper, monkeypatch):
    detector = paper.detector
    monkeypatch.setattr(detector, "predict_raw", lambda samples: time.sleep(0.002))
    timing = _time_detector(detector, 10)
    assert 2000 <= timing.p50_us <= timing.p99_us < 50_000


def of(recordings, cache, *overrides):
    small = ["recipes.paper.num_features=8", "calls=5", "sizes=[null,4]", "hops_ms=[25]"]
    data = [*of_set(recordings), *split_of_set(), *settings(workers=0, cache=cache)]
    given = ["~recipe@recipes.general", "precisions=[float64]", *small, *data, *overrides]
    return compose_config("pareto", given)


@pytest.mark.slow
def test_the_detector_that_is_left_keeps_its_deadline(recordings, cache, tmp_path, capsys):
    found = pareto(of(recordings, cache, "deadline_us=1e6"), tmp_path)
    assert json.loads((tmp_path / "pareto.json").read_text()) == found
    assert [row["size"] for row in found["candidates"]] == [8, 4]
    best = max(row["accuracy"] for row in found["candidates"])
    assert found["chosen"]["accuracy"] == best
    detector = SlipDetector.load(tmp_path / "detector.pt")
    assert len(detector.selected_names) == found["chosen"]["size"]
    assert "chosen" in capsys.readouterr().out
    again = tmp_path / "again"
    again.mkdir()
    (again / "detector.pt").touch()  # of an earlier run
    assert pareto(of(recordings, cache, "deadline_us=0.001"), again)["chosen"] is None
    assert not (again / "detector.pt").exists()
    assert "deadline_us=0.001" in capsys.readouterr().err


BAD = {"deadline_us=0": "deadline_us", "hops_ms=[-1]": "hops_ms", "sizes=[]": "sizes"}


@pytest.mark.parametrize("override", BAD)
def test_limits_that_are_none_are_refused_before_any_training(override, tmp_path):
    with pytest.raises(ValueError, match=BAD[override]):
        pareto(compose_config("pareto", [override]), tmp_path)
