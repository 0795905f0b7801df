"""The unmoved numbers: no cell of a confusion moves by more than two bins."""

import json

import pytest

from .unmoved import EXPERIMENTS, FILE, REAL_DATA, measured, moved

NOTED = json.loads(FILE.read_text())


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Features of the simulated set are made once for both recipes."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_numbers_are_unmoved(name, cache, tmp_path):
    if NOTED[name] is None:
        pytest.skip(f"not noted yet: PYTHONPATH=tests python -m contract.unmoved {name}")
    if name == "real" and not REAL_DATA.exists():
        pytest.skip(f"no recordings at {REAL_DATA}; BIOTACSP names another folder")
    assert moved(NOTED[name], measured(name, tmp_path, cache)) == {}
