"""Kept results of 0.2.0 stand beside the alarm where the recordings are the same."""

import json

import pytest

from benchmarks import alarms

HERE = {"pulled": "a", "pinch": "b", "held": "c", "taps": "d"}
KEPT = {
    "digests": HERE | {"pinch": "other", "taps": "other", "no longer made": "e"},
    "slips": {"pulled": [0.1], "pinch": [0.2], "no longer made": [0.3]},
    "quiet": {"held": {"alarms": 1}, "taps": {"alarms": 2}},
}


@pytest.fixture
def taken(tmp_path, monkeypatch):
    """What is taken of a kept file."""
    monkeypatch.setattr(alarms, "KEPT", tmp_path / "kept.json")
    monkeypatch.setattr(alarms.Alarms, "digests", lambda self, given: HERE)

    def read(kept):
        if kept is not None:
            alarms.KEPT.write_text(json.dumps(kept))
        return alarms.Alarms()._earlier([])

    return read


def test_results_of_other_recordings_are_left_out_and_named(taken, capsys):
    assert taken(KEPT) == {
        "slips": {"pulled": [0.1]},
        "quiet": {"held": {"alarms": 1}},
        "others": ["pinch", "taps"],
    }
    said = "kept results of 0.2.0 are of other recordings (pinch, taps); run benchmarks.earlier"
    assert said in capsys.readouterr().err


def test_without_a_kept_file_nothing_stands_beside_the_alarm(taken):
    found = taken(None)
    assert (found["slips"], found["quiet"]) == ({}, {})
    assert found["others"] == list(HERE)
