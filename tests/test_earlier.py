"""What 0.2.0 heard stands beside the alarm where the recordings are the same."""

import json

import pytest

from benchmarks import alarms

HERE = {"pulled": "a", "pinch": "b", "held": "c", "taps": "d"}
KEPT = {
    "digests": HERE | {"pinch": "other", "taps": "other"},
    "slips": {"pulled": [0.1], "pinch": [0.2]},
    "quiet": {"held": {"alarms": 1}, "taps": {"alarms": 2}},
}


@pytest.fixture
def heard(tmp_path, monkeypatch):
    """What is taken of a kept file."""
    monkeypatch.setattr(alarms, "KEPT", tmp_path / "kept.json")
    monkeypatch.setattr(alarms.Alarms, "digests", lambda self, given: HERE)

    def taken(kept):
        if kept is not None:
            alarms.KEPT.write_text(json.dumps(kept))
        return alarms.Alarms()._earlier([])

    return taken


def test_numbers_of_other_recordings_are_left_out_and_named(heard, capsys):
    assert heard(KEPT) == {"slips": {"pulled": [0.1]}, "quiet": {"held": {"alarms": 1}}}
    assert "0.2.0 has not heard these recordings (pinch, taps)" in capsys.readouterr().err


def test_without_a_kept_file_nothing_stands_beside_the_alarm(heard):
    assert heard(None) == {"slips": {}, "quiet": {}}
